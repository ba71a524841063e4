//! Training rays, made on the fly: a ray is a view, a pixel and a camera, so a scene costs no more memory than its 8-bit images.

use crate::camera::Ray;
use crate::dataset::{View, has_alpha};
use crate::random::{Permutation, Purpose};
use autograd::{Buffer, Real, Tensor, parallel};
use glam::DVec3;

/// Rays with what the photographs show along them.
#[derive(Debug, Clone)]
pub struct RayBatch<T: Real> {
    /// Origins and unit directions, world frame.
    pub rays: Vec<Ray>,
    /// `[n, 3]`, sRGB in [0, 1], composited over the background.
    pub target: Tensor<T>,
    /// `[n]`, in [0, 1]: how much of the pixel is object, where the images have an alpha channel; 1 where they have none.
    pub alpha: Tensor<T>,
}

impl<T: Real> RayBatch<T> {
    /// The number of rays.
    pub fn len(&self) -> usize {
        self.rays.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.rays.is_empty()
    }
}

/// Every pixel of some views, in an order that is shuffled anew each epoch.
#[derive(Debug)]
pub struct RaySource<'a> {
    views: &'a [View],
    background: [f32; 3],
    seed: u64,
    /// `first[v]` is the number of pixels before view v.
    first: Vec<u64>,
}

impl<'a> RaySource<'a> {
    /// The pixels of `views` over a background.
    pub fn new(views: &'a [View], background: [f32; 3], seed: u64) -> Self {
        let mut first = vec![0];
        for view in views {
            let (w, h) = view.image.dimensions();
            first.push(first[first.len() - 1] + u64::from(w) * u64::from(h));
        }
        RaySource { views, background, seed, first }
    }

    /// Rays in one epoch.
    pub fn len(&self) -> u64 {
        self.first[self.views.len()]
    }

    /// True if there are no pixels.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Rays number `from..from + n` of the endless sequence of epochs: a function of (seed, number) alone.
    pub fn batch<T: Real>(&self, from: u64, n: usize) -> RayBatch<T> {
        let total = self.len();
        let epochs: Vec<Permutation> = (from / total..=(from + n as u64 - 1) / total)
            .map(|epoch| Permutation::new(total, self.seed, Purpose::RayOrder, epoch))
            .collect();
        let nowhere = Ray { origin: DVec3::ZERO, direction: DVec3::ZERO, stretch: 0.0 };
        let (mut rays, mut target, mut alpha) = (vec![nowhere; n], Buffer::stale(3 * n), Buffer::stale(n));
        const RUN: usize = 512;
        let runs = rays.chunks_mut(RUN).zip(target.chunks_mut(3 * RUN)).zip(alpha.chunks_mut(RUN)).collect();
        parallel::for_each_item(runs, |run, ((rays, target), alpha)| {
            for (i, (ray, target)) in rays.iter_mut().zip(target.as_chunks_mut::<3>().0).enumerate() {
                let number = from + (run * RUN + i) as u64;
                let (found, color, a) = self.pixel(epochs[(number / total - from / total) as usize].at(number % total));
                (*ray, *target, alpha[i]) = (found, color.map(|c| T::lit(f64::from(c))), T::lit(f64::from(a)));
            }
        });
        RayBatch { rays, target: Tensor::from_buffer(target, &[n, 3]), alpha: Tensor::from_buffer(alpha, &[n]) }
    }

    /// All rays of the set, view after view and row after row, `size` at a time.
    pub fn in_order(&self, size: u64) -> impl Iterator<Item = Vec<Ray>> + '_ {
        let ray = |index: u64| {
            let (v, x, y) = self.place(index);
            self.views[v].camera.ray(x as f64 + 0.5, y as f64 + 0.5)
        };
        (0..self.len().div_ceil(size)).map(move |batch| (batch * size..((batch + 1) * size).min(self.len())).map(ray).collect())
    }

    /// The rays of [`RaySource::in_order`], each with the alpha of its pixel. Where no view has a transparent pixel ([`has_alpha`]), alpha does
    /// not tell objects: it is 0 where the color is the background's then, else 1.
    pub fn in_order_with_alpha(&self, size: u64) -> impl Iterator<Item = (Vec<Ray>, Vec<f32>)> + '_ {
        let has_alpha = has_alpha(self.views);
        let in_bytes = |color: [f32; 3]| color.map(|c| (c * 255.0).round() as u8);
        let alpha = move |index: u64| {
            let (v, x, y) = self.place(index);
            let view = &self.views[v];
            match has_alpha {
                true => view.alpha(x, y),
                false => f32::from(u8::from(in_bytes(view.color(x, y, self.background)) != in_bytes(self.background))),
            }
        };
        self.in_order(size).zip(0..).map(move |(rays, batch)| {
            let alphas = (batch * size..).take(rays.len()).map(&alpha).collect();
            (rays, alphas)
        })
    }

    /// Ray, color over the background, and alpha of one pixel of the set.
    fn pixel(&self, index: u64) -> (Ray, [f32; 3], f32) {
        let (v, x, y) = self.place(index);
        let view = &self.views[v];
        (view.camera.ray(x as f64 + 0.5, y as f64 + 0.5), view.color(x, y, self.background), view.alpha(x, y))
    }

    /// Number of the view, column and row of one pixel of the set.
    fn place(&self, index: u64) -> (usize, usize, usize) {
        let v = self.first.partition_point(|&f| f <= index) - 1;
        let (pixel, width) = ((index - self.first[v]) as usize, self.views[v].image.width() as usize);
        (v, pixel % width, pixel / width)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Intrinsics};
    use crate::dataset::image::RgbaImage;

    /// A view of some pixels in a row.
    fn view(pixels: &[[u8; 4]]) -> View {
        let intrinsics = Intrinsics::from_fov_x(pixels.len(), 1, 0.7);
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, intrinsics);
        let image = RgbaImage::from_fn(pixels.len() as u32, 1, |x, _| pixels[x as usize].into());
        View { name: String::new(), camera, image, depth: None }
    }

    #[test]
    fn a_view_full_of_object_is_judged_by_alpha_if_another_one_has_some() {
        let alphas = |views: &[View]| -> Vec<f32> {
            RaySource::new(views, [1.0; 3], 0).in_order_with_alpha(3).flat_map(|(_, alphas)| alphas).collect()
        };
        let (white, red) = ([255, 255, 255, 255], [255, 0, 0, 255]);
        // White parts of an object that fills its picture are object.
        let [full, other] = [view(&[white, red]), view(&[white, [0; 4], [9, 9, 9, 51]])];
        assert_eq!(alphas(&[full.clone(), other]), [1.0, 1.0, 1.0, 0.0, 0.2]);
        assert_eq!(alphas(&[full.clone(), full]), [0.0, 1.0, 0.0, 1.0]);
    }
}
