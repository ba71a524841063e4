//! `plenoxel carve`: carves an opaque colored grid from silhouettes and colors, without training.

use super::capture::CaptureFlags;
use super::new_run::{announce, load};
use super::train::BuiltInScene;
use super::{MOST_REDUCTION, whole};
use crate::images;
use crate::progress::Console;
use crate::report::Report;
use clap::{Args, ValueHint};
use plenoxel::carve::photo_hull::PhotoConfig;
use plenoxel::carve::{self, Carving, Colored, Fit, Progress, Rule};
use plenoxel::dataset::{Dataset, Split, has_alpha};
use plenoxel::error::Result;
use plenoxel::evaluate::Viewer;
use plenoxel::geometry::Aabb;
use plenoxel::model::plenoxels::Plenoxels;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::evenly_spaced;
use plenoxel::run::folder::{NewFolder, RunFolder, RunKind, RunRecord};
use plenoxel::run::memory::{self, Estimate};
use plenoxel::run::settings::{self, CARVE, Layers};
use plenoxel::run::training::Stopwatch;
use plenoxel::train::{About, ViewOptions};
use serde::Serialize;
use std::path::PathBuf;
use toml::Value;

const EXAMPLES: &str = "\
Examples:
  plenoxel carve data/lego                                 the visual hull with mean colors, 256 voxels per side
  plenoxel carve data/lego --sh-degree 2 --resolution 128  with view-dependent color (spherical harmonics)
  plenoxel carve data/lego --carve rays --downscale 4      with the rule of the source paper, at 200 x 200
  plenoxel carve data/lego --photo-consistency             also carve concave parts, by inconsistent colors
  plenoxel train data/lego --init-from runs/lego-1         train the carved grid

The result is a run folder for evaluate, render, export and info. Settings are layered as for train; for --set, those of carving begin \
with `carve.`. If stdout is not a terminal, its last line is a JSON object with the results.";

/// Carve an opaque colored grid, without training, from the silhouettes of images with alpha or by photo-consistency
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct CarveArgs {
    /// Dataset folder in the NeRF-synthetic format [default: the built-in scene]
    #[arg(value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Run folder to write [default: runs/<scene>-<n> with the first free n]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,

    /// Overwrite an existing run in the folder
    #[arg(long, help_heading = "Output")]
    force: bool,

    /// Write no pictures
    #[arg(long, help_heading = "Output")]
    no_images: bool,

    /// Write no report.html
    #[arg(long, help_heading = "Output")]
    no_report: bool,

    /// TOML file of settings that override the preset; a complete file, such as the config.toml of a run, replaces the preset
    #[arg(long, value_name = "FILE", help_heading = "Settings", value_hint = ValueHint::FilePath)]
    config: Option<PathBuf>,

    /// Set any key of the configuration; may be repeated
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Settings")]
    set: Vec<String>,

    /// Downscale the images by this factor, which must divide their width and height [default: 1]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = whole::<i64>(1, MOST_REDUCTION), allow_negative_numbers = true)]
    downscale: Option<i64>,

    /// Background color: white, black, or three numbers r,g,b in [0, 1] [default: white]
    #[arg(long, help_heading = "Scene", value_parser = super::background, allow_hyphen_values = true)]
    background: Option<[f64; 3]>,

    /// Half the side of the cube that contains the scene, in units of the dataset [default: 1.5]
    #[arg(long, value_name = "LENGTH", help_heading = "Scene", value_parser = super::number(f64::NEG_INFINITY), allow_negative_numbers = true)]
    half_width: Option<f64>,

    #[command(flatten)]
    capture: CaptureFlags,

    #[command(flatten)]
    built_in: BuiltInScene,

    /// Voxels per side of the box [default: 256]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<i64>(2, 1024), allow_negative_numbers = true)]
    resolution: Option<i64>,

    /// Degree of spherical harmonics for view-dependent color, 0 to 3 [default: one constant color per voxel]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<i64>(0, 3), allow_negative_numbers = true)]
    sh_degree: Option<i64>,

    /// Carving rule: footprint removes a voxel if some view shows all of it on background; rays removes it if the ray of some background
    /// pixel passes through it, as in the source paper [default: footprint]
    #[arg(long, value_name = "RULE", help_heading = "Carving", value_parser = ["footprint", "rays"])]
    carve: Option<String>,

    /// Also carve voxels with inconsistent colors: remove those whose colors in the photographs differ by more than this standard deviation, of sRGB
    /// values in [0, 1] (0.15 if no number is given). Needs no alpha channel, but a varied background: with one plain color, no voxel is inconsistent
    #[arg(long, value_name = "NOISE", help_heading = "Carving", value_parser = super::number(0.0), num_args = 0..=1, require_equals = true)]
    photo_consistency: Option<Option<f64>>,

    /// Fit of the colors: exact (least squares), or sgd (gradient descent, as in the source paper) [default: exact]
    #[arg(long, help_heading = "Carving", value_parser = ["exact", "sgd"])]
    fit: Option<String>,
}

impl CarveArgs {
    /// Source of the views.
    pub fn source(&self) -> DataSource {
        self.built_in.source_or(self.data.as_deref())
    }

    /// Resolves the configuration. Returns it with the name of its preset.
    pub fn config(&self) -> Result<(Config, Option<&str>)> {
        settings::layered(None, CARVE.name, self.config.as_deref(), |layers| self.flags(layers))
    }

    fn flags(&self, layers: &mut Layers) -> Result<()> {
        let integer = |value: Option<i64>| value.map(Value::Integer);
        let text = |value: &Option<String>| value.clone().map(Value::String);
        let noise = self.photo_consistency.map(|noise| noise.unwrap_or(PhotoConfig::default().noise));
        for (flag, path, value) in [
            ("--downscale", "downscale", integer(self.downscale)),
            ("--background", "background", self.background.map(|c| Value::Array(c.map(Value::Float).to_vec()))),
            ("--half-width", "half_width", self.half_width.map(Value::Float)),
            ("--sh-degree", "color", self.sh_degree.map(|_| Value::String("sh".to_owned()))),
            ("--sh-degree", "sh_degree", integer(self.sh_degree)),
            ("--resolution", "carve.resolution", integer(self.resolution)),
            ("--carve", "carve.rule", text(&self.carve)),
            ("--photo-consistency", "carve.photo.noise", noise.map(Value::Float)),
            ("--fit", "carve.fit", text(&self.fit)),
        ] {
            if let Some(value) = value {
                layers.set(path, Some(value), flag)?;
            }
        }
        self.capture.set(layers)?;
        self.set.iter().try_for_each(|assignment| layers.assign(assignment))
    }
}

/// Number of voxels per side above which the memory of the colors is estimated before the hull, because the hull takes long.
const LARGE: usize = 256;

/// Carves a scene and writes a run folder.
pub fn run(args: &CarveArgs, console: &Console<'_>) -> Result<()> {
    let source = args.source();
    let (config, preset) = args.config()?;
    let mut load_clock = Stopwatch::default();
    let dataset = load_clock.time(|| source.open(&config))?;
    announce(console, &dataset, &config);
    let estimate = Estimate::of_carving(&config, &dataset, 0, !args.no_report);
    console.note(&estimate.describe());
    estimate.check()?;
    dataset.space().require_box("carve")?;
    for warning in source.check_cameras(&dataset, Aabb::cube(config.half_width))? {
        console.note(&format!("warning: {warning}"));
    }
    let folder = NewFolder::choose(args.out.as_deref(), dataset.name(), args.force)?;
    let views = load_clock.time(|| load(console, &dataset, Split::Train, &source))?;

    let mut hull_clock = Stopwatch::default();
    // A coarse hull overestimates the number of voxels. If not even half of them fit into memory, the command fails early.
    if config.carve.resolution > LARGE {
        let expected = hull_clock.time(|| carve::voxels_expected(&views, &config.carve_options())).unwrap_or(0.0);
        Estimate::of_carving(&config, &dataset, (0.5 * expected) as usize, !args.no_report).check()?;
    }
    let count = console.count("carving, view", views.len());
    let progress = |progress| match progress {
        Progress::Views(done) => count.at(done, views.len()),
        Progress::Round { round, carved, left } => {
            console.note(&format!("photo hull, round {round}: carved {carved} voxels, {left} are left"))
        }
    };
    let carving = hull_clock.time(|| Carving::new(&views, &config.carve_options(), &progress))?;
    drop(count);
    let (n, left) = (config.carve.resolution, carving.voxels());
    let share = 100.0 * left as f64 / (n as f64).powi(3);
    console.note(&format!("carved {n}³ voxels in {:.2} s: {left} are left, {share:.1} %", hull_clock.seconds()));
    if share > 50.0 {
        console.note(
            "most of the box is left because the photographs rule out little of it; use more views, images with alpha, or a smaller --half-width",
        );
    }
    let estimate = Estimate::of_carving(&config, &dataset, carving.rows(), !args.no_report);
    console.note(&estimate.describe());
    estimate.check()?;

    // Nothing is written or overwritten before all checks of the input.
    let folder = folder.create()?;
    let record = RunRecord::new(RunKind::Carved, &dataset, preset, &source);
    folder.describe(&config, &record)?;
    console.note(&format!("run: {}", folder.path().display()));
    let mut color_clock = Stopwatch::default();
    let passes = match config.carve.fit {
        Fit::Exact => config.carve.sweeps + 1,
        Fit::Sgd => carve::color::EPOCHS + 1,
    };
    let count = console.count("coloring, pass", passes);
    let colored = color_clock.time(|| carving.color(&|done| count.at(done, passes)));
    drop(count);
    if colored.missed > 0.0 && has_alpha(&views) {
        console.note(&format!(
            "{:.2} % of the object pixels show no voxel: those parts are thinner than a pixel or outside the box (--half-width)",
            100.0 * colored.missed
        ));
    }
    let Colored { grid, missed } = colored;
    let model = Plenoxels::of_grid(&config, grid);
    folder.save(&model, &About { scene: dataset.name().to_owned(), background: config.background, seed: config.seed, step: 0 })?;
    drop(carving);
    drop(views);

    if !args.no_images
        && let Some(views) = console.drawn(draw(&folder, &config, &dataset, &model))
    {
        console.note(&format!("wrote pictures of {views} views to images/carved.png"));
    }
    let summary = Summary {
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
    let Summary { seconds, seconds_hull, seconds_color, .. } = summary;
    console.result(&format!(
        "carved in {seconds:.2} s: hull {seconds_hull:.2} s, colors {seconds_color:.2} s; evaluate it on test views with `plenoxel evaluate`"
    ))?;
    if config.carve.rule == Rule::Footprint {
        console.note(
            "the footprint rule keeps every voxel that any pixel may show, as a start for --init-from; --carve rays carves closer to the silhouettes and has \
             a better test PSNR (lego: 23.7 dB instead of 19.1 dB)",
        );
    }
    console.result(&format!("run folder: {}", folder.path().display()))?;
    console.record(&summary)?;
    if !args.no_report {
        let report = Report { folder: &folder, config: &config, record: &record, dataset: &dataset, model: Some(&model) };
        console.note(&report.write(console)?);
    }
    Ok(())
}

/// Renders the model from some cameras, writes the pictures side by side, and returns their number.
fn draw(folder: &RunFolder, config: &Config, dataset: &Dataset, model: &Plenoxels<f32>) -> Result<usize> {
    const MOST: usize = 4;
    let split = if dataset.count(Split::Test) > 0 { Split::Test } else { Split::Train };
    let cameras = dataset.cameras(split);
    let viewer = Viewer::of(model, &ViewOptions::over(config.background));
    let chosen = evenly_spaced(cameras.len(), MOST);
    let pictures: Vec<_> = chosen.into_iter().map(|number| viewer.see(&cameras[number]).rgb).collect();
    folder.create_images()?;
    images::write(&folder.image("carved.png"), &images::strip(&pictures.iter().collect::<Vec<_>>()))?;
    Ok(pictures.len())
}

/// Final figures. `seconds` is the time of carving and coloring, without reading images.
#[derive(Debug, Serialize)]
struct Summary {
    seconds: f64,
    seconds_hull: f64,
    seconds_color: f64,
    seconds_load: f64,
    peak_memory_bytes: Option<u64>,
    resolution: usize,
    voxels: usize,
    rule: Rule,
    fit: Fit,
    missed_object_pixels: f64,
    scene: String,
    run: String,
}
