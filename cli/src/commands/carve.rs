//! `plenoxel carve`: carves an opaque colored grid from silhouettes and colors, without training.

use super::capture::CaptureFlags;
use super::new_run::{announce, loading};
use super::train::BuiltInScene;
use super::{MOST_REDUCTION, whole};
use crate::images;
use crate::progress::{Console, Count};
use crate::report::Report;
use clap::{Args, ValueHint};
use plenoxel::carve::Rule;
use plenoxel::carve::photo_hull::PhotoConfig;
use plenoxel::dataset::Split;
use plenoxel::error::Result;
use plenoxel::evaluate::Viewer;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::carving::{Carved, CarvingSettings, CarvingSummary, Event, carve};
use plenoxel::run::data::DataSource;
use plenoxel::run::evenly_spaced;
use plenoxel::run::settings::{self, CARVE, Layers};
use plenoxel::train::ViewOptions;
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
    /// Dataset folder, as for `train`; a capture needs --space box [default: the built-in scene]
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

/// Carves a scene and writes a run folder.
pub fn run(args: &CarveArgs, console: &Console<'_>) -> Result<()> {
    let (config, preset) = args.config()?;
    let preset = preset.map(str::to_owned);
    let report = !args.no_report;
    let settings = CarvingSettings { config, preset, data: args.source(), out: args.out.clone(), force: args.force, report };
    // The counter of the current phase.
    let mut count: Option<(&str, Count<'_, '_>)> = None;
    let mut shown = Ok(());
    carve(&settings, &mut |event| {
        let (phase, text, done, total) = match event {
            Event::Loading { source, done, total } => ("loading", loading(Split::Train, source), done, total),
            Event::Carving { done, total } => ("carving", "carving, view".to_owned(), done, total),
            Event::Coloring { done, total } => ("coloring", "coloring, pass".to_owned(), done, total),
            Event::Round { round, carved, left } => {
                return console.note(&format!("photo hull, round {round}: carved {carved} voxels, {left} are left"));
            }
            other => {
                count = None;
                match other {
                    Event::Note(text) => console.note(&text),
                    Event::Opened { dataset, config } => announce(console, dataset, config),
                    Event::Saved { run } if !args.no_images => {
                        if let Some(views) = console.drawn(draw(run)) {
                            console.note(&format!("wrote pictures of {views} views to images/carved.png"));
                        }
                    }
                    Event::Finished { summary, run } => shown = finish(args, console, summary, run),
                    _ => {}
                }
                return;
            }
        };
        if count.as_ref().is_none_or(|(shown, _)| *shown != phase) {
            count = Some((phase, console.count(&text, total)));
        }
        if let Some((_, count)) = &count {
            count.at(done, total);
        }
    })?;
    shown
}

/// Prints the results and writes the report.
fn finish(args: &CarveArgs, console: &Console<'_>, summary: &CarvingSummary, run: Carved<'_>) -> Result<()> {
    let CarvingSummary { seconds, seconds_hull, seconds_color, .. } = summary;
    console.result(&format!(
        "carved in {seconds:.2} s: hull {seconds_hull:.2} s, colors {seconds_color:.2} s; evaluate it on test views with `plenoxel evaluate`"
    ))?;
    if summary.rule == Rule::Footprint {
        console.note(
            "the footprint rule keeps every voxel that any pixel may show, as a start for --init-from; --carve rays carves closer to the silhouettes and has \
             a better test PSNR (lego: 23.7 dB instead of 19.1 dB)",
        );
    }
    let Carved { folder, config, record, dataset, model } = run;
    console.result(&format!("run folder: {}", folder.path().display()))?;
    console.record(summary)?;
    if !args.no_report {
        let report = Report { folder, config, record, dataset, model: Some(model) };
        console.note(&report.write(console)?);
    }
    Ok(())
}

/// Renders the model from some cameras, writes the pictures side by side, and returns their number.
fn draw(Carved { folder, config, dataset, model, .. }: Carved<'_>) -> Result<usize> {
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
