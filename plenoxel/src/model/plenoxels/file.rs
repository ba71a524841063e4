//! State of a grid in training, in the precision of the run.
//!
//! Entries: the tables `density`, `color` and `harmonics` `[rows, width]`, in the order of the lattice; `masks`, brick masks of the present
//! voxels ([`autograd::Lattice::masks`]); and `learning`, brick masks of the cells that were sampled at the last update.

use super::Plenoxels;
use crate::checkpoint::Header;
use crate::error::Result;
use crate::field::voxel_grid::{GridShape, VoxelGrid};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::tensor_file::{TensorFile, TensorWriter};
use autograd::{Lattice, Real};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Header of a grid in training.
#[derive(Debug, Serialize, Deserialize)]
struct Facts {
    /// Shape and conventions of the grid.
    grid: Header,
    /// Number of stages in the plan. Smaller than the config's number of stages if the run started from a finer grid.
    stages: usize,
    /// Number of stages that belong to the scout.
    scouts: usize,
    /// Box and resolution of `learning`.
    learning: Option<Cells>,
}

/// Box and resolution of an [`Occupancy`].
#[derive(Debug, Serialize, Deserialize)]
struct Cells {
    min: DVec3,
    max: DVec3,
    cells: [usize; 3],
}

/// Writes everything that [`read`] needs.
pub fn write<'a, T: Real>(model: &'a Plenoxels<T>, file: &mut TensorWriter<'a>) {
    let grid = &model.grid;
    let facts = Facts {
        grid: Header::new(grid, "", model.config.background, model.config.seed, 0),
        stages: model.stages.len(),
        scouts: model.scouts,
        learning: model.learning.as_ref().map(|o| Cells { min: o.aabb().min, max: o.aabb().max, cells: o.cells() }),
    };
    file.fact("grid", facts);
    file.words("masks", grid.lattice().masks());
    if let Some(learning) = &model.learning {
        file.words("learning", learning.masks());
    }
    for param in grid.params() {
        file.tensor(param.name(), param.tensor());
    }
}

/// Restores a model from the entries that [`write`] wrote during stage `stage`.
pub fn read<T: Real>(model: &mut Plenoxels<T>, file: &mut TensorFile<'_>, stage: usize) -> Result<()> {
    let facts: Facts = file.fact("grid")?;
    let config = &model.config;
    if facts.scouts != 0 && facts.scouts != config.scout.as_ref().map_or(0, |scout| scout.stages.len()) {
        return Err(file.damaged("the number of scout stages does not match the config"));
    }
    let scout = config.scout.iter().filter(|_| facts.scouts > 0).flat_map(|scout| &scout.stages);
    let stages: Vec<_> = scout.chain(&config.stages).copied().collect();
    let left_out =
        stages.len().checked_sub(facts.stages).filter(|left_out| *left_out < stages.len() && (facts.scouts == 0 || *left_out == 0));
    let stages = stages[left_out.ok_or_else(|| file.damaged("the number of stages does not match the config"))?..].to_vec();
    let current = stages.get(stage).ok_or_else(|| file.damaged("the current stage is not in the plan"))?;
    let shape = facts.grid.shape();
    let configured = GridShape { half_width: shape.half_width, coordinates: shape.coordinates, ..config.grid_shape(current.resolution) };
    if shape != configured || !shape.has_valid_box() {
        return Err(file.damaged("the shape of the grid does not match its stage"));
    }
    let n = [shape.resolution; 3];
    let masks = file.brick_masks("masks", n)?.filter(|masks| masks.iter().any(|mask| *mask != 0));
    let lattice = Lattice::from_masks(n, masks.ok_or_else(|| file.damaged("the grid has no voxels, or voxels outside of its box"))?);
    let shapes = shape.tables(&lattice);
    // Release the old grid first, to save memory.
    model.grid = VoxelGrid::uniform(GridShape { resolution: 1, ..shape }, 0.0, 0.0);
    let tables = ["density", "color", "harmonics"].iter().zip(&shapes).map(|(name, shape)| file.tensor(name, shape));
    model.grid = VoxelGrid::with_tables(shape, lattice, tables.collect::<Result<_>>()?);
    if model.config.project {
        model.grid.project();
    }
    model.learning = match facts.learning {
        None => None,
        Some(Cells { min, max, cells }) => {
            // The box is the grid's cube, or extends it by up to one voxel on each side.
            let sides = shape.half_width..=2.0 * shape.half_width;
            let around = (0..3).all(|a| sides.contains(&-min[a]) && sides.contains(&max[a]));
            let masks = match cells.iter().all(|n| (1..=shape.resolution + 1).contains(n)) && around {
                true => file.brick_masks("learning", cells)?,
                false => None,
            };
            let masks = masks.ok_or_else(|| file.damaged("the mask `learning` has cells outside of the grid"))?;
            Some(Occupancy::from_masks(Aabb { min, max }, cells, masks))
        }
    };
    (model.stages, model.scouts) = (stages, facts.scouts);
    Ok(())
}
