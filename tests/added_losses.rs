//! Losses that a program adds to those of the settings, whatever model they name.

use autograd::{Param, Tensor};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::settings::Layers;
use plenoxel::run::training::{Event, Outcome, RunOptions, RunSettings, resume_adding, train, train_adding};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::command::Folder;

const OF_MODELS: [(&str, [&str; 2]); 2] = [
    ("demo", ["stages=[{resolution=8, steps=12, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]", "rays_per_step=64"]),
    ("tensorf", ["tensorf.stages=[{resolution=8, steps=12, rays=64}]", "seed=1"]),
];

fn settings(preset: &str, assignments: &[&str], out: &Path) -> RunSettings {
    let mut layers = Layers::defaults().unwrap().with_preset(preset).unwrap();
    assignments.iter().for_each(|assignment| layers.assign(assignment).unwrap());
    let scene = ProceduralOptions { width: 16, height: 16, train: 6, val: 0, test: 1, supersample: 1 };
    let config: Config = layers.resolve().unwrap();
    RunSettings { out: Some(out.to_owned()), ..RunSettings::new(config, DataSource::built_in(&scene)) }
}

fn checkpoint(run: &Path) -> Vec<u8> {
    std::fs::read(run.join("checkpoint.safetensors")).unwrap()
}

#[test]
fn a_loss_of_a_program_trains_like_the_same_loss_of_the_settings() {
    let folder = Folder::new("added-losses");
    for (preset, assignments) in OF_MODELS {
        let [named, added] = ["named", "added"].map(|name| folder.0.join(format!("{preset}-{name}")));
        let mut settings = settings(preset, &assignments, &named);
        settings.config.losses = [("mse".to_owned(), plenoxel::model::plenoxels::config::Weight::Constant(1.0))].into();
        train(&settings, &mut |_| {}).unwrap();
        settings.config.losses.clear();
        settings.out = Some(added.clone());
        let losses = || Objective::new().with("mse", 1.0, mse);
        train_adding(&settings, &losses, &mut |_| {}).unwrap();
        assert!(checkpoint(&named) == checkpoint(&added), "{preset}");
    }
}

#[test]
fn an_added_loss_with_a_parameter_resumes_to_the_same_bits() {
    let folder = Folder::new("added-parameter");
    let [whole, cut] = ["whole", "cut"].map(|name| folder.0.join(name));
    let losses = || {
        let objective = Objective::<f32, ()>::new().with("scaled", 1.0, |step| {
            let error = &step.rendered.rgb * step.param("scale") - &step.batch.target;
            step.batch.mean(&error.square())
        });
        objective.with_param(Param::from_tensor("scale", Tensor::full(&[3], 0.9)), 0.05)
    };
    let settings = |out: &Path| settings(OF_MODELS[0].0, &OF_MODELS[0].1, out);
    let mut values = Vec::new();
    let done = train_adding(&settings(&whole), &losses, &mut |event| {
        if let Event::Step { report, .. } = event {
            values.extend(report.losses.iter().find(|(name, _)| name == "scaled").map(|(_, value)| *value));
        }
    });
    assert!(matches!(done, Ok(Outcome::Done(_))) && values.first() > values.last(), "{values:?}");
    let asked = AtomicU64::new(0);
    let options = RunOptions { stop: Box::new(move || asked.fetch_add(1, Relaxed) >= 4), ..RunOptions::default() };
    let stopped = train_adding(&RunSettings { options, ..settings(&cut) }, &losses, &mut |_| {}).unwrap();
    assert!(matches!(stopped, Outcome::Stopped { steps: 5, .. }), "{stopped:?}");
    resume_adding(&cut, None, &RunOptions::default(), &losses, &mut |_| {}).unwrap();
    assert!(checkpoint(&whole) == checkpoint(&cut), "a resumed run has other bits");
}
