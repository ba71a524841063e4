//! Results of a run, read from its folder.

use crate::commands::background_name;
use plenoxel::checkpoint;
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::folder::RunFolder;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A finished run.
#[derive(Debug)]
pub struct Measured {
    pub folder: RunFolder,
    pub figures: Figures,
}

/// Results of a run; missing ones are `None`.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct Figures {
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    pub ssim_same: Option<f64>,
    /// Seconds of training or carving.
    pub seconds: Option<f64>,
    pub rays: Option<u64>,
    pub steps: Option<u64>,
    pub peak_memory_bytes: Option<u64>,
    /// Stored voxels, from the checkpoint if it exists.
    pub voxels: Option<usize>,
    pub resolution: Option<usize>,
    pub background: [f32; 3],
    /// Number of test views, and their size in pixels.
    pub views: Option<usize>,
    pub width: Option<usize>,
    pub height: Option<usize>,
}

/// Failure of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// Exit code; 128 plus the number of the signal if a signal ended the process.
    pub code: u8,
    /// Last message of the run.
    pub error: String,
}

/// The figures that a table shows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Scores {
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    pub seconds: Option<f64>,
}

impl Measured {
    /// Reads the run in a folder; `None` if it has not ended.
    ///
    /// Errors: the folder is not a run folder.
    pub fn read(path: &Path) -> Result<Option<Self>> {
        let (folder, config, _) = RunFolder::open(path)?;
        Ok(Figures::of(&folder, &config)?.map(|figures| Measured { folder, figures }))
    }

    /// A summary in one line.
    pub fn sentence(&self) -> String {
        let Figures { psnr, ssim, seconds, .. } = self.figures;
        let psnr = psnr.map_or("no test views".to_owned(), |psnr| format!("PSNR {psnr:.2} dB"));
        let ssim = ssim.map_or(String::new(), |ssim| format!(", SSIM {ssim:.4}"));
        format!("{psnr}{ssim}, {}", seconds.map_or("time unknown".to_owned(), |seconds| format!("{seconds:.1} s")))
    }

    /// A description of the test views.
    pub fn views(&self) -> String {
        let Figures { views: Some(views), width: Some(width), height: Some(height), background, .. } = &self.figures else {
            return "no test views".to_owned();
        };
        format!("{views} views of {width} × {height} over {}", background_name(*background))
    }
}

impl Figures {
    /// Reads the results of a run; `None` if it has not ended.
    ///
    /// Errors: those of [`RunFolder::result`].
    pub fn of(folder: &RunFolder, config: &Config) -> Result<Option<Self>> {
        let figures = folder.figures()?.and_then(|figures| serde_json::from_value::<Figures>(figures).ok());
        let Some(figures) = figures else { return Ok(None) };
        let voxels = checkpoint::header(&folder.checkpoint()).ok().map(|(_, voxels)| voxels).or(figures.voxels);
        Ok(Some(Figures { background: config.background, voxels, ..figures }))
    }

    pub fn scores(&self) -> Scores {
        Scores { psnr: self.psnr, ssim: self.ssim, seconds: self.seconds }
    }
}

impl Scores {
    /// A statistic of each figure; `None` if one of the values is missing.
    pub fn over(all: impl Iterator<Item = Scores> + Clone, of: fn(&[f64]) -> f64) -> Scores {
        let statistic = |figure: fn(Scores) -> Option<f64>| {
            let values: Vec<f64> = all.clone().map(figure).collect::<Option<_>>()?;
            (!values.is_empty()).then(|| of(&values))
        };
        Scores { psnr: statistic(|s| s.psnr), ssim: statistic(|s| s.ssim), seconds: statistic(|s| s.seconds) }
    }
}

/// The mean of the values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The standard deviation of the values, with their number as the divisor, as in the source paper and in numpy.
pub fn deviation(values: &[f64]) -> f64 {
    let mean = mean(values);
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}
