//! Captures: photographs with cameras that another program has computed, before they become a [`Dataset`].
//!
//! A reader of a format ([`transforms`](super::transforms), [`colmap`](super::colmap), [`llff`](super::llff), [`nsvf`](super::nsvf)) returns
//! a [`Capture`]: what its files state, with OpenGL camera axes, in the frame of the files. What all formats share is here: images that are
//! missing, images of another size than their camera states, splits and reduction.

mod images;

use super::image::{self, Orientation};
use super::mask::Mask;
use super::normalize::Normalization;
use super::{Dataset, Frame, OpenOptions, Source, Split, largest};
use crate::camera::{Camera, Intrinsics};
use crate::error::{Error, Result};
use crate::text::listed;
use glam::{DAffine3, DVec3};
pub(super) use images::{ImageFolder, base_name, plain, with_any_extension};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Largest accepted coordinate of a camera. Larger ones overflow when rays are intersected with boxes.
pub(super) const FARTHEST: f64 = 1e12;
/// Largest difference, in pixels of the image, between its height and the height that follows from its width and its camera: reductions
/// round differently.
const ROUNDED: f64 = 1.5;

/// Content of the files of a capture, before images are looked at.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Capture {
    /// The recognized format, as text for people.
    pub format: &'static str,
    /// Photographs whose image exists.
    pub photos: Vec<Photo>,
    /// Names of the images that the files list and that do not exist.
    pub missing: Vec<String>,
    /// Points of the scene's surfaces, in the frame of the cameras; may be empty.
    pub points: Vec<Point>,
    /// Smallest and largest depth along the optical axes at which cameras see something, if the files state it.
    pub bounds: Option<[f64; 2]>,
    /// Reduction of the images by their folder: 4 for `images_4`.
    pub reduced: usize,
    /// Notes for the user, as sentences without a stop.
    pub notes: Vec<String>,
}

/// A photograph of a [`Capture`].
#[derive(Debug, Clone, PartialEq)]
pub struct Photo {
    /// Path of the image as the files write it, without `./`. Views are sorted by it.
    pub name: String,
    /// Path of the image.
    pub image: PathBuf,
    /// Path of the mask, an image that is black where pixels are to be ignored.
    pub mask: Option<PathBuf>,
    /// Intrinsics at the size that the files state. The image may be smaller by a common factor.
    pub intrinsics: Intrinsics,
    /// Camera-to-world transform with OpenGL axes, in the frame of the files.
    pub camera_to_world: DAffine3,
    /// Split that the files state.
    pub split: Option<Split>,
}

/// A point of a surface, as structure from motion finds it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Position.
    pub position: DVec3,
    /// Color, 8-bit sRGB.
    pub color: [u8; 3],
}

/// Makes the dataset of a capture in the folder `root`.
///
/// Errors if there is no image, if fewer than half of the images exist, if an image has another shape than its camera states or a mask another
/// size than its image, or if `options` do not fit.
pub(super) fn dataset(root: &Path, mut capture: Capture, options: &OpenOptions) -> Result<Dataset> {
    check_presence(root, &mut capture)?;
    capture.photos.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = capture.photos.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(Error::input(root, format!("the image {} has two cameras", pair[0].name), "list each image once"));
    }
    let found: Vec<Result<_>> = capture.photos.par_iter().map(fitted).collect();
    let mut resized = 0;
    let mut images = Vec::new();
    for (photo, found) in capture.photos.iter_mut().zip(found) {
        let (orientation, intrinsics) = found?;
        resized += usize::from((photo.intrinsics.width, photo.intrinsics.height) != (intrinsics.width, intrinsics.height));
        images.push((orientation, (intrinsics.width, intrinsics.height)));
        photo.intrinsics = intrinsics;
    }
    if resized > 0 && capture.reduced == 1 {
        capture.notes.push(format!("{resized} images have another size than their cameras state: intrinsics were scaled"));
    }
    let masks = capture.photos.iter().filter(|photo| photo.mask.is_some()).count();
    if masks > 0 {
        capture.notes.push(format!("{masks} of {} images have a mask", capture.photos.len()));
    }
    let downscale = (options.downscale / capture.reduced).max(1);
    if capture.reduced > 1 {
        let missing = if options.downscale < capture.reduced { ", for there are no larger ones" } else { "" };
        capture.notes.push(format!("the images are those of images_{}{missing}", capture.reduced));
    }
    if let Some((photo, (_, size))) = capture.photos.iter().zip(&images).find(|(_, (_, size))| downscale > size.0.min(size.1)) {
        let found = format!("{downscale} is more than the {} x {} pixels of {}", size.0, size.1, photo.name);
        return Err(Error::usage("downscale", found, "use a smaller factor"));
    }

    let cameras: Vec<_> = capture.photos.iter().map(|p| Camera { intrinsics: p.intrinsics, camera_to_world: p.camera_to_world }).collect();
    let normalization = Normalization::of(root, &cameras, &capture.points, capture.bounds, options)?;
    let points = capture.points.iter().map(|p| Point { position: normalization.to_world.point(p.position), ..*p }).collect();

    let names = view_names(&capture.photos);
    let mut frames: [Vec<Frame>; 3] = Default::default();
    let stated: Vec<_> = capture.photos.iter().map(|photo| photo.split).collect();
    let splits = splits(&stated, options);
    for (((photo, name), (orientation, full)), split) in capture.photos.into_iter().zip(names).zip(images).zip(splits) {
        let camera_to_world = normalization.to_world.camera(photo.camera_to_world);
        let camera = Camera { intrinsics: photo.intrinsics.downscaled(downscale), camera_to_world };
        frames[split as usize].push(Frame { name, camera, path: photo.image, mask: photo.mask, orientation, full });
    }
    if frames[0].is_empty() {
        return Err(Error::input(root, "there is no training view", "list at least one training view"));
    }
    Ok(Dataset {
        name: super::scene_name(root),
        format: capture.format,
        size: largest(&frames),
        frames,
        source: Source::Files { downscale },
        normalization,
        points: Arc::new(points),
        notes: capture.notes,
    })
}

/// Reports the images that are missing.
fn check_presence(root: &Path, capture: &mut Capture) -> Result<()> {
    let (present, missing) = (capture.photos.len(), capture.missing.len());
    if present + missing == 0 {
        return Err(Error::input(root, "there is no view", "list at least one view"));
    }
    capture.missing.sort();
    if present < missing.max(1) {
        let found = format!("{missing} of {} images do not exist: {}", present + missing, listed(&capture.missing));
        return Err(Error::input(root, found, "copy the images to where the cameras' file names them; half of them may be missing"));
    }
    if missing > 0 {
        capture.notes.push(format!("skipped {missing} of {} views without an image: {}", present + missing, listed(&capture.missing)));
    }
    Ok(())
}

/// Returns the orientation in which an image has the shape that its camera states, and the intrinsics of its size. COLMAP reads images as
/// stored; programs that turn them as EXIF states come second.
///
/// Errors if the image cannot be read, or has another shape.
fn fitted(photo: &Photo) -> Result<(Orientation, Intrinsics)> {
    for orientation in [Orientation::Stored, Orientation::Stated] {
        if let Some(intrinsics) = resized(&photo.image, &photo.intrinsics, image::size_as(&photo.image, orientation)?)? {
            photo.mask.iter().try_for_each(|mask| Mask::check_file(mask, (intrinsics.width, intrinsics.height)))?;
            return Ok((orientation, intrinsics));
        }
    }
    Err(misfit(&photo.image, (photo.intrinsics.width, photo.intrinsics.height), image::size(&photo.image)?))
}

/// Returns the intrinsics of an image of another size, if it has the same shape.
///
/// Errors if the lens folds over in the image.
pub(super) fn resized(image: &Path, k: &Intrinsics, (width, height): (usize, usize)) -> Result<Option<Intrinsics>> {
    let (sx, sy) = (width as f64 / k.width as f64, height as f64 / k.height as f64);
    let off = (height as f64 - sx * k.height as f64).abs().min((width as f64 - sy * k.width as f64).abs());
    if off > ROUNDED {
        return Ok(None);
    }
    let intrinsics = Intrinsics { width, height, fx: sx * k.fx, fy: sy * k.fy, cx: sx * k.cx, cy: sy * k.cy, lens: k.lens };
    // Rounded sizes may have pixels that the stated size had not.
    intrinsics.check_lens().map_err(|unusable| unusable.at(image, "the camera of the image"))?;
    Ok(Some(intrinsics))
}

pub(super) fn misfit(path: &Path, stated: (usize, usize), size: (usize, usize)) -> Error {
    let found = format!("the image has {} x {} pixels, but its camera {} x {}", size.0, size.1, stated.0, stated.1);
    let turned = stated == (size.1, size.0);
    let remedy = if turned { "turn the image as the cameras were computed" } else { "use the images that the cameras were computed from" };
    Error::input(path, found, remedy)
}

/// Returns a name for each view: that of the file without folder and extension, or the whole path where files in several folders have one
/// name.
fn view_names(photos: &[Photo]) -> Vec<String> {
    let stem = |name: &str| base_name(name).rsplit_once('.').map_or(base_name(name), |(stem, _)| stem).to_owned();
    let stems: Vec<String> = photos.iter().map(|photo| stem(&photo.name)).collect();
    let mut sorted: Vec<&String> = stems.iter().collect();
    sorted.sort();
    if sorted.windows(2).all(|pair| pair[0] != pair[1]) {
        return stems;
    }
    photos.iter().map(|photo| photo.name.replace('/', "_")).collect()
}

/// Returns the split of each view: the stated one, or else every n-th for testing, in the order of the views.
pub(super) fn splits(stated: &[Option<Split>], options: &OpenOptions) -> Vec<Split> {
    let every = options.capture.test_every;
    let own = stated.iter().any(Option::is_some);
    let mut splits: Vec<Split> = stated
        .iter()
        .enumerate()
        .map(|(k, stated)| match *stated {
            Some(split) => split,
            None if !own && every > 0 && k.is_multiple_of(every) => Split::Test,
            None => Split::Train,
        })
        .collect();
    if let (Some(every), false) = (options.validation_every, splits.contains(&Split::Val)) {
        let training = splits.iter_mut().filter(|split| **split == Split::Train);
        training.enumerate().filter(|(k, _)| (k + 1).is_multiple_of(every)).for_each(|(_, split)| *split = Split::Val);
    }
    splits
}

/// Converts a camera-to-world transform from OpenCV axes (x right, y down, z forwards) to OpenGL axes.
pub(super) fn from_opencv(mut pose: DAffine3) -> DAffine3 {
    pose.matrix3.y_axis *= -1.0;
    pose.matrix3.z_axis *= -1.0;
    pose
}
