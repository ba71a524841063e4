//! Losses with parameters and with per-pixel channels, on eight training views: depth supervision by a channel, the adaptive robust loss,
//! and a color scale that is learned together with the grid.
//!
//!     cargo run --release -p plenoxel --example own_losses

use autograd::{Param, Tensor};
use ndarray::Axis;
use plenoxel::dataset::{Dataset, Split, View, procedural::ProceduralOptions};
use plenoxel::error::Result;
use plenoxel::evaluate::{Viewer, evaluate};
use plenoxel::loss::{AdaptiveRobust, mse};
use plenoxel::model::plenoxels::config::{Config, Stage};
use plenoxel::model::plenoxels::{Objective, Trainer};
use plenoxel::train::{Model, ViewOptions};

/// Trains with mean squared error alone, and with each of the losses, `steps` steps per stage. Prints the mean PSNR and depth error of the
/// test views.
pub fn run(steps: u64) -> Result<()> {
    let scene = Dataset::procedural(ProceduralOptions { width: 64, height: 64, train: 8, val: 0, test: 8, supersample: 2 })?;
    let (views, test) = (scene.load(Split::Train, &|_, _| {})?, scene.load(Split::Test, &|_, _| {})?);
    // Distances to the first surface, 0 for pixels without a surface: `[h, w, 1]` for each view.
    let depth =
        views.iter().flat_map(|view| view.depth.as_ref().map(|d| d.mapv(|d| if d.is_finite() { d } else { 0.0 }).insert_axis(Axis(2))));
    let depth: Vec<_> = depth.collect();
    let plain = || Objective::<f32>::new().with("mse", 1.0, mse);
    let deep = plain().with("depth", 0.03, |step| {
        let depth = step.batch.channel("depth").expect("the trainer was given it").reshape(&[step.batch.len()]);
        let known = Tensor::from_vec(depth.data().iter().map(|d| f32::from(u8::from(*d > 0.0))).collect(), depth.shape());
        step.batch.mean(&((step.rendered.depth() - depth).square() * known))
    });
    let robust = Objective::new().with_adaptive_robust("robust", 0.01, AdaptiveRobust::default());
    let scaled = plain().with_param(Param::from_tensor("scale", Tensor::full(&[3], 1.0)), 1e-3);
    let scaled = scaled.predicting(|step| &step.prediction * step.param("scale"));
    for (name, objective) in [("mse", plain()), ("depth", deep), ("robust", robust), ("scale", scaled)] {
        let stages = vec![Stage::new(16, steps), Stage::new(32, steps)];
        let mut trainer = Trainer::with_objective(Config { rays_per_step: 2048, stages, ..Config::default() }, &views[..], objective)?;
        trainer = trainer.with_channel("depth", depth.clone());
        while trainer.step()?.is_some() {}
        let (model, options) = (trainer.model(), ViewOptions::over([1.0; 3]));
        let psnr = evaluate(model, &test, &options).psnr().unwrap_or(0.0);
        let depth_error = depth_error(model, &test, &options);
        let params = trainer.objective().params().iter().map(|p| format!("{} {:.3?}", p.name(), p.tensor().data()));
        println!("{name:8} {psnr:.2} dB, depth error {depth_error:.3}  {}", params.collect::<Vec<_>>().join(", "));
    }
    Ok(())
}

/// Returns the mean absolute error of the depth over the pixels that show a surface, world length.
fn depth_error(model: &impl Model<f32>, views: &[View], options: &ViewOptions) -> f64 {
    let viewer = Viewer::of(model, options);
    let errors = views.iter().filter_map(|view| {
        let (seen, known) = (viewer.see(&view.camera).depth, view.depth.as_ref()?);
        let errors = seen.iter().zip(known).filter(|(_, known)| known.is_finite()).map(|(seen, known)| f64::from((seen - known).abs()));
        Some(errors.collect::<Vec<_>>())
    });
    let errors: Vec<f64> = errors.flatten().collect();
    errors.iter().sum::<f64>() / errors.len() as f64
}

fn main() -> Result<()> {
    run(150)
}
