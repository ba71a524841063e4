//! A run of a model that this workspace has no code for: it has a run folder like any other, and commands that cannot use it say so.

use autograd::nn::{Activation, Mlp};
use autograd::optim::{Adam, AdamMode, Optimizer};
use autograd::{Real, Tensor, impl_module, random::Stream};
use plenoxel::camera::Ray;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, View};
use plenoxel::error::Result;
use plenoxel::geometry::Aabb;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::render::{Radiance, Rendered, composite};
use plenoxel::run::data::DataSource;
use plenoxel::run::training::{Event, Outcome, RunOptions, RunSettings, resume_model, train_model};
use plenoxel::sampling::{Spacing, sample};
use plenoxel::train::{Model, Pass, PlannedStage, TrainOptions, Trainer};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::command::{Folder, plenoxel};

/// A multilayer perceptron of the position.
struct Field<T: Real> {
    net: Mlp<T>,
}
impl_module!(Field { net });

impl Model<f32> for Field<f32> {
    fn kind(&self) -> &'static str {
        "position mlp"
    }

    fn aabb(&self) -> Aabb {
        Aabb::cube(1.4)
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<f32> {
        let samples = sample::<f32>(rays, &self.aabb(), Spacing::Step(0.3), pass.jitter, None);
        let out = self.net.forward(&samples.positions);
        let radiance = Radiance { sigma: out.index_axis(1, 0).softplus(), rgb: out.narrow(1, 1, 3).sigmoid() };
        composite(samples, radiance, &Tensor::from_vec(pass.background.to_vec(), &[3]))
    }

    fn optimizer(&self, _: &PlannedStage) -> Box<dyn Optimizer<f32>> {
        Box::new(Adam::new(1e-2, AdamMode::Dense))
    }
}

const STEPS: u64 = 30;

fn start(config: &Config, _: &Dataset, views: Arc<[View]>) -> Result<Trainer<f32, Field<f32>>> {
    let net = Mlp::new("net", &[3, 16, 4], Activation::Relu, &Stream::new(7));
    let options = TrainOptions { steps: STEPS, rays_per_step: 128, ..config.train_options() };
    Trainer::with_model(Field { net }, views, Objective::new().with("mse", 1.0, mse), options)
}

fn settings(out: &Path) -> RunSettings {
    let scene = ProceduralOptions { width: 24, height: 24, train: 8, val: 0, test: 2, supersample: 1 };
    RunSettings { out: Some(out.to_owned()), ..RunSettings::new(Config::default(), DataSource::built_in(&scene)) }
}

#[test]
fn a_model_of_ones_own_has_a_run_folder_that_resumes_to_the_same_bits() {
    let folder = Folder::new("own-model");
    let [whole, cut] = ["whole", "cut"].map(|name| folder.0.join(name));
    let mut steps = 0;
    let done = train_model(&settings(&whole), start, &mut |event| steps += u64::from(matches!(event, Event::Step { .. }))).unwrap();
    let Outcome::Done(summary) = done else { panic!("it was not stopped") };
    assert_eq!((steps, summary.steps), (STEPS, STEPS));

    let asked = AtomicU64::new(0);
    let options = RunOptions { stop: Box::new(move || asked.fetch_add(1, Relaxed) >= 11), ..RunOptions::default() };
    let stopped = train_model(&RunSettings { options, ..settings(&cut) }, start, &mut |_| {}).unwrap();
    assert!(matches!(stopped, Outcome::Stopped { total: STEPS, .. }));
    resume_model(&cut, None, &RunOptions::default(), start, &mut |_| {}).unwrap();
    let checkpoint = |run: &Path| std::fs::read(run.join("checkpoint.safetensors")).unwrap();
    assert!(checkpoint(&whole) == checkpoint(&cut), "a resumed run has other bits");

    let result: serde_json::Value = serde_json::from_slice(&std::fs::read(whole.join("result.json")).unwrap()).unwrap();
    assert!(result["psnr"].as_f64().unwrap() > 5.0 && result["views"] == 2);
    assert_eq!((&result["model"]["kind"], &result["model"]["parameters"]), (&"position mlp".into(), &132.0.into()));
    let lines = std::fs::read_to_string(whole.join("metrics.jsonl")).unwrap();
    assert_eq!(lines.lines().filter(|line| line.contains("\"loss\"")).count() as u64, STEPS);
}

#[test]
fn commands_say_what_they_cannot_do_with_a_kind_that_they_do_not_know() {
    let folder = Folder::new("unknown-kind");
    let run = folder.0.join("run");
    train_model(&settings(&run), start, &mut |_| {}).unwrap();
    let run = folder.path("run");
    let about = plenoxel(&["info", &run]).done();
    assert!(about.contains("position mlp") && about.contains("net.0.weight [3, 16]"), "{about}");
    plenoxel(&["report", &run]).done();
    let page = std::fs::read_to_string(folder.0.join("run/report.html")).unwrap();
    assert!(page.contains("PSNR") && !page.contains("<canvas"));
    for command in [&["evaluate"][..], &["render"], &["export", "vox"], &["export", "mesh"], &["export", "ply"]] {
        plenoxel(&[command, &[&run[..]]].concat()).refused(3, &["checkpoint.safetensors", "`position mlp`"]);
    }
    plenoxel(&["train", "--resume", &run]).refused(3, &[&run, "this run is finished"]);
    plenoxel(&["train", "--preset=demo", "--scene-size=24", "--init-from", &run, "--out", &folder.path("next")])
        .refused(3, &["`position mlp`"]);
    plenoxel(&["compare", &run, &run, "--out", &folder.path("compared.html")]).done();
}
