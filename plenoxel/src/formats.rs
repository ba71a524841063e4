//! Grids in the files of other programs that train and render radiance fields, in both directions.
//!
//! [`svox2`] is the checkpoint of Plenoxels, [`plenoctree`] the octree of PlenOctrees. Both are archives of NumPy arrays ([`npz`]). Each
//! file has its conventions in its first lines. A reader returns the grid in the world of this crate and says what the file has beyond it.

pub mod npz;
pub mod plenoctree;
pub mod svox2;

mod logistic;

use crate::checkpoint::BRICK_BYTES;
use crate::error::{Error, Result};
use crate::field::voxel_grid::{GridShape, VoxelGrid};
use crate::files;
use crate::memory;
use autograd::lattice::BrickGrid;
use autograd::{Lattice, Module};
use npz::Npz;
use std::io::{Read, Seek};
use std::path::Path;

/// Most voxels along each axis.
const MOST_VOXELS: usize = 1024;

/// The program whose file was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A checkpoint of svox2.
    Svox2,
    /// An octree of PlenOctrees (svox).
    PlenOctree,
}

impl Format {
    /// Name of the format.
    pub fn name(self) -> &'static str {
        match self {
            Format::Svox2 => "svox2 checkpoint",
            Format::PlenOctree => "PlenOctree",
        }
    }
}

/// A grid that was read from a file.
#[derive(Debug)]
pub struct Imported {
    /// The grid, in the coordinates of the file divided by the scene scale.
    pub grid: VoxelGrid<f32>,
    /// Differences between the file and the grid, as sentences.
    pub warnings: Vec<String>,
}

/// Returns the format of an .npz file.
///
/// Errors if the file is damaged or of another format.
pub fn format(path: &Path) -> Result<Format> {
    format_of(&Npz::new(path, files::open(path, files::ARRAYS)?)?)
}

/// Reads the grid in an .npz file of svox2 or PlenOctrees. `scene_scale` is the length in the file of one world unit.
///
/// Errors if the file is damaged, is of neither format, or has what a grid of this crate cannot express.
pub fn open(path: &Path, scene_scale: f64) -> Result<Imported> {
    read(path, files::open(path, files::ARRAYS)?, scene_scale)
}

/// Reads a grid from any source, such as a file or bytes. `path` names it in error messages.
pub fn read(path: &Path, source: impl Read + Seek, scene_scale: f64) -> Result<Imported> {
    let mut file = Npz::new(path, source)?;
    match format_of(&file)? {
        Format::Svox2 => svox2::read(&mut file, scene_scale),
        Format::PlenOctree => plenoctree::read(&mut file, scene_scale),
    }
}

fn format_of(file: &Npz<'_>) -> Result<Format> {
    if file.contains("links") {
        Ok(Format::Svox2)
    } else if file.contains("child") {
        Ok(Format::PlenOctree)
    } else {
        let found = format!("the file has the arrays {}", file.names().join(", "));
        Err(Error::input(file.path(), found, "expected `links` of svox2 or `child` of PlenOctrees"))
    }
}

/// Checks the size of a grid that is about to be read.
fn check_shape(path: &Path, shape: &GridShape) -> Result<()> {
    if !(1..=MOST_VOXELS).contains(&shape.resolution) {
        let found = format!("the grid has {} voxels per side", shape.resolution);
        return Err(Error::input(path, found, format!("expected up to {MOST_VOXELS}")));
    }
    if !GridShape::HALF_WIDTHS.contains(&shape.half_width) {
        let found = format!("half the side of the grid is {} world units", shape.half_width);
        return Err(Error::input(path, found, "expected a length from 1e-9 to 1e9"));
    }
    let n = shape.resolution;
    // A few voxels may be spread over many bricks.
    memory::check(path, &format!("reading a grid of {n}³ voxels"), BRICK_BYTES * BrickGrid::new([n; 3]).len() as u64)
}

/// Checks that there is memory for the tables of a grid, with `copies` of them.
fn check_tables(path: &Path, shape: &GridShape, lattice: &Lattice, copies: usize) -> Result<()> {
    let bytes = lattice.rows() * shape.voxel_bytes() * copies;
    memory::check(path, &format!("a grid of {} voxels", lattice.present()), bytes as u64)
}

/// Checks that all numbers of a grid are finite.
fn check_numbers(path: &Path, grid: &VoxelGrid<f32>) -> Result<()> {
    if grid.is_finite() {
        return Ok(());
    }
    Err(Error::input(path, "the file has numbers that are not finite", "use an undamaged copy, or train again"))
}

/// Checks a scale.
fn check_scale(scene_scale: f64) -> Result<()> {
    if (1e-6..=1e6).contains(&scene_scale) {
        return Ok(());
    }
    Err(Error::config("scene_scale", scene_scale, "a number from 1e-6 to 1e6"))
}
