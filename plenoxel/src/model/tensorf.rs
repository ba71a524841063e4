//! TensoRF (Chen et al. 2022): a [factored field](crate::field::factored) with a small color network, trained from coarse to fine.
//!
//! The numbers of [`Config::authors`] are those of the authors' `configs/lego.txt`, `opt.py` and `models/tensoRF.py`, but for the cells that
//! are sampled: here they are found anew at the beginning of every stage but the first; the authors find them at steps 2000 and 4000, above
//! 0.08 without the factor 25, and shrink the box.

use crate::camera::Ray;
use crate::carve::visual_hull;
use crate::dataset::{View, has_alpha};
use crate::error::{Error, Result};
use crate::field::encoding::Directions;
use crate::field::factored::{Factored, Grouping, Shape};
use crate::geometry::Aabb;
use crate::loss::Step;
use crate::model::plenoxels::config::Hull;
use crate::rays::RaySource;
use crate::render::{Engine, Field, RenderOptions, Rendered, render};
use crate::sampling::{Jitter, Occupancy, Spacing};
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{About, Model, Pass, PlannedStage, RenderFn, StageLength, TrainOptions, ViewOptions};
use autograd::optim::{Adam, AdamMode, Optimizer, Rates, Schedule};
use autograd::{Module, Param, Real, Tensor, random::Stream};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

/// Kind of this model in checkpoints.
pub const KIND: &str = "tensorf";

/// A stage of training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Nodes along each axis if the box is a cube. Another box has as many cells, with about equal sides.
    pub resolution: usize,
    /// Steps.
    pub steps: u64,
    /// Rays per step.
    pub rays: usize,
}

/// Settings of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Components of each of the three plane-line pairs of the density.
    pub density_components: usize,
    /// Components of each of the three plane-line pairs of the appearance.
    pub appearance_components: usize,
    /// Length of the appearance feature.
    pub features: usize,
    /// Width of the two hidden layers of the color network.
    pub hidden: usize,
    /// Octaves of the positional encoding of the appearance feature.
    pub feature_octaves: usize,
    /// Encoding of directions.
    pub directions: Directions,
    /// Distance between samples, in cells.
    pub step: f64,
    /// Weight that completes a group of samples with one color ([`Grouping`]), in training; 0 for a color per sample.
    pub group: f64,
    /// The same in pictures.
    pub group_in_pictures: f64,
    /// Groups of samples whose weight is not above this have no color.
    pub color_above: f64,
    /// Transmittance below which a training ray ends.
    pub stop_below: f64,
    /// Transmittance below which a ray of a picture ends.
    pub stop_below_in_pictures: f64,
    /// Least opacity 1 − exp(−σ · step) of a cell that is sampled, once a stage has been trained.
    pub occupied_above: f64,
    /// Number of steps for which the density is constant. If it is not 0 and there is a visual hull, the density is opaque before the first step; otherwise it is
    /// the authors' random density.
    pub opaque_steps: u64,
    /// Learning rate of planes and lines.
    pub factor_rate: f64,
    /// Learning rate of the matrix B and the network.
    pub network_rate: f64,
    /// Share of the learning rates that is left at the end of the run; they fall exponentially.
    pub last_rate: f64,
    /// Weight of the L1 norm of the density factors, Σ over planes and lines of the mean absolute value, in the first stage.
    pub density_l1: f64,
    /// The same in the other stages.
    pub density_l1_later: f64,
    /// Treatment of rows of planes without a gradient by Adam: true visits only rows with a gradient.
    pub lazy: bool,
    /// Stages, with increasing resolution.
    pub stages: Vec<Stage>,
}

/// The recipe for two cores.
impl Default for Config {
    fn default() -> Self {
        let stages = [(64, 600, 512), (90, 600, 1024), (128, 800, 2048), (180, 1000, 3072), (256, 2000, 4096)];
        Config {
            density_components: 16,
            appearance_components: 48,
            features: 32,
            hidden: 128,
            feature_octaves: 0,
            directions: Directions::Harmonics(3),
            step: 1.0,
            group: 0.04,
            group_in_pictures: 0.02,
            color_above: 1e-3,
            stop_below: 3e-3,
            stop_below_in_pictures: 3e-4,
            occupied_above: 0.01,
            opaque_steps: 50,
            factor_rate: 0.02,
            network_rate: 5e-3,
            last_rate: 0.15,
            density_l1: 8e-5,
            density_l1_later: 4e-5,
            lazy: true,
            stages: stages.map(|(resolution, steps, rays)| Stage { resolution, steps, rays }).to_vec(),
        }
    }
}

impl Config {
    /// Returns the authors' VM-192 for synthetic scenes.
    pub fn authors() -> Self {
        // From 128 to 300 in five steps of equal ratio.
        let stages = [(128, 2000), (152, 1000), (180, 1000), (213, 1500), (253, 1500), (300, 23_000)];
        Config {
            features: 27,
            feature_octaves: 2,
            directions: Directions::Frequency(2),
            step: 0.5,
            group: 0.0,
            group_in_pictures: 0.0,
            color_above: 1e-4,
            stop_below: 0.0,
            stop_below_in_pictures: 0.0,
            opaque_steps: 0,
            network_rate: 1e-3,
            last_rate: 0.1,
            lazy: false,
            stages: stages.map(|(resolution, steps)| Stage { resolution, steps, rays: 4096 }).to_vec(),
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
        for (key, width) in [
            ("density_components", self.density_components),
            ("appearance_components", self.appearance_components),
            ("features", self.features),
            ("hidden", self.hidden),
        ] {
            check((1..=1024).contains(&width), key, width as f64, "1 to 1024")?;
        }
        check(self.feature_octaves <= 16, "feature_octaves", self.feature_octaves as f64, "0 to 16")?;
        let (most, octaves_or_degree) = match self.directions {
            Directions::Frequency(octaves) => (16, octaves),
            Directions::Harmonics(degree) => (3, degree),
        };
        check(octaves_or_degree <= most, "directions", octaves_or_degree as f64, "up to 16 octaves, or harmonics up to degree 3")?;
        check(self.step > 0.0 && self.step.is_finite(), "step", self.step, "a number of cells above 0")?;
        for (key, share) in [
            ("group", self.group),
            ("group_in_pictures", self.group_in_pictures),
            ("color_above", self.color_above),
            ("stop_below", self.stop_below),
            ("stop_below_in_pictures", self.stop_below_in_pictures),
            ("occupied_above", self.occupied_above),
        ] {
            check((0.0..1.0).contains(&share), key, share, "a number in [0, 1)")?;
        }
        for (key, rate) in [("factor_rate", self.factor_rate), ("network_rate", self.network_rate), ("last_rate", self.last_rate)] {
            check(rate > 0.0 && rate <= 1.0, key, rate, "a number in (0, 1]")?;
        }
        for (key, weight) in [("density_l1", self.density_l1), ("density_l1_later", self.density_l1_later)] {
            check((0.0..=1.0).contains(&weight), key, weight, "a number in [0, 1]")?;
        }
        if self.stages.is_empty() {
            return Err(Error::usage("stages", "there is no stage", "set at least one"));
        }
        for (i, stage) in self.stages.iter().enumerate() {
            let key = format!("stages[{i}].resolution");
            check((2..=MOST_NODES).contains(&stage.resolution), &key, stage.resolution as f64, "2 to 4096")?;
            check(stage.steps > 0, &format!("stages[{i}].steps"), 0.0, "at least 1")?;
            check((1..=1 << 20).contains(&stage.rays), &format!("stages[{i}].rays"), stage.rays as f64, "1 to 1048576")?;
        }
        Ok(())
    }

    fn shape(&self) -> Shape {
        Shape {
            density_components: self.density_components,
            appearance_components: self.appearance_components,
            features: self.features,
            hidden: self.hidden,
            feature_octaves: self.feature_octaves,
            directions: self.directions,
        }
    }

    fn total_steps(&self) -> u64 {
        self.stages.iter().map(|stage| stage.steps).sum()
    }
}

/// The model.
#[derive(Debug)]
pub struct Tensorf<T: Real> {
    config: Config,
    field: Factored<T>,
    hull: Hull,
    /// Implementation of rendering.
    pub engine: Engine,
}

impl<T: Real> Module<T> for Tensorf<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.field.visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.field.visit_mut(f);
    }
}

/// Cells that are sampled, as a checkpoint stores them beside their masks.
#[derive(Serialize, Deserialize)]
struct Cells {
    #[serde(rename = "box")]
    aabb: [[f64; 3]; 2],
    cells: [usize; 3],
}

fn corners(aabb: Aabb) -> [[f64; 3]; 2] {
    [aabb.min.to_array(), aabb.max.to_array()]
}

/// Returns the box with these corners, unless it has no volume.
fn valid_box([min, max]: [[f64; 3]; 2]) -> Option<Aabb> {
    let valid = (0..3).all(|a| min[a] < max[a] && min[a].is_finite() && max[a].is_finite());
    valid.then(|| Aabb { min: min.into(), max: max.into() })
}

/// Most nodes along an axis of a cube.
const MOST_NODES: usize = 4096;
/// Cells of the visual hull along each axis.
const HULL: usize = 128;
/// Pixels around the silhouettes that belong to the hull.
const HULL_MARGIN: f64 = 1.0;
/// Most cells of an occupancy along each axis.
const MOST_CELLS: usize = 256;

impl<T: Real> Tensorf<T> {
    /// Creates the model in a box at the resolution of the first stage. `seed` determines the initial parameters.
    ///
    /// Errors name the setting that is invalid.
    pub fn new(config: Config, aabb: Aabb, seed: u64) -> Result<Self> {
        config.validate()?;
        let random = Stream::new(seed);
        let mut field = Factored::new(config.shape(), aabb, nodes_of(aabb, config.stages[0].resolution), &random);
        field.grouping = Grouping { weight: config.group, above: config.color_above };
        field.grouping_in_pictures = Grouping { weight: config.group_in_pictures, above: config.color_above };
        Ok(Tensorf { config, field, hull: Hull::Auto, engine: Engine::Fused })
    }

    /// Sets the use of silhouettes. With [`Hull::Auto`], the default, only cells in the visual hull of the training views are sampled, if they have an alpha
    /// channel.
    pub fn with_hull(self, hull: Hull) -> Self {
        Tensorf { hull, ..self }
    }

    /// Opens a trained model.
    ///
    /// Errors if the file is damaged or holds another kind of model; the error names the file and the problem.
    pub fn open(path: &Path) -> Result<(Self, About)> {
        let config: Config = TensorFile::open(path)?.fact("settings")?;
        // Box, nodes and values are in the file.
        let mut model =
            Tensorf::new(Config { stages: config.stages.iter().copied().take(1).collect(), ..config.clone() }, Aabb::cube(1.0), 0)?;
        model.config = config;
        let about = model.load(path)?;
        Ok((model, about))
    }

    /// Returns the settings of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the field.
    pub fn field(&self) -> &Factored<T> {
        &self.field
    }

    /// Returns the cells whose opacity, or that of a neighbour, is above [`occupied_above`](Config::occupied_above).
    fn occupied(&self) -> Occupancy {
        // An opacity 1 − exp(−σ · step) above a threshold is a density above another.
        let threshold = -(-self.config.occupied_above).ln_1p() / (self.config.step * self.field.cell());
        let cells = self.field.nodes().map(|n| (n - 1).min(MOST_CELLS));
        let density = |positions: &Tensor<T>| self.field.density(positions);
        match &self.field.occupied {
            // Outside of the cells that were sampled, the density has its initial value.
            Some(sampled) => {
                let sampled = sampled.resampled(self.aabb(), cells);
                sampled.dense(threshold, density).dilated(1).intersection(&sampled)
            }
            None => Occupancy::where_dense(self.aabb(), cells, threshold, density).dilated(1),
        }
    }

    fn hull(&self, views: &[View]) -> Option<Occupancy> {
        let hull = || visual_hull::by_footprint(views, self.aabb(), [HULL; 3], HULL_MARGIN, &|_| {}).dilated(1);
        (self.hull == Hull::Auto && has_alpha(views)).then(hull)
    }

    fn render_with(&self, rays: &[Ray], background: [f32; 3], jitter: Jitter, engine: Engine) -> Rendered<T> {
        let config = &self.config;
        let training = matches!(jitter, Jitter::PerRay { .. });
        let options = RenderOptions {
            aabb: self.aabb(),
            spacing: Spacing::Step(config.step * self.field.cell()),
            jitter,
            background,
            occupancy: None,
            engine,
            stop_below: if training { config.stop_below } else { config.stop_below_in_pictures },
        };
        render(&self.field, rays, &options)
    }
}

/// Returns the numbers of nodes of a box with about as many cells as a cube of `resolution` nodes along each axis, with about equal sides.
fn nodes_of(aabb: Aabb, resolution: usize) -> [usize; 3] {
    let extent = aabb.max - aabb.min;
    let side = (extent.x * extent.y * extent.z).cbrt() / (resolution - 1) as f64;
    (extent / side).to_array().map(|cells| cells.round().max(1.0) as usize + 1)
}

/// Learning rate that falls exponentially over a run of `total` steps, of which `first` came before; 0 for the first `frozen` steps of the run.
#[derive(Debug)]
struct Falling {
    rate: f64,
    last: f64,
    first: u64,
    total: u64,
    frozen: u64,
}

impl Schedule for Falling {
    fn at(&self, step: u64) -> f64 {
        let step = self.first + step;
        if step < self.frozen { 0.0 } else { self.rate * self.last.powf(step as f64 / self.total as f64) }
    }
}

impl<T: Real> Model<T> for Tensorf<T> {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn aabb(&self) -> Aabb {
        self.field.aabb()
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T> {
        let engine = if pass.keep_samples { Engine::Graph } else { self.engine };
        self.render_with(rays, pass.background, pass.jitter, engine)
    }

    fn viewer<'a>(&'a self, view: &ViewOptions) -> RenderFn<'a, T> {
        let background = view.background;
        Box::new(move |rays| self.render_with(rays, background, Jitter::None, self.engine))
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let config = &self.config;
        let falling =
            |rate: f64, frozen: u64| Falling { rate, last: config.last_rate, first: stage.first, total: config.total_steps(), frozen };
        let mut rates = Rates::new(falling(config.factor_rate, 0));
        for name in self.field.network_names() {
            rates = rates.with(name, falling(config.network_rate, 0));
        }
        let mut l1 = Vec::new();
        self.field.density_factors().visit(&mut |param| {
            let weight = if stage.index == 0 { config.density_l1 } else { config.density_l1_later };
            l1.push((param.name().to_owned(), weight));
        });
        for (name, _) in &l1 {
            rates = rates.with(name.clone(), falling(config.factor_rate, config.opaque_steps));
        }
        let mode = if config.lazy { AdamMode::Lazy } else { AdamMode::Dense };
        Box::new(Adam::new(rates, mode).betas(0.9, 0.99).epsilon(1e-12).l1(l1))
    }

    fn stages(&self, _: &TrainOptions, _: u64) -> Vec<StageLength> {
        let length =
            |stage: &Stage| StageLength { resolution: Some(stage.resolution), steps: stage.steps, rays_per_step: Some(stage.rays) };
        self.config.stages.iter().map(length).collect()
    }

    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        if stage.index == 0 {
            self.field.occupied = self.hull(rays.all_views());
            // Without a hull, an opaque field would be the whole box, in which nothing is seen.
            if self.field.occupied.is_some() && self.config.opaque_steps > 0 {
                self.field.make_opaque();
            }
        } else {
            let occupied = self.occupied();
            if occupied.fraction() == 0.0 {
                return Err(Error::usage("occupied_above", "no cell is this opaque", "use a smaller opacity"));
            }
            self.field.occupied = Some(occupied);
        }
        if let Some(occupied) = &self.field.occupied {
            rays.aim_at(occupied);
        }
        let aabb = self.field.occupied.as_ref().and_then(Occupancy::bounds).unwrap_or(self.aabb());
        self.field.resample(aabb, nodes_of(aabb, self.config.stages[stage.index].resolution));
        Ok(())
    }

    fn resume(&mut self, _: &PlannedStage, rays: &mut RaySource) {
        if let Some(occupied) = &self.field.occupied {
            rays.aim_at(occupied);
        }
    }

    fn settings(&self) -> Value {
        json!(self.config)
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        file.fact("box", corners(self.aabb()));
        file.fact("nodes", self.field.nodes());
        file.fact("occupied", self.field.occupied.as_ref().map(|cells| Cells { aabb: corners(cells.aabb()), cells: cells.cells() }));
        if let Some(occupied) = &self.field.occupied {
            file.words("occupied", occupied.masks());
        }
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        let (aabb, nodes): ([[f64; 3]; 2], [usize; 3]) = (file.fact("box")?, file.fact("nodes")?);
        let aabb = valid_box(aabb).ok_or_else(|| file.damaged("the box has no volume"))?;
        if nodes.iter().any(|n| !(2..=4 * MOST_NODES).contains(n)) {
            return Err(file.damaged("the number of nodes is not one of this model"));
        }
        self.field.occupied = match file.fact::<Option<Cells>>("occupied")? {
            None => None,
            Some(Cells { aabb, cells }) => {
                let aabb = valid_box(aabb).ok_or_else(|| file.damaged("the box of the occupied cells has no volume"))?;
                if cells.iter().any(|n| !(1..=MOST_CELLS).contains(n)) {
                    return Err(file.damaged("the number of cells is not one of this model"));
                }
                let masks = file.brick_masks("occupied", cells)?;
                let masks = masks.ok_or_else(|| file.damaged("the mask `occupied` has cells outside of the box"))?;
                Some(Occupancy::from_masks(aabb, cells, masks))
            }
        };
        self.field.resample(aabb, nodes);
        let mut done = Ok(());
        self.visit_mut(&mut |param| {
            if done.is_ok() {
                done = file.tensor(param.name(), param.shape()).map(|read| param.replace(read));
            }
        });
        done
    }
}

/// Returns the L1 norm of the density factors: Σ over planes and lines of the mean absolute value.
pub fn density_l1<T: Real>(step: &Step<'_, T, Tensorf<T>>) -> Tensor<T> {
    let mut sum: Option<Tensor<T>> = None;
    step.model.field.density_factors().visit(&mut |param| {
        let mean = param.tensor().abs().mean();
        sum = Some(sum.take().map_or_else(|| mean.clone(), |sum| sum + &mean));
    });
    sum.unwrap_or_else(|| Tensor::zeros(&[]))
}
