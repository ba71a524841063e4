//! Rays of a picture in the lanes of vectors.
//!
//! A sample depends on those before it on the ray: they decide how much light is left, and where empty space is skipped. So the lanes of vectors are not
//! samples of one ray, but one sample of each of [`LANES`] rays. A lane in an empty brick skips to where its ray leaves the empty bricks around it. A lane whose ray ends
//! gets the next one.
//!
//! Fields differ in their densities ([`Matter`]), spaces in the paths of rays ([`Path`]).

mod paths;

use crate::camera::Ray;
use crate::field::node_table::{Cells, NodeTable};
use crate::render::RenderOptions;
use crate::render::along::{COLUMNS, Sums};
use crate::sampling::{March, Occupancy, Sections, march};
use autograd::lattice::bits;
use autograd::rows::Buckets;
use autograd::{Buffer, Real, dispatched, parallel};
use glam::DVec3;
pub(crate) use paths::{Bent, Path, Straight};
use std::ops::Range;

/// Number of rays that are led together, one for each bit of a mask: four vectors of `f32` with AVX-512, whose look-ups do not depend on each other.
pub(crate) const LANES: usize = u64::BITS as usize;
/// Samples for which there is room from the start: about those of the rays of a usual task.
const ROOM: usize = 1 << 13;

/// Densities of a field, from a table of numbers at the nodes of a grid.
pub(crate) trait Matter<T: Real>: Sync {
    /// Returns the table.
    fn table(&self) -> &NodeTable<T>;

    /// Returns the densities σ at positions in cells, from the numbers of the table there. They must be 0 in empty space: all positions in stored bricks are samples.
    fn sigma<const FUSED: bool>(&self, at: &[[T; LANES]; 3], numbers: [T; LANES]) -> [T; LANES];
}

/// Sums along a ray.
#[derive(Clone, Copy)]
struct Pixel<T> {
    sums: Sums<T>,
    /// Transmittance behind the samples.
    left: T,
    /// Weight of the last samples, which take the color of the sample before.
    waiting: T,
}

/// Rays of a picture, and the samples whose colors are to be computed.
pub(crate) struct Shown<T: Real, const N: usize> {
    /// Number of each sample's ray. The samples of a ray are in order, front to back.
    pub of: Buffer<u32>,
    /// Positions in cells, x, y and z, the weights of the colors, and, with N = 6, distances t and lengths of the intervals.
    pub columns: [Buffer<T>; N],
    /// Number of all samples in stored bricks, with or without a color.
    pub looked_at: usize,
    /// Number of samples so far.
    count: usize,
    pixels: Vec<Pixel<T>>,
}

/// Leads rays through the matter of a field.
pub(crate) struct Guide<'a, M> {
    pub matter: &'a M,
    pub options: &'a RenderOptions<'a>,
    /// Cells outside of which straight rays need no samples.
    pub cells: &'a Occupancy,
    /// Factor and summand that map positions in the box to cells of the table.
    pub to_cells: [DVec3; 2],
    /// Largest sum of weights, for each ray, whose samples may take the color of another.
    pub merged: f64,
    /// Sum of weights of consecutive samples up to which they take the color of the next one, however many there are.
    pub group: f64,
}

impl<M> Guide<'_, M> {
    /// Leads rays along their paths, without jitter. They end where the transmittance is below [`stop_below`](RenderOptions::stop_below).
    pub fn lead<T: Real, P: Path<T>, const N: usize>(&self, rays: &[Ray]) -> Shown<T, N>
    where
        M: Matter<T>,
    {
        if parallel::fused() { self.lead_in::<T, P, N, true>(rays) } else { self.lead_in::<T, P, N, false>(rays) }
    }

    fn lead_in<T: Real, P: Path<T>, const N: usize, const FUSED: bool>(&self, rays: &[Ray]) -> Shown<T, N>
    where
        M: Matter<T>,
    {
        let RenderOptions { aabb, spacing, stop_below, .. } = self.options;
        let [stop, group, merged] = [*stop_below, self.group, self.merged.max(self.group)].map(T::lit);
        let mut sections = Sections::new(Some(self.cells), *spacing);
        let mut numbers = 0..rays.len();
        let mut next = || {
            numbers.by_ref().find_map(|r| {
                let section = sections.of(rays, r)?;
                let march = march(&rays[r], aabb, *spacing, 0.0);
                let intervals = if march.is_straight() { march.between(section) } else { 0..march.count };
                (!intervals.is_empty()).then_some((r, march, intervals))
            })
        };
        let mut shown = Shown::none(rays.len());
        let mut lanes = Lanes::<T, P>::new(self.to_cells);
        let mut idle = !0;
        loop {
            for lane in bits(idle) {
                let Some((ray, march, intervals)) = next() else { break };
                lanes.begin(lane, (ray, &rays[ray]), march, intervals, merged);
                idle &= !(1 << lane);
            }
            if idle == !0 {
                shown.truncate();
                return shown;
            }
            let mut ended = 0;
            while ended == 0 {
                shown.make_room();
                ended = step::<T, P, M, N, FUSED>(&mut lanes, idle, self.matter, [stop, group], &mut shown);
            }
            for lane in bits(ended) {
                shown.pixels[lanes.ray[lane] as usize] = lanes.end(lane);
            }
            idle |= ended;
        }
    }
}

/// Rays that are led together.
struct Lanes<T, P> {
    /// Numbers of the rays.
    ray: [u32; LANES],
    intervals: Intervals<T>,
    path: P,
    sums: Sums<T, LANES>,
    /// Transmittance behind the samples so far; 0 in lanes without a ray.
    left: [T; LANES],
    /// Weight of the samples that take the color of the next one.
    waiting: [T; LANES],
    /// Largest weight that may still wait.
    allowed: [T; LANES],
}

/// Intervals of marches ([`March::of_steps`]).
struct Intervals<T> {
    /// Next interval.
    next: [u32; LANES],
    /// Interval before which the ray ends.
    end: [u32; LANES],
    /// Last interval of the march.
    last: [u32; LANES],
    /// The other distances are counted from `near`: on a straight ray, their rounding does not depend on how far the camera is.
    near: [T; LANES],
    far: [T; LANES],
    start: [T; LANES],
    step: [T; LANES],
}

impl<T: Real, P: Path<T>> Lanes<T, P> {
    /// Lanes without rays.
    fn new(to_cells: [DVec3; 2]) -> Self {
        let (numbers, none) = ([0; LANES], [T::zero(); LANES]);
        let intervals = Intervals { next: numbers, end: numbers, last: numbers, near: none, far: none, start: none, step: none };
        Lanes { ray: numbers, intervals, path: P::new(to_cells), sums: Sums::new(), left: none, waiting: none, allowed: none }
    }

    /// Gives a ray to a lane.
    fn begin(&mut self, lane: usize, (number, ray): (usize, &Ray), march: March, intervals: Range<usize>, merged: T) {
        let march = march.of_steps();
        // A lane without a ray goes on along its former one.
        self.sums.take(lane);
        self.ray[lane] = number as u32;
        let own = &mut self.intervals;
        [own.next[lane], own.end[lane], own.last[lane]] = [intervals.start, intervals.end, march.count - 1].map(|k| k as u32);
        (own.near[lane], own.far[lane]) = (T::lit(march.near), T::lit(march.far - march.near));
        (own.start[lane], own.step[lane]) = (T::lit(march.start - march.near), T::lit(march.step));
        self.path.begin(lane, ray, &march);
        (self.left[lane], self.waiting[lane], self.allowed[lane]) = (T::one(), T::zero(), merged);
    }

    /// Returns the sums along the ray of a lane, which then has no ray.
    fn end(&mut self, lane: usize) -> Pixel<T> {
        let pixel = Pixel { sums: self.sums.take(lane), left: self.left[lane], waiting: self.waiting[lane] };
        (self.left[lane], self.waiting[lane], self.allowed[lane]) = (T::zero(), T::zero(), T::zero());
        pixel
    }
}

impl<T: Real, const N: usize> Shown<T, N> {
    fn none(rays: usize) -> Self {
        let pixels = vec![Pixel { sums: Sums::new(), left: T::one(), waiting: T::zero() }; rays];
        Shown { of: Buffer::stale(0), columns: std::array::from_fn(|_| Buffer::stale(0)), looked_at: 0, count: 0, pixels }
    }

    /// Returns the positions in cells.
    pub fn at(&self) -> [&[T]; 3] {
        [0, 1, 2].map(|axis| &self.columns[axis][..])
    }

    /// Returns the weights.
    pub fn weight(&self) -> &[T] {
        &self.columns[3]
    }

    /// Makes sure that there is room for one more sample of each lane.
    #[inline]
    fn make_room(&mut self) {
        if self.count + LANES > self.of.len() {
            let room = (2 * self.of.len()).max(ROOM);
            self.of.grow(room);
            self.columns.iter_mut().for_each(|column| column.grow(room));
        }
    }

    fn truncate(&mut self) {
        self.of.truncate(self.count);
        self.columns.iter_mut().for_each(|column| column.truncate(self.count));
    }

    /// Sorts the samples by their rays. Returns the offsets of the rays' samples.
    pub fn sort(&mut self) -> Vec<u32> {
        let rays = self.pixels.len();
        let mut next = Buckets::count(rays, self.of.iter().map(|&ray| ray as usize));
        let places: Vec<usize> = self.of.iter().map(|&ray| next.take(ray as usize)).collect();
        for column in &mut self.columns {
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

    /// Writes the pixels of all rays, from the `weights` of the samples and `color(i)`, the color of sample i.
    pub fn write(&self, weights: &[T], color: impl Fn(usize) -> [T; 3], background: [T; 3], pixels: &mut [[T; COLUMNS]]) {
        // Σ w c of each ray, and its last color.
        let mut rgb = vec![([T::zero(); 3], background); pixels.len()];
        for (i, (&ray, &weight)) in self.of.iter().zip(weights).enumerate() {
            let (sum, last) = &mut rgb[ray as usize];
            *last = color(i);
            (0..3).for_each(|c| sum[c] += weight * last[c]);
        }
        for ((pixel, own), (mut rgb, last)) in pixels.iter_mut().zip(&self.pixels).zip(rgb) {
            (0..3).for_each(|c| rgb[c] += own.waiting * last[c]);
            *pixel = own.sums.pixel(rgb, own.left, background);
        }
    }
}

dispatched! {
/// Takes one sample of each ray, or skips empty bricks; `idle` is a mask of the lanes without a ray. Returns a mask of the lanes whose ray has ended.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn step<T: Real, P: Path<T>, M: Matter<T>, const N: usize, const FUSED: bool>(
    lanes: &mut Lanes<T, P>,
    idle: u64,
    matter: &M,
    [stop, group]: [T; 2],
    shown: &mut Shown<T, N>,
) -> u64 {
    // Plain loops vectorise, one array after another. These intervals are those of `March::interval`, up to rounding.
    let (mut middles, mut t, mut delta) = ([T::zero(); LANES], [T::zero(); LANES], [T::zero(); LANES]);
    let intervals = &mut lanes.intervals;
    for i in 0..LANES {
        let k = T::lit(f64::from(intervals.next[i]));
        let begin = if intervals.next[i] == 0 { T::zero() } else { intervals.start[i] + (k - T::one()) * intervals.step[i] };
        let end = if intervals.next[i] == intervals.last[i] { intervals.far[i] } else { intervals.start[i] + k * intervals.step[i] };
        middles[i] = T::lit(0.5) * (begin + end);
        (t[i], delta[i]) = (intervals.near[i] + middles[i], end - begin);
    }
    let at = lanes.path.places::<FUSED>(&middles);
    let cells = Cells::find(matter.table().bricks(), at.each_ref());
    let stored = mask_of(&cells.stored()) & !idle;
    if stored != 0 {
        shown.looked_at += stored.count_ones() as usize;
        let sigma = matter.sigma::<FUSED>(&at, cells.numbers::<FUSED>(matter.table()));
        let (mut weight, mut through) = ([T::zero(); LANES], [T::zero(); LANES]);
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
            lanes.allowed[i] = (lanes.allowed[i] - has_color[i] * lanes.waiting[i]).max(group);
        }
        for i in 0..LANES {
            lanes.waiting[i] = (T::one() - has_color[i]) * all[i];
        }
        let colored = mask_of(&colored);
        let count = shown.count;
        let of = &mut shown.of[count..count + LANES];
        let columns = shown.columns.each_mut().map(|column| &mut column[count..count + LANES]);
        let values = [&at[0], &at[1], &at[2], &all, &t, &delta];
        shown.count += colored.count_ones() as usize;
        if colored == !0 {
            // Whole vectors, without a loop over the lanes.
            of.copy_from_slice(&lanes.ray);
            for c in 0..N {
                columns[c].copy_from_slice(values[c]);
            }
        } else {
            let (mut left, mut new) = (colored, 0);
            while left != 0 {
                let i = left.trailing_zeros() as usize % LANES;
                left &= left - 1;
                of[new] = lanes.ray[i];
                for c in 0..N {
                    columns[c][new] = values[c][i];
                }
                new += 1;
            }
        }
    }
    let mut this = [T::zero(); LANES];
    for i in 0..LANES {
        this[i] = T::lit(f64::from(intervals.next[i]));
        intervals.next[i] += 1;
    }
    if stored | idle != !0 {
        let skipped = lanes.path.skip(&cells, &at, &this);
        for i in 0..LANES {
            let before = skipped[i].max(T::zero()).min(T::lit(f64::from(intervals.end[i]))).index();
            intervals.next[i] = intervals.next[i].max(before);
        }
    }
    let mut ended = [false; LANES];
    for i in 0..LANES {
        ended[i] = (intervals.next[i] >= intervals.end[i]) | (lanes.left[i] < stop);
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
