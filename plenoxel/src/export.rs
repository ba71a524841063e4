//! Grids as files of other programs.
//!
//! Positions are those of the dataset, z up, unless a format demands otherwise; colors are sRGB with 8 bits, as the photographs have them. A grid
//! whose colors depend on the direction is looked at in one direction: each voxel against the way it faces, or all along a given one.

pub mod mesh;
pub mod mesh_file;
mod palette;
pub mod vox;

use crate::field::voxel_grid::VoxelGrid;
use autograd::Real;
use glam::DVec3;

/// Rows of a grid as 8-bit colors, each seen along `direction`, or where that is `None` against its `outward` vector, of any length. One of
/// length zero is seen from everywhere: see [`VoxelGrid::colors_of`].
fn bytes_of<T: Real>(grid: &VoxelGrid<T>, rows: &[u32], outward: impl Fn(usize) -> DVec3, direction: Option<DVec3>) -> Vec<[u8; 3]> {
    let directions: Vec<DVec3> = (0..rows.len()).map(|i| direction.unwrap_or_else(|| -outward(i).normalize_or_zero())).collect();
    let byte = |c: f64| (c.clamp(0.0, 1.0) * 255.0).round() as u8;
    grid.colors_of(rows, &directions).into_iter().map(|rgb| rgb.map(byte)).collect()
}
