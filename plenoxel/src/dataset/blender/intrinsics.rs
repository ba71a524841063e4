//! Intrinsics that a transforms file states in addition to `camera_angle_x`. Cameras are pinholes with square pixels and a centred
//! principal point: keys that agree with this are accepted, all others are errors that name the key.

use crate::error::{Error, Result};
use crate::json;
use crate::text::number;
use serde_json::Value;
use std::path::Path;

/// Keys of lens distortion; 0 means no distortion.
const DISTORTION: [&str; 13] =
    ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"];
/// Keys that, if true, state a lens other than a pinhole.
const LENSES: [&str; 2] = ["is_fisheye", "latlong"];
/// Camera models of COLMAP and nerfstudio that are pinholes if there is no distortion.
const PINHOLES: [&str; 5] = ["PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];
/// Keys that are compared with `camera_angle_x` when the size of the images is known.
const COMPARED: [&str; 10] = ["camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "fl_x", "fl_y", "cx", "cy", "w", "h"];
/// Key of the name of the camera model.
const MODEL: &str = "camera_model";
/// Tolerance in pixels: the shift of a point at the edge of an image between the two values. Files contain rounded numbers.
const WITHIN: f64 = 0.05;

/// Intrinsics of a transforms file that must follow from its `camera_angle_x` and the size of the images.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StatedIntrinsics(Vec<Stated>);

#[derive(Clone, Debug, PartialEq)]
struct Stated {
    key: &'static str,
    /// Number of the frame; `None` for a key of the whole file.
    frame: Option<usize>,
    value: f64,
}

/// Returns true for the keys that [`StatedIntrinsics::add`] looks at.
pub(super) fn is_known(key: &str) -> bool {
    [&DISTORTION[..], &LENSES, &COMPARED, &[MODEL]].iter().any(|keys| keys.contains(&key))
}

/// Returns the key, with its frame.
fn place(key: &str, frame: Option<usize>) -> String {
    frame.map_or(key.to_owned(), |frame| format!("{key} of frame {frame}"))
}

impl StatedIntrinsics {
    /// Adds the intrinsics of a frame, or of the whole file.
    ///
    /// Errors if they state a distortion, a lens or a camera model other than a pinhole, or if a value is not a number.
    pub(super) fn add(&mut self, path: &Path, entry: &Value, frame: Option<usize>) -> Result<()> {
        let stated = |key: &str| entry.get(key).filter(|value| !value.is_null());
        let refused = |key: &str, value: &Value, remedy: &str| {
            Err(Error::input(path, format!("{} is {}", place(key, frame), json::shown(value)), remedy))
        };
        for (key, value) in DISTORTION.into_iter().filter_map(|key| Some((key, stated(key)?))) {
            if value.as_f64() != Some(0.0) {
                return refused(key, value, "lens distortion is not supported yet: undistort the images, and set it to 0");
            }
        }
        for (key, value) in LENSES.into_iter().filter_map(|key| Some((key, stated(key)?))) {
            if value.as_bool() != Some(false) {
                return refused(key, value, "expected a pinhole camera");
            }
        }
        if let Some(model) = stated(MODEL)
            && !model.as_str().is_some_and(|model| PINHOLES.contains(&model))
        {
            return refused(MODEL, model, "expected a pinhole camera, such as PINHOLE, or OPENCV without distortion");
        }
        for (key, value) in COMPARED.into_iter().filter_map(|key| Some((key, stated(key)?))) {
            let Some(value) = value.as_f64() else { return refused(key, value, "expected a number") };
            self.0.push(Stated { key, frame, value });
        }
        Ok(())
    }

    /// Compares all intrinsics with the horizontal field of view, radians, and with width and height of the images, pixels.
    ///
    /// Errors at the first value that does not agree.
    pub fn check(&self, path: &Path, fov_x: f64, (width, height): (usize, usize)) -> Result<()> {
        let (w, h) = (width as f64, height as f64);
        let focal = 0.5 * w / (0.5 * fov_x).tan();
        let fov_y = 2.0 * (0.5 * h / focal).atan();
        for Stated { key, frame, value } in &self.0 {
            // Shift of a point at the edge of the image if the focal length changes.
            let zoom = |side: f64, other: f64| (0.5 * side * (other / focal - 1.0)).abs();
            let angle = |side: f64, radians: f64| zoom(side, 0.5 * side / (0.5 * radians).tan());
            let (expected, moved) = match *key {
                "camera_angle_x" => (fov_x, angle(w, *value)),
                "camera_angle_y" => (fov_y, angle(h, *value)),
                "x_fov" => (fov_x.to_degrees(), angle(w, value.to_radians())),
                "y_fov" => (fov_y.to_degrees(), angle(h, value.to_radians())),
                "fl_x" => (focal, zoom(w, *value)),
                "fl_y" => (focal, zoom(h, *value)),
                "cx" => (0.5 * w, (value - 0.5 * w).abs()),
                "cy" => (0.5 * h, (value - 0.5 * h).abs()),
                "w" => (w, (value - w).abs()),
                _ => (h, (value - h).abs()),
            };
            if moved.is_nan() || moved > WITHIN {
                let found = format!("{} is {}", place(key, *frame), number(*value));
                let (expected, fov_x) = (number(expected), number(fov_x));
                let remedy = format!(
                    "{expected} is expected with camera_angle_x {fov_x} and images of {width} x {height} pixels: the principal point must be in the \
                     middle, pixels square, and the angle the same in all frames"
                );
                return Err(Error::input(path, found, remedy));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn check(file: Value) -> Result<()> {
        let mut stated = StatedIntrinsics::default();
        stated.add(Path::new("t.json"), &file, Some(3))?;
        stated.check(Path::new("t.json"), 0.6911112070083618, (800, 600))
    }

    #[test]
    fn what_says_the_same_may_stand_and_everything_else_is_refused_by_name() {
        let same = json!({
            "fl_x": 1111.1111, "fl_y": 1111.1111, "cx": 400, "cy": 300.0, "w": 800, "h": 600, "camera_angle_x": 0.69111, "camera_angle_y": 0.527451,
            "x_fov": 39.5978, "y_fov": null, "k1": 0, "k2": 0.0, "p1": 0, "camera_model": "OPENCV", "is_fisheye": false, "aabb_scale": 16
        });
        assert!(same.as_object().unwrap().keys().all(|key| is_known(key) != (key == "aabb_scale")));
        check(same).unwrap();
        for (key, value) in [
            ("fl_x", json!(1112)),
            ("fl_y", json!(555.5)),
            ("cx", json!(401)),
            ("cy", json!(400)),
            ("w", json!(1600)),
            ("h", json!(800)),
            ("camera_angle_x", json!(0.7)),
            ("camera_angle_y", json!(0.6911112070083618)),
            ("x_fov", json!(45)),
            ("y_fov", json!(0)),
            ("k1", json!(1e-9)),
            ("k4", json!("0")),
            ("p2", json!(-0.01)),
            ("ftheta_p0", json!(1)),
            ("fl_x", json!("1111")),
            ("is_fisheye", json!(true)),
            ("camera_model", json!("OPENCV_FISHEYE")),
            ("fl_x", json!(1e300)),
        ] {
            let error = check(json!({ key: value })).unwrap_err();
            assert_eq!(error.exit_code(), 3);
            assert!(error.to_string().starts_with(&format!("t.json: {key} of frame 3 is ")), "{error}");
            assert!(value != 1e300 || error.to_string().contains("is 1e300; 1111.1110311937682 is expected"), "{error}");
        }
    }
}
