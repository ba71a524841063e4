//! NeRF-synthetic folders: `transforms_{train,val,test}.json` and the images they list (Mildenhall et al. 2020).
//!
//! A file has `camera_angle_x`, the horizontal field of view in radians, and `frames`, each with a `file_path` without extension and a 4 x
//! 4 camera-to-world `transform_matrix` with OpenGL axes; world z is up. Only listed images are views: the depth and normal images in the
//! test folder of the original scenes are not. Further intrinsics must agree with `camera_angle_x` and with the size of the images. Other
//! keys are ignored.

mod intrinsics;
mod write;

use super::capture::FARTHEST;
use super::normalize::Normalization;
use super::{Dataset, Frame, OpenOptions, Source, Split, image};
use crate::camera::{Camera, Intrinsics, is_angle_of_view};
use crate::error::{Error, Result};
use crate::files;
use crate::json::{self, Kept};
use glam::{DAffine3, DMat3, DMat4};
pub use intrinsics::StatedIntrinsics;
use intrinsics::is_known;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
pub(super) use write::write;

/// Largest accepted entry of RᵀR - 1. Files written in single precision stay below 1e-6; a scaled or sheared matrix does not.
const ORTHONORMAL_WITHIN: f64 = 1e-3;
/// Content of a file that is kept. The list of views is made from it and needs memory too.
const KEPT: Kept = Kept { keys: |key| is_known(key) || KEYS.contains(&key), entries: usize::MAX, share: 75 };
const KEYS: [&str; 3] = ["frames", "file_path", "transform_matrix"];
/// Longest accepted path, which is the limit of common systems.
const LONGEST_PATH: usize = 4096;

/// Name of the format.
pub const FORMAT: &str = "NeRF-synthetic (transforms_train.json)";

/// Opens the NeRF-synthetic folder `root`. The training file must exist and list frames. Without a validation or test file, these splits
/// are empty.
///
/// Errors if the JSON, a matrix or an image's header is invalid, naming file and frame.
pub fn open(root: &Path, options: &OpenOptions) -> Result<Dataset> {
    let mut splits = [Vec::new(), Vec::new(), Vec::new()];
    let mut stated = Vec::new();
    let has_val = files::is_there(&file_name(root, Split::Val));
    for split in Split::ALL {
        let path = file_name(root, split);
        if split == Split::Train || files::is_there(&path) {
            let transforms = Transforms::parse(&path, &files::read(&path, files::CAMERAS)?)?;
            splits[split as usize] = transforms.listed(root, split)?;
            stated.push((path, transforms));
        }
    }
    if splits[0].is_empty() {
        return Err(Error::input(file_name(root, Split::Train), "frames is empty", "list at least one training view"));
    }
    let size = common_size(splits.iter().flatten())?;
    stated.iter().try_for_each(|(path, transforms)| transforms.intrinsics.check(path, transforms.fov_x, size))?;
    image::check_downscale(options.downscale, size)?;

    if let (Some(every), false) = (options.validation_every, has_val) {
        let (held, kept) =
            std::mem::take(&mut splits[0]).into_iter().enumerate().partition::<Vec<_>, _>(|(k, _)| (k + 1).is_multiple_of(every));
        splits[0] = kept.into_iter().map(|(_, listed)| listed).collect();
        splits[1] = held.into_iter().map(|(_, listed)| listed).collect();
    }
    let frame = |listed: Listed| {
        let intrinsics = Intrinsics::from_fov_x(size.0, size.1, listed.fov_x).downscaled(options.downscale);
        let camera = Camera { intrinsics, camera_to_world: listed.camera_to_world };
        Frame { name: listed.name, camera, path: listed.image, mask: None, orientation: image::Orientation::Stated, full: size }
    };
    let frames = splits.map(|listed| listed.into_iter().map(frame).collect());
    Ok(Dataset {
        name: super::scene_name(root),
        format: FORMAT,
        size: (size.0 / options.downscale, size.1 / options.downscale),
        frames,
        source: Source::Files { downscale: options.downscale },
        normalization: Normalization::none(options)?,
        points: Arc::default(),
        notes: Vec::new(),
    })
}

/// Entry of `frames`, with its image.
struct Listed {
    name: String,
    image: PathBuf,
    fov_x: f64,
    camera_to_world: DAffine3,
}

/// Validated content of a transforms file.
#[derive(Clone, Debug, PartialEq)]
pub struct Transforms {
    /// Horizontal field of view, radians.
    pub fov_x: f64,
    /// Views: `file_path` as written, and the camera-to-world transform.
    pub frames: Vec<(String, DAffine3)>,
    /// Further intrinsics of the file.
    pub intrinsics: StatedIntrinsics,
}

fn file_name(root: &Path, split: Split) -> PathBuf {
    root.join(format!("transforms_{split}.json"))
}

impl Transforms {
    /// Returns the views with the images of the scene `root`.
    ///
    /// Errors if an image does not exist.
    fn listed(&self, root: &Path, split: Split) -> Result<Vec<Listed>> {
        let listed = self.frames.iter().enumerate().map(|(k, (text, camera_to_world))| {
            let image = find_image(root, split, text).map_err(|tried| {
                let tried: Vec<String> = tried.iter().map(|path| path.display().to_string()).collect();
                let found = format!("the image \"{text}\" of frame {k} does not exist");
                Error::input(file_name(root, split), found, format!("looked for {}", tried.join(" and ")))
            })?;
            let name = image.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
            Ok(Listed { name, image, fov_x: self.fov_x, camera_to_world: *camera_to_world })
        });
        listed.collect()
    }

    /// Parses a transforms file. `path` names it in error messages.
    ///
    /// Errors if the JSON or a matrix is invalid, naming the frame.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let bad = |found: String, remedy: &str| Error::input(path, found, remedy);
        let json = json::parse(path, bytes, &KEPT)?;
        let Some(angle) = json.get("camera_angle_x") else {
            let found = "there is no key \"camera_angle_x\"";
            return Err(match json.get("fl_x") {
                Some(focal) => bad(
                    format!("{found}, but fl_x is {}", json::shown(focal)),
                    "focal lengths in pixels are not supported yet: give camera_angle_x = 2 atan(w / (2 fl_x)), in radians",
                ),
                None => bad(found.into(), "give the horizontal field of view in radians"),
            });
        };
        let Some(fov_x) = angle.as_f64().filter(|angle| is_angle_of_view(*angle)) else {
            return Err(bad(format!("camera_angle_x is {}", json::shown(angle)), "expected a number of radians between 0 and pi"));
        };
        let Some(frames) = json.get("frames") else {
            return Err(bad("there is no key \"frames\"".into(), "list the views, each with file_path and transform_matrix"));
        };
        let Some(frames) = frames.as_array() else {
            return Err(bad("frames is not a list".into(), "list the views, each with file_path and transform_matrix"));
        };
        let mut intrinsics = StatedIntrinsics::default();
        intrinsics.add(path, &json, None)?;
        let frame = |(k, frame): (usize, &Value)| {
            intrinsics.add(path, frame, Some(k))?;
            let Some(text) = frame.get("file_path") else {
                return Err(bad(format!("frame {k} has no key \"file_path\""), "name the image, without extension"));
            };
            let Some(file_path) = text.as_str().filter(|text| (1..=LONGEST_PATH).contains(&text.len())) else {
                return Err(bad(format!("file_path of frame {k} is {}", json::shown(text)), "name the image, without extension"));
            };
            let Some(matrix) = frame.get("transform_matrix") else {
                return Err(bad(format!("frame {k} has no key \"transform_matrix\""), "give the 4 x 4 camera-to-world matrix"));
            };
            let pose = pose(matrix).map_err(|(found, remedy)| bad(format!("transform_matrix of frame {k} {found}"), remedy))?;
            if pose.translation.abs().max_element() > FARTHEST {
                let found = format!("transform_matrix of frame {k} puts the camera at {:?}", pose.translation.to_array());
                return Err(bad(found, "expected coordinates of up to 1e12"));
            }
            Ok((file_path.to_owned(), pose))
        };
        let frames = frames.iter().enumerate().map(frame).collect::<Result<_>>()?;
        Ok(Transforms { fov_x, frames, intrinsics })
    }
}

/// Returns the image of a `file_path`: relative to the scene as written, or its last part in the split's folder. `.png` is appended unless
/// present. If there is no such image, returns the paths that were tried.
fn find_image(root: &Path, split: Split, file_path: &str) -> std::result::Result<PathBuf, Vec<PathBuf>> {
    let file_path = file_path.replace('\\', "/");
    let base = file_path.rsplit('/').next().unwrap_or(&file_path);
    let folder = root.join(split.to_string());
    let mut tried = vec![root.join(file_path.trim_start_matches("./")), folder.join(base)];
    if !file_path.to_ascii_lowercase().ends_with(".png") {
        for path in &mut tried {
            path.as_mut_os_string().push(".png");
        }
    }
    tried.dedup();
    // An image with another extension has it in the list.
    let as_written = root.join(file_path.trim_start_matches("./"));
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

/// Validates and converts the rows of a camera-to-world matrix, which must be finite. An error completes the sentence of [`pose`].
pub(crate) fn rigid(m: [[f64; 4]; 4]) -> std::result::Result<DAffine3, (String, &'static str)> {
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

/// Returns the common size of all images.
fn common_size<'a>(listed: impl Iterator<Item = &'a Listed>) -> Result<(usize, usize)> {
    let mut first: Option<(&Path, (usize, usize))> = None;
    for Listed { image: path, .. } in listed {
        let size = image::size(path)?;
        match first {
            None => first = Some((path, size)),
            Some((other, expected)) if expected != size => {
                let found =
                    format!("the image has {} x {} pixels, but {} has {} x {}", size.0, size.1, other.display(), expected.0, expected.1);
                return Err(Error::input(path, found, "use images of one size in a scene"));
            }
            Some(_) => {}
        }
    }
    Ok(first.map_or((0, 0), |(_, size)| size))
}

#[cfg(test)]
mod tests {
    use super::write::rows;
    use super::*;
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
