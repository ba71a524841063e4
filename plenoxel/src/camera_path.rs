//! Camera paths: where the camera of a film stands in each frame, by formula or from the files of other programs.
//!
//! | path | recognised by | world | what lies between its entries |
//! | --- | --- | --- | --- |
//! | [`Turntable`] | | the dataset's | |
//! | instant-ngp `base_cam.json` | `path` | its own: converted | B-splines, as there |
//! | nerfstudio `camera_path.json` | `camera_path` | as the file has it | nothing: entries are frames |
//! | `transforms.json` | `frames` | as the file has it | nothing: entries are frames |
//!
//! **instant-ngp's world.** It scales a dataset by 0.33 and moves it by ½, so that the box ±1.515 is the unit cube, and cycles the axes so that y is
//! up; its cameras look along +z and have y down. With p in the dataset's world, (x, y, z)ngp = 0.33 (y, z, x) + ½; the second and third column
//! of a rotation change their sign (`NerfDataset::ngp_matrix_to_nerf` and `NERF_SCALE` in its `nerf_loader.h`). A dataset whose JSON file has
//! `scale`, `offset` or `aabb` is placed otherwise there, which a path does not say. Quaternions are x, y, z, w; fields of view are vertical and in
//! degrees (`json_binding.h`, `Testbed::m_fov_axis`).
//!
//! **nerfstudio's world** is the dataset's for NeRF-synthetic scenes. Others it turns, centres and scales, and a path made there does not say how.
//!
//! A path is for new pictures: principal points and lens distortion of photographs are left out, and so are depth of field and time.
//!
//! Parsers take any bytes: files are bounded ([`CAMERA_PATH`](crate::files::CAMERA_PATH)), and no number that comes out is too large to compute with.

mod instant_ngp;
mod nerfstudio;
mod transforms;
mod turntable;

use crate::camera::{Camera, Intrinsics, is_angle_of_view};
use crate::dataset::image::MAX_SIDE;
use crate::error::{Error, Result};
use crate::json::{self, Kept};
use glam::{DAffine3, DQuat, DVec3};
use instant_ngp::Keyframes;
use serde_json::Value;
use std::path::Path;
pub use turntable::Turntable;

/// The most frames of a path: an hour of film.
pub const MOST_FRAMES: usize = 100_000;
/// What is kept of a file: a list that is longer than a path may be is not read to its end.
const KEPT: Kept = Kept { keys: |key| KEYS.contains(&key), entries: MOST_FRAMES, share: 75 };
/// The keys that one of the readers looks at.
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
/// The farthest that a camera may stand from the origin, world length.
const FARTHEST: f64 = 1e6;

/// Angle of view in radians, in (0, π).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fov {
    /// From the left to the right edge.
    Horizontal(f64),
    /// From the upper to the lower edge.
    Vertical(f64),
    /// Across the shorter of both: what fits into a square picture fits into a wide or a tall one too.
    Shorter(f64),
}

impl Fov {
    /// Of the picture that a pinhole camera takes, with square pixels.
    fn intrinsics(self, (width, height): (usize, usize)) -> Intrinsics {
        let (side, angle) = match self {
            Fov::Horizontal(angle) => (width, angle),
            Fov::Vertical(angle) => (height, angle),
            Fov::Shorter(angle) => (width.min(height), angle),
        };
        Intrinsics::centred(width, height, 0.5 * side as f64 / (0.5 * angle).tan())
    }

    /// The angle between two of a kind; `self` if they are not.
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

/// Where the camera stands in a frame, and how much it sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// A rotation whose columns are the camera's right, up and backward axes, and its position: as in [`Camera`].
    pub camera_to_world: DAffine3,
    /// How much it sees.
    pub fov: Fov,
}

impl Shot {
    /// The camera for a picture of `(width, height)` pixels.
    pub fn camera(&self, size: (usize, usize)) -> Camera {
        Camera { intrinsics: self.fov.intrinsics(size), camera_to_world: self.camera_to_world }
    }

    /// The shot at `t` in [0, 1] between two: position and angle of view linearly, rotation along the shorter arc.
    fn lerp(&self, other: &Self, t: f64) -> Self {
        let rotation = |shot: &Self| DQuat::from_mat3(&shot.camera_to_world.matrix3).normalize();
        let position = self.camera_to_world.translation.lerp(other.camera_to_world.translation, t);
        let rotation = rotation(self).slerp(rotation(other), t);
        Shot { camera_to_world: DAffine3::from_rotation_translation(rotation, position), fov: self.fov.lerp(other.fov, t) }
    }
}

/// Which program a path comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// `base_cam.json`.
    InstantNgp,
    /// `camera_path.json`.
    Nerfstudio,
    /// `transforms.json`, of NeRF-synthetic scenes and of both programs.
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

/// A path as a file has it.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPath {
    /// What the file was recognised as.
    pub format: Format,
    /// Width and height of the pictures, if the file says so.
    pub size: Option<(usize, usize)>,
    /// Frames a second, if the file says so.
    pub fps: Option<f64>,
    entries: Entries,
}

#[derive(Debug, Clone, PartialEq)]
enum Entries {
    /// All of them.
    Frames(Vec<Shot>),
    /// Between which frames lie.
    Keyframes(Keyframes),
}

impl CameraPath {
    /// Reads a path from the bytes of the file `path`, whose name is for messages alone.
    ///
    /// Errors: everything that is wrong with it, with frame and field.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let root = json::parse(path, bytes, &KEPT)?;
        let file = Entry { path, value: &root, place: String::new() };
        // A file of nerfstudio has keyframes beside its frames, and one of instant-ngp may have anything.
        for (key, read) in
            [("camera_path", nerfstudio::read as fn(&Entry<'_>) -> Result<Self>), ("frames", transforms::read), ("path", instant_ngp::read)]
        {
            if root.get(key).is_some() {
                return read(&file);
            }
        }
        let remedy = "a camera path has one of them: `path` (instant-ngp), `camera_path` (nerfstudio) or `frames` (transforms.json)";
        Err(Error::input(path, "none of the keys of a camera path is there", remedy))
    }

    /// The number of entries in the file: frames, or keyframes.
    pub fn entries(&self) -> usize {
        match &self.entries {
            Entries::Frames(shots) => shots.len(),
            Entries::Keyframes(keyframes) => keyframes.len(),
        }
    }

    /// True if frames are to be found between the entries.
    pub fn is_interpolated(&self) -> bool {
        matches!(self.entries, Entries::Keyframes(_))
    }

    /// So many frames of the path, at least 1 and at most [`MOST_FRAMES`]. Of listed frames fewer are evenly chosen, the first and the last among
    /// them, and more are found between them.
    pub fn shots(&self, frames: usize) -> Vec<Shot> {
        let frames = frames.clamp(1, MOST_FRAMES);
        match &self.entries {
            Entries::Keyframes(keyframes) => keyframes.shots(frames),
            Entries::Frames(shots) => (0..frames).map(|i| between(shots, i, frames)).collect(),
        }
    }
}

/// Frame `i` of `frames` along listed shots, of which there is at least one.
fn between(shots: &[Shot], i: usize, frames: usize) -> Shot {
    let last = shots.len() - 1;
    let place = if frames > 1 { (i * last) as f64 / (frames - 1) as f64 } else { 0.0 };
    if frames <= shots.len() {
        return shots[(place.round() as usize).min(last)];
    }
    let before = (place as usize).min(last);
    shots[before].lerp(&shots[(before + 1).min(last)], place - before as f64)
}

/// A part of a file, and its place in it.
struct Entry<'a> {
    path: &'a Path,
    value: &'a Value,
    /// Behind the name of a field: " of frame 3".
    place: String,
}

impl<'a> Entry<'a> {
    /// The error that a field is not what it should be.
    fn wrong(&self, field: &str, accepted: &str) -> Error {
        let found = match self.value.get(field) {
            None => format!("there is no `{field}`{}", self.place),
            Some(value) => format!("`{field}`{} is {}", self.place, json::shown(value)),
        };
        Error::input(self.path, found, accepted)
    }

    /// A number that a test accepts.
    fn number(&self, field: &str, accepts: impl Fn(f64) -> bool, accepted: &str) -> Result<f64> {
        let number = self.value.get(field).and_then(Value::as_f64).filter(|number| accepts(*number));
        number.ok_or_else(|| self.wrong(field, accepted))
    }

    /// The same where there may be none.
    fn optional(&self, field: &str, accepts: impl Fn(f64) -> bool, accepted: &str) -> Result<Option<f64>> {
        self.value.get(field).map(|_| self.number(field, accepts, accepted)).transpose()
    }

    /// So many finite numbers.
    fn numbers<const N: usize>(&self, field: &str, accepted: &str) -> Result<[f64; N]> {
        let list = self.value.get(field).and_then(Value::as_array).filter(|list| list.len() == N);
        let numbers: Option<Vec<f64>> = list.and_then(|list| list.iter().map(|n| n.as_f64().filter(|n| n.is_finite())).collect());
        numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| self.wrong(field, accepted))
    }

    /// The entries of a list: some, and not too many. `name` is what one of them is called.
    fn list(&self, field: &str, name: &'static str) -> Result<impl ExactSizeIterator<Item = Entry<'a>>> {
        let list = self.value.get(field).and_then(Value::as_array).ok_or_else(|| self.wrong(field, "it is a list"))?;
        if list.is_empty() {
            let found = format!("`{field}` has 0 entries");
            return Err(Error::input(self.path, found, format!("paths of 1 to {MOST_FRAMES} are read")));
        }
        let path = self.path;
        Ok(list.iter().enumerate().map(move |(k, value)| Entry { path, value, place: format!(" of {name} {k}") }))
    }

    /// An angle of view in radians, given in degrees.
    fn fov(&self) -> Result<f64> {
        let accepted = "it is an angle in degrees, above 0 and below 180";
        self.number("fov", |degrees| is_angle_of_view(degrees.to_radians()), accepted).map(f64::to_radians)
    }

    /// Width and height in pixels, where both are given.
    fn size(&self, width: &str, height: &str) -> Result<Option<(usize, usize)>> {
        let pixels = |n: f64| (1.0..=f64::from(MAX_SIDE)).contains(&n);
        let accepted = format!("it is a number of pixels from 1 to {MAX_SIDE}");
        let [width, height] = [width, height].map(|field| self.optional(field, pixels, &accepted));
        Ok(width?.zip(height?).map(|(width, height)| (width as usize, height as usize)))
    }

    /// Refuses a camera that stands nowhere.
    fn near_enough(&self, field: &str, camera_to_world: DAffine3) -> Result<DAffine3> {
        let near = camera_to_world.translation.abs().cmple(DVec3::splat(FARTHEST)).all();
        near.then_some(camera_to_world).ok_or_else(|| self.wrong(field, "cameras stand within a million units of the origin"))
    }
}

#[cfg(test)]
mod tests;
