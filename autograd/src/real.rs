//! The scalar types: `f32` for work, `f64` for checking.
//!
//! Precision is a type parameter and never a feature flag, so a gradient check in `f64` exercises the very code that trains in `f32`.
//! The functions below that `num_traits::Float` already has are repeated here because a loop over them must vectorise:
//! they are branch-free polynomials for `f32` and the standard library's for `f64`. None uses fused multiply-add, so an
//! elementwise result has the same bits on every instruction set.

use crate::pool::Pooled;
use ndarray::NdFloat;
use num_traits::{FloatConst, FromPrimitive};
use std::iter::Sum;

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// `f32` or `f64`.
pub trait Real: NdFloat + FromPrimitive + FloatConst + Sum + Default + Pooled + sealed::Sealed {
    /// A literal in this precision: `T::lit(0.5)`.
    fn lit(x: f64) -> Self;

    /// This value as `f64`, exactly.
    fn as_f64(self) -> f64;

    /// eˣ to about one unit in the last place, without a branch.
    fn exp_(self) -> Self;

    /// 1 − e⁻ˣ without cancellation for small x: the opacity of an optical depth.
    fn one_minus_exp_neg(self) -> Self;
}

impl Real for f32 {
    #[inline(always)]
    fn lit(x: f64) -> Self {
        x as f32
    }

    #[inline(always)]
    fn as_f64(self) -> f64 {
        f64::from(self)
    }

    /// Cody and Waite's reduction x = n ln 2 + r with |r| <= ln 2 / 2, then a degree-6 polynomial (Cephes `expf`) and a scaling by 2ⁿ
    /// in two halves, so that results down to the subnormals and up to the largest finite value come out right.
    #[inline(always)]
    fn exp_(self) -> Self {
        let x = self.clamp(-104.0, 89.0);
        // Adding and subtracting 1.5·2²³ rounds to the nearest integer in any instruction set.
        const ROUND: f32 = 12_582_912.0;
        let rounded = x * std::f32::consts::LOG2_E + ROUND;
        let n = rounded - ROUND;
        let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
        let p = 1.987_569_2e-4;
        let p = p * r + 1.398_2e-3;
        let p = p * r + 8.333_452e-3;
        let p = p * r + 4.166_579_6e-2;
        let p = p * r + 1.666_666_5e-1;
        let p = p * r + 5.000_000_3e-1;
        let y = p * (r * r) + r + 1.0;
        // The integer stands in the low bits of `rounded`; a conversion `as i32` would check its range and not vectorise. NaN gives some
        // scale or other, and y is NaN.
        let n = (rounded.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
        let half = n >> 1;
        let scale = |k: i32| f32::from_bits((k.wrapping_add(127) as u32) << 23);
        y * scale(half) * scale(n.wrapping_sub(half))
    }

    #[inline(always)]
    fn one_minus_exp_neg(self) -> Self {
        // Below 1/2 the Taylor polynomial x − x²/2 + … − x⁸/8! is exact to rounding; above, the difference loses at most one bit.
        let x = self;
        let p = 1.0 / 40_320.0;
        let p = 1.0 / 5_040.0 - x * p;
        let p = 1.0 / 720.0 - x * p;
        let p = 1.0 / 120.0 - x * p;
        let p = 1.0 / 24.0 - x * p;
        let p = 1.0 / 6.0 - x * p;
        let p = 0.5 - x * p;
        let small = x * (1.0 - x * p);
        let large = 1.0 - (-x).exp_();
        if x.abs() < 0.5 { small } else { large }
    }
}

impl Real for f64 {
    #[inline(always)]
    fn lit(x: f64) -> Self {
        x
    }

    #[inline(always)]
    fn as_f64(self) -> f64 {
        self
    }

    #[inline(always)]
    fn exp_(self) -> Self {
        self.exp()
    }

    #[inline(always)]
    fn one_minus_exp_neg(self) -> Self {
        -(-self).exp_m1()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_right_to_two_units_in_the_last_place_over_its_whole_range() {
        let mut x = -103.0f32;
        while x < 88.7 {
            let want = f64::from(x).exp();
            let got = f64::from(x.exp_());
            let ulp = f64::from(f32::EPSILON) * want.max(f64::from(f32::MIN_POSITIVE));
            assert!((got - want).abs() <= 2.0 * ulp, "exp({x}) = {got:e}, want {want:e}");
            x += 0.013_7;
        }
        assert_eq!(0.0f32.exp_(), 1.0);
        assert_eq!(f32::NEG_INFINITY.exp_(), 0.0);
        assert_eq!(f32::INFINITY.exp_(), f32::INFINITY);
        assert!(f32::NAN.exp_().is_nan());
    }

    #[test]
    fn opacity_of_a_small_optical_depth_keeps_its_digits() {
        for x in [1e-12f32, 1e-6, 1e-3, 0.1, 0.49, 0.51, 3.0, 40.0, -0.2, -0.6] {
            let want = -(-f64::from(x)).exp_m1();
            let got = f64::from(x.one_minus_exp_neg());
            assert!((got - want).abs() <= 4e-7 * want.abs(), "1 - exp(-{x}) = {got:e}, want {want:e}");
        }
    }
}
