//! Projection of the voxels of a box into an image, used by carving and for aiming rays.
//!
//! Corners are exact for any lens. The edges between them are straight for a pinhole only: the edges of a brick are measured
//! ([`Projection::bounds`]), and those of single voxels, which are a few pixels long, are taken as straight.

use crate::camera::lens::Lens;
use crate::camera::{Camera, Intrinsics};
use crate::geometry::Aabb;
use autograd::lattice::{BRICK, local_of};
use glam::{DAffine3, DQuat, DVec2, DVec3, dvec3};

/// Projection of the voxels of a box into an image.
pub struct Projection {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// x·depth, y·depth and depth of the first corner of voxel (0, 0, 0), and their increments per voxel along each axis.
    origin: DVec3,
    steps: [DVec3; 3],
    /// `None` for a pinhole.
    lens: Option<Lensed>,
}

/// Projection through a lens.
struct Lensed {
    intrinsics: Intrinsics,
    /// From voxels to camera axes.
    to_camera: DAffine3,
}

/// Pairs of corners ([`Projection::corners`]) that are joined by an edge.
pub const EDGES: [(usize, usize); 12] = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)];

impl Projection {
    /// Creates the projection of the voxels of a box into the image of a camera with this width and height in pixels.
    pub fn of(camera: &Camera, size: [usize; 2], aabb: Aabb, voxels: [usize; 3]) -> Self {
        let side = (aabb.max - aabb.min) / DVec3::from_array(voxels.map(|n| n as f64));
        let origin = homogeneous(camera, aabb.min);
        let steps = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| homogeneous(camera, aabb.min + axis * side) - origin);
        let to_world = DAffine3::from_scale_rotation_translation(side, DQuat::IDENTITY, aabb.min);
        let lens = (camera.intrinsics.lens != Lens::Pinhole)
            .then(|| Lensed { intrinsics: camera.intrinsics, to_camera: camera.camera_to_world.inverse() * to_world });
        Projection { size, origin, steps, lens }
    }

    /// Returns x·depth, y·depth and depth of a voxel's first corner; x and y in pixels. The depth is not positive for corners beside or
    /// behind the camera, and for those that the lens does not show.
    #[inline(always)]
    pub fn corner(&self, voxel: [usize; 3]) -> DVec3 {
        let [x, y, z] = voxel.map(|k| k as f64);
        match &self.lens {
            None => self.origin + x * self.steps[0] + y * self.steps[1] + z * self.steps[2],
            Some(lens) => lens.at(dvec3(x, y, z)),
        }
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

    /// Returns a rectangle that contains the projection of a box of voxels and a margin around it; `None` if a corner is not in front of the
    /// camera. Through a lens, edges are curves: the rectangle is enlarged by twice the largest distance of an edge's middle from the line
    /// between its ends.
    #[inline(always)]
    pub fn bounds(&self, low: [usize; 3], high: [usize; 3], margin: f64) -> Option<Rectangle> {
        let corners = self.corners(low, high)?;
        match &self.lens {
            None => Some(Rectangle::around(&corners, margin)),
            Some(lens) => Some(Rectangle::around(&corners, margin + 2.0 * lens.bulge(low, high, &corners)?)),
        }
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

impl Lensed {
    /// Returns x·depth, y·depth and depth of a point in units of voxels.
    #[inline(never)]
    fn at(&self, point: DVec3) -> DVec3 {
        let local = self.to_camera.transform_point3(point);
        match self.intrinsics.project(local) {
            Some((x, y, _)) => -local.z * dvec3(x, y, 1.0),
            None => DVec3::NEG_Z,
        }
    }

    /// Returns the largest distance in pixels of the image of an edge's middle from the line between its ends; `None` if it has no image.
    fn bulge(&self, low: [usize; 3], high: [usize; 3], corners: &[[f64; 2]; 8]) -> Option<f64> {
        let corner = |c: usize| DVec3::from_array([0, 1, 2].map(|a| if c >> a & 1 == 1 { high[a] } else { low[a] } as f64));
        EDGES.iter().try_fold(0.0_f64, |most, &(i, j)| {
            let middle = self.at(0.5 * (corner(i) + corner(j)));
            let (from, to) = (DVec2::from_array(corners[i]), DVec2::from_array(corners[j]));
            let across = (to - from).perp().normalize_or_zero();
            (middle.z > 0.0).then(|| most.max(across.dot(middle.truncate() / middle.z - from).abs()))
        })
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

/// Returns x·depth, y·depth and depth of a point in a pinhole camera, x and y in pixels. The result is linear in the point.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bounds_of_a_brick_hold_all_that_a_lens_shows_of_it() {
        let (aabb, voxels) = (Aabb { min: DVec3::new(-1.0, -1.2, -0.8), max: DVec3::new(1.0, 0.9, 1.1) }, [16, 20, 12]);
        let side = (aabb.max - aabb.min) / DVec3::new(16.0, 20.0, 12.0);
        let lenses = [
            Lens::Pinhole,
            Lens::perspective([-0.25, 0.06, 0.0, 0.0], [0.0; 3], [0.002, -0.003]),
            Lens::fisheye([0.03, -0.01, 0.0, 0.0], [0.0; 2], [0.0; 2]),
            Lens::Fov { omega: 0.9 },
        ];
        for (lens, eye) in lenses.into_iter().flat_map(|lens| [(lens, DVec3::new(2.0, -1.5, 1.0)), (lens, DVec3::new(0.3, 0.2, 0.1))]) {
            let intrinsics = Intrinsics { lens, ..Intrinsics::centred(400, 300, 260.0) };
            let camera = Camera::look_at(eye, DVec3::new(-0.2, 0.1, 0.0), DVec3::Z, intrinsics);
            let projection = Projection::of(&camera, [400, 300], aabb, voxels);
            let (mut shown, mut tight) = (0, 0);
            for brick in 0..4 * 5 * 3 {
                let low = [brick / 15 * 4, brick / 3 % 5 * 4, brick % 3 * 4];
                let Some(bounds) = projection.bounds(low, low.map(|k| k + 4), 0.0) else { continue };
                let Rectangle { low: [left, top], high: [right, bottom] } = bounds;
                let (mut least, mut most) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
                for point in 0..9 * 9 * 9 {
                    let at = [point / 81, point / 9 % 9, point % 9].map(|k| 0.5 * f64::from(k));
                    let world = aabb.min + side * (DVec3::from_array(low.map(|k| k as f64)) + DVec3::from_array(at));
                    let (x, y, _) = camera.project(world).expect("a point between visible corners");
                    (least, most) = (least.min(DVec2::new(x, y)), most.max(DVec2::new(x, y)));
                    assert!(
                        (left - 1e-9..=right + 1e-9).contains(&x) && (top - 1e-9..=bottom + 1e-9).contains(&y),
                        "{lens:?} {low:?} {at:?}"
                    );
                }
                shown += 1;
                let extent = most - least;
                tight += usize::from(right - left < 1.2 * extent.x + 1.0 && bottom - top < 1.2 * extent.y + 1.0);
                let corner = projection.corner(low);
                let (x, y, _) = camera.project(aabb.min + side * DVec3::from_array(low.map(|k| k as f64))).expect("a visible corner");
                assert!((corner.x / corner.z - x).hypot(corner.y / corner.z - y) < 1e-9);
            }
            let is_outside = eye.length() > 1.0;
            assert!(shown >= 10 && (10 * tight >= 9 * shown || !is_outside), "{lens:?}: {tight} of {shown} are tight");
        }
    }
}
