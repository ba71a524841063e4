//! The training itself: steps, what looks on, and what is saved to go on from.

use super::best_grid::BestGrid;
use super::pictures::Pictures;
use super::preview::Preview;
use super::watching::Watching;
use super::{Clocks, Job, interrupt};
use crate::images::Rgb;
use plenoxel::checkpoint::Header;
use plenoxel::dataset::View;
use plenoxel::error::Result;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::run::evaluation;
use plenoxel::run::metrics::{History, MetricsFile};
use plenoxel::model::plenoxels::Trainer;
use plenoxel::train::PlannedStage;
use serde::Serialize;
use std::time::Instant;

/// A trained grid and how it came about.
pub struct Learned<'a> {
    pub grid: VoxelGrid<f32>,
    pub metrics: MetricsFile,
    pub pictures: Pictures<'a>,
    /// The training views on the mean.
    pub mean_image: Option<Rgb>,
    pub stages: Vec<StageSummary>,
    pub steps: u64,
}

/// A stage in the final figures.
#[derive(Debug, Serialize)]
pub struct StageSummary {
    resolution: usize,
    steps: u64,
    /// Of training, when it ended.
    seconds: f64,
    /// Of the test views, if the grid was kept until they were read.
    pub psnr: Option<f64>,
    #[serde(skip)]
    pub grid: Option<VoxelGrid<f32>>,
}

impl<'a> Job<'a, '_> {
    /// The training; only its steps are on the clock for training. `None` if it was interrupted: then all that is needed to go on is saved.
    pub fn learn(
        &'a self,
        mut trainer: Trainer<f32>,
        (metrics, past): (MetricsFile, History),
        preview: Preview,
        views: &[View],
        clocks: &mut Clocks,
    ) -> Result<Option<Learned<'a>>> {
        let Job { folder, config, dataset, console, .. } = *self;
        let keep_stages = self.args.keeps_stages(&self.record.data);
        let plan = trainer.plan().to_vec();
        let total = trainer.total_steps();
        let mut stages = summaries(&past, &plan);
        let mut best = BestGrid::of(folder, &past, console);
        let header = |grid: &_, steps| Header::new(grid, dataset.name(), config.background, config.seed, steps);
        let pictures = Pictures::new(folder, config, dataset, !self.args.no_images)?;
        let preview = preview.begin(pictures.camera().map(|camera| (folder.image("preview.png"), camera)));
        let mut watching = Watching::begin((folder, config, console), &trainer, (metrics, past), pictures, preview);
        let interrupt = interrupt::Watch::begin();
        let mut saved = Instant::now();
        let last_psnr = loop {
            let report = match clocks.train.time(|| trainer.step()) {
                Ok(Some(report)) => report,
                Ok(None) => break None,
                // There is no checkpoint.
                Err(e) => return watching.failed(&e).and(Err(e)),
            };
            let seconds = clocks.train.seconds();
            let last = report.step + 1 == total;
            let due = saved.elapsed().as_secs_f64() >= self.args.checkpoint_every;
            let save = !last && (due || interrupt.requested());
            let grid = trainer.grid();
            let validation_psnr = watching.step(&report, grid, seconds, save)?;
            if report.ends_stage {
                stages.push(StageSummary::new(&plan[report.stage], seconds, (keep_stages && !last).then(|| copy(grid))));
            }
            if save {
                watching.sync()?;
                match trainer.save(&folder.state(), dataset.name()) {
                    Ok(()) => best.saved(validation_psnr, trainer.grid(), &header(trainer.grid(), report.step + 1)),
                    // There may be room on the disk the next time.
                    Err(e) if !interrupt.requested() => console.note(&format!("not saved: {e}")),
                    Err(e) => return Err(e),
                }
                saved = Instant::now();
            }
            if last {
                break validation_psnr;
            }
            if save && interrupt.requested() {
                drop(watching);
                let remedy = format!("go on with: plenoxel train --resume {}", folder.path().display());
                let text = format!("interrupted after step {} of {total}, saved; {remedy}", report.step + 1);
                console.error(&text, interrupt::EXIT_CODE);
                return Ok(None);
            }
        };
        let (metrics, pictures) = watching.end();
        let grid = trainer.into_grid();
        folder.save(&grid, &header(&grid, total))?;
        best.conclude(last_psnr);
        folder.remove_state()?;
        if interrupt.requested() {
            let text = format!("interrupted after the last step; its figures: plenoxel train --resume {}", folder.path().display());
            console.error(&text, interrupt::EXIT_CODE);
            return Ok(None);
        }
        drop(interrupt);
        let mean_image = evaluation::mean_image(views, config.background);
        Ok(Some(Learned { grid, metrics, pictures, mean_image, stages, steps: total }))
    }

    /// What a run has learned that was killed between its last step and its final figures.
    pub fn learned(&'a self, plan: &[PlannedStage], (metrics, past): (MetricsFile, History), views: &[View]) -> Result<Learned<'a>> {
        let Job { folder, config, dataset, .. } = *self;
        let mut pictures = Pictures::new(folder, config, dataset, !self.args.no_images)?;
        pictures.earlier_stages(&past, plan);
        let (grid, header) = folder.load()?;
        let mean_image = evaluation::mean_image(views, config.background);
        Ok(Learned { grid, metrics, pictures, mean_image, stages: summaries(&past, plan), steps: header.step })
    }
}

impl StageSummary {
    fn new(planned: &PlannedStage, seconds: f64, grid: Option<VoxelGrid<f32>>) -> Self {
        StageSummary { resolution: planned.stage.resolution, steps: planned.steps, seconds, psnr: None, grid }
    }
}

/// Of the stages that ended before.
fn summaries(past: &History, plan: &[PlannedStage]) -> Vec<StageSummary> {
    let ended = past.stages.iter().filter_map(|&(index, seconds)| Some((plan.get(index)?, seconds)));
    ended.map(|(planned, seconds)| StageSummary::new(planned, seconds, None)).collect()
}

/// A grid with the values that `grid` has now: the tables are shared until training changes them.
fn copy(grid: &VoxelGrid<f32>) -> VoxelGrid<f32> {
    grid.with_density(grid.density.tensor().detach())
}
