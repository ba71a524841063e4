//! Training: batch → render → objective → gradients → optimizer → projection, coarse to fine.
//!
//! The trainer draws, computes and reports; it never prints and never reads a clock.

mod between;
pub mod config;
mod plan;
mod start;
mod state;

pub use plan::PlannedStage;

use crate::dataset::View;
use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::loss::{Objective, Step};
use crate::rays::RaySource;
use crate::render::{Engine, RenderOptions, render};
use crate::sampling::{Jitter, Occupancy};
use autograd::optim::{Exponential, Optimizer, Piecewise};
use autograd::{Real, parallel, value_and_grad};
use config::{Config, Stage, Weight};
use plan::{color_rate, density_rate, initial, optimizer, plan};
use start::Silhouettes;

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

/// A grid in training.
pub struct Trainer<'a, T: Real> {
    config: Config,
    plan: Vec<PlannedStage>,
    views: &'a [View],
    rays: RaySource,
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

fn mean_squared_error<T: Real>(x: &[T], y: &[T]) -> f64 {
    let parts = parallel::map_chunks(x.len(), parallel::CHUNK, |range| {
        x[range.clone()].iter().zip(&y[range]).map(|(&x, &y)| ((x - y) * (x - y)).as_f64()).sum::<f64>()
    });
    parts.into_iter().sum::<f64>() / x.len() as f64
}
