//! A run on disk, from which it goes on as if it had never stopped.
//!
//! A `safetensors` file. Its metadata say of which kind the model is, with which settings and which views it is trained, and how many steps were taken.
//! Its tensors are those that [`Model::write`] adds; of each parameter what the optimizer remembers, `<name>.optimizer.0` and on; and the
//! parameters of the losses with theirs, `loss.<name>` and `loss.<name>.optimizer.0`. Numbers are in the run's precision. Random numbers are a
//! function of seed, step and ray, so that nothing of them is kept.

use super::model::check_kind;
use super::{Model, TrainOptions, Trainer, plan};
use crate::dataset::View;
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

/// Facts about a trained model that every kind of checkpoint has.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct About {
    /// Name of the scene.
    pub scene: String,
    /// Color behind the scene that it was trained with, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Seed of the run.
    pub seed: u64,
    /// Steps taken.
    pub step: u64,
}

/// Reads the facts about a trained model from its checkpoint, of whatever kind it is.
///
/// Errors name the file and what is wrong with it.
pub fn about(path: &Path) -> Result<About> {
    let file = TensorFile::open(path)?;
    let mut facts = file.facts()?;
    // Checkpoints of voxel grids have them among the others.
    let about = if facts["about"].is_object() { facts["about"].take() } else { facts };
    serde_json::from_value(about).map_err(|e| file.unreadable(&e))
}

/// Facts about a run beside those of its model.
#[derive(Debug, Serialize, Deserialize)]
struct State {
    about: About,
    options: TrainOptions,
    settings: Value,
    /// Bytes of a number.
    precision: usize,
    /// A hash of cameras and pixels of the training views.
    views: String,
    /// Number of the stage of the last step.
    stage: usize,
    /// Of each parameter of the model the number of its updates, where the optimizer remembers something.
    updates: Vec<Option<u64>>,
    /// The same of the losses.
    loss_updates: Vec<Option<u64>>,
}

impl<T: Real, M: Model<T>> Trainer<T, M> {
    /// Facts for a checkpoint of the model as it is now.
    pub fn about(&self, scene: &str) -> About {
        About { scene: scene.to_owned(), background: self.options.background, seed: self.options.seed, step: self.step }
    }

    /// Writes everything that the run needs to go on, except its views, whole or not at all; `scene` is the dataset's name.
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

    /// The run whose state the file holds, to go on from there: the steps that follow have the bits they would have had.
    ///
    /// Errors name the file and what is wrong with it: cut short, another program's, a later version's; of other settings or views.
    ///
    /// Panics if steps have been taken.
    pub fn resumed(self, path: &Path) -> Result<Self> {
        self.resumed_with(TensorFile::open(path)?)
    }

    /// The same from any source, a file or bytes; `path` names it in messages.
    pub fn resumed_from(self, path: &Path, source: impl Read + Seek) -> Result<Self> {
        self.resumed_with(TensorFile::new(path, source)?)
    }

    fn resumed_with(mut self, mut file: TensorFile<'_>) -> Result<Self> {
        assert_eq!(self.step, 0, "a run starts once");
        let state = read(&file)?;
        check_kind(&file, self.model.kind())?;
        let other = |what: &str| {
            let found = format!("the state of a run with other {what}");
            Err(Error::input(file.path(), found, "go on with the settings and the data that the run began with, or train again"))
        };
        if state.options != self.options || state.settings != self.model.settings() {
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
        // The first step is not taken yet, and the file is of later.
        let last = state.about.step.checked_sub(1);
        let current = last.and_then(|last| self.stage_of(last)).filter(|stage| stage.index == state.stage);
        let current = current.ok_or_else(|| file.damaged("a step that the plan does not have"))?;
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
            return Err(file.damaged("numbers that are not finite"));
        }
        self.step = state.about.step;
        self.model.resume(&current, &mut self.rays);
        Ok(self)
    }
}

/// Adds what an optimizer remembers of each parameter, and returns how many updates each had.
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

/// Has an optimizer recall what was written of each parameter.
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
        let Some(updates) = updates.next() else { return Err(file.damaged("a memory of other parameters")) };
        let Some(updates) = *updates else { return Ok(()) };
        if updates > steps {
            return Err(file.damaged("more updates than steps"));
        }
        let mut arrays: Vec<Buffer<T>> = Vec::new();
        while file.contains(&of_optimizer(prefix, param, arrays.len())) {
            let read = file.tensor::<T>(&of_optimizer(prefix, param, arrays.len()), param.shape())?;
            arrays.push(Buffer::copy_of(read.data()));
        }
        match optimizer.recall(param, updates, arrays) {
            true => Ok(()),
            false => Err(file.damaged("the memory of another optimizer")),
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
        Some(_) => Err(file.damaged("a memory of other parameters")),
    }
}

/// Facts of a file, after its version.
fn read(file: &TensorFile<'_>) -> Result<State> {
    let facts = file.facts()?;
    let format = facts["format"].as_str().unwrap_or("none");
    if format != FORMAT {
        let remedy =
            format!("this program goes on from `{FORMAT}`; use the version that wrote the file, or `--init-from` for a trained grid");
        return Err(Error::input(file.path(), format!("format `{format}`"), remedy));
    }
    file.fact("run")
}

/// Name of an array that an optimizer remembers of a parameter.
fn of_optimizer<T: Real>(prefix: &str, param: &Param<T>, i: usize) -> String {
    format!("{prefix}{}.optimizer.{i}", param.name())
}

/// A hash of cameras and pixels: FNV-1a of each view, and of these.
fn fingerprint(views: &[View]) -> String {
    const BASIS: u64 = 0xcbf2_9ce4_8422_2325;
    let more = |hash: u64, word: u64| (hash ^ word).wrapping_mul(0x0000_0100_0000_01b3);
    let hashes = parallel::map_indices(views.len(), |v| {
        let camera = format!("{:?}", views[v].camera);
        let hash = camera.bytes().fold(BASIS, |hash, byte| more(hash, byte.into()));
        let pixels = views[v].image.as_raw().chunks(8);
        pixels.fold(hash, |hash, eight| more(hash, eight.iter().fold(0, |word, &byte| word << 8 | u64::from(byte))))
    });
    format!("{:016x}", hashes.into_iter().fold(BASIS, more))
}
