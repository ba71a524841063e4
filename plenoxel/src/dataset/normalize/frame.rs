//! Geometry of a set of cameras: mean pose, up, focus, nearest depth.

use super::super::capture::Point;
use super::choice::{Center, Orient};
use super::{NEAR, NEAREST};
use crate::camera::Camera;
use crate::geometry::eigen;
use glam::{DMat3, DVec3};

/// Steps of the search for the focus.
const STEPS: usize = 100;
/// Largest distance of the focus from the cameras, in units of their spread, at which they still look inwards.
const FARTHEST_FOCUS: f64 = 10.0;
/// Share of cameras that have the focus in front of them.
const INWARDS: f64 = 0.9;
/// Smallest length of the mean of the cameras' up axes that tells up.
const CLEAR_UP: f64 = 0.3;
/// Largest number of points whose depths are looked at.
const POINTS: usize = 10_000;

/// Mean pose of a set of cameras, and how far they differ from it.
pub(super) struct Frame {
    /// Mean position.
    pub mean: DVec3,
    /// Largest distance of a camera from the mean position.
    pub spread: f64,
    /// Largest angle between an optical axis and the mean one, degrees.
    pub widest_angle: f64,
    up: DVec3,
    backward: DVec3,
    /// Largest distance of a camera from the mean position in the mean direction of sight.
    advance: f64,
}

/// Returns the right, up and backward axis of a camera.
fn axes(camera: &Camera) -> [DVec3; 3] {
    let m = camera.camera_to_world.matrix3;
    [m.x_axis, m.y_axis, m.z_axis]
}

impl Frame {
    pub fn new(cameras: &[Camera]) -> Self {
        let n = cameras.len() as f64;
        let mean = cameras.iter().map(Camera::position).sum::<DVec3>() / n;
        let up = cameras.iter().map(|camera| axes(camera)[1]).sum::<DVec3>() / n;
        let backward = cameras.iter().map(|camera| axes(camera)[2]).sum::<DVec3>() / n;
        let direction = backward.try_normalize();
        let angle = |camera: &Camera| direction.map_or(180.0, |mean| axes(camera)[2].angle_between(mean).to_degrees());
        Frame {
            mean,
            spread: cameras.iter().map(|camera| camera.position().distance(mean)).fold(0.0, f64::max),
            widest_angle: cameras.iter().map(angle).fold(0.0, f64::max),
            up,
            backward,
            advance: cameras.iter().map(|c| (mean - c.position()).dot(direction.unwrap_or_default())).fold(0.0, f64::max),
        }
    }

    /// Returns the axes of the mean camera, as LLFF has them: backward is the sum of all, up as near to the sum of all as it can be.
    pub fn mean_axes(&self) -> DMat3 {
        let z = self.backward.normalize_or(DVec3::Z);
        let x = self.up.cross(z).try_normalize().unwrap_or_else(|| z.any_orthonormal_vector());
        DMat3::from_cols(x, z.cross(x), z)
    }

    /// Returns the depth of the nearest surface from the mean camera, and what it is known from.
    pub fn near(&self, cameras: &[Camera], points: &[Point], bounds: Option<[f64; 2]>) -> Option<(f64, &'static str)> {
        if let Some([near, _]) = bounds {
            return Some((near, "the bounds of the files"));
        }
        let every = points.len().div_ceil(POINTS).max(1);
        let seen = |camera: &Camera, point: &Point| {
            let k = &camera.intrinsics;
            let (x, y, depth) = camera.project(point.position)?;
            ((0.0..=k.width as f64).contains(&x) && (0.0..=k.height as f64).contains(&y)).then_some(depth)
        };
        let depths = points.iter().step_by(every).flat_map(|point| cameras.iter().filter_map(move |camera| seen(camera, point)));
        let mut depths: Vec<f64> = depths.collect();
        depths.sort_by(f64::total_cmp);
        let near = depths.get((NEAREST * depths.len() as f64) as usize)?;
        Some((*near, "the points"))
    }

    /// Returns why cameras are not all before a scene whose nearest depth is `near`.
    pub fn behind(&self, near: f64) -> Option<String> {
        let far = self.spread.max(self.advance) >= NEAR * near;
        far.then(|| format!("cameras are up to {:.3} from their mean position, and the nearest depth is {near:.3}", self.spread))
    }

    /// Returns the rotation that makes +z up, with a description.
    pub fn orientation(&self, cameras: &[Camera], orient: Orient) -> (DMat3, String) {
        let pca = |why: &str| (self.principal_axes(cameras), format!("pca: the plane of the camera positions is horizontal{why}"));
        match orient {
            Orient::Up if self.up.length() >= CLEAR_UP => {
                let up = self.up.normalize();
                // The first camera tells which horizontal direction is x, so that files of another frame give the same world.
                let [right, _, backward] = axes(&cameras[0]);
                let flat = |v: DVec3| v - up * v.dot(up);
                let x = [flat(right), flat(backward)].into_iter().max_by(|a, b| (a.length() - 1e-6).total_cmp(&b.length()));
                let x = x.and_then(DVec3::try_normalize).unwrap_or_else(|| up.any_orthonormal_vector());
                (DMat3::from_cols(x, up.cross(x), up).transpose(), "up: the mean of the cameras' up axes is +z".into())
            }
            Orient::Up => pca(", because the cameras have no common up"),
            Orient::Pca => pca(""),
            Orient::None => (DMat3::IDENTITY, "none: that of the files".into()),
        }
    }

    /// Returns the rotation to the principal axes of the positions: the largest variance along x, the smallest along z, which points to the
    /// side of the cameras' up axes; the first camera has a positive x.
    fn principal_axes(&self, cameras: &[Camera]) -> DMat3 {
        let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        let covariance = cameras.iter().map(|camera| outer((camera.position() - self.mean) / self.spread)).fold(DMat3::ZERO, |a, b| a + b);
        let [(_, smallest), _, (_, largest)] = eigen(covariance);
        let toward = |axis: DVec3, side: DVec3| if axis.dot(side) < 0.0 { -axis } else { axis };
        let (x, z) = (toward(largest, cameras[0].position() - self.mean), toward(smallest, self.up));
        DMat3::from_cols(x, z.cross(x), z).transpose()
    }

    /// Returns the point that becomes the origin, with a description. `looked_at` is [`looked_at`](Self::looked_at).
    pub fn center(&self, cameras: &[Camera], center: Center, looked_at: Option<DVec3>) -> (DVec3, String) {
        let poses = |why: &str| (self.mean, format!("poses: the mean position of the cameras{why}"));
        let focus = || focus(cameras, self.mean, self.spread);
        const FOCUS: &str = "focus: the point nearest to the optical axes";
        match center {
            Center::Auto => match looked_at {
                Some(focus) => (focus, format!("{FOCUS}, for the cameras look inwards")),
                None => poses(", for they do not look inwards"),
            },
            Center::Poses => poses(""),
            Center::Focus => match focus() {
                Some(focus) => (focus, FOCUS.into()),
                None => poses(", because the optical axes are parallel"),
            },
            Center::None => (DVec3::ZERO, "none: the origin of the files".into()),
        }
    }

    /// Returns the point that the cameras look at from around it; `None` if they do not look inwards.
    pub fn looked_at(&self, cameras: &[Camera]) -> Option<DVec3> {
        let focus = focus(cameras, self.mean, self.spread)?;
        let sees = |camera: &&Camera| (camera.position() - focus).dot(axes(camera)[2]) > 0.0;
        let inwards = cameras.iter().filter(sees).count() as f64;
        (inwards >= INWARDS * cameras.len() as f64 && focus.distance(self.mean) <= FARTHEST_FOCUS * self.spread).then_some(focus)
    }
}

/// Returns the point with the smallest sum of distances to the optical axes, by iteratively reweighted least squares; `None` if the axes
/// are parallel. A camera that looks elsewhere counts little.
fn focus(cameras: &[Camera], mean: DVec3, spread: f64) -> Option<DVec3> {
    let across = |d: DVec3| DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    let lines: Vec<(DVec3, DMat3)> = cameras.iter().map(|c| ((c.position() - mean) / spread, across(axes(c)[2]))).collect();
    let solve = |weight: &dyn Fn(DVec3, DMat3) -> f64| {
        let (mut sum, mut right, mut total) = (DMat3::ZERO, DVec3::ZERO, 0.0);
        for &(origin, across) in &lines {
            let w = weight(origin, across);
            (sum, right, total) = (sum + across * w, right + w * (across * origin), total + w);
        }
        // The determinant is 0 for parallel axes.
        ((sum * (1.0 / total)).determinant() > 1e-4).then(|| sum.inverse() * right)
    };
    let mut focus = solve(&|_, _| 1.0)?;
    for _ in 0..STEPS {
        focus = solve(&|origin, across| 1.0 / (across * (focus - origin)).length().max(1e-3))?;
    }
    Some(mean + spread * focus)
}
