//! Sine and cosine without branches, so that loops over them vectorise.
//!
//! The method is the reduction x = n π/2 + r with |r| <= π/4 (Cody and Waite) and the polynomials of FDLIBM (`k_sin.c`, `k_cos.c`; for `f32` FreeBSD's
//! `k_sinf.c` and `k_cosf.c`). Both polynomials are computed, and the last two bits of n select one of them and its sign, which needs no branch. The functions
//! do not use fused multiply-add, so the bits are the same on every machine.

/// Largest |x| for which the reduction is accurate enough: n must be below 2²⁰, so that its product with 33 bits of π/2 is exact.
pub const LIMIT: f64 = 1_048_576.0;

/// The constant 1.5·2⁵², whose addition rounds to the nearest integer; the low bits of the sum contain that integer.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// Returns n and its low bits, for x = n π/2 + r.
#[inline(always)]
fn quarter_turns(x: f64) -> (f64, u64) {
    let rounded = x * std::f64::consts::FRAC_2_PI + ROUND;
    (rounded - ROUND, rounded.to_bits())
}

/// Returns ±sine or ±cosine, depending on the quadrant.
#[inline(always)]
fn select_by_quadrant(quadrant: u64, sine: f64, cosine: f64) -> f64 {
    let value = if quadrant & 1 == 0 { sine } else { cosine };
    f64::from_bits(value.to_bits() ^ (quadrant & 2) << 62)
}

/// Returns the sine (`SHIFT` = 0) or cosine (`SHIFT` = 1) of an `f32`. It is computed in `f64` and accurate to 0.51 units in the last place of `f32` for
/// |x| <= [`LIMIT`].
#[inline(always)]
pub fn single<const SHIFT: u64>(x: f32) -> f32 {
    // The first 25 bits of π/2, whose product with n is exact, and the next 53 bits.
    const HIGH: f64 = 1.570_796_310_901_641_8;
    const LOW: f64 = 1.589_325_477_352_819_6e-8;
    let x = f64::from(x);
    let (n, bits) = quarter_turns(x);
    let r = (x - n * HIGH) - n * LOW;
    let z = r * r;
    let w = z * z;
    // The sine is a product with r, so that sin −0 is −0.
    let sine = r
        * ((1.0 + z * (-0.166_666_666_416_265_24 + z * 0.008_333_329_385_889_463))
            + w * z * (-0.000_198_393_348_360_966_32 + z * 0.000_002_718_311_493_989_822));
    let cosine = ((1.0 + z * -0.499_999_997_251_031) + w * 0.041_666_623_323_739_06)
        + w * z * (-0.001_388_676_377_460_993 + z * 0.000_024_390_448_796_277_41);
    select_by_quadrant(bits.wrapping_add(SHIFT), sine, cosine) as f32
}

/// Returns the sine (`SHIFT` = 0) or cosine (`SHIFT` = 1) of an `f64`, accurate to one unit in the last place for |x| <= [`LIMIT`].
#[inline(always)]
pub fn double<const SHIFT: u64>(x: f64) -> f64 {
    // Three parts of π/2 of 33 bits each, whose products with n are exact, and the next 53 bits.
    const PARTS: [f64; 3] = [1.570_796_326_734_125_6, 6.077_100_506_303_966e-11, 2.022_266_248_711_166_5e-21];
    const REST: f64 = 8.478_427_660_368_9e-32;
    let (n, bits) = quarter_turns(x);
    // The first difference is exact. The rounding errors of the second and third are computed exactly and go to the low part of r = high + low.
    let first = x - n * PARTS[0];
    let second = first - n * PARTS[1];
    let third = second - n * PARTS[2];
    let lost = ((first - second) - n * PARTS[1]) + ((second - third) - n * PARTS[2]);
    let rest = n * REST - lost;
    let high = third - rest;
    let low = (third - high) - rest;

    let z = high * high;
    let w = z * z;
    let s = z * high;
    let p = 8.333_333_333_322_49e-3
        + z * (-1.984_126_982_985_795e-4 + z * 2.755_731_370_707_006_8e-6)
        + z * w * (-2.505_076_025_340_686_3e-8 + z * 1.589_690_995_211_55e-10);
    let sine = high - ((z * (0.5 * low - s * p) - low) - s * -1.666_666_666_666_663_2e-1);
    let p = z * (4.166_666_666_666_66e-2 + z * (-1.388_888_888_887_411e-3 + z * 2.480_158_728_947_673e-5))
        + w * w * (-2.755_731_435_139_066_3e-7 + z * (2.087_572_321_298_175e-9 + z * -1.135_964_755_778_819_5e-11));
    let half = 0.5 * z;
    let most = 1.0 - half;
    let cosine = most + (((1.0 - most) - half) + (z * p - high * low));
    select_by_quadrant(bits.wrapping_add(SHIFT), sine, cosine)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::real::tests::units_apart;

    /// Numbers spread over ±`LIMIT`, small numbers, and numbers near multiples of π/4, where the cancellation in the reduction is largest.
    fn arguments() -> impl Iterator<Item = f64> {
        let spread = (0..400_000).map(|i| (f64::from(i) * 0.618_033_988_749_894_9).fract() * 2.0 - 1.0);
        let near = (-300_000..300_000).map(|k| f64::from(k) * std::f64::consts::FRAC_PI_4);
        spread.clone().map(|u| u * LIMIT).chain(spread.clone().map(|u| u * 10.0)).chain(spread.map(|u| u * u * u * 1e-3)).chain(near)
    }

    #[test]
    fn sine_and_cosine_of_f64_are_right_to_a_unit_in_the_last_place() {
        let mut worst = 0.0f64;
        for x in arguments() {
            for (got, want) in [(double::<0>(x), x.sin()), (double::<1>(x), x.cos())] {
                worst = worst.max(units_apart(got, want));
                assert!(worst <= 1.0, "at {x:e}: {got:e}, want {want:e}");
            }
        }
        println!("f64: {worst} units in the last place");
    }

    #[test]
    fn sine_and_cosine_of_f32_are_those_of_f64_rounded() {
        let mut worst = 0.0f64;
        for x in arguments().map(|x| x as f32) {
            let exact = f64::from(x);
            for (got, want) in [(single::<0>(x), exact.sin()), (single::<1>(x), exact.cos())] {
                let unit = f64::from((want as f32).abs().next_up()) - f64::from((want as f32).abs());
                worst = worst.max((f64::from(got) - want).abs() / unit);
                assert!(worst <= 0.51, "at {x:e}: {got:e}, want {want:e}");
            }
        }
        println!("f32: {worst} units in the last place");
    }

    #[test]
    fn zeros_keep_their_signs_denormals_are_themselves_and_nan_stays() {
        for x in [0.0, -0.0, 5e-324, -5e-324, 1e-310, f64::MIN_POSITIVE] {
            assert_eq!((double::<0>(x).to_bits(), double::<1>(x)), (x.to_bits(), 1.0));
        }
        for x in [0.0, -0.0, 1e-45, -1e-45, f32::MIN_POSITIVE] {
            assert_eq!((single::<0>(x).to_bits(), single::<1>(x)), (x.to_bits(), 1.0));
        }
        assert!(double::<0>(f64::NAN).is_nan() && double::<1>(f64::NAN).is_nan() && single::<0>(f32::NAN).is_nan());
    }
}
