//! Groups of samples that share a color, so that a color network is evaluated less often.

use crate::random::{Purpose, uniform};
use crate::sampling::Jitter;
use autograd::{Buffer, Real};

/// Which samples have their own color. Consecutive samples of a ray form a group as soon as their weights sum to `weight`; the color
/// network is evaluated at one member, chosen at random with probability proportional to its weight, and gives its color to the group. The
/// expected color of a pixel does not change. Without jitter, the member at half the weight is chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grouping {
    /// Weight that completes a group; 0 for groups of one sample.
    pub weight: f64,
    /// Groups whose weight is not above this have no color.
    pub above: f64,
}

/// Groups of the samples of some rays.
#[derive(Debug)]
pub(crate) struct Groups {
    /// Number of the group of each sample, or [`Groups::NONE`].
    pub of: Buffer<u32>,
    /// Sample of each group at which the color network is evaluated.
    pub shaded: Vec<u32>,
    /// Number of the ray of each group.
    pub rays: Vec<u32>,
}

impl Groups {
    /// Marker for a sample without a color.
    pub const NONE: u32 = u32::MAX;
}

impl Grouping {
    /// Every sample has its own color.
    pub const NONE: Grouping = Grouping { weight: 0.0, above: 0.0 };

    /// Forms the groups of rays and chooses their members. Ray r owns the entries `offsets[r]..offsets[r + 1]` of `weights`; it has the number `first` + r,
    /// which determines its random numbers.
    pub(crate) fn groups<T: Real>(self, weights: &[T], offsets: &[u32], first: usize, jitter: Jitter) -> Groups {
        let (limit, above) = (T::lit(self.weight), T::lit(self.above));
        let mut of = Buffer::stale(weights.len());
        let (mut shaded, mut rays) = (Vec::new(), Vec::new());
        for (r, own) in offsets.windows(2).enumerate() {
            let (start, end) = (own[0] as usize, own[1] as usize);
            let mut draws = Draws { jitter, ray: first + r, drawn: 0 };
            let (mut begin, mut sum) = (start, T::zero());
            for i in start..end {
                sum += weights[i];
                if sum < limit && i + 1 < end {
                    continue;
                }
                let members = begin..i + 1;
                let number = if sum > above {
                    let mut rest = T::lit(draws.next()) * sum;
                    let chosen = members.clone().find(|&k| {
                        rest -= weights[k];
                        rest < T::zero()
                    });
                    shaded.push(chosen.unwrap_or(i) as u32);
                    rays.push((first + r) as u32);
                    shaded.len() as u32 - 1
                } else {
                    Groups::NONE
                };
                of[members].fill(number);
                (begin, sum) = (i + 1, T::zero());
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
    fn next(&mut self) -> f64 {
        self.drawn += 1;
        match self.jitter {
            Jitter::None => 0.5,
            Jitter::PerRay { seed, step } => uniform(seed, Purpose::Shade, step, (self.ray as u64) << 16 | self.drawn),
        }
    }
}
