//! `plenoxel export mesh`: exports the surface of a run.

use super::{Exported, Opened, SurfaceColors, ending};
use crate::commands::{as_flag, number, whole};
use crate::progress::Console;
use clap::Args;
use plenoxel::error::{Error, Result};
use plenoxel::export::mesh::{MeshOptions, mesh};
use plenoxel::export::mesh_file::MeshFormat;

/// Memory per voxel in bytes: triangles, normals and colors of a surface before decimation. Measured on lego.
const BYTES_PER_VOXEL: u64 = 190;

const EXAMPLES: &str = "\
Examples:
  plenoxel export mesh runs/lego
  plenoxel export mesh runs/lego --format glb
  plenoxel export mesh runs/lego --level 20 --min-part 1000 --out lego.obj
  plenoxel export mesh runs/lego --smooth 10 --max-triangles 200000
  plenoxel export mesh runs/lego --format stl              for 3D printing; without colors

Writes RUN/exports/mesh.<format>: a closed surface with normals and colors, in the coordinates of the dataset. GLB files have a rotation \
to y up, the axis of glTF. A higher level removes fog, but also thin parts. Small parts are removed first, then the surface is smoothed, then \
decimated.";

/// Export the surface of a run as a colored mesh
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct MeshArgs {
    #[command(flatten)]
    exported: Exported,

    #[command(flatten)]
    colors: SurfaceColors,

    /// File format: ply, obj, glb or stl [default: that of the file name of --out, or ply]
    #[arg(long, value_name = "FORMAT", help_heading = "Output", value_parser = format)]
    format: Option<MeshFormat>,

    /// Density of the isosurface, 1 / length of the dataset [default: the density at which a voxel has an alpha of 0.3]
    #[arg(long, value_name = "SIGMA", help_heading = "Surface", value_parser = number(f64::MIN_POSITIVE), allow_negative_numbers = true)]
    level: Option<f64>,

    /// Minimum number of triangles of a separate part; smaller parts, such as specks of fog and hidden cavities, are removed. 0 keeps all
    /// parts; the largest part is always kept
    #[arg(long, value_name = "TRIANGLES", help_heading = "Surface", default_value_t = MeshOptions::default().min_part, value_parser = whole::<usize>(0, u64::from(u32::MAX)), allow_negative_numbers = true)]
    min_part: usize,

    /// Number of smoothing passes, which remove voxel steps; no vertex moves by more than half a voxel along each axis
    #[arg(long, value_name = "PASSES", help_heading = "Surface", default_value_t = MeshOptions::default().smooth, value_parser = whole::<usize>(0, 100), allow_negative_numbers = true)]
    smooth: usize,

    /// Decimate the mesh to at most this number of triangles, by edge collapses in the order of the error they cause
    #[arg(long, value_name = "N", help_heading = "Surface", value_parser = whole::<usize>(4, u64::from(u32::MAX)), allow_negative_numbers = true)]
    max_triangles: Option<usize>,
}

/// Writes the surface of a run.
pub fn run(args: &MeshArgs, console: &Console<'_>) -> Result<()> {
    let named = args.exported.out.as_deref().and_then(ending).map(|ending| format(&ending).map_err(|expected| (ending, expected)));
    let format = match (args.format, named) {
        (None, Some(Err((ending, expected)))) => return Err(Error::usage("--out", format!("unknown file extension .{ending}"), expected)),
        (None, Some(Ok(named))) => named,
        (given, _) => given.unwrap_or(MeshFormat::Ply),
    };
    let Opened { folder, grid, record, .. } = args.exported.open(console, &format.to_string(), BYTES_PER_VOXEL)?;
    let to_world = record.to_world.unwrap_or_default();
    let options = MeshOptions {
        // The level is per length of the dataset.
        level: args.level.map(|level| level / to_world.scale),
        direction: args.colors.direction().map(|direction| to_world.rotation * direction),
        min_part: args.min_part,
        smooth: args.smooth,
        max_triangles: args.max_triangles,
    };
    let surface = mesh(&grid, &options).map_err(as_flag)?;
    let volume = surface.volume() * to_world.scale.powi(-3);
    let surface = surface.moved(&to_world.inverse());
    if surface.parts_left_out > 0 {
        let parts = if surface.parts_left_out == 1 { "part" } else { "parts" };
        console.note(&format!("removed {} {parts} of fewer than {} triangles (--min-part)", surface.parts_left_out, args.min_part));
    }
    let (vertices, triangles) = (surface.positions.len(), surface.triangles.len());
    if args.max_triangles.is_some_and(|most| triangles > most) {
        console.note(&format!("the mesh has {triangles} triangles: fewer would change the topology of the surface"));
    }
    if !format.has_colors() {
        console.note(&format!("{format} files have no colors; ply, obj and glb files do"));
    }
    let bytes = format.encode(&surface, crate::PROGRAM).map_err(as_flag)?;
    let file = args.exported.write(&folder, &format!("mesh.{format}"), &bytes, console)?;
    console.wrote(
        &file,
        &format!("wrote {vertices} vertices and {triangles} triangles with an enclosed volume of {:.4} to {}", volume, file.display()),
    )
}

/// Parses a format.
fn format(text: &str) -> std::result::Result<MeshFormat, String> {
    text.parse().map_err(|_| "expected ply, obj, glb or stl".to_owned())
}
