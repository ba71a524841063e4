//! The common part of new and resumed runs: evaluation of the trained model, the final figures, and the clocks.

use super::learning::Learned;
use super::started::load;
use super::{Event, Listener, Outcome, RunOptions, Summary, event};
use crate::camera::Camera;
use crate::dataset::{Dataset, Split, View};
use crate::error::Result;
use crate::evaluate::{self, Scores, Viewer};
use crate::model::plenoxels::config::Config;
use crate::run::evenly_spaced;
use crate::run::figures::Figures;
use crate::run::folder::{RunFolder, RunRecord};
use crate::run::memory;
use crate::train::{self, Model, ViewOptions};
use serde::Serialize;
use std::time::{Duration, Instant};

/// A new or resumed run.
pub struct Job<'a> {
    pub folder: &'a RunFolder,
    pub config: Config,
    pub dataset: &'a Dataset,
    pub record: &'a RunRecord,
    pub options: &'a RunOptions,
    /// Warnings about its cameras and settings.
    pub warnings: &'a [String],
}

/// Looks at a run after a step, whose seconds of training it is given; returns the new configuration if it has changed the plan.
pub type Adjust<'a, M> = dyn FnMut(&mut train::Trainer<f32, M>, f64) -> Option<Config> + 'a;

/// A stopped run: steps taken, and total steps.
pub struct Stopped(pub u64, pub u64);

impl Job<'_> {
    /// Indices of the test views for the final evaluation.
    pub fn test_views(&self) -> Vec<usize> {
        test_views(self.dataset, self.options)
    }

    /// Cameras of the test views for the final evaluation.
    pub fn test_cameras(&self) -> Vec<Camera> {
        test_cameras(self.dataset, self.options)
    }

    /// Evaluates the model on the test views and writes the final figures.
    pub fn conclude<M: Model<f32>>(
        &self,
        learned: std::result::Result<Learned<M>, Stopped>,
        mut clocks: Clocks,
        on: &mut Listener<'_>,
    ) -> Result<Outcome> {
        let Job { folder, ref config, dataset, .. } = *self;
        let mut learned = match learned {
            Ok(learned) => learned,
            // Without the lock, so that the caller can resume the run.
            Err(Stopped(steps, total)) => return Ok(Outcome::Stopped { steps, total, folder: RunFolder::at(folder.path()) }),
        };
        let test = clocks.load.time(|| load(dataset, Split::Test, &self.test_views(), &self.record.data, on))?;
        let view = ViewOptions::over(config.background);
        let scores = compare(&mut learned, &test, &view, &mut clocks, on)?;
        let (rays, samples) = learned.metrics.counts();
        let (validation_psnr, best_validation) = learned.metrics.validation();
        let means = [("psnr/test", scores.psnr()), ("ssim/test", scores.ssim())];
        let background_psnr = evaluate::background_psnr(&test, config.background);
        let mean_image_psnr = learned.mean_image.and_then(|image| evaluate::constant_psnr(&test, &image, config.background));
        let mut warnings = self.warnings.to_vec();
        let below = means[0].1.zip(mean_image_psnr).filter(|(psnr, mean)| psnr < mean).map(|(psnr, mean)| worse("test", psnr, mean));
        let learned_nothing = learned.training_psnr.filter(|[psnr, mean]| psnr < mean).map(|[psnr, mean]| worse("training", psnr, mean));
        for warning in below.into_iter().chain(learned_nothing) {
            on(Event::warning(&warning));
            warnings.push(warning);
        }
        let summary = Summary {
            figures: Figures::new(&scores, Split::Test, dataset, config, &learned.model, &view),
            baseline_background_psnr: background_psnr,
            baseline_mean_image_psnr: mean_image_psnr,
            seconds: clocks.train.seconds(),
            seconds_planned: self.record.seconds_planned,
            with_evaluation: self.record.with_evaluation,
            seconds_load: clocks.load.seconds(),
            seconds_evaluate: clocks.evaluate.seconds(),
            peak_memory_bytes: memory::peak(),
            steps: learned.steps,
            rays,
            samples,
            scene: dataset.name().to_owned(),
            preset: self.record.preset.clone(),
            run: folder.path().display().to_string(),
            validation_psnr,
            best_validation,
            poses: learned.poses,
            outlier_views: learned.outlier_views,
            stages: learned.stages,
            warnings,
            per_view: scores.per_view,
        };
        folder.write_result(&summary)?;
        learned.metrics.conclude(&Final { result: &summary }, &means)?;
        let about = event::Finished { folder, config, record: self.record, dataset, model: &learned.model, test: &test };
        on(Event::Evaluated { summary: &summary, run: about });
        Ok(Outcome::Done(Box::new(summary)))
    }
}

/// Indices of the test views of a dataset for the final evaluation.
fn test_views(dataset: &Dataset, options: &RunOptions) -> Vec<usize> {
    evenly_spaced(dataset.count(Split::Test), options.test_views)
}

/// Cameras of the test views of a dataset for the final evaluation.
pub fn test_cameras(dataset: &Dataset, options: &RunOptions) -> Vec<Camera> {
    let cameras = dataset.cameras(Split::Test);
    test_views(dataset, options).into_iter().map(|view| cameras[view]).collect()
}

/// Scores of the final model, and of the kept models of earlier stages.
fn compare<M: Model<f32>>(
    learned: &mut Learned<M>,
    test: &[View],
    options: &ViewOptions,
    clocks: &mut Clocks,
    on: &mut Listener<'_>,
) -> Result<Scores> {
    let total = (learned.kept.len() + 1) * test.len();
    let mut done = 0;
    let start = Instant::now();
    let mut listening = Stopwatch::default();
    for (stage, show) in learned.kept.drain(..) {
        let scores = Viewer::new(show, options.background).in_tiles(learned.model.tile()).compare(test, |_, _, _, _| {
            done += 1;
            listening.time(|| on(Event::Evaluating { done, total }));
            Ok(())
        })?;
        learned.stages[stage].psnr = scores.psnr();
    }
    let viewer = Viewer::of(&learned.model, options);
    let aabb = learned.model.aabb();
    let half_width = 0.5 * (aabb.max - aabb.min).max_element();
    let scores = viewer.compare(test, |number, view, target, picture| {
        done += 1;
        listening.time(|| {
            on(Event::Evaluating { done, total });
            on(Event::Compared { number, view, target, picture, half_width });
        });
        Ok(())
    })?;
    clocks.evaluate.0 += start.elapsed().saturating_sub(listening.0);
    if let Some(last) = learned.stages.last_mut() {
        last.psnr = scores.psnr();
    }
    Ok(scores)
}

/// A warning for a PSNR below that of the mean training image.
fn worse(split: &str, psnr: f64, mean: f64) -> String {
    format!(
        "the {split} PSNR of {psnr:.2} dB is below that of the mean training image, {mean:.2} dB: there were too few steps, or the poses or \
         intrinsics do not match the images"
    )
}

/// The last line of the metrics.
#[derive(Serialize)]
struct Final<'a> {
    #[serde(rename = "final")]
    result: &'a Summary,
}

/// Durations of loading, training and evaluation. The time of listeners is not counted.
#[derive(Debug, Default)]
pub struct Clocks {
    pub load: Stopwatch,
    pub train: Stopwatch,
    pub evaluate: Stopwatch,
}

/// A stopwatch that accumulates durations.
#[derive(Debug, Default)]
pub struct Stopwatch(pub Duration);

impl Stopwatch {
    /// Runs `f` and adds its duration.
    pub fn time<R>(&mut self, f: impl FnOnce() -> R) -> R {
        let start = Instant::now();
        let result = f();
        self.0 += start.elapsed();
        result
    }

    /// Returns the accumulated seconds.
    pub fn seconds(&self) -> f64 {
        self.0.as_secs_f64()
    }
}
