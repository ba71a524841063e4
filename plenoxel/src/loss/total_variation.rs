//! Isotropic total variation of a grid's values.
//!
//! A cell consists of a node and its forward neighbours along x, y and z, all present. Its variation per channel is √(dx² + dy² + dz² + ε).
//! The total variation is the mean over cells and channels. The gradient is exact.

mod pass;

use super::Step;
use crate::field::voxel_grid::VoxelGrid;
use crate::random::{Purpose, bits};
use autograd::lattice::{BRICK, BRICK_ROWS, Neighbours, previous_in};
use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Lattice, Param, Real, RowSparse, RowSums, Tensor, parallel};
use std::sync::{Arc, Mutex, PoisonError};

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
/// gradient is dense for the widths with a kernel, which include those of grids: C = 1, 3, 4, 9, 12, 24, 27, 45, 48. For these, a call that is
/// recorded computes the gradient too, and keeps it until the first backward pass.
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
        // No grid has rows of 4 numbers, but workload W3 does.
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
    let reached = match part {
        None => (0..bricks.len() as u32).collect(),
        Some(_) => run.reached(bricks),
    };
    let terms = run.bricks().map(|brick| bricks[brick].cells.count_ones() as usize).sum::<usize>() * W;
    let mut kernel =
        TotalVariation::<T, W, N, S> { lattice: lattice.clone(), run, reached, sparse: part.is_some(), terms, gradient: Mutex::default() };
    let value = if autograd::is_recording() && table.is_tracked() {
        let (value, gradient) = kernel.pass::<true>(table.data());
        kernel.gradient = Mutex::new(Some(gradient));
        value
    } else {
        kernel.pass::<false>(table.data()).0
    };
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

    /// Returns the bricks whose nodes are read by cells of the run: those of the run and the ones ahead of them, in ascending order.
    fn reached(self, bricks: &[Neighbours]) -> Vec<u32> {
        let mut reached: Vec<u32> = self.bricks().flat_map(|b| [Some(b as u32)].into_iter().chain(bricks[b].ahead).flatten()).collect();
        reached.sort_unstable();
        reached.dedup();
        reached
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
struct TotalVariation<T: Real, const W: usize, const N: usize, const S: usize> {
    lattice: Lattice,
    /// Bricks whose cells are included.
    run: Run,
    /// Bricks that get a gradient, in ascending order.
    reached: Vec<u32>,
    /// True if the gradient is row-sparse.
    sparse: bool,
    /// Number of cells times channels.
    terms: usize,
    /// Gradient of the value, computed with it. The first backward pass takes it; another one computes it again.
    gradient: Mutex<Option<Buffer<T>>>,
}

impl<T: Real, const W: usize, const N: usize, const S: usize> TotalVariation<T, W, N, S> {
    /// Computes the value and, if `GRADIENT` is true, its gradient to the rows of the bricks in `reached`.
    fn pass<const GRADIENT: bool>(&self, table: &[T]) -> (T, Buffer<T>) {
        let (table, bricks) = (table.as_chunks::<S>().0, self.lattice.neighbours());
        let scale = T::one() / T::lit(self.terms.max(1) as f64);
        let slabs = |bricks: usize| if GRADIENT { bricks * BRICK } else { 0 };
        let mut gradient = Buffer::<T>::stale(slabs(self.reached.len()) * S);
        let tasks = self.reached.chunks(pass::task::<T, S>(self.reached.len()));
        let parts = parallel::split_lengths(gradient.as_chunks_mut::<S>().0, tasks.clone().map(|task| slabs(task.len())));
        let sums = parallel::map_items(tasks.zip(parts).collect(), |_, (task, part)| {
            pass::value_and_gradient::<T, W, N, S, GRADIENT>(table, bricks, self.run, task, scale, part)
        });
        (scale * sums.into_iter().sum::<T>(), gradient)
    }

    /// Takes the gradient that was computed with the value, if no backward pass took it before.
    fn take_gradient(&self) -> Option<Buffer<T>> {
        self.gradient.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

impl<T: Real, const W: usize, const N: usize, const S: usize> Kernel<T> for TotalVariation<T, W, N, S> {
    fn name(&self) -> &'static str {
        "total_variation"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        sampled_total_variation(&inputs[0], &self.lattice, self.run.first * BRICK_ROWS, self.run.count * BRICK_ROWS)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (table, cotangent) = (call.input(0), call.cotangent().item());
        let mut gradient = self.take_gradient().unwrap_or_else(|| self.pass::<true>(table.data()).1);
        if !self.sparse {
            if cotangent != T::one() {
                parallel::for_each_chunk(&mut gradient, parallel::CHUNK, |_, part| part.iter_mut().for_each(|g| *g *= cotangent));
            }
            return out.dense(0, gradient);
        }
        let bricks = self.lattice.neighbours();
        let touched = self.reached.iter().map(|&brick| touched(bricks, self.run, brick as usize)).collect();
        let sums = RowsOfBricks { bricks: Members::new(&self.reached, bricks.len()), touched, width: W, values: gradient, cotangent };
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
    /// Factor of the values.
    cotangent: T,
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
            // A cotangent that is not finite times 0 is not 0: rows without a contribution are left out.
            for (r, (sums, values)) in sums.chunks_mut(self.width).zip(values.chunks(self.width)).enumerate() {
                if self.touched[k] >> r & 1 == 1 {
                    sums.iter_mut().zip(values).for_each(|(sum, &value)| *sum += self.cotangent * value);
                }
            }
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
