//! [`Real`]: the trait of the scalar types, `f32` for training and `f64` for gradient checks.
//!
//! Precision is a type parameter and never a feature flag, so a gradient check in `f64` runs the same code that trains in `f32`, except for products with
//! [`Precision::Mixed`](crate::Precision::Mixed). Some functions of
//! `num_traits::Float` have a second version here, with a trailing underscore, because loops over them must vectorise: these versions are polynomials without
//! branches. The exceptions are `exp_` and `absorb` for `f64`, which call the standard library.
//!
//! Functions with a parameter `FUSED`, and loops that use it, use fused multiply-add where the machine has it. Their bits do not depend on the number of
//! threads, but differ between instruction sets by the rounding of that operation. All other functions have the same bits on every machine.

mod expm1;
mod sine;

use crate::pool::Pooled;
use ndarray::NdFloat;
use num_traits::{FloatConst, FromPrimitive};
use std::iter::Sum;

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// A scalar type: `f32` or `f64`.
pub trait Real: NdFloat + FromPrimitive + FloatConst + Sum + Default + Pooled + sealed::Sealed {
    /// Largest |x| for which `sin_` and `cos_` are accurate: 2²⁰.
    const SINE_LIMIT: Self;

    /// Converts a literal to this type, as in `T::lit(0.5)`.
    fn lit(x: f64) -> Self;

    /// Converts this value to `f64`, exactly.
    fn as_f64(self) -> f64;

    /// Returns the integer part of a number in [0, 2²³), without a branch. The result is unspecified for other numbers.
    fn index(self) -> u32;

    /// Returns 1/√x for a positive x, accurate to about two units in the last place.
    fn inverse_sqrt(self) -> Self;

    /// Returns eˣ. For `f32` it has no branch, is accurate to two units in the last place, and results below 2⁻¹²⁵ are 0; for `f64` it is the function of the
    /// standard library. `FUSED` must be true only if the machine has fused multiply-add instructions: [`crate::parallel::fused`].
    fn exp_<const FUSED: bool>(self) -> Self;

    /// Returns eˣ − 1 without cancellation for small x, accurate to two units in the last place.
    fn expm1_(self) -> Self;

    /// Returns tanh x, accurate to three units in the last place.
    fn tanh_(self) -> Self;

    /// Returns sin x, accurate to one unit in the last place for |x| <= [`Real::SINE_LIMIT`]. The result is unspecified for larger |x|.
    fn sin_(self) -> Self;

    /// Returns cos x, accurate to one unit in the last place for |x| <= [`Real::SINE_LIMIT`]. The result is unspecified for larger |x|.
    fn cos_(self) -> Self;

    /// Returns 1 − e⁻ˣ without cancellation for small x: the opacity for an optical depth x.
    fn one_minus_exp_neg<const FUSED: bool>(self) -> Self;

    /// Returns self · b + c, rounded once if `FUSED` is true and twice otherwise.
    #[inline(always)]
    fn multiply_add<const FUSED: bool>(self, b: Self, c: Self) -> Self {
        if FUSED { self.mul_add(b, c) } else { self * b + c }
    }

    /// Returns the opacity and the transmittance for an optical depth x, (1 − e⁻ˣ, e⁻ˣ), both without cancellation.
    fn absorb<const FUSED: bool>(self) -> (Self, Self);

    /// Returns the numbers if they are `f32`.
    fn as_f32(numbers: &[Self]) -> Option<&[f32]>;

    /// Returns the numbers if they are `f32`.
    fn as_f32_mut(numbers: &mut [Self]) -> Option<&mut [f32]>;
}

impl Real for f32 {
    const SINE_LIMIT: Self = sine::LIMIT as f32;

    #[inline(always)]
    fn expm1_(self) -> Self {
        expm1::single(self)
    }

    #[inline(always)]
    fn tanh_(self) -> Self {
        expm1::tanh_single(self)
    }

    #[inline(always)]
    fn sin_(self) -> Self {
        sine::single::<0>(self)
    }

    #[inline(always)]
    fn cos_(self) -> Self {
        sine::single::<1>(self)
    }

    #[inline(always)]
    fn lit(x: f64) -> Self {
        x as f32
    }

    #[inline(always)]
    fn as_f64(self) -> f64 {
        f64::from(self)
    }

    #[inline(always)]
    fn inverse_sqrt(self) -> Self {
        // A first estimate from the exponent, then three Newton steps y ← y (3 − x y²) / 2. This takes a third of the time of a square root and a division.
        let half = 0.5 * self;
        let mut y = f32::from_bits(0x5f37_5a86_u32.wrapping_sub(self.to_bits() >> 1));
        for _ in 0..3 {
            y *= 1.5 - half * y * y;
        }
        y
    }

    #[inline(always)]
    fn index(self) -> u32 {
        // From 2²³ on, a unit in the last place is 1, so the low bits of the sum are the integer.
        const UNIT: f32 = 8_388_608.0;
        (self.floor() + UNIT).to_bits() & 0x7f_ffff
    }

    /// Reduces x = n ln 2 + r with |r| <= ln 2 / 2 (Cody and Waite), evaluates a polynomial of degree 7 (Cephes `expf`), and scales by 2 · 2ⁿ⁻¹, since 2ⁿ may
    /// overflow.
    #[inline(always)]
    fn exp_<const FUSED: bool>(self) -> Self {
        let x = self.clamp(-88.0, 89.0);
        // Adding and subtracting 1.5·2²³ rounds to the nearest integer in any instruction set.
        const ROUND: f32 = 12_582_912.0;
        let rounded = x.multiply_add::<FUSED>(std::f32::consts::LOG2_E, ROUND);
        let n = rounded - ROUND;
        let r = n.multiply_add::<FUSED>(2.121_944_4e-4, n.multiply_add::<FUSED>(-0.693_359_4, x));
        let p = r.multiply_add::<FUSED>(1.987_569_2e-4, 1.398_2e-3);
        let p = p.multiply_add::<FUSED>(r, 8.333_452e-3);
        let p = p.multiply_add::<FUSED>(r, 4.166_579_6e-2);
        let p = p.multiply_add::<FUSED>(r, 1.666_666_5e-1);
        let p = p.multiply_add::<FUSED>(r, 5.000_000_3e-1);
        let y = p.multiply_add::<FUSED>(r * r, r + 1.0);
        // The low bits of `rounded` contain the integer n; a conversion `as i32` would check the range and not vectorise. For NaN the scale is arbitrary, but
        // y is NaN. For n = −127 the exponent bits are clamped to 0, so the scale is 0 as for n = −126.
        let n = rounded.to_bits().wrapping_sub(ROUND.to_bits());
        let half_scale = f32::from_bits((n.wrapping_add(126) as i32).max(0).wrapping_shl(23) as u32);
        (y + y) * half_scale
    }

    #[inline(always)]
    fn one_minus_exp_neg<const FUSED: bool>(self) -> Self {
        self.absorb::<FUSED>().0
    }

    #[inline(always)]
    fn absorb<const FUSED: bool>(self) -> (Self, Self) {
        // For |x| < 1/2 the Taylor polynomial x − x²/2 + … − x⁸/8! is accurate to rounding. For larger |x| the subtraction loses less than one bit if x > 0,
        // and less than two bits if x < 0.
        let x = self;
        let p = x.multiply_add::<FUSED>(-1.0 / 40_320.0, 1.0 / 5_040.0);
        let p = (-x).multiply_add::<FUSED>(p, 1.0 / 720.0);
        let p = (-x).multiply_add::<FUSED>(p, 1.0 / 120.0);
        let p = (-x).multiply_add::<FUSED>(p, 1.0 / 24.0);
        let p = (-x).multiply_add::<FUSED>(p, 1.0 / 6.0);
        let p = (-x).multiply_add::<FUSED>(p, 0.5);
        let small = x * (1.0 - x * p);
        let through = (-x).exp_::<FUSED>();
        (if x.abs() < 0.5 { small } else { 1.0 - through }, through)
    }

    fn as_f32(numbers: &[f32]) -> Option<&[f32]> {
        Some(numbers)
    }

    fn as_f32_mut(numbers: &mut [f32]) -> Option<&mut [f32]> {
        Some(numbers)
    }
}

impl Real for f64 {
    const SINE_LIMIT: Self = sine::LIMIT;

    #[inline(always)]
    fn expm1_(self) -> Self {
        expm1::double(self)
    }

    #[inline(always)]
    fn tanh_(self) -> Self {
        expm1::tanh_double(self)
    }

    #[inline(always)]
    fn sin_(self) -> Self {
        sine::double::<0>(self)
    }

    #[inline(always)]
    fn cos_(self) -> Self {
        sine::double::<1>(self)
    }

    #[inline(always)]
    fn lit(x: f64) -> Self {
        x
    }

    #[inline(always)]
    fn as_f64(self) -> f64 {
        self
    }

    #[inline(always)]
    fn inverse_sqrt(self) -> Self {
        1.0 / self.sqrt()
    }

    #[inline(always)]
    fn index(self) -> u32 {
        const UNIT: f64 = 4_503_599_627_370_496.0;
        (self.floor() + UNIT).to_bits() as u32 & 0x7f_ffff
    }

    #[inline(always)]
    fn exp_<const FUSED: bool>(self) -> Self {
        self.exp()
    }

    #[inline(always)]
    fn one_minus_exp_neg<const FUSED: bool>(self) -> Self {
        -(-self).expm1_()
    }

    #[inline(always)]
    fn absorb<const FUSED: bool>(self) -> (Self, Self) {
        // Both values are computed by the standard library, as in `exp_`.
        (-(-self).exp_m1(), (-self).exp())
    }

    fn as_f32(_: &[f64]) -> Option<&[f32]> {
        None
    }

    fn as_f32_mut(_: &mut [f64]) -> Option<&mut [f32]> {
        None
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns |got − want| in units in the last place of `want`.
    pub fn units_apart(got: f64, want: f64) -> f64 {
        if got == want { 0.0 } else { (got - want).abs() / (want.abs().next_up() - want.abs()) }
    }

    #[test]
    fn exp_is_right_to_two_units_in_the_last_place_over_its_whole_range() {
        let mut x = -86.6f32;
        while x < 88.72 {
            let want = f64::from(x).exp();
            for got in [x.exp_::<false>(), x.exp_::<true>()] {
                assert!((f64::from(got) - want).abs() <= 2.0 * f64::from(f32::EPSILON) * want, "exp({x}) = {got:e}, want {want:e}");
            }
            x += 0.001_37;
        }
        assert_eq!(0.0f32.exp_::<false>(), 1.0);
        assert_eq!(f32::NEG_INFINITY.exp_::<true>(), 0.0);
        assert_eq!((-87.7f32).exp_::<false>(), 0.0);
        assert_eq!(f32::INFINITY.exp_::<true>(), f32::INFINITY);
        assert!(f32::NAN.exp_::<false>().is_nan());
    }

    #[test]
    fn opacity_of_a_small_optical_depth_keeps_its_digits() {
        for x in [1e-12f32, 1e-6, 1e-3, 0.1, 0.49, 0.51, 3.0, 40.0, 200.0, -0.2, -0.6] {
            let want = -(-f64::from(x)).exp_m1();
            for got in [x.one_minus_exp_neg::<false>(), x.one_minus_exp_neg::<true>()] {
                assert!((f64::from(got) - want).abs() <= 4e-7 * want.abs(), "1 - exp(-{x}) = {got:e}, want {want:e}");
            }
        }
    }
}
