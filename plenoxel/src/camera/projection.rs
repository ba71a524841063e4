//! Projection of the voxels of a box into an image, used by carving and for aiming rays.

use crate::camera::Camera;
use crate::geometry::Aabb;
use autograd::lattice::{BRICK, local_of};
use glam::{DVec3, dvec3};

/// Projection of the voxels of a box into an image.
pub struct Projection {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// x·depth, y·depth and depth of the first corner of voxel (0, 0, 0), and their increments per voxel along each axis.
    origin: DVec3,
    steps: [DVec3; 3],
}

impl Projection {
    /// Creates the projection of the voxels of a box into the image of a camera with this width and height in pixels.
    pub fn of(camera: &Camera, size: [usize; 2], aabb: Aabb, voxels: [usize; 3]) -> Self {
        let side = (aabb.max - aabb.min) / DVec3::from_array(voxels.map(|n| n as f64));
        let origin = homogeneous(camera, aabb.min);
        let steps = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| homogeneous(camera, aabb.min + axis * side) - origin);
        Projection { size, origin, steps }
    }

    /// Returns x·depth, y·depth and depth of a voxel's first corner; x and y in pixels.
    #[inline(always)]
    pub fn corner(&self, voxel: [usize; 3]) -> DVec3 {
        let [x, y, z] = voxel.map(|k| k as f64);
        self.origin + x * self.steps[0] + y * self.steps[1] + z * self.steps[2]
    }

    /// Returns the projected corners of a box of voxels, from `low` to one beyond the last voxel; `None` if a corner is not in front of the
    /// camera. Bit a of a corner's number is set for the higher corner along axis a.
    #[inline(always)]
    pub fn corners(&self, low: [usize; 3], high: [usize; 3]) -> Option<[[f64; 2]; 8]> {
        let mut corners = [[0.0; 2]; 8];
        for (c, corner) in corners.iter_mut().enumerate() {
            let p = self.corner([0, 1, 2].map(|a| if c >> a & 1 == 1 { high[a] } else { low[a] }));
            if p.z <= 0.0 {
                return None;
            }
            *corner = [p.x / p.z, p.y / p.z];
        }
        Some(corners)
    }

    /// Returns the projected corners of all voxels of a brick whose first voxel is `low`. Neighbouring voxels share corners.
    #[inline(always)]
    pub fn corners_in_brick(&self, low: [usize; 3]) -> BrickCorners {
        let mut corners = [[[[0.0; 2]; BRICK + 1]; BRICK + 1]; BRICK + 1];
        for (i, plane) in corners.iter_mut().enumerate() {
            for (j, line) in plane.iter_mut().enumerate() {
                for (k, corner) in line.iter_mut().enumerate() {
                    let p = self.corner([low[0] + i, low[1] + j, low[2] + k]);
                    *corner = if p.z > 0.0 { [p.x / p.z, p.y / p.z] } else { [f64::NAN; 2] };
                }
            }
        }
        BrickCorners(corners)
    }

    /// Returns the pixels of the image that a rectangle touches; empty if it is outside of the image.
    #[inline(always)]
    pub fn touched(&self, rectangle: Rectangle) -> Pixels {
        let along = |a: usize| {
            let end = self.size[a] as f64;
            let low = rectangle.low[a].floor().clamp(0.0, end) as usize;
            (low, ((rectangle.high[a].floor() + 1.0).clamp(0.0, end) as usize).max(low))
        };
        Pixels { x: along(0), y: along(1) }
    }
}

/// Projected corners of all voxels of a brick; NaN for corners that are not in front of the camera.
pub struct BrickCorners([[[[f64; 2]; BRICK + 1]; BRICK + 1]; BRICK + 1]);

impl BrickCorners {
    /// Returns the corners of a voxel, given by its bit, in the order of [`Projection::corners`].
    #[inline(always)]
    pub fn of(&self, bit: usize) -> Option<[[f64; 2]; 8]> {
        let [x, y, z] = local_of(bit);
        let corners = std::array::from_fn(|c| self.0[x + (c & 1)][y + (c >> 1 & 1)][z + (c >> 2)]);
        corners.iter().all(|corner: &[f64; 2]| !corner[0].is_nan()).then_some(corners)
    }
}

/// Returns x·depth, y·depth and depth of a point in a camera, x and y in pixels. The result is linear in the point.
fn homogeneous(camera: &Camera, point: DVec3) -> DVec3 {
    let k = &camera.intrinsics;
    let local = camera.camera_to_world.inverse().transform_point3(point);
    let depth = -local.z;
    dvec3(k.fx * local.x + k.cx * depth, -k.fy * local.y + k.cy * depth, depth)
}

/// Rectangle in an image, in pixel coordinates.
#[derive(Clone, Copy, Debug)]
pub struct Rectangle {
    /// Left and top.
    pub low: [f64; 2],
    /// Right and bottom.
    pub high: [f64; 2],
}

/// Columns and rows of pixels, each from the first to one beyond the last.
#[derive(Clone, Copy, Debug)]
pub struct Pixels {
    pub x: (usize, usize),
    pub y: (usize, usize),
}

impl Pixels {
    /// Returns the number of pixels.
    #[inline(always)]
    pub fn area(self) -> usize {
        (self.x.1 - self.x.0) * (self.y.1 - self.y.0)
    }
}

impl Rectangle {
    /// Returns the bounding rectangle of some points, enlarged by a margin.
    #[inline(always)]
    pub fn around(points: &[[f64; 2]; 8], margin: f64) -> Self {
        let along = |a: usize, f: fn(f64, f64) -> f64| points.iter().map(|p| p[a]).reduce(f).unwrap_or(f64::NAN);
        Rectangle { low: [0, 1].map(|a| along(a, f64::min) - margin), high: [0, 1].map(|a| along(a, f64::max) + margin) }
    }
}
