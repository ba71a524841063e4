//! Rows and weights of many positions at once.

use autograd::lattice::{NodeMap, TOGETHER};
use autograd::ops::trilinear::{corners_of_many, nearest_node};
use autograd::{Buffer, Real, dispatched, parallel};
use std::slice::from_mut;

/// Number of samples between the prefetch of a row and its use.
pub(super) const AHEAD: usize = 32;

/// Prefetches the rows that are in a table.
#[inline(always)]
pub(super) fn prefetch_rows<E>(table: &[E], rows: &[u32]) {
    rows.iter().filter_map(|&row| table.get(row as usize)).for_each(parallel::prefetch_early);
}

/// Rows and weights of the eight corners around each sample.
#[derive(Debug)]
pub(super) struct Corners<T: Real> {
    /// Eight entries per sample.
    rows: Buffer<u32>,
    weights: Buffer<T>,
}

/// Corners of a group of samples that are looked up together, stored corner by corner.
pub(super) struct Group<T> {
    rows: [[u32; TOGETHER]; 8],
    weights: [[T; TOGETHER]; 8],
}

dispatched! {
/// Finds the row of the voxel that contains each position; `u32::MAX` if the voxel is absent.
pub(super) fn nearest_rows<T: Real, M: NodeMap>(at: [&[T]; 3], map: M, rows: &mut [u32]) {
    let [x, y, z] = at.map(|a| &a[..rows.len()]);
    for (i, row) in rows.iter_mut().enumerate() {
        *row = map.code(nearest_node([x[i], y[i], z[i]], map.nodes()));
    }
    for row in rows {
        *row = map.row_of(*row).unwrap_or(u32::MAX);
    }
}
}

dispatched! {
/// Reads a table of one column at rows, some of which are absent (`u32::MAX`), [`TOGETHER`] at a time.
pub(super) fn read_or<T: Real>(table: &[T], rows: &[u32], absent: T, out: &mut [T]) {
    if table.is_empty() {
        return out.fill(absent);
    }
    let (groups, rest) = rows.as_chunks::<TOGETHER>();
    let (out_groups, out_rest) = out.as_chunks_mut::<TOGETHER>();
    for (rows, out) in groups.iter().zip(out_groups) {
        let mut present = [0; TOGETHER];
        for i in 0..TOGETHER {
            present[i] = if rows[i] == u32::MAX { 0 } else { rows[i] };
        }
        let found = parallel::gathered(table, present);
        for i in 0..TOGETHER {
            out[i] = if rows[i] == u32::MAX { absent } else { found[i] };
        }
    }
    for (&row, out) in rest.iter().zip(out_rest) {
        *out = if row == u32::MAX { absent } else { table[row as usize] };
    }
}
}

impl<T: Real> Group<T> {
    /// Creates an empty group.
    pub fn none() -> Self {
        Group { rows: [[0; TOGETHER]; 8], weights: [[T::zero(); TOGETHER]; 8] }
    }

    /// Finds the corners of at most [`TOGETHER`] positions.
    #[inline(always)]
    pub fn find(&mut self, at: [&[T]; 3], map: impl NodeMap) {
        corners_of_many(at, map, from_mut(&mut self.rows), from_mut(&mut self.weights));
    }

    /// Prefetches the corners in a table of one column. Neighbors along the last axis mostly are in the same cache line, so only every second corner is
    /// prefetched.
    pub fn prefetch_rows(&self, table: &[T]) {
        self.rows.iter().step_by(2).for_each(|rows| prefetch_rows(table, rows));
    }

    /// Interpolates a table of one column at each position.
    pub fn density(&self, table: &[T], values: &mut [T]) {
        interpolate(table, &self.rows, &self.weights, values);
    }
}

impl<T: Real> Corners<T> {
    /// Finds the corners of `count` positions.
    pub fn find(at: [&[T]; 3], map: impl NodeMap, count: usize) -> Self {
        let (mut corners, mut group) = (Corners::none(), Group::none());
        corners.make_room(count);
        for first in (0..count).step_by(TOGETHER) {
            let own = first..count.min(first + TOGETHER);
            group.find(at.map(|at| &at[own.clone()]), map);
            corners.put(first, 0..own.len(), &group);
        }
        corners
    }

    /// Creates corners of no samples.
    pub fn none() -> Self {
        Corners { rows: Buffer::stale(0), weights: Buffer::stale(0) }
    }

    /// Reserves memory for `count` samples.
    pub fn make_room(&mut self, count: usize) {
        self.rows.grow(8 * count);
        self.weights.grow(8 * count);
    }

    /// Removes all samples but the first `count`.
    pub fn truncate(&mut self, count: usize) {
        self.rows.truncate(8 * count);
        self.weights.truncate(8 * count);
    }

    /// Copies corners of some samples of a group to the samples from `first` on. Panics if the capacity is too small.
    pub fn put(&mut self, first: usize, from: impl ExactSizeIterator<Item = usize> + Clone, group: &Group<T>) {
        let own = first..first + from.len();
        transpose(&group.rows, from.clone(), &mut self.rows.as_chunks_mut().0[own.clone()]);
        transpose(&group.weights, from, &mut self.weights.as_chunks_mut().0[own]);
    }

    /// Sets the corners of a sample. Panics if the capacity is too small.
    #[inline(always)]
    pub fn set(&mut self, i: usize, (rows, weights): ([u32; 8], [T; 8])) {
        self.rows.as_chunks_mut().0[i] = rows;
        self.weights.as_chunks_mut().0[i] = weights;
    }

    /// Returns rows and weights of a sample.
    #[inline(always)]
    pub fn of(&self, i: usize) -> ([u32; 8], [T; 8]) {
        (self.rows.as_chunks().0[i], self.weights.as_chunks().0[i])
    }
}

dispatched! {
/// Copies the corners of some samples of a group, one sample after another.
fn transpose<N: Copy>(group: &[[N; TOGETHER]; 8], from: impl Iterator<Item = usize>, to: &mut [[N; 8]]) {
    for (to, i) in to.iter_mut().zip(from) {
        for c in 0..8 {
            to[c] = group[c][i % TOGETHER];
        }
    }
}
}

dispatched! {
fn interpolate<T: Real>(table: &[T], rows: &[[u32; TOGETHER]; 8], weights: &[[T; TOGETHER]; 8], values: &mut [T]) {
    let mut sum = [T::zero(); TOGETHER];
    for (rows, weights) in rows.iter().zip(weights) {
        let own = parallel::gathered(table, *rows);
        for i in 0..TOGETHER {
            sum[i] += weights[i] * own[i];
        }
    }
    values.copy_from_slice(&sum[..values.len()]);
}
}

dispatched! {
/// Computes the absorbed fraction 1 − exp(−σ δ) and the transmitted fraction of the interval of each sample; σ = max(0, density).
pub(super) fn absorptions<T: Real, const FUSED: bool>(density: &[T], delta: &[T], alpha: &mut [T], through: &mut [T]) {
    for (((a, e), &s), &d) in alpha.iter_mut().zip(through).zip(density).zip(delta) {
        (*a, *e) = (s.max(T::zero()) * d).absorb::<FUSED>();
    }
}
}

dispatched! {
/// Computes Σⱼ wⱼ rowⱼ of a table of three columns for the visible samples, and zeros for the others.
pub(super) fn plain<T: Real, const K: usize>(
    table: &[T],
    look: impl Fn(usize) -> ([u32; K], [T; K]),
    seen: impl Fn(usize) -> bool,
    out: &mut [[T; 3]],
) {
    let table = table.as_chunks::<3>().0;
    let count = out.len();
    for (i, out) in out.iter_mut().enumerate() {
        if i + AHEAD < count {
            prefetch_rows(table, &look(i + AHEAD).0);
        }
        let mut sum = [T::zero(); 3];
        if seen(i) {
            let (rows, weights) = look(i);
            for k in 0..K {
                let row = table[rows[k] as usize];
                (0..3).for_each(|c| sum[c] += weights[k] * row[c]);
            }
        }
        *out = sum;
    }
}
}

/// View directions of rays, as values of the harmonics.
#[derive(Clone, Copy)]
pub(super) struct Directions<'a, T> {
    /// `count` numbers per ray.
    pub basis: &'a [T],
    pub count: usize,
    /// Color of zero coefficients.
    pub offset: T,
}

/// Evaluates an expression with the width of the table, the number of harmonics, and whether multiply-add is fused.
macro_rules! with_degree {
    ($count:expr, $w:ident, $n:ident, $fused:ident => $body:expr) => {{
        macro_rules! run {
            ($width:literal, $harmonics:literal) => {{
                const $w: usize = $width;
                const $n: usize = $harmonics;
                if parallel::fused() {
                    const $fused: bool = true;
                    $body
                } else {
                    const $fused: bool = false;
                    $body
                }
            }};
        }
        match $count {
            1 => run!(3, 1),
            4 => run!(12, 4),
            9 => run!(27, 9),
            _ => run!(48, 16),
        }
    }};
}

/// Computes the colors offset + Σₖ Yₖ Σⱼ wⱼ rowⱼₖ of the visible samples, and zeros for the others. Ray r of `directions` owns the samples
/// `offsets[r]..offsets[r + 1]`.
pub(super) fn harmonics<T: Real, const K: usize>(
    table: &[T],
    offsets: &[u32],
    directions: Directions<'_, T>,
    look: impl Fn(usize) -> ([u32; K], [T; K]),
    seen: impl Fn(usize) -> bool,
    out: &mut [[T; 3]],
) {
    with_degree!(directions.count, W, N, FUSED => of_rays::<T, K, W, N, FUSED>(table, offsets, directions, look, seen, out));
}

/// Computes the colors of [`harmonics`] at positions with trilinear look-up. `rays` has the ray of each position; `out` gets one color per position.
pub(super) fn harmonics_of<T: Real>(
    table: &[T],
    at: [&[T]; 3],
    map: impl NodeMap,
    rays: &[u32],
    directions: Directions<'_, T>,
    out: &mut [[T; 3]],
) {
    with_degree!(directions.count, W, N, FUSED => of_positions::<T, _, W, N, FUSED>(table, at, map, rays, directions, out));
}

dispatched! {
/// Implements [`harmonics`] for tables of width `W` with `N` harmonics.
fn of_rays<T: Real, const K: usize, const W: usize, const N: usize, const FUSED: bool>(
    table: &[T],
    offsets: &[u32],
    directions: Directions<'_, T>,
    look: impl Fn(usize) -> ([u32; K], [T; K]),
    seen: impl Fn(usize) -> bool,
    out: &mut [[T; 3]],
) {
    // Interpolate the coefficients of several samples first, then compute their colors: the two loops use vectors of different lengths.
    let mut sums = [[T::zero(); W]; TOGETHER];
    let table = table.as_chunks::<W>().0;
    for (own, basis) in offsets.windows(2).zip(directions.basis.as_chunks::<N>().0) {
        for (run, out) in out[own[0] as usize..own[1] as usize].chunks_mut(TOGETHER).enumerate() {
            let first = own[0] as usize + run * TOGETHER;
            for (i, sum) in sums[..out.len()].iter_mut().enumerate() {
                if seen(first + i) {
                    let (rows, weights) = look(first + i);
                    weigh_all::<T, K, W, FUSED>(rows.map(|row| &table[row as usize]), weights, sum);
                }
            }
            for (i, (out, sum)) in out.iter_mut().zip(&sums).enumerate() {
                *out = if seen(first + i) { color::<T, W, N, FUSED>(sum, basis, directions.offset) } else { [T::zero(); 3] };
            }
        }
    }
}
}

dispatched! {
fn of_positions<T: Real, M: NodeMap, const W: usize, const N: usize, const FUSED: bool>(
    table: &[T],
    at: [&[T]; 3],
    map: M,
    rays: &[u32],
    directions: Directions<'_, T>,
    out: &mut [[T; 3]],
) {
    let mut sums = [[T::zero(); W]; TOGETHER];
    let [mut group, mut next] = [Group::none(), Group::none()];
    let (table, basis) = (table.as_chunks::<W>().0, directions.basis.as_chunks::<N>().0);
    let count = rays.len();
    group.find(at.map(|at| &at[..count.min(TOGETHER)]), map);
    for (k, (rays, out)) in rays.chunks(TOGETHER).zip(out.chunks_mut(TOGETHER)).enumerate() {
        let (first, end) = (count.min((k + 1) * TOGETHER), count.min((k + 2) * TOGETHER));
        if first < end {
            next.find(at.map(|at| &at[first..end]), map);
        }
        for (i, sum) in sums[..rays.len()].iter_mut().enumerate() {
            if i < end - first {
                next.rows.iter().for_each(|rows| parallel::prefetch_early(&table[rows[i] as usize]));
            }
            let own = group.rows.each_ref().map(|rows| &table[rows[i] as usize]);
            weigh_all::<T, 8, W, FUSED>(own, group.weights.each_ref().map(|weights| weights[i]), sum);
        }
        for ((out, sum), &ray) in out.iter_mut().zip(&sums).zip(rays) {
            *out = color::<T, W, N, FUSED>(sum, &basis[ray as usize], directions.offset);
        }
        std::mem::swap(&mut group, &mut next);
    }
}
}

/// Returns offset + Σₖ basisₖ coefficientₖ in red, green and blue.
#[inline(always)]
fn color<T: Real, const W: usize, const N: usize, const FUSED: bool>(coefficients: &[T; W], basis: &[T; N], offset: T) -> [T; 3] {
    std::array::from_fn(|c| {
        let mut color = offset;
        for k in 0..N {
            color = coefficients[c * N + k].multiply_add::<FUSED>(basis[k], color);
        }
        color
    })
}

/// Computes Σ weightₖ rowₖ, in whole vectors if a row is long enough.
#[inline(always)]
pub(super) fn weigh_all<T: Real, const K: usize, const W: usize, const FUSED: bool>(rows: [&[T; W]; K], weights: [T; K], sum: &mut [T; W]) {
    if W >= 16 {
        weigh::<T, K, W, 16, FUSED>(rows, weights, sum);
    } else {
        weigh::<T, K, W, 3, FUSED>(rows, weights, sum);
    }
}

/// Computes Σ weightₖ rowₖ, `L` columns at a time. The last part overlaps the one before, so that all parts are whole vectors.
#[inline(always)]
fn weigh<T: Real, const K: usize, const W: usize, const L: usize, const FUSED: bool>(
    rows: [&[T; W]; K],
    weights: [T; K],
    sum: &mut [T; W],
) {
    for part in 0..W.div_ceil(L) {
        let start = (part * L).min(W - L);
        let mut lanes = [T::zero(); L];
        for k in 0..K {
            let row: &[T; L] = rows[k][start..].first_chunk().expect("the part lies in the row");
            for l in 0..L {
                lanes[l] = weights[k].multiply_add::<FUSED>(row[l], lanes[l]);
            }
        }
        sum[start..start + L].copy_from_slice(&lanes);
    }
}
