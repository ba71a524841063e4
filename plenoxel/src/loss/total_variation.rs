//! Isotropic total variation of a grid's rows.
//!
//! A cell is a node with its forward neighbours along x, y and z, all four being present. Per cell and channel √(dx² + dy² + dz² + ε),
//! averaged over cells and channels. The gradient is the exact one.

use super::Step;
use crate::random::{Purpose, bits};
use autograd::lattice::Neighbours;
use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Lattice, Param, Real, Tensor, dispatched, parallel};

/// Keeps the root smooth (source paper).
const EPSILON: f64 = 1e-5;

/// Which cells a total variation looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cells {
    /// All: a dense gradient.
    Whole,
    /// A contiguous run of this share of the table's rows, at a random place each step (svox2): a row-sparse gradient.
    Share(f64),
}

impl Cells {
    /// svox2's share.
    pub const SAMPLED: Cells = Cells::Share(0.01);
}

/// Total variation of the density.
pub fn tv_density<T: Real>(cells: Cells) -> impl Fn(&Step<'_, T>) -> Tensor<T> + Send + Sync {
    move |step| tv(step, &step.grid.density, cells, 0)
}

/// Total variation of the colors or their harmonics.
pub fn tv_color<T: Real>(cells: Cells) -> impl Fn(&Step<'_, T>) -> Tensor<T> + Send + Sync {
    move |step| tv(step, &step.grid.color, cells, 1)
}

fn tv<T: Real>(step: &Step<'_, T>, table: &Param<T>, cells: Cells, stream: u64) -> Tensor<T> {
    let lattice = step.grid.lattice();
    match cells {
        Cells::Whole => total_variation(table.tensor(), lattice),
        Cells::Share(share) => {
            let rows = lattice.rows();
            let first = bits(step.seed, Purpose::Cells, step.number, stream) % rows.max(1) as u64;
            let count = ((share * rows as f64).ceil() as usize).clamp(1, rows.max(1));
            sampled_total_variation(table.tensor(), lattice, first as usize, count)
        }
    }
}

/// Total variation over all cells of a table `[rows, C]` in bricks: a scalar. A grid without cells has variation 0. The gradient is dense
/// where there is a kernel, for the widths that grids have: C = 1, 3, 4, 12, 27, 48.
///
/// Panics if the layout is row-major or the table does not have its rows.
#[track_caller]
pub fn total_variation<T: Real>(table: &Tensor<T>, lattice: &Lattice) -> Tensor<T> {
    check(table, lattice);
    match table.shape()[1] {
        1 => with_kernel::<T, 1, 4>(table, lattice),
        3 => with_kernel::<T, 3, 12>(table, lattice),
        4 => with_kernel::<T, 4, 16>(table, lattice),
        12 => with_kernel::<T, 12, 48>(table, lattice),
        27 => with_kernel::<T, 27, 108>(table, lattice),
        48 => with_kernel::<T, 48, 192>(table, lattice),
        _ => sampled_total_variation(table, lattice, 0, lattice.rows()),
    }
}

/// Through the kernel for a width of `W`; `N` is 4 W, the length of a line.
fn with_kernel<T: Real, const W: usize, const N: usize>(table: &Tensor<T>, lattice: &Lattice) -> Tensor<T> {
    let bricks = lattice.neighbours();
    let mut roots = Buffer::<T>::stale(table.len());
    let values = table.data().as_chunks::<N>().0;
    let runs: Vec<_> = roots.as_chunks_mut::<N>().0.chunks_mut(RUN * LINES).collect();
    let sums = parallel::map_items(runs, |run, roots| {
        inverse_roots::<T, W, N>(values, run * RUN, &bricks[run * RUN..][..roots.len() / LINES], roots)
    });
    let terms = bricks.iter().map(|b| b.cells.count_ones() as usize).sum::<usize>() * W;
    let value = sums.into_iter().sum::<T>() / T::lit(terms.max(1) as f64);
    let kernel = TotalVariation::<T, W, N> { lattice: lattice.clone(), terms, roots };
    Tensor::from_kernel(vec![value].into(), &[], &[table], kernel)
}

/// Total variation over those of `count` rows from number `first` on, wrapping round, that have a cell: a scalar, with a row-sparse gradient.
///
/// Panics if the layout is row-major or the table does not have its rows.
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
    assert!(lattice.brick_map().is_some(), "total_variation: a lattice in bricks is needed");
    assert!(
        table.ndim() == 2 && table.shape()[0] == lattice.rows(),
        "total_variation: a lattice of {} rows, a table {:?}",
        lattice.rows(),
        table.shape()
    );
}

/// The kernel behind [`total_variation`].
#[derive(Debug)]
struct TotalVariation<T: Real, const W: usize, const N: usize> {
    lattice: Lattice,
    /// Cells times channels.
    terms: usize,
    /// 1 / √(…) of each cell and channel, 0 where there is no cell: a table.
    roots: Buffer<T>,
}

/// Bricks that one task works on.
const RUN: usize = 256;
/// Lines of four nodes along z in a brick; line 4 x + y begins at (x, y, 0).
const LINES: usize = 16;

/// With q = s / √(…) for each cell and channel, s = cotangent / number of terms: the cell gets −q (dx + dy + dz), each neighbour q d.
/// Written as a gather, a node's gradient is what its own cell and the three cells behind it give: no two tasks write the same node.
impl<T: Real, const W: usize, const N: usize> Kernel<T> for TotalVariation<T, W, N> {
    fn name(&self) -> &'static str {
        "total_variation"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        sampled_total_variation(&inputs[0], &self.lattice, 0, self.lattice.rows())
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let table = call.input(0);
        let scale = call.cotangent().item() / T::lit(self.terms.max(1) as f64);
        let (values, roots) = (table.data().as_chunks::<N>().0, self.roots.as_chunks::<N>().0);
        let mut gradient = Buffer::<T>::stale(table.len());
        parallel::for_each_chunk(gradient.as_chunks_mut::<N>().0, RUN * LINES, |start, lines| {
            let (first, count) = (start / LINES, lines.len() / LINES);
            gradients::<T, W, N>(values, roots, first, &self.lattice.neighbours()[first..][..count], scale, lines);
        });
        out.dense(0, gradient);
    }
}

/// Numbers of the lines one step away along x and y and of the next along z, or of the last ones. Where a brick is missing it is the line
/// itself: no cell reads across.
#[inline(always)]
fn lines_near(own: usize, bricks: [Option<u32>; 3], line: usize, ahead: bool) -> [usize; 3] {
    let this = own * LINES + line;
    let in_brick = |brick: Option<u32>, line: usize| brick.map_or(this, |b| b as usize * LINES + line);
    let (x, y) = (line / 4, line % 4);
    if ahead {
        let next_x = if x < 3 { this + 4 } else { in_brick(bricks[0], y) };
        let next_y = if y < 3 { this + 1 } else { in_brick(bricks[1], 4 * x) };
        [next_x, next_y, in_brick(bricks[2], line)]
    } else {
        let last_x = if x > 0 { this - 4 } else { in_brick(bricks[0], 12 + y) };
        let last_y = if y > 0 { this - 1 } else { in_brick(bricks[1], 4 * x + 3) };
        [last_x, last_y, in_brick(bricks[2], line)]
    }
}

/// The nodes of a line one step on along z: `line` without its first node, then the first of `next`.
#[inline(always)]
fn next_nodes<T: Real, const W: usize, const N: usize>(line: &[T; N], next: &[T; N]) -> [T; N] {
    let mut out = [T::zero(); N];
    out[..N - W].copy_from_slice(&line[W..]);
    out[N - W..].copy_from_slice(&next[..W]);
    out
}

/// The nodes of a line one step back along z: the last of `last`, then `line` without its own.
#[inline(always)]
fn last_nodes<T: Real, const W: usize, const N: usize>(line: &[T; N], last: &[T; N]) -> [T; N] {
    let mut out = [T::zero(); N];
    out[..W].copy_from_slice(&last[N - W..]);
    out[W..].copy_from_slice(&line[..N - W]);
    out
}

dispatched! {
/// 1 / √(dx² + dy² + dz² + ε) of the cells of the bricks from number `first` on, 0 elsewhere; returns Σ √(…).
fn inverse_roots<T: Real, const W: usize, const N: usize>(table: &[[T; N]], first: usize, bricks: &[Neighbours], roots: &mut [[T; N]]) -> T {
    let mut sum = T::zero();
    for ((b, brick), roots) in bricks.iter().enumerate().zip(roots.as_chunks_mut::<LINES>().0) {
        let own = first + b;
        let mut lanes = [T::zero(); N];
        for line in 0..LINES {
            let [x, y, z] = lines_near(own, brick.ahead, line, true).map(|l| &table[l]);
            let v = &table[own * LINES + line];
            let z = next_nodes::<T, W, N>(v, z);
            let mut q = [T::zero(); N];
            let mut square = [T::zero(); N];
            for l in 0..N {
                let (dx, dy, dz) = (x[l] - v[l], y[l] - v[l], z[l] - v[l]);
                square[l] = dx * dx + dy * dy + dz * dz + T::lit(EPSILON);
                q[l] = square[l].inverse_sqrt();
            }
            let cells = brick.cells >> (4 * line) & 0xf;
            if cells != 0xf {
                for node in (0..4).filter(|node| cells >> node & 1 == 0) {
                    q[node * W..(node + 1) * W].fill(T::zero());
                }
            }
            for l in 0..N {
                lanes[l] += square[l] * q[l];
            }
            roots[line] = q;
        }
        sum += lanes.into_iter().sum::<T>();
    }
    sum
}
}

dispatched! {
/// The gradient of the bricks from number `first` on, from the roots of their cells and of those behind.
fn gradients<T: Real, const W: usize, const N: usize>(
    table: &[[T; N]],
    roots: &[[T; N]],
    first: usize,
    bricks: &[Neighbours],
    scale: T,
    out: &mut [[T; N]],
) {
    let none = [T::zero(); N];
    for ((b, brick), out) in bricks.iter().enumerate().zip(out.as_chunks_mut::<LINES>().0) {
        let own = first + b;
        for (line, out) in out.iter_mut().enumerate() {
            let this = own * LINES + line;
            let [x, y, z] = lines_near(own, brick.ahead, line, true).map(|l| &table[l]);
            let behind = lines_near(own, brick.behind, line, false);
            let [last_x, last_y, last_z] = behind.map(|l| &table[l]);
            let [qx, qy, qz] = behind.map(|l| if l == this { &none } else { &roots[l] });
            let (v, q) = (&table[this], &roots[this]);
            let (z, last_z) = (next_nodes::<T, W, N>(v, z), last_nodes::<T, W, N>(v, last_z));
            let qz = last_nodes::<T, W, N>(q, qz);
            let mut g = [T::zero(); N];
            for l in 0..N {
                let cell = q[l] * (T::lit(3.0) * v[l] - x[l] - y[l] - z[l]);
                let others = qx[l] * (v[l] - last_x[l]) + qy[l] * (v[l] - last_y[l]) + qz[l] * (v[l] - last_z[l]);
                g[l] = scale * (cell + others);
            }
            *out = g;
        }
    }
}
}
