//! Adjoint of the table: sums of contributions to its rows, which the optimizer requests one bucket of rows after another.
//!
//! A bucket has as many rows as the largest level, but at most 8 MB in single precision. The contributions of all positions to its levels are computed when they are added;
//! none is stored. Consecutive positions of a group in the same cell, as along a ray, contribute together. There are about as many tasks as levels that share rows, so more threads than
//! levels are of no use.

use super::loops::{BLOCK, Cells, Group, TOGETHER, with_features};
use super::{HashGrid, Level};
use autograd::{Buffer, Real, RowSums, dispatched};
use std::ops::Range;

/// Sums of the contributions to all rows.
#[derive(Debug)]
pub struct HashSums<T: Real> {
    pub grid: HashGrid,
    /// Positions, clamped to the unit cube.
    pub groups: Vec<Group<T>>,
    /// Cotangents of their encodings, in blocks.
    pub blocks: Buffer<T>,
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
        self.groups.is_empty()
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let (rows, features, width) = (self.rows(bucket), self.grid.shape.features, self.grid.width());
        for (l, level) in self.grid.levels.iter().enumerate() {
            if level.first < rows.end && rows.start < level.first + level.rows {
                for (groups, block) in self.groups.chunks(BLOCK / TOGETHER).zip(self.blocks.chunks(BLOCK * width)) {
                    let numbers = block.len() / self.grid.levels.len();
                    let g = &block[l * numbers..][..numbers];
                    with_features!(features, add::<T>(level, groups, g, rows.start as u32, sums, touched));
                }
            }
        }
    }
}

/// Sums of the rows of a bucket.
struct Sums<'a, T, const F: usize> {
    first: u32,
    sums: &'a mut [[T; F]],
    touched: &'a mut [u64],
}

impl<T: Real, const F: usize> Sums<'_, T, F> {
    /// Adds to the corners of the cell of position `i`, as far as their rows are in the bucket.
    #[inline(always)]
    fn add(&mut self, cells: &Cells<T>, i: usize, values: &[[T; F]; 8]) {
        for pair in 0..4 {
            let [a, b] = [0, 1].map(|c| cells.rows[2 * pair + c][i].wrapping_sub(self.first) as usize);
            for (row, value) in [(a, &values[2 * pair]), (b, &values[2 * pair + 1])] {
                if let Some(sum) = self.sums.get_mut(row) {
                    for f in 0..F {
                        sum[f] += value[f];
                    }
                }
            }
            // Neighbours along x are in the same word, with few exceptions.
            let [bit_a, bit_b] = [a, b].map(|row| 1u64 << (row % 64));
            if a / 64 == b / 64 {
                if let Some(word) = self.touched.get_mut(a / 64) {
                    *word |= bit_a | bit_b;
                }
            } else {
                for (row, bit) in [(a, bit_a), (b, bit_b)] {
                    if let Some(word) = self.touched.get_mut(row / 64) {
                        *word |= bit;
                    }
                }
            }
        }
    }
}

dispatched! {
/// Adds the contributions of positions to the rows of a level that are in the bucket that begins at row `first`. `g` is `[positions, F]`.
fn add<T: Real, const F: usize, const FUSED: bool>(
    level: &Level,
    groups: &[Group<T>],
    g: &[T],
    first: u32,
    sums: &mut [T],
    touched: &mut [u64],
) {
    let mut bucket = Sums { first, sums: sums.as_chunks_mut::<F>().0, touched };
    let mut next = Cells::new::<FUSED>(level, &groups[0]);
    for (k, g) in g.as_chunks::<F>().0.chunks(TOGETHER).enumerate() {
        let cells = next;
        if let Some(group) = groups.get(k + 1) {
            next = Cells::new::<FUSED>(level, group);
            next.prefetch(first, bucket.sums);
        }
        let (weights, continued) = (cells.weights(), cells.continued());
        // Contributions to the corners of the current cell, unless it has none.
        let mut values = [[T::zero(); F]; 8];
        let mut any = false;
        for i in 0..g.len() {
            if g[i].iter().any(|&g| g != T::zero()) {
                any = true;
                for c in 0..8 {
                    for f in 0..F {
                        values[c][f] = g[i][f].multiply_add::<FUSED>(weights[c][i], values[c][f]);
                    }
                }
            }
            if any && !(i + 1 < g.len() && continued[i + 1]) {
                bucket.add(&cells, i, &values);
                values = [[T::zero(); F]; 8];
                any = false;
            }
        }
    }
}
}
