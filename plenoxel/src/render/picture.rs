//! Rendering of whole images, in chunks of rays.

use super::{Field, RenderOptions, Rendered, render};
use crate::camera::{Camera, Ray};
use crate::sampling::PACKET;
use crate::space::Space;
use autograd::{Real, no_grad, parallel};
use glam::DVec3;
use ndarray::{Array2, Array3};
use std::ops::Range;

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

/// Side of the tiles of pixels that are rendered at a time, unless a model has its own ([`Model::tile`](crate::train::Model::tile)).
pub const TILE: usize = 64;

/// Renders an image of a field.
pub fn picture<T: Real>(field: &impl Field<T>, camera: &Camera, options: &RenderOptions<'_>) -> Picture {
    picture_by(|rays| render(field, rays, options), camera)
}

/// Renders an image with a function from rays to pixels. No gradient is recorded.
pub fn picture_by<T: Real>(render: impl Fn(&[Ray]) -> Rendered<T>, camera: &Camera) -> Picture {
    picture_unless(render, camera, TILE, || false).expect("nothing stops it")
}

/// Renders an image as [`picture_by`] does, in tiles of pixels with this side, rounded up to a multiple of 16. Before each tile it asks `stopped`; returns `None` once that is true.
pub fn picture_unless<T: Real>(
    render: impl Fn(&[Ray]) -> Rendered<T>,
    camera: &Camera,
    tile: usize,
    stopped: impl Fn() -> bool,
) -> Option<Picture> {
    let tile = tile.max(1).next_multiple_of(BAND);
    let [w, h] = [camera.intrinsics.width, camera.intrinsics.height];
    let (mut rgb, mut depth, mut opacity) = (vec![0.0; 3 * w * h], vec![0.0; w * h], vec![0.0; w * h]);
    // Rays of one tile, each of which is written before it is read.
    let mut rays = vec![Ray { origin: DVec3::ZERO, direction: DVec3::Z, stretch: 1.0 }; tile.min(w) * tile.min(h)];
    for y in (0..h).step_by(tile) {
        for x in (0..w).step_by(tile) {
            if stopped() {
                return None;
            }
            let (columns, rows) = (x..w.min(x + tile), y..h.min(y + tile));
            let of_band = BAND * columns.len();
            let rays = &mut rays[..columns.len() * rows.len()];
            parallel::for_each_chunk(rays, of_band, |first, rays| {
                for_pixels_of_band(&columns, y + first / columns.len(), h, |i, [x, y]| {
                    rays[i] = camera.ray(x as f64 + 0.5, y as f64 + 0.5)
                });
            });
            let rendered = no_grad(|| render(rays));
            let (of_rgb, of_depth, of_opacity) = (rendered.rgb.data(), rendered.depth(), rendered.opacity.data());
            let bands = rgb.chunks_mut(3 * BAND * w).zip(depth.chunks_mut(BAND * w)).zip(opacity.chunks_mut(BAND * w));
            let bands = bands.skip(y / BAND).take(rows.len().div_ceil(BAND));
            parallel::for_each_item(bands.collect(), |band, ((rgb, depth), opacity)| {
                let top = y + band * BAND;
                for_pixels_of_band(&columns, top, h, |i, [x, y]| {
                    let (ray, pixel) = (band * of_band + i, (y - top) * w + x);
                    let as_f32 = |x: T| x.as_f64() as f32;
                    (0..3).for_each(|c| rgb[3 * pixel + c] = as_f32(of_rgb[3 * ray + c]));
                    (depth[pixel], opacity[pixel]) = (as_f32(of_depth.data()[ray]), as_f32(of_opacity[ray]));
                });
            });
        }
    }
    let array = |values: Vec<f32>| Array2::from_shape_vec((h, w), values).expect("a value for each pixel");
    Some(Picture {
        rgb: Array3::from_shape_vec((h, w, 3), rgb).expect("three values for each pixel"),
        depth: array(depth),
        opacity: array(opacity),
    })
}

/// Rows of pixels that follow each other in a tile: two packets.
const BAND: usize = 2 * PACKET;

/// Calls `f(number, [x, y])` for the pixels of an image of `height` rows that lie in these columns and in the band of rows from `top` on. They are numbered so that
/// pixels that follow each other see nearly the same part of the scene: square after square of four packets, and packet after packet.
fn for_pixels_of_band(columns: &Range<usize>, top: usize, height: usize, mut f: impl FnMut(usize, [usize; 2])) {
    let (mut number, bottom) = (0, height.min(top + BAND));
    for left in columns.clone().step_by(BAND) {
        for y in (top..bottom).step_by(PACKET) {
            for x in (left..columns.end.min(left + BAND)).step_by(PACKET) {
                for y in y..bottom.min(y + PACKET) {
                    for x in x..columns.end.min(x + PACKET) {
                        f(number, [x, y]);
                        number += 1;
                    }
                }
            }
        }
    }
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
    use crate::render::Columns;
    use autograd::Tensor;
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    #[test]
    fn bands_have_each_pixel_of_some_columns_once() {
        for (columns, height) in [(0..1, 1), (64..128, 64), (64..65, 130), (0..100, 61)] {
            let mut found = vec![0; columns.end * height];
            for top in (0..height).step_by(BAND) {
                let mut next = 0;
                for_pixels_of_band(&columns, top, height, |i, [x, y]| {
                    assert!(columns.contains(&x) && (top..top + BAND).contains(&y) && i == next);
                    found[y * columns.end + x] += 1;
                    next += 1;
                });
            }
            let want = (0..found.len()).map(|pixel| i32::from(columns.contains(&(pixel % columns.end))));
            assert!(found.iter().copied().eq(want), "columns {columns:?} of {height} rows");
        }
        let mut pixels = Vec::new();
        for_pixels_of_band(&(0..100), 32, 100, |_, pixel| pixels.push(pixel));
        assert_eq!([64, 65, 128, 256].map(|i| pixels[i]), [[8, 32], [9, 32], [0, 40], [16, 32]]);
    }

    #[test]
    fn each_pixel_is_that_of_its_ray_whatever_the_tile() {
        #[derive(Debug)]
        struct Depth(Tensor<f64>);
        impl Columns<f64> for Depth {
            fn depth(&self) -> Tensor<f64> {
                self.0.clone()
            }
            fn sparsity(&self) -> Tensor<f64> {
                self.0.clone()
            }
            fn distortion(&self) -> Tensor<f64> {
                self.0.clone()
            }
        }
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(70, 45, 0.7));
        let calls = AtomicUsize::new(0);
        let render = |rays: &[Ray]| {
            calls.fetch_add(1, Relaxed);
            let of_rays = |f: fn(&Ray) -> f64| Tensor::from_vec(rays.iter().map(f).collect(), &[rays.len()]);
            let directions = crate::camera::directions(rays);
            let [opacity, depth] = [of_rays(|ray| ray.direction.z), of_rays(|ray| ray.stretch)];
            Rendered::new(directions, opacity.clone(), opacity, 0, Depth(depth))
        };
        for (tile, want) in [(0, 15), (16, 15), (17, 6), (64, 2), (256, 1)] {
            calls.store(0, Relaxed);
            let picture = picture_unless(render, &camera, tile, || false).expect("nothing stops it");
            assert_eq!(calls.load(Relaxed), want);
            for ((y, x), &depth) in picture.depth.indexed_iter() {
                let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                let rgb = [0, 1, 2].map(|c| picture.rgb[[y, x, c]]);
                assert_eq!(rgb, ray.direction.to_array().map(|d| d as f32), "pixel {x}, {y}");
                assert_eq!([depth, picture.opacity[[y, x]]], [ray.stretch as f32, ray.direction.z as f32], "pixel {x}, {y}");
            }
        }
        calls.store(0, Relaxed);
        assert!(picture_unless(render, &camera, 16, || calls.load(Relaxed) == 3).is_none());
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
