//! Settings of the models that have a table of their own in the configuration of a run, named by their kind: `[tensorf]`, for example.

use super::{dvgo, nerf, ngp, tensorf};
use crate::dataset::View;
use crate::error::{Error, Result};
use crate::loss::Objective;
use crate::model::Model;
use crate::model::plenoxels::config::Config;
use crate::render::Engine;
use crate::space::Region;
use crate::tensor_file::TensorFile;
use crate::train::StageLength;

/// Settings from which a run trains a model.
pub trait Recipe: Send + Sync {
    /// The model.
    type Model: Model<f32> + 'static
    where
        Self: Sized;

    /// Returns the kind of the model, which is also the key of these settings in the configuration.
    fn kind(&self) -> &'static str;

    /// Checks the settings.
    ///
    /// Errors name the setting that is invalid.
    fn validate(&self) -> Result<()>;

    /// Returns warnings about settings that are valid, but slow. `engine` is that of the configuration. Default: none.
    fn warnings(&self, _engine: Engine) -> Vec<String> {
        Vec::new()
    }

    /// Returns the stages of training.
    fn stages(&self) -> Vec<StageLength>;

    /// Returns true if the model uses silhouettes.
    fn uses_silhouettes(&self) -> bool;

    /// Returns true if the model gives gradients to rays, so that poses can be refined ([`Model::tracks_rays`]). Default: false.
    fn tracks_rays(&self) -> bool {
        false
    }

    /// Returns the memory of the model.
    fn memory(&self, engine: Engine) -> Memory;

    /// Creates the model in a region, with the seed, hull and engine of a configuration.
    ///
    /// Errors: a setting is invalid, which the error names; the model is not trained in this space.
    fn model(&self, config: &Config, region: Region) -> Result<Self::Model>
    where
        Self: Sized;

    /// Adds the losses that belong to the model to those of the configuration.
    fn own_losses(&self, objective: Objective<f32, Self::Model>) -> Objective<f32, Self::Model>
    where
        Self: Sized,
    {
        objective
    }

    /// Returns from which step on the steps of the first stage tell the speed of a machine, and the cost of such a step, in units of
    /// [`with_cost`](Recipe::with_cost). `model` has begun its first stage.
    fn measured_step(&self, model: &Self::Model) -> (u64, f64)
    where
        Self: Sized;

    /// Returns these settings with sizes that fit the training views: a plan must know them. `model` has begun its first stage. Default: the same settings.
    fn fitted_to(self, model: &Self::Model, views: &[View]) -> Self
    where
        Self: Sized,
    {
        let _ = (model, views);
        self
    }

    /// Returns settings whose steps cost this much in total: the same training, longer or shorter. `model` has begun its first stage. If the run keeps the `taken`
    /// steps that the model has taken, the first stage must be longer than these.
    fn with_cost(&self, model: &Self::Model, cost: f64, taken: u64) -> Self
    where
        Self: Sized;

    /// Returns a guess of the settings that a plan for `seconds` will have, apart from lengths and sizes, and the duration of a step with them relative to one
    /// with these settings. If the guess is right, the steps that measure the speed belong to the plan. Default: these settings.
    fn likely_for(&self, seconds: f64) -> (Self, f64)
    where
        Self: Sized + Clone,
    {
        let _ = seconds;
        (self.clone(), 1.0)
    }

    /// Returns true if training with these settings has the same first `steps` steps as training with `other`. Default: false.
    fn begins_as(&self, other: &Self, steps: u64) -> bool
    where
        Self: Sized,
    {
        let _ = (other, steps);
        false
    }

    /// Returns the number of first steps during which the stages to come may change; 0 if they may not. Default: 0.
    fn adjusted_until(&self) -> u64 {
        0
    }

    /// Returns these settings, which are those of a plan for `asked`, with other stages to come: the steps after the first `taken` cost `left`, in units of
    /// [`with_cost`](Recipe::with_cost), or come as near as they can while the first `taken` steps stay the same. Called if
    /// [`adjusted_until`](Recipe::adjusted_until) is not 0. Default: these settings.
    fn with_left(&self, asked: &Self, model: &Self::Model, left: f64, taken: u64) -> Self
    where
        Self: Sized + Clone,
    {
        let _ = (asked, model, left, taken);
        self.clone()
    }

    /// Replaces the settings of a model by these, which [begin as](Recipe::begins_as) the former do. The default does nothing.
    fn change(self, model: &mut Self::Model)
    where
        Self: Sized,
    {
        let _ = model;
    }

    /// Puts the settings into a configuration.
    fn set(self, config: &mut Config)
    where
        Self: Sized;
}

/// Memory of a model, in bytes.
#[derive(Clone, Copy, Debug)]
pub struct Memory {
    /// Parameters, in the stage that has the most.
    pub parameters: u64,
    /// Values of a ray that a step keeps.
    pub ray: u64,
    /// Values of a ray of a batch that a picture needs.
    pub ray_of_picture: u64,
    /// Tables from which pictures are rendered, at most.
    pub picture_tables: u64,
    /// Key of the number of rays in a step, for messages.
    pub rays: &'static str,
    /// Key that determines the number of parameters, for messages.
    pub size: &'static str,
    /// Advice for fewer parameters, for messages.
    pub smaller: &'static str,
}

/// Reads the settings of a checkpoint of a kind other than the voxel grid.
///
/// Errors: the kind is not one of [`KINDS`](super::KINDS); the settings are damaged.
pub fn read(kind: &str, file: &TensorFile<'_>) -> Result<Box<dyn Recipe>> {
    match kind {
        tensorf::KIND => Ok(Box::new(file.fact::<tensorf::Config>("settings")?)),
        dvgo::KIND => Ok(Box::new(file.fact::<dvgo::Config>("settings")?)),
        nerf::KIND => Ok(Box::new(file.fact::<nerf::Config>("settings")?)),
        ngp::KIND => Ok(Box::new(file.fact::<ngp::Config>("settings")?)),
        other => Err(unknown(other, file)),
    }
}

/// The error for a kind of model that this program cannot render.
pub(super) fn unknown(kind: &str, file: &TensorFile<'_>) -> Error {
    let remedy = format!("expected {}; evaluate the model with the program that trained it", super::KINDS.join(", "));
    Error::input(file.path(), format!("unknown kind of model `{kind}`"), remedy)
}

impl Config {
    /// Returns the settings of the model to train, if it is not the voxel grid.
    pub fn recipe(&self) -> Option<&dyn Recipe> {
        self.recipes().into_iter().flatten().next()
    }

    /// Returns the settings of each model that the configuration has. A valid configuration has at most one.
    pub(super) fn recipes(&self) -> [Option<&dyn Recipe>; 4] {
        fn any<R: Recipe>(recipe: Option<&R>) -> Option<&dyn Recipe> {
            recipe.map(|recipe| recipe as &dyn Recipe)
        }
        [any(self.tensorf.as_ref()), any(self.dvgo.as_ref()), any(self.nerf.as_ref()), any(self.ngp.as_ref())]
    }
}
