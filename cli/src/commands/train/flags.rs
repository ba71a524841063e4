//! The flags of `train`, and the configuration they amount to.

use crate::commands::{MOST_REDUCTION, background, whole};
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueHint};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::error::{Error, Result};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::settings::{self, Layers, PRESETS};
use std::path::{Path, PathBuf};
use toml::Value;

const EXAMPLES: &str = "\
Examples:
  plenoxel train                                   the built-in scene, into runs/procedural-1
  plenoxel train data/lego --out runs/lego         a NeRF-synthetic folder
  plenoxel train data/lego --preset paper --tv 1e-4
  plenoxel train data/lego --downscale 4 --half-width 1.3 --set stages[*].density_rate=30
  plenoxel train data/lego --config runs/lego/config.toml --seed 7
  plenoxel train --resume runs/lego                go on with it after Ctrl-C or a power cut

Settings are layered: defaults < preset < --config < flags. config.toml in the run folder lists all of them; --set \
reaches each by its path there, such as stages[0].sampling.step. The last line on stdout is one JSON object, \
where it is no terminal; result.json has it too.";

/// What a run that goes on was told when it began.
pub const NOT_WHEN_RESUMED: [&str; 20] = [
    "out",
    "force",
    "preset",
    "time",
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
    "tv",
];

/// Learn a scene and leave a run folder with the trained grid, pictures and figures
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct TrainArgs {
    /// Folder of a dataset in the NeRF-synthetic format; without it, the built-in scene
    #[arg(value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Folder to write [default: runs/<scene>-<n>, the first free n]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    pub out: Option<PathBuf>,

    /// Overwrite the run in the folder
    #[arg(long, help_heading = "Output")]
    pub force: bool,

    /// Go on with the run in this folder from where it was last saved, with the settings that it began with, and the data, wherever they are
    /// now
    #[arg(long, value_name = "RUN", help_heading = "Output", value_hint = ValueHint::DirPath, conflicts_with_all = NOT_WHEN_RESUMED)]
    pub resume: Option<PathBuf>,

    /// Save this often what is needed to go on, such as 30s or 10m; it is saved too when the run is interrupted (Ctrl-C, SIGTERM). If an
    /// earlier grid that was saved shows validation views better than the last, it is kept too: best.safetensors
    #[arg(long, value_name = "DURATION", help_heading = "Output", value_parser = duration, default_value = "5m")]
    pub checkpoint_every: f64,

    /// Look at the grid this often while it trains, such as 10s, or off: images/preview.png, and the PSNR of a few validation views. What is
    /// trained does not depend on it, and it takes less than a twentieth of the time, or a second
    #[arg(long, value_name = "DURATION", help_heading = "Output", value_parser = duration_or_off, default_value = "10s")]
    pub preview_every: f64,

    /// Compare the trained grid with N test views, evenly spaced, instead of all of them
    #[arg(long, value_name = "N", help_heading = "Output", value_parser = whole::<usize>(1, usize::MAX as u64), conflicts_with = "no_evaluate")]
    pub test_views: Option<usize>,

    /// Do not compare the trained grid with the test views; `plenoxel evaluate` does it later
    #[arg(long, help_heading = "Output")]
    pub no_evaluate: bool,

    /// Write no pictures
    #[arg(long, help_heading = "Output")]
    pub no_images: bool,

    /// Write no report.html
    #[arg(long, help_heading = "Output")]
    pub no_report: bool,

    /// Compute the test PSNR of each earlier stage too, which doubles the evaluation [default: for the built-in scene]
    #[arg(long, help_heading = "Output")]
    stage_psnr: bool,

    /// Settings to start from; `plenoxel presets` says what each is for [default: fast; quality with --time from 180 seconds on]
    #[arg(long, help_heading = "Settings", value_parser = PossibleValuesParser::new(PRESETS.map(|preset| preset.name)))]
    preset: Option<String>,

    /// Make all stages of the preset longer or shorter, so that training takes this long on this machine, such as 90s, 5m or 1h, and
    /// the finest coarser if it is short; how long is found out once, and written into the settings in steps
    #[arg(long, value_name = "DURATION", help_heading = "Settings", value_parser = duration, allow_hyphen_values = true)]
    pub time: Option<f64>,

    /// TOML file that changes the preset; a complete one, such as the config.toml of a run, stands in its place
    #[arg(long, value_name = "FILE", help_heading = "Settings", value_hint = ValueHint::FilePath)]
    config: Option<PathBuf>,

    /// Set any key of the configuration; may be repeated. Nothing after the = removes an optional key
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Settings")]
    set: Vec<String>,

    /// Seed of everything random [default: 42]
    #[arg(long, help_heading = "Settings", value_parser = whole::<i64>(0, i64::MAX as u64), allow_negative_numbers = true)]
    seed: Option<i64>,

    /// Reduce the images by this factor, which must divide their width and height [default: 1; preset paper: 8]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = whole::<i64>(1, MOST_REDUCTION))]
    downscale: Option<i64>,

    /// Color behind the scene: white, black, or three numbers r,g,b in [0, 1] [default: white]
    #[arg(long, help_heading = "Scene", value_parser = background)]
    background: Option<[f64; 3]>,

    /// Half the side of the cube in which the scene lies, in the dataset's units [default: 1.5; presets demo and paper: 1.4]
    #[arg(long, value_name = "LENGTH", help_heading = "Scene", allow_negative_numbers = true)]
    half_width: Option<f64>,

    #[command(flatten)]
    built_in: BuiltInScene,

    /// How values between voxel centres are found [default: trilinear; preset paper: nearest]
    #[arg(long, help_heading = "Model", value_parser = ["nearest", "trilinear"])]
    interpolation: Option<String>,

    /// One color a voxel, or spherical harmonics of the direction of view [default: sh; preset paper: rgb]
    #[arg(long, help_heading = "Model", value_parser = ["rgb", "sh"])]
    color: Option<String>,

    /// Degree of the spherical harmonics, 0 to 3; implies --color sh [default: 2]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<i64>(0, 3))]
    sh_degree: Option<i64>,

    /// Store harmonics of degree 1 and more for every N-th voxel along each axis only, which takes less memory and time
    /// [default: 4; presets quality: 3, demo, plenoxels and paper: 1]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<i64>(1, 64))]
    sh_reduction: Option<i64>,

    /// Start from the grid of this run. A trained grid keeps its box, and stages coarser than it are left out; a carved one gives the box of its
    /// voxels, and all stages are trained
    #[arg(long, value_name = "RUN", help_heading = "Training", value_hint = ValueHint::DirPath)]
    init_from: Option<PathBuf>,

    /// Where images have alpha, let silhouettes decide the size of the box and which voxels exist (auto), or use alpha for compositing
    /// only (off) [default: auto; presets paper and plenoxels: off]
    #[arg(long, help_heading = "Training", value_parser = ["auto", "off"])]
    hull: Option<String>,

    /// What computes the pixels: fused, in one pass, or graph, the slow one to compare it with [default: fused]
    #[arg(long, help_heading = "Training", value_parser = ["fused", "graph"])]
    engine: Option<String>,

    /// Total variation of the whole grid, weighted as in the source paper: sets tv_density and tv_color to W / 2 [default: 0]
    // The paper adds W (Σ over color channels / channels + density) / (2 n³) of sums over cells. Ours are means over cells, and
    // tv_color is one over channels too, so each gets W / 2.
    #[arg(long, value_name = "W", help_heading = "Training", value_parser = weight, allow_negative_numbers = true)]
    tv: Option<f64>,
}

/// What the built-in scene is to be, for a command whose argument `data` may be left out.
#[derive(Debug, Args)]
pub struct BuiltInScene {
    /// Size of the built-in scene's images in pixels, SIDE or WIDTHxHEIGHT [default: 200]
    #[arg(long, value_name = "SIZE", help_heading = "Scene", value_parser = size, conflicts_with = "data", allow_hyphen_values = true)]
    scene_size: Option<(usize, usize)>,

    /// Number of training, validation and test views of the built-in scene [default: 100,10,25]
    #[arg(long, value_name = "TRAIN,VAL,TEST", help_heading = "Scene", value_parser = three_counts, conflicts_with = "data")]
    scene_views: Option<[usize; 3]>,
}

impl BuiltInScene {
    /// The folder, or without one the built-in scene.
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
    /// Where the views come from.
    pub fn source(&self) -> DataSource {
        self.built_in.source_or(self.data.as_deref())
    }

    /// True if the grids of earlier stages are evaluated too.
    pub fn keeps_stages(&self, source: &DataSource) -> bool {
        self.stage_psnr || matches!(source, DataSource::BuiltIn { .. })
    }

    /// Where the views of a run that goes on are now, if they are not where they were.
    pub fn moved_to(&self) -> Option<DataSource> {
        self.data.as_deref().map(DataSource::folder)
    }

    /// The configuration, and the preset it started from.
    pub fn config(&self) -> Result<(Config, Option<&str>)> {
        // In two minutes `fast` is 0.2 dB better, in four 0.6 worse.
        let default = if self.time.is_some_and(|seconds| seconds >= 180.0) { "quality" } else { "fast" };
        settings::layered(self.preset.as_deref(), default, self.config.as_deref(), |layers| self.flags(layers))
    }

    fn flags(&self, layers: &mut Layers) -> Result<()> {
        let integer = |value: Option<i64>| value.map(Value::Integer);
        let text = |value: &Option<String>| value.clone().map(Value::String);
        let color = match (self.color.as_deref(), self.sh_degree) {
            (None, Some(_)) => Some(Value::String("sh".to_owned())),
            (Some("rgb"), Some(degree)) => {
                return Err(Error::config("--sh-degree", format!("{degree} with --color rgb, which has no harmonics"), "one of the two"));
            }
            _ => text(&self.color),
        };
        // Absolute, so that the settings repeat the run from anywhere.
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
            ("--color", "color", color),
            ("--sh-degree", "sh_degree", integer(self.sh_degree)),
            ("--sh-reduction", "sh_reduction", integer(self.sh_reduction)),
            ("--engine", "engine", text(&self.engine)),
            ("--init-from", "init_from", init_from),
            ("--hull", "hull", text(&self.hull)),
            ("--tv", "losses.tv_density", tv.clone()),
            ("--tv", "losses.tv_color", tv),
        ] {
            if let Some(value) = value {
                layers.set(path, Some(value), flag)?;
            }
        }
        self.set.iter().try_for_each(|assignment| layers.assign(assignment))
    }
}

/// Seconds from `90`, `90s`, `1.5m` or `1h`.
fn duration(text: &str) -> std::result::Result<f64, String> {
    let number = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[number.len()..] {
        "" | "s" => Some(1.0),
        "m" | "min" => Some(60.0),
        "h" => Some(3600.0),
        _ => None,
    };
    let seconds = unit.and_then(|unit| Some(number.parse::<f64>().ok()? * unit));
    seconds.filter(|s| *s > 0.0 && *s <= 1e6).ok_or_else(|| "a duration above 0 and up to 1e6 seconds, such as 90s, 5m or 1h".to_owned())
}

/// The same, or `off`: infinitely many.
fn duration_or_off(text: &str) -> std::result::Result<f64, String> {
    if text == "off" { Ok(f64::INFINITY) } else { duration(text).map_err(|accepted| format!("{accepted}; or off")) }
}

/// Width and height from `SIDE` or `WIDTHxHEIGHT`.
pub fn size(text: &str) -> std::result::Result<(usize, usize), String> {
    let (width, height) = text.split_once('x').unwrap_or((text, text));
    match (width.parse(), height.parse()) {
        (Ok(width), Ok(height)) if width > 0 && height > 0 => Ok((width, height)),
        _ => Err("a number of pixels, or WIDTHxHEIGHT such as 320x240".to_owned()),
    }
}

fn three_counts(text: &str) -> std::result::Result<[usize; 3], String> {
    let counts: Vec<usize> = text.split(',').map_while(|part| part.trim().parse().ok()).collect();
    let fits = counts.len() == text.split(',').count();
    let counts = counts.try_into().ok().filter(|[train, ..]: &[usize; 3]| fits && *train > 0);
    counts.ok_or_else(|| "three numbers of views such as 100,10,25, the first of them at least 1".to_owned())
}

fn weight(text: &str) -> std::result::Result<f64, String> {
    let weight = text.parse().ok();
    weight.filter(|w: &f64| w.is_finite() && *w >= 0.0).ok_or_else(|| "a number of at least 0, such as 1e-4".to_owned())
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
    fn what_says_nothing_of_a_preset_begins_with_fast_or_with_quality_where_there_is_time() {
        let preset = |arguments: &[&str]| {
            let cli = crate::Cli::try_parse_from(["plenoxel", "train"].iter().chain(arguments)).unwrap();
            let crate::Command::Train(args) = cli.command else { panic!("train") };
            args.config().unwrap().1.map(str::to_owned)
        };
        for arguments in [&[][..], &["data/lego"], &["--time", "179s"], &["data/lego", "--time", "1m"]] {
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
