//! A trained run and the views to look at it from: what `evaluate` and `render` begin with.

use crate::data::DataSource;
use crate::evaluation::with_samples;
use crate::memory::Estimate;
use crate::progress::Console;
use crate::run_folder::RunFolder;
use clap::{Args, ValueHint};
use plenoxel::checkpoint::Header;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Result;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::train::config::{Config, Sampling};
use std::path::PathBuf;

/// Which run, and how to look at it.
#[derive(Debug, Args)]
pub struct TrainedRun {
    /// Run folder that `plenoxel train` or `plenoxel carve` wrote
    #[arg(value_hint = ValueHint::DirPath)]
    pub run: PathBuf,

    /// Where the dataset is now [default: where it was when training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    pub data: Option<PathBuf>,

    /// Views to look from
    #[arg(long, help_heading = "Scene", default_value_t = Split::Test, value_parser = super::split)]
    pub split: Split,

    /// Reduce the images by this factor [default: as in training]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = super::whole::<usize>(1, super::MOST_REDUCTION))]
    pub downscale: Option<usize>,

    /// Samples on the longest ray through the box (preset paper: on every ray) [default: as the run's `evaluation` setting says]
    #[arg(long, value_name = "N", help_heading = "Rendering", value_parser = super::whole::<u32>(2, 100_000))]
    pub samples: Option<u32>,
}

/// All that there is to know of a run.
pub struct Opened {
    pub folder: RunFolder,
    pub config: Config,
    pub preset: Option<String>,
    pub source: DataSource,
    pub dataset: Dataset,
    pub sampling: Sampling,
    pub grid: VoxelGrid<f32>,
    pub header: Header,
}

impl TrainedRun {
    /// Opens it, once memory is known to suffice; `compare` says that the images of the split will be needed.
    pub fn open(&self, console: &Console<'_>, compare: bool) -> Result<Opened> {
        let (folder, mut config, record) = RunFolder::open(&self.run)?;
        config.downscale = self.downscale.unwrap_or(config.downscale);
        let source = self.data.as_deref().map_or(record.data, DataSource::folder);
        let dataset = source.reopen(&config)?;
        super::check_split(&dataset, self.split)?;
        let (header, voxels) = folder.header()?;
        let shape = header.shape();
        let sampling = self.samples.map_or(config.evaluation, |samples| with_samples(config.evaluation, samples, &shape));
        let estimate = Estimate::of_evaluation(&config, sampling, &shape, voxels, &dataset, compare.then_some(self.split));
        console.note(&estimate.describe());
        estimate.check()?;
        let (grid, header) = folder.load()?;
        Ok(Opened { folder, config, preset: record.preset, source, dataset, sampling, grid, header })
    }
}
