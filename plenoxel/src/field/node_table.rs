//! Values at the nodes of a grid, stored so that a look-up for a picture reads few cache lines.
//!
//! Nodes are in bricks of 4³ cells. Bricks share the nodes of their faces, so the eight nodes of a cell are in one brick: a sample reads the place of its brick
//! once, and eight numbers near each other.

use crate::sampling::distances;
use autograd::lattice::{BRICK, BrickGrid};
use autograd::parallel::{gathered, pairs_around};
use autograd::{Buffer, Real, parallel};
use std::sync::Arc;

/// Nodes along the side of a brick of cells.
pub const SIDE: usize = BRICK + 1;
/// Entries of a brick in the table: its nodes in row-major order, and some that are not used.
pub const ENTRIES: usize = 128;
/// Offsets of the entries of the lower nodes of the edges of a cell along z from that of its lowest node. The upper nodes are the next entries.
const EDGES: [u32; 4] = [0, SIDE as u32, (SIDE * SIDE) as u32, (SIDE * SIDE + SIDE) as u32];
/// Number of entries from the lowest node of a cell to the highest.
const CELL: usize = EDGES[3] as usize + 2;
/// Bricks that one task computes.
pub const BRICKS_OF_TASK: usize = 256;

/// Smallest link of a brick that is not stored.
const EMPTY: u32 = 1 << 31;

/// Returns the place of a brick from its link; 0 if it is not stored.
#[inline(always)]
fn place_of(link: u32) -> u32 {
    if link >= EMPTY { 0 } else { link }
}

/// Bricks of a grid whose nodes have values in tables.
#[derive(Debug)]
pub struct StoredBricks {
    nodes: [usize; 3],
    grid: BrickGrid,
    /// Place of each brick in the tables, from 1 on. For those that are not stored, [`EMPTY`] plus the distance to the nearest stored brick ([`distances`]).
    links: Buffer<u32>,
    /// Numbers of the stored bricks.
    stored: Vec<u32>,
}

impl StoredBricks {
    /// Takes the numbers of stored bricks in the [`BrickGrid`] of the cells of a grid, which has two nodes or more along each axis. `None` if a table of them
    /// has more than 2³² entries.
    pub fn new(nodes: [usize; 3], stored: Vec<u32>) -> Option<Self> {
        if Self::entries(stored.len()) > u32::MAX as usize {
            return None;
        }
        let grid = BrickGrid::new(nodes.map(|n| n - 1));
        let mut masks = vec![0; grid.len()];
        stored.iter().for_each(|&brick| masks[brick as usize] = 1);
        let mut links = Buffer::stale(grid.len());
        links.iter_mut().zip(distances(&masks, grid.count())).for_each(|(link, distance)| *link = EMPTY + u32::from(distance));
        for (place, &brick) in (1..).zip(&stored) {
            links[brick as usize] = place;
        }
        Some(StoredBricks { nodes, grid, links, stored })
    }

    /// Returns the number of entries of a table with this number of bricks.
    pub fn entries(bricks: usize) -> usize {
        ENTRIES * (bricks + 1)
    }
}

/// Table of `WIDTH` numbers at each node of a grid.
#[derive(Debug)]
pub struct NodeTable<T: Real, const WIDTH: usize = 1> {
    bricks: Arc<StoredBricks>,
    values: Buffer<T>,
}

impl<T: Real, const WIDTH: usize> NodeTable<T, WIDTH> {
    /// Computes the table of stored bricks. `fill(brick, values)` must write all entries of a brick: they hold arbitrary values before.
    /// Nodes of other bricks have the value `elsewhere`.
    pub fn new(bricks: Arc<StoredBricks>, elsewhere: [T; WIDTH], fill: impl Fn(u32, &mut [[T; WIDTH]; ENTRIES]) + Sync) -> Self {
        let of_brick = WIDTH * ENTRIES;
        let mut table = Buffer::stale(WIDTH * StoredBricks::entries(bricks.stored.len()));
        let (of_others, rest) = table.split_at_mut(of_brick);
        of_others.as_chunks_mut().0.fill(elsewhere);
        parallel::for_each_chunk(rest, BRICKS_OF_TASK * of_brick, |first, of_bricks| {
            let of_bricks = of_bricks.as_chunks_mut().0.as_chunks_mut().0;
            for (values, &brick) in of_bricks.iter_mut().zip(&bricks.stored[first / of_brick..]) {
                fill(brick, values);
            }
        });
        NodeTable { bricks, values: table }
    }

    /// Returns the bricks of the table.
    pub fn bricks(&self) -> &Arc<StoredBricks> {
        &self.bricks
    }

    /// Returns the value at a node.
    pub fn value(&self, node: [usize; 3]) -> [T; WIDTH] {
        let StoredBricks { nodes, grid, links, .. } = &*self.bricks;
        let place = [0, 1, 2].map(|a| node[a].min(nodes[a] - 2) / BRICK);
        let [i, j, k] = [0, 1, 2].map(|a| node[a] - BRICK * place[a]);
        self.values.as_chunks().0[place_of(links[grid.number(place)]) as usize * ENTRIES + (i * SIDE + j) * SIDE + k]
    }
}

/// Cells that contain `N` positions.
pub struct Cells<T, const N: usize> {
    /// Entry of the lowest node of each cell.
    entries: [u32; N],
    /// Distances from that node along each axis, in cells.
    share: [[T; N]; 3],
    /// Place of the brick along each axis.
    bricks: [[u32; N]; 3],
    /// Link of the brick ([`StoredBricks`]).
    links: [u32; N],
}

impl<T: Real, const N: usize> Cells<T, N> {
    /// Finds the cells of positions. `at` has x, y and z of each, in cells; nodes are at whole numbers. Positions outside of the nodes are moved to the nearest
    /// one inside.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    pub fn find(bricks: &StoredBricks, at: [&[T; N]; 3]) -> Self {
        let (mut share, mut places) = ([[T::zero(); N]; 3], [[0; N]; 3]);
        let (mut numbers, mut entries) = ([0; N], [0; N]);
        for a in 0..3 {
            let (count, most) = (bricks.grid.count()[a] as u32, bricks.nodes[a] as u32 - 2);
            let last = T::lit(f64::from(most + 1));
            for i in 0..N {
                let u = at[a][i].max(T::zero()).min(last);
                let node = u.index().min(most);
                share[a][i] = u - T::lit(f64::from(node));
                places[a][i] = node / BRICK as u32;
                numbers[i] = numbers[i] * count + node / BRICK as u32;
                entries[i] = entries[i] * SIDE as u32 + node % BRICK as u32;
            }
        }
        let links = gathered(&bricks.links, numbers);
        for i in 0..N {
            entries[i] += place_of(links[i]) * ENTRIES as u32;
        }
        Cells { entries, share, bricks: places, links }
    }

    /// Returns which positions are in stored bricks.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // The compiler does not inline iterators in dispatched loops.
    pub fn stored(&self) -> [bool; N] {
        let mut stored = [false; N];
        for i in 0..N {
            stored[i] = self.links[i] < EMPTY;
        }
        stored
    }

    /// Finds along rays, at voxel coordinates origin + t slope with these reciprocals of the slopes, where they leave the bricks around them of which none is
    /// stored: a lower bound of the distances t, up to rounding. It is −∞ for positions in stored bricks.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    pub fn exits(&self, origin: &[[T; N]; 3], per_slope: &[[T; N]; 3]) -> [T; N] {
        let mut exits = [T::infinity(); N];
        for a in 0..3 {
            for i in 0..N {
                // All bricks nearer than `free` are empty.
                let (here, free) = (self.bricks[a][i], self.links[i] - EMPTY.min(self.links[i]));
                let plane = if per_slope[a][i] > T::zero() { (here + free) as i32 } else { here as i32 + 1 - free as i32 };
                let exit = (T::lit(f64::from(BRICK as i32 * plane)) - origin[a][i]) * per_slope[a][i];
                exits[i] = if exit < exits[i] { exit } else { exits[i] };
            }
        }
        for i in 0..N {
            exits[i] = if self.links[i] < EMPTY { T::neg_infinity() } else { exits[i] };
        }
        exits
    }

    /// Returns a number of cells: there are no stored bricks nearer than this to the positions `at`, which are those of [`find`](Self::find), along any axis.
    /// It is negative in stored bricks.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    pub fn clearance(&self, at: &[[T; N]; 3]) -> [T; N] {
        let mut clearance = [T::infinity(); N];
        for a in 0..3 {
            for i in 0..N {
                // All bricks nearer than `free` are empty.
                let (here, free) = (self.bricks[a][i] as i32, (self.links[i] - EMPTY.min(self.links[i])) as i32);
                let [low, high] = [here + 1 - free, here + free].map(|plane| T::lit(f64::from(BRICK as i32 * plane)));
                let (below, above) = (at[a][i] - low, high - at[a][i]);
                let near = if below < above { below } else { above };
                clearance[i] = if near < clearance[i] { near } else { clearance[i] };
            }
        }
        for i in 0..N {
            clearance[i] = if self.links[i] < EMPTY { -T::one() } else { clearance[i] };
        }
        clearance
    }

    /// Interpolates a table of one number a node.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    pub fn numbers<const FUSED: bool>(&self, table: &NodeTable<T>) -> [T; N] {
        // Along z, then y, then x.
        let (edges, share) = (pairs_around(&table.values, self.entries, EDGES), &self.share);
        let mut of_x = [[T::zero(); N]; 2];
        for x in 0..2 {
            let mut of_y = [[T::zero(); N]; 2];
            for y in 0..2 {
                let [below, above] = &edges[2 * x + y];
                for i in 0..N {
                    of_y[y][i] = (above[i] - below[i]).multiply_add::<FUSED>(share[2][i], below[i]);
                }
            }
            for i in 0..N {
                of_x[x][i] = (of_y[1][i] - of_y[0][i]).multiply_add::<FUSED>(share[1][i], of_y[0][i]);
            }
        }
        let mut values = [T::zero(); N];
        for i in 0..N {
            values[i] = (of_x[1][i] - of_x[0][i]).multiply_add::<FUSED>(share[0][i], of_x[0][i]);
        }
        values
    }

    /// Interpolates a table of four numbers a node at one of the positions.
    #[inline(always)]
    pub fn vector<const FUSED: bool>(&self, table: &NodeTable<T, 4>, i: usize) -> [T; 4] {
        let own: &[[T; 4]; CELL] =
            table.values.as_chunks().0[self.entries[i] as usize..].first_chunk().expect("the nodes of a cell are in its brick");
        let [x, y, z] = [self.share[0][i], self.share[1][i], self.share[2][i]];
        let mut edges = [[T::zero(); 4]; 4];
        for (edge, &first) in edges.iter_mut().zip(&EDGES) {
            *edge = between::<T, FUSED>(own[first as usize], own[first as usize + 1], z);
        }
        let [low, high] = [between::<T, FUSED>(edges[0], edges[1], y), between::<T, FUSED>(edges[2], edges[3], y)];
        between::<T, FUSED>(low, high, x)
    }
}

/// Returns the vector between two others, at a share of the way.
#[inline(always)]
fn between<T: Real, const FUSED: bool>(first: [T; 4], second: [T; 4], share: T) -> [T; 4] {
    let mut between = [T::zero(); 4];
    for c in 0..4 {
        between[c] = (second[c] - first[c]).multiply_add::<FUSED>(share, first[c]);
    }
    between
}
