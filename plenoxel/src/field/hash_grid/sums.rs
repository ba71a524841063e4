//! Adjoint of the table: sums of contributions to its rows, which the optimizer requests one bucket of rows after another.
//!
//! A bucket has as many rows as the largest level, but at most 8 MB in single precision. The contributions of all positions to its levels are computed when
//! they are added; none is stored. Consecutive positions of a group in the same cell, as along a ray, contribute together. The rows whose sum is not 0 are
//! marked at the end. There are about as many tasks as levels that share rows, so more threads than levels are of no use.

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
    let (mut cells, mut values, mut padded) = (Cells::none(), [[[T::zero(); F]; TOGETHER]; 8], [[T::zero(); F]; TOGETHER]);
    for (group, g) in groups.iter().zip(g.as_chunks::<F>().0.chunks(TOGETHER)) {
        cells.find::<FUSED>(level, group);
        let weights = cells.weights();
        let cotangents = match g.first_chunk() {
            Some(all) => all,
            None => {
                padded[..g.len()].copy_from_slice(g);
                &padded
            }
        };
        for (values, weights) in values.iter_mut().zip(&weights) {
            for i in 0..TOGETHER {
                for f in 0..F {
                    values[i][f] = weights[i] * cotangents[i][f];
                }
            }
        }
        let count = join(&mut cells, &mut values, cotangents);
        for (rows, values) in cells.rows.iter().zip(&values) {
            for (row, value) in rows[..count].iter().zip(values) {
                if let Some(sum) = sums.get_mut(row.wrapping_sub(first) as usize) {
                    for f in 0..F {
                        sum[f] += value[f];
                    }
                }
            }
        }
    }
}
}

/// Adds up the contributions of consecutive positions in the same cell and leaves out those with cotangent 0, which do not separate others. Returns how many
/// are left, at the beginning of the arrays.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn join<T: Real, const F: usize>(cells: &mut Cells<T>, values: &mut [[[T; F]; TOGETHER]; 8], g: &[[T; F]; TOGETHER]) -> usize {
    let continued = cells.continued();
    let contributes = g.map(|g| g.iter().fold(false, |any, &g| any | (g != T::zero())));
    if contributes == [true; TOGETHER] && continued == [false; TOGETHER] {
        return TOGETHER;
    }
    let (mut count, mut begun) = (0, false);
    for i in 0..TOGETHER {
        begun &= continued[i];
        if contributes[i] {
            for (rows, values) in cells.rows.iter_mut().zip(values.iter_mut()) {
                if begun {
                    for f in 0..F {
                        values[count - 1][f] += values[i][f];
                    }
                } else {
                    (rows[count], values[count]) = (rows[i], values[i]);
                }
            }
            count += usize::from(!begun);
            begun = true;
        }
    }
    count
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
