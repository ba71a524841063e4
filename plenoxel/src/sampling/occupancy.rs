//! Occupancy of the cells of a box, with distances to the nearest occupied cells.

mod rays;

use crate::geometry::Aabb;
use autograd::lattice::{BRICK, BrickGrid, bits, bits_where, has, next_in, previous_in};
use autograd::{Real, Tensor, no_grad, parallel};
use glam::DVec3;
pub(crate) use rays::{Along, Look};
use std::sync::Arc;

/// Set of cells of a box that may hold matter. Cells are stored in bricks of 4³, one bit per cell. Each empty brick stores its distance to
/// the nearest brick that is not empty. Cloning copies pointers.
#[derive(Debug, Clone)]
pub struct Occupancy {
    aabb: Aabb,
    bricks: BrickGrid,
    /// Mask of occupied cells of each brick.
    masks: Arc<[u64]>,
    /// Result of [`distances`].
    distance: Arc<[u8]>,
}

/// Largest stored distance.
const FAR: u8 = 8;

impl Occupancy {
    /// Creates an occupancy from cells in row-major order: (i, j, k) is entry (i·ny + j)·nz + k.
    ///
    /// Panics if the mask does not have one entry per cell.
    pub fn new(aabb: Aabb, cells: [usize; 3], mask: &[bool]) -> Self {
        assert_eq!(mask.len(), cells.iter().product::<usize>(), "occupancy: the mask must have one entry for each of {cells:?} cells");
        let full = mask.iter().enumerate().filter(|(_, full)| **full);
        let masks = BrickGrid::new(cells).masks_of(full.map(|(c, _)| cell_at(c, cells)));
        Self::from_masks(aabb, cells, masks)
    }

    /// Returns the cells of a box at whose centres a density is above a threshold, 1 / world length. `density` maps world positions `[m,
    /// 3]` to `[m]` and may be that of any field; it is evaluated without recording a gradient. Matter thinner than a cell can be missed:
    /// dilate the result, or lower the threshold.
    pub fn where_dense<T: Real>(aabb: Aabb, cells: [usize; 3], threshold: f64, density: impl Fn(&Tensor<T>) -> Tensor<T>) -> Self {
        Self::full(aabb, cells).dense(threshold, density)
    }

    /// Returns all cells of a box.
    pub fn full(aabb: Aabb, cells: [usize; 3]) -> Self {
        let bricks = BrickGrid::new(cells);
        Self::from_masks(aabb, cells, (0..bricks.len()).map(|brick| bricks.inside(brick)).collect())
    }

    /// Returns the occupied cells at whose centres a density is above a threshold, as [`Occupancy::where_dense`].
    pub fn dense<T: Real>(&self, threshold: f64, density: impl Fn(&Tensor<T>) -> Tensor<T>) -> Self {
        const BRICKS: usize = 1 << 12;
        let mut masks = self.masks.to_vec();
        for (first, masks) in (0..).step_by(BRICKS).zip(masks.chunks_mut(BRICKS)) {
            let cells = || masks.iter().zip(first..).flat_map(|(&mask, brick)| bits(mask).map(move |bit| (brick, bit)));
            let positions: Vec<T> =
                cells().flat_map(|(brick, bit)| self.center(self.bricks.node(brick, bit)).to_array().map(T::lit)).collect();
            let positions = Tensor::from_vec(positions, &[cells().count(), 3]);
            let density = no_grad(|| density(&positions));
            let thin: Vec<_> = cells().zip(density.data()).filter(|(_, d)| d.as_f64() <= threshold).map(|(cell, _)| cell).collect();
            thin.into_iter().for_each(|(brick, bit)| masks[brick - first] &= !(1 << bit));
        }
        Self::from_masks(self.aabb, self.cells(), masks)
    }

    /// Returns the occupied cells whose boxes satisfy a condition.
    pub(crate) fn kept(&self, keep: impl Fn(Aabb) -> bool + Sync) -> Self {
        let masks = parallel::map_indices(self.masks.len(), |brick| {
            bits_where(self.masks[brick], |bit| keep(self.box_between(self.bricks.node(brick, bit), 1)))
        });
        Self::from_masks(self.aabb, self.cells(), masks)
    }

    /// Returns the boxes of the bricks of 4³ cells that have occupied cells.
    pub(crate) fn boxes_of_bricks(&self) -> impl Iterator<Item = Aabb> + '_ {
        let full = self.masks.iter().enumerate().filter(|(_, mask)| **mask != 0);
        full.map(|(brick, _)| self.box_between(self.bricks.place(brick).map(|place| place * BRICK), BRICK))
    }

    /// Returns the box of the cells from `low` on, `count` along each axis.
    fn box_between(&self, low: [usize; 3], count: usize) -> Aabb {
        let min = self.aabb.min + self.sides() * DVec3::from_array(low.map(|k| k as f64));
        Aabb { min, max: min + self.sides() * count as f64 }
    }

    /// Returns the sides of a cell, world length.
    pub(super) fn sides(&self) -> DVec3 {
        (self.aabb.max - self.aabb.min) / DVec3::from_array(self.cells().map(|n| n as f64))
    }

    /// Returns the center of a cell.
    fn center(&self, cell: [usize; 3]) -> DVec3 {
        self.aabb.min + self.sides() * (DVec3::from_array(cell.map(|k| k as f64)) + 0.5)
    }

    /// Returns the cells of another division of space, whose centres lie in occupied cells.
    pub fn resampled(&self, aabb: Aabb, cells: [usize; 3]) -> Self {
        let all = Occupancy { aabb, bricks: BrickGrid::new(cells), masks: [].into(), distance: [].into() };
        // For each new cell along an axis, the old cell that contains its centre.
        let places = [0, 1, 2].map(|a| (0..cells[a]).map(|k| self.place(all.center([k; 3]), a)).collect::<Vec<_>>());
        let masks = parallel::map_indices(all.bricks.len(), |brick| {
            bits_where(all.bricks.inside(brick), |bit| {
                let node = all.bricks.node(brick, bit);
                let [Some(x), Some(y), Some(z)] = [0, 1, 2].map(|a| places[a][node[a]]) else { return false };
                self.contains([x, y, z])
            })
        });
        Self::from_masks(aabb, cells, masks)
    }

    /// Returns the number of the cell along an axis that has a point; `None` outside of the box.
    fn place(&self, at: DVec3, axis: usize) -> Option<usize> {
        let (low, high, n) = (self.aabb.min[axis], self.aabb.max[axis], self.cells()[axis] as f64);
        let place = (at[axis] - low) / (high - low) * n;
        (place >= 0.0 && place < n).then_some(place as usize)
    }

    /// Returns true if a point lies in an occupied cell.
    pub fn contains_point(&self, at: DVec3) -> bool {
        let [Some(x), Some(y), Some(z)] = [0, 1, 2].map(|axis| self.place(at, axis)) else { return false };
        self.contains([x, y, z])
    }

    /// Creates an occupancy from one mask per brick, as in [`autograd::Lattice::masks`].
    ///
    /// Panics if the number of masks is not the number of bricks.
    pub fn from_masks(aabb: Aabb, cells: [usize; 3], masks: Vec<u64>) -> Self {
        let bricks = BrickGrid::new(cells);
        assert_eq!(masks.len(), bricks.len(), "occupancy: there must be one mask for each of {:?} bricks", bricks.count());
        let distance = distances(&masks, bricks.count()).into();
        Occupancy { aabb, bricks, masks: masks.into(), distance }
    }

    /// Returns the box.
    pub fn aabb(&self) -> Aabb {
        self.aabb
    }

    /// Returns the number of cells along each axis.
    pub fn cells(&self) -> [usize; 3] {
        self.bricks.nodes()
    }

    /// Returns the division of the cells into bricks.
    pub fn bricks(&self) -> BrickGrid {
        self.bricks
    }

    /// Returns one mask per brick ([`BrickGrid`]).
    pub fn masks(&self) -> &[u64] {
        &self.masks
    }

    /// Returns the number of layers of empty bricks at a brick: 0 if the brick is not empty, k if all bricks within Chebyshev distance k −
    /// 1 are empty. At most 8.
    #[inline]
    pub fn free(&self, brick: usize) -> u8 {
        self.distance[brick]
    }

    /// Returns true if a cell may hold matter.
    ///
    /// Panics if the cell lies outside of the box.
    pub fn contains(&self, cell: [usize; 3]) -> bool {
        assert!((0..3).all(|a| cell[a] < self.cells()[a]), "cell {cell:?} of {:?}", self.cells());
        let (brick, bit) = self.bricks.split(cell);
        has(self.masks[brick], bit)
    }

    /// Returns the fraction of cells that may hold matter.
    pub fn fraction(&self) -> f64 {
        self.masks.iter().map(|m| f64::from(m.count_ones())).sum::<f64>() / self.cells().iter().product::<usize>() as f64
    }

    /// Returns the bounding box of the cells that may hold matter; `None` if there are none.
    pub fn bounds(&self) -> Option<Aabb> {
        let side = (self.aabb.max - self.aabb.min) / DVec3::from_array(self.cells().map(|n| n as f64));
        // Rounding must not leave the box.
        let corner = |k: [usize; 3]| (self.aabb.min + side * DVec3::from_array(k.map(|k| k as f64))).min(self.aabb.max);
        self.extent().map(|[low, high]| Aabb { min: corner(low), max: corner(high) })
    }

    /// Returns half the side of the smallest cube around the origin that contains all cells that may hold matter; `None` if there are none.
    pub fn half_width(&self) -> Option<f64> {
        self.bounds().map(|bounds| bounds.max.max(-bounds.min).max_element())
    }

    /// Returns the bounds in cells: the lowest cell along each axis, and one above the highest; `None` if there are none.
    pub fn extent(&self) -> Option<[[usize; 3]; 2]> {
        let (mut low, mut high) = (self.cells(), [0; 3]);
        for (brick, &mask) in self.masks.iter().enumerate() {
            for cell in bits(mask).map(|bit| self.bricks.node(brick, bit)) {
                for a in 0..3 {
                    (low[a], high[a]) = (low[a].min(cell[a]), high[a].max(cell[a] + 1));
                }
            }
        }
        (low[0] < high[0]).then_some([low, high])
    }

    /// Returns the cells within Chebyshev distance `radius` of the occupied cells.
    pub fn dilated(&self, radius: usize) -> Self {
        let mut masks = self.masks.to_vec();
        for _ in 0..radius {
            for axis in 0..3 {
                masks = dilate(&masks, self.bricks, axis, true);
            }
        }
        masks.iter_mut().enumerate().for_each(|(brick, mask)| *mask &= self.bricks.inside(brick));
        Self::from_masks(self.aabb, self.cells(), masks)
    }

    /// Returns the occupancy of the cells between the centres of these cells. There is one more cell along each axis, in a box that is
    /// larger by half a cell on every side; the corners of cell (i, j, k) are the centres of cells (i − 1, j − 1, k − 1) to (i, j, k). A
    /// cell is occupied if one of its corners is the centre of an occupied cell.
    pub fn between_centres(&self) -> Self {
        let half = 0.5 * (self.aabb.max - self.aabb.min) / DVec3::from_array(self.cells().map(|n| n as f64));
        let aabb = Aabb { min: self.aabb.min - half, max: self.aabb.max + half };
        let cells = self.cells().map(|n| n + 1);
        let bricks = BrickGrid::new(cells);
        let mut masks = vec![0; bricks.len()];
        for (brick, mask) in self.masks.iter().enumerate() {
            masks[bricks.number(self.bricks.place(brick))] = *mask;
        }
        for axis in 0..3 {
            masks = dilate(&masks, bricks, axis, false);
        }
        Self::from_masks(aabb, cells, masks)
    }

    /// Returns the cells that are in both.
    ///
    /// Panics if the numbers of cells differ.
    pub fn intersection(&self, other: &Self) -> Self {
        self.combined(other, |a, b| a & b)
    }

    /// Returns the cells that are in either.
    ///
    /// Panics if the numbers of cells differ.
    pub fn union(&self, other: &Self) -> Self {
        self.combined(other, |a, b| a | b)
    }

    fn combined(&self, other: &Self, join: fn(u64, u64) -> u64) -> Self {
        assert_eq!(self.bricks, other.bricks, "occupancy: the grids have different numbers of cells");
        let masks = self.masks.iter().zip(&*other.masks).map(|(&a, &b)| join(a, b)).collect();
        Self::from_masks(self.aabb, self.cells(), masks)
    }
}

/// Returns the cell with a number in row-major order.
fn cell_at(number: usize, cells: [usize; 3]) -> [usize; 3] {
    [number / (cells[1] * cells[2]), number / cells[2] % cells[1], number % cells[2]]
}

/// Extends the cells to the next cell along an axis and, if `back`, to the previous one.
fn dilate(masks: &[u64], bricks: BrickGrid, axis: usize, back: bool) -> Vec<u64> {
    let stride = bricks.strides()[axis];
    let mut out = vec![0; masks.len()];
    parallel::for_each_chunk(&mut out, parallel::CHUNK, |first, chunk| {
        for (b, out) in (first..).zip(chunk) {
            let (place, mask) = (bricks.place(b)[axis], masks[b]);
            let behind = if place > 0 { masks[b - stride] } else { 0 };
            *out = mask | previous_in(mask, behind, axis);
            if back {
                let ahead = if place + 1 < bricks.count()[axis] { masks[b + stride] } else { 0 };
                *out |= next_in(mask, ahead, axis);
            }
        }
    });
    out
}

/// Returns the Chebyshev distance of each brick, in bricks, to the nearest brick that is not empty, at most [`FAR`]; 0 for a brick that is not empty.
///
/// The distance is min over all bricks of max |coordinate difference|. It is computed one axis after another: along z as a plain distance,
/// along y and x as the minimum over k of max(k, distance found k bricks away).
pub(crate) fn distances(masks: &[u64], count: [usize; 3]) -> Vec<u8> {
    let mut distance: Vec<u8> = masks.iter().map(|&m| if m == 0 { FAR } else { 0 }).collect();
    for line in distance.chunks_mut(count[2].max(1)) {
        let mut near = FAR;
        let mut grow = |d: &mut u8| {
            near = near.saturating_add(1).min(*d);
            *d = near;
        };
        line.iter_mut().for_each(&mut grow);
        line.iter_mut().rev().for_each(&mut grow);
    }
    for (n, inner) in [(count[1], count[2]), (count[0], count[1] * count[2])] {
        let old = distance.clone();
        parallel::for_each_chunk(&mut distance, inner, |start, row| {
            let at = start / inner % n;
            for k in 1..FAR {
                if row.iter().all(|&d| d <= k) {
                    break;
                }
                let steps = usize::from(k) * inner;
                let below = (at >= usize::from(k)).then(|| start - steps);
                let above = (at + usize::from(k) < n).then(|| start + steps);
                for from in below.into_iter().chain(above) {
                    row.iter_mut().zip(&old[from..]).for_each(|(d, &there)| *d = (*d).min(there.max(k)));
                }
            }
        });
    }
    distance
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, uniform};

    pub(super) fn scattered(cells: [usize; 3], share: f64) -> Occupancy {
        let n: usize = cells.iter().product();
        let mask: Vec<bool> = (0..n as u64).map(|c| uniform(3, Purpose::Initial, 0, c) < share).collect();
        Occupancy::new(Aabb::cube(1.0), cells, &mask)
    }

    #[test]
    fn cells_of_a_density_are_those_whose_centres_are_dense() {
        let ball = |at: &Tensor<f64>| 1.0 - at.square().sum_axis(1).sqrt();
        let found = Occupancy::where_dense(Aabb::cube(1.0), [10, 8, 6], 0.5, ball);
        for cell in (0..480).map(|c| [c / 48, c / 6 % 8, c % 6]) {
            let at = |k: usize, n: usize| (k as f64 + 0.5) * 2.0 / n as f64 - 1.0;
            let radius = (at(cell[0], 10).powi(2) + at(cell[1], 8).powi(2) + at(cell[2], 6).powi(2)).sqrt();
            assert_eq!(found.contains(cell), radius < 0.5, "{cell:?}");
        }
    }

    #[test]
    fn a_finer_division_has_the_cells_whose_centres_lie_in_occupied_cells_and_density_thins_it_out() {
        let coarse = scattered([5, 4, 6], 0.4);
        let inner = Aabb { min: DVec3::new(-0.8, -1.0, -0.9), max: DVec3::new(0.7, 0.5, 1.0) };
        let fine = coarse.resampled(inner, [13, 9, 11]);
        let right = |at: &Tensor<f64>| at.index_axis(1, 0);
        let dense = fine.dense(0.1, right);
        for cell in (0..13 * 9 * 11).map(|c| [c / 99, c / 11 % 9, c % 11]) {
            let at = fine.center(cell);
            assert_eq!(fine.contains(cell), coarse.contains_point(at), "{cell:?}");
            assert_eq!(dense.contains(cell), fine.contains(cell) && at.x > 0.1, "{cell:?}");
        }
        assert!(!coarse.contains_point(DVec3::new(1.01, 0.0, 0.0)) && fine.fraction() > 0.0);
    }

    #[test]
    fn bounds_stay_in_the_box_whatever_rounding_does() {
        for (half_width, n) in [(1.95, 320), (1.55, 384)] {
            let mut line = vec![false; n];
            let at_the_end = |line: &[bool]| Occupancy::new(Aabb::cube(half_width), [n, 1, 1], line).half_width();
            assert_eq!(at_the_end(&line), None);
            line[n - 1] = true;
            assert_eq!(at_the_end(&line), Some(half_width));
        }
    }

    #[test]
    fn dilation_adds_the_cells_around_and_stays_in_the_box() {
        let cells = [9, 6, 11];
        let some = scattered(cells, 0.01);
        let grown = some.dilated(2);
        for i in 0..cells[0] {
            for j in 0..cells[1] {
                for k in 0..cells[2] {
                    let around = |c: usize, n: usize| c.saturating_sub(2)..(c + 3).min(n);
                    let want =
                        around(i, cells[0]).any(|a| around(j, cells[1]).any(|b| around(k, cells[2]).any(|c| some.contains([a, b, c]))));
                    assert_eq!(grown.contains([i, j, k]), want, "cell {i} {j} {k}");
                }
            }
        }
        assert!(grown.fraction() > some.fraction() && grown.fraction() < 1.0);
    }

    #[test]
    fn a_cell_between_centres_is_occupied_if_one_of_its_corners_is() {
        let cells = [8, 5, 11];
        let some = scattered(cells, 0.02);
        let between = some.between_centres();
        assert_eq!(between.cells(), [9, 6, 12]);
        for i in 0..9 {
            for j in 0..6 {
                for k in 0..12 {
                    let corners = |c: usize, n: usize| c.saturating_sub(1)..(c + 1).min(n);
                    let want = corners(i, 8).any(|a| corners(j, 5).any(|b| corners(k, 11).any(|c| some.contains([a, b, c]))));
                    assert_eq!(between.contains([i, j, k]), want, "cell {i} {j} {k}");
                }
            }
        }
        // The centre of the first cell of the old box is the low corner of cell 1.
        let side = (between.aabb().max - between.aabb().min) / DVec3::new(9.0, 6.0, 12.0);
        let centre = some.aabb().min + 0.5 * (some.aabb().max - some.aabb().min) / DVec3::new(8.0, 5.0, 11.0);
        assert!((between.aabb().min + side - centre).abs().max_element() < 1e-12);
    }
}
