//! Values between the nodes of a grid whose rows are stored in a table.
//!
//! Node (i, j, k) of a grid of `[nx, ny, nz]` nodes is row (i·ny + j)·nz + k. Positions are in cells, nodes at the integers;
//! a position outside is clamped to the box of the nodes, where the gradient with respect to it is 0.

use crate::index::{self, Indices};
use crate::op::{GradSink, Kernel, KernelCall};
use crate::parallel::{self, dispatched};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// The eight rows around a position and what each of them weighs; the last index of a corner runs fastest.
#[inline(always)]
pub fn corners<T: Real>(position: [T; 3], nodes: [usize; 3]) -> ([u32; 8], [T; 8]) {
    let mut low = [0usize; 3];
    let mut high = [0usize; 3];
    let mut f = [T::zero(); 3];
    for a in 0..3 {
        (low[a], high[a], f[a], _) = axis_cell(position[a], nodes[a]);
    }
    let one = T::one();
    let w = [[one - f[0], f[0]], [one - f[1], f[1]], [one - f[2], f[2]]];
    let at = [[low[0], high[0]], [low[1], high[1]], [low[2], high[2]]];
    let mut rows = [0u32; 8];
    let mut weights = [T::zero(); 8];
    for c in 0..8 {
        let (i, j, k) = (c >> 2, c >> 1 & 1, c & 1);
        rows[c] = ((at[0][i] * nodes[1] + at[1][j]) * nodes[2] + at[2][k]) as u32;
        weights[c] = w[0][i] * w[1][j] * w[2][k];
    }
    (rows, weights)
}

/// The row of the node nearest to a position, halves rounded up.
#[inline(always)]
pub fn nearest_row<T: Real>(position: [T; 3], nodes: [usize; 3]) -> u32 {
    let mut row = 0;
    for a in 0..3 {
        let last = nodes[a] - 1;
        let i = (position[a] + T::lit(0.5)).floor().max(T::zero()).to_usize().unwrap_or(0).min(last);
        row = row * nodes[a] + i;
    }
    row as u32
}

/// Lower node, upper node, fraction between them, and whether the position lies inside (so that it has a gradient).
#[inline(always)]
fn axis_cell<T: Real>(u: T, n: usize) -> (usize, usize, T, bool) {
    let last = T::lit((n - 1) as f64);
    let inside = u >= T::zero() && u <= last;
    let u = u.max(T::zero()).min(last);
    let low = u.to_usize().unwrap_or(0).min(n.saturating_sub(2));
    (low, (low + 1).min(n - 1), u - T::lit(low as f64), inside)
}

/// yₚ = Σ over the eight corners c of wc(uₚ) · table[rowc(uₚ)]
///
/// ∂L/∂table[row] = Σ w ∂L/∂y, as rows;  ∂L/∂uₚ = Σc (∂L/∂yₚ · table[rowc]) ∂wc/∂u.
#[derive(Debug)]
struct Trilinear {
    nodes: [usize; 3],
}

impl<T: Real> Kernel<T> for Trilinear {
    fn name(&self) -> &'static str {
        "trilinear"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let [table, positions] = inputs else { unreachable!("trilinear has two inputs") };
        let m = positions.shape()[0];
        // Fractions and their complements per axis, as columns; the cell itself is constant.
        let column = |a: usize| {
            let last = (self.nodes[a] - 1) as f64;
            let u = positions.narrow(1, a, 1).clamp(0.0, last);
            let cell = u.constant_map(|u| T::lit(u.to_usize().unwrap_or(0).min(self.nodes[a].saturating_sub(2)) as f64));
            let f = &u - cell;
            [1.0 - &f, f]
        };
        let weights = [column(0), column(1), column(2)];
        let cells = points(positions);
        let corner = |c: usize| {
            let rows: Vec<u32> = cells.iter().map(|&p| corners(p, self.nodes).0[c]).collect();
            let w = &weights[0][c >> 2] * &weights[1][c >> 1 & 1] * &weights[2][c & 1];
            table.gather_rows(&Indices::from(rows)) * w
        };
        (1..8).fold(corner(0), |sum, c| sum + corner(c)).reshape(&[m, table.shape()[1]])
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (table, positions, g) = (call.input(0), call.input(1), call.cotangent());
        let cells = points(&positions);
        if call.needs(0) {
            out.rows(0, index::sum_into_rows(table.shape(), cells.len(), |p| corners(cells[p], self.nodes), g.data()));
        }
        if call.needs(1) {
            let width = table.shape()[1];
            let mut slope = Buffer::stale(positions.len());
            parallel::for_each_rows(&mut slope, 3, |first, chunk| {
                for (p, d) in chunk.chunks_exact_mut(3).enumerate() {
                    let p = first + p;
                    let g = &g.data()[p * width..][..width];
                    let (rows, _) = corners(cells[p], self.nodes);
                    let dots =
                        rows.map(|row| g.iter().zip(&table.data()[row as usize * width..][..width]).map(|(&g, &v)| g * v).sum::<T>());
                    d.copy_from_slice(&slope_of(dots, cells[p], self.nodes));
                }
            });
            out.dense(1, slope);
        }
    }
}

/// Σc dotc ∂wc/∂u
fn slope_of<T: Real>(dots: [T; 8], position: [T; 3], nodes: [usize; 3]) -> [T; 3] {
    let one = T::one();
    let mut slope = [T::zero(); 3];
    for (a, s) in slope.iter_mut().enumerate() {
        let (_, _, _, inside) = axis_cell(position[a], nodes[a]);
        if !inside || nodes[a] == 1 {
            continue;
        }
        for (c, &dot) in dots.iter().enumerate() {
            let mut w = if c >> (2 - a) & 1 == 1 { one } else { -one };
            for b in (0..3).filter(|&b| b != a) {
                let (_, _, f, _) = axis_cell(position[b], nodes[b]);
                w *= if c >> (2 - b) & 1 == 1 { f } else { one - f };
            }
            *s += dot * w;
        }
    }
    slope
}

fn points<T: Real>(positions: &Tensor<T>) -> &[[T; 3]] {
    positions.data().as_chunks::<3>().0
}

impl<T: Real> Tensor<T> {
    /// Trilinear interpolation of this table `[nx·ny·nz, C]` at `positions` `[m, 3]`, in cells with nodes at the integers: `[m, C]`.
    /// Differentiable in the table (the gradient is row-sparse) and in the positions, where the slope jumps between cells.
    ///
    /// Panics if the table does not have one row for each node or the positions are not `[m, 3]`.
    #[track_caller]
    pub fn trilinear(&self, positions: &Self, nodes: [usize; 3]) -> Self {
        self.check_grid("trilinear", positions, nodes);
        let width = self.shape()[1];
        let cells = points(positions);
        let mut out = Buffer::stale(cells.len() * width);
        let table = self.data();
        parallel::for_each_rows(&mut out, width, |first, chunk| {
            let cells = &cells[first..];
            match width {
                1 => interpolate::<T, 1>(table, cells, nodes, width, chunk),
                3 => interpolate::<T, 3>(table, cells, nodes, width, chunk),
                4 => interpolate::<T, 4>(table, cells, nodes, width, chunk),
                27 => interpolate::<T, 27>(table, cells, nodes, width, chunk),
                28 => interpolate::<T, 28>(table, cells, nodes, width, chunk),
                _ => interpolate::<T, 0>(table, cells, nodes, width, chunk),
            }
        });
        Tensor::from_kernel(out, &[cells.len(), width], &[self, positions], Trilinear { nodes })
    }

    /// The row of this table `[nx·ny·nz, C]` whose node is nearest to each of `positions` `[m, 3]`: `[m, C]`.
    /// The gradient is row-sparse; there is none with respect to the positions.
    ///
    /// Panics as [`Tensor::trilinear`] does.
    #[track_caller]
    pub fn nearest(&self, positions: &Self, nodes: [usize; 3]) -> Self {
        self.check_grid("nearest", positions, nodes);
        let cells = points(positions);
        let mut rows = Buffer::stale(cells.len());
        parallel::for_each_chunk(&mut rows, parallel::CHUNK, |first, chunk| {
            for (row, &p) in chunk.iter_mut().zip(&cells[first..]) {
                *row = nearest_row(p, nodes);
            }
        });
        self.gather_rows(&rows.into())
    }

    #[track_caller]
    fn check_grid(&self, op: &str, positions: &Self, nodes: [usize; 3]) {
        let rows: usize = nodes.iter().product();
        assert!(
            self.ndim() == 2 && self.shape()[0] == rows && rows > 0,
            "{op}: a grid of {nodes:?} nodes needs a table of [{rows}, C] rows, got {:?}",
            self.shape()
        );
        assert!(positions.ndim() == 2 && positions.shape()[1] == 3, "{op}: positions must be [m, 3], got {:?}", positions.shape());
    }
}

dispatched! {
/// `W` is the width, or 0 for one only known at run time.
fn interpolate<T: Real, const W: usize>(table: &[T], cells: &[[T; 3]], nodes: [usize; 3], width: usize, out: &mut [T]) {
    let width = if W == 0 { width } else { W };
    for (y, &cell) in out.chunks_exact_mut(width).zip(cells) {
        let (rows, weights) = corners(cell, nodes);
        if W == 0 {
            y.fill(T::zero());
            for (&row, &w) in rows.iter().zip(&weights) {
                for (y, &v) in y.iter_mut().zip(&table[row as usize * width..][..width]) {
                    *y += w * v;
                }
            }
        } else {
            let mut sum = [T::zero(); W];
            for (&row, &w) in rows.iter().zip(&weights) {
                let v = &table[row as usize * W..][..W];
                for c in 0..W {
                    sum[c] += w * v[c];
                }
            }
            y.copy_from_slice(&sum);
        }
    }
}
}
