//! `scale:RUN`: what several machines that train one scene would send in each step: the rows of the parameters that get a gradient, with their numbers.
//!
//! RUN is the folder of a run with a factored field or a voxel grid. A step of N rays is divided among K machines, which draw different rays. For each N and K
//! it prints the bytes that a machine sends (its own rows) and receives (the rows of the others), and the bytes of all parameters.

use crate::support::median;
use autograd::{Grad, value_and_grad};
use plenoxel::dataset::{Dataset, Split};
use plenoxel::model::plenoxels;
use plenoxel::model::tensorf::Tensorf;
use plenoxel::rays::RaySource;
use plenoxel::run::folder::RunFolder;
use plenoxel::sampling::Jitter;
use plenoxel::train::{Model, Pass};
use std::path::Path;
use std::time::Instant;

const BACKGROUND: [f32; 3] = [1.0; 3];
const RAYS: [usize; 3] = [1250, 5000, 40_000];
const MACHINES: [usize; 3] = [1, 2, 8];

/// Measures the run in a folder, with rays of its scene.
pub fn run(name: &str, data: &Dataset) {
    let source = RaySource::new(data.load(Split::Train, &|_, _| {}).expect("the images load"), BACKGROUND, 42);
    let (run, config, _) = RunFolder::open(Path::new(name)).expect("a run folder");
    let checkpoint = run.existing_checkpoint().expect("a checkpoint");
    match config.tensorf {
        Some(_) => print(name, &Tensorf::open(&checkpoint).expect("a factored field").0, &source),
        None => print(name, &plenoxels::open(&checkpoint, &config).expect("a voxel grid").0, &source),
    }
}

/// Bytes of a gradient: rows of f32 and their numbers of 32 bits, or all values where it is dense. Repeated rows count once.
fn bytes_of(gradient: &Grad<f32>) -> usize {
    match gradient.as_rows() {
        Some(rows) => rows.rows().len() * (4 * rows.width() + 4),
        None => 4 * gradient.data().len(),
    }
}

fn print<M: Model<f32>>(name: &str, model: &M, source: &RaySource) {
    let mut parameters = 0;
    model.visit(&mut |param| parameters += 4 * param.tensor().len());
    let mut first = 0;
    for rays in RAYS {
        for machines in MACHINES {
            let each = rays / machines;
            let (mut sent, mut seconds) = (Vec::new(), Vec::new());
            for number in 0..machines as u64 {
                let batch = source.batch::<f32>(first, each);
                first += each as u64;
                let pass =
                    Pass { background: BACKGROUND, jitter: Jitter::PerRay { seed: 42, step: number }, keep_samples: false, stage: None };
                let start = Instant::now();
                let (_, gradients) = value_and_grad(|| (&model.render(&batch.rays, &pass).rgb - &batch.target).square().mean());
                let mut bytes = 0;
                model.visit(&mut |param| bytes += gradients.of(param).map_or(0, bytes_of));
                seconds.push(start.elapsed().as_secs_f64());
                sent.push(bytes);
            }
            let total: usize = sent.iter().sum();
            seconds.sort_by(f64::total_cmp);
            let row = serde_json::json!({
                "run": name, "rays": rays, "machines": machines, "parameters_mb": parameters as f64 / 1e6, "sent_mb": sent[0] as f64 / 1e6,
                "received_mb": (total - sent[0]) as f64 / 1e6, "ms_of_a_machine": 1e3 * median(&seconds),
            });
            println!("{row}");
        }
    }
}
