//! `plenoxel import`: turns a file of svox2 or PlenOctrees into a run.

use super::export::svox2::scale_of;
use super::{as_flag, background, number};
use crate::progress::Console;
use crate::report::Report;
use clap::{Args, ValueHint};
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Result;
use plenoxel::formats::{self, Format};
use plenoxel::model::plenoxels::Plenoxels;
use plenoxel::model::plenoxels::config::{ColorKind, Config};
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::{Imported, NewFolder, RunKind, RunRecord};
use plenoxel::run::memory;
use plenoxel::run::training::Stopwatch;
use plenoxel::train::About;
use serde::Serialize;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  plenoxel import ckpt.npz --out runs/lego                      a checkpoint of svox2
  plenoxel import ckpt.npz --data data/lego --out runs/lego     with the views that `evaluate` and `render` take
  plenoxel import tree.npz --out runs/tree                      an octree of PlenOctrees
  plenoxel evaluate runs/lego

The result is a run folder for evaluate, render, export and report, and for `train --init-from`. Background spheres, learned bases and \
normalized device coordinates of svox2 are not read. Colors of PlenOctrees that depend on the direction are approximated.";

/// Turn a checkpoint of svox2 (ckpt.npz) or an octree of PlenOctrees into a run
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct ImportArgs {
    /// File written by svox2 or svox, or by `plenoxel export`
    #[arg(value_hint = ValueHint::FilePath)]
    file: PathBuf,

    /// Dataset folder with the views of the scene [default: none]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Length of one world unit in the file; svox2 multiplies the camera positions by this number when it reads a dataset [default: 2/3 for a
    /// checkpoint of svox2 with NeRF-synthetic --data, as svox2; 1 otherwise]
    #[arg(long, value_name = "S", help_heading = "Scene", value_parser = number(f64::MIN_POSITIVE), allow_negative_numbers = true)]
    scene_scale: Option<f64>,

    /// Background color, which the files do not have: white, black, or three numbers in [0, 1]
    #[arg(long, value_name = "COLOR", help_heading = "Scene", default_value = "white", value_parser = background, allow_hyphen_values = true)]
    background: [f64; 3],

    /// Run folder to write [default: runs/<name of the file or of the scene>-<n>]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,

    /// Overwrite an existing run in the folder
    #[arg(long, help_heading = "Output")]
    force: bool,

    /// Write no report.html; without --data there is none
    #[arg(long, help_heading = "Output")]
    no_report: bool,
}

/// Reads the file and writes a run folder.
pub fn run(args: &ImportArgs, console: &Console<'_>) -> Result<()> {
    let source = args.data.as_deref().map_or(DataSource::None, DataSource::folder);
    let background = args.background.map(|c| c as f32);
    let dataset = args.data.is_some().then(|| source.open(&Config { background, ..Config::default() })).transpose()?;
    let stem = || args.file.file_stem().map_or_else(|| "grid".to_owned(), |stem| stem.to_string_lossy().into_owned());
    let scene = dataset.as_ref().map_or_else(stem, |dataset| dataset.name().to_owned());
    let folder = NewFolder::choose(args.out.as_deref(), &scene, args.force)?;

    let mut clock = Stopwatch::default();
    // The scale depends on the format, which is in the file.
    let format = formats::format(&args.file)?;
    let in_svox2 = |dataset: &Dataset| if format == Format::Svox2 { scale_of(dataset.format()) } else { 1.0 };
    let scale = args.scene_scale.unwrap_or_else(|| dataset.as_ref().map_or(1.0, in_svox2));
    let formats::Imported { grid, warnings } = clock.time(|| formats::open(&args.file, scale)).map_err(as_flag)?;
    warnings.iter().for_each(|warning| console.note(&format!("warning: {warning}")));
    let (shape, voxels) = (*grid.shape(), grid.lattice().present());
    console.note(&format!(
        "{}: {voxels} voxels at {}³ in [-{half}, {half}]³, scene_scale {scale:.4}",
        format.name(),
        shape.resolution,
        half = shape.half_width
    ));

    let folder = folder.create()?;
    let (sh_degree, sh_offset) = shape.color.harmonics();
    let config = Config {
        background,
        half_width: shape.half_width,
        color: ColorKind::Sh,
        sh_degree,
        sh_offset,
        interpolation: shape.interpolation,
        stages: Vec::new(),
        ..Config::default()
    };
    let file = args.file.canonicalize().unwrap_or_else(|_| args.file.clone());
    let imported = Imported { file, format: format.name().to_owned(), scene_scale: scale };
    let about = dataset.as_ref().map_or(format.name(), Dataset::format);
    let to_world = dataset.as_ref().map(|dataset| dataset.normalization().to_world);
    let record = RunRecord { imported: Some(imported), to_world, ..RunRecord::of_scene(RunKind::Imported, &scene, about, &source) };
    folder.describe(&config, &record)?;
    let model = Plenoxels::of_grid(&config, grid);
    folder.save(&model, &About { scene: scene.clone(), background, seed: config.seed, step: 0 })?;
    let summary = Summary {
        seconds: clock.seconds(),
        peak_memory_bytes: memory::peak(),
        format: format.name(),
        resolution: shape.resolution,
        voxels,
        scene,
        run: folder.path().display().to_string(),
    };
    folder.write_result(&summary)?;
    console.result(&format!("imported a {} in {:.2} s", format.name(), summary.seconds))?;
    console.result(&format!("run folder: {}", folder.path().display()))?;
    console.record(&summary)?;
    if let Some(dataset) = dataset.filter(|dataset| !args.no_report && dataset.count(Split::Train) > 0) {
        let report = Report { folder: &folder, config: &config, record: &record, dataset: &dataset, model: Some(&model) };
        console.note(&report.write(console)?);
    }
    Ok(())
}

/// Final figures. `seconds` is the time of reading the file.
#[derive(Debug, Serialize)]
struct Summary {
    seconds: f64,
    peak_memory_bytes: Option<u64>,
    format: &'static str,
    resolution: usize,
    voxels: usize,
    scene: String,
    run: String,
}
