//! The state of a grid in training, in the precision of the run: tables `density`, `color` and `harmonics` `[rows, width]` in the order of its
//! lattice, whose `masks` of bricks say which voxels are present ([`autograd::Lattice::masks`]); and `learning`, where samples were looked up when last
//! looked at, as masks of bricks.

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

/// Facts about a grid in training.
#[derive(Debug, Serialize, Deserialize)]
struct Facts {
    /// Shape and conventions of the grid.
    grid: Header,
    /// Stages of the plan: fewer than there are if the run started from a finer grid.
    stages: usize,
    /// How many of them are the scout's.
    scouts: usize,
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

/// Adds what [`read`] needs.
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

/// Takes over what [`write`] wrote during a stage of this number.
pub fn read<T: Real>(model: &mut Plenoxels<T>, file: &mut TensorFile<'_>, stage: usize) -> Result<()> {
    let facts: Facts = file.fact("grid")?;
    let config = &model.config;
    if facts.scouts != 0 && facts.scouts != config.scout.as_ref().map_or(0, |scout| scout.stages.len()) {
        return Err(file.damaged("a scout of impossible stages"));
    }
    let scout = config.scout.iter().filter(|_| facts.scouts > 0).flat_map(|scout| &scout.stages);
    let stages: Vec<_> = scout.chain(&config.stages).copied().collect();
    let left_out =
        stages.len().checked_sub(facts.stages).filter(|left_out| *left_out < stages.len() && (facts.scouts == 0 || *left_out == 0));
    let stages = stages[left_out.ok_or_else(|| file.damaged("a plan of impossible stages"))?..].to_vec();
    let current = stages.get(stage).ok_or_else(|| file.damaged("a stage that the plan does not have"))?;
    let shape = facts.grid.shape();
    let configured = GridShape { half_width: shape.half_width, ..config.grid_shape(current.resolution) };
    if shape != configured || !GridShape::HALF_WIDTHS.contains(&shape.half_width) {
        return Err(file.damaged("a grid that is not of its stage"));
    }
    let n = [shape.resolution; 3];
    let masks = masks(file, "masks", n)?.filter(|masks| masks.iter().any(|mask| *mask != 0));
    let lattice = Lattice::from_masks(n, masks.ok_or_else(|| file.damaged("voxels outside of the grid, or none"))?);
    let shapes = shape.tables(&lattice);
    // The old grid goes first.
    model.grid = VoxelGrid::uniform(GridShape { resolution: 1, ..shape }, 0.0, 0.0);
    let tables = ["density", "color", "harmonics"].iter().zip(&shapes).map(|(name, shape)| file.tensor(name, shape));
    model.grid = VoxelGrid::with_tables(shape, lattice, tables.collect::<Result<_>>()?);
    if model.config.project {
        model.grid.project();
    }
    model.learning = match facts.learning {
        None => None,
        Some(Cells { min, max, cells }) => {
            // The grid's cube, or up to a voxel more on each side.
            let sides = shape.half_width..=2.0 * shape.half_width;
            let around = (0..3).all(|a| sides.contains(&-min[a]) && sides.contains(&max[a]));
            let masks = match cells.iter().all(|n| (1..=shape.resolution + 1).contains(n)) && around {
                true => self::masks(file, "learning", cells)?,
                false => None,
            };
            let masks = masks.ok_or_else(|| file.damaged("samples outside of the grid"))?;
            Some(Occupancy::from_masks(Aabb { min, max }, cells, masks))
        }
    };
    (model.stages, model.scouts) = (stages, facts.scouts);
    Ok(())
}

/// Masks of bricks of so many cells; `None` if one has a cell outside of these.
fn masks(file: &mut TensorFile<'_>, name: &str, cells: [usize; 3]) -> Result<Option<Vec<u64>>> {
    let whole = Lattice::bricks(cells);
    let masks = file.words(name, whole.masks().len())?;
    let inside = masks.iter().zip(whole.masks()).all(|(mask, whole)| mask & !whole == 0);
    Ok(inside.then_some(masks))
}
