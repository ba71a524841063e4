//! The division of a box of nodes into bricks of 4³ nodes, and the arithmetic of brick masks. Only this module depends on the order of the bits in a mask.
//!
//! Bricks are numbered in row-major order of their brick coordinates. A mask has one bit for each node of a brick: node (i, j, k) of the brick has bit
//! 16 i + 4 j + k. If the size of the box is not a multiple of 4, the last bricks extend beyond it.

/// Number of nodes along the side of a brick.
pub const BRICK: usize = 4;
/// Number of nodes of a brick, which is also the number of bits of its mask and of its rows in a table.
pub const BRICK_ROWS: usize = BRICK * BRICK * BRICK;
/// Distance from a node of a brick to the next along x, y and z, in rows or in bits of a mask.
pub const STRIDE: [usize; 3] = [16, 4, 1];
/// Masks of the nodes of a brick whose coordinate x, y or z in the brick is 0.
const FIRST: [u64; 3] = [0xffff, 0x000f_000f_000f_000f, 0x1111_1111_1111_1111];

/// A box of nodes divided into bricks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BrickGrid {
    nodes: [usize; 3],
    count: [usize; 3],
}

impl BrickGrid {
    /// Divides a box with the given numbers of nodes along x, y and z.
    #[inline(always)]
    pub fn new(nodes: [usize; 3]) -> Self {
        BrickGrid { nodes, count: nodes.map(|n| n.div_ceil(BRICK)) }
    }

    /// Returns the number of nodes along each axis.
    #[inline(always)]
    pub fn nodes(&self) -> [usize; 3] {
        self.nodes
    }

    /// Returns the number of bricks along each axis.
    #[inline(always)]
    pub fn count(&self) -> [usize; 3] {
        self.count
    }

    /// Returns the number of bricks.
    #[inline(always)]
    pub fn len(&self) -> usize {
        self.count[0] * self.count[1] * self.count[2]
    }

    /// Returns true if the box has no nodes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the difference of brick numbers between neighbouring bricks along each axis.
    #[inline(always)]
    pub fn strides(&self) -> [usize; 3] {
        [self.count[1] * self.count[2], self.count[2], 1]
    }

    /// Returns the number of the brick at the given brick coordinates (x, y and z in bricks).
    #[inline(always)]
    pub fn number(&self, place: [usize; 3]) -> usize {
        (place[0] * self.count[1] + place[1]) * self.count[2] + place[2]
    }

    /// Returns the brick coordinates (x, y and z in bricks) of a brick number.
    #[inline(always)]
    pub fn place(&self, brick: usize) -> [usize; 3] {
        let [_, ny, nz] = self.count;
        [brick / (ny * nz), brick / nz % ny, brick % nz]
    }

    /// Returns the number of the brick that contains a node, and the bit of the node in the mask of the brick.
    #[inline(always)]
    pub fn split(&self, node: [usize; 3]) -> (usize, usize) {
        (self.number(node.map(|c| c / BRICK)), bit_of(node.map(|c| c % BRICK)))
    }

    /// Returns the node with the given brick number and bit: the inverse of [`split`](Self::split). The node may be outside the box.
    #[inline(always)]
    pub fn node(&self, brick: usize, bit: usize) -> [usize; 3] {
        node_at(self.place(brick), bit)
    }

    /// Returns the range of the nodes of a brick that are in the box: the lowest node along each axis, and the highest plus one.
    #[inline(always)]
    pub fn bounds(&self, brick: usize) -> [[usize; 3]; 2] {
        let low = self.place(brick).map(|c| c * BRICK);
        [low, [0, 1, 2].map(|a| (low[a] + BRICK).min(self.nodes[a]))]
    }

    /// Returns the mask of the nodes of a brick that are in the box.
    pub fn inside(&self, brick: usize) -> u64 {
        let [low, high] = self.bounds(brick);
        (0..3).fold(!0, |mask, a| mask & (0..high[a] - low[a]).fold(0, |layers, k| layers | FIRST[a] << (k * STRIDE[a])))
    }

    /// Returns one mask for each brick, with the bits of the given nodes set.
    ///
    /// Panics if a node's brick does not exist.
    pub fn masks_of(&self, nodes: impl IntoIterator<Item = [usize; 3]>) -> Vec<u64> {
        let mut masks = vec![0; self.len()];
        for node in nodes {
            let (brick, bit) = self.split(node);
            masks[brick] |= 1 << bit;
        }
        masks
    }
}

/// Returns the bit of a node from its coordinates in the brick.
#[inline(always)]
pub fn bit_of(local: [usize; 3]) -> usize {
    local[0] * STRIDE[0] + local[1] * STRIDE[1] + local[2]
}

/// Returns the coordinates in the brick of the node with the given bit: the inverse of [`bit_of`].
#[inline(always)]
pub fn local_of(bit: usize) -> [usize; 3] {
    [bit / STRIDE[0], bit / STRIDE[1] % BRICK, bit % BRICK]
}

/// Returns the node with the given bit of the brick at the given brick coordinates.
#[inline(always)]
pub(super) fn node_at(place: [usize; 3], bit: usize) -> [usize; 3] {
    let local = local_of(bit);
    [0, 1, 2].map(|a| place[a] * BRICK + local[a])
}

/// Returns true if a bit of a mask is set.
#[inline(always)]
pub fn has(mask: u64, bit: usize) -> bool {
    mask >> bit & 1 == 1
}

/// Returns the set bits of a mask, in ascending order.
#[inline(always)]
pub fn bits(mask: u64) -> impl Iterator<Item = usize> {
    std::iter::successors(Some(mask), |left| Some(left & left.wrapping_sub(1)))
        .take_while(|&left| left != 0)
        .map(|left| left.trailing_zeros() as usize)
}

/// Returns the mask of the set bits for which `holds(bit)` is true. `holds` is called for each set bit, in ascending order.
#[inline(always)]
pub fn bits_where(mask: u64, mut holds: impl FnMut(usize) -> bool) -> u64 {
    (0..BRICK_ROWS).filter(|&bit| has(mask, bit) && holds(bit)).fold(0, |out, bit| out | 1 << bit)
}

/// Returns the mask of the nodes of a brick whose next node along an axis is set. `mask` is the mask of the brick, and `ahead` the mask of the next brick.
#[inline(always)]
pub fn next_in(mask: u64, ahead: u64, axis: usize) -> u64 {
    (mask & !FIRST[axis]) >> STRIDE[axis] | (ahead & FIRST[axis]) << ((BRICK - 1) * STRIDE[axis])
}

/// Returns the mask of the nodes of a brick whose previous node along an axis is set. `mask` is the mask of the brick, and `behind` the mask of the previous
/// brick.
#[inline(always)]
pub fn previous_in(mask: u64, behind: u64, axis: usize) -> u64 {
    let last = FIRST[axis] << ((BRICK - 1) * STRIDE[axis]);
    (mask & !last) << STRIDE[axis] | (behind & last) >> ((BRICK - 1) * STRIDE[axis])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_found_again_from_its_brick_and_bit() {
        for nodes in [[4, 4, 4], [9, 6, 7], [1, 1, 1], [16, 3, 20]] {
            let grid = BrickGrid::new(nodes);
            let all = (0..grid.len()).flat_map(|brick| bits(grid.inside(brick)).map(move |bit| (brick, bit)));
            let mut seen = 0;
            for (brick, bit) in all {
                let node = grid.node(brick, bit);
                let [low, high] = grid.bounds(brick);
                assert!((0..3).all(|a| node[a] < nodes[a] && (low[a]..high[a]).contains(&node[a])));
                assert_eq!(grid.split(node), (brick, bit));
                assert_eq!(grid.number(grid.place(brick)), brick);
                seen += 1;
            }
            assert_eq!(seen, nodes.iter().product::<usize>());
        }
    }

    #[test]
    fn neighbours_of_masks_are_those_of_nodes() {
        // Three bricks in a row along each axis, with about every fifth node set.
        for axis in 0..3 {
            let mut nodes = [BRICK; 3];
            nodes[axis] = 3 * BRICK;
            let grid = BrickGrid::new(nodes);
            let holds = |node: [usize; 3]| (node[0] * 7 + node[1] * 3 + node[2]).is_multiple_of(5);
            let masks: Vec<u64> = (0..3).map(|brick| bits_where(!0, |bit| holds(grid.node(brick, bit)))).collect();
            for bit in 0..BRICK_ROWS {
                let (mut next, mut previous) = (grid.node(1, bit), grid.node(1, bit));
                next[axis] += 1;
                previous[axis] -= 1;
                assert_eq!(has(next_in(masks[1], masks[2], axis), bit), holds(next));
                assert_eq!(has(previous_in(masks[1], masks[0], axis), bit), holds(previous));
            }
        }
    }
}
