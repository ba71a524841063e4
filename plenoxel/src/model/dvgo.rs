//! DirectVoxGO (Sun et al. 2022): [dense grids](crate::field::dvgo). A coarse stage with colors that do not depend on the view finds box and
//! occupied cells; fine stages with a small color network follow.
//!
//! The method is that of the authors' second program (`configs/default.py`, `run.py`, `lib/dvgo.py`), except:
//!
//! * The coarse stage has the model's box. The authors take a box around the view frusta, and empty the voxels near the cameras.
//! * Every parameter has a masked Adam, by rows: rows that no sample reads keep their values and moments. The authors' coarse stage has the
//!   dense Adam.
//! * A node counts as seen by the views in whose image it projects (`dvgo/views.rs`).
//! * The first and the last sample of a ray represent the rest of the chord, as everywhere in this crate.
//! * Fine stages draw rays from the tiles of pixels that may show an occupied cell. The authors test each ray.

pub mod config;
mod recipe;
mod views;

use crate::camera::Ray;
use crate::error::{Error, Result};
use crate::field::dvgo::{ColorNetwork, DENSITY, DenseGrid, FEATURES, shift_of};
use crate::field::grouping::Grouping;
use crate::geometry::Aabb;
use crate::loss::{Objective, entropy, mse, sample_color};
use crate::model::cells;
use crate::rays::RaySource;
use crate::render::{Engine, Field, RenderOptions, Rendered, ShadedField, render};
use crate::sampling::{Occupancy, Spacing};
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{About, Model, Pass, PlannedStage, StageLength, TrainOptions, read_params, same_settings};
use autograd::optim::{Adam, AdamMode, Optimizer, Piecewise, Rates, Scaled, Schedule};
use autograd::{Module, Param, Precision, Real, Tensor, random::Stream};
pub use config::{Config, Stage};
use serde_json::{Value, json};
use std::path::Path;

/// Kind of this model in checkpoints.
pub const KIND: &str = "dvgo";

/// The model.
#[derive(Debug)]
pub struct Dvgo<T: Real> {
    config: Config,
    seed: u64,
    field: DenseGrid<T>,
    /// Learning rate of each node's density in units of the common rate: the number of views that see it, over the largest number; `None` in the fine stages.
    view_rates: Option<Tensor<T>>,
    /// Number of steps of the fine stages before the current stage; `None` in the coarse stage.
    fine_steps: Option<u64>,
    /// Implementation of rendering.
    pub engine: Engine,
}

impl<T: Real> Module<T> for Dvgo<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.field.visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.field.visit_mut(f);
    }
}

/// Returns the side of a voxel, world length, of a box with as many voxels as a cube of `resolution` voxels along each axis.
fn voxel(aabb: Aabb, resolution: usize) -> f64 {
    aabb.volume().cbrt() / resolution as f64
}

/// Creates the field of the coarse stage: its tables are zero.
fn coarse_field<T: Real>(config: &Config, aabb: Aabb, nodes: [usize; 3]) -> DenseGrid<T> {
    let unit = voxel(aabb, config.coarse.resolution);
    let mut field = DenseGrid::new(aabb, nodes, 3, None, shift_of(config.coarse_opacity), unit);
    field.opacity_above = config.coarse_above;
    let grouping = Grouping { above: config.coarse_above, ..Grouping::NONE };
    (field.grouping, field.grouping_in_pictures) = (grouping, grouping);
    field
}

/// Creates a field of the fine stages: its tables are zero, and its network is random.
fn fine_field<T: Real>(config: &Config, aabb: Aabb, nodes: [usize; 3], seed: u64) -> DenseGrid<T> {
    let Config { features, directions, hidden, depth, .. } = *config;
    let mut network = ColorNetwork::new(features, directions, hidden, depth, &Stream::new(seed));
    network.layers.precision = Precision::mixed_if(config.mixed_precision);
    let unit = voxel(aabb, config.fine[config.fine.len() - 1].resolution);
    let mut field = DenseGrid::new(aabb, nodes, features, Some(network), shift_of(config.fine_opacity), unit);
    field.opacity_above = config.fine_above;
    let grouping = |weight: f64| Grouping { weight, above: config.fine_above, compact: false };
    (field.grouping, field.grouping_in_pictures) = (grouping(config.group), grouping(config.group_in_pictures));
    field
}

impl<T: Real> Dvgo<T> {
    /// Creates the model of the coarse stage in a box. `seed` determines the initial parameters of the network.
    ///
    /// Errors name the setting that is invalid.
    pub fn new(config: Config, aabb: Aabb, seed: u64) -> Result<Self> {
        config.validate()?;
        let field = coarse_field(&config, aabb, aabb.nodes(config.coarse.resolution));
        Ok(Dvgo { config, seed, field, view_rates: None, fine_steps: None, engine: Engine::Fused })
    }

    /// Opens a trained model.
    ///
    /// Errors if the file is damaged or holds another kind of model; the error names the file and the problem.
    pub fn open(path: &Path) -> Result<(Self, About)> {
        let config: Config = TensorFile::open(path)?.fact("settings")?;
        // Box, nodes and values are in the file.
        let small = Config { coarse: Stage { resolution: 2, ..config.coarse }, ..config.clone() };
        let mut model = Dvgo::new(small, Aabb::cube(1.0), 0)?;
        model.config = config;
        let about = model.load(path)?;
        Ok((model, about))
    }

    /// Returns the settings of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the field.
    pub fn field(&self) -> &DenseGrid<T> {
        &self.field
    }

    /// Returns the side of a voxel of the current grid, world length.
    fn voxel(&self) -> f64 {
        (self.field.aabb().volume() / self.field.nodes().iter().product::<usize>() as f64).cbrt()
    }

    /// Returns the cells around the nodes.
    fn cells(&self) -> (Aabb, [usize; 3]) {
        let (aabb, nodes) = self.field.cells_around_nodes();
        (aabb, nodes.map(|n| n.min(cells::MOST)))
    }

    /// Returns the cells among those that are sampled in which the opacity of a voxel is above a threshold.
    ///
    /// Errors if there is none; `key` is the setting that has the threshold.
    fn opaque(&self, key: &str, opacity: f64) -> Result<Occupancy> {
        // The opacity of a length is above a threshold where the density is above another.
        let threshold = -(-opacity).ln_1p() / self.voxel();
        let density = |positions: &Tensor<T>| self.field.density(positions);
        let (aabb, cells) = self.cells();
        let found = match &self.field.occupied {
            Some(sampled) => sampled.resampled(aabb, cells).dense(threshold, density),
            None => Occupancy::where_dense(aabb, cells, threshold, density),
        };
        match found.bounds() {
            Some(_) => Ok(found),
            None => Err(Error::usage(
                key,
                "no voxel is this opaque, so the training has learned nothing yet",
                "use more steps, more --time, or a smaller opacity",
            )),
        }
    }

    /// Leaves out the cells whose voxel and neighbours are transparent.
    fn prune(&mut self) -> Result<()> {
        let (aabb, cells) = self.cells();
        let opaque = self.opaque("dvgo.fine_above", self.config.fine_above)?.dilated(1);
        self.field.occupied = Some(match &self.field.occupied {
            Some(sampled) => opaque.intersection(&sampled.resampled(aabb, cells)),
            None => opaque,
        });
        Ok(())
    }

    /// Counts the views that see the nodes of the coarse grid. Returns the cells that enough of them see.
    fn count_views(&mut self, rays: &RaySource) -> Occupancy {
        let counts = views::seeing(rays.all_views(), self.field.aabb(), self.field.nodes());
        let most = counts.iter().max().copied().unwrap_or(0).max(1);
        let rates = counts.iter().map(|&count| T::lit(f64::from(count) / f64::from(most))).collect();
        self.view_rates = Some(Tensor::from_vec(rates, &[counts.len(), 1]));
        let seen: Vec<bool> = counts.iter().map(|&count| count >= self.config.least_views).collect();
        let (aabb, nodes) = self.field.cells_around_nodes();
        Occupancy::new(aabb, nodes, &seen)
    }

    /// Replaces the coarse field by a fine one in the box of what is opaque.
    fn begin_fine(&mut self) -> Result<()> {
        let opaque = self.opaque("dvgo.occupied_above", self.config.occupied_above)?;
        let tight = opaque.bounds().unwrap_or(self.field.aabb());
        let more = 0.5 * (self.config.box_scale - 1.0) * (tight.max - tight.min);
        let aabb = Aabb { min: tight.min - more, max: tight.max + more };
        self.field = fine_field(&self.config, aabb, aabb.nodes(self.config.fine[0].resolution), self.seed);
        let (aabb, cells) = self.cells();
        self.field.occupied = Some(opaque.dilated(1).resampled(aabb, cells));
        self.view_rates = None;
        Ok(())
    }
}

/// Learning rate that falls to a tenth in a number of steps.
#[derive(Debug)]
struct Falling {
    rate: f64,
    tenth_every: u64,
}

impl Schedule for Falling {
    fn at(&self, step: u64) -> f64 {
        self.rate * 0.1f64.powf(step as f64 / self.tenth_every as f64)
    }
}

impl<T: Real> Model<T> for Dvgo<T> {
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
        let options = RenderOptions {
            aabb: self.aabb(),
            spacing: Spacing::Step(self.config.step * self.voxel()),
            jitter: pass.jitter,
            background: pass.background,
            occupancy: None,
            engine: self.engine,
            stop_below: self.config.stop_below,
        };
        render(&self.field, rays, &options)
    }

    fn optimizer(&self, _: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let Config { grid_rate, network_rate, tenth_every, .. } = self.config;
        let falling = |rate: f64| Falling { rate, tenth_every };
        let rates = Rates::new(falling(network_rate)).with(DENSITY, falling(grid_rate)).with(FEATURES, falling(grid_rate));
        let adam = Adam::new(rates, AdamMode::Lazy).betas(0.9, 0.99);
        match &self.view_rates {
            None => Box::new(adam),
            Some(of_nodes) => Box::new(Scaled::new(adam, DENSITY, of_nodes.clone())),
        }
    }

    fn stages(&self, _: &TrainOptions, _: u64) -> Vec<StageLength> {
        self.config.lengths()
    }

    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        match stage.index {
            0 => self.field.occupied = Some(self.count_views(rays)),
            1 => self.begin_fine()?,
            _ => {
                let aabb = self.aabb();
                self.field.resample(aabb, aabb.nodes(self.config.fine[stage.index - 1].resolution));
                self.prune()?;
                self.field.shift -= self.config.shift_fall;
            }
        }
        self.aim(stage, rays);
        Ok(())
    }

    fn begin_step(&mut self, in_stage: u64) -> Result<()> {
        let every = self.config.prune_every;
        match self.fine_steps {
            Some(before) if every > 0 && (before + in_stage) % every == every / 2 => self.prune(),
            _ => Ok(()),
        }
    }

    fn resume(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        if stage.index == 0 {
            self.count_views(rays);
        }
        self.aim(stage, rays);
    }

    fn settings(&self) -> Value {
        json!(self.config)
    }

    fn continues(&self, saved: &Value, _: u64) -> bool {
        same_settings(&self.config, saved)
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        cells::write_box(self.aabb(), file);
        file.fact("nodes", self.field.nodes());
        file.fact("fine", self.field.network().is_some());
        file.fact("shift", self.field.shift);
        file.fact("unit", self.field.unit);
        cells::write(self.field.occupied.as_ref(), file);
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        let (aabb, nodes): (Aabb, [usize; 3]) = (cells::read_box(file)?, file.fact("nodes")?);
        // Before tables of this size are created, the file must be found to have them.
        let rows = nodes.iter().try_fold(1usize, |rows, &n| rows.checked_mul(n));
        if nodes.iter().any(|&n| n < 2) || rows.is_none_or(|rows| !file.tensors().contains(&(DENSITY.to_owned(), vec![rows, 1]))) {
            return Err(file.damaged("the number of nodes does not fit the density"));
        }
        self.field = match file.fact("fine")? {
            true => fine_field(&self.config, aabb, nodes, self.seed),
            false => coarse_field(&self.config, aabb, nodes),
        };
        (self.field.shift, self.field.unit) = (file.fact("shift")?, file.fact("unit")?);
        let positive = self.field.unit > 0.0 && self.field.unit.is_finite();
        if !(positive && self.field.shift.is_finite()) {
            return Err(file.damaged("the density has no unit"));
        }
        self.field.occupied = cells::read(file)?;
        read_params(self, file)
    }
}

impl<T: Real> Dvgo<T> {
    /// Restricts the rays of a fine stage to those that may hit occupied cells.
    fn aim(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        self.fine_steps = (stage.index > 0).then(|| stage.first - self.config.coarse.steps);
        if let Some(occupied) = self.field.occupied.as_ref().filter(|_| stage.index > 0) {
            rays.aim_at(occupied);
        }
    }
}

/// Adds the authors' losses beside the mean squared error: the entropy of opacities and the errors of the colors of single samples.
pub fn own_losses<T: Real>(config: &Config, objective: Objective<T, Dvgo<T>>) -> Objective<T, Dvgo<T>> {
    let weight = |[coarse, fine]: [f64; 2]| Piecewise::new(coarse).then(config.coarse.steps, fine);
    objective.with("dvgo_entropy", weight(config.entropy), entropy).with_samples("sample_color", weight(config.sample_color), sample_color)
}

/// Returns the authors' objective: the mean squared error and [`own_losses`].
pub fn objective<T: Real>(config: &Config) -> Objective<T, Dvgo<T>> {
    own_losses(config, Objective::new().with("mse", 1.0, mse))
}
