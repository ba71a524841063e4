//! NeRF-synthetic folders: `transforms_{train,val,test}.json` and the images they list (Mildenhall et al. 2020).
//!
//! A file has `camera_angle_x`, the horizontal field of view in radians, and `frames`, each with a `file_path` without extension and a 4 x
//! 4 camera-to-world `transform_matrix` with OpenGL axes; world z is up. Only listed images are views: the depth and normal images in the
//! test folder of the original scenes are not. The files may state other intrinsics, lenses and masks, by the keys of
//! [`transforms.json`](super::transforms).

mod write;

use super::capture::{base_name, misfit, resized};
use super::image::Orientation;
use super::mask::Mask;
use super::normalize::Normalization;
use super::transforms::{Listed, Transforms};
use super::{Dataset, Frame, OpenOptions, Source, Split, image, largest};
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::files;
use crate::json;
use glam::{DAffine3, DMat3, DMat4};
use rayon::prelude::*;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
pub(super) use write::write;

/// Largest accepted entry of RᵀR - 1. Files written in single precision stay below 1e-6; a scaled or sheared matrix does not.
const ORTHONORMAL_WITHIN: f64 = 1e-3;

/// Name of the format.
pub const FORMAT: &str = "NeRF-synthetic (transforms_train.json)";

/// Opens the NeRF-synthetic folder `root`. The training file must exist and list frames. Without a validation or test file, these splits
/// are empty.
///
/// Errors if the JSON, a matrix or an image's header is invalid, naming file and frame.
pub fn open(root: &Path, options: &OpenOptions) -> Result<Dataset> {
    let downscale = options.downscale;
    let mut splits = [Vec::new(), Vec::new(), Vec::new()];
    let has_val = files::is_there(&file_name(root, Split::Val));
    for split in Split::ALL {
        let path = file_name(root, split);
        if split == Split::Train || files::is_there(&path) {
            let transforms = Transforms::parse(&path, &files::read(&path, files::CAMERAS)?)?;
            let frames: Vec<Result<Frame>> =
                transforms.frames.par_iter().enumerate().map(|(k, listed)| frame(root, split, k, listed, downscale)).collect();
            // The first error in the order of the file is reported.
            splits[split as usize] = frames.into_iter().collect::<Result<Vec<_>>>()?;
        }
    }
    if splits[0].is_empty() {
        return Err(Error::input(file_name(root, Split::Train), "frames is empty", "list at least one training view"));
    }
    if let (Some(every), false) = (options.validation_every, has_val) {
        let (held, kept) =
            std::mem::take(&mut splits[0]).into_iter().enumerate().partition::<Vec<_>, _>(|(k, _)| (k + 1).is_multiple_of(every));
        splits[0] = kept.into_iter().map(|(_, frame)| frame).collect();
        splits[1] = held.into_iter().map(|(_, frame)| frame).collect();
    }
    Ok(Dataset {
        name: super::scene_name(root),
        format: FORMAT,
        size: largest(&splits),
        frames: splits,
        source: Source::Files { downscale },
        normalization: Normalization::none(options, "this is a NeRF-synthetic folder")?,
        points: Arc::default(),
        notes: Vec::new(),
    })
}

fn file_name(root: &Path, split: Split) -> PathBuf {
    root.join(format!("transforms_{split}.json"))
}

/// Returns view `k` of a file of the scene `root`, with its image.
///
/// Errors if the image does not exist or cannot be read, or has another shape than its camera, or if its mask has another size.
fn frame(root: &Path, split: Split, k: usize, listed: &Listed, downscale: usize) -> Result<Frame> {
    let path = file_name(root, split);
    let image = find_image(root, split, &listed.file_path).map_err(|tried| {
        let tried: Vec<String> = tried.iter().map(|path| path.display().to_string()).collect();
        let found = format!("the image \"{}\" of frame {k} does not exist", listed.file_path);
        Error::input(&path, found, format!("looked for {}", tried.join(" and ")))
    })?;
    let full = image::size(&image)?;
    let stated = listed.stated.intrinsics(&path, &listed.file_path, listed.stated.size.unwrap_or(full))?;
    let intrinsics = resized(&image, &stated, full)?.ok_or_else(|| misfit(&image, (stated.width, stated.height), full))?;
    image::check_downscale(downscale, full)?;
    let mask = listed.mask_path.as_ref().map(|mask| mask_of(root, mask, &path, k)).transpose()?;
    mask.iter().try_for_each(|mask| Mask::check_file(mask, full))?;
    Ok(Frame {
        name: image.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default(),
        camera: Camera { intrinsics: intrinsics.downscaled(downscale), camera_to_world: listed.camera_to_world },
        path: image,
        mask,
        orientation: Orientation::Stated,
        full,
    })
}

/// Returns the path of the mask of frame `k`.
///
/// Errors if it does not exist.
fn mask_of(root: &Path, name: &str, path: &Path, k: usize) -> Result<PathBuf> {
    let mask = root.join(name);
    if files::is_there(&mask) {
        return Ok(mask);
    }
    Err(Error::input(path, format!("the mask \"{name}\" of frame {k} does not exist"), format!("looked for {}", mask.display())))
}

/// Returns the image of a `file_path`: relative to the scene as written, or its last part in the split's folder. `.png` is appended unless
/// present. If there is no such image, returns the paths that were tried.
fn find_image(root: &Path, split: Split, file_path: &str) -> std::result::Result<PathBuf, Vec<PathBuf>> {
    let base = base_name(file_path);
    let folder = root.join(split.to_string());
    let mut tried = vec![root.join(file_path), folder.join(base)];
    if !file_path.to_ascii_lowercase().ends_with(".png") {
        for path in &mut tried {
            path.as_mut_os_string().push(".png");
        }
    }
    tried.dedup();
    // An image with another extension has it in the list.
    let as_written = root.join(file_path);
    let all = || tried.iter().chain([&as_written]);
    // Existing paths that are not files come last, so that the message can say what they are.
    let found = all().find(|path| path.is_file()).or_else(|| all().find(|path| files::is_there(path))).cloned();
    found.ok_or(tried)
}

/// Validates and converts a 4 x 4 camera-to-world matrix. An error completes the sentence "transform_matrix of frame k ...".
pub(crate) fn pose(matrix: &Value) -> std::result::Result<DAffine3, (String, &'static str)> {
    const SHAPE: &str = "expected a list of 4 rows of 4 numbers";
    let mut m = [[0.0; 4]; 4];
    let rows = matrix.as_array().ok_or_else(|| ("is not a list of rows".to_owned(), SHAPE))?;
    if rows.len() != 4 {
        return Err((format!("has {} rows", rows.len()), SHAPE));
    }
    for (i, row) in rows.iter().enumerate() {
        let row = row.as_array().ok_or_else(|| (format!("has a row {i} that is not a list"), SHAPE))?;
        if row.len() != 4 {
            return Err((format!("has {} numbers in row {i}", row.len()), SHAPE));
        }
        for (j, value) in row.iter().enumerate() {
            let number = value.as_f64().filter(|number| number.is_finite());
            m[i][j] = number.ok_or_else(|| (format!("has {} in row {i}, column {j}", json::shown(value)), "expected finite numbers"))?;
        }
    }
    rigid(m)
}

/// Validates and converts the rows of a camera-to-world matrix, which must be finite.
///
/// Errors: the matrix is not a rotation and a translation. The problem completes the sentence "the matrix of camera k ...", and the remedy follows it.
pub fn rigid(m: [[f64; 4]; 4]) -> std::result::Result<DAffine3, (String, &'static str)> {
    if m[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-6) {
        return Err((format!("has the last row {:?}", m[3]), "expected a rigid motion, whose last row is 0 0 0 1"));
    }
    let matrix = DMat4::from_cols_array_2d(&m).transpose();
    let rotation = DMat3::from_mat4(matrix);
    let error = rotation.transpose() * rotation - DMat3::IDENTITY;
    let worst = error.to_cols_array().into_iter().fold(0.0, |worst: f64, value| worst.max(value.abs()));
    // A huge entry overflows to infinity on the diagonal of RᵀR, so no NaN can hide the others.
    if worst > ORTHONORMAL_WITHIN {
        return Err((format!("is not a rotation: RᵀR differs from 1 by {worst:.1e}"), "remove scale and shear"));
    }
    if rotation.determinant() < 0.0 {
        return Err(("is a reflection: its determinant is -1".into(), "use OpenGL axes: x right, y up, z backwards"));
    }
    Ok(DAffine3::from_mat4(matrix))
}

#[cfg(test)]
mod tests {
    use super::write::rows;
    use super::*;
    use crate::camera::Intrinsics;
    use glam::DVec3;
    use serde_json::json;

    #[test]
    fn a_pose_survives_being_written_and_read() {
        let camera = Camera::look_at(DVec3::new(1.0, -3.0, 2.0), DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(4, 4, 0.7));
        assert_eq!(pose(&json!(rows(&camera.camera_to_world))).unwrap(), camera.camera_to_world);
    }

    #[test]
    fn matrices_that_are_not_rigid_motions_are_refused_with_the_reason() {
        let refused = |matrix: Value| pose(&matrix).unwrap_err().0;
        assert_eq!(refused(json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])), "has 3 rows");
        assert_eq!(refused(json!([[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]])), "has 3 numbers in row 1");
        assert_eq!(refused(json!([[1, 0, 0, 0], [0, 1, 0, null], [0, 0, 1, 0], [0, 0, 0, 1]])), "has null in row 1, column 3");
        assert!(refused(json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.5, 1]])).starts_with("has the last row"));
        assert!(refused(json!([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])).contains("RᵀR differs from 1 by 3.0e0"));
        assert!(refused(json!([[1e300, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])).contains("not a rotation"));
        assert!(refused(json!([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])).contains("reflection"));
        assert!(pose(&json!([[1, 0, 1e-5, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])).is_ok());
    }
}
