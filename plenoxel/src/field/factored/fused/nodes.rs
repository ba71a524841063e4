//! Values that are linear in the products plane · line, at many positions near each other.
//!
//! In each cell, the product of a bilinear plane and a linear line is trilinear. So the values at the eight nodes of a cell give those at all positions in it, up to
//! rounding. Rays of neighbouring pixels see the same cells, which have fewer nodes than the rays have positions.

use super::lookup::{Cells, LANES, Places, RUN, add_to, run_of};
use autograd::{Real, dispatched, parallel};
use rustc_hash::{FxBuildHasher, FxHashMap};

/// Nodes of a cell: bit 2 of the number is the place along x, bit 1 along y, bit 0 along z.
const CORNERS: usize = 8;

/// Nodes of the cells that contain positions.
pub struct Nodes<'a, T: Real> {
    /// Places of the nodes, in units of cells.
    pub places: [Vec<T>; 3],
    /// Numbers of the nodes of each cell.
    corners: Vec<[u32; CORNERS]>,
    /// Positions, in units of cells.
    at: Places<'a, T>,
    /// Number of the cell of each position.
    cells: Vec<u32>,
    /// Nodes of the grid along each axis.
    grid: [usize; 3],
}

impl<'a, T: Real> Nodes<'a, T> {
    /// Finds the nodes around positions, in units of cells, in a grid with these numbers of nodes. `None` if there are more nodes than `most`, or more cells than half of it.
    pub fn around(at: Places<'a, T>, grid: [usize; 3], most: usize) -> Option<Self> {
        let index = |[i, j, k]: [usize; 3]| (i * grid[1] + j) * grid[2] + k;
        let (mut cells, mut lowest) = (Vec::with_capacity(at[0].len()), Vec::new());
        let mut distinct = Distinct::with_room_for(most / 2 + 1);
        for run in 0..at[0].len().div_ceil(RUN) {
            let own = Cells::new(run_of(at, run), grid);
            for i in 0..own.count {
                let low = own.node.map(|node| node[i] as usize);
                let cell = distinct.number(index(low));
                if cell as usize == lowest.len() {
                    if lowest.len() == most / 2 {
                        return None;
                    }
                    lowest.push(low);
                }
                cells.push(cell);
            }
        }
        let (mut places, mut corners) = ([(); 3].map(|()| Vec::new()), Vec::with_capacity(lowest.len()));
        let mut distinct = Distinct::with_room_for(most + CORNERS);
        for low in lowest {
            corners.push(std::array::from_fn(|corner| {
                let node = [low[0] + (corner >> 2), low[1] + (corner >> 1 & 1), low[2] + (corner & 1)];
                let number = distinct.number(index(node));
                if number as usize == places[0].len() {
                    places.iter_mut().zip(node).for_each(|(places, node)| places.push(T::lit(node as f64)));
                }
                number
            }));
            if places[0].len() > most {
                return None;
            }
        }
        Some(Nodes { places, corners, at, cells, grid })
    }

    /// Returns the number of nodes.
    pub fn len(&self) -> usize {
        self.places[0].len()
    }

    /// Computes the values at the positions from `first` on that `out` has rows for, from those at the nodes, `[nodes, width]`.
    pub fn interpolate(&self, first: usize, values: &[T], out: &mut [T]) {
        let width = values.len() / self.len();
        for (run, out) in out.chunks_mut(RUN * width).enumerate() {
            let start = first + run * RUN;
            let own = start..start + out.len() / width;
            let corners = &mut [[0; CORNERS]; RUN][..own.len()];
            corners.iter_mut().zip(&self.cells[own.clone()]).for_each(|(corners, &cell)| *corners = self.corners[cell as usize]);
            let cells = Cells::new(self.at.map(|at| &at[own.clone()]), self.grid);
            if parallel::fused() {
                interpolate_run::<T, true>(&cells, corners, values, out);
            } else {
                interpolate_run::<T, false>(&cells, corners, values, out);
            }
        }
    }
}

dispatched! {
fn interpolate_run<T: Real, const FUSED: bool>(cells: &Cells<T>, corners: &[[u32; CORNERS]], values: &[T], out: &mut [T]) {
    let width = out.len() / corners.len();
    for (i, (corners, out)) in corners.iter().zip(out.chunks_exact_mut(width)).enumerate() {
        let [x, y, z] = [cells.share[0][i], cells.share[1][i], cells.share[2][i]];
        let along = |share: T, upper: usize| if upper == 1 { share } else { T::one() - share };
        let (mut weights, mut rows) = ([T::zero(); CORNERS], [&values[..0]; CORNERS]);
        for c in 0..CORNERS {
            weights[c] = along(x, c >> 2) * along(y, c >> 1 & 1) * along(z, c & 1);
            rows[c] = &values[corners[c] as usize * width..][..width];
        }
        let (chunks, rest) = out.as_chunks_mut::<LANES>();
        let whole = chunks.len() * LANES;
        for (k, chunk) in chunks.iter_mut().enumerate() {
            let mut sum = [T::zero(); LANES];
            for c in 0..CORNERS {
                let row: &[T; LANES] = rows[c][k * LANES..].first_chunk().expect("a chunk of each row");
                add_to::<T, FUSED>(&mut sum, row, weights[c]);
            }
            *chunk = sum;
        }
        for (l, value) in rest.iter_mut().enumerate() {
            *value = T::zero();
            for c in 0..CORNERS {
                *value = rows[c][whole + l].multiply_add::<FUSED>(weights[c], *value);
            }
        }
    }
}
}

/// Numbers of distinct nodes, in the order in which they come first.
struct Distinct(FxHashMap<usize, u32>);

impl Distinct {
    fn with_room_for(nodes: usize) -> Self {
        Distinct(FxHashMap::with_capacity_and_hasher(nodes, FxBuildHasher))
    }

    /// Returns the number of a node from its index in the grid.
    fn number(&mut self, index: usize) -> u32 {
        let next = self.0.len() as u32;
        *self.0.entry(index).or_insert(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::random::Stream;

    #[test]
    fn nodes_are_found_once_and_too_many_are_refused() {
        let grid = [4, 3, 5];
        let columns = [0, 1, 2].map(|axis| {
            let most = grid[axis] as f64 - 1.0;
            Stream::new(axis as u64).uniform_tensor::<f64>(&[2000], 0.0, most).data().to_vec()
        });
        let at = columns.each_ref().map(|column| &column[..]);
        let all: Vec<_> = (0..4).flat_map(|i| (0..3).flat_map(move |j| (0..5).map(move |k| [i, j, k]))).collect();
        let nodes = Nodes::around(at, grid, all.len()).expect("as many nodes as may be");
        let mut found: Vec<_> = (0..nodes.len()).map(|n| nodes.places.each_ref().map(|places| places[n] as usize)).collect();
        found.sort_unstable();
        assert_eq!(found, all);
        assert!(Nodes::around(at, grid, all.len() - 1).is_none());
        // Eight cells that have 64 nodes, and three of them.
        let apart = [0, 1, 2].map(|axis| (0..8).map(|i| f64::from(2 * (i >> axis & 1)) + 0.5).collect::<Vec<_>>());
        let apart = apart.each_ref().map(|column| &column[..]);
        assert!(Nodes::around(apart, [4; 3], 63).is_none() && Nodes::around(apart, [4; 3], 64).is_some());
        assert!(Nodes::around(apart, [4; 3], 15).is_none() && Nodes::around(apart.map(|at| &at[..3]), [4; 3], 24).is_some());
        assert!(Nodes::<f64>::around([&[]; 3], grid, 0).is_some_and(|nodes| nodes.len() == 0));
    }
}
