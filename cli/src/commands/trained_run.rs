//! A trained run and the views to look at it from: what `evaluate` and `render` begin with.

use crate::progress::Console;
use clap::{Args, ValueHint};
use plenoxel::checkpoint;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Result;
use plenoxel::field::voxel_grid::GridShape;
use plenoxel::model::plenoxels::config::{Config, Sampling};
use plenoxel::model::{self, Model};
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::memory::Estimate;
use plenoxel::train::{About, ViewOptions};
use std::path::PathBuf;

/// Which run, and how to look at it.
#[derive(Debug, Args)]
pub struct TrainedRun {
    /// Run folder that `plenoxel train` or `plenoxel carve` wrote
    #[arg(value_hint = ValueHint::DirPath)]
    pub run: PathBuf,

    /// The grid that validation views liked best of those that were saved, where it is another than the last
    #[arg(long)]
    pub best: bool,

    /// Where the dataset is now [default: where it was when training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    pub data: Option<PathBuf>,

    /// Views to look from: train, val or test
    #[arg(long, help_heading = "Scene", default_value_t = Split::Test, value_parser = super::split)]
    pub split: Split,

    /// Reduce the images by this factor [default: as in training]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = super::whole::<usize>(1, super::MOST_REDUCTION))]
    pub downscale: Option<usize>,

    /// Samples on the longest ray through the box (preset paper: on every ray) [default: as the run's `evaluation` setting says]
    #[arg(long, value_name = "N", help_heading = "Rendering", value_parser = super::whole::<u32>(2, 100_000))]
    pub samples: Option<u32>,
}

/// What a run says of itself. Its views may be gone.
pub struct Found {
    pub folder: RunFolder,
    pub config: Config,
    pub preset: Option<String>,
    pub source: DataSource,
}

/// Its model, and how to render it.
pub struct Loaded {
    pub model: Box<dyn Model<f32>>,
    pub about: About,
    pub view: ViewOptions,
}

impl TrainedRun {
    /// Finds it.
    pub fn find(&self) -> Result<Found> {
        let (folder, mut config, record) = RunFolder::open(&self.run)?;
        let folder = if self.best { folder.with_best()? } else { folder };
        config.downscale = self.downscale.unwrap_or(config.downscale);
        let source = self.data.as_deref().map_or(record.data, DataSource::folder);
        Ok(Found { folder, config, preset: record.preset, source })
    }

    /// Whether it is looked at as figures of a run are defined: its last grid, on whole test views, sampled as its settings say.
    pub fn is_as_trained(&self) -> bool {
        !self.best && self.split == Split::Test && self.downscale.is_none() && self.samples.is_none()
    }

    /// Opens its views, of which some must be of the split.
    pub fn views(&self, found: &Found) -> Result<Dataset> {
        let dataset = found.source.reopen(&found.config)?;
        super::check_split(&dataset, self.split)?;
        Ok(dataset)
    }

    /// Reads its model, once memory is known to suffice: what `estimate` says of sampling, shape and number of voxels.
    pub fn load(
        &self,
        found: &Found,
        console: &Console<'_>,
        estimate: impl FnOnce(Sampling, &GridShape, usize) -> Estimate,
    ) -> Result<Loaded> {
        let path = found.folder.existing_checkpoint()?;
        let (header, voxels) = checkpoint::header(&path)?;
        let (shape, as_trained) = (header.shape(), found.config.evaluation);
        let sampling = self.samples.map_or(as_trained, |samples| as_trained.with_samples(samples, &shape));
        let estimate = estimate(sampling, &shape, voxels);
        console.note(&estimate.describe());
        estimate.check()?;
        let (model, about) = model::open(&path, &found.config)?;
        if about.background != found.config.background {
            console.note("warning: config.toml has another background than the model was trained with: figures and pictures are over that of config.toml");
        }
        Ok(Loaded { model, about, view: ViewOptions { background: found.config.background, samples: self.samples } })
    }
}

impl Found {
    /// Half the side of the box of its model, world length.
    pub fn half_width(&self) -> Result<f64> {
        let (header, _) = checkpoint::header(&self.folder.existing_checkpoint()?)?;
        Ok(header.shape().half_width)
    }
}
