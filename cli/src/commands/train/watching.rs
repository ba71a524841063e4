//! Who looks on while a run trains: its lines and bar, the curve of the loss, pictures. No bit of what is trained depends on any of them.

use super::pictures::Pictures;
use super::preview::{Look, Preview};
use crate::curves::loss_svg;
use crate::progress::{Console, Training};
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::metrics::{History, MetricsFile, Observation};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::plenoxels::Trainer;
use plenoxel::train::{PlannedStage, Report};
use serde_json::json;

/// All that is told of a run while it trains.
pub struct Watching<'a, 'c> {
    folder: &'a RunFolder,
    config: &'a Config,
    console: &'a Console<'c>,
    plan: Vec<PlannedStage>,
    metrics: MetricsFile,
    progress: Training<'a, 'c>,
    pictures: Pictures<'a>,
    preview: Preview,
    losses: Vec<f64>,
    voxels: usize,
}

impl<'a, 'c> Watching<'a, 'c> {
    /// Begins to watch a run, or one with a past.
    pub fn begin(
        (folder, config, console): (&'a RunFolder, &'a Config, &'a Console<'c>),
        trainer: &Trainer<f32>,
        (metrics, past): (MetricsFile, History),
        mut pictures: Pictures<'a>,
        preview: Preview,
    ) -> Self {
        let plan = trainer.plan().to_vec();
        pictures.earlier_stages(&past, &plan);
        let progress = console.training(&plan, trainer.prunes_from(), past.seconds);
        let voxels = trainer.grid().lattice().present();
        Watching { folder, config, console, plan, metrics, progress, pictures, preview, losses: past.losses, voxels }
    }

    /// A step was taken, after so many seconds of training; `save` says that the run can go on from here. Returns the PSNR of validation views, if
    /// they were looked at.
    pub fn step(&mut self, report: &Report, grid: &VoxelGrid<f32>, seconds: f64, save: bool) -> Result<Option<f64>> {
        self.losses.push(report.loss);
        if report.step == self.plan[report.stage].first {
            self.voxels = grid.lattice().present();
        }
        let (validation_psnr, picture) = match self.preview.look(grid, report.ends_stage, save, self.config) {
            Some(Look { psnr, picture }) => (psnr, picture.and_then(|picture| self.console.drawn(picture))),
            None => (None, None),
        };
        let seen = Observation { voxels: self.voxels, validation_psnr, seconds };
        self.metrics.step(report, &self.plan, seen, save)?;
        self.progress.step(report, seen);
        if report.ends_stage {
            self.console.drawn(self.draw_loss());
            self.console.drawn(self.pictures.stage(report.stage, grid));
            if let Some((png, size)) = picture {
                self.console.drawn(self.metrics.picture(report.step, size, &png));
            }
        }
        Ok(validation_psnr)
    }

    /// Training has failed: the lines and the curve so far stay, to show how it came to this.
    pub fn failed(&mut self, error: &Error) -> Result<()> {
        self.metrics.append(&json!({ "step": self.losses.len(), "failure": error.to_string() }))?;
        self.draw_loss()
    }

    /// Has what was written on the disk.
    pub fn sync(&self) -> Result<()> {
        self.metrics.sync()
    }

    /// There will be no more steps.
    pub fn end(self) -> (MetricsFile, Pictures<'a>) {
        (self.metrics, self.pictures)
    }

    fn draw_loss(&self) -> Result<()> {
        let title = format!("Training loss of {}", self.folder.path().file_name().unwrap_or_default().display());
        self.folder.write_loss(&loss_svg(&self.losses, &self.plan, &title))
    }
}
