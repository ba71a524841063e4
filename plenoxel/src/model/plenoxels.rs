//! Plenoxels: a voxel grid that is trained coarse to fine and pruned of empty voxels between stages (Fridovich-Keil et al. 2022, and
//! Maruani 2022).
//!
//! [`config::Config`] holds every setting. [`Trainer::<f32>::new(config, views)`](Trainer) trains with the losses that the config names.
//! `Trainer::with_objective` trains with an objective of your own:
//!
//! ```
//! use plenoxel::dataset::procedural::ProceduralOptions;
//! use plenoxel::dataset::{Dataset, Split};
//! use plenoxel::loss::mse;
//! use plenoxel::model::plenoxels::config::{Config, Stage};
//! use plenoxel::model::plenoxels::{Objective, Trainer};
//!
//! let scene = ProceduralOptions { width: 16, height: 16, train: 4, val: 0, test: 0, supersample: 1 };
//! let views = Dataset::procedural(scene)?.load(Split::Train, &|_, _| {})?;
//! let objective = Objective::<f32>::new().with("mse", 1.0, mse);
//! let config = Config { stages: vec![Stage::new(8, 3)], ..Config::default() };
//! let mut trainer = Trainer::with_objective(config, views, objective)?;
//! while let Some(report) = trainer.step()? {
//!     assert!(report.psnr > 0.0);
//! }
//! assert_eq!(trainer.grid().shape().resolution, 8);
//! # Ok::<(), plenoxel::error::Error>(())
//! ```

pub mod config;
mod file;
mod objective;
mod pictures;
mod rates;
mod single;
mod stages;
mod start;

pub use objective::{LEARNED_LOSSES, LOSSES, objective, objective_of_any, with_loss};
pub(crate) use stages::ray_cost;

use crate::camera::Ray;
use crate::checkpoint::{self, Header};
use crate::dataset::View;
use crate::error::{Error, Result};
use crate::evaluate::Viewer;
use crate::field::voxel_grid::{Color, GridShape, GridSpace, VoxelGrid};
use crate::field::{Field, sh};
use crate::geometry::Aabb;
use crate::loss;
use crate::rays::RaySource;
use crate::render::{Engine, RenderOptions, Rendered, render};
use crate::sampling::Occupancy;
use crate::space::Space;
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{
    self, About, Model, Pass, PlannedStage, RenderFn, StageLength, StageProgress, TrainOptions, ViewOptions, same_settings,
};
use autograd::optim::Optimizer;
use autograd::single::{cast, cast_mut, cast_ref, is_single};
use autograd::{Module, Param, Real, Tensor};
use config::{Config, Sampling, Stage};
use pictures::Pictures;
use serde_json::{Map, Value, json};
use start::Silhouettes;
use std::any::Any;
use std::path::Path;
use std::sync::Arc;

/// Trainer of [`Plenoxels`].
pub type Trainer<T> = train::Trainer<T, Plenoxels<T>>;

/// Objective of [`Plenoxels`].
pub type Objective<T> = loss::Objective<T, Plenoxels<T>>;

/// Data of a training step of [`Plenoxels`].
pub type Step<'a, T> = loss::Step<'a, T, Plenoxels<T>>;

/// Kind of model in the checkpoints of voxel grids.
pub const KIND: &str = checkpoint::KIND;

/// Number of steps between updates of the mask of cells that can learn. A sample whose corners all have a negative density has no gradient.
/// It gets one when a corner that it shares with another sample rises above 0.
const STEPS_PER_LOOK: u64 = 64;

/// A voxel grid, trained as a config describes.
#[derive(Debug)]
pub struct Plenoxels<T: Real> {
    /// Config, fitted to the images ([`Config::fitted_to`]).
    config: Config,
    /// Stages to train; stages of the scout come first.
    stages: Vec<Stage>,
    /// Number of stages that belong to the scout.
    scouts: usize,
    silhouettes: Option<Silhouettes>,
    grid: VoxelGrid<T>,
    /// Cells that could learn at the last update. Training leaves out samples in other cells.
    learning: Option<Occupancy>,
    most_rows: usize,
}

impl<T: Real> Plenoxels<T> {
    /// Creates the initial grid of a config for these training views.
    ///
    /// Errors if a setting is invalid, naming the setting.
    pub fn new(config: &Config, views: &Arc<[View]>) -> Result<Self> {
        Self::with_progress(config, views, Arc::default())
    }

    /// Creates the initial grid as [`new`](Self::new) does. `progress` counts the views of visual hulls; another thread may read it.
    ///
    /// Errors if a setting is invalid, naming the setting.
    pub fn with_progress(config: &Config, views: &Arc<[View]>, progress: Arc<StageProgress>) -> Result<Self> {
        if const { is_single::<T>() } { cast(single::new(config, views, progress)) } else { Self::start(config, views, progress) }
    }

    fn start(config: &Config, views: &Arc<[View]>, progress: Arc<StageProgress>) -> Result<Self> {
        config.validate()?;
        let config = config.fitted_to(views.iter().map(|view| &view.camera));
        config.check_stages()?;
        let silhouettes = Silhouettes::new(&config, views, progress);
        let scout = config.scout.as_ref().filter(|_| silhouettes.is_none());
        let of_scout = scout.map_or(&[][..], |scout| &scout.stages);
        let stages: Vec<Stage> = of_scout.iter().chain(&config.stages).copied().collect();
        // An initial grid replaces this one.
        let mut shape = config.grid_shape(if config.init_from.is_some() { 2 } else { stages[0].resolution });
        if let Some(silhouettes) = &silhouettes {
            shape.half_width = match silhouettes.half_width(shape.half_width) {
                Some(half_width) => half_width,
                // An initial grid has its own box.
                None if config.init_from.is_some() => shape.half_width,
                None => return Err(Silhouettes::nothing_inside()),
            };
        }
        let scouts = of_scout.len();
        let initial = config.initial_of(scouts > 0);
        let grid = match initial.random {
            true => VoxelGrid::random(shape, initial.density, initial.color, config.seed),
            false => VoxelGrid::uniform(shape, initial.density, initial.color),
        };
        Ok(Plenoxels { config, stages, scouts, silhouettes, grid, learning: None, most_rows: usize::MAX })
    }

    /// Wraps an existing grid for rendering. The model has no stages to train.
    pub fn of_grid(config: &Config, grid: VoxelGrid<T>) -> Self {
        Plenoxels { config: config.clone(), stages: Vec::new(), scouts: 0, silhouettes: None, grid, learning: None, most_rows: usize::MAX }
    }

    /// Sets the largest number of table rows that pruning may leave. More rows would not fit into memory.
    pub fn with_most_rows(self, most_rows: usize) -> Self {
        Plenoxels { most_rows, ..self }
    }

    /// Starts from an existing grid, trained or carved. The grid keeps its box and is resampled at the resolution of the first stage.
    /// Stages that are coarser than the grid are left out, except the last.
    ///
    /// The grid of a capture keeps its [coordinates](GridShape::coordinates): the rays of the training views are transformed to them. Silhouettes and
    /// [`Config::aim`] are then not used.
    pub fn starting_from(self, grid: &VoxelGrid<T>) -> Self {
        if const { is_single::<T>() } { cast(single::from(cast(self), cast_ref(grid))) } else { self.from(grid) }
    }

    fn from(mut self, grid: &VoxelGrid<T>) -> Self {
        self.scouts = 0;
        self.stages = self.config.stages[self.config.stages_left_out(grid.shape().resolution)..].to_vec();
        if grid.shape().coordinates != GridSpace::WORLD {
            self.silhouettes = None;
        }
        self.grid = start::adapted(grid, &self.config.grid_shape(self.stages[0].resolution));
        self
    }

    /// Starts from a carved grid: keeps its voxels and colors, in the smallest box around them, and sets every density to the initial
    /// density, so that gradients reach voxels behind a surface. No stage is left out: a carved grid gives the positions of possible
    /// matter, not its density.
    pub fn starting_from_carved(mut self, grid: &VoxelGrid<T>) -> Self {
        self.scouts = 0;
        self.stages = self.config.stages.clone();
        let shape = self.config.grid_shape(self.stages[0].resolution);
        let gray = match shape.color {
            Color::Rgb => self.config.initial.color,
            Color::Sh { offset, .. } => offset + sh::Y0 * self.config.initial.color,
        };
        let carved = start::with_unseen_colors(grid, gray).with_interpolation(shape.interpolation);
        let half_width = grid.matter().half_width().unwrap_or(grid.shape().half_width);
        let adapted = start::adapted(&carved.resample_in(shape.resolution, half_width), &shape);
        let density = Tensor::full(adapted.density.shape(), self.config.initial.density);
        self.grid = adapted.with_density(density);
        self
    }

    /// Returns the current grid.
    pub fn grid(&self) -> &VoxelGrid<T> {
        &self.grid
    }

    /// Returns the grid, consuming the model.
    pub fn into_grid(self) -> VoxelGrid<T> {
        self.grid
    }

    /// Returns the config, fitted to the images ([`Config::fitted_to`]).
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the sampling of rendered images.
    fn sampling(&self, view: &ViewOptions) -> Sampling {
        let sampling = self.config.evaluation;
        view.samples.map_or(sampling, |samples| sampling.with_samples(samples, self.grid.shape()))
    }

    /// Returns a renderer of pictures of a grid.
    fn pictures(&self, grid: &VoxelGrid<T>, view: &ViewOptions) -> Pictures<T> {
        Pictures::new(grid, self.sampling(view), self.config.engine, view.background).in_groups_of(self.config.group_in_pictures)
    }

    /// Returns the stages to train, fitted to the images. Stages of the scout come first.
    pub fn stages(&self) -> &[Stage] {
        &self.stages
    }

    /// Returns the number of stages that belong to the scout.
    pub fn scout_stages(&self) -> usize {
        self.scouts
    }
}

/// Creates a viewer of a voxel grid: without jitter, and skipping empty cells, which changes no pixel.
pub fn grid_viewer<T: Real>(grid: &VoxelGrid<T>, sampling: Sampling, engine: Engine, background: [f32; 3]) -> Viewer<'_, T> {
    let pictures = Pictures::new(grid, sampling, engine, background);
    Viewer::new(move |rays: &[Ray]| pictures.render(grid, rays), background).in_tiles(pictures::tile(engine))
}

/// Opens the model of a checkpoint for rendering. `config` is the config of its run; its stages are not used.
///
/// Errors if the file cannot be read; the error names the file and the problem.
pub fn open(path: &Path, config: &Config) -> Result<(Plenoxels<f32>, About)> {
    let (grid, header) = checkpoint::load(path)?;
    if let (Sampling::Points { .. }, true) = (config.evaluation, header.coordinates != GridSpace::WORLD) {
        let found = format!("points on straight rays cannot sample a grid in the space `{}`", header.coordinates.space);
        return Err(Error::usage("evaluation", found, "set evaluation.step instead of evaluation.samples and evaluation.far"));
    }
    Ok((Plenoxels::of_grid(config, grid), header.into()))
}

/// Renders a batch of rays in the coordinates of a grid.
fn render_grid<T: Real>(grid: &VoxelGrid<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    if const { is_single::<T>() } { cast(single::render(cast_ref(grid), rays, options)) } else { render(grid, rays, options) }
}

/// Returns a copy of a grid. The tables are shared until training changes them.
fn copy<T: Real>(grid: &VoxelGrid<T>) -> VoxelGrid<T> {
    grid.with_density(grid.density.tensor().detach())
}

fn save<T: Real>(grid: &VoxelGrid<T>, path: &Path, about: &About) -> Result<()> {
    checkpoint::save(path, grid, &Header::new(grid, &about.scene, about.background, about.seed, about.step))
}

impl<T: Real> AsRef<VoxelGrid<T>> for Plenoxels<T> {
    fn as_ref(&self) -> &VoxelGrid<T> {
        &self.grid
    }
}

impl<T: Real> Module<T> for Plenoxels<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.grid.visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.grid.visit_mut(f);
    }
}

impl<T: Real> Model<T> for Plenoxels<T> {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn aabb(&self) -> Aabb {
        self.grid.shape().box_in_space()
    }

    fn space(&self) -> Space {
        self.grid.shape().coordinates.space
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T> {
        let sampling = pass.stage.map_or(self.config.evaluation, |stage| self.stages[stage].sampling);
        let occupancy = self.learning.as_ref().filter(|_| pass.stage.is_some());
        let options = self.config.render_options(&self.grid, sampling, pass.jitter);
        let engine = if pass.keep_samples { Engine::Graph } else { options.engine };
        let rays = self.grid.shape().coordinates.rays(rays);
        render_grid(&self.grid, &rays, &RenderOptions { occupancy, engine, background: pass.background, ..options })
    }

    fn viewer<'a>(&'a self, view: &ViewOptions) -> RenderFn<'a, T> {
        let pictures = self.pictures(&self.grid, view);
        Box::new(move |rays| pictures.render(&self.grid, rays))
    }

    fn tile(&self) -> usize {
        pictures::tile(self.config.engine)
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let of_stage = &self.stages[stage.index];
        match const { is_single::<T>() } {
            true => cast(single::optimizer(&self.config, of_stage, stage.steps)),
            false => rates::optimizer(&self.config, of_stage, stage.steps),
        }
    }

    fn stages(&self, options: &TrainOptions, rays_per_epoch: u64) -> Vec<StageLength> {
        let length = |stage: &Stage| StageLength {
            resolution: Some(stage.resolution),
            steps: stage.step_count(rays_per_epoch, options.rays_per_step),
            rays_per_step: None,
            ray_cost: ray_cost(stage.resolution),
        };
        self.stages.iter().map(length).collect()
    }

    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        if const { is_single::<T>() } { single::begin(cast_mut(self), stage.index, rays) } else { self.begin(stage.index, rays) }
    }

    fn progress(&self) -> Option<Arc<StageProgress>> {
        self.silhouettes.as_ref().map(|silhouettes| silhouettes.progress.clone())
    }

    fn begin_step(&mut self, in_stage: u64) -> Result<()> {
        if in_stage.is_multiple_of(STEPS_PER_LOOK) {
            self.learning = Some(if const { is_single::<T>() } { single::learning(cast_ref(&self.grid)) } else { self.grid.learning() });
        }
        Ok(())
    }

    fn facts(&self) -> Vec<(&'static str, f64)> {
        vec![("voxels", self.grid.lattice().present() as f64)]
    }

    fn figures(&self, view: &ViewOptions) -> Map<String, Value> {
        let shape = self.grid.shape();
        let grid = json!({
            "voxels_per_axis": shape.resolution,
            "voxels_stored": self.grid.lattice().present(),
            "half_width": shape.half_width,
        });
        let figures = [("resolution", json!(shape.resolution)), ("grid", grid), ("sampling", json!(self.sampling(view)))];
        figures.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    /// Returns the voxel grid, a [`VoxelGrid<T>`]. Its positions have the coordinates of its [shape](GridShape::coordinates).
    fn content(&self) -> Option<&dyn Any> {
        Some(&self.grid)
    }

    fn frozen(&self, view: &ViewOptions) -> Option<RenderFn<'static, T>> {
        let grid = copy(&self.grid);
        let pictures = self.pictures(&grid, view);
        Some(Box::new(move |rays| pictures.render(&grid, rays)))
    }

    fn settings(&self) -> Value {
        serde_json::to_value(&self.config).unwrap_or_default()
    }

    fn continues(&self, saved: &Value, _: u64) -> bool {
        same_settings(&self.config, saved)
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        file::write(self, file);
    }

    fn read(&mut self, file: &mut TensorFile<'_>, stage: usize) -> Result<()> {
        if const { is_single::<T>() } { single::read(cast_mut(self), file, stage) } else { file::read(self, file, stage) }
    }

    fn resume(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        rays.set_reduction(self.stages[stage.index].image_reduction);
        let reach = Field::<T>::reach(&self.grid).cloned();
        self.aim(reach.as_ref(), rays);
    }

    fn save(&self, path: &Path, about: &About) -> Result<()> {
        if const { is_single::<T>() } { single::save(cast_ref(&self.grid), path, about) } else { save(&self.grid, path, about) }
    }

    fn load(&mut self, path: &Path) -> Result<About> {
        let (grid, header) = if const { is_single::<T>() } { cast(single::load(path)?) } else { checkpoint::load(path)? };
        self.grid = grid;
        Ok(header.into())
    }
}

/// Construction from a config, and access to the grid.
impl<T: Real> train::Trainer<T, Plenoxels<T>> {
    /// Creates a run with the losses that the config names.
    pub fn new(config: Config, views: impl Into<Arc<[View]>>) -> Result<Self> {
        config.validate()?;
        let views = views.into();
        let objective = objective(&config, views.len())?;
        Self::with_losses(config, views, objective, Arc::default())
    }

    /// Creates a run with an objective of your own.
    ///
    /// Errors if the config names losses other than the default (a mean squared error), because they would not be used.
    pub fn with_objective(config: Config, views: impl Into<Arc<[View]>>, objective: Objective<T>) -> Result<Self> {
        if !config.losses.is_empty() && config.losses != Config::default().losses {
            let names: Vec<&str> = config.losses.keys().map(String::as_str).collect();
            let remedy = "leave `losses` empty, or use Trainer::new; model::plenoxels::objective(&config, views) builds an objective with these losses";
            let found = format!("a custom objective does not use the losses of the config: {}", names.join(", "));
            return Err(Error::usage("losses", found, remedy));
        }
        Self::with_losses(config, views.into(), objective, Arc::default())
    }

    /// Creates a run with an objective, whatever losses the config names. `progress` counts the views of visual hulls.
    pub(crate) fn with_losses(config: Config, views: Arc<[View]>, objective: Objective<T>, progress: Arc<StageProgress>) -> Result<Self> {
        let model = Plenoxels::with_progress(&config, &views, progress)?;
        Self::with_model(model, views, objective, config.train_options())
    }

    /// Sets the largest number of table rows that pruning may leave ([`Plenoxels::with_most_rows`]).
    pub fn with_most_rows(self, most_rows: usize) -> Self {
        self.map_model(|model| model.with_most_rows(most_rows))
    }

    /// Starts the run from an existing grid ([`Plenoxels::starting_from`]).
    ///
    /// Panics if steps have been taken.
    pub fn starting_from(self, grid: &VoxelGrid<T>) -> Self {
        self.map_model(|model| model.starting_from(grid))
    }

    /// Starts the run from a carved grid ([`Plenoxels::starting_from_carved`]).
    ///
    /// Panics if steps have been taken.
    pub fn starting_from_carved(self, grid: &VoxelGrid<T>) -> Self {
        self.map_model(|model| model.starting_from_carved(grid))
    }

    /// Returns the current grid.
    pub fn grid(&self) -> &VoxelGrid<T> {
        self.model().grid()
    }

    /// Returns the grid, consuming the trainer.
    pub fn into_grid(self) -> VoxelGrid<T> {
        self.into_model().into_grid()
    }

    /// Returns the config, fitted to the images ([`Config::fitted_to`]).
    pub fn config(&self) -> &Config {
        self.model().config()
    }
}

impl Sampling {
    /// Returns the sampling with `samples` samples on the diagonal of the box, or on the whole ray for [`Sampling::Points`].
    pub fn with_samples(self, samples: u32, shape: &GridShape) -> Self {
        match self {
            Sampling::Points { far, .. } => Sampling::Points { samples: samples as usize, far },
            Sampling::Step { .. } => Sampling::Step { step: 3f64.sqrt() * shape.resolution as f64 / f64::from(samples) },
        }
    }
}
