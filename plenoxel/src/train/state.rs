//! Saved state of a run, from which it resumes with bit-identical results.
//!
//! The state is a `safetensors` file. Its metadata hold the kind of the model, the settings, a hash of the training views, and the number
//! of steps taken. Its tensors are those that [`Model::write`] adds; the optimizer state of each parameter, `<name>.optimizer.0` and so on;
//! and the parameters of the losses with their optimizer state, `loss.<name>` and `loss.<name>.optimizer.0`. Numbers have the precision of
//! the run. Random numbers depend only on seed, step and ray, so no generator state is saved.

use super::model::check_kind;
use super::{Model, TrainOptions, Trainer, plan};
use crate::dataset::View;
use crate::dataset::mask::Mask;
use crate::error::{Error, Result};
use crate::tensor_file::{TensorFile, TensorWriter};
use autograd::optim::{Optimizer, Remembered};
use autograd::{Buffer, Module, Param, Real, parallel};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::io::{Read, Seek};
use std::path::Path;

/// Version of the format.
const FORMAT: &str = "plenoxel training 2";

/// Facts about a trained model that every kind of checkpoint stores.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct About {
    /// Name of the scene.
    pub scene: String,
    /// Background color of training, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Seed of the run.
    pub seed: u64,
    /// Number of steps taken.
    pub step: u64,
}

/// Reads the facts about a trained model from its checkpoint, for any kind of model.
///
/// Errors if the file cannot be read; the error names the file and the problem.
pub fn about(path: &Path) -> Result<About> {
    let file = TensorFile::open(path)?;
    let mut facts = file.facts()?;
    // Checkpoints of voxel grids store them at the top level.
    let about = if facts["about"].is_object() { facts["about"].take() } else { facts };
    serde_json::from_value(about).map_err(|e| file.unreadable(&e))
}

/// Metadata of a run, in addition to the facts of its model.
#[derive(Debug, Serialize, Deserialize)]
struct State {
    about: About,
    options: TrainOptions,
    settings: Value,
    /// Bytes per number.
    precision: usize,
    /// Hash of cameras and pixels of the training views.
    views: String,
    /// Number of the stage of the last step.
    stage: usize,
    /// Number of updates of each parameter of the model; `None` if the optimizer has no state for it.
    updates: Vec<Option<u64>>,
    /// Number of updates of each parameter of the losses.
    loss_updates: Vec<Option<u64>>,
}

impl<T: Real, M: Model<T>> Trainer<T, M> {
    /// Returns facts for a checkpoint of the current model.
    pub fn about(&self, scene: &str) -> About {
        About { scene: scene.to_owned(), background: self.options.background, seed: self.options.seed, step: self.step }
    }

    /// Writes everything that is needed to resume the run, except its views. The file is written atomically. `scene` is the name of the
    /// dataset.
    ///
    /// Panics if no step has been taken.
    pub fn save(&self, path: &Path, scene: &str) -> Result<()> {
        let stage = self.stage_of(self.step.checked_sub(1).expect("a run is saved after its first step")).expect("the stage of a step");
        let mut file = TensorWriter::of::<T>();
        file.fact("format", FORMAT);
        file.fact("kind", self.model.kind());
        self.model.write(&mut file);
        let updates = write_memory(&self.model, "", &*self.optimizer, &mut file);
        self.objective.visit(&mut |param| file.owned(format!("loss.{}", param.name()), param.tensor().detach()));
        let loss_updates = write_memory(&self.objective, "loss.", &*self.loss_optimizer, &mut file);
        let run = State {
            about: self.about(scene),
            options: self.options.clone(),
            settings: self.model.settings(),
            precision: size_of::<T>(),
            views: fingerprint(self.views()),
            stage: stage.index,
            updates,
            loss_updates,
        };
        file.fact("run", run);
        file.write(path)
    }

    /// Resumes the run that was saved to a file. The following steps are bit-identical to those of the uninterrupted run.
    ///
    /// Errors if the file is damaged, has another format or a later version, or belongs to other settings or views; the error names the
    /// file and the problem.
    ///
    /// Panics if steps have been taken.
    pub fn resumed(self, path: &Path) -> Result<Self> {
        self.resumed_with(TensorFile::open(path)?)
    }

    /// Resumes a run from any source, such as a file or bytes. `path` names it in error messages.
    pub fn resumed_from(self, path: &Path, source: impl Read + Seek) -> Result<Self> {
        self.resumed_with(TensorFile::new(path, source)?)
    }

    fn resumed_with(mut self, mut file: TensorFile<'_>) -> Result<Self> {
        assert_eq!(self.step, 0, "resumed: the run has already taken steps");
        let state = read(&file)?;
        check_kind(&file, self.model.kind())?;
        let other = |what: &str| {
            let found = format!("the saved run has other {what}");
            Err(Error::input(file.path(), found, "resume with the settings and the data that the run began with, or train again"))
        };
        if state.options != self.options || !self.model.continues(&state.settings, state.about.step) {
            return other("settings");
        }
        if state.precision != size_of::<T>() {
            return other("precision");
        }
        if state.views != fingerprint(self.views()) {
            return other("training views");
        }
        self.model.read(&mut file, state.stage)?;
        self.plan = plan(&self.model, &self.options, self.rays.len());
        // A saved run has taken at least one step, and its last step belongs to the saved stage.
        let last = state.about.step.checked_sub(1);
        let current = last.and_then(|last| self.stage_of(last)).filter(|stage| stage.index == state.stage);
        let current = current.ok_or_else(|| file.damaged("the step does not match the plan"))?;
        self.model.resume(&current, &mut self.rays);
        self.optimizer = self.model.optimizer(&current);
        read_memory(&self.model, "", &mut *self.optimizer, &state.updates, &mut file, state.about.step)?;
        let mut done = Ok(());
        self.objective.visit_mut(&mut |param| {
            if done.is_ok() {
                let read = file.tensor(&format!("loss.{}", param.name()), param.shape());
                done = read.map(|read| param.update(|values| values.copy_from_slice(read.data())));
            }
        });
        done?;
        read_memory(&self.objective, "loss.", &mut *self.loss_optimizer, &state.loss_updates, &mut file, state.about.step)?;
        if !(self.model.is_finite() && self.objective.is_finite()) {
            return Err(file.damaged("it has values that are not finite"));
        }
        self.step = state.about.step;
        Ok(self)
    }
}

/// Writes the optimizer state of each parameter. Returns the number of updates of each.
fn write_memory<'a, T: Real>(
    module: &impl Module<T>,
    prefix: &str,
    optimizer: &'a (impl Optimizer<T> + ?Sized),
    file: &mut TensorWriter<'a>,
) -> Vec<Option<u64>> {
    let mut all = Vec::new();
    module.visit(&mut |param| {
        let memory: Option<Remembered<'a, T>> = optimizer.memory_of(param);
        all.push(memory.as_ref().map(|memory| memory.updates));
        for (i, array) in memory.into_iter().flat_map(|memory| memory.arrays).enumerate() {
            file.numbers(of_optimizer(prefix, param, i), param.shape(), array);
        }
    });
    all
}

/// Restores the optimizer state of each parameter.
fn read_memory<T: Real>(
    module: &impl Module<T>,
    prefix: &str,
    optimizer: &mut (impl Optimizer<T> + ?Sized),
    updates: &[Option<u64>],
    file: &mut TensorFile<'_>,
    steps: u64,
) -> Result<()> {
    let mut updates = updates.iter();
    let mut recall = |param: &Param<T>| -> Result<()> {
        let Some(updates) = updates.next() else { return Err(file.damaged("the optimizer state is of other parameters")) };
        let Some(updates) = *updates else { return Ok(()) };
        if updates > steps {
            return Err(file.damaged("a parameter has more updates than steps"));
        }
        let mut arrays: Vec<Buffer<T>> = Vec::new();
        while file.contains(&of_optimizer(prefix, param, arrays.len())) {
            let read = file.tensor::<T>(&of_optimizer(prefix, param, arrays.len()), param.shape())?;
            arrays.push(Buffer::copy_of(read.data()));
        }
        match optimizer.recall(param, updates, arrays) {
            true => Ok(()),
            false => Err(file.damaged("the state is of another optimizer")),
        }
    };
    let mut done = Ok(());
    module.visit(&mut |param| {
        if done.is_ok() {
            done = recall(param);
        }
    });
    done?;
    match updates.next() {
        None => Ok(()),
        Some(_) => Err(file.damaged("the optimizer state is of other parameters")),
    }
}

/// Reads the metadata of a file and checks its version.
fn read(file: &TensorFile<'_>) -> Result<State> {
    let facts = file.facts()?;
    let format = facts["format"].as_str().unwrap_or("none");
    if format != FORMAT {
        let remedy =
            format!("expected `{FORMAT}`; use the program version that wrote the file, or `--init-from` to start from a trained grid");
        return Err(Error::input(file.path(), format!("format `{format}`"), remedy));
    }
    file.fact("run")
}

/// Returns the name of an array of optimizer state.
fn of_optimizer<T: Real>(prefix: &str, param: &Param<T>, i: usize) -> String {
    format!("{prefix}{}.optimizer.{i}", param.name())
}

/// Returns a hash of cameras, pixels and masks: the FNV-1a hash of the hashes of the views.
fn fingerprint(views: &[View]) -> String {
    const BASIS: u64 = 0xcbf2_9ce4_8422_2325;
    let more = |hash: u64, word: u64| (hash ^ word).wrapping_mul(0x0000_0100_0000_01b3);
    let hashes = parallel::map_indices(views.len(), |v| {
        let camera = format!("{:?}", views[v].camera);
        let hash = camera.bytes().fold(BASIS, |hash, byte| more(hash, byte.into()));
        let pixels = views[v].image.as_raw().chunks(8);
        let hash = pixels.fold(hash, |hash, eight| more(hash, eight.iter().fold(0, |word, &byte| word << 8 | u64::from(byte))));
        views[v].mask.iter().flat_map(Mask::bytes).fold(hash, |hash, keeps| more(hash, keeps.into()))
    });
    format!("{:016x}", hashes.into_iter().fold(BASIS, more))
}
