//! Isotropic total variation of a grid's rows.
//!
//! A cell is a node with its forward neighbours along x, y and z: (nx−1)(ny−1)(nz−1) of them, in row order. Per cell and channel
//! √(dx² + dy² + dz² + ε), averaged over cells and channels. The gradient is the exact one.

use super::Step;
use crate::random::{Purpose, bits};
use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Param, Real, Tensor, parallel};

/// Keeps the root smooth (source paper).
const EPSILON: f64 = 1e-5;

/// Which cells a total variation looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cells {
    /// All: a dense gradient.
    Whole,
    /// A contiguous run of this share of the cells, at a random place each step (svox2): a row-sparse gradient.
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
    let nodes = step.grid.nodes();
    match cells {
        Cells::Whole => total_variation(table.tensor(), nodes),
        Cells::Share(share) => {
            let all: usize = nodes.iter().map(|n| n - 1).product();
            let first = bits(step.seed, Purpose::Cells, step.number, stream) % all.max(1) as u64;
            let count = ((share * all as f64).ceil() as usize).clamp(1, all.max(1));
            sampled_total_variation(table.tensor(), nodes, first as usize, count)
        }
    }
}

/// Total variation over all cells of a table `[nx·ny·nz, C]`: a scalar, with a dense gradient.
///
/// Panics if the table does not have one row for each node. A grid without cells (a side of one node) has variation 0.
#[track_caller]
pub fn total_variation<T: Real>(table: &Tensor<T>, nodes: [usize; 3]) -> Tensor<T> {
    assert!(
        table.ndim() == 2 && table.shape()[0] == nodes.iter().product::<usize>(),
        "total_variation: {nodes:?} nodes, table {:?}",
        table.shape()
    );
    let kernel = TotalVariation { nodes };
    let value = kernel.value(table);
    Tensor::from_kernel(vec![value].into(), &[], &[table], kernel)
}

/// Total variation over `count` cells from number `first` on, wrapping round: a scalar, with a row-sparse gradient.
///
/// Panics if the table does not have one row for each node or there are no cells.
#[track_caller]
pub fn sampled_total_variation<T: Real>(table: &Tensor<T>, nodes: [usize; 3], first: usize, count: usize) -> Tensor<T> {
    let cells = nodes.map(|n| n.saturating_sub(1));
    let all: usize = cells.iter().product();
    assert!(all > 0 && count > 0, "sampled_total_variation: no cells among {nodes:?} nodes");
    let base: Vec<[usize; 3]> = (0..count)
        .map(|c| {
            let cell = (first + c) % all;
            [cell / (cells[1] * cells[2]), cell / cells[2] % cells[1], cell % cells[2]]
        })
        .collect();
    let node = |offset: [usize; 3]| -> Indices {
        let rows = base.iter().map(|c| (((c[0] + offset[0]) * nodes[1] + c[1] + offset[1]) * nodes[2] + c[2] + offset[2]) as u32);
        rows.collect::<Vec<_>>().into()
    };
    let center = table.gather_rows(&node([0, 0, 0]));
    let squares = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map(|o| (table.gather_rows(&node(o)) - &center).square());
    let [x, y, z] = squares;
    (x + y + z + EPSILON).sqrt().mean()
}

/// The kernel behind [`total_variation`].
#[derive(Debug)]
pub struct TotalVariation {
    nodes: [usize; 3],
}

impl TotalVariation {
    /// Numbers in a line along z, of a table of `width` channels.
    fn line(&self, width: usize) -> usize {
        self.nodes[2] * width
    }

    fn terms(&self, width: usize) -> usize {
        self.nodes.iter().map(|n| n - 1).product::<usize>() * width
    }

    /// The line of nodes at (i, j), that of its x neighbour and that of its y neighbour.
    fn lines<'a, T>(&self, table: &'a [T], width: usize, i: usize, j: usize) -> [&'a [T]; 3] {
        let line = self.line(width);
        let at = |i: usize, j: usize| &table[(i * self.nodes[1] + j) * line..][..line];
        [at(i, j), at(i + 1, j), at(i, j + 1)]
    }

    fn value<T: Real>(&self, table: &Tensor<T>) -> T {
        let width = table.shape()[1];
        let terms = self.terms(width);
        if terms == 0 {
            return T::zero();
        }
        let slabs = parallel::map_indices(self.nodes[0] - 1, |i| {
            (0..self.nodes[1] - 1).map(|j| sum_of_roots(self.lines(table.data(), width, i, j), width)).sum::<T>()
        });
        slabs.into_iter().sum::<T>() / T::lit(terms as f64)
    }
}

/// Σ √(dx² + dy² + dz² + ε) along one line.
fn sum_of_roots<T: Real>([v, x, y]: [&[T]; 3], width: usize) -> T {
    let n = v.len() - width;
    let (v, z, x, y, e) = (&v[..n], &v[width..], &x[..n], &y[..n], T::lit(EPSILON));
    let mut lanes = [T::zero(); 16];
    let mut add = |k: usize, lane: usize| {
        let (dx, dy, dz) = (x[k] - v[k], y[k] - v[k], z[k] - v[k]);
        lanes[lane] += (dx * dx + dy * dy + dz * dz + e).sqrt();
    };
    let body = n / 16 * 16;
    for block in (0..body).step_by(16) {
        (0..16).for_each(|lane| add(block + lane, lane));
    }
    (body..n).for_each(|k| add(k, k - body));
    lanes.into_iter().sum()
}

/// With q = s / √(…) for each cell and channel, s = cotangent / number of terms: the cell gets −q (dx + dy + dz), each neighbour q d.
/// Written as a gather, a node's gradient is what its own cell and the three cells behind it give: no two tasks write the same node.
impl<T: Real> Kernel<T> for TotalVariation {
    fn name(&self) -> &'static str {
        "total_variation"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let cells: usize = self.nodes.iter().map(|n| n - 1).product();
        if cells == 0 {
            return Tensor::scalar(T::zero());
        }
        sampled_total_variation(&inputs[0], self.nodes, 0, cells)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let table = call.input(0);
        let width = table.shape()[1];
        let [nx, ny, nz] = self.nodes;
        let mut gradient = Buffer::<T>::zeros(table.len());
        let terms = self.terms(width);
        if terms > 0 {
            let scale = call.cotangent().item() / T::lit(terms as f64);
            // q of every cell and channel, in the layout of the table; the last node of a line has no cell and q = 0.
            let (line, values) = (self.line(width), table.data());
            let mut q = Buffer::<T>::zeros(table.len());
            parallel::for_each_chunk(&mut q, ny * line, |start, slab| {
                let i = start / (ny * line);
                if i + 1 < nx {
                    for (j, q) in slab.chunks_exact_mut(line).enumerate().take(ny - 1) {
                        inverse_roots(self.lines(values, width, i, j), width, scale, q);
                    }
                }
            });
            parallel::for_each_chunk(&mut gradient, ny * line, |start, slab| {
                let i = start / (ny * line);
                for (j, g) in slab.chunks_exact_mut(line).enumerate() {
                    let at = |i: usize, j: usize| (&values[(i * ny + j) * line..][..line], &q[(i * ny + j) * line..][..line]);
                    let (v, own) = at(i, j);
                    if i + 1 < nx && j + 1 < ny {
                        let (x, y) = (at(i + 1, j).0, at(i, j + 1).0);
                        for k in 0..line - width {
                            g[k] = -own[k] * (x[k] + y[k] + v[k + width] - T::lit(3.0) * v[k]);
                        }
                        for k in width..line {
                            g[k] += own[k - width] * (v[k] - v[k - width]);
                        }
                    }
                    for (v_behind, q_behind) in [(i > 0).then(|| at(i - 1, j)), (j > 0).then(|| at(i, j - 1))].into_iter().flatten() {
                        for k in 0..line {
                            g[k] += q_behind[k] * (v[k] - v_behind[k]);
                        }
                    }
                }
            });
            debug_assert_eq!(nz * width, line);
        }
        out.dense(0, gradient);
    }
}

/// scale / √(dx² + dy² + dz² + ε) along one line.
fn inverse_roots<T: Real>([v, x, y]: [&[T]; 3], width: usize, scale: T, q: &mut [T]) {
    let n = v.len() - width;
    let (z, v, x, y, q) = (&v[width..], &v[..n], &x[..n], &y[..n], &mut q[..n]);
    for k in 0..n {
        let (dx, dy, dz) = (x[k] - v[k], y[k] - v[k], z[k] - v[k]);
        q[k] = scale / (dx * dx + dy * dy + dz * dz + T::lit(EPSILON)).sqrt();
    }
}
