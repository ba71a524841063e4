//! From rays to pixels, a block of rays at a time.

use super::lookup::{self, Corners, Directions};
use super::{Batch, COLUMNS, column};
use crate::camera::Ray;
use crate::field::voxel_grid::{Color, Interpolation};
use crate::render::RenderOptions;
use crate::sampling::{March, Occupancy, march};
use autograd::lattice::NodeMap;
use autograd::{Buffer, Real, Tensor, dispatched, parallel};

/// The samples of some rays, as far as the adjoint needs them. Arrays have one entry for each sample unless said otherwise.
#[derive(Debug)]
pub(super) struct Block<T: Real> {
    /// Number of its first ray.
    pub first: usize,
    /// Ray r of the block owns the samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<u32>,
    /// As looked up: σ is this where it is not negative. It is −1 where the ray has stopped before.
    pub density: Buffer<T>,
    /// Voxel coordinates; like all that follow, empty if no gradient will be asked for.
    pub at: [Buffer<T>; 3],
    /// The row that nearest look-up reads; empty with trilinear.
    pub rows: Buffer<u32>,
    pub t: Buffer<T>,
    pub delta: Buffer<T>,
    /// wᵢ = Tᵢ (1 − exp(−σᵢδᵢ))
    pub weight: Buffer<T>,
    /// Tᵢ₊₁
    pub after: Buffer<T>,
    /// Three numbers a sample, before harmonics are clamped at 0.
    pub color: Buffer<T>,
}

impl<T: Real> Block<T> {
    pub fn len(&self) -> usize {
        self.offsets[self.offsets.len() - 1] as usize
    }

    /// The samples of each ray.
    pub fn rays(&self) -> impl DoubleEndedIterator<Item = std::ops::Range<usize>> + '_ {
        self.offsets.windows(2).map(|o| o[0] as usize..o[1] as usize)
    }

    /// True for a sample that could be seen if it were dense.
    #[inline(always)]
    pub fn seen(&self) -> impl Fn(usize) -> bool {
        let (density, after, weight) = (&self.density[..], &self.after[..], &self.weight[..]);
        |i| density[i] >= T::zero() && (after[i] > T::zero() || weight[i] > T::zero())
    }

    /// Σ ln(1 + 2σᵢ²) of each ray.
    pub fn sparsity(&self) -> impl Iterator<Item = T> + '_ {
        self.rays().map(|own| {
            let of = |&d: &T| {
                let s = d.max(T::zero());
                (T::one() + T::lit(2.0) * s * s).ln()
            };
            self.density[own].iter().map(of).sum()
        })
    }
}

/// What rendering a batch reads.
pub(super) struct Scene<'a, T: Real> {
    pub batch: &'a Batch<T>,
    pub rays: &'a [Ray],
    pub options: &'a RenderOptions<'a>,
    pub cells: Option<&'a Occupancy>,
    /// Density, color, and harmonics where they are reduced.
    pub tables: [&'a [T]; 3],
}

impl<'a, T: Real> Scene<'a, T> {
    /// Of a grid's tables.
    pub fn new(
        batch: &'a Batch<T>,
        rays: &'a [Ray],
        options: &'a RenderOptions<'a>,
        cells: Option<&'a Occupancy>,
        tables: impl IntoIterator<Item = &'a Tensor<T>>,
    ) -> Self {
        let mut scene = Scene { batch, rays, options, cells, tables: [&[]; 3] };
        scene.tables.iter_mut().zip(tables).for_each(|(table, tensor)| *table = tensor.data());
        scene
    }

    /// Renders the rays from number `first` on, one for each [`COLUMNS`] of `pixels`.
    pub fn render(&self, first: usize, pixels: &mut [T], keep: bool) -> Block<T> {
        let (mut block, found) = self.weights(first, pixels.len() / COLUMNS);
        block.color = Buffer::stale(3 * block.len());
        self.colors(&mut block, found.as_ref());
        self.sum(&block, pixels);
        if !keep {
            return Block { first, offsets: block.offsets, ..Block::empty() };
        }
        block
    }

    /// The samples of `count` rays from number `first` on, all but their colors; with trilinear look-up also the rows that they read.
    pub fn weights(&self, first: usize, count: usize) -> (Block<T>, Option<Corners<T>>) {
        with_bricks!(self.batch.layout.lattice, map => self.weights_with(map, first, count))
    }

    fn weights_with(&self, map: impl NodeMap, first: usize, count: usize) -> (Block<T>, Option<Corners<T>>) {
        let mut block = self.place(first, count);
        let m = block.len();
        let (mut alpha, mut raw) = (Buffer::stale(m), Buffer::stale(m));
        let mut found = None;
        let at = block.at.each_ref().map(|a| &a[..]);
        match self.batch.layout.shape.interpolation {
            Interpolation::Nearest => {
                block.rows = Buffer::stale(m);
                lookup::nearest_rows(at, map, &mut block.rows);
                // What is not present is nothing, and no gradient makes it something.
                for (raw, &row) in raw.iter_mut().zip(&block.rows[..]) {
                    *raw = self.tables[0].get(row as usize).copied().unwrap_or(-T::one());
                }
            }
            Interpolation::Trilinear => {
                found = Some(Corners::new(at, map, self.tables[0], &mut raw));
            }
        }
        block.density = raw;
        block.after = Buffer::stale(m);
        if parallel::fused() {
            lookup::absorptions::<T, true>(&block.density, &block.delta, &mut alpha, &mut block.after);
        } else {
            lookup::absorptions::<T, false>(&block.density, &block.delta, &mut alpha, &mut block.after);
        }
        block.weight = alpha;
        let stop = T::lit(self.options.stop_below);
        for own in block.offsets.windows(2) {
            let own = own[0] as usize..own[1] as usize;
            let mut left = T::one();
            let samples = block.weight[own.clone()].iter_mut().zip(&mut block.after[own.clone()]).zip(&mut block.density[own]);
            for ((w, through), density) in samples {
                // Behind the stop there is nothing; what would be seen counts as background.
                if left < stop {
                    (*w, *through, *density) = (T::zero(), T::one(), -T::one());
                }
                *w *= left;
                left *= *through;
                *through = left;
            }
        }
        (block, found)
    }

    /// Where the samples lie: lengths and positions.
    fn place(&self, first: usize, count: usize) -> Block<T> {
        let RenderOptions { aabb, spacing, jitter, .. } = self.options;
        let rays = &self.rays[first..first + count];
        let marches: Vec<March> = rays.iter().enumerate().map(|(r, ray)| march(ray, aabb, *spacing, jitter.of(first + r))).collect();
        let bound = marches.iter().map(|m| m.count).sum();
        let mut block = Block { first, ..Block::empty() };
        [block.t, block.delta] = [Buffer::stale(bound), Buffer::stale(bound)];
        block.at = [Buffer::stale(bound), Buffer::stale(bound), Buffer::stale(bound)];
        let scale = 1.0 / self.batch.layout.shape.voxel_side();
        let to_voxels = [T::lit(scale), T::lit(self.batch.layout.shape.half_width * scale - 0.5)];
        let mut end = 0;
        for (ray, march) in rays.iter().zip(&marches) {
            let [x, y, z] = block.at.each_mut().map(|a| &mut a[end..]);
            let out = [x, y, z, &mut block.t[end..], &mut block.delta[end..]];
            end += match self.cells {
                None => place_all(march, ray, to_voxels, out),
                Some(cells) => place_occupied(march, ray, cells, to_voxels, out),
            };
            block.offsets.push(end as u32);
        }
        block.at.iter_mut().for_each(|a| a.truncate(end));
        block.t.truncate(end);
        block.delta.truncate(end);
        block
    }

    /// The color of every sample that could be seen if it were dense; zeros for the others.
    fn colors(&self, block: &mut Block<T>, found: Option<&Corners<T>>) {
        let mut color = std::mem::replace(&mut block.color, Buffer::stale(0));
        let out = color.as_chunks_mut::<3>().0;
        let seen = block.seen();
        let nearest = |i: usize| ([block.rows[i]], [T::one()]);
        match (self.directions(block.first), found) {
            (None, None) => lookup::plain(self.tables[1], nearest, seen, out),
            (None, Some(corners)) => lookup::plain(self.tables[1], |i| corners.of(i), seen, out),
            (Some(directions), None) => lookup::harmonics(self.tables[1], &block.offsets, directions, nearest, seen, out),
            (Some(directions), Some(corners)) => {
                lookup::harmonics(self.tables[1], &block.offsets, directions, |i| corners.of(i), seen, out);
            }
        }
        if let Some(lattice) = &self.batch.layout.harmonics {
            self.add_harmonics(lattice, block, out);
        }
        block.color = color;
    }

    /// What the harmonics in a row of the color table need of the rays from number `first` on; `None` if it has none.
    pub fn directions(&self, first: usize) -> Option<Directions<'_, T>> {
        let Color::Sh { offset, .. } = self.batch.layout.shape.color else { return None };
        let count = self.batch.harmonics();
        (count > 0).then(|| Directions { basis: &self.batch.basis.data()[first * count..], count, offset: T::lit(offset) })
    }

    /// Pixels from weights and colors.
    pub fn sum(&self, block: &Block<T>, pixels: &mut [T]) {
        let background = self.batch.background;
        let (rgb, _) = block.color.as_chunks::<3>();
        let clamped = self.batch.layout.shape.color != Color::Rgb;
        let shown = |c: T| if clamped { c.max(T::zero()) } else { c };
        for (own, pixel) in block.rays().zip(pixels.as_chunks_mut::<COLUMNS>().0) {
            let (mut color, mut depth, mut opacity, mut optical_depth, mut distortion, mut moment) =
                ([T::zero(); 3], T::zero(), T::zero(), T::zero(), T::zero(), T::zero());
            let left = if own.is_empty() { T::one() } else { block.after[own.end - 1] };
            for i in own {
                let (w, t, delta) = (block.weight[i], block.t[i], block.delta[i]);
                (0..3).for_each(|c| color[c] += w * shown(rgb[i][c]));
                distortion += w * (T::lit(2.0) * (t * opacity - moment) + w * delta * T::lit(1.0 / 3.0));
                depth += w * t;
                moment = depth;
                opacity += w;
                optical_depth += block.density[i].max(T::zero()) * delta;
            }
            (0..3).for_each(|c| pixel[c] = color[c] + left * background[c]);
            pixel[column::DEPTH] = depth;
            pixel[column::OPACITY] = opacity;
            pixel[column::LOG_TRANSMITTANCE] = -optical_depth;
            pixel[column::DISTORTION] = distortion;
        }
    }
}

impl<T: Real> Block<T> {
    fn empty() -> Self {
        let none = || Buffer::stale(0);
        Block {
            first: 0,
            offsets: vec![0],
            density: none(),
            at: [none(), none(), none()],
            rows: Buffer::stale(0),
            t: none(),
            delta: none(),
            weight: none(),
            after: none(),
            color: none(),
        }
    }
}

dispatched! {
/// Every interval of a march: voxel coordinates, middle, length. Returns how many.
fn place_all<T: Real>(march: &March, ray: &Ray, to_voxels: [T; 2], out: [&mut [T]; 5]) -> usize {
    let n = march.count;
    let [x, y, z, t, delta] = out.map(|o| &mut o[..n]);
    let (o, d) = (ray.origin, ray.direction);
    for k in 0..n {
        let (middle, length) = march.interval(k);
        x[k] = T::lit(o.x + middle * d.x) * to_voxels[0] + to_voxels[1];
        y[k] = T::lit(o.y + middle * d.y) * to_voxels[0] + to_voxels[1];
        z[k] = T::lit(o.z + middle * d.z) * to_voxels[0] + to_voxels[1];
        t[k] = T::lit(middle);
        delta[k] = T::lit(length);
    }
    n
}
}

/// The intervals whose middles lie in occupied cells.
fn place_occupied<T: Real>(march: &March, ray: &Ray, cells: &Occupancy, to_voxels: [T; 2], out: [&mut [T]; 5]) -> usize {
    let [x, y, z, t, delta] = out;
    let mut n = 0;
    march.for_each_occupied(ray, cells, |middle, length| {
        let p = ray.origin + middle * ray.direction;
        x[n] = T::lit(p.x) * to_voxels[0] + to_voxels[1];
        y[n] = T::lit(p.y) * to_voxels[0] + to_voxels[1];
        z[n] = T::lit(p.z) * to_voxels[0] + to_voxels[1];
        t[n] = T::lit(middle);
        delta[n] = T::lit(length);
        n += 1;
    });
    n
}
