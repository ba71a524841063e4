//! Adjoint of the table: sums of contributions to its rows, which the optimizer requests one bucket of rows after another.
//!
//! Positions are divided into chunks of a size that depends on their number only. Each chunk writes its contributions and sorts them by bucket.
//! Consecutive positions in the same cell, as along a ray, contribute together.

use super::loops::{Cells, TOGETHER, group, with_features};
use super::{HashGrid, Level};
use autograd::rows::Buckets;
use autograd::{Buffer, Real, RowSums, dispatched, parallel};

/// Contributions of a chunk of positions.
#[derive(Debug)]
struct Part<T: Real> {
    buckets: Buckets,
    /// Rows, sorted by bucket.
    rows: Buffer<u32>,
    /// Contributions to the rows, `[rows, features]`.
    values: Buffer<T>,
}

/// Sums of the contributions to all rows.
#[derive(Debug)]
pub struct HashSums<T: Real> {
    features: usize,
    parts: Vec<Part<T>>,
}

/// Returns the base-2 logarithm of the number of rows in a bucket, whose sums fit into the cache of a core.
fn bucket_shift(features: usize) -> u32 {
    const NUMBERS: usize = 1 << 15;
    (NUMBERS / features).ilog2()
}

impl<T: Real> HashSums<T> {
    /// Computes the contributions of positions from the cotangents `g` `[places, levels · features]` of their encodings.
    pub fn new(grid: &HashGrid, places: &[[T; 3]], g: &[T]) -> Self {
        let (features, width) = (grid.shape.features, grid.width());
        let shift = bucket_shift(features);
        let buckets = grid.rows().div_ceil(1 << shift);
        let parts = parallel::map_chunks(places.len(), places.len().div_ceil(64).max(1024), |range| {
            let most = 8 * grid.levels.len() * range.len();
            let (mut rows, mut values) = (Buffer::<u32>::stale(most), Buffer::<T>::stale(most * features));
            let g = &g[range.start * width..range.end * width];
            let count = with_features!(features, contributions::<T>(&grid.levels, &places[range.clone()], g, &mut rows, &mut values));
            sorted(buckets, shift, features, &rows[..count], &values)
        });
        HashSums { features, parts }
    }
}

/// Sorts contributions by bucket.
fn sorted<T: Real>(buckets: usize, shift: u32, features: usize, rows: &[u32], values: &[T]) -> Part<T> {
    let bucket = |row: u32| (row >> shift) as usize;
    let mut places = Buckets::count(buckets, rows.iter().map(|&row| bucket(row)));
    let (mut sorted_rows, mut sorted_values) = (Buffer::stale(rows.len()), Buffer::stale(rows.len() * features));
    for (&row, value) in rows.iter().zip(values.chunks_exact(features)) {
        let to = places.take(bucket(row));
        sorted_rows[to] = row;
        sorted_values[to * features..][..features].copy_from_slice(value);
    }
    Part { buckets: places.filled(), rows: sorted_rows, values: sorted_values }
}

impl<T: Real> RowSums<T> for HashSums<T> {
    fn bucket_shift(&self) -> u32 {
        bucket_shift(self.features)
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.parts.iter().all(|part| part.buckets.range(bucket).is_empty())
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let first = (bucket << self.bucket_shift()) as u32;
        for part in &self.parts {
            let range = part.buckets.range(bucket);
            let (rows, values) = (&part.rows[range.clone()], &part.values[range.start * self.features..range.end * self.features]);
            with_features!(self.features, add::<T>(first, rows, values, sums, touched));
        }
    }
}

dispatched! {
/// Writes the contributions of positions, level after level. Returns their number.
fn contributions<T: Real, const F: usize, const FUSED: bool>(
    levels: &[Level],
    places: &[[T; 3]],
    g: &[T],
    rows: &mut [u32],
    values: &mut [T],
) -> usize {
    let (g, width) = (g.as_chunks::<F>().0, levels.len());
    let (rows, values) = (rows.as_chunks_mut::<8>().0, values.as_chunks_mut::<F>().0.as_chunks_mut::<8>().0);
    let mut count = 0;
    for (l, level) in levels.iter().enumerate() {
        // Rows and contributions of the current cell, unless it has none.
        let mut own = [0; 8];
        let mut sums = [[T::zero(); F]; 8];
        let mut any = false;
        for (places, g) in places.chunks(TOGETHER).zip(g.chunks(TOGETHER * width)) {
            let cells = Cells::new::<FUSED>(level, &group(places));
            for i in 0..places.len() {
                let g = &g[i * width + l];
                if g.iter().all(|&g| g == T::zero()) {
                    continue;
                }
                let here = std::array::from_fn(|c| cells.rows[c][i]);
                if any && here != own {
                    (rows[count], values[count]) = (own, sums);
                    count += 1;
                    sums = [[T::zero(); F]; 8];
                }
                (own, any) = (here, true);
                let weights = cells.weights(i);
                for c in 0..8 {
                    for f in 0..F {
                        sums[c][f] = g[f].multiply_add::<FUSED>(weights[c], sums[c][f]);
                    }
                }
            }
        }
        if any {
            (rows[count], values[count]) = (own, sums);
            count += 1;
        }
    }
    8 * count
}
}

dispatched! {
/// Adds contributions to the rows of a bucket that begins at row `first`.
fn add<T: Real, const F: usize, const FUSED: bool>(first: u32, rows: &[u32], values: &[T], sums: &mut [T], touched: &mut [u64]) {
    let sums = sums.as_chunks_mut::<F>().0;
    for (&row, value) in rows.iter().zip(values.as_chunks::<F>().0) {
        let row = (row - first) as usize;
        touched[row / 64] |= 1 << (row % 64);
        let sum = &mut sums[row];
        for f in 0..F {
            sum[f] += value[f];
        }
    }
}
}
