//! `--path`: camera paths.

use crate::commands::train::size;
use crate::commands::trained_run::{Found, TrainedModel};
use crate::commands::whole;
use crate::progress::Console;
use clap::Args;
use plenoxel::camera::Camera;
use plenoxel::camera_path::{CameraPath, MOST_FRAMES, Turntable, along_cameras, spiral, up_axis};
use plenoxel::dataset::normalize::{NEAREST_DEPTH, looked_at};
use plenoxel::dataset::{Dataset, Split, image};
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::space::Space;
use std::path::{Path, PathBuf};

/// Default number of frames, that of the source paper's turntable.
const FRAMES: usize = 120;
/// Default frame rate, in frames per second.
const FPS: f64 = 30.0;
/// Default side of frames in pixels, if there are no views.
const SIDE: usize = 400;

/// Choice of a camera path.
#[derive(Debug, Clone)]
pub enum PathChoice {
    Orbit,
    Spiral,
    Cameras,
    File(PathBuf),
}

/// A camera path, and the size and rate of its frames.
#[derive(Debug, Args)]
pub struct PathArgs {
    /// Render a video along a camera path. orbit: one turn around what the cameras look at, or a swing if they are all on one side. spiral: two turns
    /// that rise and fall; for forward-facing captures, the spiral of LLFF. cameras: a spline along the training views. FILE: base_cam.json of instant-ngp,
    /// camera_path.json of nerfstudio, or any transforms.json
    #[arg(long, value_name = "orbit|spiral|cameras|FILE", help_heading = "Path", value_parser = choice)]
    pub path: Option<PathChoice>,

    /// Number of frames [default: that of the file, or 120]
    #[arg(long, value_name = "N", help_heading = "Path", requires = "path", value_parser = whole::<usize>(1, MOST_FRAMES as u64), allow_negative_numbers = true)]
    frames: Option<usize>,

    /// Size of the frames in pixels, SIDE or WIDTHxHEIGHT [default: that of the file, that of the views, or 400]
    #[arg(long, value_name = "SIZE", help_heading = "Path", requires = "path", value_parser = frame_size, allow_hyphen_values = true)]
    size: Option<(usize, usize)>,

    /// Frames per second of the MP4 and the GIF, which shows at most 50 [default: that of the file, or 30]
    #[arg(long, value_name = "RATE", help_heading = "Path", requires = "path", value_parser = rate, allow_negative_numbers = true)]
    fps: Option<f64>,
}

/// The cameras of a video.
pub struct Film {
    /// Name of its files.
    pub name: String,
    pub cameras: Vec<Camera>,
    /// Frames per second.
    pub fps: f64,
}

impl PathArgs {
    /// Returns the cameras of a path. The views of the run, if they still exist, give the parameters that the path leaves open.
    pub fn film(&self, path: &PathChoice, run: &TrainedModel, found: &Found, console: &Console<'_>) -> Result<Film> {
        let file = match path {
            PathChoice::File(path) => Some((path, read(path)?)),
            PathChoice::Orbit | PathChoice::Spiral | PathChoice::Cameras => None,
        };
        let in_file = file.as_ref().and_then(|(_, path)| path.size);
        let views = match (&file, self.size.or(in_file)) {
            (Some(_), Some(_)) => None,
            _ => run.views_if_any(found, console, "the camera path is computed from the box")?,
        };
        let size = self.size.or(in_file).or(views.as_ref().map(Dataset::size)).unwrap_or((SIDE, SIDE));
        let cameras = views.as_ref().map(|views| views.cameras(Split::Train)).unwrap_or_default();
        let space = views.as_ref().map_or(Space::Box, Dataset::space);
        let table = || {
            let table = match space {
                Space::Box => Turntable::like(&cameras),
                Space::Contracted => Turntable::around(&cameras, looked_at(&cameras).unwrap_or_default(), up_axis(space, &cameras)),
                Space::Ndc { .. } => {
                    let problem = "orbit leaves the side of the scene that the cameras of a forward-facing capture see";
                    return Err(Error::usage("--path", problem, "use --path spiral or --path cameras"));
                }
            };
            table.map_or_else(|| Ok(Turntable::around_box(found.half_width()?)), Ok)
        };
        let count = self.frames.unwrap_or(FRAMES);
        let (name, shots) = match (&file, path) {
            (Some((file, path)), _) => {
                let frames = self.frames.unwrap_or(if path.is_interpolated() { FRAMES } else { path.entries() });
                console.note(&format!("{}: {} of {} {}", file.display(), path.format, path.entries(), entries(path)));
                (stem(file), path.shots(frames))
            }
            (None, PathChoice::Spiral) => {
                let shots =
                    if matches!(space, Space::Ndc { .. }) { spiral(&cameras, NEAREST_DEPTH, count) } else { table()?.spiral(count) };
                ("spiral".to_owned(), shots)
            }
            (None, PathChoice::Cameras) => {
                if cameras.is_empty() {
                    return Err(Error::usage(
                        "--path",
                        "cameras needs the views of the run, which cannot be read",
                        "give their folder with --data",
                    ));
                }
                ("cameras".to_owned(), along_cameras(&cameras, count))
            }
            (None, _) => ("orbit".to_owned(), table()?.orbit(count)),
        };
        console.note(&format!("frames: {} of {} x {} pixels", shots.len(), size.0, size.1));
        let fps = self.fps.or(file.as_ref().and_then(|(_, path)| path.fps)).unwrap_or(FPS);
        Ok(Film { name, cameras: shots.iter().map(|shot| shot.camera(size)).collect(), fps })
    }
}

fn read(path: &Path) -> Result<CameraPath> {
    if !files::is_there(path) {
        return Err(Error::usage(
            "--path",
            format!("the file {} does not exist", path.display()),
            "expected orbit, spiral, cameras, or a JSON file of cameras",
        ));
    }
    CameraPath::parse(path, &files::read_named(path, files::CAMERA_PATH)?)
}

/// Name of the entries of a path.
fn entries(path: &CameraPath) -> &'static str {
    match (path.is_interpolated(), path.entries()) {
        (true, 1) => "keyframe",
        (true, _) => "keyframes",
        (false, 1) => "frame",
        (false, _) => "frames",
    }
}

/// The name of a file without its extension.
fn stem(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    // For a file `...json` it is `..`, which is not a folder name.
    if stem.trim_matches('.').is_empty() { "path".to_owned() } else { stem.into_owned() }
}

fn choice(text: &str) -> std::result::Result<PathChoice, String> {
    match text {
        "" => Err("expected orbit, spiral, cameras, or a JSON file of cameras".to_owned()),
        "orbit" => Ok(PathChoice::Orbit),
        "spiral" => Ok(PathChoice::Spiral),
        "cameras" => Ok(PathChoice::Cameras),
        file => Ok(PathChoice::File(file.into())),
    }
}

fn frame_size(text: &str) -> std::result::Result<(usize, usize), String> {
    let (width, height) = size(text)?;
    let most = image::MAX_SIDE as usize;
    if width.max(height) <= most { Ok((width, height)) } else { Err(format!("expected at most {most} pixels per side")) }
}

fn rate(text: &str) -> std::result::Result<f64, String> {
    text.parse()
        .ok()
        .filter(|fps| (0.1..=1000.0).contains(fps))
        .ok_or_else(|| "expected a number of frames per second from 0.1 to 1000".to_owned())
}
