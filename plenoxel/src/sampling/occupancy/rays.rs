//! Occupied cells along rays: of one ray, or of rays that are led together.

use super::Occupancy;
use crate::camera::Ray;
use autograd::lattice::{BRICK, has};
use autograd::parallel;
use glam::DVec3;

/// Occupancy at a point of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Look {
    Occupied,
    Empty,
    /// No occupied cell before this distance along the ray.
    EmptyUntil(f64),
}

impl Occupancy {
    /// Returns a distance before which no ray of a beam is in an occupied cell; infinite if none is in one at all. The nearer the rays are to each other, the larger it
    /// is: where all bricks nearer than k to the middle of the beam are empty, it goes on to where one of its sides leaves these bricks.
    fn free_until(&self, beam: &Beam) -> f64 {
        let (count, cells) = (self.bricks.count(), self.cells().map(|n| n as f64));
        let enters =
            |axis: usize| beam.highest[axis].until_above(0.0, 0.0).max(beam.lowest[axis].negative().until_above(-cells[axis], 0.0));
        let mut t = enters(0).max(enters(1)).max(enters(2));
        while t.is_finite() {
            let place: [usize; 3] = std::array::from_fn(|axis| {
                let middle = 0.5 * (beam.lowest[axis].at(t) + beam.highest[axis].at(t));
                (middle.max(0.0) as usize / BRICK).min(count[axis] - 1)
            });
            let free = usize::from(self.distance[self.bricks.number(place)]);
            let mut exit = f64::INFINITY;
            // There is nothing beyond the box.
            for axis in 0..3 {
                if place[axis] + free < count[axis] {
                    exit = exit.min(beam.highest[axis].until_above(((place[axis] + free) * BRICK) as f64, t));
                }
                if place[axis] + 1 > free {
                    exit = exit.min(beam.lowest[axis].negative().until_above(-(((place[axis] + 1 - free) * BRICK) as f64), t));
                }
            }
            if free == 0 || exit <= t + ROUNDING {
                break;
            }
            t = exit;
        }
        t
    }

    /// Returns two distances outside of which none of some straight rays is in an occupied cell ([`free_until`](Self::free_until), from both ends); `None` if they are
    /// in none at all.
    pub(crate) fn section(&self, rays: &[Ray]) -> Option<[f64; 2]> {
        let beam = self.beam(rays);
        let from = self.free_until(&beam);
        let leaves = |axis: usize| {
            let [lowest, behind] = [beam.lowest[axis], beam.highest[axis].negative()];
            match (lowest.slope > 0.0, behind.slope > 0.0) {
                (true, _) => lowest.until_above(self.cells()[axis] as f64, 0.0),
                (_, true) => behind.until_above(0.0, 0.0),
                _ => f64::INFINITY,
            }
        };
        let end = leaves(0).min(leaves(1)).min(leaves(2));
        match from.is_finite() {
            false => None,
            true if end.is_infinite() => Some([from, end]),
            true => Some([from, end - self.free_until(&beam.backwards(end))]),
        }
    }

    /// Returns the number of cells per length along each axis.
    #[inline]
    fn per_length(&self) -> DVec3 {
        DVec3::from_array(self.cells().map(|n| n as f64)) / (self.aabb.max - self.aabb.min)
    }

    /// Returns the beam of some rays.
    fn beam(&self, rays: &[Ray]) -> Beam {
        let [mut origins, mut directions] = [[DVec3::INFINITY, DVec3::NEG_INFINITY]; 2];
        for ray in rays {
            origins = [origins[0].min(ray.origin), origins[1].max(ray.origin)];
            directions = [directions[0].min(ray.direction), directions[1].max(ray.direction)];
        }
        let per_length = self.per_length();
        let side = |k: usize, rounding: f64| {
            let (start, slope) = ((origins[k] - self.aabb.min) * per_length + rounding, directions[k] * per_length);
            [0, 1, 2].map(|axis| Line::new(start[axis], slope[axis]))
        };
        Beam { lowest: side(0, -ROUNDING), highest: side(1, ROUNDING) }
    }

    /// Prepares look-ups along a ray.
    #[inline]
    pub(crate) fn along(&self, ray: &Ray) -> Along<'_> {
        let per_length = self.per_length();
        let slope = ray.direction * per_length;
        Along { cells: self, per_length, start: (ray.origin - self.aabb.min) * per_length, slope, per_cell: slope.recip() }
    }
}

/// Rounding of positions, in cells.
const ROUNDING: f64 = 1e-6;

/// Box around the places of some rays at distance t from their origins, in cells.
struct Beam {
    lowest: [Line; 3],
    highest: [Line; 3],
}

impl Beam {
    /// Returns the beam whose places at t are those of this one at `end` − t, for t up to `end`.
    fn backwards(&self, end: f64) -> Self {
        let back = |lines: &[Line; 3]| lines.map(|line| Line { start: line.at(end), ..line.turned() });
        Beam { lowest: back(&self.lowest), highest: back(&self.highest) }
    }
}

/// A number that is linear in the distance t along a ray: start + t slope.
#[derive(Clone, Copy)]
struct Line {
    start: f64,
    slope: f64,
    per_slope: f64,
}

impl Line {
    fn new(start: f64, slope: f64) -> Self {
        Line { start, slope, per_slope: slope.recip() }
    }

    fn at(self, t: f64) -> f64 {
        self.start + t * self.slope
    }

    fn negative(self) -> Self {
        Line { start: -self.start, ..self.turned() }
    }

    /// Returns the line with the same start and the opposite slope.
    fn turned(self) -> Self {
        Line { slope: -self.slope, per_slope: -self.per_slope, ..self }
    }

    /// Returns the least distance, from `t` on, from which the number is above a limit; infinite if it never is.
    fn until_above(self, limit: f64, t: f64) -> f64 {
        match self.start + t * self.slope > limit {
            true => t,
            false if self.slope > 0.0 => (limit - self.start) * self.per_slope,
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
    pub(crate) fn occupied<const N: usize>(&self, cell: impl Fn(usize, usize, usize) -> u32) -> [bool; N] {
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

#[cfg(test)]
mod tests {
    use super::super::tests::scattered;
    use super::*;
    use crate::geometry::Aabb;
    use crate::random::{Purpose, uniform};

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
        for (share, far_enough, sees_nothing) in [(0.0, 2400, 340), (0.0003, 300, 10), (0.01, 0, 0)] {
            let some = Occupancy { aabb, ..scattered([70, 52, 66], share) };
            let (mut far, mut back, mut none) = (0, 0, 0);
            for packet in 0..400u64 {
                // Some begin in the box.
                let distance = if packet % 7 == 3 { 0.5 } else { 3.0 };
                let (origin, target) = (distance * point(100 * packet).normalize(), point(100 * packet + 3));
                // Rays of a packet of pixels, and some that have nothing in common.
                let spread = if packet % 10 == 0 { 1.0 } else { 0.01 };
                let ray = |k: u64| {
                    let origin = origin + 0.2 * spread * point(100 * packet + 6 * k + 6);
                    Ray { origin, direction: (target + spread * point(100 * packet + 6 * k + 9) - origin).normalize(), stretch: 1.0 }
                };
                let mut rays: Vec<Ray> = (0..if packet % 4 == 1 { 1 } else { 12 }).map(ray).collect();
                if packet % 5 == 2 {
                    // Parallel to an axis.
                    let axis = [DVec3::X, DVec3::NEG_Y, DVec3::Z][packet as usize % 3];
                    rays.iter_mut().for_each(|ray| ray.direction = axis);
                }
                let [from, to] = some.section(&rays).unwrap_or([f64::INFINITY, f64::NEG_INFINITY]);
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
