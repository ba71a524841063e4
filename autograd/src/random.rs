//! Random numbers as a function of (seed, name, index), with the same bits on every machine.
//!
//! A [`Stream`] has no state: number `i` depends only on the seed, the name and `i`, and not on threads or on earlier draws. Uniform numbers are scaled
//! random bits. Normal numbers come from the Box–Muller transform. Its logarithm and cosine are functions of this crate that add, multiply and divide in
//! `f64` without fused operations; its square root is the IEEE operation. The math library of the system is not used.

use crate::parallel::{self, CHUNK};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// A sequence of random numbers with random access by index.
///
/// ```
/// use autograd::random::Stream;
/// let random = Stream::new(7);
/// assert_eq!(random.uniform(3), random.uniform(3));
/// assert_ne!(random.uniform(3), random.named("noise").uniform(3));
/// let noise = random.named("noise").normal_tensor::<f32>(&[100, 3], 0.0, 0.1);
/// assert!(noise.data().iter().all(|x| x.abs() < 1.0));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stream {
    key: u64,
}

impl Stream {
    /// Returns the stream of a seed. Its bits are the outputs of SplitMix64 (Steele, Lea, Flood 2014) with that seed.
    pub fn new(seed: u64) -> Self {
        Stream { key: seed }
    }

    /// Returns a stream that is derived from this one and a name. It is independent of this stream and of the streams with other names.
    pub fn named(self, name: &str) -> Self {
        // The FNV-1a hash of the name.
        let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
        Stream { key: mix(mix(self.key) ^ hash) }
    }

    /// Returns a stream that is derived from this one and a number, for example the step of training. It is independent of this stream and of the streams
    /// with other numbers.
    pub fn numbered(self, number: u64) -> Self {
        Stream { key: mix(mix(self.key).wrapping_add(mix(number))) }
    }

    /// Returns 64 random bits: output number `index`, from 0, of SplitMix64.
    pub fn bits(self, index: u64) -> u64 {
        mix(self.key.wrapping_add(index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    /// Returns a uniform number in [0, 1), a multiple of 2⁻⁵³.
    pub fn uniform(self, index: u64) -> f64 {
        unit(self.bits(index))
    }

    /// Returns a number from the standard normal distribution: √(−2 ln(1 − u)) cos(2π v) (Box and Muller 1958), where u and v are the uniform numbers
    /// with indices 2 · `index` and 2 · `index` + 1. Its magnitude is at most 8.6.
    pub fn normal(self, index: u64) -> f64 {
        let (u, v) = (self.uniform(2 * index), self.uniform(2 * index + 1));
        (-2.0 * ln(1.0 - u)).sqrt() * (std::f64::consts::TAU * v).cos_()
    }

    /// Returns a tensor of uniform numbers from `low` to `high`, computed in `f64` and rounded. Element `i` is computed from number `i` of the stream.
    pub fn uniform_tensor<T: Real>(self, shape: &[usize], low: f64, high: f64) -> Tensor<T> {
        filled(shape, |i| low + (high - low) * self.uniform(i))
    }

    /// Returns a tensor of normal numbers with the given mean and standard deviation, computed in `f64` and rounded. Element `i` is computed from number
    /// `i` of the stream.
    pub fn normal_tensor<T: Real>(self, shape: &[usize], mean: f64, deviation: f64) -> Tensor<T> {
        filled(shape, |i| mean + deviation * self.normal(i))
    }
}

fn filled<T: Real>(shape: &[usize], number: impl Fn(u64) -> f64 + Sync) -> Tensor<T> {
    let mut out = Buffer::stale(shape.iter().product());
    parallel::for_each_chunk(&mut out, CHUNK, |start, chunk| {
        chunk.iter_mut().zip(start as u64..).for_each(|(x, i)| *x = T::lit(number(i)));
    });
    Tensor::from_buffer(out, shape)
}

/// Converts the upper 53 bits to a number in [0, 1).
fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// Mixes the bits of `z` by variant 13 (Stafford) of the MurmurHash3 finaliser, as SplitMix64 does.
fn mix(z: u64) -> u64 {
    let z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}

/// Returns ln x for a positive normal number, accurate to two units in the last place. It is e ln 2 + 2 artanh((m − 1) / (m + 1)) for x = m 2ᵉ with m
/// from √½ to √2.
fn ln(x: f64) -> f64 {
    const ROOT_HALF: u64 = std::f64::consts::FRAC_1_SQRT_2.to_bits();
    let shifted = x.to_bits().wrapping_sub(ROOT_HALF);
    let exponent = (shifted as i64 >> 52) as f64;
    let mantissa = f64::from_bits((shifted & 0x000f_ffff_ffff_ffff) + ROOT_HALF);
    let f = (mantissa - 1.0) / (mantissa + 1.0);
    let square = f * f;
    let series = (1..=10).rev().fold(0.0, |sum, k| square * (sum + 1.0 / f64::from(2 * k + 1)));
    exponent * std::f64::consts::LN_2 + 2.0 * (f + f * series)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::real::tests::units_apart;

    #[test]
    fn the_bits_are_those_of_splitmix64() {
        let published = [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423, 4_593_380_528_125_082_431];
        for (i, bits) in published.into_iter().enumerate() {
            assert_eq!(Stream::new(1_234_567).bits(i as u64), bits);
        }
    }

    #[test]
    fn the_logarithm_is_the_librarys_to_two_units() {
        for i in 0..200_000 {
            let x = unit(mix(i)).powi(1 + i as i32 % 8).max(1e-300);
            assert!(units_apart(ln(x), x.ln()) <= 2.0, "ln {x:e} = {:e}, want {:e}", ln(x), x.ln());
        }
        assert_eq!(ln(1.0), 0.0);
    }

    #[test]
    fn moments_are_those_of_the_distributions() {
        const N: usize = 100_000;
        let moment = |x: &Tensor<f64>, power| x.powi(power).mean().item();
        let uniform = Stream::new(3).uniform_tensor::<f64>(&[N], -1.0, 1.0);
        assert!(moment(&uniform, 1).abs() < 0.01 && (moment(&uniform, 2) - 1.0 / 3.0).abs() < 0.01);
        let normal = Stream::new(3).normal_tensor::<f64>(&[N], 0.0, 1.0);
        let [mean, variance, skew, kurtosis] = [1, 2, 3, 4].map(|power| moment(&normal, power));
        assert!(mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02 && skew.abs() < 0.05 && (kurtosis - 3.0).abs() < 0.1);
    }

    /// Fixes the bits of normal numbers: if they changed, earlier training runs could not be reproduced.
    #[test]
    fn normal_numbers_have_these_bits() {
        let drawn = [0, 1, 2].map(|i| Stream::new(7).named("weight").normal(i).to_bits());
        assert_eq!(drawn, [0xbfe8_0200_2d86_6c68, 0x3fea_0e62_8b8e_cb37, 0x3ff5_c6b8_35e5_8f50]);
    }
}
