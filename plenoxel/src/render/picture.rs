//! Rendering of whole images, in chunks of rays.

use super::{Field, RenderOptions, Rendered, render};
use crate::camera::{Camera, Ray};
use autograd::{Real, no_grad, parallel};
use ndarray::{Array2, Array3};

/// A rendered image.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Color, `[h, w, 3]`, sRGB, not clamped.
    pub rgb: Array3<f32>,
    /// Depth Σ wᵢ tᵢ, `[h, w]`, world length.
    pub depth: Array2<f32>,
    /// Opacity, `[h, w]`, in [0, 1].
    pub opacity: Array2<f32>,
}

/// Number of rays rendered at a time. It bounds the memory.
const CHUNK: usize = 4096;

/// Renders an image of a field.
pub fn picture<T: Real>(field: &impl Field<T>, camera: &Camera, options: &RenderOptions<'_>) -> Picture {
    picture_by(|rays| render(field, rays, options), camera)
}

/// Renders an image with a function from rays to pixels. No gradient is recorded.
pub fn picture_by<T: Real>(render: impl Fn(&[Ray]) -> Rendered<T>, camera: &Camera) -> Picture {
    picture_unless(render, camera, || false).expect("nothing stops it")
}

/// Renders an image as [`picture_by`] does. Before each chunk of rays it asks `stopped`; returns `None` once that is true.
pub fn picture_unless<T: Real>(render: impl Fn(&[Ray]) -> Rendered<T>, camera: &Camera, stopped: impl Fn() -> bool) -> Option<Picture> {
    let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
    let (mut rgb, mut depth, mut opacity) = (Vec::with_capacity(3 * w * h), Vec::with_capacity(w * h), Vec::with_capacity(w * h));
    let as_f32 = |x: &T| x.as_f64() as f32;
    for start in (0..w * h).step_by(CHUNK) {
        if stopped() {
            return None;
        }
        let rays = parallel::map_indices(CHUNK.min(w * h - start), |i| {
            let pixel = start + i;
            camera.ray((pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5)
        });
        let rendered = no_grad(|| render(&rays));
        rgb.extend(rendered.rgb.data().iter().map(as_f32));
        depth.extend(rendered.depth().data().iter().map(as_f32));
        opacity.extend(rendered.opacity.data().iter().map(as_f32));
    }
    let fits = "one value per pixel";
    Some(Picture {
        rgb: Array3::from_shape_vec((h, w, 3), rgb).expect(fits),
        depth: Array2::from_shape_vec((h, w), depth).expect(fits),
        opacity: Array2::from_shape_vec((h, w), opacity).expect(fits),
    })
}
