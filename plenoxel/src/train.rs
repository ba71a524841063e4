//! Training: batch → render → objective → gradients → optimizer, stage after stage. The trainer depends on no particular field, only on
//! [`Model`].
//!
//! The trainer draws batches, computes and reports. It never prints and never reads a clock.

mod model;
pub mod poses;
mod state;

pub use model::{CHECKPOINT_FORMAT, Model, Pass, RenderFn, StageLength, StageProgress, ViewOptions, read_params, same_settings};
pub use state::{About, about};

use crate::camera::Camera;
use crate::dataset::View;
use crate::error::{Error, Result};
use crate::loss::{Evaluation, Objective, POSES, Step, ViewWeight};
use crate::rays::{RayBatch, RaySource};
use crate::sampling::Jitter;
use autograd::optim::{Optimizer, Sgd};
use autograd::{Module, Real, Tensor, parallel, value_and_grad};
use ndarray::Array3;
use poses::{PoseCorrections, PoseFigures};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// Settings of a run that do not depend on the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainOptions {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Number of rays per training step.
    pub rays_per_step: usize,
    /// Number of steps of the run, for models that do not define stages.
    pub steps: u64,
    /// Shift the samples of each training ray by a random fraction of a step.
    pub jitter: bool,
    /// Floor of the contrast in proportion to which pixels are drawn ([`RaySource::with_contrast_floor`]); 0 draws all pixels equally often.
    #[serde(default)]
    pub contrast_floor: f64,
    /// Side of the square patches of pixels that are drawn ([`RaySource::patches`]), for losses that compare a pixel with its neighbours. A step then has the
    /// stage's number of rays / `patch_size`² patches, rounded down. 1 draws single pixels.
    #[serde(default = "single_pixels")]
    pub patch_size: u32,
}

fn single_pixels() -> u32 {
    1
}

/// 1000 steps of 4096 jittered rays over white.
impl Default for TrainOptions {
    fn default() -> Self {
        TrainOptions {
            seed: 42,
            background: [1.0; 3],
            rays_per_step: 4096,
            steps: 1000,
            jitter: true,
            contrast_floor: 0.0,
            patch_size: single_pixels(),
        }
    }
}

/// Stage with its position in the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannedStage {
    /// Number of the stage, from 0.
    pub index: usize,
    /// Resolution of the model's grid along each axis, if it has one.
    pub resolution: Option<usize>,
    /// Number of its first step.
    pub first: u64,
    /// Number of steps.
    pub steps: u64,
    /// Number of rays of the steps before the first.
    pub first_ray: u64,
    /// Number of rays per step.
    pub rays_per_step: usize,
    /// Expected duration of a ray, in a unit that is the same for all stages.
    pub ray_cost: f64,
}

/// Result of a training step.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Number of the step, from 0 over the whole run.
    pub step: u64,
    /// Number of the stage, from 0.
    pub stage: usize,
    /// True for the last step of a stage.
    pub ends_stage: bool,
    /// Value of the objective, before the update.
    pub loss: f64,
    /// Unweighted value of each loss.
    pub losses: Vec<(String, f64)>,
    /// Training PSNR: −10 log₁₀ of the mean squared error of the batch, before the update. If rays are aimed, pixels that were left out
    /// count with error 0.
    pub psnr: f64,
    /// Number of rays in the batch.
    pub rays: usize,
    /// Number of samples on the rays.
    pub samples: usize,
    /// Learning rate of each parameter of the model, by name.
    pub rates: Vec<(String, f64)>,
}

impl Report {
    /// Returns the learning rate of the parameter of this name.
    pub fn rate(&self, parameter: &str) -> Option<f64> {
        self.rates.iter().find(|(name, _)| name == parameter).map(|(_, rate)| *rate)
    }
}

/// Training run of a model.
pub struct Trainer<T: Real, M: Model<T>> {
    model: M,
    options: TrainOptions,
    plan: Vec<PlannedStage>,
    rays: RaySource,
    objective: Objective<T, M>,
    optimizer: Box<dyn Optimizer<T>>,
    loss_optimizer: Box<dyn Optimizer<T>>,
    /// Corrections of the training views' poses, if the objective has them.
    poses: Option<PoseCorrections<T>>,
    /// Custom function that draws the batch of a step; `None` for shuffled pixels or patches.
    draw: Option<Draw<T>>,
    step: u64,
}

/// Function from the rays of a run and the number of a step to the batch of the step.
type Draw<T> = Box<dyn Fn(&RaySource, u64) -> RayBatch<T> + Send + Sync>;

impl<T: Real, M: Model<T>> Trainer<T, M> {
    /// Creates a training run of a model.
    ///
    /// Errors if there is no training view, or no step to take; if poses are refined ([`Objective::with_poses`]) and the model gives no gradients to rays; if
    /// patches are larger than all views or have more pixels than a step has rays, or if a view has a mask.
    pub fn with_model(model: M, views: impl Into<Arc<[View]>>, mut objective: Objective<T, M>, options: TrainOptions) -> Result<Self> {
        // Patches are drawn regardless of contrast.
        let floor = if options.patch_size > 1 { 0.0 } else { options.contrast_floor };
        let rays = RaySource::new(views, options.background, options.seed).with_contrast_floor(floor);
        if rays.is_empty() {
            return Err(Error::usage("views", "there are no training views", "give at least one image"));
        }
        let poses = objective.param(POSES).is_some().then(|| PoseCorrections::of(rays.all_views()));
        if poses.is_some() && !model.tracks_rays() {
            return Err(no_gradients(model.kind()));
        }
        let plan = plan(&model, &options, rays.len());
        let Some(first) = plan.first() else { return Err(Error::usage("stages", "there is no stage", "set at least one")) };
        plan.iter().try_for_each(|stage| check_patches(&rays, options.patch_size, stage))?;
        let (optimizer, loss_optimizer) = (model.optimizer(first), objective.take_optimizer());
        Ok(Trainer { model, options, plan, rays, objective, optimizer, loss_optimizer, poses, draw: None, step: 0 })
    }

    /// Adds [`RayBatch::depth`](crate::rays::RayBatch::depth) to the batches, for views with a depth image.
    pub fn with_depth(self) -> Self {
        Trainer { rays: self.rays.with_depth(), ..self }
    }

    /// Adds custom numbers for each pixel to the batches. `images` are `[height, width, c]`, one for each training view. A loss reads them
    /// with [`RayBatch::channel`](crate::rays::RayBatch::channel).
    ///
    /// Panics in the cases of [`RaySource::with_channel`].
    #[track_caller]
    pub fn with_channel(self, name: impl Into<String>, images: impl Into<Arc<[Array3<f32>]>>) -> Self {
        Trainer { rays: self.rays.with_channel(name, images), ..self }
    }

    /// Replaces the shuffled pixels or patches by custom batches, such as patches or chosen pixels. `draw` returns the batch of a step; steps are
    /// numbered over the whole run. Runs are reproducible if the batch depends only on the number.
    ///
    /// ```
    /// # use plenoxel::{model::plenoxels::Trainer, train::Model};
    /// # fn patches(trainer: Trainer<f32>) -> Trainer<f32> {
    /// trainer.with_batches(|rays, step| rays.batch_of(&rays.patches(step, 16, 16)))
    /// # }
    /// ```
    pub fn with_batches(self, draw: impl Fn(&RaySource, u64) -> RayBatch<T> + Send + Sync + 'static) -> Self {
        Trainer { draw: Some(Box::new(draw)), ..self }
    }

    /// Replaces the model by `change(model)` and plans the stages again.
    ///
    /// Panics if steps have been taken.
    #[track_caller]
    pub fn map_model(mut self, change: impl FnOnce(M) -> M) -> Self {
        assert_eq!(self.step, 0, "map_model: the run has already taken steps");
        self.model = change(self.model);
        self.plan = plan(&self.model, &self.options, self.rays.len());
        self.optimizer = self.model.optimizer(&self.plan[0]);
        self
    }

    /// Changes the settings of the model, and plans the stages again. The steps that were taken must be the same with the new settings. The optimizer stays, so
    /// its schedules must follow the settings of the model.
    ///
    /// Panics if the new plan has another current stage, or no further step.
    #[track_caller]
    pub fn replan(&mut self, change: impl FnOnce(&mut M)) {
        let before = self.step.checked_sub(1).and_then(|last| self.stage_of(last));
        change(&mut self.model);
        self.plan = plan(&self.model, &self.options, self.rays.len());
        let after = self.step.checked_sub(1).and_then(|last| self.stage_of(last));
        let place = |stage: PlannedStage| (stage.index, stage.first, stage.first_ray, stage.rays_per_step, stage.resolution);
        assert_eq!(before.map(place), after.map(place), "replan: the current stage is another");
        assert!(self.step < self.total_steps(), "replan: the run has ended");
    }

    /// Returns the current model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Returns the model, consuming the trainer.
    pub fn into_model(self) -> M {
        self.model
    }

    /// Loads the checkpoint that this trainer's run wrote at its end ([`Model::load`]). Returns the model and the facts about it.
    ///
    /// Errors if the file cannot be read; the error names the file and the problem.
    pub fn into_model_of(mut self, path: &Path) -> Result<(M, About)> {
        let about = self.model.load(path)?;
        Ok((self.model, about))
    }

    /// Returns the objective, with the current parameters of its losses.
    pub fn objective(&self) -> &Objective<T, M> {
        &self.objective
    }

    /// Returns the size of the corrections of the training views' poses; `None` if poses are not refined.
    pub fn pose_figures(&self) -> Option<PoseFigures> {
        let (poses, learned) = self.poses.as_ref().zip(self.objective.param(POSES))?;
        Some(poses.figures(learned, self.views()))
    }

    /// Returns the training views whose weight is below 0.9 because they do not fit the others; `None` without
    /// [`Objective::with_outlier_views`].
    pub fn outlier_views(&self) -> Option<Vec<ViewWeight>> {
        let all =
            self.views().iter().zip(self.objective.view_weights()?).map(|(view, weight)| ViewWeight { name: view.name.clone(), weight });
        Some(all.filter(|view| view.weight < 0.9).collect())
    }

    /// Returns the cameras of the training views, corrected if poses are refined.
    pub fn cameras(&self) -> Vec<Camera> {
        match self.poses.as_ref().zip(self.objective.param(POSES)) {
            None => self.views().iter().map(|view| view.camera).collect(),
            Some((poses, learned)) => poses.cameras(learned, self.views()),
        }
    }

    /// Returns the settings that do not depend on the model.
    pub fn options(&self) -> &TrainOptions {
        &self.options
    }

    /// Returns the training views.
    pub fn views(&self) -> &[View] {
        self.rays.all_views()
    }

    /// Returns the stages with their steps.
    pub fn plan(&self) -> &[PlannedStage] {
        &self.plan
    }

    /// Returns the number of steps of the whole run.
    pub fn total_steps(&self) -> u64 {
        self.plan.iter().map(|p| p.steps).sum()
    }

    /// Returns the number of steps taken so far.
    pub fn steps_taken(&self) -> u64 {
        self.step
    }

    /// Returns the stage of a step; `None` if the run ends before it.
    fn stage_of(&self, step: u64) -> Option<PlannedStage> {
        self.plan.iter().find(|p| step < p.first + p.steps).copied()
    }

    /// Takes the next step. Returns `None` when the run is over.
    ///
    /// Errors if the loss or the model is no longer finite, naming the step, or if the views of a stage are too small for patches; also returns the errors of
    /// [`Model::begin_stage`] and [`Model::begin_step`].
    pub fn step(&mut self) -> Result<Option<Report>> {
        let Some(stage) = self.stage_of(self.step) else { return Ok(None) };
        let in_stage = self.step - stage.first;
        if in_stage == 0 {
            // Releases the memory of the old optimizer before the model grows.
            self.optimizer = Box::new(Sgd::new(0.0));
            self.model.begin_stage(&stage, &mut self.rays).map_err(|e| at_step(e, self.step))?;
            self.optimizer = self.model.optimizer(&stage);
            check_patches(&self.rays, self.options.patch_size, &stage)?;
        }
        self.model.begin_step(in_stage)?;
        let TrainOptions { seed, background, jitter, patch_size, .. } = self.options;
        let batch = match &self.draw {
            Some(draw) => draw(&self.rays, self.step),
            None if patch_size > 1 => {
                let count = stage.rays_per_step / (patch_size * patch_size) as usize;
                self.rays.batch_of(&self.rays.patches(self.step, count, patch_size))
            }
            None => self.rays.batch::<T>(stage.first_ray + in_stage * stage.rays_per_step as u64, stage.rays_per_step),
        };
        // The training PSNR counts all views alike; the losses do not.
        let weights = self.objective.view_weights().filter(|weights| weights.iter().any(|&weight| weight < 1.0));
        let weighted = weights.map(|weights| batch.weighted(&weights));
        let jitter = if jitter { Jitter::PerRay { seed, step: self.step } } else { Jitter::None };
        let pass = Pass { background, jitter, keep_samples: self.objective.needs_samples(), stage: Some(stage.index) };
        let extent = (self.model.aabb().max - self.model.aabb().min).max_element();
        let (mut losses, mut squared_error, mut samples) = (Vec::new(), 0.0, 0);
        let (loss, gradients) = value_and_grad(|| {
            let rendered = match self.poses.as_ref().zip(self.objective.param(POSES)) {
                None => self.model.render(&batch.rays, &pass),
                Some((poses, learned)) => self.model.render_tracked(&poses.rays(learned, &batch), &pass),
            };
            samples = rendered.sample_count;
            let step = Step::new((self.step, seed), weighted.as_ref().unwrap_or(&batch), &rendered, &self.model, (extent, background));
            let Evaluation { total, losses: values, prediction } = self.objective.evaluate(step);
            // Rays that are aimed are a share of all; patches are not aimed.
            let share = if patch_size > 1 { 1.0 } else { self.rays.share() };
            squared_error = share * mean_squared_error(prediction.data(), &batch);
            losses = values;
            total
        });
        let loss = loss.as_f64();
        if !loss.is_finite() {
            let parts: Vec<String> = losses.iter().map(|(name, value)| format!("{name} {value}")).collect();
            return Err(self.numeric(format!("the loss is {loss} ({})", parts.join(", "))));
        }
        self.optimizer.step(&mut self.model, &gradients, in_stage);
        self.loss_optimizer.step(&mut self.objective, &gradients, self.step);
        let ends_stage = in_stage + 1 == stage.steps;
        if ends_stage && !(self.model.is_finite() && self.objective.is_finite()) {
            return Err(self.numeric("the model has values that are not finite".to_owned()));
        }
        let mut rates = Vec::new();
        self.model.visit(&mut |param| rates.push((param.name().to_owned(), self.optimizer.rate(param.name(), in_stage))));
        let psnr = -10.0 * squared_error.log10();
        let report = Report { step: self.step, stage: stage.index, ends_stage, loss, losses, psnr, rays: batch.len(), samples, rates };
        self.step += 1;
        Ok(Some(report))
    }

    fn numeric(&self, found: String) -> Error {
        Error::Numeric { place: format!("step {}", self.step), found, remedy: "lower the learning rates of this stage".to_owned() }
    }
}

/// The error for poses that are to be refined with a kind of model that gives no gradients to rays.
pub(crate) fn no_gradients(kind: &str) -> Error {
    let found = format!("poses cannot be refined with the model {kind}, which gives no gradients to rays");
    Error::usage(format!("losses.{POSES}"), found, "use the preset photos or quality, or leave out --refine-poses")
}

/// Errors if patches of this side cannot be drawn in a stage.
fn check_patches(rays: &RaySource, side: u32, stage: &PlannedStage) -> Result<()> {
    if side == 1 {
        return Ok(());
    }
    let PlannedStage { index, rays_per_step, .. } = *stage;
    let refused = |found: String, remedy: &str| Err(Error::usage("patch_size", found, remedy));
    if rays.views().iter().any(|view| view.mask.is_some()) {
        let found = format!("patches of {side} x {side} pixels cannot be drawn from views with masks");
        return refused(found, "set patch_size = 1, or use views without masks");
    }
    let holds = |view: &View| view.size().iter().all(|&n| n >= side as usize);
    if !rays.views().iter().any(holds) {
        return refused(
            format!("no training view has {side} x {side} pixels at the resolution of stage {index}"),
            "set a smaller patch_size",
        );
    }
    if (side * side) as usize > rays_per_step {
        let found = format!("a patch has {} pixels, but a step of stage {index} has {rays_per_step} rays", side * side);
        return refused(found, "set a smaller patch_size, or more rays");
    }
    Ok(())
}

/// Plans the stages of a model, one after another.
fn plan<T: Real, M: Model<T>>(model: &M, options: &TrainOptions, rays_per_epoch: u64) -> Vec<PlannedStage> {
    let (mut first, mut first_ray) = (0, 0);
    let plan = |(index, StageLength { resolution, steps, rays_per_step, ray_cost })| {
        let rays_per_step = rays_per_step.unwrap_or(options.rays_per_step);
        let stage = PlannedStage { index, resolution, first, steps, first_ray, rays_per_step, ray_cost };
        first += steps;
        first_ray += steps * rays_per_step as u64;
        stage
    };
    model.stages(options, rays_per_epoch).into_iter().enumerate().map(plan).collect()
}

/// Adds the number of the step to a numeric error without a place.
fn at_step(error: Error, step: u64) -> Error {
    match error {
        Error::Numeric { place, found, remedy } if place.is_empty() => Error::Numeric { place: format!("step {step}"), found, remedy },
        other => other,
    }
}

/// Returns the mean squared error of predicted colors `[n, 3]`, with the weights of the rays.
fn mean_squared_error<T: Real>(colors: &[T], batch: &RayBatch<T>) -> f64 {
    let (colors, target) = (colors.as_chunks::<3>().0, batch.target.data().as_chunks::<3>().0);
    let weight = batch.weight.as_ref().map(Tensor::data);
    let parts = parallel::map_chunks(colors.len(), parallel::CHUNK, |range| {
        let of_ray = |i: usize| {
            let error = colors[i].iter().zip(&target[i]).map(|(&x, &y)| ((x - y) * (x - y)).as_f64()).sum::<f64>();
            weight.map_or(1.0, |weight| weight[i].as_f64()) * error
        };
        range.map(of_ray).sum::<f64>()
    });
    parts.into_iter().sum::<f64>() / (3 * colors.len()) as f64
}
