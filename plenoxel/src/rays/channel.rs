//! Additional values of pixels: depth, and user-defined channels.

use super::RayBatch;
use crate::dataset::View;
use autograd::{Buffer, Real, Tensor, parallel};
use ndarray::Array3;
use std::sync::Arc;

/// Named values of every pixel of the views at full size.
#[derive(Debug, Clone)]
pub struct Channel {
    pub name: String,
    /// Images `[height, width, c]`, one per view.
    images: Arc<[Array3<f32>]>,
    /// Number of values per pixel, c.
    width: usize,
}

impl Channel {
    /// Creates a channel. Panics unless there is one image per view, of the view's size, and all have the same number of channels, at least
    /// one.
    #[track_caller]
    pub fn new(name: String, images: Arc<[Array3<f32>]>, views: &[View]) -> Self {
        assert!(images.len() == views.len(), "channel `{name}`: {} images for {} views", images.len(), views.len());
        let width = images.first().map_or(1, |image| image.dim().2);
        assert!(width > 0, "channel `{name}`: images of shape {:?} have no channels", images[0].dim());
        for (v, (image, view)) in images.iter().zip(views).enumerate() {
            let (w, h) = view.image.dimensions();
            let (found, expected) = (image.dim(), (h as usize, w as usize, width));
            assert!(found == expected, "channel `{name}`, view {v} ({}): the image has shape {found:?}, expected {expected:?}", view.name);
        }
        Channel { name, images, width }
    }

    /// Returns the values of the pixels of a batch, `[n, width]`.
    pub fn at<T: Real>(&self, batch: &RayBatch<T>, block: impl Fn(usize) -> usize + Sync) -> Tensor<T> {
        let values = gathered(batch, self.width, block, |v, [x, y], c| self.images[v][[y, x, c]]);
        Tensor::from_buffer(values, &[batch.len(), self.width])
    }
}

/// Returns the depth of the pixels of a batch, `[n]`; NaN if a view has no depth image.
pub fn depth<T: Real>(batch: &RayBatch<T>, views: &[View], block: impl Fn(usize) -> usize + Sync) -> Tensor<T> {
    let at = |v: usize, [x, y]: [usize; 2], _| views[v].depth.as_ref().map_or(f32::NAN, |depth| depth[[y, x]]);
    Tensor::from_buffer(gathered(batch, 1, block, at), &[batch.len()])
}

/// Gathers `width` values for each pixel of a batch. `block` returns the reduction k of a view; a reduced pixel gets the mean over its k ×
/// k pixels. `at` returns the c-th value of a pixel of a full image.
fn gathered<T: Real>(
    batch: &RayBatch<T>,
    width: usize,
    block: impl Fn(usize) -> usize + Sync,
    at: impl Fn(usize, [usize; 2], usize) -> f32 + Sync,
) -> Buffer<T> {
    let mut values = Buffer::stale(batch.len() * width);
    parallel::for_each_rows(&mut values, width, |first, rows| {
        for (i, row) in rows.chunks_exact_mut(width).enumerate() {
            let (v, [x, y]) = (batch.view[first + i] as usize, batch.pixel[first + i].map(|p| p as usize));
            let k = block(v);
            for (c, value) in row.iter_mut().enumerate() {
                let of_block = (y * k..(y + 1) * k).flat_map(|y| (x * k..(x + 1) * k).map(move |x| [x, y]));
                *value = T::lit(of_block.map(|place| f64::from(at(v, place, c))).sum::<f64>() / (k * k) as f64);
            }
        }
    });
    values
}
