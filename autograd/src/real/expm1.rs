//! eˣ − 1 and the hyperbolic tangent without branches, so that loops over them vectorise.
//!
//! The method is the reduction x = n ln 2 + r with |r| <= ln 2 / 2 (Cody and Waite), the Taylor polynomial p of eʳ − 1, and eˣ − 1 = 2ⁿ p + (2ⁿ − 1). For n = 0
//! the result is p, so there is no cancellation for small x. The functions do not use fused multiply-add, so the bits are the same on every machine.

/// Defines eˣ − 1 and tanh x for one of the scalar types.
macro_rules! functions {
    ($t:ident, $expm1:ident, $tanh:ident, round: $round:expr, exponent: $exponent:expr, range: $low:expr, $high:expr, ln2: [$ln2_high:expr, $ln2_low:expr], degree: $degree:expr) => {
        /// Returns eˣ − 1, accurate to two units in the last place. It is −1 for large negative x, and ∞ above the logarithm of the largest number.
        #[inline(always)]
        pub fn $expm1(x: $t) -> $t {
            /// A constant whose addition rounds to the nearest integer; the low bits of the sum contain that integer.
            const ROUND: $t = $round;
            const COEFFICIENTS: [$t; $degree - 1] = inverse_factorials!($t, $degree);
            let bounded = x.clamp($low, $high);
            let rounded = bounded * std::$t::consts::LOG2_E + ROUND;
            let n = rounded - ROUND;
            let r = (bounded - n * $ln2_high) - n * $ln2_low;
            let mut q = COEFFICIENTS[$degree - 2];
            for &c in COEFFICIENTS[..$degree - 2].iter().rev() {
                q = q * r + c;
            }
            let p = r + r * r * q;
            // The scale is 2ⁿ⁻¹, because 2ⁿ may overflow.
            let bits = rounded.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add($exponent - 1);
            let half = $t::from_bits(bits.wrapping_shl($t::MANTISSA_DIGITS - 1));
            let value = half * p + (half - 0.5);
            (if n == 0.0 { p } else { value + value }).copysign(x)
        }

        /// Returns tanh x, accurate to three units in the last place. It is computed from t = e^(−2|x|) − 1, which cannot overflow: tanh |x| = −t / (2 + t).
        #[inline(always)]
        pub fn $tanh(x: $t) -> $t {
            let t = $expm1(-2.0 * x.abs());
            (t / (2.0 + t)).copysign(x)
        }
    };
}

/// Returns the array 1/2!, 1/3!, …, 1/degree!.
macro_rules! inverse_factorials {
    ($t:ident, $degree:expr) => {{
        let mut out = [0.0; $degree - 1];
        let (mut i, mut factorial) = (0, 1.0f64);
        while i < out.len() {
            factorial *= (i + 2) as f64;
            out[i] = (1.0 / factorial) as $t;
            i += 1;
        }
        out
    }};
}

// The high part of ln 2 has so few bits that its product with n is exact. The first omitted term of the series is below a tenth of a unit in the last place.
functions!(f32, single, tanh_single, round: 12_582_912.0, exponent: 127, range: -40.0, 89.0, ln2: [0.693_359_4, -2.121_944_4e-4], degree: 8);
functions!(f64, double, tanh_double, round: 6_755_399_441_055_744.0, exponent: 1023, range: -80.0, 710.0, ln2: [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10], degree: 14);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::real::tests::units_apart;

    fn arguments(low: f64, high: f64) -> impl Iterator<Item = f64> {
        let spread = (0..500_000).map(|i| (f64::from(i) * 0.618_033_988_749_894_9).fract());
        spread
            .clone()
            .map(move |u| low + (high - low) * u)
            .chain(spread.clone().map(|u| 4.0 * u - 2.0))
            .chain(spread.map(|u| (u - 0.5).powi(9)))
    }

    #[test]
    fn they_are_right_to_a_few_units_in_the_last_place_in_f64() {
        let mut worst = [0.0f64; 2];
        for x in arguments(-60.0, 709.7) {
            let found = [units_apart(double(x), x.exp_m1()), units_apart(tanh_double(x), x.tanh())];
            assert!(found[0] <= 2.0 && found[1] <= 3.0, "at {x:e}: {found:?} units");
            worst = [worst[0].max(found[0]), worst[1].max(found[1])];
        }
        println!("f64: {worst:?} units in the last place");
    }

    #[test]
    fn they_are_right_to_a_few_units_in_the_last_place_in_f32() {
        let mut worst = [0.0f64; 2];
        for x in arguments(-30.0, 88.7).map(|x| x as f32) {
            let exact = f64::from(x);
            let found = [(single(x), exact.exp_m1()), (tanh_single(x), exact.tanh())].map(|(got, want)| {
                let unit = f64::from((want as f32).abs().next_up()) - f64::from((want as f32).abs());
                (f64::from(got) - want).abs() / unit
            });
            assert!(found[0] <= 2.0 && found[1] <= 3.0, "at {x:e}: {found:?} units");
            worst = [worst[0].max(found[0]), worst[1].max(found[1])];
        }
        println!("f32: {worst:?} units in the last place");
    }

    #[test]
    fn zeros_keep_their_signs_denormals_are_themselves_and_the_ends_are_the_limits() {
        for x in [0.0, -0.0, 5e-324, -5e-324, 1e-310, f64::MIN_POSITIVE] {
            assert_eq!((double(x).to_bits(), tanh_double(x).to_bits()), (x.to_bits(), x.to_bits()), "{x:e}");
        }
        for x in [0.0, -0.0, 1e-45, -1e-45, f32::MIN_POSITIVE] {
            assert_eq!((single(x).to_bits(), tanh_single(x).to_bits()), (x.to_bits(), x.to_bits()), "{x:e}");
        }
        for (x, expm1, tanh) in
            [(f64::INFINITY, f64::INFINITY, 1.0), (f64::NEG_INFINITY, -1.0, -1.0), (710.0, f64::INFINITY, 1.0), (-1e300, -1.0, -1.0)]
        {
            assert_eq!((double(x), tanh_double(x)), (expm1, tanh));
            assert_eq!((single(x as f32), tanh_single(x as f32)), (expm1 as f32, tanh as f32));
        }
        assert!(double(f64::NAN).is_nan() && tanh_double(f64::NAN).is_nan() && single(f32::NAN).is_nan() && tanh_single(f32::NAN).is_nan());
    }
}
