//! Paths of rays through the cells of a table.

use super::LANES;
use crate::camera::Ray;
use crate::field::node_table::Cells;
use crate::sampling::March;
use crate::space::Bend;
use autograd::Real;
use glam::DVec3;

/// Paths of [`LANES`] rays. Distances are those from where the march of a ray begins.
pub(crate) trait Path<T: Real> {
    /// Paths of no rays. `to_cells` are factor and summand that map positions in the box to cells.
    fn new(to_cells: [DVec3; 2]) -> Self;

    /// Gives a lane the path of a ray. Panics if the ray has another kind of path.
    fn begin(&mut self, lane: usize, ray: &Ray, march: &March);

    /// Returns the positions at distances, in cells.
    fn places<const FUSED: bool>(&self, distance: &[T; LANES]) -> [[T; LANES]; 3];

    /// Returns numbers of intervals. The middles of the intervals from `this` up to them are in no stored brick, up to rounding; `cells` and `at` are those of
    /// `this`. In a stored brick, the number is at most `this`.
    fn skip(&self, cells: &Cells<T, LANES>, at: &[[T; LANES]; 3], this: &[T; LANES]) -> [T; LANES];
}

/// Straight rays: the position at distance s is origin + s slope.
pub(crate) struct Straight<T> {
    origin: [[T; LANES]; 3],
    slope: [[T; LANES]; 3],
    per_slope: [[T; LANES]; 3],
    /// Start of the interval with number 1, and the number of intervals per length.
    start: [T; LANES],
    per_step: [T; LANES],
    /// Factor and summand that map positions in the box to cells.
    to_cells: [DVec3; 2],
}

impl<T: Real> Path<T> for Straight<T> {
    fn new(to_cells: [DVec3; 2]) -> Self {
        let none = [T::zero(); LANES];
        Straight { origin: [none; 3], slope: [none; 3], per_slope: [none; 3], start: none, per_step: none, to_cells }
    }

    fn begin(&mut self, lane: usize, ray: &Ray, march: &March) {
        assert!(march.is_straight(), "a straight ray");
        let [factor, summand] = self.to_cells;
        let slope = ray.direction * factor;
        let origin = ray.origin * factor + summand + march.near * slope;
        for axis in 0..3 {
            self.origin[axis][lane] = T::lit(origin[axis]);
            (self.slope[axis][lane], self.per_slope[axis][lane]) = (T::lit(slope[axis]), T::lit(slope[axis].recip()));
        }
        (self.start[lane], self.per_step[lane]) = (T::lit(march.start - march.near), T::lit(march.step.recip()));
    }

    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    fn places<const FUSED: bool>(&self, distance: &[T; LANES]) -> [[T; LANES]; 3] {
        let mut at = [[T::zero(); LANES]; 3];
        for a in 0..3 {
            for i in 0..LANES {
                at[a][i] = distance[i].multiply_add::<FUSED>(self.slope[a][i], self.origin[a][i]);
            }
        }
        at
    }

    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    fn skip(&self, cells: &Cells<T, LANES>, _: &[[T; LANES]; 3], _: &[T; LANES]) -> [T; LANES] {
        // The number of intervals whose middle lies before the exit or at it. At the exit, the nodes are still those of an empty brick.
        let mut exits = cells.exits(&self.origin, &self.per_slope);
        for i in 0..LANES {
            exits[i] = (exits[i] - self.start[i]) * self.per_step[i] + T::lit(1.5);
        }
        exits
    }
}

/// Rays in contracted space ([`Space::Contracted`](crate::space::Space)). Distances are differences of s ([`Bend`]).
pub(crate) struct Bent<T> {
    /// Ray in the world: the position at distance t from the origin is o + t d.
    origin: [[T; LANES]; 3],
    direction: [[T; LANES]; 3],
    /// Up to this s, t is s + `first`. Beyond, u = 1 − rate (s − `straight`) and t = `turn` + (1 / u − 1) / rate.
    straight: [T; LANES],
    first: [T; LANES],
    turn: [T; LANES],
    rate: [T; LANES],
    per_rate: [T; LANES],
    /// Intervals in which the position changes by at most one cell along any axis.
    intervals_per_cell: [T; LANES],
    /// Factor and summand that map positions in the box to cells.
    to_cells: [DVec3; 2],
}

/// Least u of a sample: t is infinite for 0.
const LEAST: f64 = 1e-6;

impl<T: Real> Path<T> for Bent<T> {
    fn new(to_cells: [DVec3; 2]) -> Self {
        let none = [T::zero(); LANES];
        Bent {
            origin: [none; 3],
            direction: [none; 3],
            straight: none,
            first: none,
            turn: none,
            rate: none,
            per_rate: none,
            intervals_per_cell: none,
            to_cells,
        }
    }

    fn begin(&mut self, lane: usize, ray: &Ray, march: &March) {
        let Bend { turn, rate, start } = march.bend.expect("a ray that is not straight");
        for axis in 0..3 {
            (self.origin[axis][lane], self.direction[axis][lane]) = (T::lit(ray.origin[axis]), T::lit(ray.direction[axis]));
        }
        let first = start + march.near;
        (self.straight[lane], self.first[lane]) = (T::lit(turn - first), T::lit(first));
        (self.turn[lane], self.rate[lane], self.per_rate[lane]) = (T::lit(turn), T::lit(rate), T::lit(rate.recip()));
        self.intervals_per_cell[lane] = T::lit(1.0 / (self.to_cells[0].max_element() * Bend::steepest(ray) * march.step));
    }

    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    fn places<const FUSED: bool>(&self, distance: &[T; LANES]) -> [[T; LANES]; 3] {
        let (mut t, mut m) = ([T::zero(); LANES], [T::one(); LANES]);
        for i in 0..LANES {
            let beyond = distance[i] - self.straight[i];
            let u = (T::one() - self.rate[i] * beyond).max(T::lit(LEAST));
            let bent = self.turn[i] + (T::one() / u - T::one()) * self.per_rate[i];
            t[i] = if beyond <= T::zero() { distance[i] + self.first[i] } else { bent };
        }
        // The operations of [`contract`](crate::space).
        let mut at = [[T::zero(); LANES]; 3];
        for a in 0..3 {
            for i in 0..LANES {
                at[a][i] = t[i].multiply_add::<FUSED>(self.direction[a][i], self.origin[a][i]);
            }
            for i in 0..LANES {
                m[i] = at[a][i].abs().max(m[i]);
            }
        }
        let mut scale = [T::zero(); LANES];
        for i in 0..LANES {
            let per_m = T::one() / m[i];
            scale[i] = (T::lit(2.0) - per_m) * per_m;
        }
        for a in 0..3 {
            let [factor, summand] = self.to_cells.map(|vector| T::lit(vector[a]));
            for i in 0..LANES {
                at[a][i] = (at[a][i] * scale[i]).multiply_add::<FUSED>(factor, summand);
            }
        }
        at
    }

    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    fn skip(&self, cells: &Cells<T, LANES>, at: &[[T; LANES]; 3], this: &[T; LANES]) -> [T; LANES] {
        let mut skipped = cells.clearance(at);
        for i in 0..LANES {
            skipped[i] = this[i] + skipped[i] * self.intervals_per_cell[i];
        }
        skipped
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::node_table::{NodeTable, StoredBricks};
    use crate::geometry::Aabb;
    use crate::sampling::{Spacing, march};
    use autograd::lattice::BRICK;
    use autograd::random::Stream;
    use std::sync::Arc;

    const NODES: [usize; 3] = [61, 45, 53];

    /// Rays from points inside and outside of the unit cube, in random directions.
    fn rays() -> Vec<Ray> {
        let numbers = Stream::new(11).uniform_tensor::<f64>(&[LANES, 6], -1.0, 1.0);
        let ray = |(i, row): (usize, &[f64])| Ray {
            origin: DVec3::from_slice(&row[..3]) * if i % 2 == 0 { 0.8 } else { 2.5 },
            direction: if i % 8 < 3 { DVec3::AXES[i % 8] } else { DVec3::from_slice(&row[3..]).normalize() },
            stretch: 1.0,
        };
        numbers.data().chunks(6).enumerate().map(ray).collect()
    }

    /// Leads each ray through its intervals. The places must be those of the march, and no skipped interval may lie in a stored brick.
    fn check<P: Path<f64>>(spacing: Spacing, half_width: f64) {
        let aabb = Aabb::cube(half_width);
        let factor = DVec3::from_array(NODES.map(|n| n as f64 - 1.0)) / (aabb.max - aabb.min);
        let summand = -aabb.min * factor;
        let count = NODES.map(|n| (n - 1).div_ceil(BRICK));
        let stored = (0..count.iter().product::<usize>() as u32).filter(|brick| brick % 37 == 5).collect();
        let table = NodeTable::<f64>::new(Arc::new(StoredBricks::new(NODES, stored).expect("a small table")), [0.0], |_, values| {
            values.fill([1.0])
        });
        let (rays, mut path) = (rays(), P::new([factor, summand]));
        let marches: Vec<March> = rays.iter().map(|ray| march(ray, &aabb, spacing, 0.0).of_steps()).collect();
        (0..LANES).filter(|&i| marches[i].count > 0).for_each(|i| path.begin(i, &rays[i], &marches[i]));
        let most = marches.iter().map(|march| march.count).max().unwrap_or(0);
        let (mut until, mut skipped, mut met) = ([0.0_f64; LANES], 0, 0);
        for k in 0..most {
            let interval = |i: usize| marches[i].interval(k.min(marches[i].count.saturating_sub(1))).0;
            let middles: [f64; LANES] = std::array::from_fn(|i| interval(i) - marches[i].near);
            let at = path.places::<false>(&middles);
            let cells = Cells::find(table.bricks(), at.each_ref());
            let (stored, next) = (cells.stored(), path.skip(&cells, &at, &[k as f64; LANES]));
            for i in (0..LANES).filter(|&i| k < marches[i].count) {
                let want = marches[i].at(&rays[i], interval(i)) * factor + summand;
                let found = DVec3::new(at[0][i], at[1][i], at[2][i]);
                // Near infinity, u has a least value.
                assert!(
                    (want - found).abs().max_element() < 1e-3 && (k + 2 > marches[i].count || (want - found).length() < 1e-9),
                    "{want} {found}"
                );
                assert!(!stored[i] || next[i].max(0.0) as usize <= k);
                if stored[i] {
                    met += 1;
                    assert!(until[i] as usize <= k, "{spacing:?}: ray {i} leaves out interval {k}");
                } else {
                    skipped += usize::from(until[i] as usize > k);
                }
                until[i] = until[i].max(next[i]);
            }
        }
        assert!(met > 50 && skipped > 500, "{met} {skipped}");
    }

    #[test]
    fn places_are_those_of_the_march_and_no_stored_brick_is_skipped() {
        check::<Straight<f64>>(Spacing::Step(0.02), 1.5);
        check::<Straight<f64>>(Spacing::Points { samples: 200, far: 6.0 }, 1.5);
        check::<Bent<f64>>(Spacing::Contracted(0.02), 2.0);
    }
}
