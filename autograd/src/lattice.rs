//! [`Lattice`]: the mapping from the nodes of a three-dimensional grid to the rows of a table.
//!
//! There are two layouts:
//!
//! * *Row-major*: node (i, j, k) of `[nx, ny, nz]` has row (i·ny + j)·nz + k, and every node has a row.
//! * *Bricks*: a brick of 4³ nodes has 64 consecutive rows, in row-major order inside the brick. A link table stores the position of each brick in the table;
//!   bricks without present nodes have no rows and take no memory. Bricks are ordered along a Morton curve, so nodes that are near in space are near in
//!   memory. Each brick has a mask with a bit for each node that is *present*. A node that is not present reads as a row of zeros and gets no gradient.

mod bricks;

use crate::parallel::gathered;
use bricks::node_at;
pub use bricks::{BRICK, BRICK_ROWS, BrickGrid, STRIDE, bit_of, bits, bits_where, has, local_of, next_in, previous_in};
use std::sync::{Arc, OnceLock};

/// Number of nodes that are looked up together.
pub const TOGETHER: usize = 16;

/// The layout of a grid in a table. Cloning copies a pointer.
#[derive(Clone, Debug)]
pub struct Lattice {
    nodes: [usize; 3],
    /// Brick layout, or `None` if the layout is row-major.
    bricks: Option<Arc<BrickTable>>,
}

/// The brick layout: the bricks that have rows, and the masks of their nodes. A stored brick is a brick that has rows.
#[derive(Debug)]
struct BrickTable {
    grid: BrickGrid,
    /// For each brick of the grid, in row-major order, its index among the stored bricks; the number of stored bricks if it is not stored.
    links: Vec<u32>,
    /// Masks of the stored bricks, in the order of their rows, and an empty mask at the end. This array is small enough to stay in the cache.
    linked_masks: Vec<u64>,
    /// Mask of present nodes for each brick of the grid, in row-major order.
    masks: Vec<u64>,
    /// True if every node of the grid is present.
    full: bool,
    /// Brick coordinates of each stored brick, in the order of their rows.
    places: Vec<[u32; 3]>,
    neighbours: OnceLock<Vec<Neighbours>>,
}

/// The neighbours of a brick, and the nodes of the brick that have a complete cell.
#[derive(Clone, Copy, Debug)]
pub struct Neighbours {
    /// Number of the next brick along each axis, if it has rows.
    pub ahead: [Option<u32>; 3],
    /// Number of the previous brick along each axis, if it has rows.
    pub behind: [Option<u32>; 3],
    /// Mask of the nodes that are present and whose next node along each of the three axes is present.
    pub cells: u64,
}

impl From<[usize; 3]> for Lattice {
    fn from(nodes: [usize; 3]) -> Self {
        Lattice { nodes, bricks: None }
    }
}

impl From<&Lattice> for Lattice {
    fn from(lattice: &Lattice) -> Self {
        lattice.clone()
    }
}

impl Lattice {
    /// Returns a brick layout in which all nodes are present.
    pub fn bricks(nodes: [usize; 3]) -> Self {
        Self::bricks_where(nodes, |_| true)
    }

    /// Returns a brick layout in which a node is present if `present(node)` is true.
    pub fn bricks_where(nodes: [usize; 3], present: impl Fn([usize; 3]) -> bool + Sync) -> Self {
        Self::bricks_among(nodes, |_| true, present)
    }

    /// Returns a brick layout in which a node is present if `among(brick)` is true for the coordinates of its brick, x, y and z in bricks, and `present(node)`
    /// is true. `present` is called only for nodes of such bricks, so this is much faster than [`Lattice::bricks_where`] if most of the grid is empty.
    pub fn bricks_among(nodes: [usize; 3], among: impl Fn([usize; 3]) -> bool + Sync, present: impl Fn([usize; 3]) -> bool + Sync) -> Self {
        let grid = BrickGrid::new(nodes);
        let masks = crate::parallel::map_indices(grid.len(), |brick| {
            let place = grid.place(brick);
            if among(place) { bits_where(grid.inside(brick), |bit| present(node_at(place, bit))) } else { 0 }
        });
        Self::from_masks(nodes, masks)
    }

    /// Returns a brick layout from the mask of present nodes of each brick. The bricks are in row-major order.
    ///
    /// Panics if the number of masks is not the number of bricks, or if a node outside the grid is present.
    pub fn from_masks(nodes: [usize; 3], masks: Vec<u64>) -> Self {
        let grid = BrickGrid::new(nodes);
        assert_eq!(masks.len(), grid.len(), "from_masks: {} masks for a lattice of {:?} bricks", masks.len(), grid.count());
        let mut places: Vec<[u32; 3]> = Vec::new();
        for (brick, &mask) in masks.iter().enumerate().filter(|(_, mask)| **mask != 0) {
            if let Some(bit) = bits(mask & !grid.inside(brick)).next() {
                panic!("from_masks: node {:?} is outside a lattice of {nodes:?} nodes", grid.node(brick, bit));
            }
            places.push(grid.place(brick).map(|c| c as u32));
        }
        places.sort_unstable_by_key(|&place| morton(place));
        let mut links = vec![places.len() as u32; masks.len()];
        let mut linked_masks = vec![0; places.len() + 1];
        for (brick, place) in places.iter().enumerate() {
            let b = grid.number(place.map(|c| c as usize));
            (links[b], linked_masks[brick]) = (brick as u32, masks[b]);
        }
        let full = masks.iter().map(|mask| mask.count_ones() as usize).sum::<usize>() == nodes.iter().product::<usize>();
        Lattice {
            nodes,
            bricks: Some(Arc::new(BrickTable { grid, links, linked_masks, masks, full, places, neighbours: OnceLock::new() })),
        }
    }

    /// Returns the number of nodes along each axis.
    pub fn nodes(&self) -> [usize; 3] {
        self.nodes
    }

    /// Returns the number of rows of a table in this layout. It includes the rows of nodes that are not present in stored bricks; these are never read.
    pub fn rows(&self) -> usize {
        match &self.bricks {
            None => self.nodes.iter().product(),
            Some(bricks) => bricks.places.len() * BRICK_ROWS,
        }
    }

    /// Returns the number of nodes that are present.
    pub fn present(&self) -> usize {
        match &self.bricks {
            None => self.nodes.iter().product(),
            Some(bricks) => bricks.masks.iter().map(|mask| mask.count_ones() as usize).sum(),
        }
    }

    /// Returns true if every node is present.
    pub fn is_full(&self) -> bool {
        self.bricks.as_ref().is_none_or(|bricks| bricks.full)
    }

    /// Returns the row of a node, or `None` if the node is not present.
    ///
    /// Panics if the node is outside the grid.
    #[inline]
    pub fn row(&self, node: [usize; 3]) -> Option<u32> {
        assert!((0..3).all(|a| node[a] < self.nodes[a]), "node {node:?} is outside a lattice of {:?} nodes", self.nodes);
        with_map!(self, map => map.row(node))
    }

    /// Returns the node of a row, or `None` if the row has no node that is present.
    pub fn node(&self, row: u32) -> Option<[usize; 3]> {
        match &self.bricks {
            None => {
                let (row, [nx, ny, nz]) = (row as usize, self.nodes);
                (row < nx * ny * nz).then(|| [row / (ny * nz), row / nz % ny, row % nz])
            }
            Some(bricks) => {
                let place = bricks.places.get(row as usize / BRICK_ROWS)?.map(|c| c as usize);
                let local = row as usize % BRICK_ROWS;
                has(bricks.masks[bricks.grid.number(place)], local).then(|| node_at(place, local))
            }
        }
    }

    /// Returns the number and the mask of the brick at the given brick coordinates, or `None` if the brick has no rows, is outside the grid, or the layout is
    /// row-major. The rows of brick number b begin at 64 b.
    pub fn brick(&self, place: [usize; 3]) -> Option<(usize, u64)> {
        let bricks = self.bricks.as_ref()?;
        if (0..3).any(|a| place[a] >= bricks.grid.count()[a]) {
            return None;
        }
        let b = bricks.grid.number(place);
        (bricks.masks[b] != 0).then(|| (bricks.links[b] as usize, bricks.masks[b]))
    }

    /// Returns the neighbours of each brick that has rows, in the order of the rows. They are computed on first use.
    ///
    /// Panics if the layout is row-major.
    pub fn neighbours(&self) -> &[Neighbours] {
        let bricks = self.bricks.as_ref().expect("neighbours: the layout is row-major, expected bricks");
        bricks
            .neighbours
            .get_or_init(|| crate::parallel::map_indices(bricks.places.len(), |b| self.neighbours_of(bricks.places[b].map(|c| c as usize))))
    }

    fn neighbours_of(&self, place: [usize; 3]) -> Neighbours {
        let mask = self.brick(place).map_or(0, |(_, mask)| mask);
        let neighbour = |a: usize, step: isize| {
            let mut there = place;
            there[a] = there[a].checked_add_signed(step)?;
            self.brick(there)
        };
        let mut cells = mask;
        for a in 0..3 {
            let next = neighbour(a, 1).map_or(0, |(_, mask)| mask);
            cells &= next_in(mask, next, a);
        }
        let numbers = |step: isize| [0, 1, 2].map(|a| neighbour(a, step).map(|(brick, _)| brick as u32));
        Neighbours { ahead: numbers(1), behind: numbers(-1), cells }
    }

    /// Returns the mask of present nodes of each brick of the grid ([`brick_grid`](Self::brick_grid)), or an empty slice for a row-major layout.
    pub fn masks(&self) -> &[u64] {
        self.bricks.as_ref().map_or(&[], |bricks| &bricks.masks)
    }

    /// Returns the division of the nodes into bricks, for both layouts.
    pub fn brick_grid(&self) -> BrickGrid {
        BrickGrid::new(self.nodes)
    }

    /// Returns the brick layout as a [`NodeMap`] for kernels, or `None` if the layout is row-major.
    pub fn brick_map(&self) -> Option<BrickMap<'_>> {
        self.bricks.as_ref().map(|b| BrickMap { grid: b.grid, links: &b.links, masks: &b.linked_masks })
    }

    /// Returns the brick layout as a [`NodeMap`] without masks, or `None` if the layout is row-major or a node is not present.
    pub fn full_brick_map(&self) -> Option<FullBrickMap<'_>> {
        self.brick_map().filter(|_| self.is_full()).map(FullBrickMap)
    }
}

/// Returns the Morton code: the interleaved bits of the three coordinates, in the order x, y, z from the most significant bit.
fn morton(place: [u32; 3]) -> u64 {
    let spread = |c: u32| {
        let mut c = u64::from(c) & 0x1f_ffff;
        for (shift, mask) in [
            (32, 0x001f_0000_0000_ffff),
            (16, 0x001f_0000_ff00_00ff),
            (8, 0x100f_00f0_0f00_f00f),
            (4, 0x10c3_0c30_c30c_30c3),
            (2, 0x1249_2492_4924_9249),
        ] {
            c = (c | c << shift) & mask;
        }
        c
    };
    spread(place[0]) << 2 | spread(place[1]) << 1 | spread(place[2])
}

/// The mapping from nodes to rows, as used in the loops of kernels. It has a code for each node of the grid, and maps codes to rows.
pub trait NodeMap: Copy + Sync {
    /// Returns the number of nodes along each axis.
    fn nodes(self) -> [usize; 3];
    /// Returns the contribution of one coordinate to the code of a node.
    fn share(self, axis: usize, coordinate: u32) -> u32;
    /// Returns the code of a node inside the grid. It is computed by arithmetic only, so that loops over many nodes vectorise.
    #[inline(always)]
    fn code(self, node: [u32; 3]) -> u32 {
        self.share(0, node[0]) + self.share(1, node[1]) + self.share(2, node[2])
    }
    /// Returns the row of the node with the given code, or `None` if the node is not present.
    fn row_of(self, code: u32) -> Option<u32>;
    /// Returns the rows of the nodes with the given codes, and for each node a word with all bits set if it is present, else 0. The row of a node that is not
    /// present is unspecified.
    fn rows_of(self, codes: [u32; TOGETHER]) -> ([u32; TOGETHER], [u32; TOGETHER]);
    /// Returns the row of a node inside the grid, or `None` if the node is not present.
    #[inline(always)]
    fn row(self, node: [usize; 3]) -> Option<u32> {
        self.row_of(self.code(node.map(|c| c as u32)))
    }
    /// True if some nodes may be missing.
    const SPARSE: bool;
}

/// The [`NodeMap`] of the row-major layout.
#[derive(Clone, Copy, Debug)]
pub struct RowMajor {
    /// Number of nodes along each axis.
    pub nodes: [usize; 3],
}

impl NodeMap for RowMajor {
    const SPARSE: bool = false;
    #[inline(always)]
    fn nodes(self) -> [usize; 3] {
        self.nodes
    }
    #[inline(always)]
    fn share(self, axis: usize, coordinate: u32) -> u32 {
        coordinate * [self.nodes[1] * self.nodes[2], self.nodes[2], 1][axis] as u32
    }
    #[inline(always)]
    fn row_of(self, code: u32) -> Option<u32> {
        Some(code)
    }
    #[inline(always)]
    fn rows_of(self, codes: [u32; TOGETHER]) -> ([u32; TOGETHER], [u32; TOGETHER]) {
        (codes, [!0; TOGETHER])
    }
}

/// [`BRICK`] and [`BRICK_ROWS`] in the integer type of node codes.
const SIDE: u32 = BRICK as u32;
const ROWS: u32 = BRICK_ROWS as u32;

/// The [`NodeMap`] of the brick layout.
#[derive(Clone, Copy, Debug)]
pub struct BrickMap<'a> {
    grid: BrickGrid,
    links: &'a [u32],
    masks: &'a [u64],
}

impl BrickMap<'_> {
    /// Returns the links of the bricks that contain the nodes with the given codes.
    #[inline(always)]
    fn linked(self, codes: [u32; TOGETHER]) -> [u32; TOGETHER] {
        gathered(self.links, codes.map(|code| code / ROWS))
    }
}

impl NodeMap for BrickMap<'_> {
    const SPARSE: bool = true;
    #[inline(always)]
    fn nodes(self) -> [usize; 3] {
        self.grid.nodes()
    }
    /// Returns a share of the code, which is the number of the brick in the grid times 64, plus the bit of the node in the brick.
    #[inline(always)]
    fn share(self, axis: usize, coordinate: u32) -> u32 {
        let bricks = self.grid.strides()[axis] as u32;
        coordinate / SIDE * bricks * ROWS + coordinate % SIDE * STRIDE[axis] as u32
    }
    #[inline(always)]
    fn row_of(self, code: u32) -> Option<u32> {
        let (link, local) = (self.links[(code / ROWS) as usize], code % ROWS);
        has(self.masks[link as usize], local as usize).then_some(link * ROWS + local)
    }
    #[inline(always)]
    fn rows_of(self, codes: [u32; TOGETHER]) -> ([u32; TOGETHER], [u32; TOGETHER]) {
        let links = self.linked(codes);
        let masks = gathered(self.masks, links);
        let (mut rows, mut present) = ([0; TOGETHER], [0; TOGETHER]);
        for i in 0..TOGETHER {
            let local = codes[i] % ROWS;
            rows[i] = links[i] * ROWS + local;
            present[i] = 0u32.wrapping_sub((masks[i] >> local) as u32 & 1);
        }
        (rows, present)
    }
}

/// The [`NodeMap`] of a brick layout in which all nodes are present.
#[derive(Clone, Copy, Debug)]
pub struct FullBrickMap<'a>(BrickMap<'a>);

impl NodeMap for FullBrickMap<'_> {
    const SPARSE: bool = false;
    #[inline(always)]
    fn nodes(self) -> [usize; 3] {
        self.0.nodes()
    }
    #[inline(always)]
    fn share(self, axis: usize, coordinate: u32) -> u32 {
        self.0.share(axis, coordinate)
    }
    #[inline(always)]
    fn row_of(self, code: u32) -> Option<u32> {
        Some(self.0.links[(code / ROWS) as usize] * ROWS + code % ROWS)
    }
    #[inline(always)]
    fn rows_of(self, codes: [u32; TOGETHER]) -> ([u32; TOGETHER], [u32; TOGETHER]) {
        let links = self.0.linked(codes);
        let mut rows = [0; TOGETHER];
        for i in 0..TOGETHER {
            rows[i] = links[i] * ROWS + codes[i] % ROWS;
        }
        (rows, [!0; TOGETHER])
    }
}

/// Evaluates an expression with the [`NodeMap`] of a lattice. The expression is compiled once for each layout.
macro_rules! with_map {
    ($lattice:expr, $map:ident => $body:expr) => {
        match $lattice.brick_map() {
            None => {
                let $map = $crate::lattice::RowMajor { nodes: $lattice.nodes() };
                $body
            }
            Some($map) => $body,
        }
    };
}
pub(crate) use with_map;

#[cfg(test)]
mod tests {
    use super::*;

    fn holed(nodes: [usize; 3]) -> Lattice {
        Lattice::bricks_where(nodes, |[i, j, k]| (i * 7 + j * 5 + k * 3) % 11 > 2 && (i / 4 + j / 4 + k / 4) % 2 == 0)
    }

    #[test]
    fn every_present_node_has_a_row_of_its_own_that_knows_it() {
        for nodes in [[4, 4, 4], [9, 6, 7], [1, 1, 1], [16, 3, 20]] {
            for lattice in [Lattice::from(nodes), Lattice::bricks(nodes), holed(nodes)] {
                let mut rows = Vec::new();
                for i in 0..nodes[0] {
                    for j in 0..nodes[1] {
                        for k in 0..nodes[2] {
                            if let Some(row) = lattice.row([i, j, k]) {
                                assert_eq!(lattice.node(row), Some([i, j, k]));
                                rows.push(row);
                            }
                        }
                    }
                }
                rows.sort_unstable();
                rows.dedup();
                assert_eq!(rows.len(), lattice.present());
                assert!(rows.last().is_none_or(|&last| (last as usize) < lattice.rows()));
                assert_eq!(lattice.is_full(), lattice.present() == nodes.iter().product::<usize>());
                assert_eq!((0..lattice.rows() as u32).filter(|&row| lattice.node(row).is_some()).count(), lattice.present());
            }
        }
    }

    #[test]
    fn rows_of_a_cube_of_bricks_are_neighbours_along_the_morton_curve() {
        let lattice = Lattice::bricks([32; 3]);
        // The first 64 bricks are the cube of 16³ nodes at the origin of the grid.
        let cube = |row: u32| lattice.node(row).is_some_and(|node| node.iter().all(|&c| c < 16));
        assert!((0..16 * 16 * 16).all(cube) && !(16 * 16 * 16..32 * 32 * 32).any(cube));
    }

    #[test]
    fn a_cell_is_a_present_node_with_three_present_nodes_ahead() {
        let lattice = holed([9, 10, 7]);
        for (brick, neighbours) in lattice.neighbours().iter().enumerate() {
            for local in 0..BRICK_ROWS {
                let want = lattice.node((brick * BRICK_ROWS + local) as u32).is_some_and(|node| {
                    (0..3).all(|a| {
                        let mut ahead = node;
                        ahead[a] += 1;
                        ahead[a] < lattice.nodes()[a] && lattice.row(ahead).is_some()
                    })
                });
                assert_eq!(neighbours.cells >> local & 1 == 1, want);
            }
            for a in 0..3 {
                if let Some(ahead) = neighbours.ahead[a] {
                    assert_eq!(lattice.neighbours()[ahead as usize].behind[a], Some(brick as u32));
                }
            }
        }
    }
}
