//! `plenoxel export vox`: exports the voxels of a run for MagicaVoxel.

use super::{Exported, MIN_ALPHA, Opened, SurfaceColors, min_alpha};
use crate::commands::as_flag;
use crate::progress::Console;
use clap::Args;
use plenoxel::error::Result;
use plenoxel::export::vox::{VoxOptions, vox};

/// Memory per voxel in bytes: positions, rows and colors.
const BYTES_PER_VOXEL: u64 = 100;

const EXAMPLES: &str = "\
Examples:
  plenoxel export vox runs/lego
  plenoxel export vox runs/lego --min-alpha 0.5 --out lego.vox

Writes RUN/exports/grid.vox. Voxel (i, j, k) of the grid is voxel (i, j, k) of the file, z up. Grids of more than 256 voxels per side \
are split into tiles of 256 in one scene. The palette has up to 255 colors, computed from the exported voxels.";

/// Export the voxels of a run as a MagicaVoxel .vox file
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct VoxArgs {
    #[command(flatten)]
    exported: Exported,

    #[command(flatten)]
    colors: SurfaceColors,

    #[arg(long, value_name = "A", help_heading = "Voxels", help = MIN_ALPHA, default_value_t = VoxOptions::default().min_alpha, value_parser = min_alpha, allow_negative_numbers = true)]
    min_alpha: f64,

    /// Also export voxels that are hidden on all six sides
    #[arg(long, help_heading = "Voxels")]
    solid: bool,
}

/// Writes the voxels of a run.
pub fn run(args: &VoxArgs, console: &Console<'_>) -> Result<()> {
    let Opened { folder, grid, record, .. } = args.exported.open(console, "vox", BYTES_PER_VOXEL)?;
    let options = VoxOptions {
        min_alpha: args.min_alpha,
        solid: args.solid,
        direction: args.colors.direction().map(|direction| record.to_world.unwrap_or_default().rotation * direction),
    };
    let model = vox(&grid, &options).map_err(as_flag)?;
    let file = args.exported.write(&folder, "grid.vox", &model.to_bytes().map_err(as_flag)?, console)?;
    console.wrote(&file, &format!("wrote {} voxels in {} colors to {}", model.voxels.len(), model.palette.len(), file.display()))
}
