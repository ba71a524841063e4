//! `plenoxel report`: regenerates report.html of a run.

use crate::progress::Console;
use crate::report::Report;
use clap::{Args, ValueHint};
use plenoxel::error::Result;
use plenoxel::model;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::memory::{Estimate, Stored};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel report runs/lego                        write runs/lego/report.html
  plenoxel report runs/lego --data elsewhere/lego

`train` and `carve` also write this page. It is a single file that needs no network. It has the settings, curves, pictures and results, and an
interactive viewer of the grid, or of a grid that is baked from a field without voxels. The grid of the viewer is quantized to 8 and 16 bits, and
resampled if it exceeds 30 MB. The page states its PSNR and that of the model.";

/// Regenerate report.html of a run, with pictures, curves and an interactive viewer
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct ReportArgs {
    /// Run folder written by `plenoxel train` or `plenoxel carve`
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// Dataset folder, if it has moved [default: that of the training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,
}

/// Writes the report.
pub fn run(args: &ReportArgs, console: &Console<'_>) -> Result<()> {
    write(&args.run, args.data.as_deref().map(DataSource::folder), console)
}

/// Writes the report of a run; `data` is the new source of its views if they have moved.
pub fn write(run: &Path, data: Option<DataSource>, console: &Console<'_>) -> Result<()> {
    let (folder, config, record) = RunFolder::open(run)?;
    let folder = folder.shared("RUN")?;
    folder.remove_fragments()?;
    let source = data.unwrap_or_else(|| record.data.clone());
    let dataset = source.reopen(&config)?;
    let path = folder.existing_checkpoint()?;
    let model = if model::KINDS.contains(&&model::kind(&path)?[..]) {
        let estimate = Estimate::of_report(&config, &Stored::read(&path)?);
        console.note(&estimate.describe());
        estimate.check()?;
        Some(model::open(&path, &config)?.0)
    } else {
        console.note(&format!("the report has no interactive viewer, because the model is of kind `{}`", record.model));
        None
    };
    let report = Report { folder: &folder, config: &config, record: &record, dataset: &dataset, model: model.as_deref() };
    console.result(&report.write(console)?)
}
