//! A carving run from its settings to its folder, as in `plenoxel carve`. Progress is reported as [`Event`]s; nothing is printed.

use super::data::DataSource;
use super::folder::{NewFolder, RunFolder, RunKind, RunRecord};
use super::memory::{self, Estimate};
use super::training::Stopwatch;
use crate::carve::{self, Carving, Colored, Fit, Progress, Rule};
use crate::dataset::{Dataset, Split, has_alpha};
use crate::error::Result;
use crate::geometry::Aabb;
use crate::model::plenoxels::Plenoxels;
use crate::model::plenoxels::config::Config;
use crate::train::About;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

/// Settings of a carving run.
pub struct CarvingSettings {
    /// Configuration.
    pub config: Config,
    /// Preset of the config, for `run.json`.
    pub preset: Option<String>,
    /// Source of the views.
    pub data: DataSource,
    /// Run folder; `None` for `runs/<scene>-<n>` with the first free n.
    pub out: Option<PathBuf>,
    /// Overwrite an existing run in the folder.
    pub force: bool,
    /// Include report.html in the memory estimates.
    pub report: bool,
}

/// An event of a carving run.
pub enum Event<'a> {
    /// A message about the next step of the run, or about a problem that does not end it.
    Note(String),
    /// The dataset was opened.
    Opened {
        /// The dataset; its images are not read yet.
        dataset: &'a Dataset,
        /// The settings.
        config: &'a Config,
    },
    /// Training images are being read, or rendered for the built-in scene.
    Loading {
        /// Their source.
        source: &'a DataSource,
        /// Number of images read so far.
        done: usize,
        /// Number of images to read.
        total: usize,
    },
    /// Views are being used to carve.
    Carving {
        /// Number of views used so far.
        done: usize,
        /// Number of views to use.
        total: usize,
    },
    /// A round of the photo hull ended.
    Round {
        /// Its number.
        round: usize,
        /// Number of voxels that it carved.
        carved: usize,
        /// Number of voxels that are left.
        left: usize,
    },
    /// Colors are being fitted.
    Coloring {
        /// Number of passes made so far.
        done: usize,
        /// Number of passes to make.
        total: usize,
    },
    /// The grid was saved.
    Saved {
        /// The run.
        run: Carved<'a>,
    },
    /// The figures were written.
    Finished {
        /// The figures.
        summary: &'a CarvingSummary,
        /// The run.
        run: Carved<'a>,
    },
}

/// A run whose grid was carved.
#[derive(Clone, Copy)]
pub struct Carved<'a> {
    /// Its folder.
    pub folder: &'a RunFolder,
    /// Its settings.
    pub config: &'a Config,
    /// Facts about it.
    pub record: &'a RunRecord,
    /// Its views.
    pub dataset: &'a Dataset,
    /// The model of the carved grid.
    pub model: &'a Plenoxels<f32>,
}

/// Figures of a carving run: `result.json` of its folder.
#[derive(Debug, Serialize)]
pub struct CarvingSummary {
    /// Seconds of carving and coloring, without reading images.
    pub seconds: f64,
    /// Seconds of carving.
    pub seconds_hull: f64,
    /// Seconds of coloring.
    pub seconds_color: f64,
    /// Seconds of reading images.
    pub seconds_load: f64,
    /// Peak memory of the process, in bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Voxels per side.
    pub resolution: usize,
    /// Number of voxels.
    pub voxels: usize,
    /// Carving rule.
    pub rule: Rule,
    /// Fit of the colors.
    pub fit: Fit,
    /// Fraction of the object pixels that show no voxel.
    pub missed_object_pixels: f64,
    /// Name of the scene.
    pub scene: String,
    /// Folder of the run.
    pub run: String,
}

/// Number of voxels per side above which the memory of the colors is estimated before the hull, because the hull takes long.
const LARGE: usize = 256;

/// Carves the grid of a scene and writes a run folder. Nothing is written or overwritten before all checks of the input. [`Event::Loading`] is sent from several
/// threads.
///
/// Errors: a setting is invalid; data cannot be read; no voxel can be carved or is left; there is not enough memory; a file cannot be written.
pub fn carve(settings: &CarvingSettings, on: &mut (dyn FnMut(Event<'_>) + Send)) -> Result<CarvingSummary> {
    let CarvingSettings { config, data: source, report, .. } = settings;
    let on = Mutex::new(on);
    let on = |event: Event<'_>| (*on.lock().unwrap_or_else(PoisonError::into_inner))(event);
    let note = |text: String| on(Event::Note(text));
    let checked = |estimate: Estimate| {
        note(estimate.describe());
        estimate.check()
    };
    let mut load_clock = Stopwatch::default();
    let dataset = load_clock.time(|| source.open(config))?;
    on(Event::Opened { dataset: &dataset, config });
    checked(Estimate::of_carving(config, &dataset, 0, *report))?;
    dataset.space().require_box("carve")?;
    for warning in source.check_cameras(&dataset, Aabb::cube(config.half_width))? {
        note(format!("warning: {warning}"));
    }
    let folder = NewFolder::choose(settings.out.as_deref(), dataset.name(), settings.force)?;
    let loading = |done, total| on(Event::Loading { source, done, total });
    let views = load_clock.time(|| dataset.load(Split::Train, &loading))?;

    let mut hull_clock = Stopwatch::default();
    // A coarse hull overestimates the number of voxels. If not even half of them fit into memory, the run fails early.
    if config.carve.resolution > LARGE {
        let expected = hull_clock.time(|| carve::voxels_expected(&views, &config.carve_options())).unwrap_or(0.0);
        Estimate::of_carving(config, &dataset, (0.5 * expected) as usize, *report).check()?;
    }
    let progress = |progress| match progress {
        Progress::Views(done) => on(Event::Carving { done, total: views.len() }),
        Progress::Round { round, carved, left } => on(Event::Round { round, carved, left }),
    };
    let carving = hull_clock.time(|| Carving::new(&views, &config.carve_options(), &progress))?;
    let (n, left) = (config.carve.resolution, carving.voxels());
    let share = 100.0 * left as f64 / (n as f64).powi(3);
    note(format!("carved {n}³ voxels in {:.2} s: {left} are left, {share:.1} %", hull_clock.seconds()));
    if share > 50.0 {
        let remedy = "use more views, images with alpha, or a smaller --half-width";
        note(format!("most of the box is left because the photographs rule out little of it; {remedy}"));
    }
    checked(Estimate::of_carving(config, &dataset, carving.rows(), *report))?;

    let folder = folder.create()?;
    let record = RunRecord::new(RunKind::Carved, &dataset, settings.preset.as_deref(), source);
    folder.describe(config, &record)?;
    note(format!("run: {}", folder.path().display()));
    let mut color_clock = Stopwatch::default();
    let total = match config.carve.fit {
        Fit::Exact => config.carve.sweeps + 1,
        Fit::Sgd => carve::color::EPOCHS + 1,
    };
    let Colored { grid, missed } = color_clock.time(|| carving.color(&|done| on(Event::Coloring { done, total })));
    if missed > 0.0 && has_alpha(&views) {
        note(format!(
            "{:.2} % of the object pixels show no voxel: those parts are thinner than a pixel or outside the box (--half-width)",
            100.0 * missed
        ));
    }
    let model = Plenoxels::of_grid(config, grid);
    folder.save(&model, &About { scene: dataset.name().to_owned(), background: config.background, seed: config.seed, step: 0 })?;
    drop(carving);
    drop(views);
    let run = Carved { folder: &folder, config, record: &record, dataset: &dataset, model: &model };
    on(Event::Saved { run });
    let summary = CarvingSummary {
        seconds: hull_clock.seconds() + color_clock.seconds(),
        seconds_hull: hull_clock.seconds(),
        seconds_color: color_clock.seconds(),
        seconds_load: load_clock.seconds(),
        peak_memory_bytes: memory::peak(),
        resolution: n,
        voxels: left,
        rule: config.carve.rule,
        fit: config.carve.fit,
        missed_object_pixels: missed,
        scene: dataset.name().to_owned(),
        run: folder.path().display().to_string(),
    };
    folder.write_result(&summary)?;
    on(Event::Finished { summary: &summary, run });
    Ok(summary)
}
