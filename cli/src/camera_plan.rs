//! Plans of the cameras of a dataset: from above, and from the side.

use glam::{DVec2, DVec3};
use plenoxel::camera::Camera;
use plenoxel::dataset::{Dataset, Split};

/// Length of a drawn frustum, as a share of the width of a plan.
const FRUSTUM: f64 = 0.05;
/// Largest coordinate of drawn points, in units of the largest of a camera.
const POINTS_WITHIN: f64 = 2.5;

/// The plans: from above (x right, y up), and from the side (x right, z up).
pub const SIDES: [fn(DVec3) -> DVec2; 2] = [|p| DVec2::new(p.x, p.y), |p| DVec2::new(p.x, p.z)];

/// Cameras and points of a dataset, to be drawn as plans.
pub struct Plan {
    /// All cameras, split after split.
    pub cameras: Vec<(Split, Camera)>,
    /// Points of structure from motion near the cameras.
    pub points: Vec<DVec3>,
    /// A plan shows [-half, half]².
    pub half: f64,
}

impl Plan {
    pub fn of(dataset: &Dataset) -> Self {
        let cameras: Vec<(Split, Camera)> =
            Split::ALL.iter().flat_map(|split| dataset.cameras(*split).into_iter().map(|camera| (*split, camera))).collect();
        let reach = cameras.iter().map(|(_, camera)| camera.position().abs().max_element()).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
        let near = |p: &DVec3| p.abs().max_element() <= POINTS_WITHIN * reach;
        let points: Vec<DVec3> = dataset.points().iter().map(|point| point.position).filter(near).collect();
        let all = cameras.iter().map(|(_, camera)| camera.position()).chain(points.iter().copied());
        let half = 1.1 * all.map(|p| p.abs().max_element()).fold(reach, f64::max);
        Plan { cameras, points, half }
    }

    /// Returns the edges of the frustum of a camera.
    pub fn frustum(&self, camera: &Camera) -> Vec<[DVec3; 2]> {
        let (w, h) = (camera.intrinsics.width as f64, camera.intrinsics.height as f64);
        let corner = |x: f64, y: f64| {
            let ray = camera.ray(x, y);
            ray.origin + 2.0 * FRUSTUM * self.half * ray.direction
        };
        let corners = [corner(0.5, 0.5), corner(w - 0.5, 0.5), corner(w - 0.5, h - 0.5), corner(0.5, h - 0.5)];
        (0..4).flat_map(|i| [[camera.position(), corners[i]], [corners[i], corners[(i + 1) % 4]]]).collect()
    }
}
