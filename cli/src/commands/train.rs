//! `plenoxel train`: from photographs to a run folder.

mod best_grid;
mod flags;
pub mod interrupt;
mod learning;
mod pictures;
mod preview;
mod watching;

use super::new_run::{Stopwatch, announce, load, record};
use crate::progress::{Console, clock};
use crate::report::Report;
pub use flags::{NOT_WHEN_RESUMED, TrainArgs, size};
use learning::{Learned, StageSummary};
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::error::{Error, Result};
use plenoxel::run::budget;
use plenoxel::run::evaluation::{self, Scores, ViewScore, Viewer};
use plenoxel::run::figures::Figures;
use plenoxel::run::folder::{RunFolder, RunRecord};
use plenoxel::run::machine;
use plenoxel::run::memory::{self, Estimate};
use plenoxel::run::metrics::{Best, History, MetricsFile};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::plenoxels::Trainer;
use plenoxel::train::PlannedStage;
use preview::Preview;
use serde::Serialize;
use std::path::Path;
use std::time::{Duration, Instant};

/// Learns a scene and leaves a run folder. Returns the exit code: 0, or another if it was interrupted.
pub fn run(args: &TrainArgs, console: &Console<'_>) -> Result<u8> {
    match &args.resume {
        Some(path) => resume(path, args, console),
        None => begin(args, console),
    }
}

/// A run from its first step.
fn begin(args: &TrainArgs, console: &Console<'_>) -> Result<u8> {
    let source = args.source();
    let (mut config, preset) = args.config()?;
    config.check_stages()?;
    if let (Some(from), Some(to)) = (&config.init_from, &args.out)
        && from.canonicalize().is_ok_and(|from| to.canonicalize().is_ok_and(|to| from == to))
    {
        return Err(Error::config("--init-from", format!("{}, which is --out too,", from.display()), "another folder to write"));
    }
    let mut clocks = Clocks::default();
    let dataset = clocks.load.time(|| source.open(&config))?;
    announce(console, &dataset, &config);
    let from = config.init_from.as_deref().map(RunFolder::open).transpose()?;
    // A run without stages was carved.
    let carved = from.as_ref().is_some_and(|(_, config, _)| config.stages.is_empty());
    let initial = from.map(|(folder, ..)| folder);
    let known = initial.as_ref().map(RunFolder::header).transpose()?;
    if let Some((header, _)) = known.as_ref().filter(|(header, _)| header.scene != dataset.name()) {
        console.note(&format!("the grid it starts from is of another scene: {}, not {}", header.scene, dataset.name()));
    }
    let bytes = known.map_or(0, |(header, voxels)| voxels * header.shape().voxel_bytes());
    let most_rows = room(&config, &dataset, bytes as u64, args, console)?;
    let initial = initial.map(|folder| folder.load()).transpose()?.map(|(grid, _)| grid);
    let folder = RunFolder::choose(args.out.as_deref(), dataset.name(), args.force)?;
    let preview = clocks.load.time(|| Preview::new(&dataset, args.preview_every))?;
    let views = clocks.load.time(|| load(console, &dataset, Split::Train, &source))?;

    if let Some(seconds) = args.time {
        console.note("finding out how fast this machine is");
        config = clocks.train.time(|| budget::on_time(config, &views, seconds))?;
        let stages = config.stages.iter().map(|stage| format!("{} of {}³", stage.steps.unwrap_or_default(), stage.resolution));
        console.note(&format!("planned for {}: steps {}", clock(seconds), stages.collect::<Vec<_>>().join(", ")));
    }
    // Nothing is written, and nothing overwritten, before all that could be wrong with the input has been found.
    folder.prepare()?;
    let record = RunRecord { seconds_planned: args.time, ..record(&dataset, preset, &source) };
    folder.describe(&config, &record)?;
    console.note(&format!("run: {}", folder.path().display()));
    let start = || {
        let trainer = Trainer::new(config.clone(), &views)?.with_most_rows(most_rows);
        Ok(initial.iter().fold(trainer, if carved { Trainer::starting_from_carved } else { Trainer::starting_from }))
    };
    let trainer = clocks.train.time(start)?;
    drop(initial);
    let half_width = trainer.grid().shape().half_width;
    if half_width != config.half_width {
        let chosen = if config.init_from.is_some() { "of the grid it starts from" } else { "around the silhouettes" };
        console.note(&format!("box: half width {half_width:.4}, {chosen}"));
    }
    if let scouts @ 1.. = trainer.plan().len().saturating_sub(config.stages.len()) {
        console.note(&format!("scout: {scouts} short stages first find out where matter is, as no silhouettes say so"));
    }
    let metrics = MetricsFile::create(&folder, trainer.total_steps())?;
    let job = Job { folder: &folder, config: &config, dataset: &dataset, record: &record, args, console };
    let learned = job.learn(trainer, (metrics, History::default()), preview, &views, &mut clocks)?;
    drop(views);
    job.conclude(learned, clocks)
}

/// A run that was interrupted, from where it was last saved.
fn resume(path: &Path, args: &TrainArgs, console: &Console<'_>) -> Result<u8> {
    let (folder, config, mut record) = RunFolder::open(path)?;
    if config.stages.is_empty() {
        return Err(Error::input(path, "this run was carved", "to train its grid further, use `--init-from`"));
    }
    let state = folder.existing_state()?;
    let mut clocks = Clocks::default();
    record.data = args.moved_to().unwrap_or(record.data);
    let dataset = clocks.load.time(|| record.data.open(&config))?;
    if machine::instruction_set() != record.instruction_set {
        console.note(&format!("it began with {}: other bits, the same picture", record.instruction_set));
    }
    announce(console, &dataset, &config);
    let most_rows = room(&config, &dataset, 0, args, console)?;
    let preview = clocks.load.time(|| Preview::new(&dataset, args.preview_every))?;
    let views = clocks.load.time(|| load(console, &dataset, Split::Train, &record.data))?;
    let trainer = Trainer::new(config.clone(), &views)?.with_most_rows(most_rows);
    let trainer = match &state {
        Some(state) => trainer.resumed(state)?,
        None => trainer,
    };
    folder.remove_fragments()?;
    let (plan, taken) = match state {
        Some(_) => (trainer.plan(), trainer.steps_taken()),
        None => {
            let steps = folder.header()?.0.step;
            (ends_after(trainer.plan(), steps), steps)
        }
    };
    let total = plan.iter().map(|stage| stage.steps).sum();
    let (metrics, past) = MetricsFile::resume(&folder, total, taken)?;
    clocks.train.0 = Duration::try_from_secs_f64(past.seconds).unwrap_or_default();
    console.note(&format!("run: {}, going on after step {taken} of {total}, {} of training", folder.path().display(), clock(past.seconds)));
    let job = Job { folder: &folder, config: &config, dataset: &dataset, record: &record, args, console };
    let learned = match state {
        Some(_) => job.learn(trainer, (metrics, past), preview, &views, &mut clocks)?,
        None => Some(job.learned(plan, (metrics, past), &views)?),
    };
    drop(views);
    job.conclude(learned, clocks)
}

/// The last stages, which so many steps were taken in: a run that begins with a grid leaves coarser ones out.
fn ends_after(plan: &[PlannedStage], steps: u64) -> &[PlannedStage] {
    let taken = |from: &usize| plan[*from..].iter().map(|stage| stage.steps).sum::<u64>() == steps;
    &plan[(0..plan.len()).find(taken).unwrap_or(0)..]
}

/// Says which stages the images are large enough for, and how much memory a run will take. Returns how many rows of tables there is room for.
fn room(config: &Config, dataset: &Dataset, initial: u64, args: &TrainArgs, console: &Console<'_>) -> Result<usize> {
    let fitted = config.fitted_to(&dataset.cameras(Split::Train));
    if fitted.stages != config.stages {
        let stages: Vec<String> = fitted.stages.iter().map(|stage| format!("{}³", stage.resolution)).collect();
        console.note(&format!("stages as the size of the images allows (pixels_per_voxel): {}", stages.join(", ")));
    }
    let estimate = Estimate::of_training(&fitted, dataset, initial, !args.no_report);
    console.note(&estimate.describe());
    estimate.check()?;
    Ok(estimate.most_rows(config).unwrap_or(usize::MAX))
}

/// What a run is about, however it began.
struct Job<'a, 'c> {
    folder: &'a RunFolder,
    config: &'a Config,
    dataset: &'a Dataset,
    record: &'a RunRecord,
    args: &'a TrainArgs,
    console: &'a Console<'c>,
}

impl Job<'_, '_> {
    /// Compares what was learned with the test views, and says what came of it.
    fn conclude(&self, learned: Option<Learned<'_>>, mut clocks: Clocks) -> Result<u8> {
        let Job { folder, config, dataset, console, .. } = *self;
        let Some(mut learned) = learned else { return Ok(interrupt::EXIT_CODE) };
        let test = clocks.load.time(|| load(console, dataset, Split::Test, &self.record.data))?;
        let scores = evaluate(&mut learned, &test, config, console, &mut clocks)?;
        let pictures = &learned.pictures;
        console.drawn(pictures.strip(test.first(), config.background));
        let note = pictures.note();
        let (rays, samples) = learned.metrics.counts();
        let (validation_psnr, best_validation) = learned.metrics.validation();
        let means = [("psnr/test", scores.psnr()), ("ssim/test", scores.ssim())];
        let summary = Summary {
            figures: Figures::new(&scores, Split::Test, dataset, config, config.evaluation, &learned.grid),
            baseline_background_psnr: evaluation::background_psnr(&test, config.background),
            baseline_mean_image_psnr: learned.mean_image.and_then(|image| evaluation::constant_psnr(&test, &image, config.background)),
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
            stages: learned.stages,
            per_view: scores.per_view,
        };
        folder.write_result(&summary)?;
        learned.metrics.conclude(&Final { result: &summary }, &means)?;
        say(console, folder, &summary, note.as_deref())?;
        if !self.args.no_report {
            let report = Report { folder, config, record: self.record, dataset, grid: &learned.grid };
            console.note(&report.write()?);
        }
        Ok(0)
    }
}

/// Figures of the final grid, with panels, and of the grids of earlier stages that were kept.
fn evaluate(learned: &mut Learned<'_>, test: &[View], config: &Config, console: &Console<'_>, clocks: &mut Clocks) -> Result<Scores> {
    let kept = learned.stages.iter().filter(|stage| stage.grid.is_some()).count();
    let total = (kept + 1) * test.len();
    let (count, mut done) = (console.count("evaluating", total), 0);
    let mut advance = || {
        done += 1;
        count.at(done, total);
    };
    let start = Instant::now();
    let mut drawing = Stopwatch::default();
    for stage in &mut learned.stages {
        if let Some(grid) = stage.grid.take() {
            let viewer = Viewer::new(&grid, config.evaluation, config);
            let scores = viewer.compare(test, |_, _, _, _| {
                advance();
                Ok(())
            })?;
            stage.psnr = scores.psnr();
        }
    }
    let viewer = Viewer::new(&learned.grid, config.evaluation, config);
    let half_width = learned.grid.shape().half_width;
    let scores = viewer.compare(test, |i, view, target, picture| {
        advance();
        drawing.time(|| console.drawn(learned.pictures.panel(i, view, target, picture, half_width)));
        Ok(())
    })?;
    clocks.evaluate.0 += start.elapsed() - drawing.0;
    if let Some(last) = learned.stages.last_mut() {
        last.psnr = scores.psnr();
    }
    Ok(scores)
}

/// Final figures, in the order in which people look for them.
#[derive(Debug, Serialize)]
struct Summary {
    #[serde(flatten)]
    figures: Figures,
    baseline_background_psnr: Option<f64>,
    baseline_mean_image_psnr: Option<f64>,
    seconds: f64,
    /// The time that was asked for.
    seconds_planned: Option<f64>,
    seconds_load: f64,
    seconds_evaluate: f64,
    peak_memory_bytes: Option<u64>,
    steps: u64,
    rays: u64,
    samples: u64,
    scene: String,
    preset: Option<String>,
    run: String,
    /// Of reduced validation views, when they were last looked at.
    validation_psnr: Option<f64>,
    best_validation: Option<Best>,
    stages: Vec<StageSummary>,
    per_view: Vec<ViewScore>,
}

/// The last line of the metrics.
#[derive(Serialize)]
struct Final<'a> {
    #[serde(rename = "final")]
    result: &'a Summary,
}

/// What time was spent on; pictures are on none of the clocks.
#[derive(Debug, Default)]
struct Clocks {
    load: Stopwatch,
    train: Stopwatch,
    evaluate: Stopwatch,
}

fn say(console: &Console<'_>, folder: &RunFolder, summary: &Summary, note: Option<&str>) -> Result<()> {
    if let Some(note) = note {
        console.note(note);
    }
    let decibels = |x: Option<f64>| x.map_or("none".to_owned(), |x| format!("{x:.2} dB"));
    console.note(&format!(
        "trained {} steps in {}; background alone {}, mean training image {}",
        summary.steps,
        clock(summary.seconds),
        decibels(summary.baseline_background_psnr),
        decibels(summary.baseline_mean_image_psnr),
    ));
    console.result(&summary.figures.sentence())?;
    console.result(&format!("run folder: {}", folder.path().display()))?;
    console.record(summary)
}
