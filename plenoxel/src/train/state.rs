//! A run on disk, from which it goes on as if it had never stopped.
//!
//! A `safetensors` file: the grid's tables `density`, `color` and `harmonics` `[rows, width]` in the order of its lattice, whose `masks` of
//! bricks say which voxels are present ([`autograd::Lattice::masks`]); of each what the optimizer remembers, `density.optimizer.0` and on;
//! and `learning`, where samples were looked up when last looked at, as masks of bricks. Numbers are in the run's precision. Random numbers
//! are a function of seed, step and ray, so that nothing of them is kept.

use super::{PlannedStage, Trainer, optimizer, plan};
use crate::checkpoint::Header;
use crate::dataset::View;
use crate::error::{Error, Result};
use crate::field::Field;
use crate::field::voxel_grid::{GridShape, VoxelGrid};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::tensor_file::{self, Dtype, Entry, RETRAIN, TensorFile, bytes_of, dtype_of, open};
use crate::train::config::Config;
use autograd::{Buffer, Lattice, Param, Real, Tensor, parallel};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::io::{Read, Seek};
use std::path::Path;

/// Version of the format.
const FORMAT: &str = "plenoxel training 1";

/// Everything about a run but its tables.
#[derive(Debug, Serialize, Deserialize)]
struct State {
    /// [`FORMAT`].
    format: String,
    /// What a checkpoint of the grid would say of itself.
    grid: Header,
    config: Config,
    /// A hash of cameras and pixels of the training views.
    views: String,
    /// Stages of the plan: fewer than there are if the run started from a finer grid.
    stages: usize,
    /// How many of them are the scout's.
    scouts: usize,
    /// Of each table how many updates it had, where the optimizer remembers something.
    updates: Vec<Option<u64>>,
    /// Box and cells of `learning`.
    learning: Option<Cells>,
}

/// Where the bricks of an [`Occupancy`] are.
#[derive(Debug, Serialize, Deserialize)]
struct Cells {
    min: DVec3,
    max: DVec3,
    cells: [usize; 3],
}

impl<T: Real> Trainer<'_, T> {
    /// Steps taken so far.
    pub fn steps_taken(&self) -> u64 {
        self.step
    }

    /// Writes all that the run needs to go on, beside its views, whole or not at all; `scene` is the dataset's name.
    pub fn save(&self, path: &Path, scene: &str) -> Result<()> {
        let dtype = dtype_of::<T>();
        let remembered: Vec<_> = self.grid.params().map(|param| self.optimizer.memory_of(param)).collect();
        let state = State {
            format: FORMAT.to_owned(),
            grid: Header::new(&self.grid, scene, self.config.background, self.config.seed, self.step),
            config: self.config.clone(),
            views: fingerprint(self.views),
            stages: self.plan.len(),
            scouts: self.scouts,
            updates: remembered.iter().map(|memory| Some(memory.as_ref()?.updates)).collect(),
            learning: self.learning.as_ref().map(|o| Cells { min: o.aabb().min, max: o.aabb().max, cells: o.cells() }),
        };
        fn masks<'a>(name: &str, masks: &'a [u64]) -> Entry<'a> {
            Entry::new(name, Dtype::U64, vec![masks.len()], || masks.iter().flat_map(|mask| mask.to_le_bytes()).collect())
        }
        let mut entries = vec![masks("masks", self.grid.lattice().masks())];
        entries.extend(self.learning.as_ref().map(|learning| masks("learning", learning.masks())));
        for (param, memory) in self.grid.params().zip(&remembered) {
            let (shape, values) = (param.shape().to_vec(), param.tensor().data());
            entries.push(Entry::new(param.name(), dtype, shape.clone(), move || bytes_of(values, dtype)));
            for (i, &array) in memory.iter().flat_map(|memory| &memory.arrays).enumerate() {
                entries.push(Entry::new(of_optimizer(param, i), dtype, shape.clone(), move || bytes_of(array, dtype)));
            }
        }
        tensor_file::write(path, &state, &entries)
    }

    /// The run whose state the file holds, to go on from there: the steps that follow have the bits they would have had.
    ///
    /// Errors name the file and what is wrong with it: cut short, another program's, a later version's; of other settings or views.
    ///
    /// Panics if steps have been taken.
    pub fn resumed(self, path: &Path) -> Result<Self> {
        self.resumed_from(path, open(path)?)
    }

    /// The same from any source, a file or bytes; `path` names it in messages.
    pub fn resumed_from(mut self, path: &Path, source: impl Read + Seek) -> Result<Self> {
        assert_eq!(self.step, 0, "a run starts once");
        let mut file = TensorFile::new(path, source)?;
        let state = read(path, &file)?;
        let other = |what: &str| {
            let found = format!("the state of a run with other {what}");
            Err(Error::input(path, found, "go on with the settings and the data that the run began with, or train again"))
        };
        if state.config != self.config {
            return other("settings");
        }
        if state.views != fingerprint(self.views) {
            return other("training views");
        }
        let damaged = |what: &str| Error::input(path, what, RETRAIN);
        if state.scouts != 0 && state.scouts != self.config.scout.as_ref().map_or(0, |scout| scout.stages.len()) {
            return Err(damaged("a scout of impossible stages"));
        }
        let scout = self.config.scout.iter().filter(|_| state.scouts > 0).flat_map(|scout| &scout.stages);
        let stages: Vec<_> = scout.chain(&self.config.stages).copied().collect();
        let left_out =
            stages.len().checked_sub(state.stages).filter(|left_out| *left_out < stages.len() && (state.scouts == 0 || *left_out == 0));
        let plan =
            plan(&self.config, stages.into_iter().skip(left_out.ok_or_else(|| damaged("a plan of impossible stages"))?), self.rays.len());
        // The first step is not taken yet, and the file is of later.
        let last = state.grid.step.checked_sub(1);
        let current = last.and_then(|last| plan.iter().find(|p| (p.first..p.first + p.steps).contains(&last)));
        let current: PlannedStage = *current.ok_or_else(|| damaged("a step that the plan does not have"))?;
        let shape = state.grid.shape();
        let configured = GridShape { half_width: shape.half_width, ..self.config.grid_shape(current.stage.resolution) };
        if shape != configured || !GridShape::HALF_WIDTHS.contains(&shape.half_width) {
            return Err(damaged("a grid that is not of its stage"));
        }

        let n = [shape.resolution; 3];
        let masks = masks(&mut file, "masks", n)?.filter(|masks| masks.iter().any(|mask| *mask != 0));
        let lattice = Lattice::from_masks(n, masks.ok_or_else(|| damaged("voxels outside of the grid, or none"))?);
        let dtype = dtype_of::<T>();
        let mut table = |name: &str, shape: [usize; 2]| -> Result<Vec<T>> { file.numbers(name, dtype, &shape) };
        let shapes = shape.tables(&lattice);
        let names = ["density", "color", "harmonics"];
        let tables = names.iter().zip(&shapes).map(|(name, shape)| Ok(Tensor::from_vec(table(name, *shape)?, shape)));
        // The old grid goes first.
        self.grid = VoxelGrid::uniform(GridShape { resolution: 1, ..shape }, 0.0, 0.0);
        self.grid = VoxelGrid::with_tables(shape, lattice, tables.collect::<Result<_>>()?);
        if !self.grid.is_finite() {
            return Err(damaged("numbers that are not finite"));
        }
        if self.config.project {
            self.grid.project();
        }
        if state.updates.len() != shapes.len() {
            return Err(damaged("a memory of other tables"));
        }
        self.optimizer = optimizer(&self.config, &current);
        for (param, (shape, updates)) in self.grid.params().zip(shapes.iter().zip(&state.updates)) {
            let Some(updates) = *updates else { continue };
            if updates > state.grid.step {
                return Err(damaged("more updates than steps"));
            }
            let mut arrays: Vec<Buffer<T>> = Vec::new();
            while file.info(&of_optimizer(param, arrays.len())).is_some() {
                arrays.push(file.numbers(&of_optimizer(param, arrays.len()), dtype, shape)?.into());
            }
            if !self.optimizer.recall(param, updates, arrays) {
                return Err(damaged("the memory of another optimizer"));
            }
        }
        if let Some(Cells { min, max, cells }) = state.learning {
            // The grid's cube, or up to a voxel more on each side.
            let sides = shape.half_width..=2.0 * shape.half_width;
            let around = (0..3).all(|a| sides.contains(&-min[a]) && sides.contains(&max[a]));
            let masks = match cells.iter().all(|n| (1..=shape.resolution + 1).contains(n)) && around {
                true => self::masks(&mut file, "learning", cells)?,
                false => None,
            };
            let masks = masks.ok_or_else(|| damaged("samples outside of the grid"))?;
            self.learning = Some(Occupancy::from_masks(Aabb { min, max }, cells, masks));
        }
        (self.plan, self.scouts, self.step) = (plan, state.scouts, state.grid.step);
        self.rays.set_reduction(current.stage.image_reduction);
        let reach = Field::<T>::reach(&self.grid).cloned();
        self.aim(reach.as_ref());
        Ok(self)
    }
}

/// What a file says, after its version.
fn read<R: Read + Seek>(path: &Path, file: &TensorFile<R>) -> Result<State> {
    let value = file.header()?;
    let format = value["format"].as_str().unwrap_or("none");
    if format != FORMAT {
        let remedy =
            format!("this program goes on from `{FORMAT}`; use the version that wrote the file, or `--init-from` for a trained grid");
        return Err(Error::input(path, format!("format `{format}`"), remedy));
    }
    serde_json::from_value(value).map_err(|e| file.unreadable(&e))
}

/// Masks of bricks of so many cells; `None` if one has a cell outside of these.
fn masks<R: Read + Seek>(file: &mut TensorFile<R>, name: &str, cells: [usize; 3]) -> Result<Option<Vec<u64>>> {
    let whole = Lattice::bricks(cells);
    let bytes = file.read(name, Dtype::U64, &[whole.masks().len()])?;
    let masks: Vec<u64> = bytes.as_chunks::<8>().0.iter().map(|b| u64::from_le_bytes(*b)).collect();
    let inside = masks.iter().zip(whole.masks()).all(|(mask, whole)| mask & !whole == 0);
    Ok(inside.then_some(masks))
}

/// Name of what an optimizer remembers of a parameter.
fn of_optimizer<T: Real>(param: &Param<T>, i: usize) -> String {
    format!("{}.optimizer.{i}", param.name())
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
