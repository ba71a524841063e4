//! `plenoxel render`: renders a run from the cameras of its views or along a camera path.

mod channels;
mod float_files;
mod movie;
mod path;

use super::trained_run::{Found, Loaded, TrainedRun};
use crate::images::Channel;
use crate::progress::Console;
use channels::{FileFormat, Pictures};
use clap::Args;
use path::{Film, PathArgs, PathChoice};
use plenoxel::camera::Camera;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::{Error, Result};
use plenoxel::model::plenoxels::Plenoxels;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::{self, voxel_grid};
use plenoxel::run::memory::Estimate;
use std::path::PathBuf;
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  plenoxel render runs/lego                        render all test views
  plenoxel render runs/lego --view 0 --view r_17   render two views, by index and by name
  plenoxel render runs/lego --split train --downscale 4
  plenoxel render runs/lego --path orbit           render a turntable: 120 frames, a GIF, and an MP4 if ffmpeg is installed
  plenoxel render runs/lego --path base_cam.json --size 1280x720 --fps 60
  plenoxel render runs/lego --path spiral --channels color,depth,normal --format png,exr

Views are written to RUN/renders/<split>_<index>_<name>.png, with the background of the run. Other channels have a suffix: _depth (red is near,
blue is far, white is empty), _normal (world x, y, z as red, green, blue; white is empty) and _opacity. Frames of a path are written to
RUN/renders/<path>/frame_0000.png and so on. The PNG frames are combined to RUN/renders/<path>.gif and .mp4; earlier files are replaced.

EXR and NPY files have 32-bit floats. Depth is the distance along the ray in units of the dataset (NaN where empty, infinite at infinity). Normals are unit vectors in
world coordinates (0 where empty). Opacity is from 0 to 1. Color is linear light in EXR and sRGB in NPY, not clamped.";

/// Render a run from its views, or as a video along a camera path
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct RenderArgs {
    #[command(flatten)]
    run: TrainedRun,

    /// Render only this view, given by index from 0 or by name; may be repeated
    #[arg(long, value_name = "N|NAME", help_heading = "Scene", conflicts_with = "path", allow_negative_numbers = true)]
    view: Vec<String>,

    #[command(flatten)]
    path: PathArgs,

    /// Channels to render, separated by commas [default: all for views, without normals if the model has no voxels; color for paths]
    #[arg(long, value_enum, value_name = "KINDS", value_delimiter = ',', help_heading = "Output")]
    channels: Vec<Channel>,

    /// File formats of the pictures, separated by commas
    #[arg(long, value_enum, value_name = "FORMATS", value_delimiter = ',', default_value = "png", help_heading = "Output")]
    format: Vec<FileFormat>,
}

/// Renders a run.
pub fn run(args: &RenderArgs, console: &Console<'_>) -> Result<()> {
    match &args.path.path {
        Some(path) => film(args, path, console),
        None => views(args, console),
    }
}

fn views(args: &RenderArgs, console: &Console<'_>) -> Result<()> {
    let found = args.run.find()?;
    let dataset = args.run.views(&found)?;
    let split = args.run.split;
    let (cameras, names) = (dataset.cameras(split), dataset.view_names(split));
    let shots = choose(&dataset, split, &args.view)?.into_iter();
    let shots = shots.map(|number| (cameras[number], found.folder.render(&format!("{split}_{number:03}_{}", names[number])))).collect();
    let has_voxels = model::kind(&found.folder.existing_checkpoint()?)? == model::plenoxels::KIND;
    let default: Vec<Channel> = Channel::ALL.into_iter().filter(|channel| has_voxels || *channel != Channel::Normal).collect();
    let views = render(args, &found, console, shots, &default, || found.folder.create_renders())?;
    let what = if views == 1 { "view" } else { "views" };
    console.result(&format!("rendered {views} {split} {what} to {}", found.folder.render("").display()))
}

fn film(args: &RenderArgs, path: &PathChoice, console: &Console<'_>) -> Result<()> {
    let found = args.run.find()?;
    let Film { name, cameras, fps } = args.path.film(path, &args.run.of, &found, console)?;
    let folder = found.folder.render(&name);
    let stem = |number: usize| folder.join(format!("frame_{number:04}"));
    let shots: Vec<(Camera, PathBuf)> = cameras.into_iter().enumerate().map(|(number, camera)| (camera, stem(number))).collect();
    let make = || found.folder.create_film(&name, &Channel::ALL.map(Channel::suffix));
    let frames = render(args, &found, console, shots, &[Channel::Color], make)?;
    let what = if frames == 1 { "frame" } else { "frames" };
    console.result(&format!("rendered {frames} {what} to {}", folder.display()))?;
    if args.format.contains(&FileFormat::Png) {
        for channel in channels(args, &[Channel::Color]) {
            let reel = movie::Reel { folder: &folder, suffix: channel.suffix(), frames, fps };
            reel.write(console)?;
        }
    }
    Ok(())
}

/// Renders each camera to files whose names begin with its path, and returns the number of cameras. `prepare` creates the folder, after all
/// checks.
fn render(
    args: &RenderArgs,
    found: &Found,
    console: &Console<'_>,
    shots: Vec<(Camera, PathBuf)>,
    default: &[Channel],
    prepare: impl FnOnce() -> Result<PathBuf>,
) -> Result<usize> {
    let channels = channels(args, default);
    let normals = channels.contains(&Channel::Normal);
    let pixels = shots.iter().map(|(camera, _)| camera.intrinsics.width * camera.intrinsics.height).max().unwrap_or(0);
    let Loaded { model, view, .. } =
        args.run.of.load(found, console, |sampling, stored| Estimate::of_pictures(&found.config, sampling, stored, pixels, normals))?;
    prepare()?;
    let grid = || voxel_grid(&*model, found.folder.path(), "rendering normals");
    // A mean normal is that of all samples.
    let ungrouped = Config { group_in_pictures: 0.0, ..found.config.clone() };
    let normals = normals.then(|| Ok(Plenoxels::of_grid(&ungrouped, grid()?.normals()))).transpose()?;
    let pictures = Pictures::new(&*model, normals.as_ref(), &view, 1.0 / found.to_world.scale, &channels, &args.format);
    let count = console.count("rendering", shots.len());
    let start = Instant::now();
    for (done, (camera, stem)) in shots.iter().enumerate() {
        pictures.write(camera, stem)?;
        count.at(done + 1, shots.len());
    }
    drop(count);
    console.note(&format!("{:.2} seconds per camera", start.elapsed().as_secs_f64() / shots.len().max(1) as f64));
    Ok(shots.len())
}

/// The requested channels, without duplicates.
fn channels(args: &RenderArgs, default: &[Channel]) -> Vec<Channel> {
    let asked = if args.channels.is_empty() { default } else { &args.channels };
    Channel::ALL.into_iter().filter(|channel| asked.contains(channel)).collect()
}

/// Indices of the requested views; all views of the split by default.
fn choose(dataset: &Dataset, split: Split, asked: &[String]) -> Result<Vec<usize>> {
    let names = dataset.view_names(split);
    if asked.is_empty() {
        return Ok((0..names.len()).collect());
    }
    let find = |text: &String| {
        let number = text.parse().ok().filter(|number| *number < names.len());
        let number = number.or_else(|| names.iter().position(|name| name == text));
        number.ok_or_else(|| {
            let last = names.len() - 1;
            let expected = format!("expected an index from 0 to {last}, or a name from {} to {}", names[0], names[last]);
            Error::usage("--view", format!("there is no {split} view `{text}`"), expected)
        })
    };
    asked.iter().map(find).collect()
}
