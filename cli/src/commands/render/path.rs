//! `--path`: the cameras of a film.

use crate::commands::train::size;
use crate::commands::trained_run::{Found, TrainedRun};
use crate::commands::whole;
use crate::progress::Console;
use clap::Args;
use plenoxel::camera::Camera;
use plenoxel::camera_path::{CameraPath, MOST_FRAMES, Turntable};
use plenoxel::dataset::{Dataset, Split, image};
use plenoxel::error::{Error, Result};
use plenoxel::files;
use std::path::{Path, PathBuf};

/// Frames of a path that has no number of its own: the source paper's turntable.
const FRAMES: usize = 120;
/// Frames a second, unless the file says so.
const FPS: f64 = 30.0;
/// Side of pictures where there are no views to go by.
const SIDE: usize = 400;

/// Where the camera goes.
#[derive(Debug, Clone)]
pub enum PathChoice {
    Orbit,
    Spiral,
    File(PathBuf),
}

/// A path, and how it becomes frames.
#[derive(Debug, Args)]
pub struct PathArgs {
    /// Render a film instead: once around the scene (orbit), twice around rising and falling (spiral), or along the cameras of a JSON file:
    /// instant-ngp's base_cam.json, nerfstudio's camera_path.json, any transforms.json
    #[arg(long, value_name = "orbit|spiral|FILE", help_heading = "Path", value_parser = choice)]
    pub path: Option<PathChoice>,

    /// Number of frames [default: 120, or those of the file]
    #[arg(long, value_name = "N", help_heading = "Path", requires = "path", value_parser = whole::<usize>(1, MOST_FRAMES as u64))]
    frames: Option<usize>,

    /// Size of the frames in pixels, SIDE or WIDTHxHEIGHT [default: the file's, or that of the dataset's views, or 400]
    #[arg(long, value_name = "SIZE", help_heading = "Path", requires = "path", value_parser = frame_size)]
    size: Option<(usize, usize)>,

    /// Frames a second of the GIF (which shows no more than 50) and the MP4 [default: the file's, or 30]
    #[arg(long, value_name = "RATE", help_heading = "Path", requires = "path", value_parser = rate)]
    fps: Option<f64>,
}

/// What is to be rendered.
pub struct Film {
    /// What its files are called.
    pub name: String,
    pub cameras: Vec<Camera>,
    /// Frames a second.
    pub fps: f64,
}

impl PathArgs {
    /// The film of a path. Views are looked at for what the path leaves open, and need not be there any more.
    pub fn film(&self, path: &PathChoice, run: &TrainedRun, found: &Found, console: &Console<'_>) -> Result<Film> {
        let file = match path {
            PathChoice::File(path) => Some((path, read(path)?)),
            PathChoice::Orbit | PathChoice::Spiral => None,
        };
        let in_file = file.as_ref().and_then(|(_, path)| path.size);
        let views = match (&file, self.size.or(in_file)) {
            (Some(_), Some(_)) => None,
            _ => views(run, found, console)?,
        };
        let size = self.size.or(in_file).or(views.as_ref().map(Dataset::size)).unwrap_or((SIDE, SIDE));
        let table = || {
            let cameras = views.as_ref().map(|views| views.cameras(Split::Train)).unwrap_or_default();
            Turntable::like(&cameras).map_or_else(|| Ok(Turntable::around_box(found.half_width()?)), Ok)
        };
        let (name, shots) = match (&file, path) {
            (Some((file, path)), _) => {
                let frames = self.frames.unwrap_or(if path.is_interpolated() { FRAMES } else { path.entries() });
                console.note(&format!("{}: {} of {} {}", file.display(), path.format, path.entries(), entries(path)));
                (stem(file), path.shots(frames))
            }
            (None, PathChoice::Spiral) => ("spiral".to_owned(), table()?.spiral(self.frames.unwrap_or(FRAMES))),
            (None, _) => ("orbit".to_owned(), table()?.orbit(self.frames.unwrap_or(FRAMES))),
        };
        console.note(&format!("frames: {} of {} x {}", shots.len(), size.0, size.1));
        let fps = self.fps.or(file.as_ref().and_then(|(_, path)| path.fps)).unwrap_or(FPS);
        Ok(Film { name, cameras: shots.iter().map(|shot| shot.camera(size)).collect(), fps })
    }
}

/// The views of a run as far as they are there. Only where the user says where they are must they be.
fn views(run: &TrainedRun, found: &Found, console: &Console<'_>) -> Result<Option<Dataset>> {
    match found.source.reopen(&found.config) {
        Ok(dataset) => Ok(Some(dataset)),
        Err(error) if run.data.is_some() => Err(error),
        Err(error) => {
            console.note(&format!("no views to go by ({error}); the path follows from the box"));
            Ok(None)
        }
    }
}

fn read(path: &Path) -> Result<CameraPath> {
    if !files::is_there(path) {
        return Err(Error::config("--path", format!("{} is not a file", path.display()), "orbit, spiral, or a JSON file of cameras"));
    }
    CameraPath::parse(path, &files::read_named(path, files::CAMERA_PATH)?)
}

/// What the entries of a path are called.
fn entries(path: &CameraPath) -> &'static str {
    match (path.is_interpolated(), path.entries()) {
        (true, 1) => "keyframe",
        (true, _) => "keyframes",
        (false, 1) => "frame",
        (false, _) => "frames",
    }
}

/// The name of a file without its ending.
fn stem(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    // Of a file `...json` it is `..`, which is no name for a folder.
    if stem.trim_matches('.').is_empty() { "path".to_owned() } else { stem.into_owned() }
}

fn choice(text: &str) -> std::result::Result<PathChoice, String> {
    match text {
        "" => Err("orbit, spiral, or a JSON file of cameras".to_owned()),
        "orbit" => Ok(PathChoice::Orbit),
        "spiral" => Ok(PathChoice::Spiral),
        file => Ok(PathChoice::File(file.into())),
    }
}

fn frame_size(text: &str) -> std::result::Result<(usize, usize), String> {
    let (width, height) = size(text)?;
    let most = image::MAX_SIDE as usize;
    if width.max(height) <= most { Ok((width, height)) } else { Err(format!("up to {most} pixels a side")) }
}

fn rate(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|fps| (0.1..=1000.0).contains(fps)).ok_or_else(|| "a number of frames a second from 0.1 to 1000".to_owned())
}
