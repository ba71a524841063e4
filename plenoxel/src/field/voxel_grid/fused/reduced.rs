//! Reduced harmonics: coefficients of degree 1 and more that are stored for larger voxels.
//!
//! rgb = offset + Y₀ Σⱼ wⱼ meanⱼ + Σₖ Yₖ Σᵢ vᵢ rowᵢₖ. Consecutive samples of a ray mostly read the same rows of harmonics. The adjoint
//! first sums the contributions v ∂L/∂rgb of such a run for each row, and then adds the sum times Yₖ to the row, bucket by bucket as for
//! the other tables.

use super::forward::{Block, Scene};
use super::lookup::{AHEAD, Corners, nearest_rows, prefetch_rows, weigh_all};
use super::{Batch, COLUMNS};
use crate::field::sh;
use crate::field::voxel_grid::{Color, Interpolation};
use autograd::rows::{Buckets, buckets_of};
use autograd::{Buffer, Lattice, Real, RowSums, Tensor, dispatched, parallel};
use std::sync::Arc;

/// Binary logarithm of the rows in a bucket: 8 bricks. The table is small, and smaller buckets give enough tasks.
const BUCKET_SHIFT: u32 = 9;

/// Number of runs between the prefetch of a run and its use. Runs are larger than rows.
const RUNS_AHEAD: usize = 4;

/// Red, green, blue, and a zero that pads them to a vector.
type Rgb0<T> = [T; 4];

/// Rows of harmonics that each sample reads, `K` of them.
pub(super) trait Look<T: Real, const K: usize>: Sized {
    fn find(at: [&[T]; 3], lattice: &Lattice, count: usize) -> Self;
    /// Returns rows and weights of a sample.
    fn of(&self, i: usize) -> ([u32; K], [T; K]);
}

/// One row per sample; beyond the table if the voxel is absent.
struct Nearest(Buffer<u32>);

impl<T: Real> Look<T, 1> for Nearest {
    fn find(at: [&[T]; 3], lattice: &Lattice, count: usize) -> Self {
        let mut rows = Buffer::stale(count);
        with_bricks!(lattice, map => nearest_rows(at, map, &mut rows));
        Nearest(rows)
    }

    #[inline(always)]
    fn of(&self, i: usize) -> ([u32; 1], [T; 1]) {
        ([self.0[i]], [T::one()])
    }
}

impl<T: Real> Look<T, 8> for Corners<T> {
    fn find(at: [&[T]; 3], lattice: &Lattice, count: usize) -> Self {
        with_bricks!(lattice, map => Corners::find(at, map, count))
    }

    #[inline(always)]
    fn of(&self, i: usize) -> ([u32; 8], [T; 8]) {
        Corners::of(self, i)
    }
}

/// Finds the rows that the samples of a block read.
fn found<T: Real, L: Look<T, K>, const K: usize>(batch: &Batch<T>, lattice: &Lattice, block: &Block<T>) -> L {
    let [scale, shift] = batch.layout.shape.to_harmonics().map(T::lit);
    let at = block.at.each_ref().map(|at| {
        let mut to = Buffer::stale(at.len());
        to.iter_mut().zip(&at[..]).for_each(|(to, &u)| *to = u * scale + shift);
        to
    });
    L::find(at.each_ref().map(|at| &at[..]), lattice, block.len())
}

/// Function from a sample to its rows and weights. Rows may repeat with weight zero.
pub(super) type Reads<T> = Box<dyn Fn(usize) -> ([u32; 8], [T; 8])>;

/// Returns the rows of harmonics that samples of a block read, if harmonics are reduced.
pub(super) fn reads<T: Real>(batch: &Batch<T>, block: &Block<T>) -> Option<Reads<T>> {
    let lattice = batch.layout.harmonics.as_ref()?;
    Some(match batch.layout.shape.interpolation {
        Interpolation::Nearest => {
            let found = found::<T, Nearest, 1>(batch, lattice, block);
            Box::new(move |i| ([found.0[i]; 8], std::array::from_fn(|k| if k == 0 { T::one() } else { T::zero() })))
        }
        Interpolation::Trilinear => {
            let found = found::<T, Corners<T>, 8>(batch, lattice, block);
            Box::new(move |i| found.of(i))
        }
    })
}

impl<T: Real> Scene<'_, T> {
    /// Adds harmonics to the coefficients of degree 0 of the visible samples, which makes them colors.
    pub fn add_harmonics(&self, lattice: &Lattice, block: &Block<T>, out: &mut [[T; 3]]) {
        match self.batch.layout.shape.interpolation {
            Interpolation::Nearest => self.add_found::<Nearest, 1>(lattice, block, out),
            Interpolation::Trilinear => self.add_found::<Corners<T>, 8>(lattice, block, out),
        }
    }

    fn add_found<L: Look<T, K>, const K: usize>(&self, lattice: &Lattice, block: &Block<T>, out: &mut [[T; 3]]) {
        let Color::Sh { offset, .. } = self.batch.layout.shape.color else { unreachable!("plain colors have no harmonics") };
        let count = self.batch.basis().shape()[1];
        let basis = &self.batch.basis().data()[block.first * count..];
        let (found, offset) = (found::<T, L, K>(self.batch, lattice, block), T::lit(offset));
        let look = |i: usize| found.of(i);
        match count {
            4 => add_to_means::<T, K, 9, 3>(self.tables[2], &block.offsets, basis, offset, look, block.seen(), out),
            9 => add_to_means::<T, K, 24, 8>(self.tables[2], &block.offsets, basis, offset, look, block.seen(), out),
            _ => add_to_means::<T, K, 45, 15>(self.tables[2], &block.offsets, basis, offset, look, block.seen(), out),
        }
    }
}

dispatched! {
/// Adds harmonics to `out`. `basis` has `N` + 1 numbers per ray, a row of the table has `W` = 3 `N`. Rows beyond the table are zero.
fn add_to_means<T: Real, const K: usize, const W: usize, const N: usize>(
    table: &[T],
    offsets: &[u32],
    basis: &[T],
    offset: T,
    look: impl Fn(usize) -> ([u32; K], [T; K]),
    seen: impl Fn(usize) -> bool,
    out: &mut [[T; 3]],
) {
    let table = table.as_chunks::<W>().0;
    let (none, mut sum) = ([T::zero(); W], [T::zero(); W]);
    for (own, basis) in offsets.windows(2).zip(basis.chunks_exact(N + 1)) {
        for i in (own[0] as usize..own[1] as usize).filter(|&i| seen(i)) {
            if i + AHEAD < out.len() {
                // Consecutive samples mostly read the same rows.
                let [before, later] = [i + AHEAD - 1, i + AHEAD].map(|i| look(i).0);
                if later != before {
                    prefetch_rows(table, &later);
                }
            }
            let (rows, weights) = look(i);
            weigh_all::<T, K, W, false>(rows.map(|row| table.get(row as usize).unwrap_or(&none)), weights, &mut sum);
            for c in 0..3 {
                let mut color = offset + T::lit(sh::Y0) * out[i][c];
                for k in 0..N {
                    color += sum[c * N + k] * basis[k + 1];
                }
                out[i][c] = color;
            }
        }
    }
}
}

/// Returns the contributions of the samples of a batch to the rows of harmonics, from the cotangent of the pixels.
pub(super) fn sums<T: Real>(batch: &Batch<T>, lattice: &Lattice, blocks: &[Block<T>], cotangent: &Tensor<T>) -> Arc<dyn RowSums<T>> {
    match batch.layout.shape.interpolation {
        Interpolation::Nearest => Arc::new(HarmonicsSums::new::<Nearest>(batch, lattice, blocks, cotangent)),
        Interpolation::Trilinear => Arc::new(HarmonicsSums::new::<Corners<T>>(batch, lattice, blocks, cotangent)),
    }
}

/// Contributions to the table of harmonics. A sample reads `K` rows.
#[derive(Debug)]
struct HarmonicsSums<T: Real, const K: usize> {
    /// `[n, (degree + 1)²]`
    basis: Tensor<T>,
    blocks: Vec<Runs<T, K>>,
}

/// Runs of samples of one block, and their numbers sorted by the buckets of their rows.
#[derive(Debug)]
struct Runs<T: Real, const K: usize> {
    runs: Vec<Run<T, K>>,
    buckets: Buckets,
    numbers: Buffer<u32>,
}

/// Consecutive samples of a ray that read the same rows.
#[derive(Debug)]
struct Run<T: Real, const K: usize> {
    ray: u32,
    rows: [u32; K],
    /// Σ v ∂L/∂rgb over the samples for each row, where v is the weight of the row.
    sums: [Rgb0<T>; K],
}

impl<T: Real, const K: usize> Run<T, K> {
    /// Returns the distinct buckets of the rows.
    fn buckets(&self, count: usize) -> impl Iterator<Item = usize> {
        buckets_of(self.rows, BUCKET_SHIFT).filter(move |&bucket| bucket < count)
    }
}

impl<T: Real, const K: usize> Runs<T, K> {
    fn new(block: &Block<T>, look: impl Fn(usize) -> ([u32; K], [T; K]), pixels: &[[T; COLUMNS]], buckets: usize) -> Self {
        let colors = block.color.as_chunks::<3>().0;
        let mut runs: Vec<Run<T, K>> = Vec::new();
        for ((r, own), g) in block.rays().enumerate().zip(pixels) {
            let ray = (block.first + r) as u32;
            for i in own.filter(|&i| block.density[i] >= T::zero()) {
                let (rows, weights) = look(i);
                if runs.last().is_none_or(|run| run.ray != ray || run.rows != rows) {
                    runs.push(Run { ray, rows, sums: [[T::zero(); 4]; K] });
                }
                let Some(run) = runs.last_mut() else { unreachable!("a run was just begun") };
                let mut c = [T::zero(); 4];
                for a in (0..3).filter(|&a| colors[i][a] >= T::zero()) {
                    c[a] = block.weight[i] * g[a];
                }
                for (sum, weight) in run.sums.iter_mut().zip(weights) {
                    (0..4).for_each(|a| sum[a] += weight * c[a]);
                }
            }
        }
        let mut places = Buckets::count(buckets, runs.iter().flat_map(|run| run.buckets(buckets)));
        let mut numbers = Buffer::stale(places.total());
        for (number, run) in runs.iter().enumerate() {
            run.buckets(buckets).for_each(|bucket| numbers[places.take(bucket)] = number as u32);
        }
        Runs { runs, buckets: places.filled(), numbers }
    }
}

impl<T: Real, const K: usize> HarmonicsSums<T, K> {
    fn new<L: Look<T, K>>(batch: &Batch<T>, lattice: &Lattice, blocks: &[Block<T>], cotangent: &Tensor<T>) -> Self {
        let buckets = lattice.rows().div_ceil(1 << BUCKET_SHIFT);
        let blocks = parallel::map_indices(blocks.len(), |b| {
            let block = &blocks[b];
            let found = found::<T, L, K>(batch, lattice, block);
            Runs::new(block, |i| found.of(i), &cotangent.data().as_chunks().0[block.first..], buckets)
        });
        HarmonicsSums { basis: batch.basis().clone(), blocks }
    }
}

impl<T: Real, const K: usize> RowSums<T> for HarmonicsSums<T, K> {
    fn bucket_shift(&self) -> u32 {
        BUCKET_SHIFT
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.blocks.iter().all(|runs| runs.buckets.range(bucket).is_empty())
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let basis = self.basis.data();
        self.blocks.iter().for_each(|runs| match self.basis.shape()[1] {
            4 => add_runs::<T, K, 3>(bucket, runs, basis, sums, touched),
            9 => add_runs::<T, K, 8>(bucket, runs, basis, sums, touched),
            _ => add_runs::<T, K, 15>(bucket, runs, basis, sums, touched),
        });
    }
}

dispatched! {
/// Adds the contributions of runs to their rows in the bucket, in the order of the rays. `basis` has `N` + 1 numbers per ray, a row has 3
/// `N`.
fn add_runs<T: Real, const K: usize, const N: usize>(
    bucket: usize,
    runs: &Runs<T, K>,
    basis: &[T],
    sums: &mut [T],
    touched: &mut [u64],
) {
    let sums = sums.as_chunks_mut::<N>().0;
    let numbers = &runs.numbers[runs.buckets.range(bucket)];
    for (k, &number) in numbers.iter().enumerate() {
        if let Some(&later) = numbers.get(k + RUNS_AHEAD) {
            parallel::prefetch(&runs.runs[later as usize]);
        }
        let run = &runs.runs[number as usize];
        let y: &[T; N] = basis[run.ray as usize * (N + 1) + 1..].first_chunk().expect("the harmonics of each ray");
        for (row, own) in run.rows.iter().zip(&run.sums) {
            if *row as usize >> BUCKET_SHIFT == bucket {
                let local = *row as usize & ((1 << BUCKET_SHIFT) - 1);
                touched[local / 64] |= 1 << (local % 64);
                for c in 0..3 {
                    for k in 0..N {
                        sums[3 * local + c][k] += own[c] * y[k];
                    }
                }
            }
        }
    }
}
}
