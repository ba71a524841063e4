//! Positions of samples along rays. This module defines them; pictures of voxel grids and factored fields compute the same positions in
//! vectors of rays, in the precision of the field (`field/lanes.rs`).
//!
//! A sample represents an interval of its ray: its position is the middle of the interval, `delta` the length. Samples of a batch are
//! packed one ray after another; ray `r` owns `offsets[r]..offsets[r + 1]`. Rays that miss the box have no samples.

pub mod importance;
mod occupancy;
mod running;
mod tracked;
mod visible;
pub mod walk;

use crate::camera::{self, Ray};
use crate::geometry::Aabb;
use crate::random::{self, Purpose, Stream, uniform};
use crate::space::{Bend, Space, contract};
use autograd::{Buffer, Indices, Real, Tensor, dispatched, parallel};
use glam::DVec3;
pub use occupancy::Occupancy;
pub(crate) use occupancy::distances;
use occupancy::{Along, Look};
pub use running::{Refresh, RunningOccupancy};
use serde::{Deserialize, Serialize};
use std::ops::Range;
pub use visible::sample_visible;

/// Spacing of samples along a ray.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Spacing {
    /// Steps of this world length from the entry of the ray into the box to its exit. The last step ends at the exit, so the lengths sum to
    /// the chord. Jitter shifts the steps by a fraction of a step.
    Step(f64),
    /// Steps of this length in the contracted space ([`Space::Contracted`]), from the near plane to
    /// infinity. t of a sample is then not its distance from the origin, but s ([`Bend`]), whose steps are even; `delta` are lengths
    /// of s. Jitter shifts the steps by a fraction of a step.
    Contracted(f64),
    /// Spacing of the source paper: `samples` points evenly spaced over t ∈ [0, far], where t is measured along the direction whose camera
    /// z is −1 (its world length is `stretch · t`). Points inside the box are used. Jitter shifts all points by a fraction of the spacing.
    Points {
        /// Number of points on the whole ray, inside or outside of the box.
        samples: usize,
        /// Largest t, in multiples of the direction that is not normalised.
        far: f64,
    },
}

impl Spacing {
    /// Returns steps of this length in the box of a space.
    pub fn even(space: Space, step: f64) -> Self {
        if space == Space::Contracted { Spacing::Contracted(step) } else { Spacing::Step(step) }
    }
}

/// Random shift of each ray's samples. Evaluation uses none.
#[derive(Clone, Copy, Debug)]
pub enum Jitter {
    /// No shift.
    None,
    /// One uniform random fraction of a step per ray. It depends only on seed, step and position in the batch.
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

    /// Returns a stream for the rays from a first one on; `None` without jitter.
    pub(crate) fn stream(self, purpose: Purpose, first: usize) -> Option<Stream> {
        match self {
            Jitter::None => None,
            Jitter::PerRay { seed, step } => Some(random::stream(seed, purpose, step, first as u64)),
        }
    }
}

/// Packed samples of n rays, m in total. Lengths and positions are those of the box ([`Space`]), which are the world's in
/// [`Space::Box`].
#[derive(Debug, Clone)]
pub struct Samples<T: Real> {
    /// Distance of the sample from the ray's origin, `[m]`; s of [`Bend`] with [`Spacing::Contracted`].
    pub t: Tensor<T>,
    /// Length of the sample's interval, `[m]`.
    pub delta: Tensor<T>,
    /// Position, `[m, 3]`.
    pub positions: Tensor<T>,
    /// Unit direction of each ray, `[n, 3]`.
    pub directions: Tensor<T>,
    /// Offsets of the rays' samples: n + 1 entries from 0 to m.
    pub offsets: Indices,
}

impl<T: Real> Samples<T> {
    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.t.len()
    }

    /// Returns true if there are no samples.
    pub fn is_empty(&self) -> bool {
        self.t.is_empty()
    }
}

/// Intervals `k -> (middle, length)` of one ray inside the box.
#[derive(Clone, Copy, Debug)]
pub(crate) struct March {
    pub(crate) count: usize,
    // `field/lanes.rs` computes intervals from these four as `interval` does, counted from `near`.
    pub(crate) near: f64,
    pub(crate) far: f64,
    /// Start of the step with k = 1 (`Step`), or the first point (`Points`).
    pub(crate) start: f64,
    pub(crate) step: f64,
    points: bool,
    /// Path of the ray, if it is not straight.
    pub(crate) bend: Option<Bend>,
}

/// Computes the intervals of one ray, which define the positions of its samples.
pub(crate) fn march(ray: &Ray, aabb: &Aabb, spacing: Spacing, jitter: f64) -> March {
    let none = March { count: 0, near: 0.0, far: 0.0, start: 0.0, step: 1.0, points: false, bend: None };
    let steps = |near: f64, far: f64, step: f64, bend: Option<Bend>| {
        if far <= near {
            return none;
        }
        // Interval boundaries inside the chord: near + (k + jitter) step, from k = 1 on, or from k = 0 with jitter.
        let start = near + if jitter > 0.0 { jitter * step } else { step };
        let inner = if start < far { ((far - start) / step).ceil() as usize } else { 0 };
        March { count: inner + 1, near, far, start, step, points: false, bend }
    };
    if let Spacing::Contracted(step) = spacing {
        let bend = Bend::of(ray);
        return steps(bend.near(), bend.end(), step, Some(bend));
    }
    let Some((near, far)) = aabb.intersect(ray.origin, ray.direction) else { return none };
    match spacing {
        Spacing::Step(step) | Spacing::Contracted(step) => steps(near, far, step, None),
        Spacing::Points { samples, far: limit } => {
            let step = limit * ray.stretch / (samples.max(2) - 1) as f64;
            let first = (near / step - jitter).ceil().max(0.0);
            let last = (far / step - jitter).floor().min(samples as f64 - 1.0);
            let count = if last >= first { (last - first) as usize + 1 } else { 0 };
            March { count, near, far, start: (first + jitter) * step, step, points: true, bend: None }
        }
    }
}

impl March {
    /// Returns middle and length of interval k.
    #[inline(always)]
    pub(crate) fn interval(&self, k: usize) -> (f64, f64) {
        if self.points {
            return self.inner_interval(k);
        }
        let begin = if k == 0 { self.near } else { self.boundary(k) };
        let end = if k + 1 == self.count { self.far } else { self.boundary(k + 1) };
        (0.5 * (begin + end), end - begin)
    }

    /// Returns middle and length of interval k, which must be neither the first nor the last.
    #[inline(always)]
    fn inner_interval(&self, k: usize) -> (f64, f64) {
        if self.points {
            return (self.start + f64::from(k as u32) * self.step, self.step);
        }
        let (begin, end) = (self.boundary(k), self.boundary(k + 1));
        (0.5 * (begin + end), end - begin)
    }

    /// Returns the start of interval k, which must not be the first.
    #[inline(always)]
    fn boundary(&self, k: usize) -> f64 {
        self.start + (f64::from(k as u32) - 1.0) * self.step
    }

    /// Returns a march with the same intervals that is not one of points: interval k is from `near`, or `start` + (k − 1) `step`, to `start` + k `step`, or `far`.
    pub(crate) fn of_steps(self) -> Self {
        if !self.points {
            return self;
        }
        let boundary = |k: f64| self.start + (k - 0.5) * self.step;
        March { near: boundary(0.0), far: boundary(self.count as f64), start: boundary(1.0), points: false, ..self }
    }

    /// Returns the middles and the lengths of the intervals from `first` on.
    #[inline(always)]
    fn intervals<const N: usize>(&self, first: usize) -> [[f64; N]; 2] {
        // Plain loops vectorise; the compiler does not inline `from_fn` in dispatched loops.
        let (mut middles, mut lengths) = ([0.0; N], [0.0; N]);
        for i in 0..N {
            (middles[i], lengths[i]) = self.inner_interval(first + i);
        }
        for k in [0, self.count - 1] {
            if k >= first && k - first < N {
                (middles[k - first], lengths[k - first]) = self.interval(k);
            }
        }
        [middles, lengths]
    }

    /// Returns the position at a place of the ray, in the coordinates of the box.
    #[inline(always)]
    pub(crate) fn at(&self, ray: &Ray, s: f64) -> DVec3 {
        match self.bend {
            None => ray.origin + s * ray.direction,
            Some(bend) => contract(ray.origin + bend.distance(s) * ray.direction),
        }
    }

    /// Returns true if the ray is straight in the box.
    pub(crate) fn is_straight(&self) -> bool {
        self.bend.is_none()
    }

    /// Returns the intervals whose middle lies in an occupied cell.
    #[inline]
    pub(crate) fn occupied<'a>(&self, ray: &Ray, cells: &'a Occupancy) -> Occupied<'a> {
        let (along, end) = (cells.along(ray), self.count);
        let intervals_per_cell = if self.is_straight() { 0.0 } else { along.side() / (Bend::steepest(ray) * self.step) };
        Occupied { march: *self, ray: *ray, along, intervals_per_cell, next: 0, end, found: [(0.0, 0.0); LOOKS], taken: 0, count: 0 }
    }

    /// Returns the numbers of the intervals of a straight ray whose middles may lie between two distances.
    #[inline]
    pub(crate) fn between(&self, [from, to]: [f64; 2]) -> Range<usize> {
        // The last interval of a march is shorter, so that its middle is nearer than that of a whole one.
        self.before(from)..self.count.min(self.before(to).saturating_add(2))
    }

    /// Returns the number of intervals whose middle lies before a distance on a straight ray, or one less.
    #[inline]
    fn before(&self, distance: f64) -> usize {
        let half = if self.points { 0.0 } else { 0.5 };
        ((distance - self.start) / self.step + half) as usize
    }
}

/// Side of the squares of pixels, in a picture, whose rays follow each other.
pub(crate) const PACKET: usize = 8;
/// Number of rays of such a square.
pub(crate) const RAYS_OF_PACKET: usize = PACKET * PACKET;

/// Sections of the rays of a picture outside of which there are no occupied cells. Rays of a packet have the same.
#[derive(Debug)]
pub(crate) struct Sections<'a> {
    cells: Option<&'a Occupancy>,
    section: Option<[f64; 2]>,
}

impl<'a> Sections<'a> {
    /// Sections of rays through these cells. Without cells, and for rays that are not straight, they are whole rays.
    pub(crate) fn new(cells: Option<&'a Occupancy>, spacing: Spacing) -> Self {
        Sections { cells: cells.filter(|_| !matches!(spacing, Spacing::Contracted(_))), section: Some([0.0, f64::INFINITY]) }
    }

    /// Returns the section of ray r, which follows ray r − 1; `None` if the ray is in no occupied cell.
    #[inline]
    pub(crate) fn of(&mut self, rays: &[Ray], r: usize) -> Option<[f64; 2]> {
        if let Some(cells) = self.cells.filter(|_| r.is_multiple_of(RAYS_OF_PACKET)) {
            self.section = cells.section(&rays[r..rays.len().min(r + RAYS_OF_PACKET)]);
        }
        self.section
    }
}

/// Number of intervals that are tested together.
const LOOKS: usize = 16;

/// Iterator over `(middle, length)` of the intervals of a march in occupied cells. Empty bricks are skipped at once; the intervals are the
/// same as those of [`March::interval`].
#[derive(Clone, Debug)]
pub(crate) struct Occupied<'a> {
    march: March,
    ray: Ray,
    along: Along<'a>,
    /// Intervals of a ray that is not straight in which its position changes by at most one cell along any axis.
    intervals_per_cell: f64,
    /// Next interval to test, and the first that is not tested any more.
    next: usize,
    end: usize,
    /// Result of the last test: `count` intervals, of which `taken` were returned.
    found: [(f64, f64); LOOKS],
    taken: usize,
    count: usize,
}

impl Iterator for Occupied<'_> {
    type Item = (f64, f64);

    #[inline]
    fn next(&mut self) -> Option<(f64, f64)> {
        while self.taken == self.count {
            if self.next >= self.end {
                return None;
            }
            self.look();
        }
        self.taken += 1;
        Some(self.found[self.taken - 1])
    }
}

impl Occupied<'_> {
    /// Leaves out the intervals of a straight ray outside of a section, none of which lies in an occupied cell ([`Occupancy::section`]).
    #[inline]
    pub(crate) fn between(self, section: Option<[f64; 2]>) -> Self {
        if !self.march.is_straight() {
            return self;
        }
        let Range { start, end } = section.map_or(0..0, |section| self.march.between(section));
        Self { next: start, end, ..self }
    }

    /// Returns a number of intervals of a ray that is not straight, from the next one on, whose middles are in no occupied cell.
    fn skipped_bent(&self) -> usize {
        // At infinity, there is no position.
        let s = self.march.interval(self.next).0.min(self.march.far - 1e-9);
        (self.along.clearance(self.march.at(&self.ray, s)) * self.intervals_per_cell) as usize
    }

    /// Tests the next intervals, or skips empty bricks.
    fn look(&mut self) {
        let march = &self.march;
        // If the last test found occupied intervals, more are likely to follow.
        let lost = self.count == 0;
        (self.taken, self.count) = (0, 0);
        if let Some(bend) = march.bend {
            while lost && self.next < self.end {
                let skipped = self.skipped_bent();
                if skipped < LOOKS / 2 {
                    break;
                }
                self.next = self.next.saturating_add(skipped);
            }
            if self.next >= self.end {
                return;
            }
            self.count = occupied_of_bent(march, (bend, &self.ray), &self.along, self.next, &mut self.found);
            self.next += LOOKS;
        } else if lost && let Look::EmptyUntil(exit) = self.along.look(march.interval(self.next).0) {
            self.next = (self.next + 1).max(march.before(exit));
        } else {
            self.count = occupied_of(march, &self.along, self.next, &mut self.found);
            self.next += LOOKS;
        }
    }
}

dispatched! {
/// Finds the occupied intervals among the [`LOOKS`] intervals from `first` on. Returns their number.
fn occupied_of(march: &March, along: &Along<'_>, first: usize, found: &mut [(f64, f64); LOOKS]) -> usize {
    let all: [[f64; LOOKS]; 2] = march.intervals(first);
    let occupied = along.occupied(&all[0]);
    kept(&all, &occupied, march.count - first, found)
}
}

dispatched! {
/// Like [`occupied_of`], for a ray that is not straight.
fn occupied_of_bent(march: &March, path: (Bend, &Ray), along: &Along<'_>, first: usize, found: &mut [(f64, f64); LOOKS]) -> usize {
    let all: [[f64; LOOKS]; 2] = march.intervals(first);
    let occupied = along.occupied_at(&path.0.positions(path.1, &all[0]));
    kept(&all, &occupied, march.count - first, found)
}
}

/// Keeps the occupied intervals among the first `most`. Returns their number.
#[inline(always)]
fn kept([middles, lengths]: &[[f64; LOOKS]; 2], occupied: &[bool; LOOKS], most: usize, found: &mut [(f64, f64); LOOKS]) -> usize {
    let mut count = 0;
    for i in 0..LOOKS.min(most) {
        if occupied[i] {
            found[count] = (middles[i], lengths[i]);
            count += 1;
        }
    }
    count
}

/// Samples a batch of rays through a box. With `occupancy`, samples in empty cells are left out; the positions of the others do not change.
pub fn sample<T: Real>(rays: &[Ray], aabb: &Aabb, spacing: Spacing, jitter: Jitter, occupancy: Option<&Occupancy>) -> Samples<T> {
    let marches: Vec<(Vec<March>, Vec<u32>)> = parallel::map_chunks(rays.len(), RUN, |range| {
        let marches: Vec<March> = range.clone().map(|r| march(&rays[r], aabb, spacing, jitter.of(r))).collect();
        let counts = marches.iter().zip(range).map(|(m, r)| match occupancy {
            None => m.count as u32,
            Some(cells) => m.occupied(&rays[r], cells).count() as u32,
        });
        let counts = counts.collect();
        (marches, counts)
    });
    let counts = marches.iter().flat_map(|(_, counts)| counts.iter().copied());
    packed(rays, counts, |r, slots| {
        let march = &marches[r / RUN].0[r % RUN];
        match occupancy {
            None => (0..march.count).map(|k| march.interval(k)).for_each(|interval| slots.put(march, interval)),
            Some(cells) => march.occupied(&rays[r], cells).for_each(|interval| slots.put(march, interval)),
        }
    })
}

/// Number of rays whose samples are placed together.
const RUN: usize = 128;

/// Places for the samples of some rays, filled one after another.
struct Slots<'a, T> {
    ray: Ray,
    t: &'a mut [T],
    delta: &'a mut [T],
    positions: &'a mut [T],
    filled: usize,
}

impl<T: Real> Slots<'_, T> {
    /// Adds a sample of the current ray, given the middle and length of its interval on a march.
    #[inline]
    fn put(&mut self, march: &March, (middle, length): (f64, f64)) {
        self.put_at(march.at(&self.ray, middle), middle, length);
    }

    /// Adds a sample of the current ray, given its position, its distance and the length of its interval.
    #[inline]
    fn put_at(&mut self, p: DVec3, t: f64, delta: f64) {
        let i = self.filled;
        (self.t[i], self.delta[i]) = (T::lit(t), T::lit(delta));
        self.positions[3 * i..3 * i + 3].copy_from_slice(&[T::lit(p.x), T::lit(p.y), T::lit(p.z)]);
        self.filled += 1;
    }
}

/// Packs the samples of rays. `counts` are the numbers of samples of the rays, and `place(r, slots)` adds those of ray r.
fn packed<T: Real>(rays: &[Ray], counts: impl Iterator<Item = u32>, place: impl Fn(usize, &mut Slots<'_, T>) + Sync) -> Samples<T> {
    let mut offsets = Vec::with_capacity(rays.len() + 1);
    offsets.push(0u32);
    for count in counts {
        offsets.push(offsets[offsets.len() - 1] + count);
    }
    let m = offsets[rays.len()] as usize;
    let (mut t, mut delta, mut positions) = (Buffer::<T>::stale(m), Buffer::<T>::stale(m), Buffer::<T>::stale(3 * m));
    let runs = rays.len().div_ceil(RUN);
    let lengths = || (0..runs).map(|c| (offsets[((c + 1) * RUN).min(rays.len())] - offsets[c * RUN]) as usize);
    let parts: Vec<_> = parallel::split_lengths(&mut t, lengths())
        .into_iter()
        .zip(parallel::split_lengths(&mut delta, lengths()))
        .zip(parallel::split_lengths(&mut positions, lengths().map(|n| 3 * n)))
        .collect();
    parallel::for_each_item(parts, |c, ((t, delta), positions)| {
        let mut slots = Slots { ray: rays[c * RUN], t, delta, positions, filled: 0 };
        for (r, &ray) in rays.iter().enumerate().skip(c * RUN).take(RUN) {
            slots.ray = ray;
            place(r, &mut slots);
        }
    });
    Samples {
        t: Tensor::from_buffer(t, &[m]),
        delta: Tensor::from_buffer(delta, &[m]),
        positions: Tensor::from_buffer(positions, &[m, 3]),
        directions: camera::directions(rays),
        offsets: offsets.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn bent_rays_skip_no_occupied_cell() {
        let aabb = Aabb::cube(Space::CONTRACTED);
        let numbers = autograd::random::Stream::new(3).uniform_tensor::<f64>(&[200, 6], -1.0, 1.0);
        for share in [0.0, 2e-4, 0.01, 0.3] {
            let chosen = autograd::random::Stream::new(4).uniform_tensor::<f64>(&[60 * 50 * 70], 0.0, 1.0);
            let cells = Occupancy::new(aabb, [60, 50, 70], &chosen.data().iter().map(|&number| number < share).collect::<Vec<_>>());
            let mut skipped = 0;
            for x in numbers.data().as_chunks::<6>().0 {
                let ray = ray([1.5 * x[0], 1.5 * x[1], 1.5 * x[2]], [x[3], x[4], x[5]]);
                let march = march(&ray, &aabb, Spacing::Contracted(0.004), 0.3);
                let occupied = march.occupied(&ray, &cells);
                skipped += occupied.skipped_bent();
                let all = (0..march.count).map(|k| march.interval(k));
                let want: Vec<_> = all.filter(|interval| cells.contains_point(march.at(&ray, interval.0))).collect();
                assert_eq!(occupied.collect::<Vec<_>>(), want, "{share}: {ray:?}");
            }
            assert!(share > 0.001 || skipped > 1000, "{share}: {skipped}");
        }
    }
}
