//! Samples of several passes (NeRF, section 5.2): stratified over a section of each ray, then more where the first pass found matter.
//!
//! The intervals of the samples of a ray are bounded by the middles between neighbours and by the ends of the section, so the lengths add up to the
//! section. The authors' program takes the distance to the next sample as the length, and 10¹⁰ for the last. Its second pass draws from a density that is
//! constant between middles of neighbours, as here, but leaves out the first and the last of these intervals.

use super::{Jitter, Samples, packed};
use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::random::{Purpose, uniform};
use autograd::{Real, Tensor};

/// Section of a ray that is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Section {
    /// The part inside a box; rays that miss it have no samples.
    Inside(Aabb),
    /// From `near` to `far`, in multiples of the direction whose camera z is −1, as NeRF measures it.
    Between {
        /// Smallest distance, at least 0.
        near: f64,
        /// Largest distance.
        far: f64,
    },
}

impl Section {
    /// Returns the distances of the ends of the section from the origin of a ray, world length; `None` if it is empty.
    pub fn of(&self, ray: &Ray) -> Option<(f64, f64)> {
        let ends = match self {
            Section::Inside(aabb) => aabb.intersect(ray.origin, ray.direction)?,
            Section::Between { near, far } => (near * ray.stretch, far * ray.stretch),
        };
        (ends.0 < ends.1).then_some(ends)
    }
}

/// Weight that is added to that of every interval, so that no interval is forgotten: the authors' 10⁻⁵.
const PADDING: f64 = 1e-5;

/// Samples `count` equal parts of the section of each ray, at a random place of each part, or at its middle without jitter. The places depend only on
/// seed, step, position of the ray in the batch and number of the part.
pub fn stratified<T: Real>(rays: &[Ray], section: Section, count: usize, jitter: Jitter) -> Samples<T> {
    refined(rays, section, count, |r, (near, far), t| {
        t.extend((0..count).map(|k| near + (far - near) * share(jitter, Purpose::Jitter, r, k, count)));
    })
}

/// Returns `samples` together with `count` more on each ray, in order. The new ones are drawn from the density that is constant on the interval of each
/// sample and proportional to its weight, `[m]`, plus 10⁻⁵, by the inverse of its cumulative distribution at one random number in each of `count` equal
/// parts of [0, 1), or at their middles without jitter. The numbers depend only on seed, step, position of the ray in the batch and number of the part.
///
/// `samples` are those of [`stratified`] for the same rays and section. No gradient flows through the places.
///
/// Panics if there is not one weight for each sample.
#[track_caller]
pub fn importance<T: Real>(
    rays: &[Ray],
    section: Section,
    samples: &Samples<T>,
    weights: &Tensor<T>,
    count: usize,
    jitter: Jitter,
) -> Samples<T> {
    assert_eq!(weights.len(), samples.len(), "importance: {} weights for {} samples", weights.len(), samples.len());
    let before = samples.offsets.windows(2).map(|ends| (ends[1] - ends[0]) as usize).max().unwrap_or(0);
    refined(rays, section, before + count, |r, (near, far), t| {
        let of_ray = samples.offsets[r] as usize..samples.offsets[r + 1] as usize;
        t.extend(samples.t.data()[of_ray.clone()].iter().map(|t| t.as_f64()));
        let edges = edges(t, near, far);
        let weights = weights.data()[of_ray].iter().map(|weight| weight.as_f64());
        t.extend(inverse_cdf(&edges, weights, (0..count).map(|k| share(jitter, Purpose::Importance, r, k, count))));
        t.sort_unstable_by(f64::total_cmp);
    })
}

/// Returns a random number in part k of `count` equal parts of [0, 1), or its middle without jitter.
fn share(jitter: Jitter, purpose: Purpose, ray: usize, k: usize, count: usize) -> f64 {
    let within = match jitter {
        Jitter::None => 0.5,
        Jitter::PerRay { seed, step } => uniform(seed, purpose, step, (ray as u64) << 32 | k as u64),
    };
    (k as f64 + within) / count as f64
}

/// Returns the middles between neighbours of t, between both ends of the section.
fn edges(t: &[f64], near: f64, far: f64) -> Vec<f64> {
    [near].into_iter().chain(t.windows(2).map(|pair| 0.5 * (pair[0] + pair[1]))).chain([far]).collect()
}

/// Returns the points at which the cumulative distribution of a density has the given values, ascending numbers in [0, 1). The density is constant between
/// neighbouring edges, and proportional to the weight of the interval plus 10⁻⁵ in all of it. There is one edge more than weights. Weights below 0 and NaN
/// count as 0.
pub fn inverse_cdf(edges: &[f64], weights: impl Iterator<Item = f64>, values: impl Iterator<Item = f64>) -> impl Iterator<Item = f64> {
    let masses: Vec<f64> = weights.map(|weight| weight.max(0.0) + PADDING).collect();
    let total: f64 = masses.iter().sum();
    let (mut interval, mut below) = (0, 0.0);
    values.map(move |value| {
        let mass = value * total;
        while interval + 1 < masses.len() && below + masses[interval] <= mass {
            below += masses[interval];
            interval += 1;
        }
        let [from, to] = [edges[interval], edges[interval + 1]];
        from + (to - from) * ((mass - below) / masses[interval]).clamp(0.0, 1.0)
    })
}

/// Packs `count` samples of each ray whose section is not empty. `place(r, ends, t)` appends their ascending distances to an empty list.
fn refined<T: Real>(rays: &[Ray], section: Section, count: usize, place: impl Fn(usize, (f64, f64), &mut Vec<f64>) + Sync) -> Samples<T> {
    let counts = rays.iter().map(|ray| if section.of(ray).is_some() { count as u32 } else { 0 });
    packed(rays, counts, |r, slots| {
        let Some((near, far)) = section.of(&rays[r]) else { return };
        let mut t = Vec::with_capacity(count);
        place(r, (near, far), &mut t);
        let edges = edges(&t, near, far);
        t.iter()
            .zip(edges.windows(2))
            .for_each(|(&t, ends)| slots.put_at(slots.ray.origin + t * slots.ray.direction, t, ends[1] - ends[0]));
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    const JITTER: Jitter = Jitter::PerRay { seed: 7, step: 3 };
    const SECTION: Section = Section::Between { near: 2.0, far: 6.0 };

    fn rays() -> Vec<Ray> {
        let ray = |x: f64| Ray { origin: DVec3::new(x, 0.0, 4.0), direction: -DVec3::Z, stretch: 1.25 };
        [0.0, 0.5, 9.0].map(ray).to_vec()
    }

    fn drawn(edges: &[f64], weights: &[f64], count: usize) -> Vec<f64> {
        let values = (0..count).map(|k| (k as f64 + 0.5) / count as f64);
        inverse_cdf(edges, weights.iter().copied(), values).collect()
    }

    #[test]
    fn points_are_as_frequent_as_the_weights_say_and_evenly_spread_in_each_interval() {
        let (edges, weights) = ([0.0, 1.0, 1.5, 4.0, 5.0], [0.1, 0.6, 0.0, 0.3]);
        let found = drawn(&edges, &weights, 10_000);
        assert!(found.is_sorted());
        for (ends, weight) in edges.windows(2).zip(weights) {
            let inside: Vec<f64> = found.iter().copied().filter(|x| (ends[0]..ends[1]).contains(x)).collect();
            // One point is 1e-4 of the mass, and the padding 4e-5 in all.
            assert!((inside.len() as f64 / 1e4 - weight).abs() < 2e-4, "{ends:?}: {}", inside.len());
            let gaps: Vec<f64> = inside.windows(2).map(|pair| pair[1] - pair[0]).collect();
            assert!(gaps.iter().all(|gap| (gap - gaps[0]).abs() < 1e-9), "{ends:?}");
        }
    }

    #[test]
    fn without_weights_every_interval_has_as_many_points() {
        let edges = [0.0, 1.0, 3.0, 3.5, 4.0];
        for weights in [[0.0; 4], [f64::NAN; 4], [-1.0; 4]] {
            let found = drawn(&edges, &weights, 400);
            assert!(edges.windows(2).all(|ends| found.iter().filter(|x| (ends[0]..ends[1]).contains(x)).count() == 100));
        }
        assert_eq!(drawn(&[2.0, 4.0], &[0.7], 4), [2.25, 2.75, 3.25, 3.75]);
        assert_eq!(drawn(&[2.0, 2.0, 4.0], &[0.0, 1.0], 1).len(), 1);
        // All values, and the largest below 1, stay inside.
        let last = inverse_cdf(&edges, [1.0, 0.0, 0.0, 0.0].into_iter(), [0.0, 1.0 - f64::EPSILON].into_iter()).collect::<Vec<_>>();
        assert!(last[0] == 0.0 && last[1] <= 4.0, "{last:?}");
    }

    #[test]
    fn stratified_samples_have_one_in_each_part_and_their_lengths_add_up() {
        for jitter in [Jitter::None, JITTER] {
            let samples = stratified::<f64>(&rays(), SECTION, 8, jitter);
            assert_eq!(samples.offsets[..], [0, 8, 16, 24]);
            for (t, delta) in samples.t.data().chunks(8).zip(samples.delta.data().chunks(8)) {
                // From 2.5 to 7.5 in world length.
                assert!(t.iter().enumerate().all(|(k, t)| ((t - 2.5) / 0.625) as usize == k), "{t:?}");
                assert!((delta.iter().sum::<f64>() - 5.0).abs() < 1e-12 && delta.iter().all(|d| *d > 0.0));
            }
        }
        let inside = stratified::<f64>(&rays(), Section::Inside(Aabb::cube(1.0)), 4, Jitter::None);
        assert_eq!(inside.offsets[..], [0, 4, 8, 8]);
        assert_eq!(inside.t.data()[..4], [3.25, 3.75, 4.25, 4.75]);
        assert_eq!(stratified::<f64>(&rays(), SECTION, 1, Jitter::None).delta.data(), [5.0; 3]);
    }

    #[test]
    fn new_samples_lie_between_the_old_ones_where_the_weights_are() {
        let coarse = stratified::<f64>(&rays(), SECTION, 8, JITTER);
        let weights = Tensor::from_vec((0..24).map(|i| if i % 8 == 5 { 1.0 } else { 0.0 }).collect(), &[24]);
        let samples = importance(&rays(), SECTION, &coarse, &weights, 16, JITTER);
        assert_eq!(samples.offsets[..], [0, 24, 48, 72]);
        for (r, t) in samples.t.data().chunks(24).enumerate() {
            let old = &coarse.t.data()[8 * r..][..8];
            assert!(t.is_sorted() && old.iter().all(|t_old| t.contains(t_old)));
            let interval = 0.5 * (old[4] + old[5])..0.5 * (old[5] + old[6]);
            assert_eq!(t.iter().filter(|t| interval.contains(t)).count(), 17);
            assert!((samples.delta.data()[24 * r..][..24].iter().sum::<f64>() - 5.0).abs() < 1e-12);
        }
    }

    /// The mean of f(t) over the density is what the samples estimate: uniform weights and uniform numbers give the mean over the section.
    #[test]
    fn numbers_depend_on_seed_step_ray_and_part_only_and_are_uniform() {
        let at = |step: u64, rays: &[Ray]| stratified::<f64>(rays, SECTION, 64, Jitter::PerRay { seed: 7, step }).t.data().to_vec();
        assert_eq!(at(3, &rays())[64..128], at(3, &rays()[..2])[64..]);
        assert_ne!(at(3, &rays()), at(4, &rays()));
        assert_ne!(at(3, &rays())[..64], at(3, &rays())[64..128]);
        let within: Vec<f64> = (0..200).flat_map(|step| at(step, &rays())).map(|t| (t - 2.5) / 5.0 * 64.0 % 1.0).collect();
        let mean = within.iter().sum::<f64>() / within.len() as f64;
        // 38 400 uniform numbers: three standard deviations are 0.0044.
        assert!((mean - 0.5).abs() < 4.4e-3, "{mean}");
    }
}
