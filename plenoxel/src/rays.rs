//! Training rays, generated from view, pixel and camera when needed. A scene needs only the memory of its 8-bit images.

mod batch;
mod channel;
mod importance;
mod patches;
#[cfg(test)]
mod tests;
mod tiles;

pub use batch::RayBatch;

use crate::camera::Ray;
use crate::dataset::{View, has_alpha};
use crate::geometry::Aabb;
use crate::random::{Permutation, Purpose};
use crate::sampling::Occupancy;
use autograd::single::{cast, is_single};
use autograd::{Buffer, Real, Tensor, parallel};
use channel::Channel;
use glam::DVec3;
use importance::Importance;
use ndarray::Array3;
use std::sync::Arc;
use tiles::Tile;

/// Training pixels of some views: all pixels that their masks keep, or those that can show matter. The order is shuffled in each epoch. An
/// epoch draws each pixel once, or in proportion to its contrast ([`with_contrast_floor`](Self::with_contrast_floor)).
#[derive(Debug)]
pub struct RaySource {
    all_views: Arc<[View]>,
    reduction: usize,
    /// Views reduced by `reduction`, unless it is 1.
    reduced: Option<Vec<View>>,
    background: [f32; 3],
    seed: u64,
    tiles: Vec<Tile>,
    /// `first[t]` is the number of draws of an epoch from the tiles before tile t.
    first: Vec<u64>,
    /// Tile of every [`apart`](Self::apart)-th draw; about as many entries as tiles. A binary search for a random draw would wait for
    /// memory about twelve times.
    guide: Vec<u32>,
    /// Number of pixels of the tiles.
    len: u64,
    /// Number of pixels of all views that their masks keep, after reduction.
    pixels: u64,
    /// 0 draws all pixels equally often.
    contrast_floor: f64,
    /// Importance of the pixels of the reduced views; `None` if all pixels are drawn equally often.
    importance: Option<Importance>,
    with_depth: bool,
    channels: Vec<Channel>,
}

impl RaySource {
    /// Creates a source of all pixels of `views` over a background, but for those that a mask ignores. The order depends on the seed.
    ///
    /// The source owns the views: a `Vec` is moved, an `Arc` is shared, and a slice is copied with its pixels.
    pub fn new(views: impl Into<Arc<[View]>>, background: [f32; 3], seed: u64) -> Self {
        let mut source = RaySource {
            all_views: views.into(),
            reduction: 1,
            reduced: None,
            background,
            seed,
            tiles: Vec::new(),
            first: Vec::new(),
            guide: Vec::new(),
            len: 0,
            pixels: 0,
            contrast_floor: 0.0,
            importance: None,
            with_depth: false,
            channels: Vec::new(),
        };
        source.set_reduction(1);
        source
    }

    /// Draws pixel p with a probability proportional to √(σₚ² + floor²), where σₚ² is the variance of the colors of the 3 × 3 pixels around
    /// it, sRGB in [0, 1], and adds the weights of importance sampling to the batches ([`RayBatch::weight`]). 0 draws all pixels equally
    /// often. Probabilities are rounded to a quarter of that of a pixel without contrast, and are at most 64 times that.
    ///
    /// Panics if the floor is negative or not finite.
    #[track_caller]
    pub fn with_contrast_floor(self, floor: f64) -> Self {
        assert!(floor >= 0.0 && floor.is_finite(), "with_contrast_floor: {floor} is not a contrast");
        let mut source = RaySource { contrast_floor: floor, ..self };
        source.set_reduction(source.reduction);
        source
    }

    /// Adds [`RayBatch::depth`] to the batches, if some view has a depth image. The depth of a reduced pixel is the mean over its k × k
    /// pixels; infinite or NaN if one of them is.
    pub fn with_depth(self) -> Self {
        RaySource { with_depth: true, ..self }
    }

    /// Adds custom numbers for each pixel to the batches ([`RayBatch::channel`]): masks, weights, features.
    ///
    /// `images` are `[height, width, c]`, one for each view at full size, all with the same c. The value of a reduced pixel is the mean
    /// over its k × k pixels. NaN stays NaN.
    ///
    /// Panics if the number of images is not the number of views, if an image has another size than its view (the message names the view),
    /// if the number of channels is 0 or differs between images, or if a channel of this name exists.
    #[track_caller]
    pub fn with_channel(mut self, name: impl Into<String>, images: impl Into<Arc<[Array3<f32>]>>) -> Self {
        let name = name.into();
        assert!(self.channels.iter().all(|channel| channel.name != name), "with_channel: channel `{name}` exists already");
        self.channels.push(Channel::new(name, images.into(), &self.all_views));
        self
    }

    /// Reduces the views by k with a box filter ([`View::reduced`]) and selects all their pixels. A view whose sides k does not divide is
    /// reduced by the largest smaller divisor. k = 1 restores the views at full size.
    ///
    /// Panics if k is 0.
    #[track_caller]
    pub fn set_reduction(&mut self, k: usize) {
        assert!(k > 0, "set_reduction: images cannot be reduced by 0");
        if k != self.reduction {
            // Release the old views before the new ones are created.
            self.reduced = None;
            self.reduced = (k > 1).then(|| parallel::map_indices(self.all_views.len(), |v| self.all_views[v].reduced(k)));
            self.reduction = k;
        }
        let floor = self.contrast_floor;
        self.importance = (floor > 0.0).then(|| Importance::of(self.views(), self.background, floor));
        let tiles = self.views().iter().enumerate().map(|(v, view)| Tile::of_view(v, view)).collect();
        self.set_tiles(tiles);
        self.pixels = self.len;
    }

    /// Returns the current reduction of the views, initially 1.
    pub fn reduction(&self) -> usize {
        self.reduction
    }

    /// Returns the views at full size.
    pub fn all_views(&self) -> &Arc<[View]> {
        &self.all_views
    }

    /// Returns the views after reduction. Aiming does not change them.
    pub fn views(&self) -> &[View] {
        self.reduced.as_deref().unwrap_or(&self.all_views)
    }

    fn set_tiles(&mut self, mut tiles: Vec<Tile>) {
        if self.importance.is_some() {
            // A pixel is looked for in its tile.
            tiles = tiles.iter().flat_map(Tile::parts).collect();
        }
        if self.views().iter().any(|view| view.mask.is_some()) {
            tiles = tiles.iter().flat_map(|tile| tile.kept(&self.views()[tile.view as usize])).collect();
        }
        let draws_of = |tile: &Tile| self.importance.as_ref().map_or(tile.pixels() as u64, |importance| importance.of_tile(tile));
        let draws = parallel::map_indices(tiles.len(), |t| draws_of(&tiles[t]));
        self.first = vec![0];
        for draws in draws {
            self.first.push(self.first[self.first.len() - 1] + draws);
        }
        self.len = tiles.iter().map(|tile| tile.pixels() as u64).sum();
        self.tiles = tiles;
        let apart = self.apart();
        self.guide.clear();
        for (t, first) in self.first.windows(2).enumerate() {
            while (self.guide.len() as u64) * apart < first[1] {
                self.guide.push(t as u32);
            }
        }
    }

    /// Returns the number of draws between two entries of the guide: the mean number of draws per tile.
    fn apart(&self) -> u64 {
        self.draws().div_ceil(self.tiles.len().max(1) as u64).max(1)
    }

    /// Restricts the source to the pixels around the projections of cells that may hold matter. Other pixels show the background whatever
    /// is learned; they contribute nothing but the mean of the errors.
    pub fn aim_at(&mut self, matter: &Occupancy) {
        self.set_tiles(tiles::showing(self.views(), matter));
    }

    /// Returns the fraction of the views' pixels that the source contains.
    pub fn share(&self) -> f64 {
        self.len as f64 / self.pixels as f64
    }

    /// Returns the number of pixels of the source.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Returns the number of draws of an epoch: [`len`](Self::len), or more if pixels differ in importance.
    fn draws(&self) -> u64 {
        self.first[self.tiles.len()]
    }

    /// Returns true if there are no pixels.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns rays `from..from + n` of the infinite sequence of epochs. The result depends only on the seed and the numbers.
    pub fn batch<T: Real>(&self, from: u64, n: usize) -> RayBatch<T> {
        if const { is_single::<T>() } { cast(self.batch_single(from, n)) } else { self.batch_in(from, n) }
    }

    #[inline(never)]
    fn batch_single(&self, from: u64, n: usize) -> RayBatch<f32> {
        self.batch_in(from, n)
    }

    fn batch_in<T: Real>(&self, from: u64, n: usize) -> RayBatch<T> {
        let total = self.draws();
        let epochs: Vec<Permutation> = (from / total..=(from + n as u64 - 1) / total)
            .map(|epoch| Permutation::new(total, self.seed, Purpose::RayOrder, epoch))
            .collect();
        self.gathered(n, |i| {
            let number = from + i as u64;
            self.place(epochs[(number / total - from / total) as usize].at(number % total))
        })
    }

    /// Returns the rays of chosen pixels, in the given order: (view, column, row) in the reduced images. Aiming and masks do not restrict
    /// them, and they have no weights.
    ///
    /// Panics at the caller's line if a pixel is in no view; the message names the first such pixel.
    #[track_caller]
    pub fn batch_of<T: Real>(&self, pixels: &[(u32, u32, u32)]) -> RayBatch<T> {
        let views = self.views();
        let size = |v: u32| views.get(v as usize).map(|view| view.image.dimensions());
        for &(v, x, y) in pixels {
            let there = size(v).is_some_and(|(width, height)| x < width && y < height);
            let of_view =
                || size(v).map_or(format!("{} views", views.len()), |(width, height)| format!("a view of {width} x {height} pixels"));
            assert!(there, "batch_of: pixel ({v}, {x}, {y}), as view, column and row, is not in {}", of_view());
        }
        self.gathered(pixels.len(), |i| {
            let (view, x, y) = pixels[i];
            Place { view, x, y, weight: 1.0 }
        })
    }

    /// Returns the rays of n pixels.
    fn gathered<T: Real>(&self, n: usize, place: impl Fn(usize) -> Place + Sync) -> RayBatch<T> {
        let views = self.views();
        let nowhere = Ray { origin: DVec3::ZERO, direction: DVec3::ZERO, stretch: 0.0 };
        let (mut rays, mut target) = (vec![nowhere; n], Buffer::stale(3 * n));
        let (mut alpha, mut weight) = (Buffer::stale(n), Buffer::stale(n));
        let (mut view, mut pixel) = (vec![0; n], vec![[0; 2]; n]);
        const RUN: usize = 512;
        let of_image = target.chunks_mut(3 * RUN).zip(alpha.chunks_mut(RUN));
        let of_place = view.chunks_mut(RUN).zip(pixel.chunks_mut(RUN)).zip(weight.chunks_mut(RUN));
        let runs = rays.chunks_mut(RUN).zip(of_image).zip(of_place).collect();
        parallel::for_each_item(runs, |run, ((rays, (target, alpha)), ((view, pixel), weight))| {
            // Pixels are at random places of all images, so those of a run are prefetched before its first ray is computed.
            let prefetched = |i: usize| {
                let place = place(run * RUN + i);
                parallel::prefetch_early(views[place.view as usize].image.get_pixel(place.x, place.y));
                place
            };
            let places: Vec<Place> = (0..rays.len()).map(prefetched).collect();
            for (i, ((ray, target), place)) in rays.iter_mut().zip(target.as_chunks_mut::<3>().0).zip(places).enumerate() {
                let (seen, x, y) = (&views[place.view as usize], place.x as usize, place.y as usize);
                *ray = place.ray(views);
                *target = seen.color(x, y, self.background).map(|c| T::lit(f64::from(c)));
                alpha[i] = T::lit(f64::from(seen.alpha(x, y)));
                weight[i] = T::lit(f64::from(place.weight));
                (view[i], pixel[i]) = (place.view, [place.x, place.y]);
            }
        });
        let (target, alpha) = (Tensor::from_buffer(target, &[n, 3]), Tensor::from_buffer(alpha, &[n]));
        let weighted = weight.iter().any(|w| *w != T::one());
        let weight = weighted.then(|| Tensor::from_buffer(weight, &[n]));
        let mut batch = RayBatch { rays, target, alpha, weight, view, pixel, depth: None, channels: Vec::new() };
        let block = |v: usize| (self.all_views[v].image.width() / views[v].image.width()) as usize;
        if self.with_depth && self.all_views.iter().any(|view| view.depth.is_some()) {
            batch.depth = Some(channel::depth(&batch, &self.all_views, block));
        }
        batch.channels = self.channels.iter().map(|channel| (channel.name.clone(), channel.at(&batch, block))).collect();
        batch
    }

    /// Returns the rays of the source at every `stride`-th column and row of the views, tile after tile, in batches of `size`.
    pub fn lattice_of_rays(&self, stride: u32, size: usize) -> impl Iterator<Item = Vec<Ray>> + '_ {
        let mut pixels = self.lattice(stride);
        std::iter::from_fn(move || {
            let rays: Vec<Ray> = pixels.by_ref().take(size).map(|place| place.ray(self.views())).collect();
            (!rays.is_empty()).then_some(rays)
        })
    }

    /// Returns the pixels of the source at every `stride`-th column and row of the views, tile after tile.
    fn lattice(&self, stride: u32) -> impl Iterator<Item = Place> + '_ {
        let along = move |from: u32, count: u32| (from.next_multiple_of(stride)..from + count).step_by(stride as usize);
        let of_tile = move |tile: &Tile| {
            let &Tile { view, x, y, width, height } = tile;
            along(y, height).flat_map(move |y| along(x, width).map(move |x| Place { view, x, y, weight: 1.0 }))
        };
        self.tiles.iter().flat_map(of_tile)
    }

    /// Returns the largest stride between pixels at which at least 8 rays pass through a voxel of this side that is visible in all views. The stride
    /// is computed for a voxel at the far end of the box, where its projection is smallest.
    pub fn stride(&self, side: f64, aabb: Aabb) -> u32 {
        const RAYS: f64 = 8.0;
        let reach = 0.5 * (aabb.max - aabb.min).length();
        let pixels = self.views().iter().map(|view| {
            let k = &view.camera.intrinsics;
            k.fx.min(k.fy) * side / (view.camera.position().distance(0.5 * (aabb.min + aabb.max)) + reach)
        });
        let apart = (self.views().len() as f64 / RAYS).sqrt();
        (apart * pixels.fold(f64::INFINITY, f64::min)).clamp(1.0, 64.0) as u32
    }

    /// Returns all rays of the source, tile after tile, in batches of `size`, with the alphas of their pixels. A view is a tile until the source is aimed. If no
    /// view has a transparent pixel ([`has_alpha`]), alpha is 0 for pixels of the background color, and 1 for the others.
    pub fn in_order_with_alpha(&self, size: usize) -> impl Iterator<Item = (Vec<Ray>, Vec<f32>)> + '_ {
        let views = self.views();
        let has_alpha = has_alpha(views);
        let in_bytes = |color: [f32; 3]| color.map(|c| (c * 255.0).round() as u8);
        let alpha = move |place: &Place| {
            let (view, x, y) = (&views[place.view as usize], place.x as usize, place.y as usize);
            match has_alpha {
                true => view.alpha(x, y),
                false => f32::from(u8::from(in_bytes(view.color(x, y, self.background)) != in_bytes(self.background))),
            }
        };
        let mut pixels = self.lattice(1);
        std::iter::from_fn(move || {
            let (rays, alphas): (Vec<Ray>, Vec<f32>) = pixels.by_ref().take(size).map(|place| (place.ray(views), alpha(&place))).unzip();
            (!rays.is_empty()).then_some((rays, alphas))
        })
    }

    /// Returns the pixel of a draw of an epoch.
    fn place(&self, draw: u64) -> Place {
        let guide = self.guide[(draw / self.apart()) as usize] as usize;
        let t = guide + self.first[guide + 1..].iter().take_while(|&&f| f <= draw).count();
        let tile @ &Tile { view, x, y, width, .. } = &self.tiles[t];
        let in_tile = draw - self.first[t];
        match &self.importance {
            None => Place { view, x: x + in_tile as u32 % width, y: y + in_tile as u32 / width, weight: 1.0 },
            Some(importance) => {
                let (x, y, draws) = importance.pixel(tile, in_tile);
                Place { view, x, y, weight: (self.draws() as f64 / self.len as f64 / f64::from(draws)) as f32 }
            }
        }
    }
}

/// Pixel of a view, with the weight of its rays.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Place {
    view: u32,
    x: u32,
    y: u32,
    weight: f32,
}

impl Place {
    /// Returns the ray through the pixel's centre.
    fn ray(self, views: &[View]) -> Ray {
        views[self.view as usize].camera.ray(f64::from(self.x) + 0.5, f64::from(self.y) + 0.5)
    }
}
