//! Instant-NGP (Müller et al. 2022): a [hash grid with two small networks](crate::field::ngp), sampled in cells whose density is followed
//! during training.
//!
//! The numbers of [`Config::authors`] are those of `configs/nerf/base.json` and `src/testbed_nerf.cu` of the authors' program, except:
//!
//! * A step has a fixed number of rays. The authors' has a fixed number of samples.
//! * The visual hull is used if the views have alpha, and an optical depth of 10 in it before the first step. The authors have no hull.
//! * Adam visits rows with a gradient and counts the steps of a tensor. The authors' Adam counts the steps of each entry.
//! * The parameters are those of the last step. The authors render with a running mean of them, which is worth 0.35 dB before the rates decay, and nothing after.

mod recipe;

use crate::camera::Ray;
use crate::carve::visual_hull;
use crate::dataset::has_alpha;
use crate::error::{Error, Result};
use crate::field::encoding::Directions;
use crate::field::hash_grid;
use crate::field::ngp::{HashField, Shape, TABLE};
use crate::geometry::Aabb;
use crate::loss::Step;
use crate::model::cells;
use crate::model::plenoxels::config::Hull;
use crate::model::recipe::Recipe;
use crate::rays::RaySource;
use crate::render::{Engine, Field, RenderOptions, Rendered, ShadedField, render};
use crate::sampling::{Jitter, Occupancy, Refresh, RunningOccupancy, Spacing};
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{About, Model, Pass, PlannedStage, StageLength, TrainOptions, read_params};
use autograd::optim::{Adam, AdamMode, Optimizer, Rates, Schedule};
use autograd::{Module, Param, Precision, Real, Tensor, random::Stream};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Kind of this model in checkpoints.
pub const KIND: &str = "ngp";

/// A stage of training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Steps.
    pub steps: u64,
    /// Rays per step.
    pub rays: usize,
}

/// Settings of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Levels of the hash grid.
    pub levels: usize,
    /// Features of a level: 1, 2, 4 or 8.
    pub features: usize,
    /// Base-2 logarithm of the largest number of rows of a level.
    pub log2_rows: u32,
    /// Resolution of the first level.
    pub base_resolution: usize,
    /// Resolution of the last level.
    pub finest_resolution: usize,
    /// Width of the hidden layers of both networks.
    pub hidden: usize,
    /// Hidden layers of the color network; the density network has one.
    pub color_layers: usize,
    /// Encoding of directions.
    pub directions: Directions,
    /// Optical depth of the longest side of the box before the first step.
    pub depth: f64,
    /// Optical depth before the first step if there is a visual hull.
    pub depth_in_hull: f64,
    /// Number of steps along the longest side of the box.
    pub samples: f64,
    /// Samples whose weight is not above this have no color.
    pub color_above: f64,
    /// Transmittance below which a training ray ends.
    pub stop_below: f64,
    /// Transmittance below which a ray of a picture ends.
    pub stop_below_in_pictures: f64,
    /// Cells of the occupancy along the longest side of the box.
    pub cells: usize,
    /// Opacity σ · step of a cell above which it is always sampled.
    pub occupied_above: f64,
    /// Factor of the estimates of the cells' densities in each refresh.
    pub occupancy_decay: f64,
    /// Largest number of steps between two refreshes of the occupancy.
    pub refresh_every: u64,
    /// Number of steps during which a refresh visits all cells.
    pub refresh_all_until: u64,
    /// Learning rate of the table.
    pub table_rate: f64,
    /// Learning rate of the networks.
    pub network_rate: f64,
    /// Factor of the learning rates at each decay.
    pub decay: f64,
    /// Step of the first decay.
    pub decay_from: u64,
    /// Number of steps between decays.
    pub decay_every: u64,
    /// True: products of the networks are computed in [`Precision::Mixed`], in training and in pictures.
    pub mixed_precision: bool,
    /// Stages.
    pub stages: Vec<Stage>,
}

/// The recipe for two cores.
impl Default for Config {
    fn default() -> Self {
        Config {
            levels: 8,
            features: 4,
            log2_rows: 17,
            base_resolution: 16,
            finest_resolution: 1024,
            hidden: 64,
            color_layers: 2,
            directions: Directions::Harmonics(3),
            depth: 1.0,
            depth_in_hull: 10.0,
            samples: 512.0,
            color_above: 1e-3,
            stop_below: 1e-2,
            stop_below_in_pictures: 1e-3,
            cells: 128,
            occupied_above: 0.01,
            occupancy_decay: 0.95,
            refresh_every: 16,
            refresh_all_until: 256,
            table_rate: 1e-2,
            network_rate: 1e-2,
            decay: 0.33,
            decay_from: 1000,
            decay_every: 250,
            mixed_precision: false,
            stages: vec![Stage { steps: 1500, rays: 4096 }],
        }
    }
}

impl Config {
    /// Returns the authors' settings for synthetic scenes, with a fixed number of rays per step instead of a fixed number of samples.
    pub fn authors() -> Self {
        Config {
            log2_rows: 19,
            finest_resolution: 2048,
            // The authors have no hull. With their depth of 1, thin fog in a hull loses its colors: lego at 100 x 100 stays at 17.4 dB, with 10 it has 25.3 dB after
            // 150 steps of 1024 rays.
            depth_in_hull: 10.0,
            // Steps of √3 / 1024 of the unit cube.
            samples: 1024.0 / 3f64.sqrt(),
            color_above: 0.0,
            stop_below: 1e-4,
            stop_below_in_pictures: 1e-4,
            decay_from: 20_000,
            decay_every: 10_000,
            // 2¹⁸ samples at about 8 per ray.
            stages: vec![Stage { steps: 35_000, rays: 1 << 15 }],
            ..Config::default()
        }
    }

    /// Checks the settings.
    ///
    /// Errors name the setting that is invalid.
    pub fn validate(&self) -> Result<()> {
        let check = |valid: bool, key: &str, value: f64, expected: &str| match valid {
            true => Ok(()),
            false => Err(Error::config(key, value, expected)),
        };
        check((1..=32).contains(&self.levels), "levels", self.levels as f64, "1 to 32")?;
        check([1, 2, 4, 8].contains(&self.features), "features", self.features as f64, "1, 2, 4 or 8")?;
        check((3..=24).contains(&self.log2_rows), "log2_rows", f64::from(self.log2_rows), "3 to 24")?;
        check((2..=1 << 16).contains(&self.base_resolution), "base_resolution", self.base_resolution as f64, "2 to 65536")?;
        let finest = self.base_resolution..=1 << 20;
        check(finest.contains(&self.finest_resolution), "finest_resolution", self.finest_resolution as f64, "base_resolution to 1048576")?;
        check((1..=1024).contains(&self.hidden), "hidden", self.hidden as f64, "1 to 1024")?;
        check((1..=8).contains(&self.color_layers), "color_layers", self.color_layers as f64, "1 to 8")?;
        self.directions.validate("directions")?;
        for (key, depth) in [("depth", self.depth), ("depth_in_hull", self.depth_in_hull)] {
            check(depth > 0.0 && depth <= 1e6, key, depth, "a number in (0, 1000000]")?;
        }
        check((1.0..=1e5).contains(&self.samples), "samples", self.samples, "1 to 100000")?;
        check((1..=MOST_CELLS).contains(&self.cells), "cells", self.cells as f64, "1 to 256")?;
        for (key, share) in [
            ("color_above", self.color_above),
            ("stop_below", self.stop_below),
            ("stop_below_in_pictures", self.stop_below_in_pictures),
            ("occupied_above", self.occupied_above),
            ("occupancy_decay", self.occupancy_decay),
        ] {
            check((0.0..1.0).contains(&share), key, share, "a number in [0, 1)")?;
        }
        for (key, rate) in [("table_rate", self.table_rate), ("network_rate", self.network_rate), ("decay", self.decay)] {
            check(rate > 0.0 && rate <= 1.0, key, rate, "a number in (0, 1]")?;
        }
        check(self.refresh_every > 0, "refresh_every", 0.0, "at least 1")?;
        check(self.decay_every > 0, "decay_every", 0.0, "at least 1")?;
        if self.stages.is_empty() {
            return Err(Error::usage("stages", "there is no stage", "set at least one"));
        }
        for (i, stage) in self.stages.iter().enumerate() {
            check(stage.steps > 0, &format!("stages[{i}].steps"), 0.0, "at least 1")?;
            check((1..=1 << 20).contains(&stage.rays), &format!("stages[{i}].rays"), stage.rays as f64, "1 to 1048576")?;
        }
        Ok(())
    }

    fn shape(&self) -> Shape {
        let ratio = self.finest_resolution as f64 / self.base_resolution as f64;
        let grid = hash_grid::Shape {
            levels: self.levels,
            features: self.features,
            log2_rows: self.log2_rows,
            base: self.base_resolution,
            growth: ratio.powf(1.0 / (self.levels.max(2) - 1) as f64),
        };
        Shape { grid, hidden: self.hidden, color_layers: self.color_layers, directions: self.directions }
    }
}

/// The model.
#[derive(Debug)]
pub struct Ngp<T: Real> {
    config: Config,
    decays: Arc<Decays>,
    field: HashField<T>,
    /// Densities of the cells; `None` before the first step.
    running: Option<RunningOccupancy>,
    hull: Hull,
    seed: u64,
    /// First step of the current stage.
    first: u64,
    /// Implementation of rendering.
    pub engine: Engine,
}

impl<T: Real> Module<T> for Ngp<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.field.visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.field.visit_mut(f);
    }
}

/// Most cells of the occupancy along an axis.
const MOST_CELLS: usize = 256;
/// Pixels around the silhouettes that belong to the hull.
const HULL_MARGIN: f64 = 1.0;

impl<T: Real> Ngp<T> {
    /// Creates the model in a box. `seed` determines the initial parameters and the refreshes of the occupancy.
    ///
    /// Errors name the setting that is invalid.
    pub fn new(config: Config, aabb: Aabb, seed: u64) -> Result<Self> {
        config.validate()?;
        let mut field = HashField::new(config.shape(), aabb, &Stream::new(seed));
        field.color_above = config.color_above;
        field.set_precision(Precision::mixed_if(config.mixed_precision));
        let decays = Arc::new(Decays::default());
        let mut model =
            Ngp { config: config.clone(), decays, field, running: None, hull: Hull::Auto, seed, first: 0, engine: Engine::Fused };
        model.set_config(config);
        Ok(model)
    }

    /// Sets the use of silhouettes. With [`Hull::Auto`], the default, only cells in the visual hull of the training views are sampled, if they have an alpha
    /// channel.
    pub fn with_hull(self, hull: Hull) -> Self {
        Ngp { hull, ..self }
    }

    /// Opens a trained model.
    ///
    /// Errors if the file is damaged or holds another kind of model; the error names the file and the problem.
    pub fn open(path: &Path) -> Result<(Self, About)> {
        let config: Config = TensorFile::open(path)?.fact("settings")?;
        let mut model = Ngp::new(config, Aabb::cube(1.0), 0)?;
        let about = model.load(path)?;
        Ok((model, about))
    }

    /// Returns the settings of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    fn set_config(&mut self, config: Config) {
        self.decays.from.store(config.decay_from, Relaxed);
        self.decays.every.store(config.decay_every, Relaxed);
        self.config = config;
    }

    /// Returns the field.
    pub fn field(&self) -> &HashField<T> {
        &self.field
    }

    /// Returns the distance between samples, world length.
    fn step(&self) -> f64 {
        self.field.extent() / self.config.samples
    }

    fn refresh(&self) -> Refresh {
        let config = &self.config;
        Refresh {
            decay: config.occupancy_decay,
            limit: config.occupied_above / self.step(),
            every: config.refresh_every,
            warm_up: config.refresh_all_until,
        }
    }

    /// Returns the number of cells of the occupancy along each axis.
    fn cells(&self) -> [usize; 3] {
        let aabb = self.field.aabb();
        let share = (aabb.max - aabb.min) / self.field.extent();
        share.to_array().map(|share| (share * self.config.cells as f64).round().max(1.0) as usize)
    }

    fn render_with(&self, rays: &[Ray], background: [f32; 3], jitter: Jitter, engine: Engine) -> Rendered<T> {
        let config = &self.config;
        let training = matches!(jitter, Jitter::PerRay { .. });
        let options = RenderOptions {
            aabb: self.field.aabb(),
            spacing: Spacing::Step(self.step()),
            jitter,
            background,
            occupancy: None,
            engine,
            stop_below: if training { config.stop_below } else { config.stop_below_in_pictures },
        };
        render(&self.field, rays, &options)
    }
}

/// Steps at which the learning rates decay ([`Config::decay_from`], [`Config::decay_every`]). The rates of the current optimizer follow them when a plan changes.
#[derive(Debug, Default)]
struct Decays {
    from: AtomicU64,
    every: AtomicU64,
}

/// Learning rate that is multiplied by a factor at every decay.
#[derive(Debug)]
struct Decaying {
    rate: f64,
    factor: f64,
    decays: Arc<Decays>,
    /// Number of steps before the stage.
    first: u64,
}

impl Schedule for Decaying {
    fn at(&self, step: u64) -> f64 {
        let (from, every) = (self.decays.from.load(Relaxed), self.decays.every.load(Relaxed));
        let decays = (self.first + step).checked_sub(from).map_or(0, |since| 1 + since / every);
        self.rate * self.factor.powi(i32::try_from(decays).unwrap_or(i32::MAX))
    }
}

impl<T: Real> Model<T> for Ngp<T> {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn aabb(&self) -> Aabb {
        self.field.aabb()
    }

    fn shaded(&self) -> Option<&dyn ShadedField<T>> {
        Some(&self.field)
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T> {
        let engine = if pass.keep_samples { Engine::Graph } else { self.engine };
        self.render_with(rays, pass.background, pass.jitter, engine)
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let Config { table_rate, network_rate, decay, .. } = self.config;
        let decaying = |rate: f64| Decaying { rate, factor: decay, decays: self.decays.clone(), first: stage.first };
        let mut rates = Rates::new(decaying(network_rate)).with(TABLE, decaying(table_rate));
        for layer in self.field.networks().into_iter().flat_map(|network| &network.layers) {
            rates = rates.with(layer.bias.name(), 0.0);
        }
        Box::new(Adam::new(rates, AdamMode::Lazy).betas(0.9, 0.99).epsilon(1e-15))
    }

    fn stages(&self, _: &TrainOptions, _: u64) -> Vec<StageLength> {
        Recipe::stages(&self.config)
    }

    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        if stage.index == 0 {
            let (views, aabb, cells) = (rays.all_views(), self.field.aabb(), self.cells());
            let among = match self.hull == Hull::Auto && has_alpha(views) {
                true => visual_hull::by_footprint(views, aabb, cells, HULL_MARGIN, &|_| {}).dilated(1),
                false => Occupancy::full(aabb, cells),
            };
            self.field.depth = if among.fraction() < 1.0 { self.config.depth_in_hull } else { self.config.depth };
            self.running = Some(RunningOccupancy::new(among, self.refresh()));
        }
        self.resume(stage, rays);
        Ok(())
    }

    fn begin_step(&mut self, in_stage: u64) -> Result<()> {
        let step = self.first + in_stage;
        if let Some(running) = self.running.as_mut().filter(|running| running.refresh().is_due(step)) {
            running.update(self.seed, step, |at| self.field.density(at));
            self.field.occupied = Some(running.occupied());
        }
        Ok(())
    }

    fn resume(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        self.first = stage.first;
        if let Some(running) = self.running.as_ref().filter(|running| running.among().fraction() < 1.0) {
            rays.aim_at(running.among());
        }
    }

    fn settings(&self) -> Value {
        json!(self.config)
    }

    /// A plan may have changed after the run was saved.
    fn continues(&self, saved: &Value, steps: u64) -> bool {
        Config::deserialize(saved).is_ok_and(|saved| self.config.begins_as(&saved, steps))
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        cells::write_box(self.field.aabb(), file);
        file.fact("depth", self.field.depth);
        file.fact("cells", self.running.as_ref().map(|running| running.estimates().len()));
        if let Some(running) = &self.running {
            file.words("among", running.among().masks());
            file.numbers("density", &[running.estimates().len()], running.estimates());
        }
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        self.field.set_aabb(cells::read_box(file)?);
        self.field.depth = file.fact("depth")?;
        self.running = match file.fact::<Option<usize>>("cells")? {
            None => None,
            Some(count) => {
                let cells = self.cells();
                let masks = file.brick_masks("among", cells)?;
                let masks = masks.ok_or_else(|| file.damaged("the mask `among` has cells outside of the box"))?;
                let among = Occupancy::from_masks(self.field.aabb(), cells, masks);
                let mut running = RunningOccupancy::new(among, self.refresh());
                if count != running.estimates().len() {
                    return Err(file.damaged("there must be one density for each cell of `among`"));
                }
                running.set_estimates(file.tensor::<f32>("density", &[count])?.data().to_vec());
                Some(running)
            }
        };
        self.field.occupied = self.running.as_ref().map(RunningOccupancy::occupied);
        read_params(self, file)
    }
}

/// Returns half the sum of squares of the networks' weights. With weight 10⁻⁶ it is the authors' regularization.
pub fn network_l2<T: Real>(step: &Step<'_, T, Ngp<T>>) -> Tensor<T> {
    let layers = step.model.field.networks().into_iter().flat_map(|network| &network.layers);
    let sums = layers.map(|layer| layer.weight.tensor().square().sum());
    0.5 * sums.reduce(|sum, of_layer| sum + of_layer).unwrap_or_else(|| Tensor::zeros(&[]))
}
