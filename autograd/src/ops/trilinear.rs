//! Trilinear and nearest-neighbour interpolation of a grid whose node values are rows of a table.
//!
//! A [`Lattice`] maps nodes to rows: in row-major order, which `[nx, ny, nz]` converts to, or in bricks, where nodes may be missing. A missing node reads as
//! zeros. Positions are in units of cells, and the nodes are at integer positions. A position outside the grid is clamped to the box of the nodes; the
//! gradient with respect to a clamped coordinate is 0.

use crate::index::Indices;
use crate::lattice::{Lattice, NodeMap, TOGETHER, with_map};
use crate::op::{GradSink, Kernel, KernelCall};
use crate::parallel::{self, dispatched};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// Returns the rows and the interpolation weights of the eight corners of the cell that contains a position. In the order of the corners, the last axis
/// runs fastest. A corner that is not present has weight 0 and the row of a corner that is present, so it does not add a row to the gradient.
#[inline(always)]
pub fn corners<T: Real>(position: [T; 3], map: impl NodeMap) -> ([u32; 8], [T; 8]) {
    let (rows, weights, _) = corners_present(position, map);
    (rows, weights)
}

/// Returns the rows and weights of [`corners`], and a mask with a bit for each corner that is present.
#[inline(always)]
fn corners_present<T: Real, M: NodeMap>(position: [T; 3], map: M) -> ([u32; 8], [T; 8], u32) {
    let mut shares = [[0; 2]; 3];
    let mut f = [T::zero(); 3];
    for a in 0..3 {
        let (low, high, fraction, _) = axis_cell(position[a], map.nodes()[a]);
        (shares[a], f[a]) = ([map.share(a, low), map.share(a, high)], fraction);
    }
    combine_axes(shares, f, map)
}

/// Computes the corners of a cell from the contributions of its lower and upper node along each axis to the node code ([`NodeMap::share`]), and from the
/// fractional position `f` along each axis.
#[inline(always)]
fn combine_axes<T: Real, M: NodeMap>(shares: [[u32; 2]; 3], f: [T; 3], map: M) -> ([u32; 8], [T; 8], u32) {
    let one = T::one();
    let w = [[one - f[0], f[0]], [one - f[1], f[1]], [one - f[2], f[2]]];
    let axes = |c: usize| [c >> 2, c >> 1 & 1, c & 1];
    let codes = std::array::from_fn(|c| (0..3).map(|a| shares[a][axes(c)[a]]).sum());
    let (rows, present) = rows_of(codes, map);
    let weights = std::array::from_fn(|c| {
        let [i, j, k] = axes(c);
        if present >> c & 1 == 1 { w[0][i] * w[1][j] * w[2][k] } else { T::zero() }
    });
    (rows, weights, present)
}

/// The mask of eight corners that are all present.
const ALL: u32 = 0xff;

/// Returns the rows of the eight corners with the given node codes, and a mask with a bit for each corner that is present. The other corners get the row of
/// a corner that is present, or row 0 if there is none.
#[inline(always)]
fn rows_of<M: NodeMap>(codes: [u32; 8], map: M) -> ([u32; 8], u32) {
    let mut rows = [0; 8];
    let mut present = 0;
    for (c, code) in codes.into_iter().enumerate() {
        let found = map.row_of(code);
        present |= u32::from(found.is_some()) << c;
        rows[c] = found.unwrap_or_default();
    }
    if M::SPARSE && present != ALL {
        let stand_in = if present == 0 { 0 } else { rows[present.trailing_zeros() as usize] };
        for (c, row) in rows.iter_mut().enumerate() {
            if present >> c & 1 == 0 {
                *row = stand_in;
            }
        }
    }
    (rows, present)
}

dispatched! {
/// Computes the corners of many positions in groups of [`TOGETHER`]. `at` has one slice of coordinates for each axis. `rows[g][c][i]` is the row of corner c
/// of position [`TOGETHER`] · g + i, and `weights[g][c][i]` its weight. Entries beyond the last position are unspecified.
///
/// Panics if a group begins beyond the last position.
pub fn corners_of_many<T: Real, M: NodeMap>(
    at: [&[T]; 3],
    map: M,
    rows: &mut [[[u32; TOGETHER]; 8]],
    weights: &mut [[[T; TOGETHER]; 8]],
) {
    // The arithmetic of a whole group is vectorised; it precedes the lookups in the layout.
    let mut shares = [[[0u32; TOGETHER]; 2]; 3];
    let mut fractions = [[[T::zero(); TOGETHER]; 2]; 3];
    for (group, (rows, weights)) in rows.iter_mut().zip(weights).enumerate() {
        for a in 0..3 {
            let mut u = [T::zero(); TOGETHER];
            let own = &at[a][group * TOGETHER..];
            match own.first_chunk() {
                Some(whole) => u = *whole,
                None => u[..own.len()].copy_from_slice(own),
            }
            for i in 0..TOGETHER {
                let (low, high, fraction, _) = axis_cell(u[i], map.nodes()[a]);
                (shares[a][0][i], shares[a][1][i]) = (map.share(a, low), map.share(a, high));
                (fractions[a][0][i], fractions[a][1][i]) = (T::one() - fraction, fraction);
            }
        }
        for c in 0..8 {
            let [x, y, z] = [c >> 2, c >> 1 & 1, c & 1];
            for i in 0..TOGETHER {
                weights[c][i] = fractions[0][x][i] * fractions[1][y][i] * fractions[2][z][i];
                rows[c][i] = shares[0][x][i] + shares[1][y][i] + shares[2][z][i];
            }
        }
        let mut present = [[0; TOGETHER]; 8];
        for c in 0..8 {
            (rows[c], present[c]) = map.rows_of(rows[c]);
        }
        if M::SPARSE && present != [[!0; TOGETHER]; 8] {
            let mut stand_in = [0; TOGETHER];
            for c in (0..8).rev() {
                for i in 0..TOGETHER {
                    stand_in[i] = rows[c][i] & present[c][i] | stand_in[i] & !present[c][i];
                }
            }
            for c in 0..8 {
                for i in 0..TOGETHER {
                    rows[c][i] = rows[c][i] & present[c][i] | stand_in[i] & !present[c][i];
                }
                for i in 0..TOGETHER {
                    weights[c][i] = if present[c][i] == 0 { T::zero() } else { weights[c][i] };
                }
            }
        }
    }
}
}

/// Returns the node nearest to a position; halves are rounded up.
#[inline(always)]
pub fn nearest_node<T: Real>(position: [T; 3], nodes: [usize; 3]) -> [u32; 3] {
    std::array::from_fn(|a| (position[a] + T::lit(0.5)).max(T::zero()).min(T::lit((nodes[a] - 1) as f64)).index())
}

/// Returns, for one axis, the lower node, the upper node, the fractional position between them, and whether the position is inside the grid. Only a position
/// inside has a gradient.
#[inline(always)]
fn axis_cell<T: Real>(u: T, n: usize) -> (u32, u32, T, bool) {
    let last = T::lit((n - 1) as f64);
    let inside = u >= T::zero() && u <= last;
    let u = u.max(T::zero()).min(last);
    let low = u.index().min(n.saturating_sub(2) as u32);
    (low, (low + 1).min(n as u32 - 1), u - T::lit(f64::from(low)), inside)
}

/// Trilinear interpolation at the positions uₚ: yₚ = Σc wc(uₚ) · table[rowc(uₚ)], over the eight corners c of the cell.
///
/// ∂L/∂table is row-sparse: wc ∂L/∂yₚ is added to row rowc, for each p and c.  ∂L/∂uₚ = Σc (∂L/∂yₚ · table[rowc]) ∂wc/∂u.
#[derive(Debug)]
struct Trilinear {
    lattice: Lattice,
}

impl<T: Real> Kernel<T> for Trilinear {
    fn name(&self) -> &'static str {
        "trilinear"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let [table, positions] = inputs else { unreachable!("trilinear has two inputs") };
        let (m, nodes) = (positions.shape()[0], self.lattice.nodes());
        // The fractions and their complements for each axis, as columns. The index of the cell is a constant.
        let column = |a: usize| {
            let last = (nodes[a] - 1) as f64;
            let u = positions.narrow(1, a, 1).clamp(0.0, last);
            let cell = u.constant_map(|u| T::lit(u.to_usize().unwrap_or(0).min(nodes[a].saturating_sub(2)) as f64));
            let f = &u - cell;
            [1.0 - &f, f]
        };
        let weights = [column(0), column(1), column(2)];
        let cells = points(positions);
        let corner = |c: usize| {
            let found: Vec<_> = cells.iter().map(|&p| with_map!(self.lattice, map => corners_present(p, map))).collect();
            let rows: Vec<u32> = found.iter().map(|(rows, _, _)| rows[c]).collect();
            let present: Vec<T> = found.iter().map(|(_, _, present)| T::lit(f64::from(present >> c & 1))).collect();
            let w = &weights[0][c >> 2] * &weights[1][c >> 1 & 1] * &weights[2][c & 1] * Tensor::from_vec(present, &[m, 1]);
            table.gather_rows(&Indices::from(rows)) * w
        };
        (1..8).fold(corner(0), |sum, c| sum + corner(c)).reshape(&[m, table.shape()[1]])
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (table, positions, g) = (call.input(0), call.input(1), call.cotangent());
        let cells = points(&positions);
        if call.needs(0) {
            with_map!(self.lattice, map => out.scatter_weighted(0, |p| corners(cells[p], map), g.data()));
        }
        if call.needs(1) {
            let width = table.shape()[1];
            let mut slope = Buffer::stale(positions.len());
            parallel::for_each_rows(&mut slope, 3, |first, chunk| {
                for (p, d) in chunk.chunks_exact_mut(3).enumerate() {
                    let p = first + p;
                    let g = &g.data()[p * width..][..width];
                    let (rows, _, present) = with_map!(self.lattice, map => corners_present(cells[p], map));
                    let dots = std::array::from_fn(|c| match present >> c & 1 {
                        0 => T::zero(),
                        _ => g.iter().zip(&table.data()[rows[c] as usize * width..][..width]).map(|(&g, &v)| g * v).sum::<T>(),
                    });
                    d.copy_from_slice(&slope_of(dots, cells[p], self.lattice.nodes()));
                }
            });
            out.dense(1, slope);
        }
    }
}

/// Returns Σc dotc ∂wc/∂u, the gradient with respect to the position.
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

/// Returns the rows of a tensor `[m, 3]` as points.
fn points<T: Real>(positions: &Tensor<T>) -> &[[T; 3]] {
    positions.data().as_chunks::<3>().0
}

impl<T: Real> Tensor<T> {
    /// Interpolates this table `[rows, C]` trilinearly at `positions` `[m, 3]`; the result is `[m, C]`. Positions are in units of cells, with the nodes at
    /// the integers. The layout of the table is a [`Lattice`], or `[nx, ny, nz]` for row-major order.
    ///
    /// Differentiable with respect to the table, with a row-sparse gradient, and with respect to the positions. The derivative with respect to a position is
    /// discontinuous between cells.
    ///
    /// Panics if the table does not have the rows of the layout or the positions are not `[m, 3]`.
    #[track_caller]
    pub fn trilinear(&self, positions: &Self, lattice: impl Into<Lattice>) -> Self {
        let lattice = lattice.into();
        self.check_grid("trilinear", positions, &lattice);
        let width = self.shape()[1];
        let cells = points(positions);
        let mut out = Buffer::stale(cells.len() * width);
        let table = self.data();
        with_map!(lattice, map => parallel::for_each_rows(&mut out, width, |first, chunk| {
            let cells = &cells[first..];
            match width {
                1 => interpolate::<T, 1, _>(table, cells, map, width, chunk),
                3 => interpolate::<T, 3, _>(table, cells, map, width, chunk),
                27 => interpolate::<T, 27, _>(table, cells, map, width, chunk),
                // The width that `benches/ops.rs` measures.
                28 => interpolate::<T, 28, _>(table, cells, map, width, chunk),
                _ => interpolate::<T, 0, _>(table, cells, map, width, chunk),
            }
        }));
        Tensor::from_kernel(out, &[cells.len(), width], &[self, positions], Trilinear { lattice })
    }

    /// Returns the row of this table `[rows, C]` at the node nearest to each of `positions` `[m, 3]`; the result is `[m, C]`. It is zero where the nearest
    /// node is not present. The gradient of the table is row-sparse. There is no gradient with respect to the positions.
    ///
    /// Panics under the same conditions as [`Tensor::trilinear`].
    #[track_caller]
    pub fn nearest(&self, positions: &Self, lattice: impl Into<Lattice>) -> Self {
        let lattice = lattice.into();
        self.check_grid("nearest", positions, &lattice);
        let cells = points(positions);
        let mut rows = Buffer::stale(cells.len());
        with_map!(lattice, map => parallel::for_each_chunk(&mut rows, parallel::CHUNK, |first, chunk| {
            for (row, &p) in chunk.iter_mut().zip(&cells[first..]) {
                *row = map.row_of(map.code(nearest_node(p, map.nodes()))).unwrap_or(u32::MAX);
            }
        }));
        if lattice.is_full() {
            return self.gather_rows(&rows.into());
        }
        let present: Vec<T> = rows.iter().map(|&row| if row == u32::MAX { T::zero() } else { T::one() }).collect();
        rows.iter_mut().filter(|row| **row == u32::MAX).for_each(|row| *row = 0);
        self.gather_rows(&rows.into()) * Tensor::from_vec(present, &[cells.len(), 1])
    }

    #[track_caller]
    fn check_grid(&self, op: &str, positions: &Self, lattice: &Lattice) {
        let rows = lattice.rows();
        assert!(
            self.ndim() == 2 && self.shape()[0] == rows && rows > 0,
            "{op}: a grid of {:?} nodes needs a table of shape [{rows}, C], got {:?}",
            lattice.nodes(),
            self.shape()
        );
        assert!(positions.ndim() == 2 && positions.shape()[1] == 3, "{op}: positions must be [m, 3], got {:?}", positions.shape());
    }
}

dispatched! {
/// Interpolates at each position. `W` is the width, or 0 if the width is known at run time only.
fn interpolate<T: Real, const W: usize, M: NodeMap>(table: &[T], cells: &[[T; 3]], map: M, width: usize, out: &mut [T]) {
    let width = if W == 0 { width } else { W };
    for (y, &cell) in out.chunks_exact_mut(width).zip(cells) {
        let (rows, weights) = corners(cell, map);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_of_many_are_those_of_each() {
        let nodes = [9, 14, 7];
        let holed = Lattice::bricks_where(nodes, |[i, j, k]| (i * 7 + j * 5 + k * 3) % 11 > 2 && (i / 4 + j / 4 + k / 4) % 2 == 0);
        // Positions inside cells, on nodes, on the border and outside the grid. Their number is not a multiple of the group size.
        let at: Vec<[f64; 3]> = (0..999).map(|i| std::array::from_fn(|a| f64::from((i * [7, 11, 13][a]) % 160) * 0.125 - 2.0)).collect();
        let columns: [Vec<f64>; 3] = std::array::from_fn(|a| at.iter().map(|p| p[a]).collect());
        for lattice in [Lattice::from(nodes), Lattice::bricks(nodes), holed] {
            let groups = at.len().div_ceil(TOGETHER);
            let (mut rows, mut weights) = (vec![[[0; TOGETHER]; 8]; groups], vec![[[0.0; TOGETHER]; 8]; groups]);
            with_map!(lattice, map => corners_of_many(columns.each_ref().map(|c| &c[..]), map, &mut rows, &mut weights));
            for (i, &p) in at.iter().enumerate() {
                let (group, lane) = (i / TOGETHER, i % TOGETHER);
                let found = (rows[group].map(|rows| rows[lane]), weights[group].map(|weights| weights[lane]));
                assert_eq!(found, with_map!(lattice, map => corners(p, map)), "position {p:?}");
            }
        }
    }
}
