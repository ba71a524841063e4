//! Camera paths of films, by formula or from files of other programs.
//!
//! | path | recognised by | world frame | between entries |
//! | --- | --- | --- | --- |
//! | [`Turntable`] | | dataset | |
//! | [`spiral`] of forward-facing captures | | dataset | |
//! | [`along_cameras`] | | dataset | B-splines, as in instant-ngp |
//! | instant-ngp `base_cam.json` | `path` | instant-ngp's, converted | B-splines, as in instant-ngp |
//! | nerfstudio `camera_path.json` | `camera_path` | as in the file | nothing: entries are frames |
//! | `transforms.json` | `frames` | as in the file | nothing: entries are frames |
//!
//! **World frame of instant-ngp.** instant-ngp scales a dataset by 0.33 and moves it by ½, so that the box ±1.515 becomes the unit cube,
//! and cycles the axes so that y is up. Its cameras look along +z, with y down. With p in the dataset's world, (x, y, z)ngp = 0.33 (y, z,
//! x) + ½, and the second and third column of a rotation change sign (`NerfDataset::ngp_matrix_to_nerf` and `NERF_SCALE` in its
//! `nerf_loader.h`). A dataset whose JSON file has `scale`, `offset` or `aabb` is transformed differently; a path does not contain these
//! values. Quaternions are x, y, z, w. Fields of view are vertical, in degrees (`json_binding.h`, `Testbed::m_fov_axis`).
//!
//! **World frame of nerfstudio.** For NeRF-synthetic scenes it is that of the dataset. Other scenes are rotated, centred and scaled; a path
//! does not contain this transform.
//!
//! A path is used to render new images: principal points and lens distortion of photographs are ignored, and so are depth of field and
//! time.
//!
//! Parsers accept any bytes: the size of files is limited ([`CAMERA_PATH`](crate::files::CAMERA_PATH)), and all resulting numbers are in a
//! range that is safe to compute with.

mod forward_facing;
mod instant_ngp;
mod nerfstudio;
mod transforms;
mod turntable;

use crate::camera::{Camera, Intrinsics, is_angle_of_view};
use crate::dataset::image::MAX_SIDE;
use crate::error::{Error, Result};
use crate::json::{self, Kept};
use crate::space::Space;
pub use forward_facing::spiral;
use glam::{DAffine3, DQuat, DVec3};
use instant_ngp::Keyframes;
use serde_json::Value;
use std::path::Path;
pub use turntable::Turntable;

/// Largest number of frames of a path: an hour of film.
pub const MOST_FRAMES: usize = 100_000;
/// Content of a file that is kept. A list that is longer than a path may be is not read to its end.
const KEPT: Kept = Kept { keys: |key| KEYS.contains(&key), entries: MOST_FRAMES, share: 75 };
/// Keys that one of the readers uses.
const KEYS: [&str; 23] = [
    "path",
    "loop",
    "spline_order",
    "R",
    "T",
    "fov",
    "timestamp",
    "camera_path",
    "camera_type",
    "camera_to_world",
    "render_width",
    "render_height",
    "fps",
    "frames",
    "transform_matrix",
    "w",
    "h",
    "x_fov",
    "y_fov",
    "fl_x",
    "fl_y",
    "camera_angle_x",
    "camera_angle_y",
];
/// Largest distance of a camera from the origin along an axis, world length.
const FARTHEST: f64 = 1e6;

/// Field of view in radians, in (0, π).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fov {
    /// From the left to the right edge.
    Horizontal(f64),
    /// From the upper to the lower edge.
    Vertical(f64),
    /// Across the shorter side: what fits into a square image also fits into a wide or tall one.
    Shorter(f64),
}

impl Fov {
    /// Returns the intrinsics of a pinhole camera with square pixels for an image of this size.
    fn intrinsics(self, (width, height): (usize, usize)) -> Intrinsics {
        let (side, angle) = match self {
            Fov::Horizontal(angle) => (width, angle),
            Fov::Vertical(angle) => (height, angle),
            Fov::Shorter(angle) => (width.min(height), angle),
        };
        Intrinsics::centred(width, height, 0.5 * side as f64 / (0.5 * angle).tan())
    }

    /// Interpolates two angles of the same kind; returns `self` if the kinds differ.
    fn lerp(self, other: Self, t: f64) -> Self {
        let mix = |a: f64, b: f64| a + (b - a) * t;
        match (self, other) {
            (Fov::Horizontal(a), Fov::Horizontal(b)) => Fov::Horizontal(mix(a, b)),
            (Fov::Vertical(a), Fov::Vertical(b)) => Fov::Vertical(mix(a, b)),
            (Fov::Shorter(a), Fov::Shorter(b)) => Fov::Shorter(mix(a, b)),
            _ => self,
        }
    }
}

/// Camera pose and field of view of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Camera-to-world transform as in [`Camera`]: a rotation whose columns are the camera's right, up and backward axes, and the camera's
    /// position.
    pub camera_to_world: DAffine3,
    /// Field of view.
    pub fov: Fov,
}

impl Shot {
    /// Returns the camera for an image of `(width, height)` pixels.
    pub fn camera(&self, size: (usize, usize)) -> Camera {
        Camera { intrinsics: self.fov.intrinsics(size), camera_to_world: self.camera_to_world }
    }

    /// Interpolates two shots at `t` in [0, 1]: position and field of view linearly, rotation along the shorter arc.
    fn lerp(&self, other: &Self, t: f64) -> Self {
        let rotation = |shot: &Self| DQuat::from_mat3(&shot.camera_to_world.matrix3).normalize();
        let position = self.camera_to_world.translation.lerp(other.camera_to_world.translation, t);
        let rotation = rotation(self).slerp(rotation(other), t);
        Shot { camera_to_world: DAffine3::from_rotation_translation(rotation, position), fov: self.fov.lerp(other.fov, t) }
    }
}

/// Returns `frames` frames along the cameras of a capture, in their order: a cubic B-spline over at most 24 of them, evenly spaced in the
/// list, so that the shakes of a hand-held camera are smoothed. Empty if there are no cameras.
pub fn along_cameras(cameras: &[Camera], frames: usize) -> Vec<Shot> {
    const KEYS: usize = 24;
    let count = cameras.len().min(KEYS);
    let keys: Vec<Camera> = (0..count).map(|i| cameras[i * cameras.len() / count]).collect();
    if keys.is_empty() { Vec::new() } else { Keyframes::over(&keys).shots(frames.clamp(1, MOST_FRAMES)) }
}

/// Returns the up axis of a scene: +z in a box of the world; in other spaces the unit mean of the cameras' up axes, or +z if they have no common up.
pub fn up_axis(space: Space, cameras: &[Camera]) -> DVec3 {
    /// Smallest length of the mean that tells up.
    const CLEAR: f64 = 0.3;
    let mean = cameras.iter().map(|camera| camera.camera_to_world.matrix3.y_axis).sum::<DVec3>() / cameras.len().max(1) as f64;
    if space != Space::Box && mean.length() >= CLEAR { mean.normalize() } else { DVec3::Z }
}

/// File format of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// `base_cam.json`.
    InstantNgp,
    /// `camera_path.json`.
    Nerfstudio,
    /// `transforms.json` of NeRF-synthetic scenes and of both programs.
    Transforms,
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Format::InstantNgp => "an instant-ngp camera path",
            Format::Nerfstudio => "a nerfstudio camera path",
            Format::Transforms => "cameras of a transforms.json",
        })
    }
}

/// Camera path read from a file.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPath {
    /// Recognised format of the file.
    pub format: Format,
    /// Width and height of the images, if stated in the file.
    pub size: Option<(usize, usize)>,
    /// Frames per second, if stated in the file.
    pub fps: Option<f64>,
    entries: Entries,
}

#[derive(Debug, Clone, PartialEq)]
enum Entries {
    /// Every frame.
    Frames(Vec<Shot>),
    /// Keyframes, between which frames are interpolated.
    Keyframes(Keyframes),
}

impl CameraPath {
    /// Parses the bytes of a camera path file. `path` names the file in error messages.
    ///
    /// Errors if the content is invalid, naming frame and field.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let root = json::parse(path, bytes, &KEPT)?;
        let file = Entry { path, value: &root, place: String::new() };
        // A file of nerfstudio contains keyframes in addition to its frames, and a file of instant-ngp may contain anything.
        for (key, read) in
            [("camera_path", nerfstudio::read as fn(&Entry<'_>) -> Result<Self>), ("frames", transforms::read), ("path", instant_ngp::read)]
        {
            if root.get(key).is_some() {
                return read(&file);
            }
        }
        let remedy = "expected one of `path` (instant-ngp), `camera_path` (nerfstudio) and `frames` (transforms.json)";
        Err(Error::input(path, "it has none of the keys of a camera path", remedy))
    }

    /// Returns the number of entries in the file: frames or keyframes.
    pub fn entries(&self) -> usize {
        match &self.entries {
            Entries::Frames(shots) => shots.len(),
            Entries::Keyframes(keyframes) => keyframes.len(),
        }
    }

    /// Returns true if frames are interpolated between the entries.
    pub fn is_interpolated(&self) -> bool {
        matches!(self.entries, Entries::Keyframes(_))
    }

    /// Returns `frames` frames of the path, clamped to 1 to [`MOST_FRAMES`]. If the file lists frames, fewer frames are a uniform selection
    /// that includes the first and the last, and more frames are interpolated.
    pub fn shots(&self, frames: usize) -> Vec<Shot> {
        let frames = frames.clamp(1, MOST_FRAMES);
        match &self.entries {
            Entries::Keyframes(keyframes) => keyframes.shots(frames),
            Entries::Frames(shots) => (0..frames).map(|i| between(shots, i, frames)).collect(),
        }
    }
}

/// Returns frame `i` of `frames` along listed shots, of which there must be at least one.
fn between(shots: &[Shot], i: usize, frames: usize) -> Shot {
    let last = shots.len() - 1;
    let place = if frames > 1 { (i * last) as f64 / (frames - 1) as f64 } else { 0.0 };
    if frames <= shots.len() {
        return shots[(place.round() as usize).min(last)];
    }
    let before = (place as usize).min(last);
    shots[before].lerp(&shots[(before + 1).min(last)], place - before as f64)
}

/// Part of a file, with its position.
struct Entry<'a> {
    path: &'a Path,
    value: &'a Value,
    /// Suffix of a field's name in error messages, for example " of frame 3".
    place: String,
}

impl<'a> Entry<'a> {
    /// Returns the error for an invalid field.
    fn wrong(&self, field: &str, expected: &str) -> Error {
        let found = match self.value.get(field) {
            None => format!("there is no `{field}`{}", self.place),
            Some(value) => format!("`{field}`{} is {}", self.place, json::shown(value)),
        };
        Error::input(self.path, found, format!("expected {expected}"))
    }

    /// Reads a number that satisfies a predicate.
    fn number(&self, field: &str, accepts: impl Fn(f64) -> bool, expected: &str) -> Result<f64> {
        let number = self.value.get(field).and_then(Value::as_f64).filter(|number| accepts(*number));
        number.ok_or_else(|| self.wrong(field, expected))
    }

    /// Reads an optional number that satisfies a predicate.
    fn optional(&self, field: &str, accepts: impl Fn(f64) -> bool, expected: &str) -> Result<Option<f64>> {
        self.value.get(field).map(|_| self.number(field, accepts, expected)).transpose()
    }

    /// Reads N finite numbers.
    fn numbers<const N: usize>(&self, field: &str, expected: &str) -> Result<[f64; N]> {
        let list = self.value.get(field).and_then(Value::as_array).filter(|list| list.len() == N);
        let numbers: Option<Vec<f64>> = list.and_then(|list| list.iter().map(|n| n.as_f64().filter(|n| n.is_finite())).collect());
        numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| self.wrong(field, expected))
    }

    /// Reads the entries of a list of 1 to [`MOST_FRAMES`]. `name` is the name of an entry.
    fn list(&self, field: &str, name: &'static str) -> Result<impl ExactSizeIterator<Item = Entry<'a>>> {
        let list = self.value.get(field).and_then(Value::as_array).ok_or_else(|| self.wrong(field, "a list"))?;
        if list.is_empty() {
            let found = format!("`{field}` has 0 entries");
            return Err(Error::input(self.path, found, format!("expected 1 to {MOST_FRAMES}")));
        }
        let path = self.path;
        Ok(list.iter().enumerate().map(move |(k, value)| Entry { path, value, place: format!(" of {name} {k}") }))
    }

    /// Reads a field of view given in degrees. Returns radians.
    fn fov(&self) -> Result<f64> {
        let expected = "an angle in degrees, above 0 and below 180";
        self.number("fov", |degrees| is_angle_of_view(degrees.to_radians()), expected).map(f64::to_radians)
    }

    /// Reads width and height in pixels, if both are given.
    fn size(&self, width: &str, height: &str) -> Result<Option<(usize, usize)>> {
        let pixels = |n: f64| (1.0..=f64::from(MAX_SIDE)).contains(&n);
        let expected = format!("a number of pixels from 1 to {MAX_SIDE}");
        let [width, height] = [width, height].map(|field| self.optional(field, pixels, &expected));
        Ok(width?.zip(height?).map(|(width, height)| (width as usize, height as usize)))
    }

    /// Errors if a camera is too far from the origin.
    fn near_enough(&self, field: &str, camera_to_world: DAffine3) -> Result<DAffine3> {
        let near = camera_to_world.translation.abs().cmple(DVec3::splat(FARTHEST)).all();
        near.then_some(camera_to_world).ok_or_else(|| self.wrong(field, "positions within a million units of the origin"))
    }
}

#[cfg(test)]
mod tests;
