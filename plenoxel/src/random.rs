//! Random numbers as a function of what they are for: (seed, purpose, step, index), never of threads or of how many were drawn before.
//! So a run can be cut anywhere and resumed, and any number of threads draws the same numbers.
//!
//! The crate draws for its own [`Purpose`]s; a loss or a program of one's own draws from a [`Stream`] with a name of its own.

use std::f64::consts::TAU;

/// What a number is drawn for; different purposes are independent.
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
    /// Squares of neighbouring pixels.
    Patches = 5,
}

/// 64 random bits for (seed, purpose, step, index).
pub fn bits(seed: u64, purpose: Purpose, step: u64, index: u64) -> u64 {
    let key = mix(mix(seed ^ (purpose as u64) << 56) ^ step);
    mix(key ^ mix(index))
}

/// A uniform number in [0, 1) for (seed, purpose, step, index).
pub fn uniform(seed: u64, purpose: Purpose, step: u64, index: u64) -> f64 {
    unit(bits(seed, purpose, step, index))
}

/// A stream of random numbers with a name: a function of (seed, name, step, index), independent of what the crate draws and of streams with
/// other names or seeds.
///
/// A loss draws the same numbers whenever a step is taken again, as after a resumed run:
///
/// ```
/// use plenoxel::loss::{Objective, Step};
/// use plenoxel::random::Stream;
///
/// // Opacities are pulled towards 0 on a random tenth of the rays.
/// let objective = Objective::<f64>::new().with("thin", 0.1, |step: &Step<f64>| {
///     let stream = Stream::new(step.seed, "thin");
///     let rays = (0..step.batch.len() as u64).map(|ray| f64::from(stream.uniform(step.number, ray) < 0.1)).collect();
///     let chosen = autograd::Tensor::from_vec(rays, &[step.batch.len()]);
///     (&step.rendered.opacity * &chosen).mean()
/// });
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stream {
    key: u64,
}

impl Stream {
    /// The stream of a seed and a name. The name counts by its 64-bit FNV-1a hash (Fowler, Noll and Vo).
    pub fn new(seed: u64, name: &str) -> Self {
        let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash: u64, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3));
        Stream { key: mix(mix(seed) ^ hash) }
    }

    /// 64 random bits for (step, index).
    pub fn bits(&self, step: u64, index: u64) -> u64 {
        mix(mix(self.key ^ step) ^ mix(index))
    }

    /// A uniform number in [0, 1) for (step, index), made of [`bits`](Self::bits).
    pub fn uniform(&self, step: u64, index: u64) -> f64 {
        unit(self.bits(step, index))
    }

    /// A standard normal number for (step, index), of mean 0 and variance 1: √(−2 ln u) cos 2πv (Box and Muller 1958), with u in (0, 1] from
    /// [`bits`](Self::bits), so that it depends on [`uniform`](Self::uniform) of the same (step, index), and v from a hash of them.
    pub fn normal(&self, step: u64, index: u64) -> f64 {
        let bits = self.bits(step, index);
        (-2.0 * (1.0 - unit(bits)).ln()).sqrt() * (TAU * unit(mix(bits))).cos()
    }
}

/// The number in [0, 1) that the upper 53 of 64 bits are as a binary fraction.
fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
}

/// Stafford's variant 13 of the MurmurHash3 finaliser, as in SplitMix64.
fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// A permutation of 0..n that needs no memory: a four-round Feistel network on the next even number of bits, walked until it lands
/// inside (Black and Rogaway 2002).
#[derive(Clone, Copy, Debug)]
pub struct Permutation {
    n: u64,
    half_bits: u32,
    keys: [u64; 4],
}

impl Permutation {
    /// The permutation of 0..n for (seed, purpose, epoch).
    pub fn new(n: u64, seed: u64, purpose: Purpose, epoch: u64) -> Self {
        let half_bits = (64 - n.saturating_sub(1).leading_zeros()).div_ceil(2).max(1);
        Permutation { n, half_bits, keys: [0, 1, 2, 3].map(|round| bits(seed, purpose, epoch, round)) }
    }

    /// Where `i` goes. Panics if `i` is not below n.
    pub fn at(&self, i: u64) -> u64 {
        assert!(i < self.n, "permutation of {} asked for {i}", self.n);
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

    #[test]
    fn streams_differ_by_seed_name_step_and_index_and_repeat_themselves() {
        // Of "a" the published FNV-1a hash.
        assert_eq!(Stream::new(3, "a").key, mix(mix(3) ^ 0xaf63_dc4c_8601_ec8c));
        let of = |seed, name, step, index| Stream::new(seed, name).bits(step, index);
        let first = of(3, "my loss", 4, 5);
        assert_eq!(of(3, "my loss", 4, 5), first);
        for other in
            [of(4, "my loss", 4, 5), of(3, "my lost", 4, 5), of(3, "my loss", 5, 5), of(3, "my loss", 4, 6), of(3, "my loss", 5, 4)]
        {
            assert_ne!(other, first);
        }
        for purpose in [Purpose::RayOrder, Purpose::Jitter, Purpose::Initial, Purpose::Cells, Purpose::Patches] {
            assert_ne!(bits(3, purpose, 4, 5), first);
        }
    }

    #[test]
    fn uniform_and_normal_numbers_have_the_moments_of_their_distributions() {
        let stream = Stream::new(1, "moments");
        const N: u64 = 100_000;
        let mean = |of: &dyn Fn(u64) -> f64| (0..N).map(of).sum::<f64>() / N as f64;
        // Five standard deviations of such means: √(1/12), 1, √2 and √96 each divided by √N.
        let expect = |what: &str, found: f64, expected: f64, deviation: f64| {
            assert!((found - expected).abs() < 5.0 * deviation / (N as f64).sqrt(), "{what}: {found}");
        };
        expect("uniform", mean(&|i| stream.uniform(7, i)), 0.5, (1.0 / 12.0f64).sqrt());
        expect("normal", mean(&|i| stream.normal(7, i)), 0.0, 1.0);
        expect("its square", mean(&|i| stream.normal(7, i).powi(2)), 1.0, 2f64.sqrt());
        expect("its fourth power", mean(&|i| stream.normal(7, i).powi(4)), 3.0, 96f64.sqrt());
        expect("neighbours", mean(&|i| stream.normal(7, i) * stream.normal(7, i + 1)), 0.0, 1.0);
        expect("steps", mean(&|i| stream.normal(7, i) * stream.normal(8, i)), 0.0, 1.0);
    }
}
