//! A finished run and its views, for `evaluate`, `render` and `view`.

use crate::progress::Console;
use clap::{Args, ValueHint};
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::{Error, Result};
use plenoxel::geometry::Similarity;
use plenoxel::model::plenoxels::config::{Config, Sampling};
use plenoxel::model::{self, Model};
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::memory::{Estimate, Stored};
use plenoxel::train::{About, ViewOptions};
use std::path::PathBuf;

/// The run, its model, and the sampling.
#[derive(Debug, Args)]
pub struct TrainedModel {
    /// Run folder written by `plenoxel train` or `plenoxel carve`
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// Use best.safetensors, the checkpoint with the best validation PSNR, instead of the final grid
    #[arg(long)]
    pub best: bool,

    /// Dataset folder, if it has moved [default: that of the training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    pub data: Option<PathBuf>,

    /// Number of samples on the longest ray through the box (preset paper: on every ray) [default: the `evaluation` setting of the run]
    #[arg(long, value_name = "N", help_heading = "Rendering", value_parser = super::whole::<u32>(2, 100_000), allow_negative_numbers = true)]
    samples: Option<u32>,
}

/// A run, and a choice of its views.
#[derive(Debug, Args)]
pub struct TrainedRun {
    #[command(flatten)]
    pub of: TrainedModel,

    /// Split of the views: train, val or test
    #[arg(long, help_heading = "Scene", default_value_t = Split::Test, value_parser = super::split)]
    pub split: Split,

    /// Downscale the images by this factor [default: that of the training]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = super::whole::<usize>(1, super::MOST_REDUCTION), allow_negative_numbers = true)]
    pub downscale: Option<usize>,
}

/// An opened run. Its dataset may no longer exist.
pub struct Found {
    pub folder: RunFolder,
    pub config: Config,
    pub preset: Option<String>,
    pub source: DataSource,
    /// From the coordinates of the dataset to the world of the run.
    pub to_world: Similarity,
}

/// The model of a run, and its render options.
pub struct Loaded {
    pub model: Box<dyn Model<f32>>,
    pub about: About,
    pub view: ViewOptions,
}

impl TrainedRun {
    /// Opens the run folder.
    pub fn find(&self) -> Result<Found> {
        let mut found = self.of.find()?;
        found.config.downscale = self.downscale.unwrap_or(found.config.downscale);
        Ok(found)
    }

    /// True for the evaluation that defines the scores of a run: its final grid, on the test views at full size, sampled as configured.
    pub fn is_as_trained(&self) -> bool {
        !self.of.best && self.split == Split::Test && self.downscale.is_none() && self.of.samples.is_none()
    }

    /// Opens the dataset.
    ///
    /// Errors: it has no views of the split.
    pub fn views(&self, found: &Found) -> Result<Dataset> {
        let dataset = found.source.reopen(&found.config)?;
        super::check_split(&dataset, self.split)?;
        Ok(dataset)
    }
}

impl TrainedModel {
    /// Opens the run folder.
    pub fn find(&self) -> Result<Found> {
        let (folder, config, record) = RunFolder::open(&self.run)?;
        let folder = if self.best { folder.with_best()? } else { folder };
        let source = self.data.as_deref().map_or(record.data, DataSource::folder);
        Ok(Found { folder, config, preset: record.preset, source, to_world: record.to_world.unwrap_or_default() })
    }

    /// Opens the dataset, if it still exists. If the user gave its folder, it must exist. `otherwise` is the consequence of its absence.
    pub fn views_if_any(&self, found: &Found, console: &Console<'_>, otherwise: &str) -> Result<Option<Dataset>> {
        match found.source.reopen(&found.config) {
            Ok(dataset) => Ok(Some(dataset)),
            Err(error) if self.data.is_some() => Err(error),
            Err(error) => {
                console.note(&format!("the views of the run cannot be read ({error}); {otherwise}"));
                Ok(None)
            }
        }
    }

    /// Reads the model. `estimate` computes the memory from the sampling, the shape and the number of voxels.
    ///
    /// Errors: there is not enough memory; the model cannot be read.
    pub fn load(&self, found: &Found, console: &Console<'_>, estimate: impl FnOnce(Sampling, &Stored) -> Estimate) -> Result<Loaded> {
        let path = found.folder.existing_checkpoint()?;
        let (stored, as_trained) = (Stored::read(&path)?, found.config.evaluation);
        let sampling = match (self.samples, &stored) {
            (None, _) => as_trained,
            (Some(samples), Stored::Grid { shape, .. }) => as_trained.with_samples(samples, shape),
            (Some(_), Stored::Other { recipe, .. }) => {
                let found = format!("the settings of the model `{}` determine its samples", recipe.kind());
                return Err(Error::usage("--samples", found, "leave out --samples"));
            }
        };
        let estimate = estimate(sampling, &stored);
        console.note(&estimate.describe());
        estimate.check()?;
        let (model, about) = model::open(&path, &found.config)?;
        if about.background != found.config.background {
            console.note("warning: the background of config.toml differs from that of the training; that of config.toml is used");
        }
        Ok(Loaded { model, about, view: ViewOptions { background: found.config.background, samples: self.samples } })
    }
}

impl Found {
    /// Half the side of the box of the model, in world units.
    pub fn half_width(&self) -> Result<f64> {
        Ok(Stored::read(&self.folder.existing_checkpoint()?)?.half_width())
    }
}
