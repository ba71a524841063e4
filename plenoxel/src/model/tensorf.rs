//! TensoRF (Chen et al. 2022): a [factored field](crate::field::factored) with a small color network, trained from coarse to fine.
//!
//! The numbers of [`Config::authors`] are those of the authors' `configs/lego.txt`, `opt.py` and `models/tensoRF.py`, with three exceptions. The
//! cells that are sampled are found anew at the beginning of every stage but the first; the authors find them at steps 2000 and 4000, above
//! 0.08 without the factor 25, and shrink the box. Adam has ε = 1e-12, where PyTorch's default is 1e-8. Learning rates go on falling when the
//! planes become larger; the authors' begin anew.

mod config;
mod recipe;
mod total_variation;

pub use super::stage::Stage;
use config::CoolDown;
pub use config::{Config, Short};

use super::stage::MOST_NODES;
use crate::camera::{Ray, TrackedRays};
use crate::carve::visual_hull;
use crate::dataset::{View, has_alpha};
use crate::error::Result;
use crate::field::factored::Factored;
use crate::field::factored::fused::{self, Densities};
use crate::field::grouping::Grouping;
use crate::geometry::Aabb;
use crate::loss::Step;
use crate::model::cells;
use crate::model::plenoxels::config::Hull;
use crate::model::recipe::Recipe;
use crate::rays::RaySource;
use crate::render::{Engine, Field, RenderOptions, Rendered, ShadedField, render, render_tracked};
use crate::sampling::{Jitter, Occupancy, Spacing};
use crate::space::{Region, Space};
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{About, Model, Pass, PlannedStage, RenderFn, StageLength, TrainOptions, ViewOptions, read_params};
use autograd::optim::{Adam, AdamMode, Optimizer, Rates, Schedule};
use autograd::{Module, Param, Precision, Real, Tensor, random::Stream};
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, OnceLock, PoisonError, RwLock};

/// Kind of this model in checkpoints.
pub const KIND: &str = "tensorf";

/// The model.
#[derive(Debug)]
pub struct Tensorf<T: Real> {
    config: Config,
    /// Cool-down of the learning rates. The current optimizer shares it, so its rates follow a changed plan.
    cooling: Arc<RwLock<CoolDown>>,
    field: Factored<T>,
    space: Space,
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

/// Cells of the visual hull along each axis.
const HULL: usize = 128;
/// Pixels around the silhouettes that belong to the hull.
const HULL_MARGIN: f64 = 1.0;
/// Opacity of a sample that pictures leave out.
const NEGLIGIBLE: f64 = 1e-5;
/// Number of rays that a viewer renders before it computes a table of densities. The computation takes about as long as these rays.
const RAYS_BEFORE_TABLE: usize = 1 << 17;
/// Most cells of an occupancy along each axis.
const MOST_CELLS: usize = 256;

impl<T: Real> Tensorf<T> {
    /// Creates the model in a box of the world, at the resolution of the first stage. `seed` determines the initial parameters.
    ///
    /// Errors name the setting that is invalid.
    pub fn new(config: Config, aabb: Aabb, seed: u64) -> Result<Self> {
        Tensorf::in_region(config, Region { space: Space::Box, aabb }, seed)
    }

    /// Creates the model in a region. Silhouettes are used in [`Space::Box`] only.
    ///
    /// Errors name the setting that is invalid.
    pub fn in_region(config: Config, region: Region, seed: u64) -> Result<Self> {
        config.validate()?;
        let random = Stream::new(seed);
        let Region { space, aabb } = region;
        let mut field = Factored::new(config.shape(), aabb, config.nodes(region, config.stages[0].resolution), &random);
        let grouping = |weight: f64| Grouping { weight, above: config.color_above, compact: config.compact_groups };
        (field.grouping, field.grouping_in_pictures) = (grouping(config.group), grouping(config.group_in_pictures));
        field.gradient_above = config.gradient_above;
        field.set_precision(Precision::mixed_if(config.mixed_precision));
        // In normalized device coordinates, rays are parallel, and no denser near the camera.
        field.gradient_scaling = if matches!(space, Space::Ndc { .. }) { 0.0 } else { config.gradient_scaling };
        let cooling = Arc::new(RwLock::new(config.cooling()));
        Ok(Tensorf { config, cooling, field, space, hull: Hull::Auto, engine: Engine::Fused })
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
        let mut model = Tensorf::new(
            Config { stages: config.stages.iter().copied().take(1).collect(), former_lengths: Vec::new(), ..config.clone() },
            Aabb::cube(1.0),
            0,
        )?;
        model.set_config(config);
        let about = model.load(path)?;
        Ok((model, about))
    }

    /// Returns the settings of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    fn set_config(&mut self, config: Config) {
        *self.cooling.write().unwrap_or_else(PoisonError::into_inner) = config.cooling();
        self.config = config;
    }

    /// Returns the field.
    pub fn field(&self) -> &Factored<T> {
        &self.field
    }

    /// Returns the side of a cell in which distances between samples are counted, in the coordinates of the box.
    fn cell_of_steps(&self) -> f64 {
        // Rays run along the depth of normalized device coordinates.
        if matches!(self.space, Space::Ndc { .. }) { self.field.sides().z } else { self.field.cell() }
    }

    /// Returns true if the fused kernel computes the field.
    fn fuses(&self) -> bool {
        self.config.engine(self.engine) == Engine::Fused
    }

    /// Returns the cells whose opacity, or that of a neighbour, is above [`occupied_above`](Config::occupied_above).
    fn occupied(&self) -> Occupancy {
        // An opacity 1 − exp(−σ · step) above a threshold is a density above another.
        let threshold = -(-self.config.occupied_above).ln_1p() / (self.config.step * self.cell_of_steps());
        let cells = self.field.nodes().map(|n| (n - 1).min(MOST_CELLS));
        let density = |positions: &Tensor<T>| match self.fuses() {
            true => fused::densities_at(&self.field, positions),
            false => self.field.density(positions),
        };
        match &self.field.occupied {
            // Outside of the cells that were sampled, the density has its initial value.
            Some(sampled) => {
                let sampled = sampled.resampled(self.aabb(), cells);
                sampled.dense(threshold, density).dilated(1).intersection(&sampled)
            }
            None => Occupancy::where_dense(self.aabb(), cells, threshold, density).dilated(1),
        }
    }

    /// Returns the region of the cells that are sampled.
    fn sampled(&self) -> Region {
        let aabb = self.field.occupied.as_ref().and_then(Occupancy::bounds).unwrap_or(self.aabb());
        Region { space: self.space, aabb }
    }

    fn hull(&self, views: &[View]) -> Option<Occupancy> {
        let hull = || visual_hull::by_footprint(views, self.aabb(), [HULL; 3], HULL_MARGIN, &|_| {}).dilated(1);
        (self.hull == Hull::Auto && self.space == Space::Box && has_alpha(views)).then(hull)
    }

    /// Restricts rays to the pixels that show occupied cells.
    fn aim(&self, rays: &mut RaySource) {
        if let (Space::Box, Some(occupied)) = (self.space, &self.field.occupied) {
            rays.aim_at(occupied);
        }
    }

    fn options(&self, pass: &Pass) -> RenderOptions<'static> {
        let config = &self.config;
        let training = matches!(pass.jitter, Jitter::PerRay { .. });
        let step = if training { config.step } else { config.step_in_pictures } * self.cell_of_steps();
        RenderOptions {
            aabb: self.aabb(),
            spacing: Spacing::even(self.space, step),
            jitter: pass.jitter,
            background: pass.background,
            occupancy: None,
            engine: if pass.keep_samples { Engine::Graph } else { self.engine },
            stop_below: if training { config.stop_below } else { config.stop_below_in_pictures },
        }
    }
}

/// Learning rate that falls exponentially over a run, of which `first` steps came before, and that also [cools down](CoolDown); 0 for the first `frozen` steps of
/// the run.
#[derive(Debug)]
struct Falling {
    rate: f64,
    last: f64,
    first: u64,
    cooling: Arc<RwLock<CoolDown>>,
    frozen: u64,
}

impl Schedule for Falling {
    fn at(&self, step: u64) -> f64 {
        let step = self.first + step;
        if step < self.frozen {
            return 0.0;
        }
        let cooling = self.cooling.read().unwrap_or_else(PoisonError::into_inner);
        cooling.at(step) * self.rate * self.last.powf(step as f64 / cooling.steps() as f64)
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
        render(&self.field, &self.space.rays(rays), &self.options(pass))
    }

    fn viewer<'a>(&'a self, view: &ViewOptions) -> RenderFn<'a, T> {
        let pass = Pass { background: view.background, jitter: Jitter::None, keep_samples: false, stage: None };
        let fuses = self.fuses();
        let options = self.options(&pass);
        let negligible = NEGLIGIBLE / (self.config.step_in_pictures * self.cell_of_steps());
        let (rendered, densities) = (AtomicUsize::new(0), OnceLock::new());
        Box::new(move |rays| {
            let many = rendered.fetch_add(rays.len(), Relaxed) >= RAYS_BEFORE_TABLE;
            let densities = if fuses && many { densities.get_or_init(|| Densities::new(&self.field, negligible)).as_ref() } else { None };
            match densities {
                Some(densities) => fused::render_picture(&self.field, densities, &self.space.rays(rays), &options),
                None => self.render(rays, &pass),
            }
        })
    }

    fn tracks_rays(&self) -> bool {
        true
    }

    fn render_tracked(&self, rays: &TrackedRays<T>, pass: &Pass) -> Rendered<T> {
        render_tracked(&self.field, &self.space.tracked(rays), &self.options(pass))
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let config = &self.config;
        let falling =
            |rate: f64, frozen: u64| Falling { rate, last: config.last_rate, first: stage.first, cooling: self.cooling.clone(), frozen };
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
            rates = rates.with(name.clone(), falling(config.factor_rate, config.frozen_steps));
        }
        let mode = if config.lazy { AdamMode::Lazy } else { AdamMode::Dense };
        Box::new(Adam::new(rates, mode).betas(0.9, 0.99).epsilon(1e-12).l1(l1))
    }

    fn stages(&self, _: &TrainOptions, _: u64) -> Vec<StageLength> {
        self.config.lengths(self.space)
    }

    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        if stage.index == 0 {
            self.field.occupied = self.hull(rays.all_views());
            let Config { frozen_steps, initial_density, .. } = self.config;
            // Without a hull, an opaque field would be the whole box, in which nothing is seen.
            if self.field.occupied.is_some() && frozen_steps > 0 {
                self.field.make_opaque();
            } else if initial_density > 0.0 {
                self.field.make_fog(initial_density);
            }
        } else {
            // A field that is still thin everywhere, after few steps, keeps the cells that were sampled.
            let occupied = self.occupied();
            if occupied.fraction() > 0.0 {
                self.field.occupied = Some(occupied);
            }
        }
        self.aim(rays);
        let region = self.sampled();
        let resolution = self.config.bounded(self.config.stages[stage.index].resolution, region, rays.all_views());
        self.field.resample(region.aabb, self.config.nodes(region, resolution));
        Ok(())
    }

    fn resume(&mut self, _: &PlannedStage, rays: &mut RaySource) {
        self.aim(rays);
    }

    fn shaded(&self) -> Option<&dyn ShadedField<T>> {
        Some(&self.field)
    }

    fn space(&self) -> Space {
        self.space
    }

    fn settings(&self) -> Value {
        json!(self.config)
    }

    /// A plan may have changed after the run was saved.
    fn continues(&self, saved: &Value, steps: u64) -> bool {
        Config::deserialize(saved).is_ok_and(|saved| self.config.begins_as(&saved, steps))
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        cells::write_box(self.aabb(), file);
        file.fact("space", self.space);
        file.fact("nodes", self.field.nodes());
        cells::write(self.field.occupied.as_ref(), file);
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        let (aabb, nodes): (Aabb, [usize; 3]) = (cells::read_box(file)?, file.fact("nodes")?);
        if nodes.iter().any(|n| !(2..=4 * MOST_NODES).contains(n)) {
            return Err(file.damaged("the number of nodes is not one of this model"));
        }
        // Checkpoints without a space are of a box.
        self.space = file.fact::<Option<Space>>("space")?.unwrap_or_default();
        self.field.occupied = cells::read(file)?;
        self.field.resample(aabb, nodes);
        read_params(self, file)
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
