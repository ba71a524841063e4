//! Occupancy of the cells of a box, with distances to the nearest occupied cells.

use crate::camera::Ray;
use crate::geometry::Aabb;
use autograd::lattice::{BRICK, BrickGrid, bits, bits_where, has, next_in, previous_in};
use autograd::{Real, Tensor, no_grad, parallel};
use glam::DVec3;
use std::sync::Arc;

/// Set of cells of a box that may hold matter. Cells are stored in bricks of 4³, one bit per cell. Each empty brick stores its distance to
/// the nearest brick that is not empty. Cloning copies pointers.
#[derive(Debug, Clone)]
pub struct Occupancy {
    aabb: Aabb,
    bricks: BrickGrid,
    /// Mask of occupied cells of each brick.
    masks: Arc<[u64]>,
    /// Chebyshev distance, in bricks, to the nearest brick that is not empty, at most [`FAR`]; 0 for a brick that is not empty.
    distance: Arc<[u8]>,
}

/// Largest stored distance.
const FAR: u8 = 8;

/// Occupancy at a point of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Look {
    Occupied,
    Empty,
    /// No occupied cell before this distance along the ray.
    EmptyUntil(f64),
}

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

    /// Returns a distance before which none of some straight rays is in an occupied cell; infinite if they are in none at all. The nearer the rays are to each
    /// other, the larger it is.
    ///
    /// Ray r is in the box around the middle ray, at distance t, whose half sides are a + b t along each axis. Where all bricks nearer than k to the middle ray
    /// are empty, the rays go on to where their box leaves these bricks.
    fn free_until(&self, rays: &[Ray]) -> f64 {
        /// Rounding of positions, in cells.
        const ROUNDING: f64 = 1e-6;
        let Some(middle) = rays.get(rays.len() / 2).map(|ray| self.along(ray)) else { return f64::INFINITY };
        let (mut a, mut b) = (DVec3::splat(ROUNDING), DVec3::ZERO);
        for along in rays.iter().map(|ray| self.along(ray)) {
            a = a.max((along.start - middle.start).abs() + ROUNDING);
            b = b.max((along.slope - middle.slope).abs());
        }
        // The lowest and the highest place of the rays along each axis are linear in t.
        let lowest = |axis: usize| Line { start: middle.start[axis] - a[axis], slope: middle.slope[axis] - b[axis] };
        let highest = |axis: usize| Line { start: middle.start[axis] + a[axis], slope: middle.slope[axis] + b[axis] };
        let (count, cells) = (self.bricks.count(), self.cells().map(|n| n as f64));
        let enters = |axis: usize| highest(axis).until_above(0.0, 0.0).max(lowest(axis).negative().until_above(-cells[axis], 0.0));
        let mut t = enters(0).max(enters(1)).max(enters(2));
        while t.is_finite() {
            let at = middle.start + t * middle.slope;
            let place: [usize; 3] = std::array::from_fn(|axis| (at[axis].max(0.0) as usize / BRICK).min(count[axis] - 1));
            let free = usize::from(self.distance[self.bricks.number(place)]);
            let mut exit = f64::INFINITY;
            // There is nothing beyond the box.
            for axis in 0..3 {
                if place[axis] + free < count[axis] {
                    exit = exit.min(highest(axis).until_above(((place[axis] + free) * BRICK) as f64, t));
                }
                if place[axis] + 1 > free {
                    exit = exit.min(lowest(axis).negative().until_above(-(((place[axis] + 1 - free) * BRICK) as f64), t));
                }
            }
            if free == 0 || exit <= t + ROUNDING {
                break;
            }
            t = exit;
        }
        t
    }

    /// Returns two distances outside of which none of some straight rays is in an occupied cell ([`free_until`](Self::free_until), from both ends): the first
    /// is infinite if they are in none at all.
    pub(crate) fn section(&self, rays: &[Ray]) -> [f64; 2] {
        let from = self.free_until(rays);
        let exits = rays.iter().filter_map(|ray| self.aabb.intersect(ray.origin, ray.direction)).map(|(_, exit)| exit);
        let Some(end) = exits.reduce(f64::max).filter(|_| from.is_finite()) else { return [f64::INFINITY, f64::NEG_INFINITY] };
        let back: Vec<Ray> =
            rays.iter().map(|ray| Ray { origin: ray.origin + end * ray.direction, direction: -ray.direction, ..*ray }).collect();
        [from, end - self.free_until(&back)]
    }

    /// Prepares look-ups along a ray.
    #[inline]
    pub(crate) fn along(&self, ray: &Ray) -> Along<'_> {
        let per_length = DVec3::from_array(self.cells().map(|n| n as f64)) / (self.aabb.max - self.aabb.min);
        let slope = ray.direction * per_length;
        Along { cells: self, per_length, start: (ray.origin - self.aabb.min) * per_length, slope, per_cell: slope.recip() }
    }
}

/// A number that is linear in the distance t along a ray: start + t slope.
#[derive(Clone, Copy)]
struct Line {
    start: f64,
    slope: f64,
}

impl Line {
    fn negative(self) -> Self {
        Line { start: -self.start, slope: -self.slope }
    }

    /// Returns the least distance, from `t` on, from which the number is above a limit; infinite if it never is.
    fn until_above(self, limit: f64, t: f64) -> f64 {
        match self.start + t * self.slope > limit {
            true => t,
            false if self.slope > 0.0 => (limit - self.start) / self.slope,
            false => f64::INFINITY,
        }
    }
}

/// Ray through a box. Its position in cells at distance t is `start + t slope`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Along<'a> {
    cells: &'a Occupancy,
    /// Cells per length along each axis.
    per_length: DVec3,
    start: DVec3,
    slope: DVec3,
    /// Reciprocal of the slope.
    per_cell: DVec3,
}

impl Along<'_> {
    /// Looks up the cell at a distance along the ray.
    #[inline]
    pub(crate) fn look(&self, t: f64) -> Look {
        let Occupancy { bricks, masks, distance, .. } = self.cells;
        let cell: [usize; 3] = std::array::from_fn(|a| self.cell(a, t, bricks.nodes()[a]) as usize);
        let (brick, bit) = bricks.split(cell);
        // The table of distances stays in the cache, and most look-ups are far from occupied cells.
        let free = distance[brick];
        if free == 0 {
            return if has(masks[brick], bit) { Look::Occupied } else { Look::Empty };
        }
        // All bricks nearer than `free` are empty: skip to the exit of the ray from the cube of these bricks.
        let exit = (0..3).fold(f64::INFINITY, |exit, a| {
            let (here, reach) = ((cell[a] / BRICK) as f64, f64::from(free));
            let d = self.slope[a];
            let plane = BRICK as f64 * if d > 0.0 { here + reach } else { here + 1.0 - reach };
            if d == 0.0 { exit } else { exit.min((plane - self.start[a]) * self.per_cell[a]) }
        });
        Look::EmptyUntil(exit)
    }

    /// Returns the cell at a distance, along one axis.
    #[inline(always)]
    fn cell(&self, axis: usize, t: f64, cells: usize) -> u32 {
        (self.start[axis] + t * self.slope[axis]).max(0.0).min((cells - 1) as f64) as u32
    }

    /// Tests which distances lie in occupied cells.
    #[inline(always)]
    pub(crate) fn occupied<const N: usize>(&self, t: &[f64; N]) -> [bool; N] {
        self.cells.occupied(|axis, i, cells| self.cell(axis, t[i], cells))
    }

    /// Returns a number of cells: there are no occupied ones nearer than this to a position, along any axis. 0 near occupied cells.
    #[inline]
    pub(crate) fn clearance(&self, at: DVec3) -> f64 {
        let Occupancy { aabb, bricks, distance, .. } = self.cells;
        let place = (at - aabb.min) * self.per_length;
        let brick: [usize; 3] = std::array::from_fn(|a| (place[a].max(0.0) as usize).min(bricks.nodes()[a] - 1) / BRICK);
        let free = distance[bricks.number(brick)];
        if free < 2 {
            return 0.0;
        }
        // All bricks nearer than `free` are empty.
        (0..3).fold(f64::INFINITY, |clear, a| {
            let (here, reach) = (brick[a] as f64, f64::from(free));
            let [low, high] = [(here + 1.0 - reach) * BRICK as f64, (here + reach) * BRICK as f64];
            clear.min(place[a] - low).min(high - place[a])
        })
    }

    /// Returns the shortest side of a cell.
    pub(crate) fn side(&self) -> f64 {
        1.0 / self.per_length.max_element()
    }

    /// Tests which positions lie in occupied cells: x, y and z of each.
    #[inline(always)]
    pub(crate) fn occupied_at<const N: usize>(&self, at: &[[f64; N]; 3]) -> [bool; N] {
        let (low, per_length) = (self.cells.aabb.min, self.per_length);
        self.cells.occupied(|axis, i, cells| ((at[axis][i] - low[axis]) * per_length[axis]).max(0.0).min((cells - 1) as f64) as u32)
    }
}

impl Occupancy {
    /// Tests which cells are occupied. `cell(axis, i, n)` is the cell of the i-th place along an axis of n cells.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // The compiler does not inline `from_fn` in dispatched loops.
    fn occupied<const N: usize>(&self, cell: impl Fn(usize, usize, usize) -> u32) -> [bool; N] {
        let Occupancy { bricks, masks, .. } = self;
        let (mut numbers, mut bits) = ([0; N], [0; N]);
        // Like `BrickGrid::split`, one axis after another, because such loops vectorise.
        for a in 0..3 {
            let (mut cells, nodes, count) = ([0; N], bricks.nodes()[a], bricks.count()[a] as u32);
            for i in 0..N {
                cells[i] = cell(a, i, nodes);
            }
            for i in 0..N {
                numbers[i] = numbers[i] * count + cells[i] / BRICK as u32;
                bits[i] = bits[i] * BRICK as u32 + cells[i] % BRICK as u32;
            }
        }
        let masks = parallel::gathered(masks, numbers);
        let mut occupied = [false; N];
        for i in 0..N {
            occupied[i] = has(masks[i], bits[i] as usize);
        }
        occupied
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

/// Returns the Chebyshev distance of each brick to the nearest brick that is not empty, at most [`FAR`].
///
/// The distance is min over all bricks of max |coordinate difference|. It is computed one axis after another: along z as a plain distance,
/// along y and x as the minimum over k of max(k, distance found k bricks away).
fn distances(masks: &[u64], count: [usize; 3]) -> Vec<u8> {
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

    fn scattered(cells: [usize; 3], share: f64) -> Occupancy {
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

    #[test]
    fn an_empty_stretch_holds_no_occupied_cell() {
        let some = scattered([70, 64, 66], 0.00002);
        let origin = DVec3::new(-2.0, 0.13, -0.41);
        for target in [[0.9, 0.3, 0.2], [0.5, -0.9, 0.9], [0.9, 0.13, -0.41]] {
            let direction = (DVec3::from(target) - origin).normalize();
            let ray = Ray { origin, direction, stretch: 1.0 };
            let (near, far) = some.aabb.intersect(origin, direction).expect("it hits");
            let along = some.along(&ray);
            let mut strides = 0;
            let mut t = near + 1e-9;
            while t < far {
                if let Look::EmptyUntil(exit) = along.look(t) {
                    assert!(exit > t);
                    for k in 0..100 {
                        let between = t + (exit.min(far) - t) * (f64::from(k) + 0.5) / 100.0;
                        assert_ne!(along.look(between), Look::Occupied);
                    }
                    strides += 1;
                }
                t += 0.01;
            }
            assert!(strides > 0);
        }
    }

    #[test]
    fn rays_that_are_led_together_pass_no_occupied_cell_outside_of_their_section() {
        let aabb = Aabb { min: DVec3::new(-1.0, -0.8, -1.1), max: DVec3::new(0.9, 1.2, 1.0) };
        let number = |k: u64| 2.0 * uniform(5, Purpose::Initial, 1, k) - 1.0;
        let point = |k: u64| DVec3::new(number(k), number(k + 1), number(k + 2));
        for (share, far_enough, sees_nothing) in [(0.0, 3000, 340), (0.0003, 400, 10), (0.01, 0, 0)] {
            let some = Occupancy { aabb, ..scattered([70, 52, 66], share) };
            let (mut far, mut back, mut none) = (0, 0, 0);
            for packet in 0..400u64 {
                let (origin, target) = (3.0 * point(100 * packet).normalize(), point(100 * packet + 3));
                // Rays of a packet of pixels, and some that have nothing in common.
                let spread = if packet % 10 == 0 { 1.0 } else { 0.01 };
                let ray = |k: u64| {
                    let origin = origin + 0.2 * spread * point(100 * packet + 6 * k + 6);
                    Ray { origin, direction: (target + spread * point(100 * packet + 6 * k + 9) - origin).normalize(), stretch: 1.0 }
                };
                let rays: Vec<Ray> = (0..12).map(ray).collect();
                let [from, to] = some.section(&rays);
                for ray in &rays {
                    let Some((near, end)) = aabb.intersect(ray.origin, ray.direction) else { continue };
                    for k in 0..300 {
                        let t = near + (end - near) * (f64::from(k) + 0.5) / 300.0;
                        let free = t < from || t > to;
                        assert!(!free || !some.contains_point(ray.origin + t * ray.direction), "packet {packet} at {t}");
                    }
                    far += usize::from(from > near + 0.2);
                    back += usize::from(to < end - 0.2);
                }
                none += usize::from(from.is_infinite());
            }
            assert!(far.min(back) >= far_enough && none >= sees_nothing, "{share}: {far}, {back} and {none}");
        }
    }
}
