//! NSVF: `intrinsics.txt`, a folder of poses and a folder of images (Liu et al. 2020), as of the Tanks and Temples scenes.
//!
//! `intrinsics.txt` has a 4 x 4 matrix, or a first line of focal length, cx and cy. `pose` or `poses` has a 4 x 4 camera-to-world matrix
//! with OpenCV axes for each image of `rgb`, `image` or `images` with the same name. A name begins with `0_` in the training split, `1_`
//! in the validation split and `2_` in the test split; without names of `2_`, those of `1_` are for testing.

use super::blender::rigid;
use super::capture::{Capture, FARTHEST, ImageFolder, Photo, from_opencv};
use super::{Split, image};
use crate::camera::Intrinsics;
use crate::error::{Error, Result};
use crate::files::{self, Kind};
use glam::DAffine3;
use std::path::{Path, PathBuf};

/// Name of the file of the intrinsics.
pub const FILE: &str = "intrinsics.txt";
/// The recognized format, as text for people.
const FORMAT: &str = "NSVF (intrinsics.txt)";
/// A matrix as text.
const MATRIX: Kind = Kind { name: "a text file of a matrix", most: 1 << 16, memory: 4 };
const POSES: [&str; 2] = ["pose", "poses"];
const IMAGES: [&str; 3] = ["rgb", "image", "images"];

/// Focal lengths and principal point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Focal {
    f: [f64; 2],
    c: [f64; 2],
}

/// Returns the folder of the poses below `root`.
pub(super) fn poses(root: &Path) -> Option<PathBuf> {
    POSES.iter().map(|name| root.join(name)).find(|path| path.is_dir())
}

fn rows(path: &Path, bytes: &[u8]) -> Result<Vec<Vec<f64>>> {
    let text = files::text(path, bytes)?;
    let number = |word: &str, line: usize| match word.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(Error::input(path, format!("line {line} has \"{word}\""), "expected finite numbers")),
    };
    let lines = text.lines().zip(1..).filter(|(line, _)| !line.trim().is_empty());
    lines.map(|(line, k)| line.split_whitespace().map(|word| number(word, k)).collect()).collect()
}

/// Parses an intrinsics.txt. `path` names it in error messages.
pub fn intrinsics(path: &Path, bytes: &[u8]) -> Result<Focal> {
    let rows = rows(path, bytes)?;
    let is_matrix = (3..=4).contains(&rows.len()) && rows.iter().all(|row| row.len() == rows[0].len() && row.len() >= 3);
    let focal = match (is_matrix, rows.first().map(Vec::as_slice)) {
        (true, _) => Some(Focal { f: [rows[0][0], rows[1][1]], c: [rows[0][2], rows[1][2]] }),
        (false, Some(&[f, cx, cy, ..])) => Some(Focal { f: [f, f], c: [cx, cy] }),
        _ => None,
    };
    focal.filter(|focal| focal.f.iter().all(|f| *f > 0.0)).ok_or_else(|| {
        let remedy = "expected a 4 x 4 matrix with positive focal lengths, or a first line with focal length, cx and cy";
        Error::input(path, "this is no matrix of intrinsics", remedy)
    })
}

/// Parses a file of a pose. `path` names it in error messages. The result has OpenGL axes.
pub fn pose(path: &Path, bytes: &[u8]) -> Result<DAffine3> {
    let rows = rows(path, bytes)?;
    let row = |i: usize| rows.get(i).and_then(|row| <[f64; 4]>::try_from(row.as_slice()).ok());
    let matrix = match (rows.len(), row(0), row(1), row(2)) {
        (4, Some(a), Some(b), Some(c)) => row(3).map(|d| [a, b, c, d]),
        (3, Some(a), Some(b), Some(c)) => Some([a, b, c, [0.0, 0.0, 0.0, 1.0]]),
        _ => None,
    };
    let matrix = matrix.ok_or_else(|| Error::input(path, "this is no 4 x 4 matrix", "expected 4 rows of 4 numbers"))?;
    let pose = rigid(matrix).map_err(|(found, remedy)| Error::input(path, format!("the matrix {found}"), remedy))?;
    if pose.translation.abs().max_element() > FARTHEST {
        let found = format!("the camera is at {:?}", pose.translation.to_array());
        return Err(Error::input(path, found, "expected coordinates of up to 1e12"));
    }
    Ok(from_opencv(pose))
}

/// Reads the capture in the folder `root`, whose poses are in `folder`.
pub(super) fn read(root: &Path, folder: &Path) -> Result<Capture> {
    let path = root.join(FILE);
    let Focal { f, c } = intrinsics(&path, &files::read(&path, MATRIX)?)?;
    let Some(images) = ImageFolder::find(root, &IMAGES, 1) else {
        return Err(Error::input(root, "there is no folder of images", "copy the images to a folder `rgb`"));
    };
    let mut capture = Capture { format: FORMAT, reduced: 1, ..Capture::default() };
    let entries = std::fs::read_dir(folder).map_err(|source| Error::io(folder, source, "listing the folder"))?;
    let mut names: Vec<String> = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.retain(|name| name.ends_with(".txt") && !name.starts_with('.'));
    names.sort();
    let stem = |name: &String| name.trim_end_matches(".txt").to_owned();
    let begins = |prefix: &str| names.iter().any(|name| name.starts_with(prefix));
    let (has_splits, has_test) = (names.iter().all(|name| prefix(name).is_some()) && begins("0_"), begins("2_"));
    for name in &names {
        let pose_file = folder.join(name);
        let camera_to_world = pose(&pose_file, &files::read(&pose_file, MATRIX)?)?;
        let Some(image) = images.image(&format!("{}.png", stem(name))) else {
            capture.missing.push(stem(name));
            continue;
        };
        let (width, height) = image::size(&image)?;
        let intrinsics = Intrinsics { fx: f[0], fy: f[1], cx: c[0], cy: c[1], ..Intrinsics::centred(width, height, f[0]) };
        let split = prefix(name).filter(|_| has_splits).map(|split| if has_test || split == Split::Train { split } else { Split::Test });
        capture.photos.push(Photo { name: stem(name), image, mask: None, intrinsics, camera_to_world, split });
    }
    let unused = images.sorted()?.len().saturating_sub(capture.photos.len());
    if unused > 0 {
        capture.notes.push(format!("{unused} images of {} have no camera", images.path.display()));
    }
    Ok(capture)
}

/// Returns the split of a name by its beginning.
fn prefix(name: &str) -> Option<Split> {
    let split = Split::ALL.into_iter().find(|split| name.starts_with(&format!("{}_", *split as usize)));
    split.filter(|_| name.len() > 2)
}
