//! Groups of samples that share a color, so that a color network is evaluated less often.

use crate::random::{Purpose, uniform};
use crate::sampling::Jitter;
use autograd::{Buffer, Indices, Real, Tensor};
use std::ops::Range;

/// Which samples have their own color. Consecutive samples of a ray form a group as soon as their weights sum to `weight`. The color network is evaluated at one
/// position of the group, and gives its color to all members.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grouping {
    /// Weight that completes a group; 0 for groups of one sample.
    pub weight: f64,
    /// Groups whose weight is not above this have no color.
    pub above: f64,
    /// True: the position is the mean of those of the members, weighted by their weights, which are constants for gradients; a group whose weight is above
    /// `above` also ends at a gap between samples and with [`MOST`] members. False: it is the position of one member, which is drawn with a probability
    /// proportional to its weight, so that the expected color of a pixel does not change. Without jitter, the member at half the weight is chosen.
    pub compact: bool,
}

/// Largest number of samples in a compact group.
pub const MOST: usize = 8;

/// Groups of the samples of some rays.
#[derive(Debug)]
pub(crate) struct Groups {
    /// Number of the group of each sample, or [`Groups::NONE`].
    pub of: Buffer<u32>,
    /// Samples of each group at whose mean position the color network is evaluated: all or one.
    pub shaded: Vec<Range<u32>>,
    /// Number of the ray of each group.
    pub rays: Vec<u32>,
}

impl Groups {
    /// Marker for a sample without a color.
    pub const NONE: u32 = u32::MAX;

    /// Returns all shaded samples: the number of the group, that of the sample, and the share of the sample in the position of the group.
    pub fn shares<'a, T: Real>(&'a self, weights: &'a [T]) -> impl Iterator<Item = (usize, usize, T)> {
        self.shaded.iter().enumerate().flat_map(move |(group, shaded)| {
            let members = shaded.start as usize..shaded.end as usize;
            let sum: T = weights[members.clone()].iter().copied().sum();
            members.map(move |i| (group, i, weights[i] / sum))
        })
    }

    /// Returns the mean positions of the groups, `[g, 3]`, from those of the samples, `[m, 3]`.
    pub fn mean_positions<T: Real>(&self, weights: &[T], positions: &Tensor<T>) -> Tensor<T> {
        let (mut groups, mut samples, mut shares) = (Vec::new(), Vec::new(), Vec::new());
        for (group, sample, share) in self.shares(weights) {
            groups.push(group as u32);
            samples.push(sample as u32);
            shares.push(share);
        }
        let shares = Tensor::from_vec(shares, &[samples.len(), 1]);
        (positions.gather_rows(&Indices::from(samples)) * shares).scatter_rows(&Indices::from(groups), self.shaded.len())
    }

    /// Returns the colors of the samples, `[m, 3]`, from those of the groups, `[g, 3]`.
    pub fn colors_of_samples<T: Real>(&self, colors: &Tensor<T>) -> Tensor<T> {
        let members = self.of.iter().zip(0u32..).filter(|(group, _)| **group != Groups::NONE);
        let (groups, colored): (Vec<u32>, Vec<u32>) = members.unzip();
        colors.gather_rows(&Indices::from(groups)).scatter_rows(&Indices::from(colored), self.of.len())
    }
}

impl Grouping {
    /// Every sample has its own color.
    pub const NONE: Grouping = Grouping { weight: 0.0, above: 0.0, compact: false };

    /// Forms the groups of rays from the weights, distances t and lengths of their samples. Ray r owns the samples `offsets[r]..offsets[r + 1]`; it has the number
    /// `first` + r, which determines its random numbers.
    pub(crate) fn groups<T: Real>(self, weights: &[T], [t, delta]: [&[T]; 2], offsets: &[u32], first: usize, jitter: Jitter) -> Groups {
        /// Distance of the middles of two intervals that touch, relative to the sum of their lengths, up to rounding.
        const TOUCHING: f64 = 0.51;
        let (limit, above, touching) = (T::lit(self.weight), T::lit(self.above), T::lit(TOUCHING));
        let mut of = Buffer::stale(weights.len());
        let (mut shaded, mut rays) = (Vec::new(), Vec::new());
        for (r, own) in offsets.windows(2).enumerate() {
            let (start, end) = (own[0] as usize, own[1] as usize);
            let mut draws = Draws { jitter, ray: first + r, drawn: 0 };
            let (mut begin, mut sum) = (start, T::zero());
            for i in start..end {
                sum += weights[i];
                let next = i + 1;
                let ends = || next - begin >= MOST || t[next] - t[i] > touching * (delta[next] + delta[i]);
                if sum < limit && next < end && !(self.compact && sum > above && ends()) {
                    continue;
                }
                let members = begin..next;
                let number = if sum > above {
                    let from = if self.compact { members.clone() } else { draws.member(&weights[members.clone()], sum, begin) };
                    shaded.push(from.start as u32..from.end as u32);
                    rays.push((first + r) as u32);
                    shaded.len() as u32 - 1
                } else {
                    Groups::NONE
                };
                of[members].fill(number);
                (begin, sum) = (next, T::zero());
            }
        }
        Groups { of, shaded, rays }
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

    /// Groups of two rays without jitter, the first with `weights` at unit distances but for a gap before sample 5, the second with the last of the `weights`.
    fn groups(grouping: Grouping, weights: &[f64]) -> Groups {
        let n = weights.len();
        let t: Vec<f64> = (0..n).map(|i| if i < 5 { i as f64 } else { i as f64 + 1.0 }).collect();
        grouping.groups(weights, [&t, &vec![1.0; n]], &[0, n as u32 - 1, n as u32], 7, Jitter::None)
    }

    #[test]
    fn compact_groups_end_at_gaps_and_when_they_have_many_members() {
        let weights = [0.1, 0.1, 0.2, 0.05, 0.01, 0.1, 0.01, 0.2];
        let found = groups(Grouping { weight: 0.15, above: 0.02, compact: true }, &weights);
        assert_eq!(found.shaded, [0..2, 2..3, 3..5, 5..7, 7..8]);
        assert_eq!(found.of[..], [0, 0, 1, 2, 2, 3, 3, 4]);
        assert_eq!(found.rays, [7, 7, 7, 7, 8]);
        // A group that would have no color goes on.
        assert_eq!(groups(Grouping { weight: 0.3, above: 0.07, compact: true }, &weights).shaded, [0..3, 3..7, 7..8]);
        let fog = groups(Grouping { weight: 0.5, above: 0.0, compact: true }, &[1e-3; 25]);
        let lengths: Vec<usize> = fog.shaded.iter().map(Range::len).collect();
        assert_eq!(lengths, [5, 8, 8, 3, 1]);
        assert_eq!(groups(Grouping::NONE, &weights).shaded.len(), weights.len());
    }

    #[test]
    fn other_groups_end_with_their_weight_and_have_the_position_of_one_member() {
        let weights = [0.1, 0.1, 0.2, 0.05, 0.01, 0.1, 0.01, 0.2];
        let found = groups(Grouping { weight: 0.15, above: 0.02, compact: false }, &weights);
        assert_eq!(found.shaded, [1..2, 2..3, 5..6, 7..8]);
        assert_eq!(found.of[..], [0, 0, 1, 2, 2, 2, Groups::NONE, 3]);
        // With jitter, a member is drawn as often as its weight says.
        let grouping = Grouping { weight: 0.5, above: 0.0, compact: false };
        let drawn = |step: u64| {
            let jitter = Jitter::PerRay { seed: 3, step };
            grouping.groups(&[0.1, 0.3, 0.1], [&[0.0, 1.0, 2.0], &[1.0; 3]], &[0, 3], 0, jitter).shaded[0].start
        };
        const DRAWS: u64 = 4000;
        let share = (0..DRAWS).filter(|&step| drawn(step) == 1).count() as f64 / DRAWS as f64;
        // Four standard deviations, with the seed above.
        assert!((share - 0.6).abs() < 4.0 * (0.24 / DRAWS as f64).sqrt(), "{share}");
    }

    #[test]
    fn mean_positions_are_those_of_the_matter_and_colors_return_to_the_members() {
        let weights = [0.1, 0.3, 0.0, 0.2];
        let found = groups(Grouping { weight: 0.4, above: 0.0, compact: true }, &weights);
        assert_eq!(found.shaded, [0..2, 3..4]);
        let positions = Tensor::from_vec(vec![0.0, 4.0, 8.0, 4.0, 4.0, 0.0, 9.0, 9.0, 9.0, 1.0, 2.0, 3.0], &[4, 3]);
        let means = found.mean_positions(&weights, &positions);
        let want = [3.0, 4.0, 2.0, 1.0, 2.0, 3.0];
        assert!(means.data().iter().zip(want).all(|(a, b): (&f64, f64)| (a - b).abs() < 1e-12));
        let colors = found.colors_of_samples(&Tensor::from_vec(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], &[2, 3]));
        assert_eq!(colors.data(), [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 4.0, 5.0, 6.0]);
    }
}
