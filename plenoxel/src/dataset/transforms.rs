//! `transforms.json` of instant-ngp and nerfstudio: all views of a capture in one file.
//!
//! Poses are camera-to-world with OpenGL axes. Intrinsics are those of the frame, else those of the file: `w`, `h`; `fl_x`, `fl_y`, or
//! `x_fov`, `y_fov` in degrees, or `camera_angle_x`, `camera_angle_y` in radians (y as x if missing); `cx`, `cy` (the centre if missing);
//! `camera_model` or `is_fisheye`, and `k1` to `k4`, `p1`, `p2`. Splits are those of `train_filenames`, `val_filenames` and
//! `test_filenames`. Points are those of `ply_file_path`. `aabb_scale`, `applied_transform` and other keys are ignored: the frame of a
//! capture is that of its poses.

mod intrinsics;

use super::blender::pose;
use super::capture::{Capture, FARTHEST, ImageFolder, Photo, Point, plain, with_any_extension};
use super::{Split, image};
use crate::camera::Intrinsics;
use crate::error::{Error, Result};
use crate::files;
use crate::json::{self, Kept};
use crate::point_cloud::ply::PlyFile;
use crate::text::listed;
use glam::DAffine3;
pub use intrinsics::Stated;
use serde_json::Value;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Name of the file.
pub const FILE: &str = "transforms.json";
/// The recognized format, as text for people.
const FORMAT: &str = "instant-ngp or nerfstudio (transforms.json)";
/// Content of the file that is kept.
const KEPT: Kept =
    Kept { keys: |key| KEYS.contains(&key) || LISTS.contains(&key) || intrinsics::is_known(key), entries: usize::MAX, share: 75 };
const KEYS: [&str; 5] = ["frames", "file_path", "mask_path", "transform_matrix", "ply_file_path"];
/// Keys of the splits, in the order of [`Split::ALL`].
const LISTS: [&str; 3] = ["train_filenames", "val_filenames", "test_filenames"];
/// Longest accepted path, which is the limit of common systems.
const LONGEST_PATH: usize = 4096;

/// Validated content of a transforms.json.
#[derive(Debug, Clone, PartialEq)]
pub struct Transforms {
    /// The views.
    pub frames: Vec<Listed>,
    /// Names of the images of each split, if there are any, as plain paths.
    splits: [Vec<String>; 3],
    /// Path of a point cloud.
    points: Option<String>,
}

/// A view of a transforms.json.
#[derive(Debug, Clone, PartialEq)]
pub struct Listed {
    /// Path of the image, plain.
    pub file_path: String,
    /// Path of the mask, plain.
    pub mask_path: Option<String>,
    /// Intrinsics.
    pub stated: Stated,
    /// Camera-to-world transform.
    pub camera_to_world: DAffine3,
}

impl Transforms {
    /// Parses a transforms.json. `path` names it in error messages.
    ///
    /// Errors if the JSON, intrinsics or a matrix is invalid, naming the frame.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let bad = |found: String, remedy: &str| Error::input(path, found, remedy);
        let json = json::parse(path, bytes, &KEPT)?;
        let Some(frames) = json.get("frames").and_then(Value::as_array) else {
            return Err(bad("there is no list \"frames\"".into(), "list the views, each with file_path and transform_matrix"));
        };
        let name = |value: &Value, key: &str, place: &str| match value.as_str() {
            Some(text) if (1..=LONGEST_PATH).contains(&text.len()) => Ok(plain(text)),
            _ => Err(bad(format!("{key}{place} is {}", json::shown(value)), "name a file")),
        };
        let frame = |(k, frame): (usize, &Value)| {
            let place = format!(" of frame {k}");
            let Some(file_path) = frame.get("file_path") else {
                return Err(bad(format!("frame {k} has no key \"file_path\""), "name the image"));
            };
            let Some(matrix) = frame.get("transform_matrix") else {
                return Err(bad(format!("frame {k} has no key \"transform_matrix\""), "give the 4 x 4 camera-to-world matrix"));
            };
            let camera_to_world = pose(matrix).map_err(|(found, remedy)| bad(format!("transform_matrix{place} {found}"), remedy))?;
            if camera_to_world.translation.abs().max_element() > FARTHEST {
                let found = format!("transform_matrix{place} puts the camera at {:?}", camera_to_world.translation.to_array());
                return Err(bad(found, "expected coordinates of up to 1e12"));
            }
            Ok(Listed {
                file_path: name(file_path, "file_path", &place)?,
                mask_path: present(frame, "mask_path").map(|mask| name(mask, "mask_path", &place)).transpose()?,
                stated: Stated::of(path, &json, frame, k)?,
                camera_to_world,
            })
        };
        let list = |key: &str| match present(&json, key).map(|list| list.as_array().ok_or(list)) {
            None => Ok(Vec::new()),
            Some(Ok(list)) => list.iter().map(|value| name(value, "an entry of ", key)).collect(),
            Some(Err(other)) => Err(bad(format!("{key} is {}", json::shown(other)), "list the paths of its images")),
        };
        Ok(Transforms {
            frames: frames.iter().enumerate().map(frame).collect::<Result<_>>()?,
            splits: [list(LISTS[0])?, list(LISTS[1])?, list(LISTS[2])?],
            points: present(&json, "ply_file_path").map(|path| name(path, "ply_file_path", "")).transpose()?,
        })
    }

    /// Returns the split of each path; `None` if the file has no splits.
    fn split_of(&self) -> Option<HashMap<&str, Split>> {
        let pairs = Split::ALL.iter().zip(&self.splits).flat_map(|(split, names)| names.iter().map(|name| (name.as_str(), *split)));
        let map: HashMap<&str, Split> = pairs.collect();
        (!map.is_empty()).then_some(map)
    }
}

/// Returns the value of a key, if it is there and not null.
fn present<'v>(value: &'v Value, key: &str) -> Option<&'v Value> {
    value.get(key).filter(|value| !value.is_null())
}

/// Reads the capture in the folder `root`; images are looked for where the reduction by `downscale` is.
pub(super) fn read(root: &Path, downscale: usize) -> Result<Capture> {
    let path = root.join(FILE);
    let transforms = Transforms::parse(&path, &files::read(&path, files::CAMERAS)?)?;
    let mut capture = Capture { format: FORMAT, reduced: 1, ..Capture::default() };
    // A reduced image cannot tell the size to which intrinsics without w and h belong.
    let sized = transforms.frames.iter().all(|frame| frame.stated.size.is_some());
    let folder = sized.then(|| ImageFolder::find(root, &["images"], downscale)).flatten();
    capture.reduced = folder.as_ref().map_or(1, |folder| folder.reduced);
    let splits = transforms.split_of();
    let mut unlisted = Vec::new();
    for frame in &transforms.frames {
        let split = splits.as_ref().map(|splits| splits.get(frame.file_path.as_str()).copied());
        if split == Some(None) {
            unlisted.push(frame.file_path.clone());
            continue;
        }
        let Some(image) = find(root, folder.as_ref(), &frame.file_path) else {
            capture.missing.push(frame.file_path.clone());
            continue;
        };
        let size = frame.stated.size.map_or_else(|| image::size(&image), Ok)?;
        capture.photos.push(Photo {
            intrinsics: frame.stated.intrinsics(&path, &frame.file_path, size)?,
            name: frame.file_path.clone(),
            image,
            mask: frame.mask_path.as_ref().map(|mask| root.join(mask)),
            camera_to_world: frame.camera_to_world,
            split: split.flatten(),
        });
    }
    if !unlisted.is_empty() {
        let names = listed(&unlisted);
        capture.notes.push(format!("left out {} views that are in no list of a split: {names}", unlisted.len()));
    }
    if let Some(name) = &transforms.points {
        match files::is_there(&root.join(name)) {
            true => capture.points = points(&root.join(name))?,
            false => capture.notes.push(format!("the points {name} do not exist")),
        }
    }
    Ok(capture)
}

/// Returns the image of a path: in the reduced folder if it is one, else as written.
fn find(root: &Path, folder: Option<&ImageFolder>, file_path: &str) -> Option<PathBuf> {
    match (folder, file_path.strip_prefix("images/")) {
        (Some(folder), Some(name)) => folder.image(name),
        _ => with_any_extension(&root.join(file_path)),
    }
}

/// Reads the points of a PLY file.
fn points(path: &Path) -> Result<Vec<Point>> {
    let file = PlyFile::open(path)?;
    let positions = file.positions()?;
    let channel = |name: &str| file.values(name).ok();
    let colors = [channel("red"), channel("green"), channel("blue")];
    let color = |i: usize| colors.each_ref().map(|values| values.as_ref().map_or(128, |values| values[i] as u8));
    let all = positions.into_iter().enumerate().map(|(i, position)| Point { position, color: color(i) });
    Ok(all.filter(|point| point.position.is_finite()).collect())
}

impl Stated {
    /// Returns the intrinsics for images of a size, which is the stated one if there is one.
    pub(super) fn intrinsics(&self, path: &Path, file_path: &str, size: (usize, usize)) -> Result<Intrinsics> {
        let intrinsics = self.at(size);
        if let Some(found) = self.conflict(&intrinsics) {
            let remedy = "give w and h of the images from which the cameras were computed, or leave camera_angle_x out";
            return Err(Error::input(path, format!("for {file_path}, {found}"), remedy));
        }
        intrinsics.check_lens().map_err(|unusable| unusable.at(path, &format!("camera of {file_path}")))?;
        Ok(intrinsics)
    }
}
