//! Camera models of COLMAP (`sensor/models.h`).

use super::{Lens, Unusable};
use crate::camera::Intrinsics;

/// Camera model of COLMAP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Model {
    /// Number in cameras.bin.
    pub id: i32,
    /// Name in cameras.txt.
    pub name: &'static str,
    /// Number of parameters.
    pub parameters: usize,
}

/// All camera models of COLMAP 4, also those without a [`Lens`]: a reader of cameras.bin must know their lengths.
pub const MODELS: [Model; 18] = [
    model(0, "SIMPLE_PINHOLE", 3),
    model(1, "PINHOLE", 4),
    model(2, "SIMPLE_RADIAL", 4),
    model(3, "RADIAL", 5),
    model(4, "OPENCV", 8),
    model(5, "OPENCV_FISHEYE", 8),
    model(6, "FULL_OPENCV", 12),
    model(7, "FOV", 5),
    model(8, "SIMPLE_RADIAL_FISHEYE", 4),
    model(9, "RADIAL_FISHEYE", 5),
    model(10, "THIN_PRISM_FISHEYE", 12),
    model(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    model(12, "SIMPLE_DIVISION", 4),
    model(13, "DIVISION", 5),
    model(14, "SIMPLE_FISHEYE", 3),
    model(15, "FISHEYE", 4),
    model(16, "EUCM", 6),
    model(17, "EQUIRECTANGULAR", 2),
];

const fn model(id: i32, name: &'static str, parameters: usize) -> Model {
    Model { id, name, parameters }
}

/// Models that have a [`Lens`], for messages.
const SUPPORTED: &str = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE, FOV, SIMPLE_RADIAL_FISHEYE, \
                         RADIAL_FISHEYE, THIN_PRISM_FISHEYE, SIMPLE_FISHEYE or FISHEYE";

impl Model {
    /// Returns the model with this number in cameras.bin.
    pub fn with_id(id: i32) -> Option<Self> {
        MODELS.into_iter().find(|model| model.id == id)
    }

    /// Returns the model with this name in cameras.txt.
    pub fn named(name: &str) -> Option<Self> {
        MODELS.into_iter().find(|model| model.name == name)
    }
}

impl Intrinsics {
    /// Returns the intrinsics of a camera of COLMAP. `parameters` are in the order of the files: f or fx, fy; cx, cy; the lens. Principal
    /// points need no shift, for the centre of COLMAP's first pixel is (0.5, 0.5) too.
    ///
    /// Refused: models without a [`Lens`], another number of parameters than the model has, parameters that are not finite, focal lengths
    /// that are not above 0, pixels beyond the fold of the lens ([`Intrinsics::check_lens`]).
    pub fn from_colmap(model: Model, (width, height): (usize, usize), parameters: &[f64]) -> Result<Self, Unusable> {
        let lens = Lens::from_colmap(model, parameters)?;
        let (fx, fy, cx, cy) = match (focal_lengths(model), parameters) {
            (1, &[f, cx, cy, ..]) => (f, f, cx, cy),
            (_, &[fx, fy, cx, cy, ..]) => (fx, fy, cx, cy),
            _ => return Err(wrong_count(model, parameters)),
        };
        if let Some(focal) = [fx, fy].into_iter().find(|f| *f <= 0.0) {
            return Err(Unusable { found: format!("the focal length is {focal}"), remedy: "expected a number above 0".to_owned() });
        }
        let intrinsics = Intrinsics { width, height, fx, fy, cx, cy, lens };
        intrinsics.check_lens().map(|()| intrinsics)
    }
}

impl Lens {
    /// Returns the lens of a camera of COLMAP. `parameters` are all parameters of the camera, with focal lengths and principal point.
    ///
    /// Refused: models without a lens here, another number of parameters than the model has, parameters that are not finite.
    pub fn from_colmap(model: Model, parameters: &[f64]) -> Result<Self, Unusable> {
        if parameters.len() != model.parameters {
            return Err(wrong_count(model, parameters));
        }
        if let Some(at) = parameters.iter().position(|value| !value.is_finite()) {
            let found = format!("parameter {} of the model {} is {}", at + 1, model.name, parameters[at]);
            return Err(Unusable { found, remedy: "expected finite numbers".to_owned() });
        }
        let (none, radial) = ([0.0; 2], |k1: f64, k2: f64| [k1, k2, 0.0, 0.0]);
        let lens = match (model.name, &parameters[(focal_lengths(model) + 2).min(parameters.len())..]) {
            ("SIMPLE_PINHOLE" | "PINHOLE", []) => Lens::Pinhole,
            ("SIMPLE_RADIAL", &[k]) => Lens::perspective(radial(k, 0.0), [0.0; 3], none),
            ("RADIAL", &[k1, k2]) => Lens::perspective(radial(k1, k2), [0.0; 3], none),
            ("OPENCV", &[k1, k2, p1, p2]) => Lens::perspective(radial(k1, k2), [0.0; 3], [p1, p2]),
            ("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6]) => Lens::perspective([k1, k2, k3, 0.0], [k4, k5, k6], [p1, p2]),
            ("OPENCV_FISHEYE", &[k1, k2, k3, k4]) => Lens::fisheye([k1, k2, k3, k4], none, none),
            ("FOV", &[0.0]) => Lens::Pinhole,
            ("FOV", &[omega]) if omega.abs() < std::f64::consts::PI => Lens::Fov { omega: omega.abs() },
            ("FOV", &[omega]) => {
                let found = format!("omega of the model FOV is {omega}");
                return Err(Unusable { found, remedy: "expected an angle in radians below 3.1416".to_owned() });
            }
            ("SIMPLE_FISHEYE" | "FISHEYE", []) => Lens::fisheye([0.0; 4], none, none),
            ("SIMPLE_RADIAL_FISHEYE", &[k]) => Lens::fisheye(radial(k, 0.0), none, none),
            ("RADIAL_FISHEYE", &[k1, k2]) => Lens::fisheye(radial(k1, k2), none, none),
            ("THIN_PRISM_FISHEYE", &[k1, k2, p1, p2, k3, k4, s1, s2]) => Lens::fisheye([k1, k2, k3, k4], [p1, p2], [s1, s2]),
            _ => {
                let remedy = format!("expected {SUPPORTED}; for other models undistort the images with `colmap image_undistorter`");
                return Err(Unusable { found: format!("the camera model {} is not supported", model.name), remedy });
            }
        };
        Ok(lens)
    }
}

/// Returns the number of focal lengths among the parameters.
fn focal_lengths(model: Model) -> usize {
    let single = ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE"];
    if single.contains(&model.name) { 1 } else { 2 }
}

fn wrong_count(model: Model, parameters: &[f64]) -> Unusable {
    Unusable {
        found: format!("the camera has {} parameters", parameters.len()),
        remedy: format!("expected the {} of the model {}", model.parameters, model.name),
    }
}
