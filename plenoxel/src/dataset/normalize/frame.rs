//! Geometry of a set of cameras: mean pose, up, focus, nearest depth.

use super::super::capture::Point;
use super::choice::{Center, Orient};
use super::{NEAR, NEAREST};
use crate::camera::Camera;
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
        let axes = eigenvectors(covariance);
        let toward = |axis: DVec3, side: DVec3| if axis.dot(side) < 0.0 { -axis } else { axis };
        let (x, z) = (toward(axes[0], cameras[0].position() - self.mean), toward(axes[2], self.up));
        DMat3::from_cols(x, z.cross(x), z).transpose()
    }

    /// Returns the point that becomes the origin, with a description.
    pub fn center(&self, cameras: &[Camera], center: Center) -> (DVec3, String) {
        let poses = |why: &str| (self.mean, format!("poses: the mean position of the cameras{why}"));
        let focus = || focus(cameras, self.mean, self.spread);
        const FOCUS: &str = "focus: the point nearest to the optical axes";
        match center {
            Center::Auto => match focus().filter(|focus| self.is_looked_at(cameras, *focus)) {
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

    /// Returns true if the cameras look at a point from around it.
    fn is_looked_at(&self, cameras: &[Camera], focus: DVec3) -> bool {
        let sees = |camera: &&Camera| (camera.position() - focus).dot(axes(camera)[2]) > 0.0;
        let inwards = cameras.iter().filter(sees).count() as f64;
        inwards >= INWARDS * cameras.len() as f64 && focus.distance(self.mean) <= FARTHEST_FOCUS * self.spread
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

/// Returns the eigenvectors of a symmetric matrix, of the largest eigenvalue first (Jacobi's method).
fn eigenvectors(matrix: DMat3) -> [DVec3; 3] {
    let (mut a, mut v) = (matrix, DMat3::IDENTITY);
    // Each sweep at least squares the error; 3 x 3 matrices need about six.
    for (p, q) in [(0, 1), (0, 2), (1, 2)].into_iter().cycle().take(45) {
        let off = a.col(q)[p];
        if off == 0.0 {
            continue;
        }
        let theta = 0.5 * (2.0 * off).atan2(a.col(q)[q] - a.col(p)[p]);
        let (s, c) = theta.sin_cos();
        let mut r = DMat3::IDENTITY;
        r.col_mut(p)[p] = c;
        r.col_mut(q)[q] = c;
        r.col_mut(q)[p] = s;
        r.col_mut(p)[q] = -s;
        a = r.transpose() * a * r;
        v *= r;
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a.col(j)[j].total_cmp(&a.col(i)[i]));
    order.map(|i| v.col(i))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::dvec3;

    #[test]
    fn eigenvectors_are_in_the_order_of_their_values() {
        let rotation = DMat3::from_axis_angle(dvec3(1.0, 2.0, -0.5).normalize(), 1.1);
        let matrix = rotation * DMat3::from_diagonal(dvec3(2.0, 7.0, -1.0)) * rotation.transpose();
        let found = eigenvectors(matrix);
        for (vector, (value, axis)) in found.into_iter().zip([(7.0, 1), (2.0, 0), (-1.0, 2)]) {
            assert!((matrix * vector - value * vector).length() < 1e-12);
            assert!((vector.dot(rotation.col(axis)).abs() - 1.0).abs() < 1e-12);
        }
    }
}
