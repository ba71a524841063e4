//! Losses with parameters and per-pixel channels: depth supervision by a channel, the adaptive robust loss, and a color scale that is
//! learned beside the grid.
//!
//!     cargo run --release -p plenoxel --example own_losses

use autograd::{Param, Tensor};
use ndarray::Axis;
use plenoxel::dataset::{Dataset, Split, procedural::ProceduralOptions};
use plenoxel::error::Result;
use plenoxel::evaluate::evaluate;
use plenoxel::loss::{AdaptiveRobust, mse};
use plenoxel::model::plenoxels::config::{Config, Stage};
use plenoxel::model::plenoxels::{Objective, Trainer};
use plenoxel::train::ViewOptions;

/// Trains with mean squared error alone, and with each of the losses; prints the mean PSNR of the test views. `steps` are those of each stage.
pub fn run(steps: u64) -> Result<()> {
    let scene = Dataset::procedural(ProceduralOptions { width: 64, height: 64, train: 30, val: 0, test: 8, supersample: 2 })?;
    let (views, test) = (scene.load(Split::Train, &|_, _| {})?, scene.load(Split::Test, &|_, _| {})?);
    // Distances to the first surface, 0 where there is none: `[h, w, 1]` for each view.
    let depth =
        views.iter().flat_map(|view| view.depth.as_ref().map(|d| d.mapv(|d| if d.is_finite() { d } else { 0.0 }).insert_axis(Axis(2))));
    let depth: Vec<_> = depth.collect();
    let plain = || Objective::<f32>::new().with("mse", 1.0, mse);
    let deep = plain().with("depth", 1e-3, |step| {
        let depth = step.batch.channel("depth").expect("the trainer was given it").reshape(&[step.batch.len()]);
        let known = Tensor::from_vec(depth.data().iter().map(|d| f32::from(u8::from(*d > 0.0))).collect(), depth.shape());
        ((step.rendered.depth() - depth).square() * known).mean()
    });
    let robust = Objective::new().with_adaptive_robust("robust", 0.01, AdaptiveRobust::default());
    let scaled = plain().with_param(Param::from_tensor("scale", Tensor::full(&[3], 1.0)), 1e-3);
    let scaled = scaled.predicting(|step| &step.prediction * step.param("scale"));
    for (name, objective) in [("mse", plain()), ("depth", deep), ("robust", robust), ("scale", scaled)] {
        let stages = vec![Stage::new(16, steps), Stage::new(32, steps)];
        let mut trainer = Trainer::with_objective(Config { rays_per_step: 2048, stages, ..Config::default() }, &views[..], objective)?;
        trainer = trainer.with_channel("depth", depth.clone());
        while trainer.step()?.is_some() {}
        let psnr = evaluate(trainer.model(), &test, &ViewOptions::over([1.0; 3])).psnr().unwrap_or(0.0);
        let params = trainer.objective().params().iter().map(|p| format!("{} {:.3?}", p.name(), p.tensor().data()));
        println!("{name:8} {psnr:.2} dB  {}", params.collect::<Vec<_>>().join(", "));
    }
    Ok(())
}

fn main() -> Result<()> {
    run(150)
}
