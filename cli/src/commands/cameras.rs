//! `plenoxel cameras`: runs COLMAP on a folder of photographs, and writes a folder for training.

mod colmap;
mod folder;
mod output;
mod photos;
mod settings;
mod steps;

use super::beside;
use crate::interrupt::{EXIT_CODE, Watch};
use crate::progress::Console;
use clap::{Args, ValueHint};
use colmap::{Installed, Place};
use folder::{CameraFolder, Record};
use photos::Photos;
use plenoxel::dataset::{self, OpenOptions};
use plenoxel::error::Result;
use plenoxel::text::{clock, listed};
use serde::Serialize;
use settings::SettingsFlags;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Instant;
use steps::{Step, Work};

const EXAMPLES: &str = "\
Examples:
  plenoxel cameras data/photos                      write data/photos-cameras
  plenoxel cameras data/photos --out data/room
  plenoxel cameras data/frames --matcher sequential    frames of a film
  plenoxel train data/room

Runs the program COLMAP (apt install colmap) on the CPU: features, matching, mapping. The folder gets a link to the photographs, the \
reconstruction in sparse/0, and the output of COLMAP in colmap/colmap.log. The photographs are not changed. Repeat the command to continue \
after an interruption or a failed step. If fewer than half of the photographs get a camera, that is an error. If stdout is not a terminal, \
its last line is a JSON object with the results.";

/// Compute the cameras of photographs with COLMAP, for training
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct CamerasArgs {
    /// Folder of photographs: JPEG, PNG or WebP files
    #[arg(value_hint = ValueHint::DirPath)]
    photos: PathBuf,

    /// Program of COLMAP
    #[arg(long, value_name = "PROGRAM", help_heading = "COLMAP", default_value = "colmap", value_hint = ValueHint::ExecutablePath)]
    colmap: PathBuf,

    #[command(flatten)]
    settings: SettingsFlags,

    /// Folder to write [default: PHOTOS-cameras]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,

    /// Repeat the steps whose photographs or settings have changed since an earlier call
    #[arg(long, help_heading = "Output")]
    force: bool,

    /// Print the output of COLMAP too
    #[arg(long, help_heading = "Output")]
    verbose: bool,
}

/// Computes the cameras of photographs. Returns the exit code.
pub fn run(args: &CamerasArgs, console: &Console<'_>) -> Result<u8> {
    let photos = photos::find(&args.photos)?;
    let colmap = Installed::find(&args.colmap)?;
    let out = args.out.clone().map_or_else(|| beside(&args.photos, "cameras"), Ok)?;
    let settings = args.settings.resolve(photos.all.len());
    let mut folder = CameraFolder::open(&out, Record::new(&args.photos, &photos.all, &settings)?, args.force)?;
    introduce(&photos, &colmap, console);
    // Signals end the current command of COLMAP.
    let watch = Watch::begin();
    for step in Step::ALL {
        if let Some(seconds) = folder.seconds(step) {
            console.note(&format!("{}: finished earlier, in {}", step.title(), clock(seconds)));
            continue;
        }
        console.note(&format!("{}: begins", step.title()));
        let begun = Instant::now();
        let place = Place { folder: &out, lock: &folder.lock, watch: &watch, console, verbose: args.verbose };
        let work = Work { begun, colmap: &colmap, place, settings: &settings, photos: &photos.all };
        if !work.take(step, &folder)? {
            console.error(&format!("interrupted; repeat the command to continue with {}", step.title()), EXIT_CODE);
            return Ok(EXIT_CODE);
        }
        let seconds = begun.elapsed().as_secs_f64();
        console.note(&format!("{}: finished in {}", step.title(), clock(seconds)));
        folder.finish(step, seconds)?;
    }
    drop(watch);
    conclude(&photos, &folder, console).map(|()| 0)
}

/// Says what is there, and what is not as expected.
fn introduce(photos: &Photos, colmap: &Installed, console: &Console<'_>) {
    console.note(&format!("{} photographs; {}", photos.all.len(), colmap.version));
    let sizes = photos::by_size(&photos.all).len();
    if sizes > 1 {
        console.note(&format!("the photographs have {sizes} sizes"));
    }
    if !photos.others.is_empty() {
        console.note(&format!("other files are not read: {}", listed(&photos.others)));
    }
    if photos.turned > 0 {
        let said = "photographs are stored turned (EXIF orientation): COLMAP and training use them as stored";
        console.note(&format!("{} {said}; if the scene lies on its side, train with --orient pca", photos.turned));
    }
}

/// Prints the results.
fn conclude(photos: &Photos, folder: &CameraFolder, console: &Console<'_>) -> Result<()> {
    #[derive(Serialize)]
    struct Results<'r> {
        out: &'r Path,
        photographs: usize,
        with_camera: usize,
        without_camera: Vec<&'r str>,
        /// Seconds of each step.
        seconds: BTreeMap<&'static str, f64>,
    }
    // As training opens it.
    dataset::open(folder.path(), &OpenOptions::default())?;
    let images = plenoxel::dataset::colmap::images(&folder.reconstruction().join("images.bin"))?;
    let placed: BTreeSet<&str> = images.iter().map(|image| image.name.as_str()).collect();
    let without: Vec<&str> = photos.all.iter().map(|photo| photo.name.as_str()).filter(|name| !placed.contains(name)).collect();
    let (all, with) = (photos.all.len(), photos.all.len() - without.len());
    let times: Vec<(Step, f64)> = Step::ALL.into_iter().filter_map(|step| Some((step, folder.seconds(step)?))).collect();
    let each: Vec<String> = times.iter().map(|(step, seconds)| format!("{} {}", step.name(), clock(*seconds))).collect();
    if !without.is_empty() {
        console.result(&format!("without a camera: {}", without.join(", ")))?;
    }
    console.result(&format!("{with} of {all} photographs have a camera: {}", each.join(", ")))?;
    console.result(&format!("wrote {}; train it with `plenoxel train {0}`", folder.path().display()))?;
    let seconds = times.into_iter().map(|(step, seconds)| (step.name(), seconds)).collect();
    console.record(&Results { out: folder.path(), photographs: all, with_camera: with, without_camera: without, seconds })
}
