//! Isotropic total variation of a grid's values.
//!
//! A cell consists of a node and its forward neighbours along x, y and z, all present. Its variation per channel is √(dx² + dy² + dz² + ε).
//! The total variation is the mean over cells and channels. The gradient is exact.

use super::Step;
use crate::field::voxel_grid::VoxelGrid;
use crate::random::{Purpose, bits};
use autograd::lattice::{BRICK, BRICK_ROWS, Neighbours, STRIDE, has, previous_in};
use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Lattice, Param, Real, RowSparse, RowSums, Tensor, dispatched, parallel};
use std::ops::Range;
use std::sync::Arc;

/// Added under the root to make it smooth (source paper).
const EPSILON: f64 = 1e-5;

/// Cells that a total variation covers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cells {
    /// All cells. The gradient is dense.
    Whole,
    /// A contiguous run of this fraction of the table's bricks, at a random position in each step (svox2 draws runs of rows). The gradient
    /// is row-sparse.
    Share(f64),
}

impl Cells {
    /// Fraction used by svox2.
    pub const SAMPLED: Cells = Cells::Share(0.01);
}

/// Returns a loss: the total variation of the density of a model with a voxel grid.
pub fn tv_density<T: Real, M: AsRef<VoxelGrid<T>>>(cells: Cells) -> impl Fn(&Step<'_, T, M>) -> Tensor<T> + Send + Sync {
    move |step| {
        let grid = step.model.as_ref();
        tv(step, &grid.density, grid.lattice(), cells, 0)
    }
}

/// Returns a loss: the total variation of colors or their harmonics. It is the mean over all channels, each over the cells of its own
/// table.
pub fn tv_color<T: Real, M: AsRef<VoxelGrid<T>>>(cells: Cells) -> impl Fn(&Step<'_, T, M>) -> Tensor<T> + Send + Sync {
    move |step| {
        let grid = step.model.as_ref();
        let color = tv(step, &grid.color, grid.lattice(), cells, 1);
        match (&grid.harmonics, grid.harmonics_lattice()) {
            (Some(table), Some(lattice)) => {
                let share = grid.shape().harmonics_width() as f64 / grid.shape().color.channels() as f64;
                (1.0 - share) * color + share * tv(step, table, lattice, cells, 2)
            }
            _ => color,
        }
    }
}

fn tv<T: Real, M>(step: &Step<'_, T, M>, table: &Param<T>, lattice: &Lattice, cells: Cells, stream: u64) -> Tensor<T> {
    match cells {
        Cells::Whole => total_variation(table.tensor(), lattice),
        Cells::Share(share) => {
            let bricks = lattice.rows() / BRICK_ROWS;
            let first = bits(step.seed, Purpose::Cells, step.number, stream) % bricks.max(1) as u64;
            let count = ((share * bricks as f64).ceil() as usize).clamp(1, bricks.max(1));
            total_variation_of_bricks(table.tensor(), lattice, first as usize, count)
        }
    }
}

/// Returns the total variation over all cells of a table `[rows, C]` in bricks, as a scalar. A grid without cells has variation 0. The
/// gradient is dense for the widths with a kernel, which include those of grids: C = 1, 3, 4, 9, 12, 24, 27, 45, 48.
///
/// Panics if the layout is row-major, or if the table has another number of rows.
#[track_caller]
pub fn total_variation<T: Real>(table: &Tensor<T>, lattice: &Lattice) -> Tensor<T> {
    of_run(table, lattice, None)
}

/// Returns the total variation over the cells of `count` bricks from `first` on, wrapping around. The gradient is row-sparse.
///
/// Panics if the layout is row-major, if the table has another number of rows, or if `first` or `count` exceeds the number of bricks.
#[track_caller]
pub fn total_variation_of_bricks<T: Real>(table: &Tensor<T>, lattice: &Lattice, first: usize, count: usize) -> Tensor<T> {
    let all = lattice.rows() / BRICK_ROWS;
    assert!(first < all.max(1) && count <= all.max(1), "total_variation_of_bricks: {count} bricks from {first} on, the table has {all}");
    of_run(table, lattice, Some((first, count.min(all))))
}

/// Computes the total variation over all cells, or over the cells of a run of bricks.
#[track_caller]
fn of_run<T: Real>(table: &Tensor<T>, lattice: &Lattice, part: Option<(usize, usize)>) -> Tensor<T> {
    check(table, lattice);
    match table.shape()[1] {
        1 => with_kernel::<T, 1, 4, 16>(table, lattice, part),
        3 => with_kernel::<T, 3, 12, 48>(table, lattice, part),
        // No grid has rows of 4 numbers, but workload W3 does: 5.8 ms with the kernel, 126 ms without (`benches/history/2026-11-24.md`).
        4 => with_kernel::<T, 4, 16, 64>(table, lattice, part),
        9 => with_kernel::<T, 9, 36, 144>(table, lattice, part),
        12 => with_kernel::<T, 12, 48, 192>(table, lattice, part),
        24 => with_kernel::<T, 24, 96, 384>(table, lattice, part),
        27 => with_kernel::<T, 27, 108, 432>(table, lattice, part),
        45 => with_kernel::<T, 45, 180, 720>(table, lattice, part),
        48 => with_kernel::<T, 48, 192, 768>(table, lattice, part),
        _ => {
            let (first, count) = part.map_or((0, lattice.rows()), |(first, count)| (first * BRICK_ROWS, count * BRICK_ROWS));
            sampled_total_variation(table, lattice, first, count)
        }
    }
}

/// Computes the total variation with the kernel for width `W`. `N` = 4 W is the length of a line, `S` = 16 W the length of a slab.
fn with_kernel<T: Real, const W: usize, const N: usize, const S: usize>(
    table: &Tensor<T>,
    lattice: &Lattice,
    part: Option<(usize, usize)>,
) -> Tensor<T> {
    const { assert!(N == 4 * W && S == 4 * N) };
    let bricks = lattice.neighbours();
    let (first, count) = part.unwrap_or((0, bricks.len()));
    let run = Run { first, count, all: bricks.len() };
    let values = table.data().as_chunks::<S>().0;
    let sums = parallel::map_chunks(count, TASK, |range| variation::<T, W, N, S>(values, bricks, run, range));
    let terms = run.bricks().map(|brick| bricks[brick].cells.count_ones() as usize).sum::<usize>() * W;
    let value = sums.into_iter().sum::<T>() / T::lit(terms.max(1) as f64);
    let kernel = TotalVariation::<W, N, S> { lattice: lattice.clone(), run, sparse: part.is_some(), terms };
    Tensor::from_kernel(vec![value].into(), &[], &[table], kernel)
}

/// Run of consecutive bricks, wrapping around after the last brick.
#[derive(Clone, Copy, Debug)]
struct Run {
    first: usize,
    count: usize,
    /// Number of bricks in the grid.
    all: usize,
}

impl Run {
    /// Returns the k-th brick of the run.
    #[inline(always)]
    fn brick(self, k: usize) -> usize {
        let brick = self.first + k;
        if brick < self.all { brick } else { brick - self.all }
    }

    /// Returns true if the run contains a brick.
    #[inline(always)]
    fn contains(self, brick: usize) -> bool {
        let k = if brick >= self.first { brick - self.first } else { brick + self.all - self.first };
        k < self.count
    }

    fn bricks(self) -> impl Iterator<Item = usize> {
        (0..self.count).map(move |k| self.brick(k))
    }
}

/// Returns the total variation over the cells of `count` rows from `first` on, wrapping around, as a scalar. The gradient is row-sparse.
///
/// Panics if the layout is row-major, or if the table has another number of rows.
#[track_caller]
pub fn sampled_total_variation<T: Real>(table: &Tensor<T>, lattice: &Lattice, first: usize, count: usize) -> Tensor<T> {
    check(table, lattice);
    let mut corners: [Vec<u32>; 4] = Default::default();
    for row in (0..count).map(|c| ((first + c) % lattice.rows()) as u32) {
        let Some(node) = lattice.node(row) else { continue };
        let ahead = |a: usize| {
            let mut next = node;
            next[a] += 1;
            if next[a] < lattice.nodes()[a] { lattice.row(next) } else { None }
        };
        if let (Some(x), Some(y), Some(z)) = (ahead(0), ahead(1), ahead(2)) {
            corners.iter_mut().zip([row, x, y, z]).for_each(|(rows, row)| rows.push(row));
        }
    }
    if corners[0].is_empty() {
        return Tensor::scalar(T::zero());
    }
    let [center, x, y, z] = corners.map(|rows| table.gather_rows(&Indices::from(rows)));
    let [x, y, z] = [x, y, z].map(|ahead| (ahead - &center).square());
    (x + y + z + EPSILON).sqrt().mean()
}

#[track_caller]
fn check<T: Real>(table: &Tensor<T>, lattice: &Lattice) {
    assert!(lattice.brick_map().is_some(), "total_variation: the lattice must be in bricks");
    assert!(
        table.ndim() == 2 && table.shape()[0] == lattice.rows(),
        "total_variation: the lattice has {} rows, the table has shape {:?}",
        lattice.rows(),
        table.shape()
    );
}

/// Kernel of [`total_variation`].
#[derive(Debug)]
struct TotalVariation<const W: usize, const N: usize, const S: usize> {
    lattice: Lattice,
    /// Bricks whose cells are included.
    run: Run,
    /// True if the gradient is row-sparse.
    sparse: bool,
    /// Number of cells times channels.
    terms: usize,
}

/// Number of bricks per task.
const TASK: usize = 256;

/// With q = s / √(…) for each cell and channel, s = cotangent / number of terms, the node of a cell gets −q (dx + dy + dz), and each
/// neighbour q d. The gradient is computed as a gather: a node collects from its own cell and from the three cells behind it, so no two
/// tasks write the same node. The roots are not kept from the forward pass: computing them again takes less time than writing and reading them.
///
/// A brick consists of four *slabs* of equal x, a slab of four *lines* of equal y, a line of four nodes along z. The loops run over slabs:
/// a step along x moves to another slab, a step along y shifts the lines, a step along z shifts the nodes of each line.
impl<T: Real, const W: usize, const N: usize, const S: usize> Kernel<T> for TotalVariation<W, N, S> {
    fn name(&self) -> &'static str {
        "total_variation"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        sampled_total_variation(&inputs[0], &self.lattice, self.run.first * BRICK_ROWS, self.run.count * BRICK_ROWS)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let table = call.input(0);
        let scale = call.cotangent().item() / T::lit(self.terms.max(1) as f64);
        let values = table.data().as_chunks::<S>().0;
        let bricks = self.lattice.neighbours();
        let reached: Vec<u32> = match self.sparse {
            false => (0..bricks.len() as u32).collect(),
            true => {
                let ahead = self.run.bricks().flat_map(|b| [Some(b as u32)].into_iter().chain(bricks[b].ahead).flatten());
                let mut reached: Vec<u32> = ahead.collect();
                reached.sort_unstable();
                reached.dedup();
                reached
            }
        };
        let mut gradient = Buffer::<T>::stale(reached.len() * BRICK_ROWS * W);
        parallel::for_each_chunk(gradient.as_chunks_mut::<S>().0, TASK * BRICK, |start, slabs| {
            gradients::<T, W, N, S>(values, bricks, self.run, &reached[start / BRICK..][..slabs.len() / BRICK], scale, slabs);
        });
        if !self.sparse {
            return out.dense(0, gradient);
        }
        let touched = reached.iter().map(|&brick| touched(bricks, self.run, brick as usize)).collect();
        let sums = RowsOfBricks { bricks: Members::new(&reached, bricks.len()), touched, width: W, values: gradient };
        out.rows(0, RowSparse::deferred(table.shape(), Arc::new(sums)));
    }
}

/// Returns the nodes of a brick that a cell of the run reads: nodes with a cell, and their forward neighbours.
fn touched(bricks: &[Neighbours], run: Run, brick: usize) -> u64 {
    let cells = |brick: usize| if run.contains(brick) { bricks[brick].cells } else { 0 };
    let own = cells(brick);
    (0..3).fold(own, |touched, axis| {
        let behind = bricks[brick].behind[axis].map_or(0, |behind| cells(behind as usize));
        touched | previous_in(own, behind, axis)
    })
}

/// Rows of some bricks, with their contributions.
#[derive(Debug)]
struct RowsOfBricks<T: Real> {
    bricks: Members,
    /// One bit per row of a brick, set if the row has a contribution.
    touched: Vec<u64>,
    width: usize,
    values: Buffer<T>,
}

impl<T: Real> RowSums<T> for RowsOfBricks<T> {
    fn bucket_shift(&self) -> u32 {
        const { assert!(1 << 6 == BRICK_ROWS) };
        6
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.bricks.place(bucket).is_none()
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        if let Some(k) = self.bricks.place(bucket) {
            let values = &self.values[k * BRICK_ROWS * self.width..][..BRICK_ROWS * self.width];
            sums.iter_mut().zip(values).for_each(|(sum, &value)| *sum += value);
            touched[0] |= self.touched[k];
        }
    }
}

/// A subset of the numbers below a bound, with constant-time look-up of positions.
#[derive(Debug)]
struct Members {
    bits: Vec<u64>,
    /// Number of members before each word of bits.
    before: Vec<u32>,
}

impl Members {
    /// Creates the subset from ascending numbers.
    fn new(ascending: &[u32], bound: usize) -> Self {
        let mut bits = vec![0u64; bound.div_ceil(64)];
        ascending.iter().for_each(|&member| bits[member as usize / 64] |= 1 << (member % 64));
        let count = |sum: &mut u32, word: &u64| Some(std::mem::replace(sum, *sum + word.count_ones()));
        let before = bits.iter().scan(0, count).collect();
        Members { bits, before }
    }

    /// Returns the number of members before `number`, or `None` if it is not a member.
    #[inline(always)]
    fn place(&self, number: usize) -> Option<usize> {
        let (word, bit) = (self.bits[number / 64], number % 64);
        (word >> bit & 1 == 1).then(|| self.before[number / 64] as usize + (word & ((1 << bit) - 1)).count_ones() as usize)
    }
}

/// Returns slab x of a brick, if the brick exists.
#[inline(always)]
fn slab<T, const S: usize>(table: &[[T; S]], brick: Option<u32>, x: usize) -> Option<&[T; S]> {
    brick.map(|b| &table[b as usize * BRICK + x])
}

/// Returns the nodes one step ahead along x, y and z of the nodes of a slab. If a brick is missing, they are arbitrary nodes, which no cell
/// reads.
#[inline(always)]
fn ahead<T: Real, const W: usize, const N: usize, const S: usize>(
    table: &[[T; S]],
    own: usize,
    x: usize,
    bricks: [Option<u32>; 3],
) -> (&[T; S], [T; S], [T; S]) {
    let here = &table[own * BRICK + x];
    let next_x = if x + 1 < BRICK { &table[own * BRICK + x + 1] } else { slab(table, bricks[0], 0).unwrap_or(here) };
    let (beyond_y, beyond_z) = (slab(table, bricks[1], x).unwrap_or(here), slab(table, bricks[2], x).unwrap_or(here));
    let (mut next_y, mut next_z) = (*here, *here);
    next_y[..S - N].copy_from_slice(&here[N..]);
    next_y[S - N..].copy_from_slice(&beyond_y[..N]);
    for y in 0..BRICK {
        let line = y * N..(y + 1) * N;
        next_z[line.start..line.end - W].copy_from_slice(&here[line.start + W..line.end]);
        next_z[line.end - W..line.end].copy_from_slice(&beyond_z[line.start..line.start + W]);
    }
    (next_x, next_y, next_z)
}

/// For each node of a slab: the differences d to the nodes ahead of it, and their root.
struct Differences<T, const S: usize> {
    along: [[T; S]; 3],
    /// dx² + dy² + dz² + ε
    square: [T; S],
    /// 1 / √(…); 0 for nodes without a cell.
    inverse_root: [T; S],
}

impl<T: Real, const S: usize> Differences<T, S> {
    /// Computes differences and roots of slab x of a brick.
    #[inline(always)]
    fn of<const W: usize, const N: usize>(table: &[[T; S]], bricks: &[Neighbours], brick: usize, x: usize) -> Self {
        let (next_x, next_y, next_z) = ahead::<T, W, N, S>(table, brick, x, bricks[brick].ahead);
        let v = &table[brick * BRICK + x];
        let [mut dx, mut dy, mut dz, mut square, mut inverse_root] = [[T::zero(); S]; 5];
        for l in 0..S {
            (dx[l], dy[l], dz[l]) = (next_x[l] - v[l], next_y[l] - v[l], next_z[l] - v[l]);
            square[l] = dx[l] * dx[l] + dy[l] * dy[l] + dz[l] * dz[l] + T::lit(EPSILON);
            inverse_root[l] = square[l].inverse_sqrt();
        }
        let cells = bricks[brick].cells >> (STRIDE[0] * x) & 0xffff;
        if cells != 0xffff {
            for node in (0..16).filter(|&node| !has(cells, node)) {
                inverse_root[node * W..(node + 1) * W].fill(T::zero());
            }
        }
        Differences { along: [dx, dy, dz], square, inverse_root }
    }

    /// Returns q d along each axis for s = 1.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    fn contributions(mut self) -> [[T; S]; 3] {
        for d in &mut self.along {
            for l in 0..S {
                d[l] *= self.inverse_root[l];
            }
        }
        self.along
    }
}

/// Prefetches a brick, and the parts of the bricks ahead along x and y that [`Differences::of`] reads. Larger bricks are left to the hardware.
#[inline(always)]
fn prefetch_brick<T: Real, const N: usize, const S: usize>(table: &[[T; S]], bricks: &[Neighbours], brick: usize) {
    if size_of::<[[T; S]; BRICK]>() > PREFETCHED {
        return;
    }
    parallel::prefetch(&table[brick * BRICK..][..BRICK]);
    let [ahead_x, ahead_y, _] = bricks[brick].ahead;
    if let Some(slab) = slab(table, ahead_x, 0) {
        parallel::prefetch(slab);
    }
    for x in 0..BRICK {
        if let Some(slab) = slab(table, ahead_y, x) {
            parallel::prefetch(&slab[..N]);
        }
    }
}

/// Largest size of a brick that is prefetched, in bytes.
const PREFETCHED: usize = 4096;
/// Number of bricks between the one that is read and the one that is prefetched.
const PREFETCH_AHEAD: usize = 2;

dispatched! {
/// Returns Σ √(dx² + dy² + dz² + ε) over the cells of a range of the run's bricks.
fn variation<T: Real, const W: usize, const N: usize, const S: usize>(
    table: &[[T; S]],
    bricks: &[Neighbours],
    run: Run,
    range: Range<usize>,
) -> T {
    let mut sum = T::zero();
    for k in range {
        if k + PREFETCH_AHEAD < run.count {
            prefetch_brick::<T, N, S>(table, bricks, run.brick(k + PREFETCH_AHEAD));
        }
        let mut lanes = [T::zero(); S];
        for x in 0..BRICK {
            let Differences { square, inverse_root, .. } = Differences::of::<W, N>(table, bricks, run.brick(k), x);
            for l in 0..S {
                lanes[l] += square[l] * inverse_root[l];
            }
        }
        sum += folded(lanes);
    }
    sum
}
}

/// Sums lanes pairwise. Sequential addition would take as long as all other work.
#[inline(always)]
fn folded<T: Real, const S: usize>(mut lanes: [T; S]) -> T {
    let mut width = S;
    while width.is_multiple_of(2) {
        width /= 2;
        for l in 0..width {
            lanes[l] += lanes[width + l];
        }
    }
    lanes[..width].iter().copied().sum()
}

/// Contributions q d, for s = 1, that leave a brick: those of its last slab to the brick ahead along x, of the last line of each slab along y, and of the last
/// node of each line along z.
type Passed<T, const S: usize> = [[T; S]; 3];

/// Stores the contributions of slab x that leave its brick.
#[inline(always)]
fn pass_on<T: Real, const W: usize, const N: usize, const S: usize>(passed: &mut Passed<T, S>, x: usize, [to_x, to_y, to_z]: &[[T; S]; 3]) {
    if x + 1 == BRICK {
        passed[0] = *to_x;
    }
    passed[1][x * N..(x + 1) * N].copy_from_slice(&to_y[S - N..]);
    for y in 0..BRICK {
        let (end, node) = ((y + 1) * N, (x * BRICK + y) * W);
        passed[2][node..node + W].copy_from_slice(&to_z[end - W..end]);
    }
}

/// Computes the contributions of a brick to the brick ahead along one axis.
#[inline(always)]
fn passed_along<T: Real, const W: usize, const N: usize, const S: usize>(
    table: &[[T; S]],
    bricks: &[Neighbours],
    run: Run,
    brick: usize,
    axis: usize,
) -> [T; S] {
    let mut passed = [[T::zero(); S]; 3];
    if run.contains(brick) {
        let first = if axis == 0 { BRICK - 1 } else { 0 };
        for x in first..BRICK {
            pass_on::<T, W, N, S>(&mut passed, x, &Differences::of::<W, N>(table, bricks, brick, x).contributions());
        }
    }
    passed[axis]
}

dispatched! {
/// Computes the gradient of some bricks. Cells outside of the run do not contribute.
fn gradients<T: Real, const W: usize, const N: usize, const S: usize>(
    table: &[[T; S]],
    bricks: &[Neighbours],
    run: Run,
    reached: &[u32],
    scale: T,
    out: &mut [[T; S]],
) {
    let zeros = [T::zero(); S];
    let mut passed = Buffer::<T>::stale(3 * reached.len() * S);
    let passed: &mut [Passed<T, S>] = passed.as_chunks_mut::<S>().0.as_chunks_mut().0;
    for (k, (&own, out)) in reached.iter().zip(out.as_chunks_mut::<BRICK>().0).enumerate() {
        if let Some(&later) = reached.get(k + PREFETCH_AHEAD) {
            prefetch_brick::<T, N, S>(table, bricks, later as usize);
        }
        // Bricks behind have lower numbers. Most were computed before in this call. Without gaps in `reached`, their place follows from their number.
        let behind = |axis: usize| match bricks[own as usize].behind[axis] {
            None => zeros,
            Some(brick) => {
                let near = brick.wrapping_sub(reached[0]) as usize;
                let is_near = near < k && reached[near] == brick;
                match if is_near { Ok(near) } else { reached[..k].binary_search(&brick) } {
                    Ok(before) => passed[before][axis],
                    Err(_) => passed_along::<T, W, N, S>(table, bricks, run, brick as usize, axis),
                }
            }
        };
        let [mut from_x, behind_y, behind_z] = [behind(0), behind(1), behind(2)];
        let included = run.contains(own as usize);
        for (x, g) in out.iter_mut().enumerate() {
            let to = if included { Differences::of::<W, N>(table, bricks, own as usize, x).contributions() } else { [zeros; 3] };
            let [to_x, to_y, to_z] = &to;
            let [mut from_y, mut from_z] = [zeros; 2];
            from_y[..N].copy_from_slice(&behind_y[x * N..(x + 1) * N]);
            from_y[N..].copy_from_slice(&to_y[..S - N]);
            for y in 0..BRICK {
                let (line, node) = (y * N, (x * BRICK + y) * W);
                from_z[line..line + W].copy_from_slice(&behind_z[node..node + W]);
                from_z[line + W..line + N].copy_from_slice(&to_z[line..line + N - W]);
            }
            for l in 0..S {
                g[l] = scale * ((from_x[l] - to_x[l]) + (from_y[l] - to_y[l]) + (from_z[l] - to_z[l]));
            }
            pass_on::<T, W, N, S>(&mut passed[k], x, &to);
            from_x = *to_x;
        }
    }
}
}
