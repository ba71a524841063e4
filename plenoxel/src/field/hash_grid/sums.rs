//! Adjoint of the table: sums of contributions to its rows, which the optimizer requests one bucket of rows after another.
//!
//! A bucket has as many rows as the largest level, but at most 8 MB in single precision. The contributions of all positions to its levels are computed when they are added;
//! none is stored. Consecutive positions in the same cell, as along a ray, contribute together. There are about as many tasks as levels that share rows, so more threads than
//! levels are of no use.

use super::loops::{Cells, TOGETHER, group, with_features};
use super::{HashGrid, Level};
use autograd::{Real, RowSums, Tensor, dispatched, parallel};
use std::ops::Range;

/// Sums of the contributions to all rows.
#[derive(Debug)]
pub struct HashSums<T: Real> {
    pub grid: HashGrid,
    /// Positions `[m, 3]`.
    pub positions: Tensor<T>,
    /// Cotangents of their encodings `[m, levels · features]`.
    pub g: Tensor<T>,
}

impl<T: Real> HashSums<T> {
    /// Returns the rows of a bucket.
    fn rows(&self, bucket: usize) -> Range<usize> {
        bucket << self.bucket_shift()..(bucket + 1) << self.bucket_shift()
    }
}

impl<T: Real> RowSums<T> for HashSums<T> {
    fn bucket_shift(&self) -> u32 {
        const NUMBERS: usize = 1 << 21;
        self.grid.shape.log2_rows.clamp(6, (NUMBERS / self.grid.shape.features).ilog2())
    }

    fn is_empty(&self, _bucket: usize) -> bool {
        self.positions.is_empty()
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let (rows, levels) = (self.rows(bucket), &self.grid.levels);
        let (places, g) = (self.positions.data().as_chunks::<3>().0, self.g.data());
        for l in 0..levels.len() {
            if levels[l].first < rows.end && rows.start < levels[l].first + levels[l].rows {
                with_features!(self.grid.shape.features, add::<T>(levels, l, places, g, rows.clone(), sums, touched));
            }
        }
    }
}

/// Sums of the rows of a bucket.
struct Sums<'a, T, const F: usize> {
    rows: Range<u32>,
    /// True if all rows of the level are in the bucket.
    all: bool,
    sums: &'a mut [[T; F]],
    touched: &'a mut [u64],
}

impl<T: Real, const F: usize> Sums<'_, T, F> {
    /// Prefetches the rows of a group of positions.
    #[inline(always)]
    fn prefetch(&self, cells: &Cells<T>) {
        for rows in &cells.rows {
            for &row in rows {
                if let Some(sum) = self.sums.get(row.wrapping_sub(self.rows.start) as usize) {
                    parallel::prefetch(sum);
                }
            }
        }
    }

    /// Adds to the rows of the corners of a cell that are in the bucket.
    #[inline(always)]
    fn add(&mut self, rows: &[u32; 8], values: &[[T; F]; 8]) {
        for (row, value) in rows.iter().zip(values) {
            if self.all || self.rows.contains(row) {
                let row = (row - self.rows.start) as usize;
                self.touched[row / 64] |= 1 << (row % 64);
                let sum = &mut self.sums[row];
                for f in 0..F {
                    sum[f] += value[f];
                }
            }
        }
    }
}

dispatched! {
/// Adds the contributions of positions to the rows of level `l` that are in a bucket.
fn add<T: Real, const F: usize, const FUSED: bool>(
    levels: &[Level],
    l: usize,
    places: &[[T; 3]],
    g: &[T],
    rows: Range<usize>,
    sums: &mut [T],
    touched: &mut [u64],
) {
    let (g, width, level) = (g.as_chunks::<F>().0, levels.len(), &levels[l]);
    let all = rows.start <= level.first && level.first + level.rows <= rows.end;
    let mut bucket = Sums { rows: rows.start as u32..rows.end as u32, all, sums: sums.as_chunks_mut::<F>().0, touched };
    // Rows and contributions of the current cell, unless it has none.
    let mut own = [0; 8];
    let mut values = [[T::zero(); F]; 8];
    let mut any = false;
    let mut groups = places.chunks(TOGETHER).zip(g.chunks(TOGETHER * width)).peekable();
    let mut next = Cells::new::<FUSED>(level, &group(places.chunks(TOGETHER).next().unwrap_or_default()));
    while let Some((places, g)) = groups.next() {
        let cells = next;
        // What the next group reads is prefetched.
        if let Some((places, g)) = groups.peek() {
            next = Cells::new::<FUSED>(level, &group(places));
            bucket.prefetch(&next);
            g.iter().skip(l).step_by(width).for_each(parallel::prefetch);
        }
        for i in 0..places.len() {
            let g = &g[i * width + l];
            if g.iter().all(|&g| g == T::zero()) {
                continue;
            }
            let here = std::array::from_fn(|c| cells.rows[c][i]);
            if any && here != own {
                bucket.add(&own, &values);
                values = [[T::zero(); F]; 8];
            }
            (own, any) = (here, true);
            let weights = cells.weights(i);
            for c in 0..8 {
                for f in 0..F {
                    values[c][f] = g[f].multiply_add::<FUSED>(weights[c], values[c][f]);
                }
            }
        }
    }
    if any {
        bucket.add(&own, &values);
    }
}
}
