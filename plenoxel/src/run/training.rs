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
mod learning;
mod other;
mod preview;
mod summary;

pub use event::{Event, Finished, Underway};
pub use learning::StageSummary;
pub use summary::Summary;

use super::budget;
use super::data::DataSource;
use super::evenly_spaced;
use super::folder::{NewFolder, RunFolder, RunKind, RunRecord};
use super::machine;
use super::memory::{self, Estimate};
use super::metrics::{History, MetricsFile};
use super::settings;
use crate::checkpoint;
use crate::dataset::{Dataset, Split, View};
use crate::error::{Error, Result};
use crate::evaluate::{self, Scores, Viewer};
use crate::files;
use crate::geometry::Aabb;
use crate::loss;
use crate::model::plenoxels::config::Config;
use crate::model::plenoxels::{self, Objective, Trainer, objective};
use crate::run::figures::Figures;
use crate::run::pace::Begun;
use crate::text::clock;
use crate::train::{self, Model, PlannedStage, StageProgress, ViewOptions};
use learning::Learned;
use preview::Preview;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

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
            stop: Box::new(|| false),
            save: Box::new(|| false),
        }
    }
}

impl RunSettings {
    /// Settings for a run with a config on some views, and defaults for everything else.
    pub fn new(config: Config, data: DataSource) -> Self {
        RunSettings { config, preset: None, data, out: None, force: false, time: None, options: RunOptions::default() }
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
    let from = run.config.init_from.as_deref().map(RunFolder::open).transpose()?;
    let carved = from.as_ref().is_some_and(|(_, _, record)| record.is_carved());
    let initial = from.map(|(folder, ..)| folder.existing_checkpoint()).transpose()?;
    let known = initial.as_deref().map(checkpoint::header).transpose()?;
    // An initial grid has its own box.
    let half_width = known.as_ref().map_or(run.config.half_width, |(header, _)| header.shape().half_width);
    run.dataset.space().require_box(plenoxels::KIND)?;
    run.check_cameras(Aabb::cube(half_width), on)?;
    if let Some((header, _)) = known.as_ref().filter(|(header, _)| header.scene != run.dataset.name()) {
        on(Event::note(format!("the initial grid is of another scene: {}, not {}", header.scene, run.dataset.name())));
    }
    let bytes = known.map_or(0, |(header, voxels)| voxels * header.shape().voxel_bytes());
    let estimate = estimate(&run.config, &run.dataset, bytes as u64, &settings.options, on)?;
    let most_rows = estimate.most_rows(&run.config).unwrap_or(usize::MAX);
    run.saved = estimate.saved();
    let initial = initial.as_deref().map(checkpoint::load).transpose()?.map(|(grid, _)| grid);
    run.read(on)?;
    if let Some(seconds) = settings.time {
        on(Event::note("measuring the speed of this machine"));
        let NewRun { config, views, clocks, .. } = &mut run;
        *config = clocks.train.time(|| budget::on_time(config.clone(), views, seconds, objective))?;
        let stages = config.stages.iter().map(|stage| format!("{} of {}³", stage.steps.unwrap_or_default(), stage.resolution));
        on(Event::note(format!("planned for {}: steps {}", clock(seconds), stages.collect::<Vec<_>>().join(", "))));
    }
    let objective = objective(&run.config, run.views.len())?;
    let NewRun { config, views, clocks, .. } = &mut run;
    let progress = Arc::new(StageProgress::default());
    let start = || {
        let trainer = Trainer::with_losses(config.clone(), views.clone(), objective, progress.clone())?.with_most_rows(most_rows);
        Ok(initial.iter().fold(trainer, if carved { Trainer::starting_from_carved } else { Trainer::starting_from }))
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

/// A new run.
struct NewRun<'s> {
    settings: &'s RunSettings,
    /// The config, with planned steps.
    config: Config,
    dataset: Dataset,
    folder: NewFolder,
    /// The training views; empty until they are read.
    views: Arc<[View]>,
    preview: Preview,
    clocks: Clocks,
    /// Expected size of a saved state, in bytes.
    saved: u64,
    /// Warnings about the cameras.
    warnings: Vec<String>,
}

impl<'s> NewRun<'s> {
    /// Opens the dataset and chooses the folder. Writes nothing.
    fn open(settings: &'s RunSettings, on: &mut Listener<'_>) -> Result<Self> {
        let config = settings.config.clone();
        config.validate()?;
        if let (Some(from), Some(to)) = (&config.init_from, &settings.out)
            && from.canonicalize().is_ok_and(|from| to.canonicalize().is_ok_and(|to| from == to))
        {
            return Err(Error::usage(
                "--init-from",
                format!("{} is also the folder of --out", from.display()),
                "choose another folder for --out",
            ));
        }
        let mut clocks = Clocks::default();
        let dataset = clocks.load.time(|| settings.data.open(&config))?;
        on(Event::Opened { dataset: &dataset, config: &config });
        let folder = NewFolder::choose(settings.out.as_deref(), dataset.name(), settings.force)?;
        Ok(NewRun {
            settings,
            config,
            dataset,
            folder,
            views: Arc::new([]),
            preview: Preview::default(),
            clocks,
            saved: 0,
            warnings: Vec::new(),
        })
    }

    /// Checks the cameras against the box of the model and reports warnings.
    ///
    /// Errors: no camera sees the box.
    fn check_cameras(&mut self, aabb: Aabb, on: &mut Listener<'_>) -> Result<()> {
        self.warnings = self.settings.data.check_cameras(&self.dataset, aabb)?;
        self.warnings.iter().for_each(|warning| on(Event::warning(warning)));
        Ok(())
    }

    /// Reads the training views, and those that are looked at while training.
    fn read(&mut self, on: &mut Listener<'_>) -> Result<()> {
        let NewRun { settings, dataset, clocks, .. } = self;
        self.preview = clocks.load.time(|| Preview::new(dataset, settings.options.preview_every))?;
        self.views = clocks.load.time(|| load(dataset, Split::Train, &all(dataset, Split::Train), &settings.data, on))?.into();
        Ok(())
    }

    /// Creates the folder, trains and evaluates; `adjust` may change the plan. Nothing is written or overwritten before all checks of the input.
    fn learn<M: Model<f32>>(self, begun: Begun<M>, adjust: &mut Adjust<'_, M>, on: &mut Listener<'_>) -> Result<Outcome> {
        let NewRun { settings, config, dataset, folder, views, preview, mut clocks, saved, warnings } = self;
        let RunSettings { data, preset, time, options, .. } = settings;
        check_disk(settings.out.as_deref().unwrap_or(Path::new("runs")), saved.saturating_sub(folder.overwritten()), on)?;
        let folder = folder.create()?;
        let record = RunRecord {
            seconds_planned: *time,
            asked: time.map(|_| settings::values(&settings.config)),
            model: begun.trainer.model().kind().to_owned(),
            ..RunRecord::new(RunKind::Trained, &dataset, preset.as_deref(), data)
        };
        folder.describe(&config, &record)?;
        on(Event::note(format!("run: {}", folder.path().display())));
        let metrics = MetricsFile::create(&folder, begun.trainer.total_steps())?;
        let mut job = Job { folder: &folder, config, dataset: &dataset, record: &record, options, warnings: &warnings };
        let learned = job.learn(begun, adjust, (metrics, History::default()), preview, &views, &mut clocks, on)?;
        drop(views);
        job.conclude(learned, clocks, on)
    }
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
    let estimate = estimate(&run.config, &run.dataset, 0, options, on)?;
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

/// A resumed run.
struct OldRun<'o> {
    folder: RunFolder,
    config: Config,
    record: RunRecord,
    options: &'o RunOptions,
    dataset: Dataset,
    /// The state to resume from; `None` if only the final figures are missing.
    state: Option<PathBuf>,
    views: Arc<[View]>,
    preview: Preview,
    clocks: Clocks,
}

impl<'o> OldRun<'o> {
    /// Opens a run and its dataset.
    fn open(path: &Path, data: Option<DataSource>, options: &'o RunOptions, on: &mut Listener<'_>) -> Result<Self> {
        let (folder, config, mut record) = RunFolder::open(path)?;
        if record.kind != RunKind::Trained {
            let article = if record.kind == RunKind::Imported { "an" } else { "a" };
            let found = format!("{article} {} run cannot be resumed", record.kind.name());
            return Err(Error::input(path, found, "train its grid with --init-from"));
        }
        let folder = folder.locked("--resume")?;
        let state = folder.existing_state()?;
        let mut clocks = Clocks::default();
        record.data = data.unwrap_or(record.data);
        let dataset = clocks.load.time(|| record.data.open(&config))?;
        if machine::instruction_set() != record.instruction_set {
            on(Event::note(format!("the run was started with {}: the results differ by rounding only", record.instruction_set)));
        }
        on(Event::Opened { dataset: &dataset, config: &config });
        Ok(OldRun { folder, config, record, options, dataset, state, views: Arc::new([]), preview: Preview::default(), clocks })
    }

    /// Reads the training views, and those that are looked at while training.
    fn read(&mut self, on: &mut Listener<'_>) -> Result<()> {
        let OldRun { options, dataset, record, clocks, .. } = self;
        self.preview = clocks.load.time(|| Preview::new(dataset, options.preview_every))?;
        self.views = clocks.load.time(|| load(dataset, Split::Train, &all(dataset, Split::Train), &record.data, on))?.into();
        Ok(())
    }

    /// Resumes training from the state with a new trainer of the run, and evaluates.
    fn learn<M: Model<f32>>(self, trainer: train::Trainer<f32, M>, on: &mut Listener<'_>) -> Result<Outcome> {
        let OldRun { folder, config, record, options, dataset, state, views, preview, mut clocks } = self;
        let trainer = match &state {
            Some(state) => trainer.resumed(state)?,
            None => trainer,
        };
        folder.remove_fragments()?;
        let (plan, taken) = match state {
            Some(_) => (trainer.plan().to_vec(), trainer.steps_taken()),
            None => {
                let steps = train::about(&folder.existing_checkpoint()?)?.step;
                (ends_after(trainer.plan(), steps).to_vec(), steps)
            }
        };
        let total = plan.iter().map(|stage| stage.steps).sum();
        let (metrics, past) = MetricsFile::resume(&folder, total, taken)?;
        clocks.train.0 = Duration::try_from_secs_f64(past.seconds).unwrap_or_default();
        let path = folder.path().display();
        on(Event::note(format!("run: {path}, resumed after step {taken} of {total} and {} of training", clock(past.seconds))));
        let as_it_began = !record.is_of_own_model() && config.init_from.is_none();
        let aabb = if as_it_began { Aabb::cube(config.half_width) } else { trainer.model().aabb() };
        let warnings = record.data.check_cameras(&dataset, aabb)?;
        let mut job = Job { folder: &folder, config, dataset: &dataset, record: &record, options, warnings: &warnings };
        let learned = match state {
            Some(_) => job.learn(Begun::new(trainer), &mut |_, _| None, (metrics, past), preview, &views, &mut clocks, on)?,
            None => Ok(job.learned(trainer, &plan, (metrics, past), &views, on)?),
        };
        drop(views);
        job.conclude(learned, clocks, on)
    }
}

/// Returns the last stages of a plan, with `steps` steps in total: a run with an initial grid skips coarser stages.
fn ends_after(plan: &[PlannedStage], steps: u64) -> &[PlannedStage] {
    let taken = |from: &usize| plan[*from..].iter().map(|stage| stage.steps).sum::<u64>() == steps;
    &plan[(0..plan.len()).find(taken).unwrap_or(0)..]
}

/// Indices of all views of a split.
fn all(dataset: &Dataset, split: Split) -> Vec<usize> {
    (0..dataset.count(split)).collect()
}

/// Reads or renders some views of a split.
fn load(dataset: &Dataset, split: Split, numbers: &[usize], source: &DataSource, on: &mut Listener<'_>) -> Result<Vec<View>> {
    let on = Mutex::new(on);
    dataset.load_views(split, numbers, &|done, total| {
        let mut on = on.lock().unwrap_or_else(PoisonError::into_inner);
        (*on)(Event::Loading { split, source, done, total });
    })
}

/// Runs a computation and reports its progress.
fn watched<R>(progress: &StageProgress, on: &mut Listener<'_>, compute: impl FnOnce() -> R) -> R {
    const FIRST: Duration = Duration::from_secs(1);
    const NEXT: Duration = Duration::from_millis(100);
    let (end, ended) = mpsc::channel::<()>();
    thread::scope(|scope| {
        scope.spawn(move || {
            let mut wait = FIRST;
            while let Err(RecvTimeoutError::Timeout) = ended.recv_timeout(wait) {
                if let Some((done, total)) = progress.now() {
                    on(Event::Carving { done, total });
                }
                wait = NEXT;
            }
        });
        let result = compute();
        drop(end);
        result
    })
}

/// Reports the stages, reduced to the size of the images, and the memory estimate.
///
/// Errors: there is not enough memory.
fn estimate(config: &Config, dataset: &Dataset, initial: u64, options: &RunOptions, on: &mut Listener<'_>) -> Result<Estimate> {
    let fitted = config.fitted_to(&dataset.cameras(Split::Train));
    if fitted.stages != config.stages {
        let stages: Vec<String> = fitted.stages.iter().map(|stage| format!("{}³", stage.resolution)).collect();
        on(Event::note(format!("stages, limited by the size of the images (pixels_per_voxel): {}", stages.join(", "))));
    }
    let estimate = Estimate::of_training(&fitted, dataset, initial, options);
    on(Event::note(estimate.describe()));
    estimate.check()?;
    Ok(estimate)
}

/// Checks that the files of a run fit on the disk, and warns if they might not.
///
/// Errors: the disk is too small even if pruning leaves only a quarter of the expected voxels.
fn check_disk(folder: &Path, saved: u64, on: &mut Listener<'_>) -> Result<()> {
    // A new state is written before the previous one is removed. The checkpoint, the pictures and the page follow.
    const REST: u64 = 4_000_000;
    let needed = |saved: u64| files::check_room(folder, 3 * saved + REST, saved);
    needed(saved / 4).map_err(|e| Error::io(folder, e, "checking the disk space for the run"))?;
    files::check_handles().map_err(|e| Error::io(folder, e, "opening as many files as a run needs"))?;
    if let Err(e) = needed(saved) {
        on(Event::note(format!("warning: the disk may be too small for this run: {e}")));
    }
    Ok(())
}

/// A new or resumed run.
struct Job<'a> {
    folder: &'a RunFolder,
    config: Config,
    dataset: &'a Dataset,
    record: &'a RunRecord,
    options: &'a RunOptions,
    /// Warnings about its cameras.
    warnings: &'a [String],
}

/// Looks at a run after a step, whose seconds of training it is given; returns the new configuration if it has changed the plan.
type Adjust<'a, M> = dyn FnMut(&mut train::Trainer<f32, M>, f64) -> Option<Config> + 'a;

/// A stopped run: steps taken, and total steps.
struct Stopped(u64, u64);

impl Job<'_> {
    /// Indices of the test views for the final evaluation.
    fn test_views(&self) -> Vec<usize> {
        evenly_spaced(self.dataset.count(Split::Test), self.options.test_views)
    }

    /// Evaluates the model on the test views and writes the final figures.
    fn conclude<M: Model<f32>>(
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
        let scores = Viewer::new(show, options.background).compare(test, |_, _, _, _| {
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
struct Clocks {
    load: Stopwatch,
    train: Stopwatch,
    evaluate: Stopwatch,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_computation_tells_of_its_progress_and_a_short_one_does_not() {
        let progress = StageProgress::default();
        let mut told = Vec::new();
        let mut listen = |event: Event<'_>| {
            if let Event::Carving { done, total } = event {
                told.push((done, total));
            }
        };
        let work = |seconds| {
            progress.of(3, |done| {
                done(2);
                thread::sleep(Duration::from_secs_f64(seconds));
            });
        };
        watched(&progress, &mut listen, || work(0.01));
        watched(&progress, &mut listen, || work(1.5));
        assert!(!told.is_empty() && told.iter().all(|told| *told == (2, 3)), "{told:?}");
        assert_eq!(progress.now(), None);
    }
}
