//! Interface between the trainer and a model.

use super::{About, PlannedStage, TrainOptions};
use crate::camera::{Ray, TrackedRays};
use crate::error::Result;
use crate::geometry::Aabb;
use crate::rays::RaySource;
use crate::render::picture::TILE;
use crate::render::{Rendered, ShadedField};
use crate::sampling::Jitter;
use crate::space::Space;
use crate::tensor_file::{TensorFile, TensorWriter};
use autograd::optim::Optimizer;
use autograd::{Module, Real};
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use std::any::Any;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Progress of a long computation in [`Model::begin_stage`], counted in items, that another thread may read while it goes on.
#[derive(Debug, Default)]
pub struct StageProgress {
    done: AtomicUsize,
    total: AtomicUsize,
}

impl StageProgress {
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

/// A radiance field with a training recipe: how it is rendered, how its parameters are optimized, and how it changes during training.
///
/// A field of your own must implement [`kind`](Model::kind), [`aabb`](Model::aabb), [`render`](Model::render) and
/// [`optimizer`](Model::optimizer); `plenoxel/examples/custom_field.rs` is a complete example. All other methods have defaults for fields
/// whose parameters keep their shapes. [`Trainer`](super::Trainer) trains any model; [`evaluate`](crate::evaluate::evaluate) compares it
/// with photographs.
pub trait Model<T: Real>: Module<T> + Send + Sync {
    /// Returns the name of this kind of model, which checkpoints store.
    fn kind(&self) -> &'static str;

    /// Returns the bounding box of the model in world coordinates. Space outside of it is empty.
    fn aabb(&self) -> Aabb;

    /// Renders rays. While a step is recorded, gradients flow from the result to the parameters.
    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T>;

    /// Returns true if [`render_tracked`](Model::render_tracked) gives gradients to rays, which the refinement of camera poses needs. Default: false.
    fn tracks_rays(&self) -> bool {
        false
    }

    /// Renders rays like [`render`](Model::render). Gradients also flow to the origins and directions of the rays, if
    /// [`tracks_rays`](Model::tracks_rays) returns true. Default: no gradient flows to the rays.
    fn render_tracked(&self, rays: &TrackedRays<T>, pass: &Pass) -> Rendered<T> {
        self.render(&rays.rays, pass)
    }

    /// Creates the optimizer of a stage; schedules count from the stage's first step. It is called at the beginning of each stage, after
    /// [`begin_stage`](Model::begin_stage) or [`resume`](Model::resume).
    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>>;

    /// Returns a function that renders images of the current model, without jitter. It may precompute data for many rays. It is called
    /// without recording gradients. The pixels need not have a [sparsity](Rendered::sparsity).
    fn viewer<'a>(&'a self, view: &ViewOptions) -> RenderFn<'a, T> {
        let pass = Pass { background: view.background, jitter: Jitter::None, keep_samples: false, stage: None };
        Box::new(move |rays| self.render(rays, &pass))
    }

    /// Returns the side of the tiles of pixels that images of the model are rendered in. Larger tiles take more memory, but threads wait less for each other.
    fn tile(&self) -> usize {
        TILE
    }

    /// Returns the stages of training, in order, for epochs of `rays_per_epoch` rays. Default: a single stage of [`TrainOptions::steps`]
    /// steps.
    fn stages(&self, options: &TrainOptions, rays_per_epoch: u64) -> Vec<StageLength> {
        let _ = rays_per_epoch;
        vec![StageLength { resolution: None, steps: options.steps, rays_per_step: None, ray_cost: 1.0 }]
    }

    /// Changes the model at the beginning of a stage, for example by resampling or pruning. It may reduce the images and restrict the rays
    /// of the stage.
    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        let _ = (stage, rays);
        Ok(())
    }

    /// Returns the progress of [`begin_stage`](Model::begin_stage), which another thread reads, for a model whose stages may take long to begin. The default is `None`.
    fn progress(&self) -> Option<Arc<StageProgress>> {
        None
    }

    /// Changes the model before a step. `in_stage` counts from the beginning of the stage.
    fn begin_step(&mut self, in_stage: u64) -> Result<()> {
        let _ = in_stage;
        Ok(())
    }

    /// Returns named figures about the model, for progress, metrics and reports. Default: the number of its parameters.
    fn facts(&self) -> Vec<(&'static str, f64)> {
        let mut count = 0;
        self.visit(&mut |param| count += param.tensor().len());
        vec![("parameters", count as f64)]
    }

    /// Returns facts about the trained model, rendered with `view`, for the final figures of a run (`result.json`). Default: an entry
    /// `model` with its kind and its [`facts`](Model::facts).
    fn figures(&self, view: &ViewOptions) -> Map<String, Value> {
        let _ = view;
        let facts = self.facts().into_iter().map(|(name, value)| (name.to_owned(), json!(value)));
        let model = [("kind".to_owned(), json!(self.kind()))].into_iter().chain(facts).collect();
        [("model".to_owned(), Value::Object(model))].into_iter().collect()
    }

    /// Returns the representation of the model, for code that needs a certain type. Exports need a voxel grid, for example. Default: none.
    fn content(&self) -> Option<&dyn Any> {
        None
    }

    /// Returns the field from which a voxel grid can be [baked](crate::bake), for exports and the viewer of the report. Default: none.
    fn shaded(&self) -> Option<&dyn ShadedField<T>> {
        None
    }

    /// Returns the space of the model's box: [`content`](Model::content) and [`shaded`](Model::shaded) are functions of positions in this box. Default: a box of
    /// the world.
    fn space(&self) -> Space {
        Space::Box
    }

    /// Returns a function that renders images of the current model and stays valid when the model changes; `None` if not supported. A run
    /// uses it to compare the models of earlier stages with test views.
    fn frozen(&self, view: &ViewOptions) -> Option<RenderFn<'static, T>> {
        let _ = view;
        None
    }

    /// Returns the settings that must match when a saved run is resumed.
    fn settings(&self) -> Value {
        Value::Null
    }

    /// Returns true if a run that was saved after `steps` steps, when the settings of its model were `saved`, goes on with the settings of this model. Default:
    /// they are the same.
    fn continues(&self, saved: &Value, steps: u64) -> bool {
        let _ = steps;
        self.settings() == *saved
    }

    /// Writes everything that [`read`](Model::read) needs. Default: the parameters by name.
    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        self.visit(&mut |param| {
            // The visitor borrows each parameter only briefly, so the values are shared.
            file.owned(param.name(), param.tensor().detach());
        });
    }

    /// Restores the state that [`write`](Model::write) wrote. `stage` is the number of the last step's stage.
    ///
    /// Errors if the state does not fit this model.
    fn read(&mut self, file: &mut TensorFile<'_>, stage: usize) -> Result<()> {
        let _ = stage;
        read_params(self, file)
    }

    /// Restores the rays of a resumed run, and everything that [`read`](Model::read) does not restore, to the state after
    /// [`begin_stage`](Model::begin_stage).
    fn resume(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        let _ = (stage, rays);
    }

    /// Writes a checkpoint of the trained model, in `f32`. The file is written atomically.
    fn save(&self, path: &Path, about: &About) -> Result<()> {
        let mut file = TensorWriter::single();
        file.fact("format", CHECKPOINT_FORMAT);
        file.fact("kind", self.kind());
        file.fact("about", about);
        file.fact("settings", self.settings());
        self.write(&mut file);
        file.write(path)
    }

    /// Loads the parameters of a checkpoint that [`save`](Model::save) wrote.
    ///
    /// Errors if the file is damaged, or has another kind of model or other parameters; the error names the file and the problem.
    fn load(&mut self, path: &Path) -> Result<About> {
        let mut file = TensorFile::open(path)?;
        check_kind(&file, self.kind())?;
        self.read(&mut file, 0)?;
        file.fact("about")
    }
}

/// Returns true if the settings of a saved run are these. A setting that the saved run did not have yet counts as its default.
pub fn same_settings<C: DeserializeOwned + PartialEq>(settings: &C, saved: &Value) -> bool {
    C::deserialize(saved).is_ok_and(|saved| saved == *settings)
}

/// Reads the values of all parameters by name.
///
/// Errors if the file lacks a parameter, or has it in another shape.
pub fn read_params<T: Real, M: Module<T> + ?Sized>(module: &mut M, file: &mut TensorFile<'_>) -> Result<()> {
    let mut done = Ok(());
    module.visit_mut(&mut |param| {
        if done.is_ok() {
            done = file.tensor(param.name(), param.shape()).map(|read| param.update(|values| values.copy_from_slice(read.data())));
        }
    });
    done
}

/// Function from rays to the rendered pixels of a model.
pub type RenderFn<'a, T> = Box<dyn Fn(&[Ray]) -> Rendered<T> + Sync + 'a>;

/// Format version of the checkpoints that [`Model::save`] writes by default.
pub const CHECKPOINT_FORMAT: &str = "plenoxel model 1";

/// Errors if the file holds another kind of model.
pub(super) fn check_kind(file: &TensorFile<'_>, kind: &str) -> Result<()> {
    let facts = file.facts()?;
    match facts["kind"].as_str() {
        Some(found) if found == kind => Ok(()),
        found => {
            let found = format!("the file holds a model of kind `{}`", found.unwrap_or("none"));
            Err(crate::error::Error::input(file.path(), found, format!("use a model of kind `{kind}`")))
        }
    }
}

/// Options for rendering a batch of rays.
#[derive(Clone, Debug)]
pub struct Pass {
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Random shift of the samples of each ray.
    pub jitter: Jitter,
    /// True if [`Rendered::samples`] will be read. Only the graph of small ops keeps the samples.
    pub keep_samples: bool,
    /// Number of the training stage; `None` when rendering images.
    pub stage: Option<usize>,
}

/// Options for rendering images of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewOptions {
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Number of samples on the longest ray through the box; `None` for the model's default.
    pub samples: Option<u32>,
}

impl ViewOptions {
    /// Returns options with this background and the model's default sampling.
    pub fn over(background: [f32; 3]) -> Self {
        ViewOptions { background, samples: None }
    }
}

/// Length of a stage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageLength {
    /// Resolution of the model's grid along each axis during this stage, if it has one.
    pub resolution: Option<usize>,
    /// Number of steps.
    pub steps: u64,
    /// Number of rays per step; `None` for [`TrainOptions::rays_per_step`].
    pub rays_per_step: Option<usize>,
    /// Expected duration of a ray, in a unit that is the same for all stages. Estimates of the remaining time use it.
    pub ray_cost: f64,
}
