//! Simulation of automatic exposure: a different brightness and white balance in every view.

use super::View;
use crate::random::Stream;
use ::image::Rgba;

/// Changes brightness and white balance of each view at random.
///
/// View v gets the gains, by channel c,
///
/// ```text
/// g_c = exp(S z₀ + S/2 (z_c − (z₁ + z₂ + z₃) / 3)),        c = 1, 2, 3
/// ```
///
/// with S = `spread` and standard normal z₀ … z₃ ([`Stream`] of `seed` and the name "exposure", step v, index 0 to 3). Brightness varies by
/// a factor of about exp(±S); the mean of ln g_c over the channels is S z₀. Gains multiply the stored colors, sRGB with straight alpha;
/// results are rounded and clamped to [0, 1]. Alpha and depth do not change. Colors of two views that are not clamped differ by the factor
/// g / g'. A spread of 0 changes nothing.
pub fn spread(views: &mut [View], spread: f64, seed: u64) {
    let stream = Stream::new(seed).named("exposure");
    for (v, view) in views.iter_mut().enumerate() {
        let gains = gains(spread, [0, 1, 2, 3].map(|index| stream.numbered(v as u64).normal(index)));
        for Rgba([r, g, b, _]) in view.image.pixels_mut() {
            for (value, gain) in [r, g, b].into_iter().zip(gains) {
                *value = (f64::from(*value) * gain).round().min(255.0) as u8;
            }
        }
    }
}

/// Computes the gain of each channel from four standard normal numbers.
fn gains(spread: f64, [brightness, balance @ ..]: [f64; 4]) -> [f64; 3] {
    let mean = balance.iter().sum::<f64>() / 3.0;
    balance.map(|z| (spread * brightness + spread / 2.0 * (z - mean)).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};

    #[test]
    fn gains_are_those_of_the_formula_and_balance_changes_no_brightness() {
        let [r, g, b] = gains(0.3, [0.5, 1.0, -2.0, 0.25]);
        let log = |gain: f64, want: f64| assert!((gain.ln() - want).abs() < 1e-15, "{gain}");
        // The mean of the last three is -0.25.
        log(r, 0.15 + 0.15 * 1.25);
        log(g, 0.15 - 0.15 * 1.75);
        log(b, 0.15 + 0.15 * 0.5);
        assert!(((r * g * b).ln() / 3.0 - 0.15).abs() < 1e-15);
    }

    #[test]
    fn views_differ_in_color_alone_and_the_same_seed_gives_the_same() {
        let options = ProceduralOptions { width: 20, height: 20, train: 4, val: 0, test: 0, supersample: 2 };
        let views = Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap();
        let changed = |by: f64, seed: u64| {
            let mut views = views.clone();
            spread(&mut views, by, seed);
            views
        };
        assert!(views.iter().zip(changed(0.0, 1)).all(|(before, after)| before.image == after.image));
        let (after, again, other) = (changed(0.4, 1), changed(0.4, 1), changed(0.4, 2));
        for (v, view) in views.iter().enumerate() {
            assert!(after[v].image == again[v].image && after[v].image != view.image && after[v].image != other[v].image);
            assert!(after[v].depth == view.depth && after[v].camera == view.camera);
            let gains = gains(0.4, [0, 1, 2, 3].map(|index| Stream::new(1).named("exposure").numbered(v as u64).normal(index)));
            for (before, after) in view.image.pixels().zip(after[v].image.pixels()) {
                assert_eq!(before.0[3], after.0[3]);
                for (c, gain) in gains.into_iter().enumerate() {
                    let want = (f64::from(before.0[c]) * gain).min(255.0);
                    assert!((f64::from(after.0[c]) - want).abs() <= 0.5, "view {v}, channel {c}");
                }
            }
        }
    }
}
