//! A custom loss, trained on the built-in scene.
//!
//!     cargo run --release -p plenoxel --example custom_loss

use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::plenoxels::{Objective, Trainer};

fn main() -> Result<()> {
    run()
}

/// Runs the example. The tests call it too.
pub fn run() -> Result<()> {
    let scene = Dataset::procedural(ProceduralOptions { width: 64, height: 64, train: 40, val: 0, test: 0, supersample: 2 })?;
    let views = scene.load(Split::Train, &|_, _| {})?;

    // ln cosh: quadratic for small errors, absolute for large ones. The gradient is automatic.
    let objective = Objective::new().with("ln_cosh", 1.0, |step| {
        let error = (&step.rendered.rgb - &step.batch.target) * 10.0;
        let cosh = (error.exp() + (-&error).exp()) / 2.0;
        step.batch.mean(&cosh.ln())
    });

    // The default settings, reduced to the first two stages.
    let mut config = Config { rays_per_step: 2048, ..Config::default() };
    config.stages.truncate(2);
    let mut trainer = Trainer::<f32>::with_objective(config, views, objective)?;
    while let Some(report) = trainer.step()? {
        if report.step % 50 == 49 {
            println!("step {:3}: ln cosh {:.4}, {:.2} dB on training rays", report.step + 1, report.loss, report.psnr);
        }
    }
    Ok(())
}
