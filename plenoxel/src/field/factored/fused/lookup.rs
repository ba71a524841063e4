//! Look-ups in planes and lines, and the adjoint of planes.
//!
//! A row of a table is a number of chunks of [`LANES`] components.

use super::super::{PLANE_OF, SCALE, SHIFT};
use autograd::single::is_single;
use autograd::{Real, dispatched, parallel};

/// Number of components that are computed together. The number of components of a field is a multiple of it.
pub const LANES: usize = 16;

/// Number of samples between the current one and that whose cotangents are prefetched.
const AHEAD: usize = 6;

/// Number of samples that are looked up together.
pub const RUN: usize = 16;

/// Tables of a density or an appearance.
#[derive(Clone, Copy)]
pub struct Pairs<'a, T> {
    pub planes: [&'a [T]; 3],
    pub lines: [&'a [T]; 3],
    /// Nodes along each axis.
    pub nodes: [usize; 3],
    /// Components of each pair.
    pub width: usize,
}

/// Position between the nodes of an axis: the lower node, and the distance from it in cells.
#[derive(Clone, Copy, Default)]
struct Between<T> {
    node: usize,
    share: T,
}

impl<T: Real> Between<T> {
    #[inline(always)]
    fn new(cell: T, nodes: usize) -> Self {
        let node = (cell.index() as usize).min(nodes - 2);
        Between { node, share: cell - T::lit(node as f64) }
    }
}

/// Cell of a plane: its four rows and their weights.
#[derive(Clone, Copy)]
struct Corner<T> {
    rows: [usize; 4],
    weights: [T; 4],
}

impl<T: Real> Corner<T> {
    #[inline(always)]
    fn new(axis: usize, between: [Between<T>; 3], nodes: [usize; 3]) -> Self {
        let [b, c] = PLANE_OF[axis];
        let (b, c, stride) = (between[b], between[c], nodes[c]);
        let (u, v) = (T::one() - b.share, T::one() - c.share);
        let first = b.node * stride + c.node;
        let rows = [first, first + 1, first + stride, first + stride + 1];
        Corner { rows, weights: [u * v, u * c.share, b.share * v, b.share * c.share] }
    }
}

dispatched! {
/// Finds the first row of the plane of an axis that each sample reads. The others are the next one, and the same two after a row of nodes.
pub fn first_rows<T: Real>(axis: usize, at: Places<'_, T>, nodes: [usize; 3], out: &mut [u32]) {
    let ([b, c], stride) = (PLANE_OF[axis].map(|a| &at[a][..out.len()]), nodes[PLANE_OF[axis][1]] as u32);
    let most = PLANE_OF[axis].map(|a| nodes[a] as u32 - 2);
    for i in 0..out.len() {
        out[i] = b[i].index().min(most[0]) * stride + c[i].index().min(most[1]);
    }
}
}

dispatched! {
/// Computes the opacity 1 − exp(−σδ) and the transmittance exp(−σδ) of samples.
pub fn absorb<T: Real, const FUSED: bool>(sigma: &[T], delta: &[T], opacity: &mut [T], transmittance: &mut [T]) {
    for (((&sigma, &delta), opacity), transmittance) in sigma.iter().zip(delta).zip(opacity).zip(transmittance) {
        (*opacity, *transmittance) = (sigma * delta).absorb::<FUSED>();
    }
}
}

/// Returns ln(1 + e) for e in [0, 1], as 2 artanh(e / (2 + e)).
#[inline(always)]
fn ln_1p<T: Real>(e: T) -> T {
    let terms = if is_single::<T>() { 7 } else { 17 };
    let s = e / (T::lit(2.0) + e);
    let square = s * s;
    let mut sum = T::zero();
    for k in (0..terms).rev() {
        sum = sum * square + T::lit(2.0 / f64::from(2 * k + 1));
    }
    s * sum
}

#[inline(always)]
fn between<T: Real>(at: [T; 3], nodes: [usize; 3]) -> [Between<T>; 3] {
    [Between::new(at[0], nodes[0]), Between::new(at[1], nodes[1]), Between::new(at[2], nodes[2])]
}

/// Returns the interpolated chunk of a plane.
#[inline(always)]
fn plane_at<T: Real, const FUSED: bool>(table: &[[T; LANES]], corner: &Corner<T>, chunks: usize, k: usize) -> [T; LANES] {
    let (rows, weights) = (corner.rows, corner.weights);
    let [p, q] = [&table[rows[0] * chunks + k], &table[rows[1] * chunks + k]];
    let [r, s] = [&table[rows[2] * chunks + k], &table[rows[3] * chunks + k]];
    let mut value = [T::zero(); LANES];
    for i in 0..LANES {
        let sum = p[i] * weights[0];
        let sum = q[i].multiply_add::<FUSED>(weights[1], sum);
        let sum = r[i].multiply_add::<FUSED>(weights[2], sum);
        value[i] = s[i].multiply_add::<FUSED>(weights[3], sum);
    }
    value
}

/// Returns the interpolated chunk of a line.
#[inline(always)]
fn line_at<T: Real, const FUSED: bool>(table: &[[T; LANES]], along: Between<T>, chunks: usize, k: usize) -> [T; LANES] {
    let (p, q) = (&table[along.node * chunks + k], &table[(along.node + 1) * chunks + k]);
    let rest = T::one() - along.share;
    let mut value = [T::zero(); LANES];
    for i in 0..LANES {
        value[i] = q[i].multiply_add::<FUSED>(along.share, p[i] * rest);
    }
    value
}

/// Positions of up to [`RUN`] samples, in units of cells.
pub type Places<'a, T> = [&'a [T]; 3];

#[inline(always)]
fn place<T: Real>(at: Places<'_, T>, i: usize) -> [T; 3] {
    [at[0][i], at[1][i], at[2][i]]
}

/// Prefetches the plane rows of samples.
#[inline(always)]
fn prefetch<T: Real>(pairs: Pairs<'_, T>, at: Places<'_, T>) {
    let (nodes, width) = (pairs.nodes, pairs.width);
    for i in 0..at[0].len() {
        let between = between(place(at, i), nodes);
        for axis in 0..3 {
            let [first, _, second, _] = Corner::new(axis, between, nodes).rows;
            for first in [first, second] {
                parallel::prefetch(&pairs.planes[axis][first * width..][..2 * width]);
            }
        }
    }
}

dispatched! {
/// Computes the density σ and dσ/ds of samples.
pub fn density<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, sigma: &mut [T], slope: &mut [T]) {
    prefetch(pairs, at);
    let (nodes, chunks) = (pairs.nodes, pairs.width / LANES);
    let planes = pairs.planes.map(|table| table.as_chunks::<LANES>().0);
    let lines = pairs.lines.map(|table| table.as_chunks::<LANES>().0);
    for (i, sigma) in sigma.iter_mut().enumerate() {
        let between = between(place(at, i), nodes);
        let mut sums = [T::zero(); LANES];
        for axis in 0..3 {
            let (corner, along) = (Corner::new(axis, between, nodes), between[axis]);
            for k in 0..chunks {
                let plane = plane_at::<T, FUSED>(planes[axis], &corner, chunks, k);
                let line = line_at::<T, FUSED>(lines[axis], along, chunks, k);
                for l in 0..LANES {
                    sums[l] = plane[l].multiply_add::<FUSED>(line[l], sums[l]);
                }
            }
        }
        let mut width = LANES / 2;
        while width > 0 {
            for l in 0..width {
                sums[l] += sums[l + width];
            }
            width /= 2;
        }
        *sigma = sums[0] + T::lit(SHIFT);
    }
    let scale = T::lit(SCALE);
    for (sigma, slope) in sigma.iter_mut().zip(slope) {
        let x = *sigma;
        let e = (-x.abs()).exp_::<FUSED>();
        let above = T::one() / (T::one() + e);
        *slope = scale * if x > T::zero() { above } else { e * above };
        *sigma = scale * (x.max(T::zero()) + ln_1p(e));
    }
}
}

dispatched! {
/// Computes the products plane · line of samples: rows of three times `width` values.
pub fn products<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, out: &mut [T]) {
    prefetch(pairs, at);
    let (nodes, chunks) = (pairs.nodes, pairs.width / LANES);
    let planes = pairs.planes.map(|table| table.as_chunks::<LANES>().0);
    let lines = pairs.lines.map(|table| table.as_chunks::<LANES>().0);
    for (i, out) in out.as_chunks_mut::<LANES>().0.chunks_exact_mut(3 * chunks).enumerate() {
        let between = between(place(at, i), nodes);
        for axis in 0..3 {
            let (corner, along) = (Corner::new(axis, between, nodes), between[axis]);
            for k in 0..chunks {
                let plane = plane_at::<T, FUSED>(planes[axis], &corner, chunks, k);
                let line = line_at::<T, FUSED>(lines[axis], along, chunks, k);
                for l in 0..LANES {
                    out[axis * chunks + k][l] = plane[l] * line[l];
                }
            }
        }
    }
}
}

dispatched! {
/// Adds the adjoint of lines. `g(i)` is the cotangent of the products of sample i: either three times `width` values, or one value that all products share.
pub fn add_to_lines<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, g: Cotangents<'_, T>, sums: &mut [T]) {
    prefetch(pairs, at);
    let (nodes, chunks) = (pairs.nodes, pairs.width / LANES);
    let planes = pairs.planes.map(|table| table.as_chunks::<LANES>().0);
    let sums = sums.as_chunks_mut::<LANES>().0;
    for i in 0..at[0].len() {
        let between = between(place(at, i), nodes);
        for axis in 0..3 {
            let (corner, along) = (Corner::new(axis, between, nodes), between[axis]);
            let first = nodes[..axis].iter().sum::<usize>() + along.node;
            for k in 0..chunks {
                let mut value = plane_at::<T, FUSED>(planes[axis], &corner, chunks, k);
                g.times(i, axis * chunks + k, 3 * chunks, &mut value);
                for (row, weight) in [(first, T::one() - along.share), (first + 1, along.share)] {
                    let sum = &mut sums[row * chunks + k];
                    for l in 0..LANES {
                        sum[l] = value[l].multiply_add::<FUSED>(weight, sum[l]);
                    }
                }
            }
        }
    }
}
}

/// Cotangents of products.
#[derive(Clone, Copy)]
pub enum Cotangents<'a, T> {
    /// One value per sample, for the sum of all products.
    Shared(&'a [T]),
    /// One value per sample and product.
    Each(&'a [T]),
}

impl<T: Real> Cotangents<'_, T> {
    /// Prefetches `count` chunks of sample i from chunk `k` of `chunks` on.
    #[inline(always)]
    fn prefetch(&self, i: usize, k: usize, chunks: usize, count: usize) {
        if let Cotangents::Each(g) = self {
            parallel::prefetch(&g[(i * chunks + k) * LANES..][..count * LANES]);
        }
    }

    /// Multiplies chunk `k` of `chunks` by the cotangents of sample i.
    #[inline(always)]
    fn times(&self, i: usize, k: usize, chunks: usize, value: &mut [T; LANES]) {
        match self {
            Cotangents::Shared(g) => value.iter_mut().for_each(|v| *v *= g[i]),
            Cotangents::Each(g) => {
                let g = &g.as_chunks::<LANES>().0[i * chunks + k];
                value.iter_mut().zip(g).for_each(|(v, &g)| *v *= g);
            }
        }
    }
}

/// The plane of an axis, whose adjoint is computed from the line along the axis.
#[derive(Clone, Copy)]
pub struct PlaneOf<'a, T> {
    pub axis: usize,
    pub line: &'a [T],
    /// Nodes along each axis.
    pub nodes: [usize; 3],
    /// Components of each pair.
    pub width: usize,
}

/// Rows of a plane in one bucket, whose sums are computed.
pub struct BucketSums<'a, T> {
    /// First row of the bucket.
    pub first: usize,
    pub sums: &'a mut [T],
    pub touched: &'a mut [u64],
}

dispatched! {
/// Adds the adjoint of a plane, for the samples `which`, to the rows of one bucket. `at` are the positions of all samples.
pub fn add_to_plane<T: Real, const FUSED: bool>(
    plane: PlaneOf<'_, T>,
    at: Places<'_, T>,
    which: &[u32],
    g: Cotangents<'_, T>,
    bucket: BucketSums<'_, T>,
) {
    let PlaneOf { axis, nodes, .. } = plane;
    let chunks = plane.width / LANES;
    let line = plane.line.as_chunks::<LANES>().0;
    let sums = bucket.sums.as_chunks_mut::<LANES>().0;
    let rows = sums.len() / chunks;
    for (k, &i) in which.iter().enumerate() {
        let i = i as usize;
        if let Some(&later) = which.get(k + AHEAD) {
            g.prefetch(later as usize, axis * chunks, 3 * chunks, chunks);
        }
        let between = between(place(at, i), nodes);
        let (corner, along) = (Corner::new(axis, between, nodes), between[axis]);
        for row in corner.rows {
            let row = row.wrapping_sub(bucket.first);
            if row < rows {
                bucket.touched[row / 64] |= 1 << (row % 64);
            }
        }
        for k in 0..chunks {
            let mut value = line_at::<T, FUSED>(line, along, chunks, k);
            g.times(i, axis * chunks + k, 3 * chunks, &mut value);
            for c in 0..4 {
                let (row, weight) = (corner.rows[c].wrapping_sub(bucket.first), corner.weights[c]);
                if row < rows {
                    let sum = &mut sums[row * chunks + k];
                    for l in 0..LANES {
                        sum[l] = value[l].multiply_add::<FUSED>(weight, sum[l]);
                    }
                }
            }
        }
    }
}
}
