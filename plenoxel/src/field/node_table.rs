//! Values at the nodes of a grid, stored so that a look-up for a picture reads few cache lines.
//!
//! Nodes are in bricks of 4³ cells. Bricks share the nodes of their faces, so the eight nodes of a cell are in one brick: a sample reads the place of its brick
//! once, and eight numbers near each other.

use autograd::lattice::{BRICK, BrickGrid};
use autograd::parallel::{gathered, gathered_around};
use autograd::{Real, dispatched, parallel};

/// Nodes along the side of a brick of cells.
pub const SIDE: usize = BRICK + 1;
/// Entries of a brick in the table: its nodes in row-major order, and some that are not used.
pub const ENTRIES: usize = 128;
/// Offsets of the entries of the nodes of a cell from that of its lowest node; along z first.
const CORNERS: [u32; 8] = {
    const X: u32 = (SIDE * SIDE) as u32;
    const Y: u32 = SIDE as u32;
    [0, 1, Y, Y + 1, X, X + 1, X + Y, X + Y + 1]
};
/// Bricks that one task computes.
pub const TOGETHER: usize = 256;

/// Table of a value at the nodes of a grid.
#[derive(Debug)]
pub struct NodeTable<T> {
    nodes: [usize; 3],
    bricks: BrickGrid,
    /// Place of each brick in the table; 0 for those that are not stored.
    links: Vec<u32>,
    values: Vec<T>,
}

impl<T: Real> NodeTable<T> {
    /// Returns the number of entries of a table with this number of bricks.
    pub fn entries(bricks: usize) -> usize {
        ENTRIES * (bricks + 1)
    }

    /// Computes the table of a grid with two nodes or more along each axis. `stored` has the numbers of bricks in the [`BrickGrid`] of cells; nodes of other
    /// bricks have the value `elsewhere`. `values(brick)` returns the values of a brick.
    ///
    /// Panics if the table has more than 2³² entries.
    pub fn new(nodes: [usize; 3], stored: &[u32], elsewhere: T, values: impl Fn(u32) -> [T; ENTRIES] + Sync) -> Self {
        let bricks = BrickGrid::new(nodes.map(|n| n - 1));
        let entries = Self::entries(stored.len());
        assert!(entries <= u32::MAX as usize, "a table of {entries} entries: entries have numbers of 32 bits");
        let mut links = vec![0; bricks.len()];
        for (place, &brick) in (1..).zip(stored) {
            links[brick as usize] = place;
        }
        let mut table = vec![elsewhere; entries];
        parallel::for_each_chunk(&mut table[ENTRIES..], TOGETHER * ENTRIES, |first, of_bricks| {
            for (to, &brick) in of_bricks.chunks_exact_mut(ENTRIES).zip(&stored[first / ENTRIES..]) {
                to.copy_from_slice(&values(brick));
            }
        });
        NodeTable { nodes, bricks, links, values: table }
    }

    /// Returns the value at a node.
    pub fn value(&self, node: [usize; 3]) -> T {
        let place = [0, 1, 2].map(|a| node[a].min(self.nodes[a] - 2) / BRICK);
        let [i, j, k] = [0, 1, 2].map(|a| node[a] - BRICK * place[a]);
        self.values[self.links[self.bricks.number(place)] as usize * ENTRIES + (i * SIDE + j) * SIDE + k]
    }
}

dispatched! {
/// Interpolates the values of `N` positions trilinearly. `at` has x, y and z of each, in cells; nodes are at whole numbers. Positions outside of the
/// nodes are moved to the nearest one inside. Returns false if none of their bricks is stored; the values are then not written.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
pub fn interpolate<T: Real, const N: usize, const FUSED: bool>(table: &NodeTable<T>, at: [&[T; N]; 3], values: &mut [T; N]) -> bool {
    let mut share = [[T::zero(); N]; 3];
    let (mut numbers, mut entries) = ([0; N], [0; N]);
    for a in 0..3 {
        let (bricks, most) = (table.bricks.count()[a] as u32, table.nodes[a] as u32 - 2);
        let last = T::lit(f64::from(most + 1));
        for i in 0..N {
            let u = at[a][i].max(T::zero()).min(last);
            let node = u.index().min(most);
            share[a][i] = u - T::lit(f64::from(node));
            numbers[i] = numbers[i] * bricks + node / BRICK as u32;
            entries[i] = entries[i] * SIDE as u32 + node % BRICK as u32;
        }
    }
    let links = gathered(&table.links, numbers);
    let mut any = 0;
    for i in 0..N {
        any |= links[i];
        entries[i] += links[i] * ENTRIES as u32;
    }
    if any == 0 {
        return false;
    }
    // Along z, then y, then x.
    let corners = gathered_around(&table.values, entries, CORNERS);
    let mut of_x = [[T::zero(); N]; 2];
    for x in 0..2 {
        let mut of_y = [[T::zero(); N]; 2];
        for y in 0..2 {
            let (below, above) = (&corners[4 * x + 2 * y], &corners[4 * x + 2 * y + 1]);
            for i in 0..N {
                of_y[y][i] = (above[i] - below[i]).multiply_add::<FUSED>(share[2][i], below[i]);
            }
        }
        for i in 0..N {
            of_x[x][i] = (of_y[1][i] - of_y[0][i]).multiply_add::<FUSED>(share[1][i], of_y[0][i]);
        }
    }
    for i in 0..N {
        values[i] = (of_x[1][i] - of_x[0][i]).multiply_add::<FUSED>(share[0][i], of_x[0][i]);
    }
    true
}
}
