//! Rendering of whole images, in chunks of rays.

use super::{Field, RenderOptions, Rendered, render};
use crate::camera::{Camera, Ray};
use crate::sampling::PACKET;
use crate::space::Space;
use autograd::{Real, no_grad, parallel};
use ndarray::{Array2, Array3};

/// A rendered image.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Color, `[h, w, 3]`, sRGB, not clamped.
    pub rgb: Array3<f32>,
    /// Depth Σ wᵢ tᵢ, `[h, w]`, with the t of the space of the field's box ([`Samples`](crate::sampling::Samples)).
    pub depth: Array2<f32>,
    /// Opacity, `[h, w]`, in [0, 1].
    pub opacity: Array2<f32>,
}

impl Picture {
    /// Returns the image with `[width, height]` pixels, each equal to the one at its place.
    pub(crate) fn enlarged(&self, [width, height]: [usize; 2]) -> Picture {
        let (h, w) = self.depth.dim();
        let place = |y: usize, x: usize| [y * h / height, x * w / width];
        let channel = |of: &Array2<f32>| Array2::from_shape_fn((height, width), |(y, x)| of[place(y, x)]);
        Picture {
            rgb: Array3::from_shape_fn((height, width, 3), |(y, x, c)| {
                let [y, x] = place(y, x);
                self.rgb[[y, x, c]]
            }),
            depth: channel(&self.depth),
            opacity: channel(&self.opacity),
        }
    }

    /// Returns the distance along each ray to the mean depth, `[h, w]`, world length: infinite at infinity, not a number where the picture is empty. `space` is
    /// that of the box of the field.
    pub fn distances(&self, camera: &Camera, space: Space) -> Array2<f32> {
        Array2::from_shape_fn(self.depth.dim(), |(y, x)| {
            // 0 / 0 is not a number.
            let t = f64::from(self.depth[[y, x]] / self.opacity[[y, x]]);
            if t.is_nan() { f32::NAN } else { space.distance(&camera.ray(x as f64 + 0.5, y as f64 + 0.5), t) as f32 }
        })
    }
}

/// Side of the squares of pixels that are rendered at a time. It bounds the memory.
const TILE: usize = 64;

/// Renders an image of a field.
pub fn picture<T: Real>(field: &impl Field<T>, camera: &Camera, options: &RenderOptions<'_>) -> Picture {
    picture_by(|rays| render(field, rays, options), camera)
}

/// Renders an image with a function from rays to pixels. No gradient is recorded.
pub fn picture_by<T: Real>(render: impl Fn(&[Ray]) -> Rendered<T>, camera: &Camera) -> Picture {
    picture_unless(render, camera, || false).expect("nothing stops it")
}

/// Renders an image as [`picture_by`] does. Before each tile of rays it asks `stopped`; returns `None` once that is true.
pub fn picture_unless<T: Real>(render: impl Fn(&[Ray]) -> Rendered<T>, camera: &Camera, stopped: impl Fn() -> bool) -> Option<Picture> {
    let size = [camera.intrinsics.width, camera.intrinsics.height];
    let [w, h] = size;
    let mut picture = Picture { rgb: Array3::zeros((h, w, 3)), depth: Array2::zeros((h, w)), opacity: Array2::zeros((h, w)) };
    for corner in (0..h).step_by(TILE).flat_map(|y| (0..w).step_by(TILE).map(move |x| [x, y])) {
        if stopped() {
            return None;
        }
        let pixels = pixels_of_tile(corner, size);
        let rays = parallel::map_indices(pixels.len(), |i| camera.ray(pixels[i][0] as f64 + 0.5, pixels[i][1] as f64 + 0.5));
        let rendered = no_grad(|| render(&rays));
        let (rgb, depth, opacity) = (rendered.rgb.data(), rendered.depth(), rendered.opacity.data());
        let as_f32 = |x: T| x.as_f64() as f32;
        for (i, &[x, y]) in pixels.iter().enumerate() {
            (0..3).for_each(|c| picture.rgb[[y, x, c]] = as_f32(rgb[3 * i + c]));
            picture.depth[[y, x]] = as_f32(depth.data()[i]);
            picture.opacity[[y, x]] = as_f32(opacity[i]);
        }
    }
    Some(picture)
}

/// Returns the pixels of a tile that lie in an image, packet after packet, so that rays that follow each other see nearly the same part of the scene.
fn pixels_of_tile(corner: [usize; 2], size: [usize; 2]) -> Vec<[usize; 2]> {
    let range = |a: usize, from: usize, side: usize| from..(from + side).min(size[a]).min(corner[a] + TILE);
    let packets = range(1, corner[1], TILE).step_by(PACKET).flat_map(|y| range(0, corner[0], TILE).step_by(PACKET).map(move |x| [x, y]));
    let pixels = |[x, y]: [usize; 2]| range(1, y, PACKET).flat_map(move |y| range(0, x, PACKET).map(move |x| [x, y]));
    packets.flat_map(pixels).collect()
}

/// Returns the rays of `count` packets of pixels, at places that fill the images of some cameras evenly, also the first ones of them.
pub(crate) fn sampled_packets(cameras: &[Camera], count: usize) -> Vec<Ray> {
    // Steps of an additive sequence that fills the cube evenly: powers of the inverse of the root of x⁴ = x + 1.
    const STEPS: [f64; 3] = [0.819_172_513_396_164_5, 0.671_043_606_703_789_3, 0.549_700_477_901_970_3];
    let packet = |k: usize| {
        let at = |axis: usize, count: usize| ((0.5 + k as f64 * STEPS[axis]).fract() * count as f64) as usize;
        let camera = &cameras[at(2, cameras.len())];
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        let corner = |axis: usize| at(axis, (size[axis] + 1).saturating_sub(PACKET).max(1));
        let [x, y] = [corner(0), corner(1)];
        let side = move |axis: usize| PACKET.min(size[axis]);
        (0..side(1)).flat_map(move |j| (0..side(0)).map(move |i| camera.ray((x + i) as f64 + 0.5, (y + j) as f64 + 0.5)))
    };
    (0..count).flat_map(packet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::DVec3;

    #[test]
    fn tiles_have_each_pixel_of_an_image_once() {
        for size in [[1, 1], [64, 64], [65, 130], [100, 61]] {
            let mut found = vec![0; size[0] * size[1]];
            for corner in (0..size[1]).step_by(TILE).flat_map(|y| (0..size[0]).step_by(TILE).map(move |x| [x, y])) {
                pixels_of_tile(corner, size).into_iter().for_each(|[x, y]| found[y * size[0] + x] += 1);
            }
            assert!(found.iter().all(|&count| count == 1), "{size:?}");
        }
        assert_eq!(pixels_of_tile([0, 0], [100, 100])[64..66], [[8, 0], [9, 0]]);
    }

    #[test]
    fn sampled_packets_are_pixels_of_all_cameras_spread_over_their_images() {
        let camera = |width, height| Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(width, height, 0.7));
        let cameras = [camera(100, 61), camera(5, 3)];
        let rays = sampled_packets(&cameras, 64);
        let small = rays.iter().filter(|ray| ray.direction == cameras[1].ray(0.5, 0.5).direction).count();
        assert!((28..=36).contains(&small) && rays.len() == small * 15 + (64 - small) * 64, "{small} packets of the small image");
        let place = |ray: &Ray| cameras[0].project(ray.origin + ray.direction).expect("it is seen");
        let places: Vec<_> = sampled_packets(&cameras[..1], 64).iter().map(place).collect();
        assert!(places.iter().all(|(x, y, _)| (x.fract() - 0.5).abs() < 1e-9 && (y.fract() - 0.5).abs() < 1e-9));
        for (quarter, [x, y]) in [[0.0, 0.0], [50.0, 0.0], [0.0, 30.5], [50.0, 30.5]].into_iter().enumerate() {
            let inside = places.iter().filter(|(u, v, _)| (x..x + 50.0).contains(u) && (y..y + 30.5).contains(v)).count();
            assert!((768..1280).contains(&inside), "quarter {quarter}: {inside}");
        }
    }
}
