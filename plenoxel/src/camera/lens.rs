//! Lens models: where the image of a direction lies, and from which direction a point of the image is seen.
//!
//! A lens works in units of the focal length, between directions of the camera and points of the image plane, with the axes of OpenCV: x
//! right, y *down*, z forward. Pixels follow from focal lengths and principal point ([`Intrinsics`]). All models but [`Lens::Fov`] consist
//! of two steps:
//!
//! 1. A projection without distortion. Of a perspective lens: (X/Z, Y/Z), for directions less than 90° from the axis. Of a fisheye lens:
//!    θ (X, Y)/√(X² + Y²), with the angle θ to the axis (equidistant projection); θ may exceed 90°.
//! 2. A polynomial map of the plane ([`Distortion`]).
//!
//! A polynomial is a lens only near the centre. Where the determinant of its Jacobian is no longer positive, the image folds over itself,
//! and a point has two directions. The parts of the plane beyond the fold do not belong to the lens: directions there have no image, and
//! points that only they would reach have no direction. [`Intrinsics::check_lens`] tells whether an image has such points.
//!
//! Sources: the OpenCV manual, modules calib3d and fisheye (Kannala and Brandt 2006); COLMAP, `sensor/models.h`; nerfstudio,
//! `cameras/camera_utils.py`. [`colmap`] makes lenses from the parameters of COLMAP's models, [`Lens::from_transforms`] from the keys of a
//! transforms.json.

pub mod colmap;
mod distortion;
#[cfg(test)]
mod tests;

pub use distortion::Distortion;

use super::Intrinsics;
use crate::error::Error;
use glam::{DVec2, DVec3, dvec2};
use std::path::Path;

/// Lens of a camera.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Lens {
    /// No distortion: the image of (X, Y, Z) is (X/Z, Y/Z).
    #[default]
    Pinhole,
    /// Perspective projection, then a polynomial: radial, tangential and rational models of OpenCV, COLMAP and nerfstudio.
    Perspective(Distortion),
    /// Equidistant projection, then a polynomial: fisheye models of OpenCV, COLMAP and nerfstudio.
    Fisheye(Distortion),
    /// Field-of-view model: perspective projection, then r ↦ atan(2 r tan(ω/2))/ω (Devernay and Faugeras 2001).
    Fov {
        /// ω, radians, in (0, π).
        omega: f64,
    },
}

/// Reason why a lens cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unusable {
    /// Problem that was found.
    pub found: String,
    /// Accepted values, or advice.
    pub remedy: String,
}

impl Unusable {
    /// Returns the error for a file and a place in it, such as "camera 3".
    pub fn at(self, path: &Path, place: &str) -> Error {
        Error::input(path, format!("{place}: {}", self.found), self.remedy)
    }
}

/// Models of transforms.json that are perspective lenses with the polynomial of nerfstudio. Keys of distortion apply whatever the name.
const PERSPECTIVE: [&str; 5] = ["PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];
const FISHEYE: &str = "OPENCV_FISHEYE";

impl Lens {
    /// Returns a perspective lens with the [`Distortion`] of these coefficients: k₁ to k₄ of the numerator, of the denominator, and p₁, p₂.
    /// It is a pinhole if all are 0.
    pub fn perspective(numerator: [f64; 4], denominator: [f64; 3], tangential: [f64; 2]) -> Self {
        if numerator.iter().chain(&denominator).chain(&tangential).all(|k| *k == 0.0) {
            return Lens::Pinhole;
        }
        Lens::Perspective(Distortion::of_perspective(numerator, denominator, tangential))
    }

    /// Returns a fisheye lens with the [`Distortion`] of these coefficients: k₁ to k₄, p₁ and p₂, s₁ and s₂.
    pub fn fisheye(radial: [f64; 4], tangential: [f64; 2], prism: [f64; 2]) -> Self {
        Lens::Fisheye(Distortion::of_fisheye(radial, tangential, prism))
    }

    /// Returns the lens of a transforms.json of instant-ngp or nerfstudio: `camera_model` ("OPENCV_FISHEYE" for `is_fisheye`), `k1` to `k4`
    /// and `p1`, `p2`; missing numbers are 0. `k4` is the fourth coefficient of the numerator, as in nerfstudio; it is not the first of
    /// OpenCV's denominator.
    ///
    /// Refused: other models, numbers that are not finite.
    pub fn from_transforms(camera_model: &str, k: [f64; 4], p: [f64; 2]) -> Result<Self, Unusable> {
        let names = ["k1", "k2", "k3", "k4", "p1", "p2"];
        if let Some((name, value)) = names.iter().zip(k.iter().chain(&p)).find(|(_, value)| !value.is_finite()) {
            return Err(Unusable { found: format!("{name} is {value}"), remedy: "expected a finite number".to_owned() });
        }
        match camera_model {
            FISHEYE => Ok(Lens::fisheye(k, p, [0.0; 2])),
            model if PERSPECTIVE.contains(&model) => Ok(Lens::perspective(k, [0.0; 3], p)),
            model => Err(Unusable {
                found: format!("the camera model {model:?} is not supported"),
                remedy: format!("expected {} or {FISHEYE}; undistort the images for other models", PERSPECTIVE.join(", ")),
            }),
        }
    }

    /// Returns the image of a direction (of any length), in focal lengths from the principal point: x right, y down. `None` if it has none:
    /// beyond the fold of the lens, or 90° and more from the axis of a lens that is not a fisheye.
    pub fn distort(&self, direction: DVec3) -> Option<DVec2> {
        let across = direction.truncate();
        if let Lens::Fisheye(distortion) = self {
            let sine = across.length();
            let angle = sine.atan2(direction.z);
            // The image of the direction opposite to the axis would be a circle.
            return match sine > 0.0 {
                true => distortion.apply(angle / sine * across),
                false => (direction.z > 0.0).then_some(DVec2::ZERO),
            };
        }
        if direction.z <= 0.0 || direction.z.is_nan() {
            return None;
        }
        let plane = across / direction.z;
        match self {
            Lens::Perspective(distortion) => distortion.apply(plane),
            Lens::Fov { omega } => Some(plane * fov_scale(plane.length(), *omega)),
            _ => Some(plane),
        }
    }

    /// Returns the direction whose image is a point in focal lengths from the principal point, the inverse of [`Lens::distort`]: of z = 1,
    /// of length 1 for a fisheye. `None` if there is none.
    pub fn undistort(&self, point: DVec2) -> Option<DVec3> {
        match self {
            Lens::Pinhole => Some(point.extend(1.0)),
            Lens::Perspective(distortion) => distortion.invert(point).map(|plane| plane.extend(1.0)),
            Lens::Fisheye(distortion) => distortion.invert(point).map(|plane| {
                let angle = plane.length();
                let (sine, cosine) = angle.sin_cos();
                (plane * if angle > 0.0 { sine / angle } else { 1.0 }).extend(cosine)
            }),
            Lens::Fov { omega } => {
                let angle = point.length() * omega;
                let scale = if angle > 0.0 { angle.tan() / angle } else { 1.0 };
                (angle < std::f64::consts::FRAC_PI_2).then(|| (point * (scale * 0.5 * omega / (0.5 * omega).tan())).extend(1.0))
            }
        }
    }

    /// Returns the distance from the principal point up to which points have directions, in focal lengths, along the direction `towards` of
    /// the image plane; infinite if all have.
    fn image_radius(&self, towards: DVec2) -> f64 {
        match self {
            Lens::Pinhole => f64::INFINITY,
            Lens::Perspective(distortion) | Lens::Fisheye(distortion) => distortion.image_radius(towards),
            Lens::Fov { omega } => std::f64::consts::FRAC_PI_2 / omega,
        }
    }
}

/// Returns atan(2 r tan(ω/2))/(ω r).
fn fov_scale(r: f64, omega: f64) -> f64 {
    let slope = 2.0 * (0.5 * omega).tan();
    if r > 0.0 { (slope * r).atan() / (omega * r) } else { slope / omega }
}

impl Intrinsics {
    /// Checks that every pixel of the image has a ray. It tests the corners and 64 pixels along each edge: a lens that reaches the edge
    /// reaches what is inside.
    ///
    /// Refused: an image with pixels beyond the fold of the lens. The message has the radius of the fold in pixels.
    pub fn check_lens(&self) -> Result<(), Unusable> {
        const STEPS: usize = 64;
        let (right, bottom) = (self.width as f64 - 0.5, self.height as f64 - 0.5);
        let edge = (0..=STEPS).flat_map(|i| {
            let share = i as f64 / STEPS as f64;
            let (x, y) = (0.5 + share * (right - 0.5), 0.5 + share * (bottom - 0.5));
            [(x, 0.5), (x, bottom), (0.5, y), (right, y)]
        });
        let away = |(x, y): (f64, f64)| (x - self.cx).hypot(y - self.cy);
        let outside = edge.filter(|&(x, y)| self.lens.undistort(self.plane(x, y)).is_none());
        let Some(farthest) = outside.max_by(|a, b| away(*a).total_cmp(&away(*b))) else { return Ok(()) };
        let towards = self.plane(farthest.0, farthest.1);
        let fold = self.lens.image_radius(towards) * away(farthest) / towards.length();
        Err(Unusable {
            found: format!(
                "the lens folds over at {fold:.1} pixels from the principal point, and the image has pixels up to {:.1} pixels away",
                away(farthest)
            ),
            remedy: "undistort or crop the images, or correct the distortion parameters or the image size".to_owned(),
        })
    }

    /// Returns a point in pixels as a point of the image plane, in focal lengths from the principal point.
    fn plane(&self, x: f64, y: f64) -> DVec2 {
        dvec2((x - self.cx) / self.fx, (y - self.cy) / self.fy)
    }
}
