//! The training itself: steps, previews, metrics, and the state from which a run resumes.

use super::best::BestGrid;
use super::event::Underway;
use super::preview::{Look, Preview};
use super::{Clocks, Event, Job, Listener, Stopped};
use crate::camera::Camera;
use crate::checkpoint::Header;
use crate::dataset::{Split, View};
use crate::error::{Error, Result};
use crate::evaluate::{self, Viewer};
use crate::field::voxel_grid::VoxelGrid;
use crate::model::plenoxels::Trainer;
use crate::run::metrics::{History, MetricsFile, Observation};
use crate::train::{Model, PlannedStage, ViewOptions};
use ndarray::Array3;
use serde::Serialize;
use serde_json::json;
use std::time::Instant;

/// A trained grid and how it came about.
pub struct Learned {
    pub grid: VoxelGrid<f32>,
    pub metrics: MetricsFile,
    /// Mean of the training views.
    pub mean_image: Option<Array3<f32>>,
    pub stages: Vec<StageSummary>,
    pub steps: u64,
}

/// A stage in the final figures.
#[derive(Debug, Serialize)]
pub struct StageSummary {
    resolution: Option<usize>,
    steps: u64,
    /// Seconds of training when it ended.
    seconds: f64,
    /// Mean PSNR of the test views, if the grid was kept until they were read.
    pub psnr: Option<f64>,
    #[serde(skip)]
    pub(super) grid: Option<VoxelGrid<f32>>,
}

impl Job<'_> {
    /// Trains; only the steps are on the clock for training. [`Stopped`] if the run was stopped: then everything that it needs to resume is saved.
    pub fn learn(
        &self,
        mut trainer: Trainer<f32>,
        (mut metrics, past): (MetricsFile, History),
        preview: Preview,
        views: &[View],
        clocks: &mut Clocks,
        on: &mut Listener<'_>,
    ) -> Result<std::result::Result<Learned, Stopped>> {
        let Job { folder, config, dataset, options, .. } = *self;
        let plan = trainer.plan().to_vec();
        let total = trainer.total_steps();
        let mut stages = summaries(&past, &plan);
        let mut best = BestGrid::of(folder, &past);
        let header = |grid: &_, steps| Header::new(grid, dataset.name(), config.background, config.seed, steps);
        let first = |split| dataset.cameras(split).into_iter().next();
        let mut preview = preview.begin(first(Split::Test).or(first(Split::Train)).filter(|_| options.pictures));
        let run = Underway { folder, config, dataset };
        on(Event::Started { run, plan: &plan, prunes_from: trainer.model().prunes_from(), history: &past });
        let mut losses = past.losses;
        let mut facts = trainer.model().facts();
        let mut saved = Instant::now();
        let last_psnr = loop {
            let report = match clocks.train.time(|| trainer.step()) {
                Ok(Some(report)) => report,
                Ok(None) => break None,
                // There is no checkpoint: the lines and the curve so far show how it came to this.
                Err(e) => return Err(failed(e, &losses, &mut metrics, on)),
            };
            losses.push(report.loss);
            let stage = plan[report.stage];
            let last = report.step + 1 == total;
            let due = saved.elapsed().as_secs_f64() >= options.checkpoint_every;
            let save = !last && (due || (options.stop)());
            if report.step == stage.first {
                facts = trainer.model().facts();
            }
            let model = trainer.model();
            let viewer = || Viewer::of(model, &ViewOptions::over(config.background));
            let seconds = clocks.train.seconds();
            let look = preview.look(viewer, report.ends_stage, save, config.background);
            let validation_psnr = look.as_ref().and_then(|look| look.psnr);
            let observation = Observation { facts: facts.clone(), validation_psnr, seconds };
            metrics.step(&report, &plan, &observation, save)?;
            on(Event::Step { report: &report, observation: &observation });
            if report.ends_stage {
                on(Event::StageEnded { stage, losses: &losses, see: &|camera: &Camera| viewer().see(camera) });
                let kept = (options.stage_psnr && !last).then(|| copy(trainer.grid()));
                stages.push(StageSummary::new(&stage, seconds, kept));
            }
            if let Some(Look { picture: Some((picture, target)), .. }) = &look {
                let (step, ends_stage) = (report.step, report.ends_stage);
                on(Event::Preview { step, ends_stage, picture, target: target.as_ref(), metrics: &mut metrics });
            }
            if save {
                metrics.sync()?;
                match trainer.save(&folder.state(), dataset.name()) {
                    Ok(()) => {
                        best.saved(validation_psnr, trainer.grid(), &header(trainer.grid(), report.step + 1), on);
                        on(Event::Saved { steps: report.step + 1 });
                    }
                    // There may be room on the disk the next time.
                    Err(e) if !(options.stop)() => on(Event::note(format!("not saved: {e}"))),
                    Err(e) => return Err(e),
                }
                saved = Instant::now();
            }
            if last {
                break validation_psnr;
            }
            if save && (options.stop)() {
                on(Event::Trained);
                return Ok(Err(Stopped(report.step + 1, total)));
            }
        };
        let grid = trainer.into_grid();
        folder.save(&grid, &header(&grid, total))?;
        best.conclude(last_psnr, on);
        folder.remove_state()?;
        let stopped = (options.stop)();
        on(Event::Trained);
        if stopped {
            return Ok(Err(Stopped(total, total)));
        }
        let mean_image = self.mean_image(views);
        Ok(Ok(Learned { grid, metrics, mean_image, stages, steps: total }))
    }

    /// What a run has learned that was killed between its last step and its final figures.
    pub fn learned(
        &self,
        plan: &[PlannedStage],
        (metrics, past): (MetricsFile, History),
        views: &[View],
        on: &mut Listener<'_>,
    ) -> Result<Learned> {
        let Job { folder, config, dataset, .. } = *self;
        on(Event::Started { run: Underway { folder, config, dataset }, plan, prunes_from: None, history: &past });
        on(Event::Trained);
        let (grid, header) = folder.load()?;
        Ok(Learned { grid, metrics, mean_image: self.mean_image(views), stages: summaries(&past, plan), steps: header.step })
    }

    /// What test views are compared with, if there are any.
    fn mean_image(&self, views: &[View]) -> Option<Array3<f32>> {
        if self.dataset.count(Split::Test) > 0 { evaluate::mean_image(views, self.config.background) } else { None }
    }
}

/// Writes down that training failed, and gives the error back, or that of writing.
fn failed(error: Error, losses: &[f64], metrics: &mut MetricsFile, on: &mut Listener<'_>) -> Error {
    on(Event::Failed { losses });
    let written = metrics.append(&json!({ "step": losses.len(), "failure": error.to_string() }));
    written.err().unwrap_or(error)
}

impl StageSummary {
    fn new(planned: &PlannedStage, seconds: f64, grid: Option<VoxelGrid<f32>>) -> Self {
        StageSummary { resolution: planned.resolution, steps: planned.steps, seconds, psnr: None, grid }
    }
}

/// Summaries of the stages that ended before.
fn summaries(past: &History, plan: &[PlannedStage]) -> Vec<StageSummary> {
    let ended = past.stages.iter().filter_map(|&(index, seconds)| Some((plan.get(index)?, seconds)));
    ended.map(|(planned, seconds)| StageSummary::new(planned, seconds, None)).collect()
}

/// A grid with the values that `grid` has now: the tables are shared until training changes them.
fn copy(grid: &VoxelGrid<f32>) -> VoxelGrid<f32> {
    grid.with_density(grid.density.tensor().detach())
}
