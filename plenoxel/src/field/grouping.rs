//! Groups of samples with one evaluation of the color network each.

use crate::random::{Purpose, uniform};
use crate::sampling::Jitter;
use autograd::{Buffer, Indices, Real, Tensor};
use std::ops::Range;

/// At which positions of a ray the color network is evaluated. Consecutive samples of a ray form a group as soon as their weights sum to `weight`. The network is
/// evaluated at one position of each group: an approximation of the color of each sample, exact for a `weight` of 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grouping {
    /// Weight that completes a group; 0 for groups of one sample.
    pub weight: f64,
    /// Groups whose weight is not above this have no color.
    pub above: f64,
    /// True: the position is the mean of those of the members, weighted by their weights, which are constants for gradients, and all members have its color. A
    /// group whose weight is above `above` also ends at a gap between samples, and when it has [`MOST_MEMBERS`]. False: it is the position of one member,
    /// which is drawn with a probability proportional to its weight; without jitter, it is the member at half the weight. The colors of the samples between
    /// two drawn members are interpolated, linearly in the distance t along the ray.
    pub compact: bool,
}

/// Number of samples with which a compact group ends.
pub const MOST_MEMBERS: usize = 8;

/// Groups of the samples of some rays. Sample i has the color (1 − sᵢ) c_g + sᵢ c_{g+1} with g = `of[i]` and sᵢ = `toward_next[i]`.
#[derive(Debug)]
pub(crate) struct Groups<T: Real> {
    /// Number g of the group whose color a sample has, or the first of two; [`NO_COLOR`] for no color.
    pub of: Buffer<u32>,
    /// Share sᵢ of the color of the next group; 0 for the color of one group.
    pub toward_next: Buffer<T>,
    /// Samples whose mean position is that of the group: all members, or the one that was drawn.
    pub sources: Vec<Range<u32>>,
    /// Number of the ray of each group.
    pub rays: Vec<u32>,
}

/// Marker for a sample without a color.
pub(crate) const NO_COLOR: u32 = u32::MAX;

impl<T: Real> Groups<T> {
    /// Returns groups of no samples.
    pub fn empty() -> Self {
        Groups { of: Buffer::stale(0), toward_next: Buffer::stale(0), sources: Vec::new(), rays: Vec::new() }
    }

    /// Returns the number of groups.
    pub fn len(&self) -> usize {
        self.sources.len()
    }

    /// Returns the sources of all groups: the number of the group, that of the sample, and the share of the sample in the position of the group.
    pub fn shares<'a>(&'a self, weights: &'a [T]) -> impl Iterator<Item = (usize, usize, T)> {
        self.sources.iter().enumerate().flat_map(move |(group, sources)| {
            let sources = sources.start as usize..sources.end as usize;
            let sum: T = weights[sources.clone()].iter().copied().sum();
            sources.map(move |i| (group, i, weights[i] / sum))
        })
    }

    /// Returns the positions of the groups, `[g, 3]`, from those of the samples, `[m, 3]`.
    pub fn positions(&self, weights: &[T], positions: &Tensor<T>) -> Tensor<T> {
        if self.sources.iter().all(|sources| sources.len() == 1) {
            return positions.gather_rows(&Indices::from(self.sources.iter().map(|sources| sources.start).collect::<Vec<_>>()));
        }
        let (mut groups, mut samples, mut shares) = (Vec::new(), Vec::new(), Vec::new());
        for (group, sample, share) in self.shares(weights) {
            groups.push(group as u32);
            samples.push(sample as u32);
            shares.push(share);
        }
        let shares = Tensor::from_vec(shares, &[samples.len(), 1]);
        (positions.gather_rows(&Indices::from(samples)) * shares).scatter_rows(&Indices::from(groups), self.len())
    }

    /// Returns the colors of the samples, `[m, 3]`, from those of the groups, `[g, 3]`.
    pub fn colors_of_samples(&self, colors: &Tensor<T>) -> Tensor<T> {
        let colored: Vec<u32> = (0..self.of.len() as u32).filter(|&i| self.of[i as usize] != NO_COLOR).collect();
        let first: Vec<u32> = colored.iter().map(|&i| self.of[i as usize]).collect();
        let toward_next: Vec<T> = colored.iter().map(|&i| self.toward_next[i as usize]).collect();
        let colors = if toward_next.iter().any(|&share| share > T::zero()) {
            let last = self.len() as u32 - 1;
            let next = Indices::from(first.iter().map(|&group| last.min(group + 1)).collect::<Vec<_>>());
            let first = colors.gather_rows(&Indices::from(first));
            &first + (colors.gather_rows(&next) - &first) * Tensor::from_vec(toward_next, &[colored.len(), 1])
        } else if colored.len() == self.len() {
            // Groups of one sample are in the order of the samples.
            colors.clone()
        } else {
            colors.gather_rows(&Indices::from(first))
        };
        colors.scatter_rows(&Indices::from(colored), self.of.len())
    }

    /// Returns the color of a sample from those of the groups.
    #[inline(always)]
    pub fn color(&self, colors: &[[T; 3]], i: usize) -> [T; 3] {
        let (group, share) = (self.of[i] as usize, self.toward_next[i]);
        let Some(&first) = colors.get(group) else { return [T::zero(); 3] };
        if share == T::zero() {
            return first;
        }
        let next = colors[group + 1];
        [0, 1, 2].map(|c| first[c] + share * (next[c] - first[c]))
    }

    /// Adds the cotangent g of the color of a sample to the cotangents of the colors of its groups.
    #[inline(always)]
    pub fn add_cotangent(&self, of_groups: &mut [[T; 3]], i: usize, g: [T; 3]) {
        let (group, share) = (self.of[i] as usize, self.toward_next[i]);
        if group == NO_COLOR as usize {
            return;
        }
        if share == T::zero() {
            (0..3).for_each(|c| of_groups[group][c] += g[c]);
            return;
        }
        (0..3).for_each(|c| {
            of_groups[group][c] += (T::one() - share) * g[c];
            of_groups[group + 1][c] += share * g[c];
        });
    }

    /// Interpolates the colors of the samples `own` of a ray, whose groups from `first` on have one source each.
    fn interpolate(&mut self, own: Range<usize>, first: usize, t: &[T]) {
        let source = |group: usize| self.sources[group].start as usize;
        for i in own {
            let group = self.of[i] as usize;
            if group == NO_COLOR as usize {
                continue;
            }
            // The first group whose source is behind the sample. There is none in front of the first source, and none behind the last.
            let behind = group + usize::from(i >= source(group));
            if behind == first || behind == self.sources.len() {
                continue;
            }
            let front = behind - 1;
            self.of[i] = front as u32;
            let (from, to) = (t[source(front)], t[source(behind)]);
            // Distances may be equal after rounding.
            self.toward_next[i] = if to > from { ((t[i] - from) / (to - from)).max(T::zero()).min(T::one()) } else { T::zero() };
        }
    }
}

impl Grouping {
    /// Every sample has its own color.
    pub const NONE: Grouping = Grouping { weight: 0.0, above: 0.0, compact: false };

    /// Forms the groups of rays from the weights, distances t and lengths of their samples. Ray r owns the samples `offsets[r]..offsets[r + 1]`; it has the number
    /// `first` + r, which determines its random numbers.
    pub(crate) fn groups<T: Real>(self, weights: &[T], [t, delta]: [&[T]; 2], offsets: &[u32], first: usize, jitter: Jitter) -> Groups<T> {
        /// Distance of the middles of two intervals that touch, relative to the sum of their lengths, up to rounding.
        const TOUCHING: f64 = 0.51;
        let (limit, above, touching) = (T::lit(self.weight), T::lit(self.above), T::lit(TOUCHING));
        let mut groups = Groups { of: Buffer::stale(weights.len()), toward_next: Buffer::zeros(weights.len()), ..Groups::empty() };
        for (r, own) in offsets.windows(2).enumerate() {
            let (start, end) = (own[0] as usize, own[1] as usize);
            let mut draws = Draws { jitter, ray: first + r, drawn: 0 };
            let (mut begin, mut sum) = (start, T::zero());
            let before = groups.len();
            for i in start..end {
                sum += weights[i];
                let next = i + 1;
                let ends = || next - begin >= MOST_MEMBERS || t[next] - t[i] > touching * (delta[next] + delta[i]);
                if sum < limit && next < end && !(self.compact && sum > above && ends()) {
                    continue;
                }
                let members = begin..next;
                let number = if sum > above {
                    let own = if self.compact { members.clone() } else { draws.member(&weights[members.clone()], sum, begin) };
                    groups.sources.push(own.start as u32..own.end as u32);
                    groups.rays.push((first + r) as u32);
                    groups.len() as u32 - 1
                } else {
                    NO_COLOR
                };
                groups.of[members].fill(number);
                (begin, sum) = (next, T::zero());
            }
            if !self.compact {
                groups.interpolate(start..end, before, t);
            }
        }
        groups
    }
}

/// Random numbers of a ray.
struct Draws {
    jitter: Jitter,
    ray: usize,
    drawn: u64,
}

impl Draws {
    /// Draws one of the samples from `first` on with a probability proportional to its weight.
    fn member<T: Real>(&mut self, weights: &[T], sum: T, first: usize) -> Range<usize> {
        let mut rest = T::lit(self.next()) * sum;
        let drawn = weights.iter().position(|&weight| {
            rest -= weight;
            rest < T::zero()
        });
        // Rounding may leave a rest.
        let drawn = drawn.or_else(|| weights.iter().rposition(|&weight| weight > T::zero())).unwrap_or(0);
        first + drawn..first + drawn + 1
    }

    fn next(&mut self) -> f64 {
        self.drawn += 1;
        match self.jitter {
            Jitter::None => 0.5,
            Jitter::PerRay { seed, step } => uniform(seed, Purpose::Shade, step, (self.ray as u64) << 16 | self.drawn),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Ray;
    use crate::geometry::Aabb;
    use crate::sampling::{Spacing, sample};
    use glam::DVec3;

    /// Groups of two rays without jitter, the first with `weights` at unit distances but for a gap before sample 5, the second with the last of the `weights`.
    fn groups(grouping: Grouping, weights: &[f64]) -> Groups<f64> {
        let n = weights.len();
        let t: Vec<f64> = (0..n).map(|i| if i < 5 { i as f64 } else { i as f64 + 1.0 }).collect();
        grouping.groups(weights, [&t, &vec![1.0; n]], &[0, n as u32 - 1, n as u32], 7, Jitter::None)
    }

    #[test]
    fn compact_groups_end_at_gaps_and_when_they_have_many_members() {
        let weights = [0.1, 0.1, 0.2, 0.05, 0.01, 0.1, 0.01, 0.2];
        let found = groups(Grouping { weight: 0.15, above: 0.02, compact: true }, &weights);
        assert_eq!(found.sources, [0..2, 2..3, 3..5, 5..7, 7..8]);
        assert_eq!(found.of[..], [0, 0, 1, 2, 2, 3, 3, 4]);
        assert_eq!(found.rays, [7, 7, 7, 7, 8]);
        // A group that would have no color goes on.
        assert_eq!(groups(Grouping { weight: 0.3, above: 0.07, compact: true }, &weights).sources, [0..3, 3..7, 7..8]);
        let fog = groups(Grouping { weight: 0.5, above: 0.0, compact: true }, &[1e-3; 25]);
        let lengths: Vec<usize> = fog.sources.iter().map(Range::len).collect();
        assert_eq!(lengths, [5, 8, 8, 3, 1]);
        assert_eq!(groups(Grouping::NONE, &weights).sources.len(), weights.len());
    }

    #[test]
    fn other_groups_end_with_their_weight_and_colors_between_their_drawn_members_are_interpolated() {
        let weights = [0.1, 0.1, 0.2, 0.05, 0.01, 0.1, 0.01, 0.2];
        let found = groups(Grouping { weight: 0.15, above: 0.02, compact: false }, &weights);
        assert_eq!(found.sources, [1..2, 2..3, 5..6, 7..8]);
        assert_eq!(found.of[..], [0, 0, 1, 1, 1, 2, NO_COLOR, 3]);
        assert_eq!(found.toward_next[..], [0.0, 0.0, 0.0, 0.25, 0.5, 0.0, 0.0, 0.0]);
        let colors = Tensor::from_vec((0..12).map(|k| (k * k) as f64).collect(), &[4, 3]);
        let rows = colors.data().as_chunks::<3>().0;
        let of_samples = found.colors_of_samples(&colors);
        assert_eq!(of_samples.data()[9..12], [0.75 * 9.0 + 0.25 * 36.0, 0.75 * 16.0 + 0.25 * 49.0, 0.75 * 25.0 + 0.25 * 64.0]);
        // Both forms of the colors agree, and the adjoint is the transpose: ⟨g, C c⟩ = ⟨Cᵀ g, c⟩.
        let (mut product, mut of_groups) = (0.0, [[0.0; 3]; 4]);
        for (i, want) in of_samples.data().as_chunks::<3>().0.iter().enumerate() {
            assert_eq!(found.color(rows, i), *want);
            let g = [0, 1, 2].map(|c| (7 * i + c + 1) as f64);
            product += (0..3).map(|c| g[c] * want[c]).sum::<f64>();
            found.add_cotangent(&mut of_groups, i, g);
        }
        let transposed: f64 = of_groups.as_flattened().iter().zip(colors.data()).map(|(g, c)| g * c).sum();
        assert!((product - transposed).abs() < 1e-9 * product.abs(), "{product}, {transposed}");
        // With jitter, a member is drawn as often as its weight says.
        let grouping = Grouping { weight: 0.5, above: 0.0, compact: false };
        let drawn = |step: u64| {
            let jitter = Jitter::PerRay { seed: 3, step };
            grouping.groups(&[0.1, 0.3, 0.1], [&[0.0, 1.0, 2.0], &[1.0; 3]], &[0, 3], 0, jitter).sources[0].start
        };
        const DRAWS: u64 = 4000;
        let share = (0..DRAWS).filter(|&step| drawn(step) == 1).count() as f64 / DRAWS as f64;
        // Four standard deviations, with the seed above.
        assert!((share - 0.6).abs() < 4.0 * (0.24 / DRAWS as f64).sqrt(), "{share}");
    }

    #[test]
    fn positions_are_those_of_the_matter_and_colors_return_to_the_members() {
        let weights = [0.1, 0.3, 0.0, 0.2];
        let found = groups(Grouping { weight: 0.4, above: 0.0, compact: true }, &weights);
        assert_eq!(found.sources, [0..2, 3..4]);
        let positions = Tensor::from_vec(vec![0.0, 4.0, 8.0, 4.0, 4.0, 0.0, 9.0, 9.0, 9.0, 1.0, 2.0, 3.0], &[4, 3]);
        let means = found.positions(&weights, &positions);
        let want = [3.0, 4.0, 2.0, 1.0, 2.0, 3.0];
        assert!(means.data().iter().zip(want).all(|(a, b): (&f64, f64)| (a - b).abs() < 1e-12));
        let colors = found.colors_of_samples(&Tensor::from_vec(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], &[2, 3]));
        assert_eq!(colors.data(), [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    fn jitter_makes_no_gaps() {
        let ray = Ray { origin: DVec3::new(-0.3, 0.2, 4.0), direction: DVec3::new(0.1, -0.05, -1.0).normalize(), stretch: 1.0 };
        for spacing in [Spacing::Step(0.05), Spacing::Contracted(0.05)] {
            for step in 0..50 {
                let jitter = Jitter::PerRay { seed: 5, step };
                let samples = sample::<f32>(&[ray], &Aabb::cube(1.5), spacing, jitter, None);
                let weights = vec![1e-6; samples.len()];
                let grouping = Grouping { weight: 0.5, above: 0.0, compact: true };
                let groups = grouping.groups(&weights, [samples.t.data(), samples.delta.data()], &samples.offsets, 0, jitter);
                let (_, full) = groups.sources.split_last().expect("samples");
                assert!(full.len() > 4 && full.iter().all(|sources| sources.len() == MOST_MEMBERS), "{spacing:?}, {step}");
            }
        }
    }
}
