//! Bricks of the cells of a lattice, whose values pictures read from tables ([`NodeTable`](crate::field::node_table::NodeTable)).

use crate::field::node_table::{ENTRIES, SIDE};
use autograd::Lattice;
use autograd::lattice::{BRICK, BRICK_ROWS, BrickGrid, STRIDE, bits_where, has, local_of};
use autograd::parallel;

/// Offsets from a brick to itself and to the next ones along the axes.
const AHEAD: [[usize; 3]; 8] = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0], [1, 1, 1]];

/// Number of nodes of a brick of cells.
const NODES: usize = SIDE * SIDE * SIDE;

/// Brick of voxels that has the value of each node of a brick of cells, as an index of [`AHEAD`], and its row in that brick.
const PLACES: [(usize, usize); NODES] = {
    let mut places = [(0, 0); NODES];
    let mut entry = 0;
    while entry < NODES {
        let node = [entry / (SIDE * SIDE), entry / SIDE % SIDE, entry % SIDE];
        let mut axis = 0;
        while axis < 3 {
            places[entry].0 = 2 * places[entry].0 + node[axis] / BRICK;
            places[entry].1 += node[axis] % BRICK * STRIDE[axis];
            axis += 1;
        }
        entry += 1;
    }
    places
};

/// Bricks of the cells between the voxels of a lattice.
pub(super) struct CellBricks<'a> {
    lattice: &'a Lattice,
    grid: BrickGrid,
}

impl<'a> CellBricks<'a> {
    /// Takes the bricks of a lattice with two voxels or more along each axis.
    pub fn new(lattice: &'a Lattice) -> Self {
        CellBricks { lattice, grid: BrickGrid::new(lattice.nodes().map(|n| n - 1)) }
    }

    /// Returns the numbers of the bricks of cells that read a voxel of `masks`, which has a mask for each brick of voxels.
    pub fn reading(&self, masks: &[u64]) -> Vec<u32> {
        // A brick of cells reads the voxels of its own brick, and those at the faces of the next ones.
        let read = AHEAD.map(|offset| bits_where(!0, |bit| (0..3).all(|a| offset[a] == 0 || local_of(bit)[a] == 0)));
        let (of_voxels, count) = (self.lattice.brick_grid(), self.lattice.brick_grid().count());
        let reads = |brick: &u32| {
            let places = self.ahead(*brick).into_iter().zip(read);
            let mut inside = places.filter(|(place, _)| (0..3).all(|a| place[a] < count[a]));
            inside.any(|(place, read)| masks[of_voxels.number(place)] & read != 0)
        };
        let stored = parallel::map_chunks(self.grid.len(), parallel::CHUNK, |range| {
            (range.start as u32..range.end as u32).filter(reads).collect::<Vec<_>>()
        });
        stored.concat()
    }

    /// Stores the values at the nodes of a brick of cells, from those of rows; `absent` for voxels that are not present.
    pub fn fill<V: Copy>(&self, brick: u32, absent: V, of_row: impl Fn(usize) -> V, values: &mut [V; ENTRIES]) {
        let parts = self.ahead(brick).map(|place| self.lattice.brick(place));
        let (of_nodes, unused) = values.split_at_mut(NODES);
        for (value, (part, row)) in of_nodes.iter_mut().zip(PLACES) {
            let number = parts[part].filter(|(_, mask)| has(*mask, row));
            *value = number.map_or(absent, |(number, _)| of_row(number * BRICK_ROWS + row));
        }
        unused.fill(absent);
    }

    /// Returns the places of the bricks of voxels that a brick of cells reads. Some can be outside of the lattice.
    fn ahead(&self, brick: u32) -> [[usize; 3]; 8] {
        let place = self.grid.place(brick as usize);
        AHEAD.map(|offset| [0, 1, 2].map(|a| place[a] + offset[a]))
    }
}
