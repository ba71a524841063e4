//! Look-ups in planes and lines, and their adjoints.
//!
//! A row of a table is a number of chunks of [`LANES`] components.

use super::super::{PLANE_OF, SCALE, SHIFT};
use autograd::single::is_single;
use autograd::{Buffer, Real, Tensor, dispatched, parallel};
use std::ops::Range;

/// Number of components that are computed together. The number of components of a field is a multiple of it.
pub const LANES: usize = 16;

/// Number of samples between the current one and that whose cotangents are prefetched.
const AHEAD: usize = 16;

/// Largest number of samples that are looked up together.
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

impl<'a, T: Real> Pairs<'a, T> {
    /// Takes three planes and three lines of `width` components from the tables of a field.
    pub fn of(tables: &'a [Tensor<T>], nodes: [usize; 3], width: usize) -> Self {
        let data = |first: usize| [0, 1, 2].map(|axis| tables[first + axis].data());
        Pairs { planes: data(0), lines: data(3), nodes, width }
    }

    /// Returns zeros for the nodes of the three lines, one line after another.
    pub fn zeros_of_lines(&self) -> Buffer<T> {
        Buffer::zeros(self.nodes.iter().sum::<usize>() * self.width)
    }
}

/// Cells of up to [`RUN`] samples, in columns.
pub(super) struct Cells<T> {
    /// Number of samples.
    pub count: usize,
    /// Lower node along each axis.
    pub node: [[u32; RUN]; 3],
    /// Distance from the lower node, in cells.
    pub share: [[T; RUN]; 3],
    /// Nodes along each axis.
    nodes: [usize; 3],
}

/// Cell of one sample in a plane: numbers of its first row and of the row after a row of nodes, and the weights of both and of those that follow them.
#[derive(Clone, Copy)]
pub(super) struct Corner<T> {
    pub rows: [usize; 2],
    weights: [T; 4],
}

/// Rows of one sample in a line: the lower one, and the weights of both.
#[derive(Clone, Copy)]
pub(super) struct Along<T> {
    pub row: usize,
    weights: [T; 2],
}

impl<T: Real> Cells<T> {
    /// Finds the cells of at most [`RUN`] samples.
    #[inline(always)]
    pub fn new(at: Places<'_, T>, nodes: [usize; 3]) -> Self {
        let count = at[0].len();
        let mut cells = Cells { count, node: [[0; RUN]; 3], share: [[T::zero(); RUN]; 3], nodes };
        for axis in 0..3 {
            let most = nodes[axis] as u32 - 2;
            let (at, node, share) = (&at[axis][..count], &mut cells.node[axis][..count], &mut cells.share[axis][..count]);
            for i in 0..count {
                node[i] = at[i].index().min(most);
                share[i] = at[i] - T::lit(f64::from(node[i]));
            }
        }
        cells
    }

    #[inline(always)]
    pub fn corner(&self, axis: usize, i: usize) -> Corner<T> {
        let [b, c] = PLANE_OF[axis];
        let (stride, x, y) = (self.nodes[c], self.share[b][i], self.share[c][i]);
        let (u, v) = (T::one() - x, T::one() - y);
        let first = self.node[b][i] as usize * stride + self.node[c][i] as usize;
        Corner { rows: [first, first + stride], weights: [u * v, u * y, x * v, x * y] }
    }

    #[inline(always)]
    pub fn along(&self, axis: usize, i: usize) -> Along<T> {
        let share = self.share[axis][i];
        Along { row: self.node[axis][i] as usize, weights: [T::one() - share, share] }
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

/// Coefficients of 2 artanh(s) = Σ 2 s²ᵏ⁺¹ / (2k + 1).
const ARTANH: [f64; 17] = {
    let mut coefficients = [0.0; 17];
    let mut k = 0;
    while k < coefficients.len() {
        coefficients[k] = 2.0 / (2 * k + 1) as f64;
        k += 1;
    }
    coefficients
};

/// Returns ln(1 + e) for e in [0, 1], as 2 artanh(e / (2 + e)).
#[inline(always)]
fn ln_1p<T: Real>(e: T) -> T {
    let s = e / (T::lit(2.0) + e);
    if const { is_single::<T>() } { artanh_series::<T, 7>(s) } else { artanh_series::<T, 17>(s) }
}

/// Returns the first terms of 2 artanh(s). Their number is a constant, so that loops over samples vectorise.
#[inline(always)]
fn artanh_series<T: Real, const TERMS: usize>(s: T) -> T {
    let square = s * s;
    let mut sum = T::zero();
    let mut k = TERMS;
    while k > 0 {
        k -= 1;
        sum = sum * square + T::lit(ARTANH[k]);
    }
    s * sum
}

/// Returns the interpolated chunk of a plane.
// Compilers make vectors of a loop over a chunk, for every instruction set, only if it writes to an array of its own, and not to one that the loop also reads.
// Closures inside of a dispatched function stay calls if a library function calls them: it has other target features.
#[inline(always)]
pub(super) fn plane_at<T: Real, const FUSED: bool>(table: &[[T; LANES]], corner: Corner<T>, chunks: usize, k: usize) -> [T; LANES] {
    let Corner { rows, weights } = corner;
    let (first, second) = (rows[0] * chunks + k, rows[1] * chunks + k);
    let (p, q, r, s) = (&table[first], &table[first + chunks], &table[second], &table[second + chunks]);
    let mut value = [T::zero(); LANES];
    for l in 0..LANES {
        let sum = p[l] * weights[0];
        let sum = q[l].multiply_add::<FUSED>(weights[1], sum);
        let sum = r[l].multiply_add::<FUSED>(weights[2], sum);
        value[l] = s[l].multiply_add::<FUSED>(weights[3], sum);
    }
    value
}

/// Returns the interpolated chunk of a line.
#[inline(always)]
pub(super) fn line_at<T: Real, const FUSED: bool>(table: &[[T; LANES]], along: Along<T>, chunks: usize, k: usize) -> [T; LANES] {
    let first = along.row * chunks + k;
    let (p, q) = (&table[first], &table[first + chunks]);
    let mut value = [T::zero(); LANES];
    for l in 0..LANES {
        value[l] = q[l].multiply_add::<FUSED>(along.weights[1], p[l] * along.weights[0]);
    }
    value
}

/// Adds `weight` times a chunk to a sum.
#[inline(always)]
pub(super) fn add_to<T: Real, const FUSED: bool>(sum: &mut [T; LANES], value: &[T; LANES], weight: T) {
    let old = *sum;
    let mut new = [T::zero(); LANES];
    for l in 0..LANES {
        new[l] = value[l].multiply_add::<FUSED>(weight, old[l]);
    }
    *sum = new;
}

/// Positions of samples, in units of cells.
pub type Places<'a, T> = [&'a [T]; 3];

/// Returns the rows of sample i in the plane of an axis: two pairs of neighbours.
#[inline(always)]
fn rows_of<'a, T: Real>(pairs: Pairs<'a, T>, cells: &Cells<T>, axis: usize, i: usize) -> [&'a [T]; 2] {
    cells.corner(axis, i).rows.map(|row| &pairs.planes[axis][row * pairs.width..][..2 * pairs.width])
}

/// Prefetches the rows of sample i in the plane of an axis, for a later run.
#[inline(always)]
fn prefetch_early<T: Real>(pairs: Pairs<'_, T>, cells: &Cells<T>, axis: usize, i: usize) {
    rows_of(pairs, cells, axis, i).into_iter().for_each(parallel::prefetch_early);
}

/// Prefetches the plane rows of samples that are looked up next.
#[inline(always)]
pub(super) fn prefetch<T: Real>(pairs: Pairs<'_, T>, cells: &Cells<T>) {
    for axis in 0..3 {
        for i in 0..cells.count {
            rows_of(pairs, cells, axis, i).into_iter().for_each(parallel::prefetch);
        }
    }
}

/// Adds up the lanes of each sum, into the first.
#[inline(always)]
pub(super) fn add_lanes<T: Real, const N: usize>(sums: &mut [[T; LANES]; N]) {
    let mut width = LANES / 2;
    while width > 0 {
        for sums in &mut *sums {
            for l in 0..width {
                sums[l] += sums[l + width];
            }
        }
        width /= 2;
    }
}

dispatched! {
/// Computes the density σ and dσ/ds of up to [`RUN`] samples. Meanwhile prefetches the rows of the samples that come `later`, up to [`RUN`].
pub fn density<T: Real, const FUSED: bool>(
    pairs: Pairs<'_, T>,
    at: Places<'_, T>,
    later: Places<'_, T>,
    sigma: &mut [T],
    slope: &mut [T],
) {
    let [cells, later] = [at, later].map(|at| Cells::new(at, pairs.nodes));
    let chunks = pairs.width / LANES;
    let mut sums = [[T::zero(); LANES]; RUN];
    for axis in 0..3 {
        let (plane, line) = (pairs.planes[axis].as_chunks::<LANES>().0, pairs.lines[axis].as_chunks::<LANES>().0);
        for k in 0..chunks {
            for (i, sum) in sums.iter_mut().enumerate() {
                if k == 0 && i < later.count {
                    prefetch_early(pairs, &later, axis, i);
                }
                if i >= cells.count {
                    continue;
                }
                let value = plane_at::<T, FUSED>(plane, cells.corner(axis, i), chunks, k);
                let factor = line_at::<T, FUSED>(line, cells.along(axis, i), chunks, k);
                let old = *sum;
                let mut new = [T::zero(); LANES];
                for l in 0..LANES {
                    new[l] = value[l].multiply_add::<FUSED>(factor[l], old[l]);
                }
                *sum = new;
            }
        }
    }
    add_lanes(&mut sums);
    for (sigma, sums) in sigma.iter_mut().zip(&sums) {
        *sigma = sums[0] + T::lit(SHIFT);
    }
    for (sigma, slope) in sigma.iter_mut().zip(slope) {
        (*sigma, *slope) = density_of::<T, FUSED>(*sigma);
    }
}
}

/// Returns the density σ and dσ/ds of a density feature s − 10.
#[inline(always)]
pub(super) fn density_of<T: Real, const FUSED: bool>(x: T) -> (T, T) {
    let scale = T::lit(SCALE);
    let e = (-x.abs()).exp_::<FUSED>();
    let above = T::one() / (T::one() + e);
    (scale * (x.max(T::zero()) + ln_1p(e)), scale * if x > T::zero() { above } else { e * above })
}

/// Returns a run of samples, which is empty behind the last.
#[inline(always)]
pub fn run_of<T>(at: Places<'_, T>, run: usize) -> Places<'_, T> {
    at.map(|at| &at[at.len().min(run * RUN)..at.len().min((run + 1) * RUN)])
}

/// Interpolates the three planes at samples: rows of three times `width` values.
pub fn planes<T: Real>(pairs: Pairs<'_, T>, at: Places<'_, T>, out: &mut [T]) {
    if parallel::fused() { planes_in_runs::<T, true>(pairs, at, out) } else { planes_in_runs::<T, false>(pairs, at, out) }
}

/// Computes the products plane · line at samples from the values of the planes: rows of three times `width` values.
pub fn times_lines<T: Real>(pairs: Pairs<'_, T>, at: Places<'_, T>, of_planes: &[T], out: &mut [T]) {
    let length = 3 * pairs.width * RUN;
    for (run, (of_planes, out)) in of_planes.chunks(length).zip(out.chunks_mut(length)).enumerate() {
        let at = run_of(at, run);
        if parallel::fused() {
            times_lines_of_run::<T, true>(pairs, at, of_planes, out);
        } else {
            times_lines_of_run::<T, false>(pairs, at, of_planes, out);
        }
    }
}

dispatched! {
/// Interpolates the planes at samples, run by run. Meanwhile prefetches the rows of the next run.
fn planes_in_runs<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, out: &mut [T]) {
    let chunks = pairs.width / LANES;
    let mut cells = Cells::new(run_of(at, 0), pairs.nodes);
    for axis in 0..3 {
        for i in 0..cells.count {
            prefetch_early(pairs, &cells, axis, i);
        }
    }
    for (run, out) in out.as_chunks_mut::<LANES>().0.chunks_mut(RUN * 3 * chunks).enumerate() {
        let next = Cells::new(run_of(at, run + 1), pairs.nodes);
        for axis in 0..3 {
            let plane = pairs.planes[axis].as_chunks::<LANES>().0;
            for (i, out) in out.chunks_exact_mut(3 * chunks).enumerate() {
                if i < next.count {
                    prefetch_early(pairs, &next, axis, i);
                }
                let corner = cells.corner(axis, i);
                for (k, out) in out[axis * chunks..][..chunks].iter_mut().enumerate() {
                    *out = plane_at::<T, FUSED>(plane, corner, chunks, k);
                }
            }
        }
        cells = next;
    }
}
}

dispatched! {
fn times_lines_of_run<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, of_planes: &[T], out: &mut [T]) {
    let cells = Cells::new(at, pairs.nodes);
    let chunks = pairs.width / LANES;
    let (of_planes, out) = (of_planes.as_chunks::<LANES>().0, out.as_chunks_mut::<LANES>().0);
    for axis in 0..3 {
        let line = pairs.lines[axis].as_chunks::<LANES>().0;
        for (i, (of_planes, out)) in of_planes.chunks_exact(3 * chunks).zip(out.chunks_exact_mut(3 * chunks)).enumerate() {
            let along = cells.along(axis, i);
            let (of_plane, out) = (&of_planes[axis * chunks..][..chunks], &mut out[axis * chunks..][..chunks]);
            for k in 0..chunks {
                let factor = line_at::<T, FUSED>(line, along, chunks, k);
                let mut product = [T::zero(); LANES];
                for l in 0..LANES {
                    product[l] = of_plane[k][l] * factor[l];
                }
                out[k] = product;
            }
        }
    }
}
}

/// Adds the adjoint of the lines to `sums`, for samples with the cotangents `g` and the values `of_planes` of the planes.
pub fn add_to_lines<T: Real>(pairs: Pairs<'_, T>, at: Places<'_, T>, of_planes: &[T], g: Cotangents<'_, T>, sums: &mut [T]) {
    let width = 3 * pairs.width;
    for first in (0..at[0].len()).step_by(RUN) {
        let range = first..at[0].len().min(first + RUN);
        let (at, of_planes, g) = (at.map(|at| &at[range.clone()]), &of_planes[range.start * width..], g.of(range.clone(), width));
        if parallel::fused() {
            add_run_to_lines::<T, true>(pairs, at, of_planes, g, sums);
        } else {
            add_run_to_lines::<T, false>(pairs, at, of_planes, g, sums);
        }
    }
}

dispatched! {
fn add_run_to_lines<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, of_planes: &[T], g: Cotangents<'_, T>, sums: &mut [T]) {
    let cells = Cells::new(at, pairs.nodes);
    let (nodes, chunks) = (pairs.nodes, pairs.width / LANES);
    let (of_planes, sums) = (of_planes.as_chunks::<LANES>().0, sums.as_chunks_mut::<LANES>().0);
    for axis in 0..3 {
        let before = nodes[..axis].iter().sum::<usize>();
        let sums = &mut sums[before * chunks..];
        for i in 0..cells.count {
            let along = cells.along(axis, i);
            for k in 0..chunks {
                let value = g.times(i, axis * chunks + k, 3 * chunks, of_planes[(3 * i + axis) * chunks + k]);
                for c in 0..2 {
                    add_to::<T, FUSED>(&mut sums[(along.row + c) * chunks + k], &value, along.weights[c]);
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

impl<'a, T: Real> Cotangents<'a, T> {
    /// Returns the cotangents of a range of samples with `width` products each.
    pub fn of(&self, samples: Range<usize>, width: usize) -> Cotangents<'a, T> {
        match self {
            Cotangents::Shared(g) => Cotangents::Shared(&g[samples]),
            Cotangents::Each(g) => Cotangents::Each(&g[width * samples.start..width * samples.end]),
        }
    }

    /// Prefetches `count` chunks of sample i from chunk `k` of `chunks` on.
    #[inline(always)]
    fn prefetch(&self, i: usize, k: usize, chunks: usize, count: usize) {
        if let Cotangents::Each(g) = self {
            parallel::prefetch_early(&g[(i * chunks + k) * LANES..][..count * LANES]);
        }
    }

    /// Returns a chunk times the cotangents of chunk `k` of `chunks` of sample i.
    #[inline(always)]
    pub fn times(&self, i: usize, k: usize, chunks: usize, value: [T; LANES]) -> [T; LANES] {
        let mut product = [T::zero(); LANES];
        match self {
            Cotangents::Shared(g) => {
                let g = g[i];
                for l in 0..LANES {
                    product[l] = value[l] * g;
                }
            }
            Cotangents::Each(g) => {
                let g = &g.as_chunks::<LANES>().0[i * chunks + k];
                for l in 0..LANES {
                    product[l] = value[l] * g[l];
                }
            }
        }
        product
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
    for (first, run) in which.chunks(RUN).enumerate() {
        let mut places = [[T::zero(); RUN]; 3];
        for axis in 0..3 {
            for (place, &i) in places[axis].iter_mut().zip(run) {
                *place = at[axis][i as usize];
            }
        }
        let [x, y, z] = &places;
        let cells = Cells::new([&x[..run.len()], &y[..run.len()], &z[..run.len()]], nodes);
        for (c, &i) in run.iter().enumerate() {
            if let Some(&later) = which.get(first * RUN + c + AHEAD) {
                g.prefetch(later as usize, axis * chunks, 3 * chunks, chunks);
            }
            let (Corner { rows: [p, r], weights }, along) = (cells.corner(axis, c), cells.along(axis, c));
            let (p, r) = (p.wrapping_sub(bucket.first), r.wrapping_sub(bucket.first));
            let of = [p, p.wrapping_add(1), r, r.wrapping_add(1)];
            for row in of {
                if row < rows {
                    bucket.touched[row / 64] |= 1 << (row % 64);
                }
            }
            for k in 0..chunks {
                let value = g.times(i as usize, axis * chunks + k, 3 * chunks, line_at::<T, FUSED>(line, along, chunks, k));
                for c in 0..4 {
                    if of[c] < rows {
                        add_to::<T, FUSED>(&mut sums[of[c] * chunks + k], &value, weights[c]);
                    }
                }
            }
        }
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::random::Stream;

    #[test]
    fn products_of_any_number_of_samples_are_those_of_each() {
        let (nodes, width) = ([5, 9, 7], 32);
        let numbers = |rows: usize, seed: u64| Stream::new(seed).uniform_tensor::<f64>(&[rows * width], -1.0, 1.0);
        let planes = [0, 1, 2].map(|axis| numbers(PLANE_OF[axis].map(|a| nodes[a]).iter().product(), axis as u64));
        let lines = [0, 1, 2].map(|axis| numbers(nodes[axis], 3 + axis as u64));
        let pairs = Pairs { planes: planes.each_ref().map(|x| x.data()), lines: lines.each_ref().map(|x| x.data()), nodes, width };
        for count in [0, 1, RUN - 1, RUN, RUN + 1, 2 * RUN + 3] {
            let at = [0, 1, 2].map(|axis| Stream::new(7 + axis as u64).uniform_tensor::<f64>(&[count], 0.0, nodes[axis] as f64 - 1.0));
            let at = at.each_ref().map(|x| x.data());
            let products = |at: Places<'_, f64>| {
                let [mut of_planes, mut out] = [(); 2].map(|()| vec![0.0; 3 * width * at[0].len()]);
                super::planes(pairs, at, &mut of_planes);
                times_lines(pairs, at, &of_planes, &mut out);
                out
            };
            for (i, all) in products(at).chunks(3 * width).enumerate() {
                assert_eq!(products(at.map(|at| &at[i..=i])), all, "sample {i} of {count}");
            }
        }
    }
}
