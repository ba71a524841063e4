//! Reconstructions of COLMAP, binary and text: `cameras`, `images` and `points3D`.
//!
//! Poses are world-to-camera, a quaternion (w, x, y, z) and a translation, with OpenCV axes; they become camera-to-world with OpenGL axes
//! in the same world. Cameras may have any numbers, and each image its own camera. Points are optional, and so are all other files beside
//! these three.

mod binary;
mod text;

use super::capture::{Capture, FARTHEST, ImageFolder, Photo, Point, base_name, from_opencv, plain};
use crate::camera::Intrinsics;
use crate::camera::lens::colmap::Model;
use crate::error::{Error, Result};
use crate::files::{self, Kind};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use std::collections::BTreeMap;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// Folders in which a reconstruction is looked for, in this order.
const FOLDERS: [&str; 4] = ["sparse/0", "sparse", "colmap/sparse/0", "distorted/sparse/0"];
/// Folders of images, in this order.
const IMAGES: [&str; 2] = ["images", "input"];
/// The binary files: up to 100 000 images of 10 000 points. They are read piece by piece.
const BINARY: Kind = Kind { name: "a binary file of COLMAP", most: 64 << 30, memory: 0 };
/// The text files.
const TEXT: Kind = Kind { name: "a text file of COLMAP", most: 4 << 30, memory: 1 };
/// Largest accepted width or height of the images that cameras were computed from.
const LARGEST: u64 = 1_000_000;

/// Cameras by their numbers.
pub type Cameras = BTreeMap<u32, Intrinsics>;

/// An image of a reconstruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Path below the folder of images.
    pub name: String,
    /// Number of its camera.
    pub camera: u32,
    /// Camera-to-world transform with OpenGL axes.
    pub camera_to_world: DAffine3,
}

/// Returns the folder below `root` with a reconstruction: cameras and images. Of several in `sparse/N`, that with the largest file of
/// images.
pub(super) fn find(root: &Path) -> Option<PathBuf> {
    let size = |folder: &Path| {
        let [_, images] = ["cameras", "images"].map(|name| file(folder, name));
        file(folder, "cameras")?;
        images?.metadata().ok().map(|data| data.len())
    };
    let numbered = std::fs::read_dir(root.join("sparse")).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut numbered: Vec<_> = numbered.filter_map(|folder| Some((size(&folder)?, folder))).collect();
    // The largest; of equal ones the first by name.
    numbered.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
    let listed = || FOLDERS.iter().map(|name| root.join(name)).find(|folder| size(folder).is_some());
    numbered.into_iter().next().map(|(_, folder)| folder).or_else(listed)
}

/// Returns the file of a name in a reconstruction, binary if there are both.
fn file(folder: &Path, name: &str) -> Option<PathBuf> {
    [".bin", ".txt"].iter().map(|extension| folder.join(format!("{name}{extension}"))).find(|path| files::is_there(path))
}

/// Parses a file of cameras, binary or text by its extension.
///
/// Errors if it is damaged, or if a camera cannot be used, naming the camera.
pub fn cameras(path: &Path) -> Result<Cameras> {
    if is_binary(path) { binary::cameras(open(path)?) } else { text::cameras(path, &files::text(path, &files::read(path, TEXT)?)?) }
}

/// Parses a file of images, binary or text by its extension.
///
/// Errors if it is damaged, or if a pose is not a motion, naming the image.
pub fn images(path: &Path) -> Result<Vec<Image>> {
    if is_binary(path) { binary::images(open(path)?) } else { text::images(path, &files::text(path, &files::read(path, TEXT)?)?) }
}

/// Parses a file of points, binary or text by its extension. Points that are not finite are left out.
///
/// Errors if it is damaged.
pub fn points(path: &Path) -> Result<Vec<Point>> {
    if is_binary(path) { binary::points(open(path)?) } else { text::points(path, &files::text(path, &files::read(path, TEXT)?)?) }
}

/// Parses the bytes of a file of the kind "cameras", "images" or "points3D", binary or text by the extension of `path`. Returns the number
/// of entries.
pub fn parse(path: &Path, bytes: &[u8]) -> Result<usize> {
    let source = || binary::Source::new(path, std::io::Cursor::new(bytes), bytes.len() as u64);
    let text = || files::text(path, bytes);
    match (path.file_stem().unwrap_or_default().to_str(), is_binary(path)) {
        (Some("cameras"), true) => binary::cameras(source()).map(|cameras| cameras.len()),
        (Some("cameras"), false) => text::cameras(path, &text()?).map(|cameras| cameras.len()),
        (Some("images"), true) => binary::images(source()).map(|images| images.len()),
        (Some("images"), false) => text::images(path, &text()?).map(|images| images.len()),
        (_, true) => binary::points(source()).map(|points| points.len()),
        (_, false) => text::points(path, &text()?).map(|points| points.len()),
    }
}

fn is_binary(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "bin")
}

fn open(path: &Path) -> Result<binary::Source<'_, BufReader<std::fs::File>>> {
    let file = files::open(path, BINARY)?;
    let length = file.metadata().map_err(|e| Error::io(path, e, "reading the file"))?.len();
    Ok(binary::Source::new(path, BufReader::new(file), length))
}

/// Reads the cameras of a reconstruction, if there are any.
pub(super) fn cameras_in(folder: &Path) -> Result<Cameras> {
    file(folder, "cameras").map_or(Ok(Cameras::new()), |path| cameras(&path))
}

/// Reads the points beside cameras, if there are any.
pub(super) fn points_in(folder: &Path) -> Result<Vec<Point>> {
    file(folder, "points3D").map_or(Ok(Vec::new()), |path| points(&path))
}

/// Reads the capture in the folder `root`, whose reconstruction is in `model`.
pub(super) fn read(root: &Path, model: &Path, downscale: usize) -> Result<Capture> {
    let missing =
        |name: &str| Error::input(model, format!("there is no {name}.bin and no {name}.txt"), "copy all files of the reconstruction");
    let [cameras_file, images_file] = ["cameras", "images"].map(|name| file(model, name).ok_or_else(|| missing(name)));
    let (cameras_file, images_file) = (cameras_file?, images_file?);
    let format = if is_binary(&images_file) { "COLMAP (binary)" } else { "COLMAP (text)" };
    let (cameras, images) = (cameras(&cameras_file)?, images(&images_file)?);
    let mut capture = Capture { format, points: points_in(model)?, ..Capture::default() };
    let Some(folder) = ImageFolder::find(root, &IMAGES, downscale) else {
        let remedy = "copy the images to a folder `images` beside the reconstruction";
        return Err(Error::input(root, "there is no folder of images", remedy));
    };
    capture.reduced = folder.reduced;
    let ranked = ranked(&folder, &images)?;
    for image in images {
        let Some(intrinsics) = cameras.get(&image.camera).copied() else {
            let found = format!("the image {} has camera {}, which {} does not list", image.name, image.camera, cameras_file.display());
            return Err(Error::input(images_file, found, "use cameras and images of one reconstruction"));
        };
        let Some(path) = ranked.get(&image.name).cloned().or_else(|| folder.image(&image.name)) else {
            capture.missing.push(image.name);
            continue;
        };
        let camera_to_world = image.camera_to_world;
        capture.photos.push(Photo { name: image.name, image: path, mask: None, intrinsics, camera_to_world, split: None });
    }
    let unused = folder.sorted()?.len().saturating_sub(capture.photos.len());
    if unused > 0 {
        capture.notes.push(format!("{unused} images of {} have no camera", folder.path.display()));
    }
    Ok(capture)
}

/// Returns the path of each image by its rank, if the names in the folder are others: LLFF numbers the images that it reduces.
fn ranked(folder: &ImageFolder, images: &[Image]) -> Result<BTreeMap<String, PathBuf>> {
    let there = folder.sorted()?;
    if there.len() != images.len() || images.iter().any(|image| folder.image(&image.name).is_some()) {
        return Ok(BTreeMap::new());
    }
    let mut names: Vec<&String> = images.iter().map(|image| &image.name).collect();
    names.sort();
    Ok(names.into_iter().cloned().zip(there.iter().map(|name| folder.path.join(name))).collect())
}

/// Builds the intrinsics of a camera.
fn camera(path: &Path, id: u32, model: Model, size: [u64; 2], parameters: &[f64]) -> Result<Intrinsics> {
    if size.iter().any(|side| !(1..=LARGEST).contains(side)) {
        let found = format!("camera {id} has images of {} x {} pixels", size[0], size[1]);
        return Err(Error::input(path, found, format!("expected sizes of 1 to {LARGEST}")));
    }
    let size = (size[0] as usize, size[1] as usize);
    Intrinsics::from_colmap(model, size, parameters).map_err(|unusable| unusable.at(path, &format!("camera {id}")))
}

/// Builds an image from a world-to-camera rotation (w, x, y, z) and translation.
fn image(path: &Path, name: &str, camera: u32, [w, x, y, z]: [f64; 4], t: [f64; 3]) -> Result<Image> {
    let refused = |found: String, remedy: &str| Err(Error::input(path, format!("the image {name} {found}"), remedy));
    if name.is_empty() || base_name(name).is_empty() {
        return Err(Error::input(path, "an image has no name", "use undamaged files"));
    }
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    let is_unit = (quaternion.length() - 1.0).abs() < 1e-3;
    if !is_unit {
        return refused(format!("has the rotation ({w}, {x}, {y}, {z})"), "expected a quaternion of length 1");
    }
    let rotation = DMat3::from_quat(quaternion.normalize()).transpose();
    let center = -(rotation * DVec3::from_array(t));
    if !center.is_finite() || center.abs().max_element() > FARTHEST {
        return refused(format!("has the translation {t:?}"), "expected finite coordinates of up to 1e12");
    }
    let camera_to_world = from_opencv(DAffine3 { matrix3: rotation, translation: center });
    Ok(Image { name: plain(name), camera, camera_to_world })
}
