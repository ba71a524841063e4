//! Random numbers as a function of (seed, purpose, step, index). They do not depend on threads or on earlier draws, so a run can be resumed
//! at any step, and any number of threads draws the same numbers.
//!
//! The crate draws for its own [`Purpose`]s. Custom losses and programs draw from a [`Stream`] with their own name. A step that is taken
//! again, for example after resuming, draws the same numbers:
//!
//! ```
//! use plenoxel::model::plenoxels::Objective;
//! use plenoxel::random::Stream;
//!
//! // Opacities are pulled towards 0 on a random tenth of the rays.
//! let objective = Objective::<f64>::new().with("thin", 0.1, |step| {
//!     let stream = Stream::new(step.seed).named("thin").numbered(step.number);
//!     let rays = (0..step.batch.len() as u64).map(|ray| f64::from(stream.uniform(ray) < 0.1)).collect();
//!     let chosen = autograd::Tensor::from_vec(rays, &[step.batch.len()]);
//!     (&step.rendered.opacity * &chosen).mean()
//! });
//! ```

pub use autograd::random::Stream;

/// Purpose of a random number. Different purposes are independent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Order of the training rays within an epoch.
    RayOrder = 1,
    /// Offset of a ray's samples.
    Jitter = 2,
    /// Initial values of a grid.
    Initial = 3,
    /// Cells on which a regulariser is evaluated.
    Cells = 4,
    /// Random patches of pixels.
    Patches = 5,
    /// Samples at which the color network of a factored field is evaluated.
    Shade = 6,
    /// Samples that are drawn where an earlier pass found matter.
    Importance = 7,
    /// Noise of the density.
    Noise = 8,
    /// Which small gradients are used.
    GradientPruning = 9,
}

/// Returns 64 random bits for (seed, purpose, step, index).
pub fn bits(seed: u64, purpose: Purpose, step: u64, index: u64) -> u64 {
    stream(seed, purpose, step, index).bits(0)
}

/// Returns a uniform random number in [0, 1) for (seed, purpose, step, index).
pub fn uniform(seed: u64, purpose: Purpose, step: u64, index: u64) -> f64 {
    stream(seed, purpose, step, index).uniform(0)
}

/// Returns the stream whose first number is that of (seed, purpose, step, index).
pub(crate) fn stream(seed: u64, purpose: Purpose, step: u64, index: u64) -> Stream {
    Stream::new(mix(mix(seed ^ (purpose as u64) << 56) ^ step) ^ mix(index))
}

/// Returns the first output of SplitMix64 with seed x.
fn mix(x: u64) -> u64 {
    Stream::new(x).bits(0)
}

/// Pseudorandom permutation of 0..n without a table: a four-round Feistel network on the next even number of bits, iterated until the
/// result is below n (cycle walking, Black and Rogaway 2002).
#[derive(Clone, Copy, Debug)]
pub struct Permutation {
    n: u64,
    half_bits: u32,
    keys: [u64; 4],
}

impl Permutation {
    /// Creates the permutation of 0..n for (seed, purpose, epoch).
    pub fn new(n: u64, seed: u64, purpose: Purpose, epoch: u64) -> Self {
        let half_bits = (64 - n.saturating_sub(1).leading_zeros()).div_ceil(2).max(1);
        Permutation { n, half_bits, keys: [0, 1, 2, 3].map(|round| bits(seed, purpose, epoch, round)) }
    }

    /// Returns the image of `i`. Panics if `i` is not below n.
    pub fn at(&self, i: u64) -> u64 {
        assert!(i < self.n, "permutation: index {i} is out of range for length {}", self.n);
        let mask = (1u64 << self.half_bits) - 1;
        let mut x = i;
        loop {
            let (mut left, mut right) = (x >> self.half_bits, x & mask);
            for key in self.keys {
                (left, right) = (right, left ^ (mix(right ^ key) & mask));
            }
            x = left << self.half_bits | right;
            if x < self.n {
                return x;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_permutation_visits_everything_once() {
        for n in [1u64, 2, 3, 17, 1000, 4097] {
            let p = Permutation::new(n, 42, Purpose::RayOrder, 3);
            let mut seen = vec![false; n as usize];
            for i in 0..n {
                assert!(!std::mem::replace(&mut seen[p.at(i) as usize], true), "n = {n}: {i} collides");
            }
        }
    }

    #[test]
    fn numbers_are_spread_over_the_unit_interval_and_differ_by_purpose() {
        let mut tenths = [0; 10];
        for i in 0..10_000 {
            tenths[(uniform(1, Purpose::Jitter, 5, i) * 10.0) as usize] += 1;
        }
        // 1000 expected in each, standard deviation 30.
        assert!(tenths.iter().all(|&n| (850..1150).contains(&n)), "{tenths:?}");
        assert_ne!(bits(1, Purpose::Jitter, 5, 0), bits(1, Purpose::Initial, 5, 0));
    }

    /// Changing these numbers would make runs irreproducible.
    #[test]
    fn numbers_have_these_bits() {
        const DRAWN: u64 = 0xb0b6_95b7_8e9c_e144;
        assert_eq!(bits(1, Purpose::Jitter, 5, 0), DRAWN);
        assert_eq!(uniform(1, Purpose::Jitter, 5, 0), (DRAWN >> 11) as f64 / (1u64 << 53) as f64);
    }
}
