//! A new or resumed run, from its settings or its folder to its first step.

use super::job::{self, Adjust, Clocks, Job};
use super::preview::Preview;
use super::{Event, Listener, Outcome, RunOptions, RunSettings};
use crate::dataset::{Dataset, Split, View};
use crate::error::{Error, Result};
use crate::evaluate;
use crate::files;
use crate::geometry::Aabb;
use crate::model::plenoxels::config::Config;
use crate::run::data::DataSource;
use crate::run::folder::{NewFolder, RunFolder, RunKind, RunRecord};
use crate::run::machine;
use crate::run::memory::{Estimate, Stored};
use crate::run::metrics::{History, MetricsFile};
use crate::run::pace::{Begun, TimeBudget};
use crate::run::settings;
use crate::text::clock;
use crate::train::{self, Model, PlannedStage, StageProgress};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// A new run.
pub struct NewRun<'s> {
    pub settings: &'s RunSettings,
    /// The config, with planned steps.
    pub config: Config,
    pub dataset: Dataset,
    pub folder: NewFolder,
    /// The training views; empty until they are read.
    pub views: Arc<[View]>,
    pub preview: Preview,
    pub clocks: Clocks,
    /// Expected size of a saved state, in bytes.
    pub saved: u64,
    /// Warnings about the cameras and the settings.
    pub warnings: Vec<String>,
    /// When the run began.
    pub began: Instant,
}

impl<'s> NewRun<'s> {
    /// Opens the dataset and chooses the folder. Writes nothing.
    pub fn open(settings: &'s RunSettings, on: &mut Listener<'_>) -> Result<Self> {
        let began = Instant::now();
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
            began,
        })
    }

    /// Returns the time for which the run is planned, if it is; `pictures` is the number of pictures of each test view that are evaluated.
    pub fn time_budget(&self, pictures: f64) -> Option<TimeBudget> {
        let RunSettings { time, with_evaluation, options, .. } = self.settings;
        time.map(|seconds| match with_evaluation {
            true => {
                let evaluated = pictures * evaluate::pixels(&job::test_cameras(&self.dataset, options)) as f64;
                TimeBudget { seconds, spent: self.began.elapsed().as_secs_f64(), evaluated }
            }
            false => TimeBudget::of_training(seconds),
        })
    }

    /// Checks the cameras against the box of the model, and reports warnings about them and about the settings.
    ///
    /// Errors: no camera sees the box.
    pub fn check_cameras(&mut self, aabb: Aabb, on: &mut Listener<'_>) -> Result<()> {
        self.warnings = warnings(&self.settings.data, &self.dataset, aabb, &self.config)?;
        self.warnings.iter().for_each(|warning| on(Event::warning(warning)));
        Ok(())
    }

    /// Reads the training views, and those that are looked at while training.
    pub fn read(&mut self, on: &mut Listener<'_>) -> Result<()> {
        let NewRun { settings, dataset, clocks, .. } = self;
        self.preview = clocks.load.time(|| Preview::new(dataset, settings.options.preview_every))?;
        self.views = clocks.load.time(|| load(dataset, Split::Train, &all(dataset, Split::Train), &settings.data, on))?.into();
        Ok(())
    }

    /// Creates the folder, trains and evaluates; `adjust` may change the plan. Nothing is written or overwritten before all checks of the input.
    pub fn learn<M: Model<f32>>(self, begun: Begun<M>, adjust: &mut Adjust<'_, M>, on: &mut Listener<'_>) -> Result<Outcome> {
        let NewRun { settings, config, dataset, folder, views, preview, mut clocks, saved, warnings, .. } = self;
        let RunSettings { data, preset, time, with_evaluation, options, .. } = settings;
        check_disk(settings.out.as_deref().unwrap_or(Path::new("runs")), saved.saturating_sub(folder.overwritten()), on)?;
        let folder = folder.create()?;
        let record = RunRecord {
            seconds_planned: *time,
            with_evaluation: time.is_some() && *with_evaluation,
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

/// A resumed run.
pub struct OldRun<'o> {
    pub folder: RunFolder,
    pub config: Config,
    pub record: RunRecord,
    pub options: &'o RunOptions,
    pub dataset: Dataset,
    /// The state to resume from; `None` if only the final figures are missing.
    pub state: Option<PathBuf>,
    pub views: Arc<[View]>,
    pub preview: Preview,
    pub clocks: Clocks,
}

impl<'o> OldRun<'o> {
    /// Opens a run and its dataset.
    pub fn open(path: &Path, data: Option<DataSource>, options: &'o RunOptions, on: &mut Listener<'_>) -> Result<Self> {
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
            on(Event::note(format!("the run was started with {}: the results may differ by rounding", record.instruction_set)));
        }
        on(Event::Opened { dataset: &dataset, config: &config });
        Ok(OldRun { folder, config, record, options, dataset, state, views: Arc::new([]), preview: Preview::default(), clocks })
    }

    /// Reads the training views, and those that are looked at while training.
    pub fn read(&mut self, on: &mut Listener<'_>) -> Result<()> {
        let OldRun { options, dataset, record, clocks, .. } = self;
        self.preview = clocks.load.time(|| Preview::new(dataset, options.preview_every))?;
        self.views = clocks.load.time(|| load(dataset, Split::Train, &all(dataset, Split::Train), &record.data, on))?.into();
        Ok(())
    }

    /// Resumes training from the state with a new trainer of the run, and evaluates.
    pub fn learn<M: Model<f32>>(self, trainer: train::Trainer<f32, M>, on: &mut Listener<'_>) -> Result<Outcome> {
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
        let warnings = warnings(&record.data, &dataset, aabb, &config)?;
        let mut job = Job { folder: &folder, config, dataset: &dataset, record: &record, options, warnings: &warnings };
        let learned = match state {
            Some(_) => job.learn(Begun::new(trainer), &mut |_, _| None, (metrics, past), preview, &views, &mut clocks, on)?,
            None => Ok(job.learned(trainer, &plan, (metrics, past), &views, on)?),
        };
        drop(views);
        job.conclude(learned, clocks, on)
    }
}

/// Checks the cameras, and returns warnings about them and about the settings.
///
/// Errors: no camera sees the box.
fn warnings(data: &DataSource, dataset: &Dataset, aabb: Aabb, config: &Config) -> Result<Vec<String>> {
    let mut warnings = data.check_cameras(dataset, aabb)?;
    warnings.extend(config.recipe().into_iter().flat_map(|recipe| recipe.warnings(config.engine)));
    Ok(warnings)
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
pub fn load(dataset: &Dataset, split: Split, numbers: &[usize], source: &DataSource, on: &mut Listener<'_>) -> Result<Vec<View>> {
    let on = Mutex::new(on);
    dataset.load_views(split, numbers, &|done, total| {
        let mut on = on.lock().unwrap_or_else(PoisonError::into_inner);
        (*on)(Event::Loading { split, source, done, total });
    })
}

/// Runs a computation and reports its progress.
pub fn watched<R>(progress: &StageProgress, on: &mut Listener<'_>, compute: impl FnOnce() -> R) -> R {
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
pub fn estimate(
    config: &Config,
    dataset: &Dataset,
    initial: Option<&Stored>,
    options: &RunOptions,
    on: &mut Listener<'_>,
) -> Result<Estimate> {
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
