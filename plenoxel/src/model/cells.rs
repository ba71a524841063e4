//! Boxes and occupied cells in checkpoints.

use crate::error::Result;
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::tensor_file::{TensorFile, TensorWriter};
use serde::{Deserialize, Serialize};

/// Box and number of the cells that are sampled, as a checkpoint stores them beside their masks.
#[derive(Serialize, Deserialize)]
struct Cells {
    #[serde(rename = "box")]
    aabb: [[f64; 3]; 2],
    cells: [usize; 3],
}

/// Most cells of an occupancy along each axis. A file cannot announce more than memory holds.
pub const MOST: usize = 512;

fn corners(aabb: Aabb) -> [[f64; 3]; 2] {
    [aabb.min.to_array(), aabb.max.to_array()]
}

/// Returns the box with these corners, unless it has no volume.
fn valid_box([min, max]: [[f64; 3]; 2]) -> Option<Aabb> {
    let valid = (0..3).all(|a| min[a] < max[a] && min[a].is_finite() && max[a].is_finite());
    valid.then(|| Aabb { min: min.into(), max: max.into() })
}

/// Writes the box of a model.
pub fn write_box(aabb: Aabb, file: &mut TensorWriter<'_>) {
    file.fact("box", corners(aabb));
}

/// Reads the box that [`write_box`] wrote.
pub fn read_box(file: &TensorFile<'_>) -> Result<Aabb> {
    valid_box(file.fact("box")?).ok_or_else(|| file.damaged("the box has no volume"))
}

/// Writes the cells that are sampled; `None` stands for all.
pub fn write<'a>(occupied: Option<&'a Occupancy>, file: &mut TensorWriter<'a>) {
    file.fact("occupied", occupied.map(|cells| Cells { aabb: corners(cells.aabb()), cells: cells.cells() }));
    if let Some(occupied) = occupied {
        file.words("occupied", occupied.masks());
    }
}

/// Reads the cells that [`write`] wrote.
pub fn read(file: &mut TensorFile<'_>) -> Result<Option<Occupancy>> {
    let Some(Cells { aabb, cells }) = file.fact("occupied")? else { return Ok(None) };
    let aabb = valid_box(aabb).ok_or_else(|| file.damaged("the box of the occupied cells has no volume"))?;
    if cells.iter().any(|n| !(1..=MOST).contains(n)) {
        return Err(file.damaged("the number of cells is not one of this model"));
    }
    let masks = file.brick_masks("occupied", cells)?;
    let masks = masks.ok_or_else(|| file.damaged("the mask `occupied` has cells outside of the box"))?;
    Ok(Some(Occupancy::from_masks(aabb, cells, masks)))
}
