//! Training: batch → render → objective → gradients → optimizer → projection, coarse to fine.
//!
//! The trainer draws, computes and reports; it never prints and never reads a clock.

pub mod config;
mod start;
mod state;

use crate::dataset::View;
use crate::error::{Error, Result};
use crate::field::Field;
use crate::field::voxel_grid::VoxelGrid;
use crate::loss::{Objective, Step};
use crate::rays::RaySource;
use crate::render::fused::largest_weights;
use crate::render::{Engine, RenderOptions, render};
use crate::sampling::{Jitter, Occupancy};
use autograd::optim::{Adam, AdamMode, Exponential, Momentum, Optimizer, Piecewise, Rates, RmsProp, Schedule, Sgd, WarmUp};
use autograd::{Real, parallel, release_free_buffers, value_and_grad};
use config::{Config, Initial, OptimizerConfig, Stage, Weight};
use start::Silhouettes;
use std::borrow::Cow;

/// Rays that are rendered at a time to find out what is seen: bounds the memory.
const RAYS_PER_BATCH: usize = 1 << 15;

/// After so many steps it is looked up anew where the grid can learn. What has a density below 0 all around has no gradient; it comes to
/// have one when a voxel at its edge, which others have in common with it, rises.
const STEPS_PER_LOOK: u64 = 64;

/// What one step did.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Number of the step, from 0 over the whole run.
    pub step: u64,
    /// Stage it belongs to, from 0.
    pub stage: usize,
    /// True if it was the last of its stage.
    pub ends_stage: bool,
    /// The weighted sum that was minimised.
    pub loss: f64,
    /// Each loss by itself, unweighted.
    pub losses: Vec<(String, f64)>,
    /// −10 log₁₀ of the batch's mean squared error: of training rays, before the update; with `aim`, as if rays that see nothing were in it.
    pub psnr: f64,
    /// Rays in the batch.
    pub rays: usize,
    /// Samples they took.
    pub samples: usize,
    /// Learning rate of the density.
    pub density_rate: f64,
    /// Learning rate of the colors.
    pub color_rate: f64,
}

/// A stage with its place in the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannedStage {
    /// As configured, fitted to the images ([`Config::fitted_to`]).
    pub stage: Stage,
    /// Its first step.
    pub first: u64,
    /// How many steps it has.
    pub steps: u64,
}

/// A grid in training.
pub struct Trainer<'a, T: Real> {
    config: Config,
    plan: Vec<PlannedStage>,
    views: &'a [View],
    rays: RaySource<'a>,
    /// By how much the images are reduced whose pixels the rays are.
    reduction: usize,
    silhouettes: Option<Silhouettes<'a>>,
    /// How many stages of the plan are the scout's.
    scouts: usize,
    objective: Objective<T>,
    grid: VoxelGrid<T>,
    /// Where the grid could learn when last looked at: samples elsewhere are left out.
    learning: Option<Occupancy>,
    optimizer: Box<dyn Optimizer<T>>,
    step: u64,
    most_rows: usize,
}

impl<'a, T: Real> Trainer<'a, T> {
    /// A run from its beginning, with the losses that the config names.
    pub fn new(config: Config, views: &'a [View]) -> Result<Self> {
        config.validate()?;
        let objective = objective(&config)?;
        Self::with_objective(config, views, objective)
    }

    /// A run with an objective of one's own; the config's losses are not used.
    pub fn with_objective(config: Config, views: &'a [View], objective: Objective<T>) -> Result<Self> {
        config.validate()?;
        let config = config.fitted_to(views.iter().map(|view| &view.camera));
        let rays = RaySource::new(views, config.background, config.seed);
        if rays.is_empty() {
            return Err(Error::config("train views", "none", "at least one image to learn from"));
        }
        config.check_stages()?;
        let silhouettes = Silhouettes::new(&config, views);
        let scout = config.scout.as_ref().filter(|_| silhouettes.is_none());
        let of_scout = scout.map_or(&[][..], |scout| &scout.stages);
        let plan = plan(&config, of_scout.iter().chain(&config.stages).copied(), rays.len());
        let mut shape = config.grid_shape(plan[0].stage.resolution);
        if let Some(silhouettes) = &silhouettes {
            shape.half_width = silhouettes.half_width(shape.half_width);
        }
        let initial = initial(&config, !of_scout.is_empty());
        let grid = match initial.random {
            true => VoxelGrid::random(shape, initial.density, initial.color, config.seed),
            false => VoxelGrid::uniform(shape, initial.density, initial.color),
        };
        let optimizer = optimizer(&config, &plan[0]);
        let scouts = of_scout.len();
        Ok(Trainer {
            config,
            plan,
            views,
            rays,
            reduction: 1,
            silhouettes,
            scouts,
            objective,
            grid,
            learning: None,
            optimizer,
            step: 0,
            most_rows: usize::MAX,
        })
    }

    /// The same run where pruning must not leave more rows of tables than these, because they would not fit into memory.
    pub fn with_most_rows(self, most_rows: usize) -> Self {
        Trainer { most_rows, ..self }
    }

    /// The same run starting from a grid that is there already, trained or carved: its box stays, its numbers are read at the resolution of
    /// the first stage, and stages coarser than it are left out, except the last.
    ///
    /// Panics if steps have been taken.
    pub fn starting_from(mut self, grid: &VoxelGrid<T>) -> Self {
        assert_eq!(self.step, 0, "a run starts once");
        let stages = &self.config.stages;
        let coarser = stages.iter().take_while(|stage| stage.resolution < grid.shape().resolution).count();
        self.scouts = 0;
        self.plan = plan(&self.config, stages[coarser.min(stages.len() - 1)..].iter().copied(), self.rays.len());
        self.grid = start::adapted(grid, &self.config.grid_shape(self.plan[0].stage.resolution));
        self.optimizer = optimizer(&self.config, &self.plan[0]);
        self
    }

    /// The same from a carved grid, whose voxels are as opaque as each other: they are made thin, so that gradients reach what is behind them.
    pub fn starting_from_carved(self, grid: &VoxelGrid<T>) -> Self {
        self.starting_from(&start::thinned(grid))
    }

    /// The grid as it is now.
    pub fn grid(&self) -> &VoxelGrid<T> {
        &self.grid
    }

    /// The trained grid.
    pub fn into_grid(self) -> VoxelGrid<T> {
        self.grid
    }

    /// The config, fitted to the images ([`Config::fitted_to`]).
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The stages with their steps.
    pub fn plan(&self) -> &[PlannedStage] {
        &self.plan
    }

    /// Steps of the whole run.
    pub fn total_steps(&self) -> u64 {
        self.plan.iter().map(|p| p.steps).sum()
    }

    /// Training rays of one epoch.
    pub fn rays_per_epoch(&self) -> u64 {
        self.rays.len()
    }

    /// Takes the next step; `None` when the run is over.
    ///
    /// Errors if the loss or the grid is no longer finite, naming the step.
    pub fn step(&mut self) -> Result<Option<Report>> {
        let Some(index) = self.plan.iter().position(|p| self.step < p.first + p.steps) else { return Ok(None) };
        let plan = self.plan[index];
        if self.step == plan.first {
            self.begin(index)?;
        }
        let in_stage = self.step - plan.first;
        if in_stage.is_multiple_of(STEPS_PER_LOOK) {
            self.learning = Some(self.grid.learning());
        }
        let rays = self.config.rays_per_step;
        let batch = self.rays.batch::<T>(self.step * rays as u64, rays);
        let jitter = if self.config.jitter { Jitter::PerRay { seed: self.config.seed, step: self.step } } else { Jitter::None };
        let options = RenderOptions { occupancy: self.learning.as_ref(), ..self.options(&self.grid, &plan.stage, jitter) };
        let (mut losses, mut squared_error, mut samples) = (Vec::new(), 0.0, 0);
        let (loss, gradients) = value_and_grad(|| {
            let rendered = render(&self.grid, &batch.rays, &options);
            samples = rendered.sample_count;
            squared_error = self.rays.share() * mean_squared_error(rendered.rgb.data(), batch.target.data());
            let step = Step { number: self.step, seed: self.config.seed, batch: &batch, rendered: &rendered, grid: &self.grid };
            let (total, values) = self.objective.evaluate(&step);
            losses = values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
            total
        });
        let loss = loss.as_f64();
        if !loss.is_finite() {
            let parts: Vec<String> = losses.iter().map(|(name, value)| format!("{name} {value}")).collect();
            return Err(self.numeric(format!("the loss is {loss} ({})", parts.join(", "))));
        }
        self.optimizer.step(&mut self.grid, &gradients, in_stage);
        let ends_stage = in_stage + 1 == plan.steps;
        if ends_stage && !self.grid.is_finite() {
            return Err(self.numeric("the grid holds numbers that are not finite".to_owned()));
        }
        let report = Report {
            step: self.step,
            stage: index,
            ends_stage,
            loss,
            losses,
            psnr: -10.0 * squared_error.log10(),
            rays: batch.len(),
            samples,
            density_rate: density_rate(&plan).at(in_stage),
            color_rate: color_rate(&plan, plan.stage.color_rate).at(in_stage),
        };
        self.step += 1;
        Ok(Some(report))
    }

    /// What happens between stages: the field is read at a finer resolution, the optimizer starts afresh, empty space is left out.
    fn begin(&mut self, index: usize) -> Result<()> {
        let plan = self.plan[index];
        // The old state goes before the finer grid comes.
        self.optimizer = optimizer(&self.config, &plan);
        if let Some(scout) = self.config.scout.as_ref().filter(|_| (1..=self.scouts).contains(&index)) {
            let least = scout.prune_unseen_below;
            let kept = self.worth_keeping(&self.grid, &self.plan[index - 1].stage, least)?;
            let initial = initial(&self.config, index < self.scouts);
            let half_width = kept.half_width().ok_or_else(|| self.pruned_to_nothing(least))?;
            let whole = start::with_hidden(&kept, self.rays.views(), self.config.carve.margin);
            self.grid = start::scouted(&self.grid, &whole, half_width, plan.stage.resolution, &initial);
        }
        // Which voxels there will be is found out by densities alone: with all their colors, those that go at once may not fit into memory.
        release_free_buffers();
        let finer = plan.stage.resolution != self.grid.shape().resolution;
        let prunes = self.prunes_from().is_some_and(|first| index >= first);
        let mut outline = self.grid.outline();
        if finer {
            let mut half_width = outline.shape().half_width;
            if self.scouts > 0 && prunes {
                // The scout's cube was as coarse as its voxels.
                let kept = self.worth_keeping(&outline, &self.plan[index - 1].stage, self.config.prune_unseen_below)?;
                half_width = kept.half_width().unwrap_or(half_width);
                outline = outline.pruned(&kept);
            }
            outline = outline.resample_in(plan.stage.resolution, half_width);
        }
        if let Some(silhouettes) = self.silhouettes.as_ref().filter(|_| finer || index == 0) {
            outline = outline.pruned(&silhouettes.voxels(&outline));
            if outline.lattice().present() == 0 {
                return Err(Error::config(
                    "hull",
                    "\"auto\", with silhouettes that hold nothing of the grid,",
                    "\"off\"; or another half_width, or another run to start from",
                ));
            }
        }
        if plan.stage.image_reduction != self.reduction {
            self.reduction = plan.stage.image_reduction;
            self.rays = self.all_rays();
        }
        self.aim(Field::<T>::reach(&outline));
        if prunes {
            outline = outline.pruned(&self.worth_keeping(&outline, &plan.stage, self.config.prune_unseen_below)?);
            self.aim(Field::<T>::reach(&outline));
        }
        let lattice = outline.lattice();
        if prunes && lattice.rows() > self.most_rows {
            let found = format!(
                "{} voxels that would be left at {}³, where memory has room for {}",
                lattice.rows(),
                plan.stage.resolution,
                self.most_rows
            );
            return Err(Error::config("prune_unseen_below", found, "a larger share of a pixel; or fewer voxels a side in the last stages"));
        }
        if finer {
            self.grid = self.grid.resample_as(&outline);
        } else if lattice.present() < self.grid.lattice().present() {
            self.grid = self.grid.pruned(&outline.voxels_where(|_| true));
        }
        if self.config.project {
            self.grid.project();
        }
        Ok(())
    }

    /// Leaves the rays out that pass what is left of the grid, if the config says so.
    fn aim(&mut self, reach: Option<&Occupancy>) {
        if let Some(reach) = reach.filter(|_| self.config.aim) {
            self.rays.aim_at(reach);
        }
    }

    fn pruned_to_nothing(&self, prune_unseen_below: f64) -> Error {
        let prune_below = self.config.prune_below;
        Error::Numeric {
            place: format!("step {}", self.step),
            found: "pruning would leave nothing".to_owned(),
            remedy: format!(
                "set prune_below lower than {prune_below}, prune_unseen_below lower than {prune_unseen_below}, or prune_from_stage later"
            ),
        }
    }

    /// The rays of all pixels of the images as reduced now.
    fn all_rays(&self) -> RaySource<'a> {
        let views: Cow<'a, [View]> = match self.reduction {
            1 => self.views.into(),
            k => parallel::map_indices(self.views.len(), |v| self.views[v].reduced(k)).into(),
        };
        RaySource::new(views, self.config.background, self.config.seed)
    }

    /// The first stage of the plan that begins by pruning, if one does: the config counts those too that a start from a grid has left out.
    pub fn prunes_from(&self) -> Option<usize> {
        let left_out = self.config.stages.len() + self.scouts - self.plan.len();
        self.config.prune_from_stage.map(|first| self.scouts + first.saturating_sub(left_out))
    }

    /// The voxels that pruning leaves: those that hold matter and, if the config asks for it, that a training ray sees.
    ///
    /// Errors if they are none.
    fn worth_keeping(&self, grid: &VoxelGrid<T>, stage: &Stage, least: f64) -> Result<Occupancy> {
        let full = grid.occupancy(self.config.prune_below);
        let kept = if least == 0.0 { full } else { full.intersection(&self.seen(grid, stage, least)) };
        if kept.fraction() > 0.0 { Ok(kept) } else { Err(self.pruned_to_nothing(least)) }
    }

    /// The voxels that weigh at least so much in a pixel, and those around.
    fn seen(&self, grid: &VoxelGrid<T>, stage: &Stage, least: f64) -> Occupancy {
        // svox2's: its weights are of the samples around a voxel, and what lies behind a surface must stay for the surface to move.
        const MARGIN: usize = 2;
        // Where less light is left, no sample weighs as much.
        let stop_below = self.config.stop_below.max(least);
        let options = RenderOptions { stop_below, ..self.options(grid, stage, Jitter::None) };
        let stride = self.rays.stride(grid.shape().voxel_side(), grid.aabb());
        let weights = largest_weights(grid, self.rays.lattice_of_rays(stride, RAYS_PER_BATCH), &options);
        grid.voxels_where(|row| f64::from(weights[row]) >= least).dilated(MARGIN)
    }

    /// How a stage renders.
    fn options(&self, grid: &VoxelGrid<T>, stage: &Stage, jitter: Jitter) -> RenderOptions<'static> {
        RenderOptions {
            aabb: grid.aabb(),
            spacing: stage.sampling.spacing(grid.shape().voxel_side()),
            jitter,
            background: self.config.background,
            occupancy: None,
            engine: self.engine(),
            stop_below: self.config.stop_below,
        }
    }

    /// The engine that the config asks for, unless a loss needs what only the graph has.
    pub fn engine(&self) -> Engine {
        if self.objective.needs_samples() { Engine::Graph } else { self.config.engine }
    }

    fn numeric(&self, found: String) -> Error {
        Error::Numeric { place: format!("step {}", self.step), found, remedy: "lower the learning rates of this stage".to_owned() }
    }
}

/// Values before the first step, of a scout or of the training itself.
fn initial(config: &Config, scouts: bool) -> Initial {
    let density = config.scout.as_ref().filter(|_| scouts).map_or(config.initial.density, |scout| scout.density);
    Initial { density, ..config.initial }
}

/// Stages one after another.
fn plan(config: &Config, stages: impl Iterator<Item = Stage>, rays: u64) -> Vec<PlannedStage> {
    let mut first = 0;
    let planned = stages.map(|stage| {
        let steps = stage.step_count(rays, config.rays_per_step);
        first += steps;
        PlannedStage { stage, first: first - steps, steps }
    });
    planned.collect()
}

/// The losses that a config names.
pub fn objective<T: Real>(config: &Config) -> Result<Objective<T>> {
    if config.losses.is_empty() {
        return Err(Error::config("losses", "no loss", "at least one, as in `mse = 1.0`"));
    }
    config.losses.iter().try_fold(Objective::new(), |objective, (name, weight)| match *weight {
        Weight::Constant(weight) => objective.with_named(name, weight),
        Weight::Until { weight, until } => objective.with_named(name, Piecewise::new(weight).then(until, 0.0)),
        Weight::Exponential { from, to, steps } => objective.with_named(name, Exponential::new(from, to, steps)),
    })
}

fn optimizer<T: Real>(config: &Config, plan: &PlannedStage) -> Box<dyn Optimizer<T>> {
    let Stage { color_rate: of_color, harmonics_rate, .. } = plan.stage;
    let of_harmonics = harmonics_rate.unwrap_or(of_color);
    let rates = || {
        let rates = Rates::new(0.0).with("density", density_rate(plan)).with("color", color_rate(plan, of_color));
        rates.with("harmonics", color_rate(plan, of_harmonics))
    };
    match config.optimizer {
        OptimizerConfig::Sgd => Box::new(Sgd::new(rates())),
        OptimizerConfig::Momentum { decay } => Box::new(Momentum::new(rates(), decay)),
        OptimizerConfig::RmsProp { beta, epsilon } => Box::new(RmsProp::new(rates()).beta(beta).epsilon(epsilon)),
        OptimizerConfig::LazyAdam { beta1, beta2, epsilon } => {
            Box::new(Adam::new(rates(), AdamMode::Lazy).betas(beta1, beta2).epsilon(epsilon))
        }
    }
}

/// The density's rate over the steps of a stage.
fn density_rate(plan: &PlannedStage) -> Box<dyn Schedule> {
    // svox2's.
    const FIRST: f64 = 0.01;
    let whole = rate(plan, plan.stage.density_rate, plan.stage.rate_decay);
    if plan.stage.density_warm_up == 0 { whole } else { Box::new(WarmUp::new(whole, FIRST, plan.stage.density_warm_up)) }
}

/// That of colors or harmonics.
fn color_rate(plan: &PlannedStage, start: f64) -> Box<dyn Schedule> {
    rate(plan, start, plan.stage.color_decay())
}

fn rate(plan: &PlannedStage, start: f64, decay: f64) -> Box<dyn Schedule> {
    if start == 0.0 || decay == 1.0 { Box::new(start) } else { Box::new(Exponential::new(start, start * decay, plan.steps)) }
}

fn mean_squared_error<T: Real>(x: &[T], y: &[T]) -> f64 {
    let parts = parallel::map_chunks(x.len(), parallel::CHUNK, |range| {
        x[range.clone()].iter().zip(&y[range]).map(|(&x, &y)| ((x - y) * (x - y)).as_f64()).sum::<f64>()
    });
    parts.into_iter().sum::<f64>() / x.len() as f64
}

#[cfg(test)]
mod tests {
    use super::config::{Hull, Scout};
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};
    use autograd::Tensor;
    use glam::DVec3;

    #[test]
    fn after_a_scout_the_cube_shrinks_to_what_a_finer_stage_begins_with() {
        let options = ProceduralOptions { width: 32, height: 32, train: 8, val: 0, test: 0, supersample: 1 };
        let views = Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap();
        let half_width = |scout: Option<Scout>, prune_from_stage| {
            let stages = vec![Stage::new(16, 1), Stage::new(32, 1)];
            let config = Config { scout, prune_from_stage, prune_unseen_below: 0.1, hull: Hull::Off, stages, ..Config::default() };
            let mut trainer = Trainer::<f64>::new(config, &views).unwrap();
            // As if it had learned a ball of radius 0.4.
            let grid = VoxelGrid::uniform(trainer.config.grid_shape(16), 0.0, 0.0);
            let densities = (0..16 * 16 * 16).map(|row| {
                let center =
                    grid.lattice().node(row).map(|node| DVec3::from(node.map(|k| (k as f64 + 0.5) / 8.0 - 1.0)) * grid.shape().half_width);
                if center.is_some_and(|center| center.length() < 0.4) { 50.0 } else { 0.0 }
            });
            trainer.grid = grid.with_density(Tensor::from_vec(densities.collect(), &[16 * 16 * 16, 1]));
            trainer.step = trainer.plan[trainer.plan.len() - 1].first;
            trainer.step().unwrap();
            assert_eq!(trainer.grid.shape().resolution, 32);
            trainer.grid.shape().half_width
        };
        let whole = Config::default().half_width;
        let scout = Scout { density: 1.0, prune_unseen_below: 0.1, stages: vec![Stage::new(8, 1)] };
        let fitted = half_width(Some(scout.clone()), Some(1));
        assert!((0.4..0.8 * whole).contains(&fitted), "{fitted}");
        assert_eq!(half_width(Some(scout), None), whole);
        assert_eq!(half_width(None, Some(1)), whole);
    }
}
