//! `plenoxel scene`: writes the built-in scene as a dataset.

use super::train::size;
use super::whole;
use crate::progress::Console;
use clap::{Args, ValueHint};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::dataset::{exposure, image};
use plenoxel::error::{Error, Result};
use plenoxel::run::memory::Estimate;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  plenoxel scene data/still-life
  plenoxel scene data/still-life --size 400 --train 200 --force
  plenoxel scene data/still-life --exposure-spread 0.3    with varying exposure of the training views
  plenoxel train data/still-life

Writes transforms_{train,val,test}.json and RGBA images with straight alpha, in the NeRF-synthetic format. Test views also have exact depth \
maps: 16 bits, in thousandths of a world unit, 0 for the background.";

/// Maximum number of pixels per side.
const MOST_PIXELS: u64 = image::MAX_SIDE as u64;
/// Maximum number of views of a split.
const MOST_VIEWS: u64 = 100_000;

/// Maximum spread of exposures, at which most views are nearly black or white.
const MOST_SPREAD: f64 = 2.0;

/// Write the built-in scene to a folder in the NeRF-synthetic format
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct SceneArgs {
    /// Dataset folder to write
    #[arg(value_hint = ValueHint::DirPath)]
    dir: PathBuf,

    /// Size of the images in pixels, SIDE or WIDTHxHEIGHT [default: 200]
    #[arg(long, help_heading = "Scene", value_parser = size, conflicts_with_all = ["width", "height"], allow_hyphen_values = true)]
    size: Option<(usize, usize)>,

    /// Image width in pixels
    #[arg(long, value_name = "N", help_heading = "Scene", default_value_t = ProceduralOptions::default().width, value_parser = whole::<usize>(1, MOST_PIXELS), allow_negative_numbers = true)]
    width: usize,

    /// Image height in pixels
    #[arg(long, value_name = "N", help_heading = "Scene", default_value_t = ProceduralOptions::default().height, value_parser = whole::<usize>(1, MOST_PIXELS), allow_negative_numbers = true)]
    height: usize,

    /// Number of training views
    #[arg(long, value_name = "N", help_heading = "Scene", default_value_t = ProceduralOptions::default().train, value_parser = whole::<usize>(1, MOST_VIEWS), allow_negative_numbers = true)]
    train: usize,

    /// Number of validation views
    #[arg(long, value_name = "N", help_heading = "Scene", default_value_t = ProceduralOptions::default().val, value_parser = whole::<usize>(0, MOST_VIEWS), allow_negative_numbers = true)]
    val: usize,

    /// Number of test views
    #[arg(long, value_name = "N", help_heading = "Scene", default_value_t = ProceduralOptions::default().test, value_parser = whole::<usize>(0, MOST_VIEWS), allow_negative_numbers = true)]
    test: usize,

    /// Spread S of random exposures of the training views, 0 to 2. The sRGB values of a view are multiplied by exp(S z) for its brightness, and each
    /// channel by about exp(S/2 z) for its white balance, with standard normal z. Validation and test views are not changed [default: 0]
    #[arg(long, value_name = "S", help_heading = "Scene", value_parser = spread, allow_negative_numbers = true)]
    exposure_spread: Option<f64>,

    /// Seed of the random exposures
    #[arg(long, value_name = "SEED", help_heading = "Scene", default_value_t = 42, requires = "exposure_spread", value_parser = whole::<u64>(0, u64::MAX), allow_negative_numbers = true)]
    seed: u64,

    /// Write into a folder that is not empty
    #[arg(long, help_heading = "Output")]
    force: bool,
}

/// Parses a spread of exposures.
fn spread(text: &str) -> std::result::Result<f64, String> {
    let number = text.parse().ok().filter(|spread| (0.0..=MOST_SPREAD).contains(spread));
    number.ok_or_else(|| format!("expected a number from 0 to {MOST_SPREAD}"))
}

/// Writes the built-in scene.
pub fn run(args: &SceneArgs, console: &Console<'_>) -> Result<()> {
    let (width, height) = args.size.unwrap_or((args.width, args.height));
    let dataset = Dataset::procedural(ProceduralOptions {
        width,
        height,
        train: args.train,
        val: args.val,
        test: args.test,
        ..ProceduralOptions::default()
    })?;
    if args.dir.exists() && !args.dir.is_dir() {
        return Err(Error::usage("DIR", format!("{} is a file", args.dir.display()), "choose a folder"));
    }
    let occupied = std::fs::read_dir(&args.dir).is_ok_and(|mut entries| entries.next().is_some());
    if occupied && !args.force {
        return Err(Error::usage(
            "DIR",
            format!("{} is not empty", args.dir.display()),
            "choose a new folder, or write into it with --force",
        ));
    }
    let estimate = Estimate::of_images(&dataset);
    console.note(&estimate.describe());
    estimate.check()?;
    // Otherwise the views of an earlier scene would remain in splits without views.
    for split in Split::ALL {
        let path = args.dir.join(format!("transforms_{split}.json"));
        if path.exists() {
            std::fs::remove_file(&path).map_err(|e| Error::io(&path, e, "removing the file"))?;
        }
    }
    let views = args.train + args.val + args.test;
    console.note(&format!("rendering {views} views of {width} x {height} pixels"));
    let spread = args.exposure_spread.unwrap_or(0.0);
    dataset.write_blender_changed(&args.dir, args.force, &|split, views| {
        if split == Split::Train {
            exposure::spread(views, spread, args.seed);
        }
    })?;
    console.result(&format!(
        "wrote {} train, {} val and {} test views of {width} x {height} to {}",
        args.train,
        args.val,
        args.test,
        args.dir.display()
    ))
}
