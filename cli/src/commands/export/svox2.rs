//! `plenoxel export svox2`: exports the grid of a run as a checkpoint of svox2.

use super::{Exported, Opened};
use crate::commands::{as_flag, number};
use crate::progress::Console;
use clap::Args;
use plenoxel::error::Result;
use plenoxel::formats::svox2::{BLENDER_SCALE, encode};
use plenoxel::run::memory::bytes;

/// Memory per voxel in bytes: a copy of the tables, the rows in single precision, and the file.
const BYTES_PER_VOXEL: u64 = 400;

const EXAMPLES: &str = "\
Examples:
  plenoxel export svox2 runs/lego
  plenoxel export svox2 runs/lego --scene-scale 1 --out ckpt.npz
  plenoxel import runs/lego/exports/ckpt.npz --data data/lego --out runs/again

Writes RUN/exports/ckpt.npz for svox2's render_imgs.py. The pictures are the same, up to the half precision of the colors. The grid must be \
interpolated, with harmonics of degree 2 or less. A model without voxels must be baked first (`plenoxel bake`).";

/// Export the grid of a run as a checkpoint of svox2 (Plenoxels)
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct Svox2Args {
    #[command(flatten)]
    exported: Exported,

    /// Length of one world unit in the file; svox2 multiplies the camera positions by this number when it reads a dataset [default: 2/3 for
    /// NeRF-synthetic scenes, as svox2; 1 otherwise]
    #[arg(long, value_name = "S", help_heading = "Output", value_parser = number(f64::MIN_POSITIVE), allow_negative_numbers = true)]
    scene_scale: Option<f64>,
}

/// Writes the checkpoint.
pub fn run(args: &Svox2Args, console: &Console<'_>) -> Result<()> {
    let Opened { folder, record, grid, .. } = args.exported.open(console, "npz", BYTES_PER_VOXEL)?;
    let scale = args.scene_scale.unwrap_or_else(|| scale_of(&record.format));
    if grid.shape().is_reduced() && grid.shape().sh_reduction.is_multiple_of(2) {
        console.note(
            "warning: the harmonics of this grid are on a coarser grid, and are interpolated to every voxel; pictures differ a little",
        );
    }
    let (file, voxels) = encode(&folder.checkpoint(), &grid, scale).map_err(as_flag)?;
    let path = args.exported.write(&folder, "ckpt.npz", &file, console)?;
    let size = bytes(file.len() as u64);
    console.wrote(&path, &format!("wrote {voxels} voxels at scene_scale {scale:.4} to {} ({size})", path.display()))
}

/// The scale by which svox2 multiplies the camera positions of a dataset format.
pub fn scale_of(format: &str) -> f64 {
    if format == plenoxel::dataset::blender::FORMAT { BLENDER_SCALE } else { 1.0 }
}
