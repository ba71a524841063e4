//! A training run from its settings to its final figures, as in `plenoxel train`. Progress is reported as [`Event`]s; nothing is printed.
//!
//! ```no_run
//! use plenoxel::model::plenoxels::config::Config;
//! use plenoxel::run::data::DataSource;
//! use plenoxel::run::training::{Event, RunSettings, train};
//!
//! let settings = RunSettings::new(Config::preset("fast")?, DataSource::folder("data/lego".as_ref()));
//! train(&settings, &mut |event| {
//!     if let Event::Step { report, .. } = event {
//!         println!("step {}: {:.2} dB", report.step, report.psnr);
//!     }
//! })?;
//! # Ok::<(), plenoxel::error::Error>(())
//! ```

mod best;
mod event;
mod initial;
mod job;
mod learning;
mod other;
mod preview;
mod started;
mod summary;

pub use event::{Event, Finished, Underway};
pub use job::Stopwatch;
pub use learning::StageSummary;
pub use summary::Summary;

use super::budget;
use super::data::DataSource;
use super::folder::RunFolder;
use crate::dataset::{Dataset, View};
use crate::error::{Error, Result};
use crate::geometry::Aabb;
use crate::loss;
use crate::model::plenoxels::config::Config;
use crate::model::plenoxels::{Objective, Trainer, objective};
use crate::run::pace::Begun;
use crate::text::clock;
use crate::train::{self, Model, StageProgress};
pub(super) use initial::InitialGrid;
use initial::InitialRun;
use started::{NewRun, OldRun, estimate, watched};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Settings of a new run.
pub struct RunSettings {
    /// Configuration of the training.
    pub config: Config,
    /// Preset of the config, for `run.json`.
    pub preset: Option<String>,
    /// Source of the views.
    pub data: DataSource,
    /// Run folder; `None` for `runs/<scene>-<n>` with the first free n.
    pub out: Option<PathBuf>,
    /// Overwrite an existing run in the folder.
    pub force: bool,
    /// Planned duration of training on this machine, in seconds; `None` for the steps of the config.
    pub time: Option<f64>,
    /// True if `time` is that of the whole run, from its beginning to the figures of the evaluation; at most half of what is left after
    /// reading is kept for the evaluation.
    pub with_evaluation: bool,
    /// Settings that do not affect the training.
    pub options: RunOptions,
}

/// Settings of a run that do not affect the training. They may change when a run is resumed.
pub struct RunOptions {
    /// Checkpoint interval, in seconds.
    pub checkpoint_every: f64,
    /// Preview interval, in seconds; infinity for no previews. Previews take less than 5 % of the time.
    pub preview_every: f64,
    /// Render the pictures of [`Event::Preview`]; otherwise only the validation PSNR is measured.
    pub pictures: bool,
    /// Keep the grid of each stage and evaluate it on the test views at the end.
    pub stage_psnr: bool,
    /// Maximum number of test views for the final evaluation, evenly spaced among all of them; 0 for no evaluation.
    pub test_views: usize,
    /// Include report.html in the memory estimate.
    pub report: bool,
    /// Largest number of pixels of a picture that a listener renders between steps, for the memory estimate; 0 for none.
    pub shown_pixels: usize,
    /// Called after each step: `true` saves the run and stops it.
    pub stop: Box<dyn Fn() -> bool + Send + Sync>,
    /// Called after each step: `true` saves a checkpoint.
    pub save: Box<dyn Fn() -> bool + Send + Sync>,
}

impl Default for RunOptions {
    fn default() -> Self {
        RunOptions {
            checkpoint_every: 300.0,
            preview_every: 10.0,
            pictures: false,
            stage_psnr: false,
            test_views: usize::MAX,
            report: false,
            shown_pixels: 0,
            stop: Box::new(|| false),
            save: Box::new(|| false),
        }
    }
}

impl RunSettings {
    /// Settings for a run with a config on some views, and defaults for everything else.
    pub fn new(config: Config, data: DataSource) -> Self {
        RunSettings {
            config,
            preset: None,
            data,
            out: None,
            force: false,
            time: None,
            with_evaluation: false,
            options: RunOptions::default(),
        }
    }

    /// Says what the time includes.
    fn included(&self) -> &'static str {
        if self.with_evaluation { " with evaluation" } else { "" }
    }
}

/// Outcome of a run.
#[derive(Debug)]
pub enum Outcome {
    /// The run is finished and has its final figures.
    Done(Box<Summary>),
    /// The run was stopped and saved. It can be resumed from its folder.
    Stopped {
        /// Steps taken.
        steps: u64,
        /// Steps of the whole run.
        total: u64,
        /// The run folder.
        folder: RunFolder,
    },
}

/// A listener for events. [`Event::Loading`] is sent from several threads.
pub type Listener<'l> = dyn FnMut(Event<'_>) + Send + 'l;

/// Trains Plenoxels with the losses of the config.
///
/// Errors: a setting is invalid, data cannot be read, a number is not finite, or a file cannot be written.
pub fn train(settings: &RunSettings, on: &mut Listener<'_>) -> Result<Outcome> {
    train_adding(settings, &loss::Objective::new, on)
}

/// Creates the losses that a program adds to those of a config, whatever model it names. It is called for each trainer of a run: those that measure the speed of
/// the machine have the same losses.
pub type MakeLosses<'l> = dyn Fn() -> loss::Objective<f32, ()> + 'l;

/// Trains the model that the config names with further losses. The config may then have no losses of its own.
///
/// Errors: those of [`train()`]; a parameter of the losses has the name of one of the config's.
pub fn train_adding(settings: &RunSettings, losses: &MakeLosses<'_>, on: &mut Listener<'_>) -> Result<Outcome> {
    match &settings.config {
        Config { tensorf: Some(recipe), .. } => other::train(settings, recipe, losses, on),
        Config { dvgo: Some(recipe), .. } => other::train(settings, recipe, losses, on),
        Config { nerf: Some(recipe), .. } => other::train(settings, recipe, losses, on),
        Config { ngp: Some(recipe), .. } => other::train(settings, recipe, losses, on),
        _ => train_plenoxels(settings, &|config, views| with_losses(config, || objective(config, views), losses), on),
    }
}

/// Adds losses to the objective of a config, which may have none.
fn with_losses<M: 'static>(
    config: &Config,
    own: impl FnOnce() -> Result<loss::Objective<f32, M>>,
    losses: &MakeLosses<'_>,
) -> Result<loss::Objective<f32, M>> {
    let losses = losses();
    let own = if config.losses.is_empty() && losses.names().next().is_some() { loss::Objective::new() } else { own()? };
    if let Some(param) = losses.params().iter().find(|param| own.param(param.name()).is_some()) {
        let found = format!("a loss of the settings has a parameter `{}`", param.name());
        return Err(Error::usage(format!("parameter {}", param.name()), found, "choose another name"));
    }
    Ok(own.joined(losses))
}

/// Trains Plenoxels with a custom objective. `objective` builds it from the config and the number of training views. The losses of the config are
/// used only if `objective` adds them, as [`plenoxels::objective`](objective()) does. If the run is planned by time, the objective is also built for the steps
/// that measure the speed of the machine.
///
/// Errors: those of [`train()`] and of `objective`.
pub fn train_with(
    settings: &RunSettings,
    objective: impl Fn(&Config, usize) -> Result<Objective<f32>>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    train_plenoxels(settings, &objective, on)
}

/// A function that builds an objective from a config and the number of training views.
type MakeObjective<'o> = dyn Fn(&Config, usize) -> Result<Objective<f32>> + 'o;

/// [`train_with`], compiled once.
fn train_plenoxels(settings: &RunSettings, objective: &MakeObjective<'_>, on: &mut Listener<'_>) -> Result<Outcome> {
    settings.config.check_stages()?;
    let mut run = NewRun::open(settings, on)?;
    let from = run.config.init_from.as_deref().map(InitialRun::open).transpose()?;
    // An initial grid has its own box.
    let half_width = from.as_ref().map_or(run.config.half_width, |from| from.header.shape().half_width);
    InitialRun::check_space(from.as_ref(), &run.dataset)?;
    run.check_cameras(Aabb::cube(half_width), on)?;
    if let Some(InitialRun { header, .. }) = from.as_ref().filter(|from| from.header.scene != run.dataset.name()) {
        on(Event::note(format!("the initial grid is of another scene: {}, not {}", header.scene, run.dataset.name())));
    }
    let estimate = estimate(&run.config, &run.dataset, from.as_ref().map(InitialRun::stored).as_ref(), &settings.options, on)?;
    let most_rows = estimate.most_rows(&run.config).unwrap_or(usize::MAX);
    run.saved = estimate.saved();
    let initial = from.as_ref().map(InitialRun::load).transpose()?;
    run.read(on)?;
    // Stages that are kept are evaluated too.
    let pictures = if settings.options.stage_psnr { 2.0 } else { 1.0 };
    if let Some(time) = run.time_budget(pictures) {
        on(Event::note("measuring the speed of this machine"));
        let NewRun { config, views, clocks, .. } = &mut run;
        *config = clocks.train.time(|| budget::on_time(config.clone(), views, time, initial.as_ref(), objective))?;
        let stages = config.stages.iter().map(|stage| format!("{} of {}³", stage.steps.unwrap_or_default(), stage.resolution));
        on(Event::note(format!(
            "planned for {}{}: steps {}",
            clock(time.seconds),
            settings.included(),
            stages.collect::<Vec<_>>().join(", ")
        )));
    }
    let objective = objective(&run.config, run.views.len())?;
    let NewRun { config, views, clocks, .. } = &mut run;
    let progress = Arc::new(StageProgress::default());
    let start = || {
        let trainer = Trainer::with_losses(config.clone(), views.clone(), objective, progress.clone())?.with_most_rows(most_rows);
        Ok(match &initial {
            Some(initial) => initial.begin(trainer),
            None => trainer,
        })
    };
    let trainer = clocks.train.time(|| watched(&progress, on, start))?;
    drop(initial);
    let half_width = trainer.grid().shape().half_width;
    if half_width != config.half_width {
        let chosen = if config.init_from.is_some() { "from the initial grid" } else { "from the silhouettes" };
        on(Event::note(format!("box: half width {half_width:.4}, {chosen}")));
    }
    if let scouts @ 1.. = trainer.model().scout_stages() {
        on(Event::note(format!("scout: {scouts} short stages first locate the objects, because there are no silhouettes")));
    }
    run.learn(Begun::new(trainer), &mut |_, _| None, on)
}

/// Trains a custom model. `start` builds its trainer from the config, the dataset and the training views. It may use any part of the config;
/// [`Config::train_options`] has the seed, the background and the rays per step. The run itself uses the background and the image settings. The
/// model is saved and evaluated with its [`Model`] methods. Its own settings ([`Model::settings`]) are part of its checkpoint.
///
/// Errors: those of [`train()`] and of `start`.
pub fn train_model<M: Model<f32>>(
    settings: &RunSettings,
    start: impl FnOnce(&Config, &Dataset, Arc<[View]>) -> Result<train::Trainer<f32, M>>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    if settings.time.is_some() {
        return Err(Error::usage("--time", "a custom model cannot be planned by time", "set a number of steps"));
    }
    let mut run = NewRun::open(settings, on)?;
    run.read(on)?;
    let NewRun { config, dataset, views, clocks, .. } = &mut run;
    let trainer = clocks.train.time(|| start(config, dataset, views.clone()))?;
    run.check_cameras(trainer.model().aabb(), on)?;
    run.learn(Begun::new(trainer), &mut |_, _| None, on)
}

/// Resumes a stopped run from its last checkpoint, with the losses of its config. `data` is the new source of the views if they have moved.
///
/// Errors: those of [`train()`]; the run has ended or saved no checkpoint.
pub fn resume(path: &Path, data: Option<DataSource>, options: &RunOptions, on: &mut Listener<'_>) -> Result<Outcome> {
    resume_adding(path, data, options, &loss::Objective::new, on)
}

/// Resumes a run started by [`train_adding`], with the same losses.
///
/// Errors: those of [`resume`] and of [`train_adding`].
pub fn resume_adding(
    path: &Path,
    data: Option<DataSource>,
    options: &RunOptions,
    losses: &MakeLosses<'_>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    match RunFolder::open(path)?.1 {
        Config { tensorf: Some(recipe), .. } => other::resume(path, &recipe, data, options, losses, on),
        Config { dvgo: Some(recipe), .. } => other::resume(path, &recipe, data, options, losses, on),
        Config { nerf: Some(recipe), .. } => other::resume(path, &recipe, data, options, losses, on),
        Config { ngp: Some(recipe), .. } => other::resume(path, &recipe, data, options, losses, on),
        _ => resume_plenoxels(path, data, options, &|config, views| with_losses(config, || objective(config, views), losses), on),
    }
}

/// Resumes a run started by [`train_with`], with the same objective.
///
/// Errors: those of [`resume`] and of `objective`.
pub fn resume_with(
    path: &Path,
    data: Option<DataSource>,
    options: &RunOptions,
    objective: impl Fn(&Config, usize) -> Result<Objective<f32>>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    resume_plenoxels(path, data, options, &objective, on)
}

/// [`resume_with`], compiled once.
fn resume_plenoxels(
    path: &Path,
    data: Option<DataSource>,
    options: &RunOptions,
    objective: &MakeObjective<'_>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    let mut run = OldRun::open(path, data, options, on)?;
    if run.record.is_of_own_model() {
        let found = format!("this run has a model of another kind, `{}`", run.record.model);
        return Err(Error::input(path, found, "resume it with the program that started it (run::training::resume_model)"));
    }
    // The initial run may be gone.
    let from = run.config.init_from.as_deref().and_then(|path| InitialRun::open(path).ok());
    let estimate = estimate(&run.config, &run.dataset, from.as_ref().map(InitialRun::stored).as_ref(), options, on)?;
    let most_rows = estimate.most_rows(&run.config).unwrap_or(usize::MAX);
    run.read(on)?;
    let objective = objective(&run.config, run.views.len())?;
    let progress = Arc::new(StageProgress::default());
    let start = || Trainer::with_losses(run.config.clone(), run.views.clone(), objective, progress.clone());
    let trainer = watched(&progress, on, start)?.with_most_rows(most_rows);
    run.learn(trainer, on)
}

/// Resumes a run started by [`train_model`], with the same `start`.
///
/// Errors: those of [`resume`] and of `start`.
pub fn resume_model<M: Model<f32>>(
    path: &Path,
    data: Option<DataSource>,
    options: &RunOptions,
    start: impl FnOnce(&Config, &Dataset, Arc<[View]>) -> Result<train::Trainer<f32, M>>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    let mut run = OldRun::open(path, data, options, on)?;
    run.read(on)?;
    let trainer = start(&run.config, &run.dataset, run.views.clone())?;
    run.learn(trainer, on)
}
