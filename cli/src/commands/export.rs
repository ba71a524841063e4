//! `plenoxel export`: exports the grid of a run to files for other programs.

mod mesh;
mod plenoctree;
mod ply;
pub mod svox2;
mod vox;

use super::{check_box, numbers};
use crate::progress::{Console, is_stdout};
use clap::{Args, Subcommand, ValueHint};
use glam::DVec3;
use plenoxel::checkpoint::{self, Header};
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::{self, plenoxels};
use plenoxel::run::folder::{RunFolder, RunRecord};
use plenoxel::run::memory::Estimate;
use plenoxel::space::Space;
use plenoxel::tensor_file::TensorFile;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel export ply runs/lego       a colored point cloud, for CloudCompare or MeshLab
  plenoxel export vox runs/lego       voxels, for MagicaVoxel
  plenoxel export mesh runs/lego      a surface mesh, for Blender and other readers of PLY, OBJ, GLB or STL
  plenoxel export svox2 runs/lego     a checkpoint, for svox2 (Plenoxels)
  plenoxel export plenoctree runs/lego  an octree, for svox and volrend (PlenOctrees)
  plenoxel export ply --help          the flags of a format";

/// Export the grid of a run as a point cloud, voxels, a mesh, or a file of svox2 or PlenOctrees
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
    Svox2(svox2::Svox2Args),
    #[command(name = "plenoctree")]
    PlenOctree(plenoctree::PlenOctreeArgs),
}

/// Exports a run.
pub fn run(args: &ExportArgs, console: &Console<'_>) -> Result<()> {
    match &args.what {
        What::Ply(args) => ply::run(args, console),
        What::Vox(args) => vox::run(args, console),
        What::Mesh(args) => mesh::run(args, console),
        What::Svox2(args) => svox2::run(args, console),
        What::PlenOctree(args) => plenoctree::run(args, console),
    }
}

/// The run to export, and the file to write.
#[derive(Debug, Args)]
struct Exported {
    /// Run folder written by `plenoxel train` or `plenoxel carve`
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// Use best.safetensors, the checkpoint with the best validation PSNR, instead of the final grid
    #[arg(long)]
    best: bool,

    /// File to write, replacing an existing file; - for stdout [default: a file in RUN/exports]
    #[arg(long, short, value_name = "FILE", help_heading = "Output", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
}

/// An opened run.
struct Opened {
    folder: RunFolder,
    config: Config,
    record: RunRecord,
    header: Header,
    grid: VoxelGrid<f32>,
}

impl Exported {
    /// Opens the run and reads its grid, once there is enough memory for it and for `bytes_per_voxel`.
    ///
    /// Errors: the output file has the wrong extension; the run cannot be read; there is not enough memory.
    fn open(&self, console: &Console<'_>, format: &str, bytes_per_voxel: u64) -> Result<Opened> {
        if let Some(out) = self.out.as_deref().filter(|out| !is_stdout(out) && ending(out).as_deref() != Some(format)) {
            let found = format!("{} does not end in .{format}", out.display());
            return Err(Error::usage("--out", found, format!("choose a name that ends in .{format}")));
        }
        let (folder, config, record) = RunFolder::open(&self.run)?;
        let folder = if self.best { folder.with_best()? } else { folder };
        let path = folder.existing_checkpoint()?;
        let kind = model::kind(&path)?;
        if kind != plenoxels::KIND {
            // Checkpoints without a space are of a box.
            check_box(&path, TensorFile::open(&path)?.fact::<Option<Space>>("space")?.unwrap_or_default())?;
            let run = self.run.display();
            return Err(Error::input(
                &path,
                format!("a model of kind `{kind}` has no voxels"),
                format!("run `plenoxel bake {run}` first, and export its result"),
            ));
        }
        let (header, voxels) = checkpoint::header(&path)?;
        check_box(&path, header.coordinates.space)?;
        let estimate = Estimate::of_export(&header.shape(), voxels, bytes_per_voxel);
        console.note(&estimate.describe());
        estimate.check()?;
        let (grid, header) = checkpoint::load(&path)?;
        Ok(Opened { folder, config, record, header, grid })
    }

    /// Writes the requested file, or the file `name` in the exports of the run. Returns its path.
    fn write(&self, folder: &RunFolder, name: &str, bytes: &[u8], console: &Console<'_>) -> Result<PathBuf> {
        let file = self.out.clone().map_or_else(|| folder.create_export(name), Ok)?;
        console.write_file(&file, bytes)?;
        Ok(file)
    }
}

/// The file extension, in lower case.
fn ending(path: &Path) -> Option<String> {
    path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase())
}

/// Help of `--min-alpha`.
const MIN_ALPHA: &str = "Minimum alpha of a voxel, 1 - exp(-density * side); voxels without density are never kept";

/// Parses a minimum alpha, which is below 1.
fn min_alpha(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|share| (0.0..1.0).contains(share)).ok_or_else(|| "expected a number in [0, 1)".to_owned())
}

/// Choice of a constant color for a view-dependent one.
#[derive(Clone, Copy, Debug, PartialEq)]
enum ColorChoice {
    /// The mean color in the training views.
    Seen,
    /// The mean over all directions.
    Mean,
    /// The color seen against the normal of the surface.
    Facing,
    /// The color seen along a unit direction, from the viewer into the scene.
    Along(DVec3),
}

/// Parses a choice: one of `words`, or a direction.
fn color(words: &'static [(&'static str, ColorChoice)]) -> impl Fn(&str) -> std::result::Result<ColorChoice, String> + Clone {
    move |text| {
        if let Some((_, choice)) = words.iter().find(|(word, _)| *word == text) {
            return Ok(*choice);
        }
        let direction = numbers::<3>(text).ok().and_then(|d| DVec3::from(d).try_normalize());
        let words = || words.iter().map(|(word, _)| format!("{word}, ")).collect::<String>();
        direction
            .map(ColorChoice::Along)
            .ok_or_else(|| format!("expected {}or a direction of three numbers such as 0,0,-1, not all 0", words()))
    }
}

/// The flags for the colors of a surface.
#[derive(Debug, Args)]
struct SurfaceColors {
    /// View direction for view-dependent color: facing, against the surface normal, or one direction X,Y,Z for all points, from the viewer
    /// into the scene
    #[arg(long, value_name = "facing|X,Y,Z", help_heading = "Colors", default_value = "facing", allow_hyphen_values = true,
          value_parser = color(&[("facing", ColorChoice::Facing)]))]
    color: ColorChoice,
}

impl SurfaceColors {
    /// The direction, if it is the same for all points.
    fn direction(&self) -> Option<DVec3> {
        if let ColorChoice::Along(direction) = self.color { Some(direction) } else { None }
    }
}
