//! Training rays, made on the fly: a ray is a view, a pixel and a camera, so a scene costs no more memory than its 8-bit images.

use crate::camera::Ray;
use crate::dataset::{View, has_alpha};
use crate::geometry::Aabb;
use crate::random::{Permutation, Purpose};
use crate::sampling::Occupancy;
use autograd::{Buffer, Real, Tensor, parallel};
use glam::DVec3;
use std::borrow::Cow;
use tiles::Tile;

mod tiles;

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

/// The pixels of some views, all of them or those that can see something, in an order that is shuffled anew each epoch.
#[derive(Debug)]
pub struct RaySource<'a> {
    views: Cow<'a, [View]>,
    background: [f32; 3],
    seed: u64,
    tiles: Vec<Tile>,
    /// `first[t]` is the number of pixels before tile t.
    first: Vec<u64>,
    /// The tile of every [`apart`](Self::apart)-th pixel, about as many as there are tiles: one search for a random pixel would wait for memory a
    /// dozen times.
    guide: Vec<u32>,
    /// Pixels of all views.
    pixels: u64,
}

impl<'a> RaySource<'a> {
    /// The pixels of `views` over a background.
    ///
    /// Views that are owned stay in memory as long as the source.
    pub fn new(views: impl Into<Cow<'a, [View]>>, background: [f32; 3], seed: u64) -> Self {
        let views = views.into();
        let tiles = views.iter().enumerate().map(|(v, view)| Tile::of_view(v, view)).collect();
        let mut source = RaySource { views, background, seed, tiles: Vec::new(), first: Vec::new(), guide: Vec::new(), pixels: 0 };
        source.set_tiles(tiles);
        source.pixels = source.len();
        source
    }

    fn set_tiles(&mut self, tiles: Vec<Tile>) {
        self.first = vec![0];
        for tile in &tiles {
            self.first.push(self.first[self.first.len() - 1] + tile.pixels() as u64);
        }
        self.tiles = tiles;
        let apart = self.apart();
        self.guide.clear();
        for (t, first) in self.first.windows(2).enumerate() {
            while (self.guide.len() as u64) * apart < first[1] {
                self.guide.push(t as u32);
            }
        }
    }

    /// Pixels between two entries of the guide: those of a tile in the mean.
    fn apart(&self) -> u64 {
        self.len().div_ceil(self.tiles.len().max(1) as u64).max(1)
    }

    /// From now on the pixels of the same views around the projections of what may hold matter. The others show the background whatever is
    /// learned, so they say nothing, except of the mean of the errors.
    pub fn aim_at(&mut self, matter: &Occupancy) {
        self.set_tiles(tiles::showing(&self.views, matter));
    }

    /// The views whose pixels these are, at their present size, whether rays are aimed or not.
    pub fn views(&self) -> &[View] {
        &self.views
    }

    /// The share of the pixels of the views that are in the set.
    pub fn share(&self) -> f64 {
        self.len() as f64 / self.pixels as f64
    }

    /// Rays in one epoch.
    pub fn len(&self) -> u64 {
        self.first[self.tiles.len()]
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

    /// Rays of the set through every `stride`-th column and row of the views, tile after tile, `size` at a time.
    pub fn lattice_of_rays(&self, stride: u32, size: usize) -> impl Iterator<Item = Vec<Ray>> + '_ {
        let along = move |from: u32, count: u32| (from.next_multiple_of(stride)..from + count).step_by(stride as usize);
        let of_tile = move |tile: &Tile| {
            let &Tile { view, x, y, width, height } = tile;
            along(y, height).flat_map(move |y| along(x, width).map(move |x| (view as usize, x, y)))
        };
        let mut pixels = self.tiles.iter().flat_map(of_tile);
        std::iter::from_fn(move || {
            let ray = |(v, x, y): (usize, u32, u32)| self.views[v].camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let rays: Vec<Ray> = pixels.by_ref().take(size).map(ray).collect();
            (!rays.is_empty()).then_some(rays)
        })
    }

    /// How many pixels apart rays may be so that 8 of them or more pass through a voxel of this side that all views have in sight, wherever
    /// it is in a box: as the projection of the farthest would have it.
    pub fn stride(&self, side: f64, aabb: Aabb) -> u32 {
        const RAYS: f64 = 8.0;
        let reach = 0.5 * (aabb.max - aabb.min).length();
        let pixels = self.views.iter().map(|view| {
            let k = &view.camera.intrinsics;
            k.fx.min(k.fy) * side / (view.camera.position().distance(0.5 * (aabb.min + aabb.max)) + reach)
        });
        let apart = (self.views.len() as f64 / RAYS).sqrt();
        (apart * pixels.fold(f64::INFINITY, f64::min)).clamp(1.0, 64.0) as u32
    }

    /// All rays of the set, view after view and row after row, `size` at a time.
    fn in_order(&self, size: u64) -> impl Iterator<Item = Vec<Ray>> + '_ {
        let ray = |index: u64| {
            let (v, x, y) = self.place(index);
            self.views[v].camera.ray(x as f64 + 0.5, y as f64 + 0.5)
        };
        (0..self.len().div_ceil(size)).map(move |batch| (batch * size..((batch + 1) * size).min(self.len())).map(ray).collect())
    }

    /// All rays of the set, view after view and row after row, `size` at a time, each with the alpha of its pixel. Where no
    /// view has a transparent pixel ([`has_alpha`]), alpha does not tell objects: it is 0 where the color is the background's then, else 1.
    pub fn in_order_with_alpha(&self, size: u64) -> impl Iterator<Item = (Vec<Ray>, Vec<f32>)> + '_ {
        let has_alpha = has_alpha(&self.views);
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
        let guide = self.guide[(index / self.apart()) as usize] as usize;
        let t = guide + self.first[guide + 1..].iter().take_while(|&&f| f <= index).count();
        let Tile { view, x, y, width, .. } = self.tiles[t];
        let pixel = (index - self.first[t]) as u32;
        (view as usize, (x + pixel % width) as usize, (y + pixel / width) as usize)
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
    fn every_pixel_of_tiles_of_any_size_has_its_place() {
        let views = [view(&[[0; 4]; 1000])];
        let mut source = RaySource::new(&views[..], [1.0; 3], 0);
        let tiles = [(3, 1), (4, 0), (10, 500), (600, 1), (601, 2), (700, 300)];
        source.set_tiles(tiles.map(|(x, width)| Tile { view: 0, x, y: 0, width, height: 1 }).into());
        let want: Vec<usize> = tiles.iter().flat_map(|&(x, width)| (x..x + width).map(|x| x as usize)).collect();
        assert!(source.len() == want.len() as u64 && source.guide.len() <= tiles.len());
        let places = (0..source.len()).map(|index| source.place(index));
        assert!(places.eq(want.iter().map(|&x| (0, x, 0))));
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
