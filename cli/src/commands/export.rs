//! `plenoxel export`: a trained run as files of other programs.

mod mesh;
mod ply;
mod vox;

use super::numbers;
use crate::progress::{Console, is_stdout};
use clap::{Args, Subcommand, ValueHint};
use glam::DVec3;
use plenoxel::checkpoint::{self, Header};
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::folder::{RunFolder, RunRecord};
use plenoxel::run::memory::Estimate;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel export ply runs/lego       a colored point cloud: CloudCompare, MeshLab
  plenoxel export vox runs/lego       MagicaVoxel
  plenoxel export mesh runs/lego      a surface: Blender, and what reads PLY, OBJ, GLB or STL
  plenoxel export ply --help          the settings of one";

/// Write a trained run as files of other programs
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, arg_required_else_help = true)]
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

/// Which run, and where to.
#[derive(Debug, Args)]
struct Exported {
    /// Run folder that `plenoxel train` or `plenoxel carve` wrote
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// The grid that validation views liked best of those that were saved, where it is another than the last
    #[arg(long)]
    best: bool,

    /// File to write, replacing what is there; - for stdout [default: in RUN/exports]
    #[arg(long, short, value_name = "FILE", help_heading = "Output", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
}

/// A run as it was found.
struct Opened {
    folder: RunFolder,
    config: Config,
    record: RunRecord,
    header: Header,
    grid: VoxelGrid<f32>,
}

impl Exported {
    /// The run with its grid, once memory is known to suffice for it and for `bytes_per_voxel`, and the name of the file to be fit for its format.
    fn open(&self, console: &Console<'_>, format: &str, bytes_per_voxel: u64) -> Result<Opened> {
        if let Some(out) = self.out.as_deref().filter(|out| !is_stdout(out) && ending(out).as_deref() != Some(format)) {
            let found = format!("{} does not name a file of the format {format}", out.display());
            return Err(Error::config("--out", found, format!("a name that ends in .{format}")));
        }
        let (folder, config, record) = RunFolder::open(&self.run)?;
        let folder = if self.best { folder.with_best()? } else { folder };
        let path = folder.existing_checkpoint()?;
        let (header, voxels) = checkpoint::header(&path)?;
        let estimate = Estimate::of_export(&header.shape(), voxels, bytes_per_voxel);
        console.note(&estimate.describe());
        estimate.check()?;
        let (grid, header) = checkpoint::load(&path)?;
        Ok(Opened { folder, config, record, header, grid })
    }

    /// Writes the file that was asked for, or else one of a name in the run's folder, and says which.
    fn write(&self, folder: &RunFolder, name: &str, bytes: &[u8], console: &Console<'_>) -> Result<PathBuf> {
        let file = self.out.clone().map_or_else(|| folder.create_export(name), Ok)?;
        console.write_file(&file, bytes)?;
        Ok(file)
    }
}

/// What stands behind the last dot of a file's name, in small letters.
fn ending(path: &Path) -> Option<String> {
    path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase())
}

/// What `--min-alpha` means, whatever is exported.
const MIN_ALPHA: &str =
    "Keep voxels that absorb at least this share of the light that crosses them, 1 - exp(-density * side); none without density";

/// A least share of the light as the command line takes it: no voxel absorbs all of it.
fn min_alpha(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|share| (0.0..1.0).contains(share)).ok_or_else(|| "a number from 0 on, and below 1".to_owned())
}

/// The one color of a place, where it depends on the direction.
#[derive(Clone, Copy, Debug, PartialEq)]
enum ColorChoice {
    /// What training cameras see of it.
    Seen,
    /// The mean over all directions.
    Mean,
    /// As seen straight on, against the normal of the surface.
    Facing,
    /// As seen along a unit direction, from the viewer into the scene.
    Along(DVec3),
}

/// A choice as the command line takes it: one of some words, or a direction.
fn color(words: &'static [(&'static str, ColorChoice)]) -> impl Fn(&str) -> std::result::Result<ColorChoice, String> + Clone {
    move |text| {
        if let Some((_, choice)) = words.iter().find(|(word, _)| *word == text) {
            return Ok(*choice);
        }
        let direction = numbers::<3>(text).ok().and_then(|d| DVec3::from(d).try_normalize());
        let words = || words.iter().map(|(word, _)| format!("{word}, ")).collect::<String>();
        direction
            .map(ColorChoice::Along)
            .ok_or_else(|| format!("{}or a direction of three numbers such as 0,0,-1, not all of them 0", words()))
    }
}

/// From where the colors of a surface are seen.
#[derive(Debug, Args)]
struct SurfaceColors {
    /// The one color of a place, where it depends on the direction: as seen straight on, against the surface's normal, or what a ray in
    /// the direction X,Y,Z, from the viewer into the scene, shows there
    #[arg(long, value_name = "facing|X,Y,Z", help_heading = "Colors", default_value = "facing", allow_hyphen_values = true,
          value_parser = color(&[("facing", ColorChoice::Facing)]))]
    color: ColorChoice,
}

impl SurfaceColors {
    /// The direction, if it is one for all.
    fn direction(&self) -> Option<DVec3> {
        if let ColorChoice::Along(direction) = self.color { Some(direction) } else { None }
    }
}
