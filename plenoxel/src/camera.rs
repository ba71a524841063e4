//! Camera conventions. All other modules use this one.
//!
//! World coordinates are those of the dataset. Camera axes are those of OpenGL: x right, y up, the camera looks along -z. Pixel coordinates
//! run x right and y *down* from the top left corner of the image, so the centre of pixel (i, j) is (i + 0.5, j + 0.5). Ray directions have
//! unit length: t along a ray is world distance.

pub mod lens;
pub mod placement;
pub(crate) mod projection;
mod tracked;

use autograd::{Real, Tensor};
use glam::{DAffine3, DMat3, DVec2, DVec3};
use lens::Lens;
pub use tracked::TrackedRays;

/// Image size, focal lengths and principal point in pixels, and the lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Horizontal principal point in pixels from the left edge.
    pub cx: f64,
    /// Vertical principal point in pixels from the top edge.
    pub cy: f64,
    /// Lens. Its parameters are in focal lengths, so they do not depend on the size of the image.
    pub lens: Lens,
}

impl Intrinsics {
    /// Creates intrinsics of a pinhole with square pixels and a centred principal point from the horizontal field of view in radians: f = W / (2 tan(fov
    /// / 2)), c = (W / 2, H / 2).
    pub fn from_fov_x(width: usize, height: usize, fov_x: f64) -> Self {
        Self::centred(width, height, 0.5 * width as f64 / (0.5 * fov_x).tan())
    }

    /// Creates intrinsics of a pinhole with square pixels and a centred principal point from the focal length in pixels.
    pub fn centred(width: usize, height: usize, focal: f64) -> Self {
        Intrinsics { width, height, fx: focal, fy: focal, cx: 0.5 * width as f64, cy: 0.5 * height as f64, lens: Lens::Pinhole }
    }

    /// Returns the horizontal field of view in radians, 2 atan(W / (2 fx)): the inverse of [`Intrinsics::from_fov_x`]. The lens is ignored.
    pub fn fov_x(&self) -> f64 {
        2.0 * (0.5 * self.width as f64 / self.fx).atan()
    }

    /// Returns the intrinsics of an image reduced by k, whose pixels are the means of `k` x `k` pixels: every parameter is divided by k, but
    /// those of the lens.
    /// Rays through pixel *centres* then pass through the centres of the blocks. `k` must not be 0 and should divide width and height;
    /// otherwise incomplete blocks at the right and bottom are dropped.
    pub fn downscaled(&self, k: usize) -> Self {
        let s = k as f64;
        Intrinsics {
            width: self.width / k,
            height: self.height / k,
            fx: self.fx / s,
            fy: self.fy / s,
            cx: self.cx / s,
            cy: self.cy / s,
            lens: self.lens,
        }
    }

    /// Returns the intrinsics of an image of the same view with other numbers of pixels.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let [x, y] = [width as f64 / self.width as f64, height as f64 / self.height as f64];
        Intrinsics { width, height, fx: self.fx * x, fy: self.fy * y, cx: self.cx * x, cy: self.cy * y, lens: self.lens }
    }

    /// Returns the direction, in camera axes, in which a point of the image in pixels is seen: of z = -1, or of length 1 for a fisheye.
    ///
    /// Panics at points that no direction reaches ([`Intrinsics::check_lens`]).
    #[inline]
    fn direction(&self, x: f64, y: f64) -> DVec3 {
        match self.lens {
            Lens::Pinhole => DVec3::new((x - self.cx) / self.fx, -(y - self.cy) / self.fy, -1.0),
            _ => self.direction_through_lens(x, y),
        }
    }

    #[inline(never)]
    fn direction_through_lens(&self, x: f64, y: f64) -> DVec3 {
        let point = DVec2::new((x - self.cx) / self.fx, (y - self.cy) / self.fy);
        match self.lens.undistort(point) {
            Some(d) => DVec3::new(d.x, -d.y, -d.z),
            None => panic!("the point ({x}, {y}) is beyond the fold of the lens: Intrinsics::check_lens refuses such cameras"),
        }
    }

    /// Projects a point in camera axes. Returns pixel coordinates and depth, like [`Camera::project`].
    #[inline]
    pub(crate) fn project(&self, local: DVec3) -> Option<(f64, f64, f64)> {
        let depth = -local.z;
        if matches!(self.lens, Lens::Pinhole) {
            return (depth > 0.0).then(|| (self.cx + self.fx * local.x / depth, self.cy - self.fy * local.y / depth, depth));
        }
        let point = self.lens.distort(DVec3::new(local.x, -local.y, depth))?;
        let depth = if let Lens::Fisheye(_) = self.lens { local.length() } else { depth };
        Some((self.cx + self.fx * point.x, self.cy + self.fy * point.y, depth))
    }
}

/// Returns true for valid fields of view of a pinhole camera in radians: the tangent of half the angle must be finite and not 0.
pub(crate) fn is_angle_of_view(radians: f64) -> bool {
    const LEAST: f64 = 1e-6;
    (LEAST..std::f64::consts::PI - LEAST).contains(&radians)
}

/// Ray from a camera through a point of its image, in world coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Position of the camera.
    pub origin: DVec3,
    /// Unit direction.
    pub direction: DVec3,
    /// Length of the direction before normalisation, when its camera z was -1. t / stretch is the depth along the optical axis. The stretch
    /// is 1 in the image centre and grows towards the corners. For a fisheye, whose rays may be at right angles to the axis, it is 1: depth
    /// is the distance from the camera.
    pub stretch: f64,
}

/// Returns the directions of rays, `[n, 3]`.
pub(crate) fn directions<T: Real>(rays: &[Ray]) -> Tensor<T> {
    let directions: Vec<[T; 3]> = rays.iter().map(|ray| ray.direction.to_array().map(T::lit)).collect();
    Tensor::from_vec(directions.into_flattened(), &[rays.len(), 3])
}

/// Camera: intrinsics and pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Image size, focal lengths, principal point, lens.
    pub intrinsics: Intrinsics,
    /// Camera-to-world transform: a rotation whose columns are the camera's right, up and backward axes, and the camera's position.
    pub camera_to_world: DAffine3,
}

/// Returns the mean width of a pixel, world length, at the middle of a box with this half width: max(d, half width) / f for a camera at the distance d with the focal
/// length f, in pixels. NaN without cameras.
pub(crate) fn mean_pixel_width<'c>(cameras: impl IntoIterator<Item = &'c Camera>, middle: DVec3, half_width: f64) -> f64 {
    let width = |camera: &Camera| camera.position().distance(middle).max(half_width) / camera.intrinsics.fx.min(camera.intrinsics.fy);
    let (sum, count) = cameras.into_iter().map(width).fold((0.0, 0.0), |(sum, count), width| (sum + width, count + 1.0));
    sum / count
}

impl Camera {
    /// Creates a camera at `eye` with `target` in the middle of its image and `up` pointing up in it. If `up` is parallel to the line of
    /// sight, an arbitrary perpendicular direction is used.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3, intrinsics: Intrinsics) -> Self {
        let backward = (eye - target).normalize();
        let right = up.cross(backward).try_normalize().unwrap_or_else(|| backward.any_orthonormal_vector());
        let rotation = DMat3::from_cols(right, backward.cross(right), backward);
        Camera { intrinsics, camera_to_world: DAffine3::from_mat3_translation(rotation, eye) }
    }

    /// Returns the camera's position in the world.
    pub fn position(&self) -> DVec3 {
        self.camera_to_world.translation
    }

    /// Returns the ray through the point (`x`, `y`) of the image, in pixel coordinates. The ray through the centre of pixel (i, j) is
    /// `ray(i + 0.5, j + 0.5)`. The direction of a pinhole is R ((x - cx)/fx, -(y - cy)/fy, -1), normalised; other lenses: [`lens`].
    ///
    /// Panics at points that the lens does not reach. Images of a camera that [`Intrinsics::check_lens`] accepts have none.
    #[inline]
    pub fn ray(&self, x: f64, y: f64) -> Ray {
        let direction = self.camera_to_world.transform_vector3(self.intrinsics.direction(x, y));
        let stretch = direction.length();
        Ray { origin: self.camera_to_world.translation, direction: direction / stretch, stretch }
    }

    /// Projects the world point `p`. Returns `(x, y, depth)`: pixel coordinates, and depth along the optical axis, of a fisheye the distance
    /// from the camera (the distance along the ray is the depth times the ray's stretch). Returns `None` for points that the lens does not
    /// show: beyond its fold, and unless it is a fisheye beside or behind the camera (depth <= 0). Points outside of the image have
    /// coordinates outside of it.
    pub fn project(&self, p: DVec3) -> Option<(f64, f64, f64)> {
        self.intrinsics.project(self.camera_to_world.inverse().transform_point3(p))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn synthetic() -> Intrinsics {
        Intrinsics::from_fov_x(800, 800, 0.6911112070083618)
    }

    #[test]
    fn focal_length_of_the_synthetic_scenes_is_1111_pixels() {
        // 400 / tan(0.3455556...) = 1111.111; the scenes were rendered with a 50 mm lens on a 36 mm sensor: 800 * 50 / 36.
        assert!((synthetic().fx - 800.0 * 50.0 / 36.0).abs() < 1e-4);
        assert!((synthetic().fov_x() - 0.6911112070083618).abs() < 1e-15);
    }

    #[test]
    fn image_axes_follow_the_camera_axes() {
        let camera = Camera { intrinsics: synthetic(), camera_to_world: DAffine3::IDENTITY };
        assert_eq!(camera.ray(400.0, 400.0).direction, DVec3::NEG_Z);
        let corner = camera.ray(0.0, 0.0); // top left: left is -x, up is +y
        assert!(corner.direction.x < 0.0 && corner.direction.y > 0.0 && corner.direction.z < 0.0);
        // At the corner both offsets are 400 / 1111.111 = 0.36: stretch = sqrt(1 + 2 * 0.36^2).
        assert!((corner.stretch - (1.0 + 2.0 * 0.36_f64.powi(2)).sqrt()).abs() < 1e-7);
        assert!((corner.direction.length() - 1.0).abs() < 1e-15);
    }

    #[test]
    fn look_at_puts_the_target_in_the_middle_and_up_upwards() {
        let camera = Camera::look_at(DVec3::new(3.0, -2.0, 1.5), DVec3::new(0.2, 0.1, -0.3), DVec3::Z, synthetic());
        let (x, y, depth) = camera.project(DVec3::new(0.2, 0.1, -0.3)).unwrap();
        assert!((x - 400.0).abs() < 1e-9 && (y - 400.0).abs() < 1e-9);
        assert!((depth - DVec3::new(2.8, -2.1, 1.8).length()).abs() < 1e-12);
        assert!(camera.project(DVec3::new(0.2, 0.1, 0.0)).unwrap().1 < 400.0);
        assert!((camera.camera_to_world.matrix3.determinant() - 1.0).abs() < 1e-12);
        assert_eq!(camera.project(DVec3::new(6.0, -4.0, 3.0)), None);
    }

    #[test]
    fn looking_straight_down_is_a_proper_camera() {
        let camera = Camera::look_at(DVec3::Z * 4.0, DVec3::ZERO, DVec3::Z, synthetic());
        assert!((camera.camera_to_world.matrix3.determinant() - 1.0).abs() < 1e-12);
        assert!((camera.ray(400.0, 400.0).direction - DVec3::NEG_Z).length() < 1e-12);
    }

    #[test]
    fn a_point_on_a_ray_projects_to_the_pixel_of_the_ray() {
        let camera = Camera::look_at(DVec3::new(-1.0, 3.5, 2.0), DVec3::ZERO, DVec3::Z, synthetic());
        for (x, y) in [(0.5, 0.5), (799.5, 12.5), (321.25, 654.75)] {
            let ray = camera.ray(x, y);
            let (px, py, depth) = camera.project(ray.origin + 2.5 * ray.direction).unwrap();
            assert!((px - x).abs() < 1e-9 && (py - y).abs() < 1e-9);
            assert!((depth * ray.stretch - 2.5).abs() < 1e-12);
        }
    }

    #[test]
    fn downscaling_keeps_the_ray_through_the_middle_of_a_block() {
        let camera = Camera::look_at(DVec3::new(2.0, 2.0, 2.0), DVec3::ZERO, DVec3::Z, synthetic());
        let small = Camera { intrinsics: camera.intrinsics.downscaled(8), ..camera };
        assert_eq!((small.intrinsics.width, small.intrinsics.height), (100, 100));
        // Block (3, 5) covers x in [24, 32) and y in [40, 48): its middle is (28, 44).
        let (a, b) = (small.ray(3.5, 5.5), camera.ray(28.0, 44.0));
        assert!((a.direction - b.direction).length() < 1e-15);
    }
}
