//! Intrinsics of a frame of a transforms.json: its own values, else those of the file.

use super::present;
use crate::camera::lens::Lens;
use crate::camera::{Intrinsics, is_angle_of_view};
use crate::error::{Error, Result};
use crate::json;
use crate::text::number;
use serde_json::Value;
use std::path::Path;

const NUMBERS: [&str; 18] = [
    "w",
    "h",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
    "fl_x",
    "fl_y",
    "x_fov",
    "y_fov",
    "camera_angle_x",
    "camera_angle_y",
    "k5",
    "k6",
];
/// Keys of the horizontal and the vertical focal length: in pixels, as an angle in degrees, as an angle in radians.
const FOCAL: [[&str; 3]; 2] = [["fl_x", "x_fov", "camera_angle_x"], ["fl_y", "y_fov", "camera_angle_y"]];
/// Keys of cameras that cannot be used, unless they are false or 0.
const REFUSED: [&str; 11] = [
    "k5",
    "k6",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "ftheta_p3",
    "ftheta_p4",
    "latlong",
    "equirectangular",
    "orthographic",
    "rolling_shutter",
];
const MODEL: &str = "camera_model";
const IS_FISHEYE: &str = "is_fisheye";
/// Largest accepted width or height of the images that cameras were computed from.
const LARGEST: f64 = 1e6;

/// Returns true for the keys of intrinsics.
pub(super) fn is_known(key: &str) -> bool {
    NUMBERS.contains(&key) || REFUSED.contains(&key) || [MODEL, IS_FISHEYE].contains(&key)
}

/// Intrinsics that a file states for a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stated {
    /// Width and height of the image in pixels.
    pub size: Option<(usize, usize)>,
    focal: [Option<Focal>; 2],
    /// `camera_angle_x`, radians.
    angle_x: Option<f64>,
    center: [Option<f64>; 2],
    lens: Lens,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Focal {
    Pixels(f64),
    /// Angle of view in radians.
    Angle(f64),
}

/// A frame and the file around it.
struct Layers<'v> {
    path: &'v Path,
    top: &'v Value,
    frame: &'v Value,
    number: usize,
}

impl<'v> Layers<'v> {
    /// Returns the value of a key, that of the frame first.
    fn get(&self, key: &str) -> Option<&'v Value> {
        present(self.frame, key).or_else(|| present(self.top, key))
    }

    fn refused(&self, key: &str, value: &Value, remedy: &str) -> Error {
        let place = if present(self.frame, key).is_some() { format!(" of frame {}", self.number) } else { String::new() };
        Error::input(self.path, format!("{key}{place} is {}", json::shown(value)), remedy)
    }

    /// Returns the number of a key in a layer, if `accepted`.
    fn number(&self, key: &str, remedy: &str, accepted: impl Fn(f64) -> bool) -> Result<Option<f64>> {
        let number = |value: &Value| value.as_f64().filter(|x| accepted(*x)).ok_or_else(|| self.refused(key, value, remedy));
        self.get(key).map(number).transpose()
    }

    fn focal(&self, keys: &[&'static str; 3]) -> Result<Option<Focal>> {
        // Whatever a frame states precedes what the file states in another form.
        let key = [self.frame, self.top].into_iter().find_map(|layer| keys.iter().find(|key| present(layer, key).is_some()));
        let Some(key) = key else { return Ok(None) };
        let angle = |unit: f64| {
            let remedy = "expected an angle of view above 0 and below 180 degrees (x_fov in degrees, camera_angle_x in radians)";
            let number = self.number(key, remedy, |x| is_angle_of_view(unit * x))?;
            Ok(number.map(|x| Focal::Angle(unit * x)))
        };
        match *key {
            key if key == keys[0] => {
                Ok(self.number(key, "expected a positive number of pixels", |x| x > 0.0 && x.is_finite())?.map(Focal::Pixels))
            }
            key if key == keys[1] => angle(1f64.to_radians()),
            _ => angle(1.0),
        }
    }
}

impl Stated {
    /// Reads the intrinsics of frame `number`.
    pub(super) fn of(path: &Path, top: &Value, frame: &Value, number: usize) -> Result<Self> {
        let layers = Layers { path, top, frame, number };
        for (key, value) in REFUSED.into_iter().filter_map(|key| Some((key, layers.get(key)?))) {
            if value.as_f64() != Some(0.0) && value.as_bool() != Some(false) {
                return Err(layers.refused(key, value, "undistort the images: cameras of this kind are not supported"));
            }
        }
        let side = |key: &str| layers.number(key, "expected a size in pixels", |x| (1.0..=LARGEST).contains(&x) && x.fract() == 0.0);
        let size = match (side("w")?, side("h")?) {
            (Some(w), Some(h)) => Some((w as usize, h as usize)),
            _ => None,
        };
        let focal = [layers.focal(&FOCAL[0])?, layers.focal(&FOCAL[1])?];
        if focal == [None, None] {
            let found = format!("frame {number} has no focal length");
            return Err(Error::input(path, found, "give fl_x in pixels, or camera_angle_x in radians, in the frame or in the file"));
        }
        let center = |key: &str| layers.number(key, "expected a number of pixels", |x| x.abs() <= LARGEST);
        let coefficient = |key: &str| layers.number(key, "expected a number", f64::is_finite).map(Option::unwrap_or_default);
        let fisheye = layers.get(IS_FISHEYE);
        if let Some(value) = fisheye.filter(|value| !value.is_boolean()) {
            return Err(layers.refused(IS_FISHEYE, value, "expected true or false"));
        }
        let model = match layers.get(MODEL) {
            _ if fisheye.and_then(Value::as_bool) == Some(true) => "OPENCV_FISHEYE",
            Some(model) => model.as_str().ok_or_else(|| layers.refused(MODEL, model, "name a camera model, such as OPENCV"))?,
            None => "OPENCV",
        };
        let k = [coefficient("k1")?, coefficient("k2")?, coefficient("k3")?, coefficient("k4")?];
        let lens = Lens::from_transforms(model, k, [coefficient("p1")?, coefficient("p2")?]);
        let lens = lens.map_err(|unusable| unusable.at(path, &format!("frame {number}")))?;
        let angle_x = layers.get("camera_angle_x").and_then(Value::as_f64);
        Ok(Stated { size, focal, angle_x, center: [center("cx")?, center("cy")?], lens })
    }

    /// Returns how `camera_angle_x` contradicts a focal length in pixels, if the file does not state the size of the images to which that belongs.
    pub(super) fn conflict(&self, intrinsics: &Intrinsics) -> Option<String> {
        let (Some(Focal::Pixels(focal)), Some(angle), None) = (self.focal[0], self.angle_x, self.size) else { return None };
        let of_angle = 0.5 * intrinsics.width as f64 / (0.5 * angle).tan();
        let moved = 0.5 * intrinsics.width as f64 * (focal / of_angle - 1.0).abs();
        (moved > 1.0).then(|| {
            let [focal, of_angle] = [focal, of_angle].map(number);
            format!("fl_x is {focal}, but camera_angle_x and the width of {} pixels give {of_angle}", intrinsics.width)
        })
    }

    /// Returns the intrinsics for images of a size.
    pub fn at(&self, (width, height): (usize, usize)) -> Intrinsics {
        let (w, h) = (width as f64, height as f64);
        let pixels = |focal: Focal, side: f64| match focal {
            Focal::Pixels(pixels) => pixels,
            Focal::Angle(angle) => 0.5 * side / (0.5 * angle).tan(),
        };
        let [x, y] = [self.focal[0].map(|focal| pixels(focal, w)), self.focal[1].map(|focal| pixels(focal, h))];
        let fx = x.or(y).unwrap_or(w);
        Intrinsics {
            width,
            height,
            fx,
            fy: y.unwrap_or(fx),
            cx: self.center[0].unwrap_or(0.5 * w),
            cy: self.center[1].unwrap_or(0.5 * h),
            lens: self.lens,
        }
    }
}
