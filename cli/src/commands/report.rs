//! `plenoxel report`: the page about a run, made again.

use crate::progress::Console;
use crate::report::Report;
use clap::{Args, ValueHint};
use plenoxel::checkpoint;
use plenoxel::error::Result;
use plenoxel::model;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::memory::Estimate;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel report runs/lego                        writes runs/lego/report.html
  plenoxel report runs/lego --data elsewhere/lego

`train` and `carve` write it too. It needs no other file and no network: settings, curves, pictures, figures, and the grid itself to look
around in, with colors and densities of 8 and 16 bits; from 30 MB on it is made coarser, and the page says what that costs.";

/// Write the page about a run again, with pictures, curves and an interactive view
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct ReportArgs {
    /// Run folder that `plenoxel train` or `plenoxel carve` wrote
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// Where the dataset is now [default: where it was when training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,
}

/// Writes the page.
pub fn run(args: &ReportArgs, console: &Console<'_>) -> Result<()> {
    write(&args.run, args.data.as_deref().map(DataSource::folder), console)
}

/// Writes the page about the run in a folder; `data` is the source of its views now, if it is not where it was.
pub fn write(run: &Path, data: Option<DataSource>, console: &Console<'_>) -> Result<()> {
    let (folder, config, record) = RunFolder::open(run)?;
    let folder = folder.shared("RUN")?;
    folder.remove_fragments()?;
    let source = data.unwrap_or_else(|| record.data.clone());
    let dataset = source.reopen(&config)?;
    let path = folder.existing_checkpoint()?;
    let model = if model::KINDS.contains(&&model::kind(&path)?[..]) {
        let (header, voxels) = checkpoint::header(&path)?;
        let estimate = Estimate::of_report(&config, &header.shape(), voxels);
        console.note(&estimate.describe());
        estimate.check()?;
        Some(model::open(&path, &config)?.0)
    } else {
        console.note(&format!("the model is of kind `{}`: the page has no interactive view of it", record.model));
        None
    };
    let report = Report { folder: &folder, config: &config, record: &record, dataset: &dataset, model: model.as_deref() };
    console.result(&report.write(console)?)
}
