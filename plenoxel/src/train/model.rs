//! The seam between a trainer and what it trains.

use super::{About, PlannedStage, TrainOptions};
use crate::camera::Ray;
use crate::error::Result;
use crate::geometry::Aabb;
use crate::rays::RaySource;
use crate::render::Rendered;
use crate::sampling::Jitter;
use crate::tensor_file::{TensorFile, TensorWriter};
use autograd::optim::Optimizer;
use autograd::{Module, Real};
use serde_json::{Map, Value, json};
use std::any::Any;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Progress of a long computation, counted in items, that another thread may read while it goes on.
#[derive(Debug, Default)]
pub struct Progress {
    done: AtomicUsize,
    total: AtomicUsize,
}

impl Progress {
    /// Runs a computation over `total` items, which calls the function it is given with the number of items that are done.
    pub fn of<R>(&self, total: usize, compute: impl FnOnce(&dyn Fn(usize)) -> R) -> R {
        self.done.store(0, Relaxed);
        self.total.store(total, Relaxed);
        let result = compute(&|done| self.done.store(done, Relaxed));
        self.total.store(0, Relaxed);
        result
    }

    /// Returns how many items are done, and of how many; `None` while nothing is computed.
    pub fn now(&self) -> Option<(usize, usize)> {
        let total = self.total.load(Relaxed);
        (total > 0).then(|| (self.done.load(Relaxed).min(total), total))
    }
}

/// A radiance field with a recipe: how it is rendered, how its parameters are learned, and what happens to it at which step.
///
/// A field of your own needs [`kind`](Model::kind), [`aabb`](Model::aabb), [`render`](Model::render) and [`optimizer`](Model::optimizer);
/// `plenoxel/examples/custom_field.rs` is a complete one. Everything else has a default that fits a field whose parameters keep their
/// shapes. [`Trainer`](super::Trainer) trains any model; [`evaluate`](crate::evaluate::evaluate) compares it with photographs.
pub trait Model<T: Real>: Module<T> + Send + Sync {
    /// Name of this kind of model, which checkpoints carry.
    fn kind(&self) -> &'static str;

    /// The box outside of which there is nothing, world coordinates.
    fn aabb(&self) -> Aabb;

    /// Pixels of rays. While a step is recorded, gradients flow from them to the parameters.
    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T>;

    /// A fresh optimizer, made at the beginning of each stage. Its schedules count from the first step of the stage.
    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>>;

    /// A function that renders pictures of the model as it is now: without jitter, and with whatever can be prepared once for many rays. It is
    /// called without recording gradients.
    fn viewer<'a>(&'a self, view: &ViewOptions) -> RenderFn<'a, T> {
        let pass = Pass { background: view.background, jitter: Jitter::None, keep_samples: false, stage: None };
        Box::new(move |rays| self.render(rays, &pass))
    }

    /// Stages of training, in order, where an epoch has `rays_per_epoch` rays: by default a single one of [`TrainOptions::steps`].
    fn stages(&self, options: &TrainOptions, rays_per_epoch: u64) -> Vec<StageLength> {
        let _ = rays_per_epoch;
        vec![StageLength { resolution: None, steps: options.steps }]
    }

    /// Changes the model at the beginning of a stage: resampling, pruning. It may reduce the images and choose the rays of the stage.
    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        let _ = (stage, rays);
        Ok(())
    }

    /// Progress of [`begin_stage`](Model::begin_stage), for a model whose stages may take long to begin: another thread reads it meanwhile. By default there is none.
    fn progress(&self) -> Option<Arc<Progress>> {
        None
    }

    /// Changes the model before a step, whose number counts from the beginning of the stage.
    fn begin_step(&mut self, in_stage: u64) -> Result<()> {
        let _ = in_stage;
        Ok(())
    }

    /// Figures about the model that progress, metrics and reports show, by name: by default the number of its parameters.
    fn facts(&self) -> Vec<(&'static str, f64)> {
        let mut count = 0;
        self.visit(&mut |param| count += param.tensor().len());
        vec![("parameters", count as f64)]
    }

    /// Facts about the trained model, rendered like this, for the final figures of a run (`result.json`): by default its kind and its
    /// [`facts`](Model::facts), under `model`.
    fn figures(&self, view: &ViewOptions) -> Map<String, Value> {
        let _ = view;
        let facts = self.facts().into_iter().map(|(name, value)| (name.to_owned(), json!(value)));
        let model = [("kind".to_owned(), json!(self.kind()))].into_iter().chain(facts).collect();
        [("model".to_owned(), Value::Object(model))].into_iter().collect()
    }

    /// The part of the model that code for one representation can use, by its type: a voxel grid, say, which exports and the page's viewer ask
    /// for. By default there is none.
    fn content(&self) -> Option<&dyn Any> {
        None
    }

    /// A function that renders pictures of the model as it is now, whatever becomes of the model afterwards; `None` if the model does not
    /// support it. A run needs it to compare the models of earlier stages with test views.
    fn frozen(&self, view: &ViewOptions) -> Option<RenderFn<'static, T>> {
        let _ = view;
        None
    }

    /// Settings that must be the same for a saved run to go on.
    fn settings(&self) -> Value {
        Value::Null
    }

    /// Adds everything that [`read`](Model::read) needs: by default the parameters by their names.
    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        self.visit(&mut |param| {
            // The visitor lends each parameter for a moment; their values are shared.
            file.owned(param.name(), param.tensor().detach());
        });
    }

    /// Takes over what [`write`](Model::write) wrote; `stage` is the number of the last step's stage.
    ///
    /// Errors if the file does not hold a model of this shape.
    fn read(&mut self, file: &mut TensorFile<'_>, stage: usize) -> Result<()> {
        let _ = stage;
        let mut done = Ok(());
        self.visit_mut(&mut |param| {
            if done.is_ok() {
                done = file.tensor(param.name(), param.shape()).map(|read| param.update(|values| values.copy_from_slice(read.data())));
            }
        });
        done
    }

    /// Brings the rays of a resumed run to where [`begin_stage`](Model::begin_stage) had brought them.
    fn resume(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        let _ = (stage, rays);
    }

    /// Writes a checkpoint of the trained model, in `f32`, whole or not at all.
    fn save(&self, path: &Path, about: &About) -> Result<()> {
        let mut file = TensorWriter::single();
        file.fact("format", CHECKPOINT_FORMAT);
        file.fact("kind", self.kind());
        file.fact("about", about);
        file.fact("settings", self.settings());
        self.write(&mut file);
        file.write(path)
    }

    /// Takes over the parameters of a checkpoint that [`save`](Model::save) wrote.
    ///
    /// Errors name the file, and what is wrong with it: another kind, other parameters, damage.
    fn load(&mut self, path: &Path) -> Result<About> {
        let mut file = TensorFile::open(path)?;
        check_kind(&file, self.kind())?;
        self.read(&mut file, 0)?;
        file.fact("about")
    }
}

/// A function from rays to the pixels of a model.
pub type RenderFn<'a, T> = Box<dyn Fn(&[Ray]) -> Rendered<T> + Sync + 'a>;

/// Version of the format of checkpoints that [`Model::save`] writes by default.
pub const CHECKPOINT_FORMAT: &str = "plenoxel model 1";

/// Refuses a file of another kind of model.
pub(super) fn check_kind(file: &TensorFile<'_>, kind: &str) -> Result<()> {
    let facts = file.facts()?;
    match facts["kind"].as_str() {
        Some(found) if found == kind => Ok(()),
        found => {
            let found = format!("a model of kind `{}`", found.unwrap_or("none"));
            Err(crate::error::Error::input(file.path(), found, format!("a model of kind `{kind}` is expected")))
        }
    }
}

/// How a model renders a batch of rays.
#[derive(Clone, Debug)]
pub struct Pass {
    /// Color behind the scene, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Random shift of the samples of each ray.
    pub jitter: Jitter,
    /// True if [`Rendered::samples`] will be asked for, which only the graph of small ops keeps.
    pub keep_samples: bool,
    /// Number of the stage of training; `None` for pictures.
    pub stage: Option<usize>,
}

/// How pictures of a model are rendered.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewOptions {
    /// Color behind the scene, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Samples on the longest ray through the box; `None` for the model's own choice.
    pub samples: Option<u32>,
}

impl ViewOptions {
    /// Over this background, with the model's own choice of samples.
    pub fn over(background: [f32; 3]) -> Self {
        ViewOptions { background, samples: None }
    }
}

/// Length of a stage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageLength {
    /// Cells along each axis of what the model stores in this stage, if it stores a grid.
    pub resolution: Option<usize>,
    /// Steps.
    pub steps: u64,
}
