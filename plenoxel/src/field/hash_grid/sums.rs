//! Adjoint of the table: sums of contributions to its rows, which the optimizer requests one bucket of rows after another.
//!
//! A bucket has as many rows as the largest level, but at most 8 MB in single precision. The contributions of all positions to its levels are computed when
//! they are added; none is stored. The rows whose sum is not 0 are marked at the end. There are about as many tasks as levels that share rows, so more threads
//! than levels are of no use.

use super::loops::{BLOCK, Cells, Group, TOGETHER, with_features};
use super::{HashGrid, Level};
use autograd::lattice::bits;
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
                    with_features!(features, add::<T>(level, groups, g, rows.start as u32, sums));
                }
            }
        }
        with_features!(features, mark::<T>(sums, touched));
    }
}

dispatched! {
/// Adds the contributions of positions to the rows of a level that are in the bucket that begins at row `first`. `g` is `[positions, F]`.
fn add<T: Real, const F: usize, const FUSED: bool>(level: &Level, groups: &[Group<T>], g: &[T], first: u32, sums: &mut [T]) {
    let sums = sums.as_chunks_mut::<F>().0;
    let mut cells = Cells::none();
    for (group, g) in groups.iter().zip(g.as_chunks::<F>().0.chunks(TOGETHER)) {
        cells.find::<FUSED>(level, (level.first as u32).wrapping_sub(first), group);
        let mut padded = [[T::zero(); F]; TOGETHER];
        let cotangents = g.first_chunk().unwrap_or_else(|| {
            padded[..g.len()].copy_from_slice(g);
            &padded
        });
        if level.hashed { add_group::<T, F, true>(&cells, cotangents, sums) } else { add_group::<T, F, false>(&cells, cotangents, sums) }
    }
}
}

/// Adds the contributions of a group of positions. The corners of a cell are the ends of four edges along x. If the two rows of each edge are neighbors, both
/// are updated at once. In a level that is not hashed, they are neighbors unless the row number wraps at the end of the level. In a hashed level, they are in
/// every other cell, because the rows of the nodes 2i and 2i + 1 differ in the last bit only. The factors of y and z are odd, so a step along y or z flips that
/// bit: if the lower node has the even row on edges 0 and 3, the upper node has it on edges 1 and 2, and vice versa.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn add_group<T: Real, const F: usize, const HASHED: bool>(cells: &Cells<T>, g: &[[T; F]; TOGETHER], sums: &mut [[T; F]]) {
    let (edges, [x, y, z], count) = (cells.edges(), &cells.shares, sums.len() as u32);
    let mut apart = cells.apart::<HASHED>();
    for [lower, upper] in edges {
        for i in 0..TOGETHER {
            apart[i] |= u32::from(lower[i].max(upper[i]) >= count);
        }
    }
    let mut along_x = [[T::zero(); TOGETHER]; 2];
    for i in 0..TOGETHER {
        let (lower, upper) = (x[0][i], x[1][i]);
        let upper_is_even = HASHED && (edges[0][0][i] & 1) > apart[i]; // The lower row is odd, and the rows are not apart.
        along_x[0][i] = if upper_is_even { upper } else { lower };
        along_x[1][i] = if upper_is_even { lower } else { upper };
    }
    let mut values = [[[T::zero(); F]; 2]; TOGETHER];
    for i in 0..TOGETHER {
        for end in 0..2 {
            for f in 0..F {
                values[i][end][f] = along_x[end][i] * g[i][f];
            }
        }
    }
    let mut weights = [[T::zero(); TOGETHER]; 4];
    for e in 0..4 {
        for i in 0..TOGETHER {
            weights[e][i] = y[e & 1][i] * z[e >> 1][i];
        }
    }
    let (mut neighbors, mut contributes) = (0u64, 0u64);
    for i in 0..TOGETHER {
        neighbors |= u64::from(apart[i] == 0) << i;
        contributes |= u64::from(g[i].iter().fold(false, |any, &g| any | (g != T::zero()))) << i;
    }
    for i in bits(neighbors & contributes) {
        let [first, second] = values[i];
        for e in 0..4 {
            let values = if HASHED && (e == 1 || e == 2) { [second, first] } else { [first, second] };
            let row = if HASHED { edges[e][0][i] & !1 } else { edges[e][0][i] } as usize;
            for (sum, value) in sums[row..row + 2].iter_mut().zip(&values) {
                add_weighted(sum, value, weights[e][i]);
            }
        }
    }
    for i in bits(!neighbors & contributes) {
        for e in 0..4 {
            for end in 0..2 {
                if let Some(sum) = sums.get_mut(edges[e][end][i] as usize) {
                    add_weighted(sum, &values[i][end], weights[e][i]);
                }
            }
        }
    }
}

#[inline(always)]
fn add_weighted<T: Real, const F: usize>(sum: &mut [T; F], value: &[T; F], weight: T) {
    for f in 0..F {
        sum[f] += value[f] * weight;
    }
}

dispatched! {
/// Sets the bits of the rows that are not 0.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn mark<T: Real, const F: usize, const FUSED: bool>(sums: &[T], touched: &mut [u64]) {
    for (word, rows) in touched.iter_mut().zip(sums.as_chunks::<F>().0.chunks(64)) {
        let mut bits = 0;
        for (r, row) in rows.iter().enumerate() {
            let mut any = false;
            for f in 0..F {
                any |= row[f] != T::zero();
            }
            bits |= u64::from(any) << r;
        }
        *word |= bits;
    }
}
}
