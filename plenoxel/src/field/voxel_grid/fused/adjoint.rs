//! Gradients of table rows from cotangents of pixels. [`Along`](crate::render::along::Along) has the formulas.

use super::forward::Block;
use super::lookup::Corners;
use super::{BUCKET_SHIFT, Batch, COLUMNS, Output};
use crate::field::sh;
use crate::field::voxel_grid::{Color, Interpolation};
use crate::render::along;
use autograd::rows::Buckets;
use autograd::{Buffer, Pooled, Real, RowSums, Tensor, dispatched, parallel};
use std::ops::Range;
use std::sync::Arc;

/// Contributions of every sample of a batch to the tables, sorted by bucket within each block.
#[derive(Debug)]
pub(super) struct Sums<T: Real> {
    /// Number of harmonics per channel in a row of the color table ([`Batch::harmonics`]).
    count: usize,
    /// `[n, (degree + 1)²]`
    basis: Tensor<T>,
    blocks: Vec<Records<T>>,
}

/// Records of one block. A sample has one record in each bucket that it reads.
#[derive(Debug)]
struct Records<T: Real> {
    buckets: Buckets,
    at: At<T>,
    /// [`Slopes`] of each record.
    slopes: Buffer<T>,
    /// Number of the ray; empty if rows have no harmonics.
    ray: Buffer<u32>,
}

/// ∂L/∂density, then ∂L/∂rgb before multiplication with the harmonics of the ray. If rows have no harmonics, the latter is the contribution to the row
/// of colors.
type Slopes<T> = [T; 4];

#[derive(Debug)]
enum At<T: Real> {
    Rows(Buffer<u32>),
    Corners(Corners<T>),
}

impl<T: Real> Sums<T> {
    /// Computes the records from the cotangent of the kernel's output.
    pub fn new(batch: &Batch<T>, blocks: &[Block<T>], cotangent: &Tensor<T>, output: Output) -> Self {
        let buckets = batch.layout.lattice.rows().div_ceil(1 << BUCKET_SHIFT);
        let blocks = parallel::map_indices(blocks.len(), |b| {
            let block = &blocks[b];
            let gradients = Gradients::new(batch, block, cotangent, output);
            gradients.sorted(batch, block, buckets)
        });
        Sums { count: batch.harmonics(), basis: batch.basis().clone(), blocks }
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.blocks.iter().all(|records| records.buckets.range(bucket).is_empty())
    }

    /// Calls `f(records, range)` for the records of a bucket, in the order of the blocks.
    fn for_each(&self, bucket: usize, mut f: impl FnMut(&Records<T>, Range<usize>)) {
        for records in &self.blocks {
            let range = records.buckets.range(bucket);
            if !range.is_empty() {
                f(records, range);
            }
        }
    }
}

/// ∂L/∂σ and ∂L/∂c of each sample of a block.
struct Gradients<T: Real> {
    sigma: Buffer<T>,
    /// ∂L/∂rgb of each ray, `[rays, 3]`; ∂L/∂cᵢ is wᵢ times this.
    rgb: Vec<[T; 3]>,
}

impl<T: Real> Gradients<T> {
    fn new(batch: &Batch<T>, block: &Block<T>, cotangent: &Tensor<T>, output: Output) -> Self {
        let mut sigma = Buffer::stale(block.len());
        let rays = block.offsets.len() - 1;
        if output == Output::Sparsity {
            for (own, &g) in block.rays().zip(&cotangent.data()[block.first..]) {
                own.for_each(|i| sigma[i] = g * along::sparsity_slope(block.density[i].max(T::zero())));
            }
            return Gradients { sigma, rgb: vec![[T::zero(); 3]; rays] };
        }
        let pixels = &cotangent.data().as_chunks::<COLUMNS>().0[block.first..];
        let (along, color) = (block.along(), block.shown(batch));
        for (own, g) in block.rays().zip(pixels) {
            along.sigma_adjoint(own, batch.background, g, &color, &mut sigma);
        }
        Gradients { sigma, rgb: pixels[..rays].iter().map(|g| [g[0], g[1], g[2]]).collect() }
    }

    /// Sorts the gradients of samples with non-negative density by the buckets that they read.
    fn sorted(&self, batch: &Batch<T>, block: &Block<T>, buckets: usize) -> Records<T> {
        match batch.layout.shape.interpolation {
            Interpolation::Nearest => {
                let one = |i: usize| [block.rows[i] >> BUCKET_SHIFT];
                let mut rows = loaded(block.len());
                let records = self.records(batch, block, buckets, block.len(), one, |place, i| rows[place] = block.rows[i]);
                Records { at: At::Rows(rows), ..records }
            }
            Interpolation::Trilinear => {
                let found = block.trilinear();
                let mut touched = Buffer::stale(8 * block.len());
                let touched = touched.as_chunks_mut().0;
                let most = block.len() + touch_buckets(found, touched);
                let mut sorted = Corners::none();
                sorted.make_room(most);
                let records = self.records(batch, block, buckets, most, |i| touched[i], |place, i| sorted.set(place, found.of(i)));
                Records { at: At::Corners(sorted), ..records }
            }
        }
    }

    /// Counts the records of each bucket, then writes every record to its place, in the order of the samples. `buckets_of(i)` are the
    /// buckets that sample i reads, terminated by [`NONE`]. `put(place, i)` writes the rows of sample i to `place`.
    #[inline(always)]
    fn records<const K: usize>(
        &self,
        batch: &Batch<T>,
        block: &Block<T>,
        buckets: usize,
        most: usize,
        buckets_of: impl Fn(usize) -> [u32; K],
        mut put: impl FnMut(usize, usize),
    ) -> Records<T> {
        let buckets_of = |i: usize| buckets_of(i).into_iter().take_while(|&b| b != NONE).map(|b| b as usize);
        let live = (0..block.len()).filter(|&i| block.density[i] >= T::zero());
        let mut places = Buckets::count(buckets, live.flat_map(buckets_of));
        let clamped = batch.layout.shape.color != Color::Rgb;
        let mut slopes = loaded(4 * most);
        let harmonic = batch.harmonics() > 0;
        let mut ray = loaded(if harmonic { most } else { 0 });
        let to: &mut [Slopes<T>] = slopes.as_chunks_mut().0;
        let colors = block.color.as_chunks::<3>().0;
        for (r, own) in block.rays().enumerate() {
            let g = self.rgb[r];
            for i in own.filter(|&i| block.density[i] >= T::zero()) {
                let w = block.weight[i];
                let mut c = g.map(|g| w * g);
                if clamped {
                    (0..3).filter(|&a| colors[i][a] < T::zero()).for_each(|a| c[a] = T::zero());
                }
                if clamped && !harmonic {
                    c = c.map(|c| c * T::lit(sh::Y0));
                }
                for bucket in buckets_of(i) {
                    let place = places.take(bucket);
                    to[place] = [self.sigma[i], c[0], c[1], c[2]];
                    if harmonic {
                        ray[place] = (block.first + r) as u32;
                    }
                    put(place, i);
                }
            }
        }
        Records { buckets: places.filled(), at: At::Rows(Buffer::stale(0)), slopes, ray }
    }
}

/// Size of the largest array that is read in order before records are written to it, in bytes: half of a second-level cache of 1 MB.
const LOADED: usize = 1 << 19;

/// Returns a buffer of unspecified contents, after reading it in order if it is small. Records are written to many buckets in turn, and each write to a line
/// outside of the cache would wait.
fn loaded<E: Pooled>(len: usize) -> Buffer<E> {
    let buffer = Buffer::stale(len);
    if size_of_val(&buffer[..]) <= LOADED {
        parallel::load(&buffer);
    }
    buffer
}

/// Marker for no bucket: the bucket of row `u32::MAX`, which no table reaches.
const NONE: u32 = u32::MAX >> BUCKET_SHIFT;

dispatched! {
/// Finds the distinct buckets of the corners of each sample, terminated by [`NONE`]. Returns the number of buckets minus the number of
/// samples.
fn touch_buckets<T: Real>(corners: &Corners<T>, touched: &mut [[u32; 8]]) -> usize {
    let mut more = 0;
    for (i, touched) in touched.iter_mut().enumerate() {
        let all = corners.of(i).0.map(|row| row >> BUCKET_SHIFT);
        *touched = [NONE; 8];
        touched[0] = all[0];
        if all != [all[0]; 8] {
            // Like `rows::buckets_of`, but from the corners found before, without computing rows and weights again.
            let mut found = 1;
            for b in all {
                if !touched[..found].contains(&b) {
                    touched[found] = b;
                    found += 1;
                }
            }
            more += found - 1;
        }
    }
    more
}
}

/// Contributions to the density table.
#[derive(Debug)]
pub(super) struct DensitySums<T: Real>(pub Arc<Sums<T>>);

/// Contributions to the color table.
#[derive(Debug)]
pub(super) struct ColorSums<T: Real>(pub Arc<Sums<T>>);

impl<T: Real> RowSums<T> for DensitySums<T> {
    fn bucket_shift(&self) -> u32 {
        BUCKET_SHIFT
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.0.is_empty(bucket)
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        self.0.for_each(bucket, |records, range| {
            let of_density = OfDensity(records.slopes.as_chunks().0);
            match &records.at {
                At::Rows(rows) => add_rows::<T, _, 1>(rows, range, of_density, sums, touched),
                At::Corners(corners) => add_corners::<T, _, 1>(bucket, corners, range, of_density, sums, touched),
            }
        });
    }
}

impl<T: Real> RowSums<T> for ColorSums<T> {
    fn bucket_shift(&self) -> u32 {
        BUCKET_SHIFT
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.0.is_empty(bucket)
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        match self.0.count {
            0 | 1 => self.add_of_width::<3>(bucket, sums, touched),
            4 => self.add_of_width::<12>(bucket, sums, touched),
            9 => self.add_of_width::<27>(bucket, sums, touched),
            _ => self.add_of_width::<48>(bucket, sums, touched),
        }
    }
}

impl<T: Real> ColorSums<T> {
    fn add_of_width<const W: usize>(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let harmonic = self.0.count > 0;
        self.0.for_each(bucket, |records, range| {
            let of_color = OfColor(records.slopes.as_chunks().0);
            let products = ColorTimesBasis { of_color, rays: &records.ray, basis: self.0.basis.data() };
            match &records.at {
                At::Rows(rows) if !harmonic => add_rows::<T, _, 3>(rows, range, of_color, sums, touched),
                At::Rows(rows) => add_rows::<T, _, W>(rows, range, products, sums, touched),
                At::Corners(corners) if !harmonic => add_corners::<T, _, 3>(bucket, corners, range, of_color, sums, touched),
                At::Corners(corners) => add_corners::<T, _, W>(bucket, corners, range, products, sums, touched),
            }
        });
    }
}

/// Contribution of each record to the row that it reads, before multiplication with the weights of trilinear look-up. The compiler inlines these
/// methods in dispatched loops, but not closures.
trait Values<T, const W: usize> {
    fn of(&self, i: usize) -> [T; W];
}

#[derive(Clone, Copy)]
struct OfDensity<'a, T>(&'a [Slopes<T>]);

impl<T: Real> Values<T, 1> for OfDensity<'_, T> {
    #[inline(always)]
    fn of(&self, i: usize) -> [T; 1] {
        [self.0[i][0]]
    }
}

#[derive(Clone, Copy)]
struct OfColor<'a, T>(&'a [Slopes<T>]);

impl<T: Real> Values<T, 3> for OfColor<'_, T> {
    #[inline(always)]
    fn of(&self, i: usize) -> [T; 3] {
        let [_, r, g, b] = self.0[i];
        [r, g, b]
    }
}

/// Products of the gradient of a color and the harmonics of its ray.
struct ColorTimesBasis<'a, T> {
    of_color: OfColor<'a, T>,
    rays: &'a [u32],
    /// `W` / 3 numbers for each ray.
    basis: &'a [T],
}

impl<T: Real, const W: usize> Values<T, W> for ColorTimesBasis<'_, T> {
    #[inline(always)]
    fn of(&self, i: usize) -> [T; W] {
        let (color, count) = (self.of_color.of(i), W / 3);
        let basis = &self.basis[self.rays[i] as usize * count..][..count];
        let mut value = [T::zero(); W];
        for c in 0..3 {
            for k in 0..count {
                value[c * count + k] = color[c] * basis[k];
            }
        }
        value
    }
}

dispatched! {
/// Adds the values of a range of records, all of one bucket, to their rows.
fn add_rows<T: Real, V: Values<T, W>, const W: usize>(rows: &[u32], range: Range<usize>, values: V, sums: &mut [T], touched: &mut [u64]) {
    let sums = sums.as_chunks_mut::<W>().0;
    for i in range {
        let local = rows[i] as usize & ((1 << BUCKET_SHIFT) - 1);
        touched[local / 64] |= 1 << (local % 64);
        let value = values.of(i);
        for (s, v) in sums[local].iter_mut().zip(value) {
            *s += v;
        }
    }
}
}

dispatched! {
/// Adds weighted values to the corner rows of each sample that lie in the bucket.
fn add_corners<T: Real, V: Values<T, W>, const W: usize>(
    bucket: usize,
    corners: &Corners<T>,
    range: Range<usize>,
    values: V,
    sums: &mut [T],
    touched: &mut [u64],
) {
    let sums = sums.as_chunks_mut::<W>().0;
    for i in range {
        let (rows, weights) = corners.of(i);
        let value = values.of(i);
        for c in 0..8 {
            if rows[c] as usize >> BUCKET_SHIFT == bucket {
                let local = rows[c] as usize & ((1 << BUCKET_SHIFT) - 1);
                touched[local / 64] |= 1 << (local % 64);
                add_weighted::<T, W>(weights[c], &value, &mut sums[local]);
            }
        }
    }
}
}

/// Adds a weighted value to a row, in whole vectors if the row is long enough. The last vector overlaps the one before: its first numbers are written twice.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn add_weighted<T: Real, const W: usize>(weight: T, value: &[T; W], row: &mut [T; W]) {
    /// Length of a vector.
    const L: usize = 16;
    if W < L {
        for k in 0..W {
            row[k] += weight * value[k];
        }
        return;
    }
    let mut parts = [[T::zero(); L]; 3];
    for part in 0..W.div_ceil(L) {
        let start = (part * L).min(W - L);
        for l in 0..L {
            parts[part][l] = row[start + l] + weight * value[start + l];
        }
    }
    for part in 0..W.div_ceil(L) {
        let start = (part * L).min(W - L);
        row[start..start + L].copy_from_slice(&parts[part]);
    }
}
