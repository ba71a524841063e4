//! Whole images, in chunks of rays.

use crate::camera::Camera;
use crate::field::Field;
use crate::render::{RenderOptions, render};
use autograd::{Real, no_grad};
use ndarray::{Array2, Array3};

/// A rendered image.
#[derive(Debug, Clone)]
pub struct Picture {
    /// `[h, w, 3]` sRGB, not clamped.
    pub rgb: Array3<f32>,
    /// `[h, w]` Σ wᵢ tᵢ, world length.
    pub depth: Array2<f32>,
    /// `[h, w]` in [0, 1].
    pub opacity: Array2<f32>,
}

/// Rays rendered at a time: bounds the memory.
const CHUNK: usize = 4096;
/// Side of the squares in which pixels are taken, so that rays which read the same voxels come one after another.
const TILE: usize = 16;

/// Renders what a camera sees.
pub fn picture<T: Real>(field: &impl Field<T>, camera: &Camera, options: &RenderOptions<'_>) -> Picture {
    let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
    let (mut rgb, mut depth, mut opacity) = (Array3::zeros((h, w, 3)), Array2::zeros((h, w)), Array2::zeros((h, w)));
    let pixels = tiled(w, h);
    for pixels in pixels.chunks(CHUNK) {
        let rays: Vec<_> = pixels.iter().map(|&[x, y]| camera.ray(x as f64 + 0.5, y as f64 + 0.5)).collect();
        let rendered = no_grad(|| render(field, &rays, options));
        let (c, d, o) = (rendered.rgb.data().as_chunks::<3>().0, rendered.depth(), rendered.opacity.data());
        for (i, &[x, y]) in pixels.iter().enumerate() {
            (0..3).for_each(|a| rgb[[y, x, a]] = c[i][a].as_f64() as f32);
            depth[[y, x]] = d.data()[i].as_f64() as f32;
            opacity[[y, x]] = o[i].as_f64() as f32;
        }
    }
    Picture { rgb, depth, opacity }
}

/// Every pixel (x, y) once, square after square.
fn tiled(width: usize, height: usize) -> Vec<[usize; 2]> {
    let mut pixels = Vec::with_capacity(width * height);
    for top in (0..height).step_by(TILE) {
        for left in (0..width).step_by(TILE) {
            for y in top..(top + TILE).min(height) {
                pixels.extend((left..(left + TILE).min(width)).map(|x| [x, y]));
            }
        }
    }
    pixels
}

#[cfg(test)]
mod tests {
    #[test]
    fn squares_cover_every_pixel_once() {
        for (w, h) in [(1, 1), (16, 16), (33, 17), (5, 40)] {
            let mut pixels = super::tiled(w, h);
            pixels.sort_unstable();
            let all: Vec<[usize; 2]> = (0..w).flat_map(|x| (0..h).map(move |y| [x, y])).collect();
            assert_eq!(pixels, all);
        }
    }
}
