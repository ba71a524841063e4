//! Where a ray looks at the field: the single definition of sample positions.
//!
//! A sample stands for an interval of its ray: position at the interval's middle, `delta` its length. Samples of a batch are packed one ray
//! after another; ray `r` owns `offsets[r]..offsets[r + 1]`, and rays that miss the box own nothing.

mod occupancy;
pub mod walk;

use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::random::{Purpose, uniform};
use autograd::{Buffer, Indices, Real, Tensor, dispatched, parallel};
pub use occupancy::Occupancy;
use occupancy::{Along, Look};
use serde::{Deserialize, Serialize};

/// How samples are spaced along a ray.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Spacing {
    /// Steps of this world length from where the ray enters the box to where it leaves; the last step ends there, so the lengths add up
    /// to the chord. Jitter shifts the steps by a fraction of one.
    Step(f64),
    /// The source paper's: `samples` points equally spaced over t ∈ [0, far], t measured along the direction whose camera z is −1 (so
    /// its world length is `stretch · t`); those inside the box count. Jitter shifts all of them by a fraction of one.
    Points {
        /// Points on the whole ray, box or not.
        samples: usize,
        /// Largest t, in multiples of the un-normalised direction.
        far: f64,
    },
}

/// The random shift of each ray's samples; evaluation has none.
#[derive(Clone, Copy, Debug)]
pub enum Jitter {
    /// Samples where the spacing puts them.
    None,
    /// One uniform fraction of a step for each ray, a function of (seed, step, place in the batch).
    PerRay {
        /// Seed of the run.
        seed: u64,
        /// Training step.
        step: u64,
    },
}

impl Jitter {
    pub(crate) fn of(self, ray: usize) -> f64 {
        match self {
            Jitter::None => 0.0,
            Jitter::PerRay { seed, step } => uniform(seed, Purpose::Jitter, step, ray as u64),
        }
    }
}

/// Packed samples of n rays, m in all.
#[derive(Debug, Clone)]
pub struct Samples<T: Real> {
    /// `[m]` distance of the sample from the ray's origin, world length.
    pub t: Tensor<T>,
    /// `[m]` length of the interval it stands for, world length.
    pub delta: Tensor<T>,
    /// `[m, 3]` position, world.
    pub positions: Tensor<T>,
    /// `[n, 3]` unit direction of each ray.
    pub directions: Tensor<T>,
    /// n + 1 entries from 0 to m.
    pub offsets: Indices,
}

impl<T: Real> Samples<T> {
    /// The number of samples.
    pub fn len(&self) -> usize {
        self.t.len()
    }

    /// True if no ray hits the box.
    pub fn is_empty(&self) -> bool {
        self.t.is_empty()
    }
}

/// The intervals `k -> (middle, length)` of one ray, as far as they lie in the box.
#[derive(Clone, Copy, Debug)]
pub(crate) struct March {
    pub(crate) count: usize,
    near: f64,
    far: f64,
    /// Start of the step with k = 1 (`Step`), or the first point (`Points`).
    start: f64,
    step: f64,
    points: bool,
}

/// The samples of one ray: everything about their positions is here.
pub(crate) fn march(ray: &Ray, aabb: &Aabb, spacing: Spacing, jitter: f64) -> March {
    let none = March { count: 0, near: 0.0, far: 0.0, start: 0.0, step: 1.0, points: false };
    let Some((near, far)) = aabb.intersect(ray.origin, ray.direction) else { return none };
    match spacing {
        Spacing::Step(step) => {
            if far <= near {
                return none;
            }
            // Boundaries inside the chord: near + (k + jitter) step, the first at k = 1 unless jitter makes room for k = 0.
            let start = near + if jitter > 0.0 { jitter * step } else { step };
            let inner = if start < far { ((far - start) / step).ceil() as usize } else { 0 };
            March { count: inner + 1, near, far, start, step, points: false }
        }
        Spacing::Points { samples, far: limit } => {
            let step = limit * ray.stretch / (samples.max(2) - 1) as f64;
            let first = (near / step - jitter).ceil().max(0.0);
            let last = (far / step - jitter).floor().min(samples as f64 - 1.0);
            let count = if last >= first { (last - first) as usize + 1 } else { 0 };
            March { count, near, far, start: (first + jitter) * step, step, points: true }
        }
    }
}

impl March {
    /// Middle and length of interval k.
    #[inline(always)]
    pub(crate) fn interval(&self, k: usize) -> (f64, f64) {
        if self.points {
            return self.inner_interval(k);
        }
        let begin = if k == 0 { self.near } else { self.boundary(k) };
        let end = if k + 1 == self.count { self.far } else { self.boundary(k + 1) };
        (0.5 * (begin + end), end - begin)
    }

    /// The same if it is neither the first nor the last.
    #[inline(always)]
    fn inner_interval(&self, k: usize) -> (f64, f64) {
        if self.points {
            return (self.start + f64::from(k as u32) * self.step, self.step);
        }
        let (begin, end) = (self.boundary(k), self.boundary(k + 1));
        (0.5 * (begin + end), end - begin)
    }

    /// Where interval k begins if it is not the first.
    #[inline(always)]
    fn boundary(&self, k: usize) -> f64 {
        self.start + (f64::from(k as u32) - 1.0) * self.step
    }

    /// The intervals from number `first` on.
    #[inline(always)]
    fn intervals<const N: usize>(&self, first: usize) -> [(f64, f64); N] {
        let mut found: [(f64, f64); N] = std::array::from_fn(|i| self.inner_interval(first + i));
        for k in [0, self.count - 1] {
            if let Some(end) = k.checked_sub(first).filter(|end| *end < N) {
                found[end] = self.interval(k);
            }
        }
        found
    }

    /// The intervals whose middle lies in an occupied cell.
    #[inline]
    pub(crate) fn occupied<'a>(&self, ray: &Ray, cells: &'a Occupancy) -> Occupied<'a> {
        Occupied { march: *self, along: cells.along(ray), next: 0, found: [(0.0, 0.0); LOOKS], taken: 0, count: 0 }
    }
}

/// Intervals that are looked at together.
const LOOKS: usize = 16;

/// `(middle, length)` of those intervals of a march that lie in occupied cells. Runs of empty bricks are passed in one stride; the intervals are
/// those of [`March::interval`] all the same.
#[derive(Clone, Debug)]
pub(crate) struct Occupied<'a> {
    march: March,
    along: Along<'a>,
    /// The next interval to be looked at.
    next: usize,
    /// What was found the last time: `count` intervals, of which some are taken.
    found: [(f64, f64); LOOKS],
    taken: usize,
    count: usize,
}

impl Iterator for Occupied<'_> {
    type Item = (f64, f64);

    #[inline]
    fn next(&mut self) -> Option<(f64, f64)> {
        while self.taken == self.count {
            if self.next >= self.march.count {
                return None;
            }
            self.look();
        }
        self.taken += 1;
        Some(self.found[self.taken - 1])
    }
}

impl Occupied<'_> {
    /// Finds the next intervals, if there are any in the next bricks.
    fn look(&mut self) {
        let march = &self.march;
        // Where the last look found something there is more to be expected.
        let lost = self.count == 0;
        (self.taken, self.count) = (0, 0);
        if lost && let Look::EmptyUntil(exit) = self.along.look(march.interval(self.next).0) {
            // The last k whose middle does not lie beyond the exit, but for rounding; it is looked at again.
            let half = if march.points { 0.0 } else { 0.5 };
            let last = ((exit - march.start) / march.step + half) as usize;
            self.next = (self.next + 1).max(last);
        } else {
            self.count = occupied_of(march, &self.along, self.next, &mut self.found);
            self.next += LOOKS;
        }
    }
}

dispatched! {
/// Those of the [`LOOKS`] intervals from number `first` on that are occupied. Returns how many.
fn occupied_of(march: &March, along: &Along<'_>, first: usize, found: &mut [(f64, f64); LOOKS]) -> usize {
    let all: [(f64, f64); LOOKS] = march.intervals(first);
    let occupied = along.occupied(&all.map(|(middle, _)| middle));
    let mut count = 0;
    for i in 0..LOOKS.min(march.count - first) {
        if occupied[i] {
            found[count] = all[i];
            count += 1;
        }
    }
    count
}
}

/// Packed samples of a batch of rays through a box. With `occupancy`, samples in empty cells are left out; the others stay where they
/// are.
pub fn sample<T: Real>(rays: &[Ray], aabb: &Aabb, spacing: Spacing, jitter: Jitter, occupancy: Option<&Occupancy>) -> Samples<T> {
    const RUN: usize = 128;
    let marches: Vec<(Vec<March>, Vec<u32>)> = parallel::map_chunks(rays.len(), RUN, |range| {
        let marches: Vec<March> = range.clone().map(|r| march(&rays[r], aabb, spacing, jitter.of(r))).collect();
        let counts = marches.iter().zip(range).map(|(m, r)| match occupancy {
            None => m.count as u32,
            Some(cells) => m.occupied(&rays[r], cells).count() as u32,
        });
        let counts = counts.collect();
        (marches, counts)
    });
    let mut offsets = Vec::with_capacity(rays.len() + 1);
    offsets.push(0u32);
    for count in marches.iter().flat_map(|(_, counts)| counts) {
        offsets.push(offsets[offsets.len() - 1] + count);
    }
    let m = offsets[rays.len()] as usize;
    let (mut t, mut delta, mut positions) = (Buffer::<T>::stale(m), Buffer::<T>::stale(m), Buffer::<T>::stale(3 * m));
    let lengths = || (0..marches.len()).map(|c| (offsets[((c + 1) * RUN).min(rays.len())] - offsets[c * RUN]) as usize);
    let parts: Vec<_> = parallel::split_lengths(&mut t, lengths())
        .into_iter()
        .zip(parallel::split_lengths(&mut delta, lengths()))
        .zip(parallel::split_lengths(&mut positions, lengths().map(|n| 3 * n)))
        .collect();
    parallel::for_each_item(parts, |c, ((t, delta), positions)| {
        let mut i = 0;
        for (ray, march) in rays[c * RUN..].iter().zip(&marches[c].0) {
            let mut place = |middle: f64, length: f64| {
                let p = ray.origin + middle * ray.direction;
                (t[i], delta[i]) = (T::lit(middle), T::lit(length));
                positions[3 * i..3 * i + 3].copy_from_slice(&[T::lit(p.x), T::lit(p.y), T::lit(p.z)]);
                i += 1;
            };
            match occupancy {
                None => (0..march.count).map(|k| march.interval(k)).for_each(|(middle, length)| place(middle, length)),
                Some(cells) => march.occupied(ray, cells).for_each(|(middle, length)| place(middle, length)),
            }
        }
    });
    let directions: Vec<T> = rays.iter().flat_map(|r| r.direction.to_array()).map(T::lit).collect();
    Samples {
        t: Tensor::from_buffer(t, &[m]),
        delta: Tensor::from_buffer(delta, &[m]),
        positions: Tensor::from_buffer(positions, &[m, 3]),
        directions: Tensor::from_vec(directions, &[rays.len(), 3]),
        offsets: offsets.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn ray(origin: [f64; 3], direction: [f64; 3]) -> Ray {
        let d = DVec3::from(direction);
        Ray { origin: origin.into(), direction: d.normalize(), stretch: d.length() }
    }

    #[test]
    fn step_lengths_add_up_to_the_chord_with_and_without_jitter() {
        let rays =
            [ray([-4.0, 0.1, 0.2], [1.0, 0.03, -0.02]), ray([0.0, 0.0, 0.0], [0.3, 0.4, 0.5]), ray([-4.0, 3.0, 0.0], [1.0, 0.0, 0.0])];
        let aabb = Aabb::cube(1.5);
        for jitter in [Jitter::None, Jitter::PerRay { seed: 7, step: 3 }] {
            for step in [0.013, 0.5, 10.0] {
                let s = sample::<f64>(&rays, &aabb, Spacing::Step(step), jitter, None);
                for (r, ray) in rays.iter().enumerate() {
                    let (a, b) = (s.offsets[r] as usize, s.offsets[r + 1] as usize);
                    let sum: f64 = s.delta.data()[a..b].iter().sum();
                    let chord = aabb.intersect(ray.origin, ray.direction).map_or(0.0, |(near, far)| far - near);
                    assert!((sum - chord).abs() < 1e-12, "step {step}: {sum} of {chord}");
                    assert!(s.delta.data()[a..b].iter().all(|&d| d > -1e-12 && d <= step + 1e-12));
                    assert!(s.t.data()[a..b].is_sorted());
                }
            }
        }
    }

    #[test]
    fn points_lie_where_the_paper_puts_them() {
        // |d| = 1.25: spacing 8 · 1.25 / 4 = 2.5 in world length; points at 0, 2.5, 5, 7.5, 10; the box spans t = 3..5 (faces included).
        let rays = [ray([-4.0, 0.0, 0.0], [1.25, 0.0, 0.0])];
        let s = sample::<f64>(&rays, &Aabb::cube(1.0), Spacing::Points { samples: 5, far: 8.0 }, Jitter::None, None);
        assert_eq!(s.t.data(), [5.0]);
        assert_eq!(s.delta.data(), [2.5]);
        assert_eq!(s.positions.data(), [1.0, 0.0, 0.0]);
    }

    #[test]
    fn skipping_empty_cells_leaves_the_other_samples_where_they_are() {
        let rays = [ray([-4.0, 0.3, -0.2], [1.0, 0.05, 0.1])];
        let aabb = Aabb::cube(1.0);
        let half: Vec<bool> = (0..8 * 8 * 8).map(|i| i >= 4 * 64).collect();
        let all = sample::<f64>(&rays, &aabb, Spacing::Step(0.1), Jitter::None, None);
        let some = sample::<f64>(&rays, &aabb, Spacing::Step(0.1), Jitter::None, Some(&Occupancy::new(aabb, [8; 3], &half)));
        let kept: Vec<f64> =
            all.t.data().iter().zip(all.positions.data().chunks(3)).filter(|(_, p)| p[0] >= 0.0).map(|(&t, _)| t).collect();
        assert_eq!(some.t.data(), kept);
        assert!(kept.len() < all.len());
    }
}
