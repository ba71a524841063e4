//! The training loop: steps, previews, metrics and checkpoints.

use super::best::BestModel;
use super::event::Underway;
use super::job::{Adjust, Clocks, Job, Stopped};
use super::preview::{GLANCE, Look, Moment, Preview};
use super::started::watched;
use super::{Event, Listener};
use crate::camera::Camera;
use crate::dataset::{Split, View};
use crate::error::{Error, Result};
use crate::evaluate::{self, Viewer};
use crate::loss::ViewWeight;
use crate::run::metrics::{History, MetricsFile, Observation};
use crate::run::pace::Begun;
use crate::train::poses::PoseFigures;
use crate::train::{About, Model, PlannedStage, RenderFn, Trainer, ViewOptions};
use ndarray::Array3;
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Number of training views for the PSNR of the mean image.
const VIEWS_OF_MEAN: usize = 16;
/// Smoothing factor of the error of training rays.
const SMOOTHED: f64 = 0.05;

/// A trained model with the figures of its training.
pub struct Learned<M> {
    pub model: M,
    pub metrics: MetricsFile,
    /// Mean of the training views.
    pub mean_image: Option<Array3<f32>>,
    /// Smoothed PSNR of the training rays at the end, and PSNR of the mean training image; `None` if no steps were taken.
    pub training_psnr: Option<[f64; 2]>,
    pub stages: Vec<StageSummary>,
    /// Renderers of the models at the end of earlier stages, if kept, with their index in `stages`.
    pub kept: Vec<(usize, RenderFn<'static, f32>)>,
    pub steps: u64,
    /// Corrections of the training views' poses, if they were refined and steps were taken.
    pub poses: Option<PoseFigures>,
    /// Training views that counted less at the end; `None` without the loss `outlier_views`, or if no steps were taken.
    pub outlier_views: Option<Vec<ViewWeight>>,
}

/// Saves a trained model outside its run folder if that cannot be written: in the parent folder, the working directory, or the folder for
/// temporary files. Returns the path.
fn rescued(run: &Path, model: &impl Model<f32>, about: &About) -> Option<PathBuf> {
    let beside = run.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = run.file_name().unwrap_or_default().to_string_lossy();
    let places = [beside.to_owned(), PathBuf::from("."), std::env::temp_dir()];
    let files = places.map(|folder| folder.join(format!("{name}-{}.safetensors", std::process::id())));
    files.into_iter().find(|file| model.save(file, about).is_ok())
}

/// A stage in the final figures.
#[derive(Debug, Serialize)]
pub struct StageSummary {
    resolution: Option<usize>,
    steps: u64,
    /// Seconds of training at its end.
    seconds: f64,
    /// Mean test PSNR, if the model of the stage was kept.
    pub psnr: Option<f64>,
}

impl Job<'_> {
    /// Trains the model; only the steps count as training time. `reports` are of the steps that were taken before this run had a folder. Returns [`Stopped`] if
    /// the run was stopped and its state was saved.
    #[expect(clippy::too_many_arguments, reason = "each is needed once")]
    pub fn learn<M: Model<f32>>(
        &mut self,
        begun: Begun<M>,
        adjust: &mut Adjust<'_, M>,
        (mut metrics, past): (MetricsFile, History),
        preview: Preview,
        views: &[View],
        clocks: &mut Clocks,
        on: &mut Listener<'_>,
    ) -> Result<std::result::Result<Learned<M>, Stopped>> {
        let Job { folder, dataset, record, options, .. } = *self;
        let Begun { mut trainer, reports } = begun;
        let mut plan = trainer.plan().to_vec();
        let mut total = trainer.total_steps();
        let mut stages = summaries(&past, &plan);
        let mut kept = Vec::new();
        let mut best = BestModel::of(folder, &past);
        let background = self.config.background;
        let options_of_view = ViewOptions::over(background);
        let first = |split| dataset.cameras(split).into_iter().next();
        let mut preview = preview.begin(first(Split::Test).or(first(Split::Train)).filter(|_| options.pictures), self.test_cameras());
        let run = Underway { folder, config: &self.config, dataset };
        on(Event::Started { run, plan: &plan, test_views: self.test_views().len(), history: &past });
        if let Some(&stage) = plan.first().filter(|_| trainer.steps_taken() == reports.len() as u64) {
            on(Event::Initial { stage, see: &|camera: &Camera| Viewer::of(trainer.model(), &options_of_view).glance(camera, GLANCE) });
        }
        let mut losses = past.losses;
        let mut facts = trainer.model().facts();
        let mut saved = Instant::now();
        let (mut mean_squared_error, mut taken) = (0.0, false);
        let mut reports = reports.into_iter();
        let last_psnr = loop {
            let begins = plan.iter().any(|stage| stage.first == trainer.steps_taken());
            let progress = if begins { trainer.model().progress() } else { None };
            let (report, replayed) = reports.next().unzip();
            let mut step = || trainer.step();
            let report = match report.map_or_else(
                || {
                    clocks.train.time(|| match &progress {
                        Some(progress) => watched(progress, on, step),
                        None => step(),
                    })
                },
                |report| Ok(Some(report)),
            ) {
                Ok(Some(report)) => report,
                Ok(None) => break None,
                // There is no checkpoint: the metrics so far show what happened.
                Err(e) => return Err(failed(e, &losses, &mut metrics, on)),
            };
            losses.push(report.loss);
            let error = 10f64.powf(-0.1 * report.psnr);
            mean_squared_error += if taken { SMOOTHED * (error - mean_squared_error) } else { error };
            taken = true;
            let stage = plan[report.stage];
            let last = report.step + 1 == total;
            let due = saved.elapsed().as_secs_f64() >= options.checkpoint_every;
            // The run neither stops nor saves after a step that was taken before: the trainer is further.
            let goes_on = !last && report.step + 1 == trainer.steps_taken();
            let stops = goes_on && (options.stop)();
            let save = goes_on && ((options.save)() || due || stops);
            if report.step == stage.first {
                facts = trainer.model().facts();
            }
            let model = trainer.model();
            let viewer = || Viewer::of(model, &options_of_view);
            let seconds = replayed.unwrap_or_else(|| clocks.train.seconds());
            let moment = match (last && best.is_kept(), report.ends_stage, save) {
                (true, _, _) => Moment::Comparison,
                (_, true, _) => Moment::StageEnd,
                (_, _, true) => Moment::Checkpoint,
                _ => Moment::Step,
            };
            let look = preview.look(viewer, moment, background);
            let validation_psnr = look.as_ref().and_then(|look| look.psnr);
            let evaluation_seconds = look.as_ref().map(|look| look.evaluation_seconds);
            let observation = Observation { facts: facts.clone(), validation_psnr, seconds, evaluation_seconds };
            metrics.step(&report, &plan, &observation, save)?;
            on(Event::Step { report: &report, observation: &observation, model });
            if report.ends_stage {
                on(Event::StageEnded { stage, losses: &losses, see: &|camera: &Camera| viewer().glance(camera, GLANCE) });
                kept.extend(
                    (options.stage_psnr && !last).then(|| model.frozen(&options_of_view)).flatten().map(|show| (stages.len(), show)),
                );
                stages.push(StageSummary::new(&stage, seconds));
            }
            if let Some(Look { picture: Some((picture, target)), .. }) = &look {
                let (step, ends_stage) = (report.step, report.ends_stage);
                on(Event::Preview { step, ends_stage, picture, target: target.as_ref(), metrics: &mut metrics });
            }
            if save {
                metrics.sync()?;
                match folder.check_identity().and_then(|()| trainer.save(&folder.state(), dataset.name())) {
                    Ok(()) => {
                        best.saved(validation_psnr, trainer.model(), &trainer.about(dataset.name()), on);
                        on(Event::Saved { steps: report.step + 1 });
                    }
                    // The next attempt may succeed.
                    Err(e) if !stops => on(Event::note(format!("the checkpoint was not saved: {e}"))),
                    Err(e) => return Err(e),
                }
                saved = Instant::now();
            }
            if last {
                break validation_psnr;
            }
            if stops {
                on(Event::Trained);
                return Ok(Err(Stopped(report.step + 1, total)));
            }
            if goes_on && let Some(config) = adjust(&mut trainer, seconds) {
                self.config = config;
                plan = trainer.plan().to_vec();
                total = trainer.total_steps();
                metrics.plan(total);
                if let Err(e) = folder.check_identity().and_then(|()| folder.describe(&self.config, record)) {
                    on(Event::note(format!("the adjusted plan was not written to the run folder: {e}")));
                }
                on(Event::Planned { plan: &plan });
            }
        };
        let about = trainer.about(dataset.name());
        let poses = trainer.pose_figures();
        if let Some(poses) = &poses {
            on(Event::note(format!("corrections of the training views' poses: {poses}")));
        }
        let outlier_views = trainer.outlier_views();
        if let Some(outliers) = outlier_views.as_ref().filter(|outliers| !outliers.is_empty()) {
            let all: Vec<String> = outliers.iter().map(|view| format!("{} (weight {:.2})", view.name, view.weight)).collect();
            on(Event::note(format!("training views with a much larger error than the others, which count less: {}", all.join(", "))));
        }
        let model = trainer.into_model();
        if let Err(e) = folder.save(&model, &about) {
            let kept = match rescued(folder.path(), &model, &about) {
                Some(place) => {
                    format!("the trained model was saved as {}; move it to checkpoint.safetensors in the run folder", place.display())
                }
                None => "the trained model was not saved".to_owned(),
            };
            let again = match folder.existing_state() {
                Ok(_) => "; `plenoxel train --resume` continues from the last checkpoint",
                Err(_) => "",
            };
            on(Event::note(format!("{kept}{again}")));
            return Err(e);
        }
        best.conclude(last_psnr, on);
        folder.remove_state()?;
        let stopped = (options.stop)();
        on(Event::Trained);
        if stopped {
            return Ok(Err(Stopped(total, total)));
        }
        let mean_image = self.mean_image(views);
        let of_mean =
            mean_image.as_ref().and_then(|image| evaluate::constant_psnr(&views[..views.len().min(VIEWS_OF_MEAN)], image, background));
        let training_psnr = of_mean.map(|of_mean| [-10.0 * mean_squared_error.log10(), of_mean]).filter(|_| taken);
        Ok(Ok(Learned { model, metrics, mean_image, training_psnr, stages, kept, steps: total, poses, outlier_views }))
    }

    /// Returns the trained model of a run that was killed between its last step and its final figures; `trainer` is a new trainer of the run.
    pub fn learned<M: Model<f32>>(
        &self,
        trainer: Trainer<f32, M>,
        plan: &[PlannedStage],
        (metrics, past): (MetricsFile, History),
        views: &[View],
        on: &mut Listener<'_>,
    ) -> Result<Learned<M>> {
        let Job { folder, ref config, dataset, .. } = *self;
        on(Event::Started { run: Underway { folder, config, dataset }, plan, test_views: self.test_views().len(), history: &past });
        on(Event::Trained);
        let (model, about) = trainer.into_model_of(&folder.existing_checkpoint()?)?;
        let (mean_image, stages) = (self.mean_image(views), summaries(&past, plan));
        Ok(Learned {
            model,
            metrics,
            mean_image,
            training_psnr: None,
            stages,
            kept: Vec::new(),
            steps: about.step,
            poses: None,
            outlier_views: None,
        })
    }

    /// Mean training image, the baseline of the test views, if there are any.
    fn mean_image(&self, views: &[View]) -> Option<Array3<f32>> {
        if self.test_views().is_empty() { None } else { evaluate::mean_image(views, self.config.background) }
    }
}

/// Records in the metrics that training failed. Returns the error, or that of writing the metrics.
fn failed(error: Error, losses: &[f64], metrics: &mut MetricsFile, on: &mut Listener<'_>) -> Error {
    on(Event::Failed { losses });
    let written = metrics.append(&json!({ "step": losses.len(), "failure": error.to_string() }));
    written.err().unwrap_or(error)
}

impl StageSummary {
    fn new(planned: &PlannedStage, seconds: f64) -> Self {
        StageSummary { resolution: planned.resolution, steps: planned.steps, seconds, psnr: None }
    }
}

/// Summaries of the stages that ended before the run was resumed.
fn summaries(past: &History, plan: &[PlannedStage]) -> Vec<StageSummary> {
    let ended = past.stages.iter().filter_map(|&(index, seconds)| Some((plan.get(index)?, seconds)));
    ended.map(|(planned, seconds)| StageSummary::new(planned, seconds)).collect()
}
