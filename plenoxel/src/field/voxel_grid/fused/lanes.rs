//! Rays of a picture in the lanes of vectors.
//!
//! A sample depends on those before it on the ray: they decide how much light is left, and where empty space is skipped. So the lanes of vectors are not
//! samples of one ray, but one sample of each of [`LANES`] rays. A lane in an empty brick skips to where its ray leaves the empty bricks around it. A lane whose ray ends
//! gets the next one.

use crate::camera::Ray;
use crate::field::node_table::{Cells, NodeTable};
use crate::render::along::Sums;
use crate::sampling::March;
use autograd::lattice::bits;
use autograd::rows::Buckets;
use autograd::{Buffer, Real, dispatched};
use std::ops::Range;

/// Number of rays that are led together, one for each bit of a mask: four vectors of `f32` with AVX-512, whose look-ups do not depend on each other.
const LANES: usize = u64::BITS as usize;
/// Samples for which there is room from the start: about those of the rays of a usual task.
const ROOM: usize = 1 << 13;

/// Sums along a ray.
#[derive(Clone, Copy)]
pub(super) struct Pixel<T> {
    pub sums: Sums<T>,
    /// Transmittance behind the samples.
    pub left: T,
    /// Weight of the last samples, which take the color of the sample before.
    pub waiting: T,
}

/// Samples whose color is looked up, those of each ray front to back.
pub(super) struct Shown<T: Real> {
    /// Number of each sample's ray.
    pub of: Buffer<u32>,
    /// Voxel coordinates.
    pub at: [Buffer<T>; 3],
    /// Weights of the colors.
    pub weight: Buffer<T>,
    /// Number of samples so far.
    count: usize,
    /// Number of all samples in stored bricks, with or without a color.
    pub looked_at: usize,
}

/// Rays that are led together.
struct Lanes<T> {
    /// Numbers of the rays.
    ray: [u32; LANES],
    /// Next interval.
    next: [u32; LANES],
    /// Interval before which the ray ends.
    end: [u32; LANES],
    /// Last interval of the march.
    last: [u32; LANES],
    /// The march ([`March::of_steps`]). Its other distances are those from `near`, so that their rounding does not depend on how far the camera is.
    near: [T; LANES],
    far: [T; LANES],
    start: [T; LANES],
    step: [T; LANES],
    per_step: [T; LANES],
    /// Voxel coordinates at distance `near` + s along the ray are origin + s slope.
    origin: [[T; LANES]; 3],
    slope: [[T; LANES]; 3],
    per_slope: [[T; LANES]; 3],
    sums: Sums<T, LANES>,
    /// Transmittance behind the samples so far; 0 in lanes without a ray.
    left: [T; LANES],
    /// Weight of the samples that take the color of the next one.
    waiting: [T; LANES],
    /// Largest weight that may still wait.
    allowed: [T; LANES],
}

/// Leads rays through a table of densities. `next` returns the number of the next ray, its march, and the range of its intervals that can be in matter. Voxel
/// coordinates are `to_voxels[0]` x + `to_voxels[1]`. Rays end where the transmittance is below `least`; samples whose weights sum to at most `least` for each
/// ray take the color of another. `pixels` gets the sums of each ray.
pub(super) fn lead<T: Real, const FUSED: bool>(
    densities: &NodeTable<T>,
    rays: &[Ray],
    mut next: impl FnMut() -> Option<(usize, March, Range<usize>)>,
    to_voxels: [f64; 2],
    least: T,
    pixels: &mut [Pixel<T>],
) -> Shown<T> {
    let mut shown = Shown::none();
    let mut lanes = Lanes::none();
    let mut idle = !0;
    loop {
        for lane in bits(idle) {
            let Some((ray, march, intervals)) = next() else { break };
            lanes.begin(lane, (ray, &rays[ray]), march, intervals, to_voxels, least);
            idle &= !(1 << lane);
        }
        if idle == !0 {
            shown.truncate();
            return shown;
        }
        let mut ended = 0;
        while ended == 0 {
            shown.make_room();
            ended = step::<T, FUSED>(&mut lanes, idle, densities, least, &mut shown);
        }
        for lane in bits(ended) {
            pixels[lanes.ray[lane] as usize] = lanes.end(lane);
        }
        idle |= ended;
    }
}

impl<T: Real> Lanes<T> {
    fn none() -> Self {
        let (numbers, none) = ([0; LANES], [T::zero(); LANES]);
        Lanes {
            ray: numbers,
            next: numbers,
            end: numbers,
            last: numbers,
            near: none,
            far: none,
            start: none,
            step: none,
            per_step: none,
            origin: [none; 3],
            slope: [none; 3],
            per_slope: [none; 3],
            sums: Sums::new(),
            left: none,
            waiting: none,
            allowed: none,
        }
    }

    /// Gives a ray to a lane.
    fn begin(&mut self, lane: usize, (number, ray): (usize, &Ray), march: March, intervals: Range<usize>, to_voxels: [f64; 2], least: T) {
        let march = march.of_steps();
        // A lane without a ray goes on along its former one.
        self.sums.take(lane);
        self.ray[lane] = number as u32;
        [self.next[lane], self.end[lane], self.last[lane]] = [intervals.start, intervals.end, march.count - 1].map(|k| k as u32);
        (self.near[lane], self.far[lane]) = (T::lit(march.near), T::lit(march.far - march.near));
        self.start[lane] = T::lit(march.start - march.near);
        (self.step[lane], self.per_step[lane]) = (T::lit(march.step), T::lit(march.step.recip()));
        for axis in 0..3 {
            let slope = ray.direction[axis] * to_voxels[0];
            self.origin[axis][lane] = T::lit(ray.origin[axis] * to_voxels[0] + to_voxels[1] + march.near * slope);
            (self.slope[axis][lane], self.per_slope[axis][lane]) = (T::lit(slope), T::lit(slope.recip()));
        }
        (self.left[lane], self.waiting[lane], self.allowed[lane]) = (T::one(), T::zero(), least);
    }

    /// Returns the sums along the ray of a lane, which then has no ray.
    fn end(&mut self, lane: usize) -> Pixel<T> {
        let pixel = Pixel { sums: self.sums.take(lane), left: self.left[lane], waiting: self.waiting[lane] };
        (self.left[lane], self.waiting[lane], self.allowed[lane]) = (T::zero(), T::zero(), T::zero());
        pixel
    }
}

impl<T: Real> Shown<T> {
    fn none() -> Self {
        let none = || Buffer::stale(0);
        Shown { of: Buffer::stale(0), at: [none(), none(), none()], weight: none(), count: 0, looked_at: 0 }
    }

    /// Makes sure that there is room for one more sample of each lane.
    #[inline]
    fn make_room(&mut self) {
        if self.count + LANES > self.of.len() {
            let room = (2 * self.of.len()).max(ROOM);
            self.of.grow(room);
            self.at.iter_mut().chain([&mut self.weight]).for_each(|column| column.grow(room));
        }
    }

    fn truncate(&mut self) {
        self.of.truncate(self.count);
        self.at.iter_mut().chain([&mut self.weight]).for_each(|column| column.truncate(self.count));
    }

    /// Sorts the samples by their rays, of which there are `rays`. Returns the offsets of the rays' samples.
    pub fn sort(&mut self, rays: usize) -> Vec<u32> {
        let mut next = Buckets::count(rays, self.of.iter().map(|&ray| ray as usize));
        let places: Vec<usize> = self.of.iter().map(|&ray| next.take(ray as usize)).collect();
        for column in self.at.iter_mut().chain([&mut self.weight]) {
            let unsorted = std::mem::replace(column, Buffer::stale(places.len()));
            places.iter().zip(&unsorted[..]).for_each(|(&place, &x)| column[place] = x);
        }
        let (sorted, mut offsets) = (next.filled(), vec![0]);
        for ray in 0..rays {
            let own = sorted.range(ray);
            offsets.push(own.end as u32);
            self.of[own].fill(ray as u32);
        }
        offsets
    }
}

dispatched! {
/// Takes one sample of each ray, or skips empty bricks; `idle` is a mask of the lanes without a ray. Returns a mask of the lanes whose ray has ended.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn step<T: Real, const FUSED: bool>(lanes: &mut Lanes<T>, idle: u64, densities: &NodeTable<T>, stop: T, shown: &mut Shown<T>) -> u64 {
    // Plain loops vectorise, one array after another. These intervals are those of `March::interval`, up to rounding.
    let (mut middles, mut t, mut delta) = ([T::zero(); LANES], [T::zero(); LANES], [T::zero(); LANES]);
    for i in 0..LANES {
        let k = T::lit(f64::from(lanes.next[i]));
        let begin = if lanes.next[i] == 0 { T::zero() } else { lanes.start[i] + (k - T::one()) * lanes.step[i] };
        let end = if lanes.next[i] == lanes.last[i] { lanes.far[i] } else { lanes.start[i] + k * lanes.step[i] };
        middles[i] = T::lit(0.5) * (begin + end);
        (t[i], delta[i]) = (lanes.near[i] + middles[i], end - begin);
    }
    let mut at = [[T::zero(); LANES]; 3];
    for a in 0..3 {
        for i in 0..LANES {
            at[a][i] = middles[i].multiply_add::<FUSED>(lanes.slope[a][i], lanes.origin[a][i]);
        }
    }
    let cells = Cells::find(densities.bricks(), at.each_ref());
    let stored = mask_of(&cells.stored()) & !idle;
    if stored != 0 {
        shown.looked_at += stored.count_ones() as usize;
        let density = cells.numbers::<FUSED>(densities);
        let (mut sigma, mut weight, mut through) = ([T::zero(); LANES], [T::zero(); LANES], [T::zero(); LANES]);
        for i in 0..LANES {
            // `max` would turn a density that is not a number into 0.
            sigma[i] = if density[i] < T::zero() { T::zero() } else { density[i] };
        }
        for i in 0..LANES {
            (weight[i], through[i]) = (sigma[i] * delta[i]).absorb::<FUSED>();
        }
        for i in 0..LANES {
            weight[i] *= lanes.left[i];
            lanes.left[i] *= through[i];
        }
        lanes.sums.add(weight, t, delta, sigma);
        // The compiler makes branches of conditions, so they are 0 or 1 here.
        let (mut all, mut has_color, mut colored) = ([T::zero(); LANES], [T::zero(); LANES], [false; LANES]);
        for i in 0..LANES {
            all[i] = lanes.waiting[i] + weight[i];
        }
        for i in 0..LANES {
            colored[i] = all[i] > lanes.allowed[i];
        }
        for i in 0..LANES {
            has_color[i] = if colored[i] { T::one() } else { T::zero() };
        }
        for i in 0..LANES {
            lanes.allowed[i] -= has_color[i] * lanes.waiting[i];
        }
        for i in 0..LANES {
            lanes.waiting[i] = (T::one() - has_color[i]) * all[i];
        }
        let colored = mask_of(&colored);
        let count = shown.count;
        let (of, to_weight) = (&mut shown.of[count..count + LANES], &mut shown.weight[count..count + LANES]);
        let [x, y, z] = &mut shown.at;
        let to = [&mut x[count..count + LANES], &mut y[count..count + LANES], &mut z[count..count + LANES]];
        shown.count += colored.count_ones() as usize;
        if colored == !0 {
            // Whole vectors, without a loop over the lanes.
            of.copy_from_slice(&lanes.ray);
            to_weight.copy_from_slice(&all);
            for a in 0..3 {
                to[a].copy_from_slice(&at[a]);
            }
        } else {
            let (mut left, mut new) = (colored, 0);
            while left != 0 {
                let i = left.trailing_zeros() as usize % LANES;
                left &= left - 1;
                (of[new], to_weight[new]) = (lanes.ray[i], all[i]);
                (to[0][new], to[1][new], to[2][new]) = (at[0][i], at[1][i], at[2][i]);
                new += 1;
            }
        }
    }
    for i in 0..LANES {
        lanes.next[i] += 1;
    }
    if stored | idle != !0 {
        let exits = cells.exits(&lanes.origin, &lanes.per_slope);
        for i in 0..LANES {
            // The number of intervals whose middle lies before the exit or at it. At the exit, the nodes are still those of an empty brick.
            let end = T::lit(f64::from(lanes.end[i]));
            let before = ((exits[i] - lanes.start[i]) * lanes.per_step[i] + T::lit(1.5)).max(T::zero()).min(end).index();
            lanes.next[i] = lanes.next[i].max(before);
        }
    }
    let mut ended = [false; LANES];
    for i in 0..LANES {
        ended[i] = (lanes.next[i] >= lanes.end[i]) | (lanes.left[i] < stop);
    }
    mask_of(&ended) & !idle
}
}

/// Returns a mask with a bit for each lane where a condition holds.
#[inline(always)]
fn mask_of(holds: &[bool; LANES]) -> u64 {
    let (mut bits, mut mask) = ([0; LANES], 0);
    for i in 0..LANES {
        bits[i] = if holds[i] { 1_u64 << i } else { 0 };
    }
    for bit in bits {
        mask |= bit;
    }
    mask
}
