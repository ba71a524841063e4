//! `plenoxel export`: a trained run as files of other programs.

mod mesh;
mod ply;
mod vox;

use crate::memory::Estimate;
use crate::progress::Console;
use crate::run_folder::RunFolder;
use clap::{Args, Subcommand, ValueHint};
use glam::DVec3;
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::files::write_atomically;
use std::path::{Path, PathBuf};

/// Write a trained run as files of other programs
#[derive(Debug, Args)]
#[command(arg_required_else_help = true)]
pub struct ExportArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Ply(Box<ply::PlyArgs>),
    Vox(vox::VoxArgs),
    Mesh(mesh::MeshArgs),
}

/// Exports a run.
pub fn run(args: &ExportArgs, console: &Console<'_>) -> Result<()> {
    match &args.what {
        What::Ply(args) => ply::run(args, console),
        What::Vox(args) => vox::run(args, console),
        What::Mesh(args) => mesh::run(args, console),
    }
}

/// Which run, where to, and from where colors are seen.
#[derive(Debug, Args)]
struct Exported {
    /// Run folder that `plenoxel train` or `plenoxel carve` wrote
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// File to write, replacing what is there [default: in RUN/exports]
    #[arg(long, short, value_name = "FILE", help_heading = "Output", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,

    /// Take colors that depend on the direction as seen along this one, from the viewer into the scene [default: against the surface's normal]
    #[arg(long, value_name = "X,Y,Z", help_heading = "Colors", value_parser = direction, allow_hyphen_values = true)]
    direction: Option<DVec3>,
}

impl Exported {
    /// The trained grid, once memory is known to suffice, and the name of the file to be fit for its format.
    fn open(&self, console: &Console<'_>, format: &str) -> Result<(RunFolder, VoxelGrid<f32>)> {
        if let Some(out) = self.out.as_deref().filter(|out| ending(out).as_deref() != Some(format)) {
            let found = format!("{}, for a file of the format {format},", out.display());
            return Err(Error::config("--out", found, format!("a name that ends in .{format}")));
        }
        let (folder, ..) = RunFolder::open(&self.run)?;
        let (header, voxels) = folder.header()?;
        let estimate = Estimate::of_export(&header.shape(), voxels);
        console.note(&estimate.describe());
        estimate.check()?;
        let (grid, _) = folder.load()?;
        Ok((folder, grid))
    }

    /// Writes the file that was asked for, or else one of a name in the run's folder, and says which.
    fn write(&self, folder: &RunFolder, name: &str, bytes: &[u8]) -> Result<PathBuf> {
        let file = self.out.clone().map_or_else(|| folder.create_export(name), Ok)?;
        write_atomically(&file, bytes)?;
        Ok(file)
    }
}

/// What stands behind the last dot of a file's name, in small letters.
fn ending(path: &Path) -> Option<String> {
    path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase())
}

/// A setting of the library under the name that its flag has.
fn as_flag(error: Error) -> Error {
    match error {
        Error::Config { key, found, accepted } => Error::config(format!("--{}", key.replace('_', "-")), found, accepted),
        other => other,
    }
}

/// A direction as the command line takes it, of unit length.
fn direction(text: &str) -> std::result::Result<DVec3, String> {
    let direction = super::numbers(text).ok().and_then(|d: [f64; 3]| DVec3::from(d).try_normalize());
    direction.ok_or_else(|| "three numbers such as 0,0,-1, not all of them 0".to_owned())
}
