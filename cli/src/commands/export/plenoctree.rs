//! `plenoxel export plenoctree`: exports the grid of a run as an octree of PlenOctrees.

use super::{Exported, Opened};
use crate::commands::{as_flag, whole};
use crate::progress::Console;
use clap::Args;
use plenoxel::error::Result;
use plenoxel::field::voxel_grid::{Color, Interpolation};
use plenoxel::formats::plenoctree::{OctreeOptions, encode};
use plenoxel::run::memory::bytes;

/// Memory per voxel in bytes: its place and its row. The leaves are counted when they are known.
const BYTES_PER_VOXEL: u64 = 100;

const EXAMPLES: &str = "\
Examples:
  plenoxel export plenoctree runs/lego
  plenoxel export plenoctree runs/lego --subdivide 2 --out lego.npz

Writes RUN/exports/tree.npz for svox and volrend. Leaves of an octree are constant, and their colors are in (0, 1). The octree of an \
interpolated grid with view-dependent colors is therefore an approximation; --subdivide makes it better and larger. A model without voxels must be \
baked first (`plenoxel bake`).";

/// Export the grid of a run as an octree of PlenOctrees (svox N3Tree)
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct PlenOctreeArgs {
    #[command(flatten)]
    exported: Exported,

    /// Leaves per voxel along each axis: 1, 2, 4 or 8; 1 for grids with constant voxels
    #[arg(long, value_name = "K", help_heading = "Output", default_value_t = OctreeOptions::default().subdivide, value_parser = whole::<usize>(1, 8), allow_negative_numbers = true)]
    subdivide: usize,
}

/// Writes the octree.
pub fn run(args: &PlenOctreeArgs, console: &Console<'_>) -> Result<()> {
    let Opened { folder, grid, .. } = args.exported.open(console, "npz", BYTES_PER_VOXEL)?;
    let shape = grid.shape();
    let options = OctreeOptions { subdivide: args.subdivide, ..OctreeOptions::default() };
    if shape.interpolation == Interpolation::Trilinear {
        console.note("warning: leaves of an octree are constant; the pictures differ from those of the interpolated grid");
    }
    if shape.color.channels() > Color::Rgb.channels() {
        console.note("warning: colors of an octree are logistic functions of harmonics; view-dependent colors are fitted to them");
    }
    let count = console.count("computing leaves, voxel", 1);
    let encoded = encode(&folder.checkpoint(), &grid, &options, &|done, all| count.at(done, all));
    drop(count);
    let (file, leaves) = encoded.map_err(as_flag)?;
    let path = args.exported.write(&folder, "tree.npz", &file, console)?;
    console.wrote(&path, &format!("wrote {leaves} leaves to {} ({})", path.display(), bytes(file.len() as u64)))
}
