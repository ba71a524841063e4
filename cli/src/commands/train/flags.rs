//! The flags of `train`, and the configuration resolved from them.

use crate::commands::capture::CaptureFlags;
use crate::commands::{MOST_REDUCTION, background, number, whole};
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueHint};
use plenoxel::dataset::is_capture;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::error::{Error, Result};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::settings::{self, Layers, PRESETS};
use plenoxel::text::duration;
use std::path::{Path, PathBuf};
use toml::Value;

const EXAMPLES: &str = "\
Examples:
  plenoxel train                                   train the built-in scene into runs/procedural-1
  plenoxel train data/lego --out runs/lego         train a NeRF-synthetic scene
  plenoxel train data/lego --preset paper --tv 1e-4
  plenoxel train data/lego --downscale 4 --half-width 1.3 --set stages[*].density_rate=30
  plenoxel train data/lego --config runs/lego/config.toml --seed 7
  plenoxel train --resume runs/lego                resume after Ctrl-C or a power cut
  plenoxel train data/lego --view                  watch the scene as it is learned, in a browser

Settings are layered: defaults < preset < --config < flags. The run folder has all of them in config.toml. --set takes their \
paths in that file, such as stages[0].sampling.step. If stdout is not a terminal, its last line is the JSON object of result.json.";

/// Weight of the loss `poses` with `--refine-poses`.
const POSES: f64 = 0.01;

/// Arguments that conflict with `--resume`, because they are fixed at the start of a run.
pub const NOT_WHEN_RESUMED: [&str; 28] = [
    "out",
    "force",
    "preset",
    "time",
    "including_evaluation",
    "config",
    "set",
    "seed",
    "downscale",
    "background",
    "half_width",
    "scene_size",
    "scene_views",
    "interpolation",
    "color",
    "sh_degree",
    "sh_reduction",
    "init_from",
    "hull",
    "engine",
    "refine_poses",
    "tv",
    "format",
    "space",
    "orient",
    "center",
    "scale",
    "test_every",
];

/// Train a scene and write a run folder with the trained grid, pictures and results
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct TrainArgs {
    /// Dataset folder: NeRF-synthetic, transforms.json, COLMAP, LLFF or NSVF [default: the built-in scene]
    #[arg(value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Run folder to write [default: runs/<scene>-<n> with the first free n]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    pub out: Option<PathBuf>,

    /// Overwrite an existing run in the folder
    #[arg(long, help_heading = "Output")]
    pub force: bool,

    /// Resume the run in this folder from its last checkpoint, with its own settings. Flags that do not change the training, such as
    /// --test-views and --no-report, are not remembered. If the dataset has moved, give its new folder as DATA
    #[arg(long, value_name = "RUN", help_heading = "Output", value_hint = ValueHint::DirPath, conflicts_with_all = NOT_WHEN_RESUMED)]
    pub resume: Option<PathBuf>,

    /// Checkpoint interval, such as 30s or 10m. A checkpoint is also saved on Ctrl-C and SIGTERM. The checkpoint with the best validation
    /// PSNR is kept as best.safetensors if it is better than the final grid
    #[arg(long, value_name = "DURATION", help_heading = "Output", value_parser = duration, default_value = "5m", allow_hyphen_values = true)]
    pub checkpoint_every: f64,

    /// Preview interval, such as 10s, or off. A preview renders images/preview.png and measures the PSNR of a few validation views. Previews do
    /// not affect the training and take less than 5 % of the time, or one second in short runs
    #[arg(long, value_name = "DURATION", help_heading = "Output", value_parser = duration_or_off, default_value = "10s", allow_hyphen_values = true)]
    pub preview_every: f64,

    /// Evaluate the trained grid on N evenly spaced test views instead of all of them
    #[arg(long, value_name = "N", help_heading = "Output", value_parser = whole::<usize>(1, usize::MAX as u64), conflicts_with = "no_evaluate", allow_negative_numbers = true)]
    pub test_views: Option<usize>,

    /// Do not evaluate the trained grid on the test views; `plenoxel evaluate` can do it later
    #[arg(long, help_heading = "Output")]
    pub no_evaluate: bool,

    /// Write no pictures
    #[arg(long, help_heading = "Output")]
    pub no_images: bool,

    /// Write no report.html
    #[arg(long, help_heading = "Output")]
    pub no_report: bool,

    /// Also compute the test PSNR of each earlier stage, which doubles the evaluation time [default: for the built-in scene only]
    #[arg(long, help_heading = "Output")]
    stage_psnr: bool,

    /// Show the training on a page of this machine: the scene as it is learned, its curves, and buttons to save and to stop. The address is printed
    #[arg(long, help_heading = "Output")]
    pub view: bool,

    /// Port of the page on 127.0.0.1; 0 for any free port
    #[arg(long, value_name = "PORT", help_heading = "Output", value_parser = whole::<u16>(0, u16::MAX.into()), default_value = "0", requires = "view", allow_negative_numbers = true)]
    pub port: u16,

    /// Preset of the settings; `plenoxel presets` describes each [default: photos for captures; else fast, or quality with --time]
    #[arg(long, help_heading = "Settings", value_parser = PossibleValuesParser::new(PRESETS.map(|preset| preset.name)))]
    preset: Option<String>,

    /// Duration of training on this machine, such as 90s, 5m or 1h. The program measures the speed of the machine, scales the lengths of all
    /// stages, and reduces the resolution of the finest stages if the time is short. With the presets quality, tensorf, photos and
    /// ngp, the stages to come are adjusted during training. If the time is short, quality, tensorf and photos have a smaller color
    /// network (tensorf.short). The settings record the plan
    #[arg(long, value_name = "DURATION", help_heading = "Settings", value_parser = duration, allow_hyphen_values = true)]
    pub time: Option<f64>,

    /// Let --time be that of the whole run, from the start of the program to the figures of the test views. At most half of what is left after reading is kept
    /// for the evaluation. Where the plan is adjusted during training, the speed of pictures is measured; otherwise it is estimated
    #[arg(long, help_heading = "Settings", requires = "time", conflicts_with = "no_evaluate")]
    pub including_evaluation: bool,

    /// TOML file of settings that override the preset; a complete file, such as the config.toml of a run, replaces the preset
    #[arg(long, value_name = "FILE", help_heading = "Settings", value_hint = ValueHint::FilePath)]
    config: Option<PathBuf>,

    /// Set any key of the configuration; may be repeated. An empty value removes an optional key
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Settings")]
    set: Vec<String>,

    /// Seed of all random numbers [default: 42]
    #[arg(long, help_heading = "Settings", value_parser = whole::<i64>(0, i64::MAX as u64), allow_negative_numbers = true)]
    seed: Option<i64>,

    /// Downscale the images by this factor, which must divide their width and height [default: 1; preset paper: 8]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = whole::<i64>(1, MOST_REDUCTION), allow_negative_numbers = true)]
    downscale: Option<i64>,

    /// Background color: white, black, or three numbers r,g,b in [0, 1] [default: white; preset photos: 0.5,0.5,0.5]
    #[arg(long, help_heading = "Scene", value_parser = background, allow_hyphen_values = true)]
    background: Option<[f64; 3]>,

    /// Half the side of the cube that contains the scene, in units of the dataset [default: 1.5; presets demo and paper: 1.4]
    #[arg(long, value_name = "LENGTH", help_heading = "Scene", value_parser = number(f64::NEG_INFINITY), allow_negative_numbers = true)]
    half_width: Option<f64>,

    #[command(flatten)]
    capture: CaptureFlags,

    #[command(flatten)]
    built_in: BuiltInScene,

    /// Interpolation between voxel centers [default: trilinear; preset paper: nearest]
    #[arg(long, help_heading = "Model", value_parser = ["nearest", "trilinear"])]
    interpolation: Option<String>,

    /// Color of a voxel: constant (rgb), or view-dependent with spherical harmonics (sh) [default: sh; preset paper: rgb]
    #[arg(long, help_heading = "Model", value_parser = ["rgb", "sh"])]
    color: Option<String>,

    /// Degree of the spherical harmonics, 0 to 3; implies --color sh [default: 2]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<i64>(0, 3), allow_negative_numbers = true)]
    sh_degree: Option<i64>,

    /// Store view-dependent color (harmonics of degree 1 and higher) on an N times coarser grid, which saves memory and time
    /// [default: 4; presets voxels: 3, demo, plenoxels, paper, quality, photos, tensorf, dvgo, ngp and nerf: 1]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<i64>(1, 64), allow_negative_numbers = true)]
    sh_reduction: Option<i64>,

    /// Start from the grid of this run. With a trained grid, the box is that of the grid, and coarser stages are skipped. With a carved grid, the
    /// box is that of its voxels, and all stages are trained
    #[arg(long, value_name = "RUN", help_heading = "Training", value_hint = ValueHint::DirPath)]
    init_from: Option<PathBuf>,

    /// Use of the alpha channel of images: auto computes the visual hull of the silhouettes for the size of the box and the initial voxels; off
    /// uses alpha for compositing only [default: auto; presets paper, plenoxels, photos, dvgo and nerf: off]
    #[arg(long, help_heading = "Training", value_parser = ["auto", "off"])]
    hull: Option<String>,

    /// Renderer for training: fused (single pass), or graph (slow reference implementation) [default: fused]
    #[arg(long, help_heading = "Training", value_parser = ["fused", "graph"])]
    engine: Option<String>,

    /// Experimental: refine the camera poses of the training views together with the scene; sets the loss poses to 0.01. It helps if poses are wrong by
    /// pixels. With the good poses of COLMAP, held-out views of three captures lost 1 to 3.5 dB. Only the factored field (presets photos, quality and
    /// tensorf) supports it
    #[arg(long, help_heading = "Training")]
    refine_poses: bool,

    /// Weight of the total variation of the whole grid, as in the source paper; sets the losses tv_density and tv_color to W / 2 [default: 0]
    // The paper adds W (Σ over color channels / channels + density) / (2 n³) of sums over cells. Ours are means over cells, and
    // tv_color is one over channels too, so each gets W / 2.
    #[arg(long, value_name = "W", help_heading = "Training", value_parser = weight, allow_negative_numbers = true)]
    tv: Option<f64>,
}

/// Size and views of the built-in scene, for a command with an optional argument `data`.
#[derive(Debug, Args)]
pub struct BuiltInScene {
    /// Image size of the built-in scene in pixels, SIDE or WIDTHxHEIGHT [default: 200]
    #[arg(long, value_name = "SIZE", help_heading = "Scene", value_parser = size, conflicts_with = "data", allow_hyphen_values = true)]
    scene_size: Option<(usize, usize)>,

    /// Numbers of training, validation and test views of the built-in scene [default: 100,10,25]
    #[arg(long, value_name = "TRAIN,VAL,TEST", help_heading = "Scene", value_parser = three_counts, conflicts_with = "data", allow_hyphen_values = true)]
    scene_views: Option<[usize; 3]>,
}

impl BuiltInScene {
    /// Source of the views: a folder, or the built-in scene.
    pub fn source_or(&self, folder: Option<&Path>) -> DataSource {
        if let Some(folder) = folder {
            return DataSource::folder(folder);
        }
        let default = ProceduralOptions::default();
        let (width, height) = self.scene_size.unwrap_or((default.width, default.height));
        let views = [default.train, default.val, default.test];
        let [train, val, test] = self.scene_views.unwrap_or(views);
        DataSource::built_in(&ProceduralOptions { width, height, train, val, test, ..default })
    }
}

impl TrainArgs {
    /// Source of the views.
    pub fn source(&self) -> DataSource {
        self.built_in.source_or(self.data.as_deref())
    }

    /// True if the grids of earlier stages are evaluated as well.
    pub fn keeps_stages(&self, source: &DataSource) -> bool {
        self.stage_psnr || matches!(source, DataSource::BuiltIn { .. })
    }

    /// New source of the views of a resumed run, if given.
    pub fn moved_to(&self) -> Option<DataSource> {
        self.data.as_deref().map(DataSource::folder)
    }

    /// Resolves the configuration. Returns it with the name of its preset.
    pub fn config(&self) -> Result<(Config, Option<&str>)> {
        // In equal time, the factored field is better; `fast` is a voxel grid, which other programs read.
        let default = match &self.data {
            Some(data) if self.capture.names_format() || is_capture(data) => "photos",
            _ if self.time.is_some() => "quality",
            _ => "fast",
        };
        settings::layered(self.preset.as_deref(), default, self.config.as_deref(), |layers| self.flags(layers))
    }

    fn flags(&self, layers: &mut Layers) -> Result<()> {
        let integer = |value: Option<i64>| value.map(Value::Integer);
        let text = |value: &Option<String>| value.clone().map(Value::String);
        let color = match (self.color.as_deref(), self.sh_degree) {
            (None, Some(_)) => Some(Value::String("sh".to_owned())),
            (Some("rgb"), Some(degree)) => {
                return Err(Error::usage(
                    "--sh-degree",
                    format!("{degree} conflicts with --color rgb, which has no harmonics"),
                    "leave out one of the two flags",
                ));
            }
            _ => text(&self.color),
        };
        // Absolute, so that the settings repeat the run from any directory.
        let init_from = self.init_from.as_deref().map(|path| path.canonicalize().unwrap_or_else(|_| path.to_owned()));
        let init_from = init_from.map(|path| Value::String(path.to_string_lossy().into_owned()));
        let background = self.background.map(|c| Value::Array(c.map(Value::Float).to_vec()));
        let tv = self.tv.map(|weight| Value::Float(0.5 * weight));
        for (flag, path, value) in [
            ("--seed", "seed", integer(self.seed)),
            ("--downscale", "downscale", integer(self.downscale)),
            ("--background", "background", background),
            ("--half-width", "half_width", self.half_width.map(Value::Float)),
            ("--interpolation", "interpolation", text(&self.interpolation)),
            ("--sh-degree", "sh_degree", integer(self.sh_degree)),
            ("--color", "color", color),
            ("--sh-reduction", "sh_reduction", integer(self.sh_reduction)),
            ("--engine", "engine", text(&self.engine)),
            ("--init-from", "init_from", init_from),
            ("--hull", "hull", text(&self.hull)),
            ("--refine-poses", "losses.poses", self.refine_poses.then_some(Value::Float(POSES))),
            ("--tv", "losses.tv_density", tv.clone()),
            ("--tv", "losses.tv_color", tv),
        ] {
            if let Some(value) = value {
                layers.set(path, Some(value), flag)?;
            }
        }
        self.capture.set(layers)?;
        self.set.iter().try_for_each(|assignment| layers.assign(assignment))
    }
}

/// Parses a duration, or `off` to infinity.
fn duration_or_off(text: &str) -> std::result::Result<f64, String> {
    if text == "off" { Ok(f64::INFINITY) } else { duration(text).map_err(|expected| format!("{expected}, or off")) }
}

/// Parses an image size, `SIDE` or `WIDTHxHEIGHT`.
pub fn size(text: &str) -> std::result::Result<(usize, usize), String> {
    let (width, height) = text.split_once('x').unwrap_or((text, text));
    match (width.parse(), height.parse()) {
        (Ok(width), Ok(height)) if width > 0 && height > 0 => Ok((width, height)),
        _ => Err("expected a number of pixels, or WIDTHxHEIGHT such as 320x240".to_owned()),
    }
}

fn three_counts(text: &str) -> std::result::Result<[usize; 3], String> {
    let counts: Vec<usize> = text.split(',').map_while(|part| part.trim().parse().ok()).collect();
    let fits = counts.len() == text.split(',').count();
    let counts = counts.try_into().ok().filter(|[train, ..]: &[usize; 3]| fits && *train > 0);
    counts.ok_or_else(|| "expected three numbers of views such as 100,10,25, with at least 1 training view".to_owned())
}

fn weight(text: &str) -> std::result::Result<f64, String> {
    let weight = text.parse().ok();
    weight.filter(|w: &f64| w.is_finite() && *w >= 0.0).ok_or_else(|| "expected a number of at least 0, such as 1e-4".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[test]
    fn colors_sizes_and_counts_are_read_or_refused() {
        assert_eq!(background("0.25, 0.5,1").unwrap(), [0.25, 0.5, 1.0]);
        for wrong in ["gray", "1,2,3", "0.1,0.2", "0,0,0,0", "NaN,0,0", "0,0,x"] {
            assert!(background(wrong).is_err(), "{wrong}");
        }
        assert_eq!(size("32"), Ok((32, 32)));
        assert_eq!(size("32x24"), Ok((32, 24)));
        assert!(size("0").is_err() && size("3x").is_err() && size("-1").is_err());
        assert_eq!(three_counts("6,1,3"), Ok([6, 1, 3]));
        assert!(three_counts("6,1").is_err() && three_counts("0,1,3").is_err() && three_counts("6,x,3").is_err());
        assert_eq!(weight("1e-4"), Ok(1e-4));
        assert!(weight("-1").is_err() && weight("inf").is_err());
    }

    #[test]
    fn what_says_nothing_of_a_preset_begins_with_fast_or_with_quality_if_a_time_is_planned() {
        let preset = |arguments: &[&str]| {
            let cli = crate::Cli::try_parse_from(["plenoxel", "train"].iter().chain(arguments)).unwrap();
            let crate::Command::Train(args) = cli.command else { panic!("train") };
            args.config().unwrap().1.map(str::to_owned)
        };
        for arguments in [&[][..], &["data/lego"]] {
            assert_eq!(preset(arguments).as_deref(), Some("fast"), "{arguments:?}");
        }
        assert_eq!(preset(&["--time", "3m"]).as_deref(), Some("quality"));
        assert_eq!(preset(&["data/lego", "--time", "11m"]).as_deref(), Some("quality"));
        assert_eq!(preset(&["--time", "3m", "--preset", "fast"]).as_deref(), Some("fast"));
    }

    #[test]
    fn durations_have_units() {
        for (text, seconds) in [("90", 90.0), ("90s", 90.0), ("1.5m", 90.0), ("2min", 120.0), ("1h", 3600.0)] {
            assert_eq!(duration(text), Ok(seconds), "{text}");
        }
        for text in ["", "s", "0", "-5s", "5 m", "1d", "nan", "inf", "1e9s"] {
            assert!(duration(text).is_err() && duration_or_off(text).is_err(), "{text}");
        }
        assert_eq!((duration_or_off("off"), duration_or_off("1m")), (Ok(f64::INFINITY), Ok(60.0)));
    }
}
