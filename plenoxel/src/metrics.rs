//! Image quality: PSNR and SSIM, as in the tables of radiance-field papers.
//!
//! Predictions are clamped to [0, 1] and not quantised. The target is the 8-bit image composited in floating point. The value of a table is
//! the mean over the views, not the PSNR of the mean error. Sums are accumulated in f64, row by row in order, so results do not depend on
//! the number of threads.

use autograd::dispatched;
use ndarray::{ArrayView3, Axis};
use rayon::prelude::*;

/// Side of the Gaussian window of SSIM.
const WINDOW: usize = 11;
/// Number of columns processed together, so that the running sums stay in the L1 cache.
const BLOCK: usize = 64;

/// Returns the peak signal-to-noise ratio in dB, [`psnr_of`] the [`mse`].
///
/// Both images are [height, width, 3]. Panics if the shapes differ.
pub fn psnr(prediction: ArrayView3<'_, f32>, target: ArrayView3<'_, f32>) -> f64 {
    psnr_of(mse(prediction, target))
}

/// Returns the peak signal-to-noise ratio in dB for a mean squared error of values in [0, 1]: -10 log10(mse). Infinite for 0.
pub fn psnr_of(mse: f64) -> f64 {
    -10.0 * mse.log10()
}

/// Returns the mean squared error over pixels and channels, with the prediction clamped to [0, 1]. NaN if the prediction contains NaN or
/// the images are empty.
///
/// Both images are [height, width, 3]. Panics if the shapes differ.
pub fn mse(prediction: ArrayView3<'_, f32>, target: ArrayView3<'_, f32>) -> f64 {
    assert_eq!(prediction.shape(), target.shape(), "mse: prediction and target differ in shape");
    let row_sums: Vec<f64> = (0..target.shape()[0])
        .into_par_iter()
        .map(|y| {
            let (prediction, target) = (prediction.index_axis(Axis(0), y), target.index_axis(Axis(0), y));
            let squared = |(p, t): (&f32, &f32)| (f64::from(p.clamp(0.0, 1.0)) - f64::from(*t)).powi(2);
            prediction.iter().zip(&target).map(squared).sum()
        })
        .collect();
    row_sums.iter().sum::<f64>() / target.len() as f64
}

/// Returns the structural similarity (Wang et al. 2004): 11 x 11 Gaussian window of sigma 1.5, k1 = 0.01, k2 = 0.03, L = 1, per channel,
/// averaged over channels and over the windows inside the image ("valid", as in tf.image.ssim, mip-NeRF and DVGO). Variances are clipped at
/// 0, and the covariance at the geometric mean of the variances. The prediction is clamped to [0, 1].
///
/// Both images are [height, width, 3]. Panics if the shapes differ. `None` for images smaller than 11 pixels per side.
pub fn ssim(prediction: ArrayView3<'_, f32>, target: ArrayView3<'_, f32>) -> Option<f64> {
    ssims(prediction, target).0
}

/// Returns the structural similarity as svox2 computes it: like [`ssim`], but with one window per pixel and zero padding around both
/// images. With bright borders it is slightly higher. Defined for every size; NaN for empty images.
pub fn ssim_same(prediction: ArrayView3<'_, f32>, target: ArrayView3<'_, f32>) -> f64 {
    ssims(prediction, target).1
}

/// Returns [`ssim`] and [`ssim_same`], in one pass.
///
/// The filter is separable: each row of windows first takes a weighted sum of 11 image rows, then of 11 neighbours within the result. Channels are interleaved,
/// so neighbours are `channels` apart.
pub fn ssims(prediction: ArrayView3<'_, f32>, target: ArrayView3<'_, f32>) -> (Option<f64>, f64) {
    assert_eq!(prediction.shape(), target.shape(), "ssim: prediction and target differ in shape");
    let (height, width, channels) = target.dim();
    let prediction: Vec<f64> = prediction.iter().map(|value| f64::from(value.clamp(0.0, 1.0))).collect();
    let target: Vec<f64> = target.iter().map(|value| f64::from(*value)).collect();
    let weights = gaussian();
    let stride = width * channels;
    let pad = WINDOW / 2;
    let has_valid = height >= WINDOW && width >= WINDOW;
    let row_sums: Vec<[f64; 2]> = (0..height)
        .into_par_iter()
        .map_init(
            || (vec![vec![0.0; (width + 2 * pad) * channels]; 5], vec![0.0; stride]),
            |(moments, values), y| {
                let window = y.saturating_sub(pad)..(y + pad + 1).min(height);
                let weights_of_window = &weights[window.start + pad - y..];
                for start in (0..stride).step_by(BLOCK) {
                    let span = start..(start + BLOCK).min(stride);
                    let mut sums = [[0.0; BLOCK]; 5];
                    // Rows of zeros around the image add nothing.
                    for (row, weight) in window.clone().zip(weights_of_window) {
                        let [a, b] = [&prediction, &target].map(|image| &image[row * stride..][span.clone()]);
                        add_moments(&mut sums, *weight, a, b);
                    }
                    for (moment, sum) in moments.iter_mut().zip(&sums) {
                        moment[pad * channels..][span.clone()].copy_from_slice(&sum[..span.len()]);
                    }
                }
                for (block, values) in values.chunks_mut(BLOCK).enumerate() {
                    similarities(moments, block * BLOCK, channels, &weights, values);
                }
                let inside = has_valid && (pad..height - pad).contains(&y);
                let valid = if inside { values[pad * channels..stride - pad * channels].iter().sum() } else { 0.0 };
                [valid, values.iter().sum()]
            },
        )
        .collect();
    let [valid, same] = [0, 1].map(|kind| row_sums.iter().map(|sums| sums[kind]).sum::<f64>());
    let windows = |height: usize, width: usize| (height * width * channels) as f64;
    (has_valid.then(|| valid / windows(height - 2 * pad, width - 2 * pad)), same / windows(height, width))
}

dispatched! {
/// Adds weight times a, b, a², b² and ab of a stretch of an image row to the five running sums.
fn add_moments(sums: &mut [[f64; BLOCK]; 5], weight: f64, a: &[f64], b: &[f64]) {
    // Slices cut to one length let the compiler drop the bounds checks and use vector instructions.
    let n = a.len().min(BLOCK);
    let [sa, sb, saa, sbb, sab] = sums;
    let (sa, sb, saa, sbb, sab) = (&mut sa[..n], &mut sb[..n], &mut saa[..n], &mut sbb[..n], &mut sab[..n]);
    let (a, b) = (&a[..n], &b[..n]);
    for i in 0..n {
        let (wa, wb) = (weight * a[i], weight * b[i]);
        sa[i] += wa;
        sb[i] += wb;
        saa[i] += wa * a[i];
        sbb[i] += wb * b[i];
        sab[i] += wa * b[i];
    }
}
}

dispatched! {
/// Computes the SSIM of the windows from `start` on, at most [`BLOCK`], from the moments of their columns.
fn similarities(moments: &[Vec<f64>], start: usize, channels: usize, weights: &[f64; WINDOW], out: &mut [f64]) {
    let n = out.len().min(BLOCK);
    let mut sums = [[0.0; BLOCK]; 5];
    for (sum, moment) in sums.iter_mut().zip(moments) {
        for (k, weight) in weights.iter().enumerate() {
            let values = &moment[start + k * channels..][..n];
            for i in 0..n {
                sum[i] += weight * values[i];
            }
        }
    }
    let [a, b, aa, bb, ab] = &sums;
    for i in 0..n {
        out[i] = similarity(a[i], b[i], aa[i], bb[i], ab[i]);
    }
}
}

/// Returns the SSIM of one window from its weighted means of a, b, a², b² and ab.
#[inline(always)]
fn similarity(a: f64, b: f64, aa: f64, bb: f64, ab: f64) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let (variance_a, variance_b) = ((aa - a * a).max(0.0), (bb - b * b).max(0.0));
    let bound = (variance_a * variance_b).sqrt();
    // min and max instead of clamp, which panics if the bound is NaN.
    let covariance = (ab - a * b).min(bound).max(-bound);
    (2.0 * a * b + C1) * (2.0 * covariance + C2) / ((a * a + b * b + C1) * (variance_a + variance_b + C2))
}

/// Returns the weights of the window along one axis: exp(-x² / (2 · 1.5²)) at x = -5 ... 5, normalised to sum 1.
fn gaussian() -> [f64; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|k| (-(k as f64 - 5.0).powi(2) / (2.0 * 1.5 * 1.5)).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|weight| weight / sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    /// Returns a reproducible image with structure and noise; `phase` selects different images.
    fn picture(height: usize, width: usize, phase: f32) -> Array3<f32> {
        Array3::from_shape_fn((height, width, 3), |(y, x, c)| {
            let hash = (y * 7919 + x * 104729 + c * 1299709) % 997;
            0.5 + 0.3 * (0.4 * x as f32 + 0.3 * y as f32 + c as f32 + phase).sin() + 0.2 * (hash as f32 / 997.0 - 0.5)
        })
    }

    /// Computes SSIM by definition: 121 weights and centred moments for every window, without separability.
    fn brute_force(a: &Array3<f32>, b: &Array3<f32>, pad: isize) -> f64 {
        let (height, width, channels) = a.dim();
        let at = |image: &Array3<f32>, y: isize, x: isize, c: usize| {
            let inside = y >= 0 && x >= 0 && y < height as isize && x < width as isize;
            if inside { f64::from(image[[y as usize, x as usize, c]]) } else { 0.0 }
        };
        let weight = |y: isize, x: isize| (-((y * y + x * x) as f64) / 4.5).exp();
        let offsets: Vec<(isize, isize)> = (-5..=5).flat_map(|y| (-5..=5).map(move |x| (y, x))).collect();
        let norm: f64 = offsets.iter().map(|&(y, x)| weight(y, x)).sum();
        let (mut total, mut count) = (0.0, 0);
        for c in 0..channels {
            for y in 5 - pad..height as isize - 5 + pad {
                for x in 5 - pad..width as isize - 5 + pad {
                    let mean = |f: &dyn Fn(isize, isize) -> f64| -> f64 {
                        offsets.iter().map(|&(dy, dx)| weight(dy, dx) / norm * f(y + dy, x + dx)).sum()
                    };
                    let ma = mean(&|y, x| at(a, y, x, c));
                    let mb = mean(&|y, x| at(b, y, x, c));
                    let va = mean(&|y, x| (at(a, y, x, c) - ma).powi(2));
                    let vb = mean(&|y, x| (at(b, y, x, c) - mb).powi(2));
                    let cov = mean(&|y, x| (at(a, y, x, c) - ma) * (at(b, y, x, c) - mb));
                    total += (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
                    count += 1;
                }
            }
        }
        total / f64::from(count)
    }

    #[test]
    fn psnr_of_a_constant_error_is_twenty_times_its_negative_logarithm() {
        let target = Array3::from_elem((4, 5, 3), 0.25_f32);
        // Error 0.1 everywhere: mse = 0.01, -10 log10(0.01) = 20 dB. f32 rounds 0.35 - 0.25 by some 1e-8.
        assert!((psnr((&target + 0.1).view(), target.view()) - 20.0).abs() < 1e-5);
        // Error 0.5 in one channel of three: mse = 0.25 / 3.
        let mut prediction = target.clone();
        prediction.index_axis_mut(Axis(2), 1).fill(0.75);
        assert!((psnr(prediction.view(), target.view()) + 10.0 * (0.25_f64 / 3.0).log10()).abs() < 1e-12);
        assert_eq!(psnr(target.view(), target.view()), f64::INFINITY);
    }

    #[test]
    fn predictions_outside_the_unit_interval_are_clamped_before_comparing() {
        let target = Array3::from_elem((3, 3, 3), 1.0_f32);
        assert_eq!(psnr(Array3::from_elem((3, 3, 3), 7.0).view(), target.view()), f64::INFINITY);
        assert_eq!(psnr(Array3::from_elem((3, 3, 3), -7.0).view(), target.view()), 0.0); // mse 1
        assert!(psnr(Array3::from_elem((3, 3, 3), f32::NAN).view(), target.view()).is_nan());
    }

    #[test]
    fn ssim_agrees_with_the_definition_window_by_window() {
        // 37 columns of 3 channels do not fill the last block of 64.
        let (a, b) = (picture(19, 37, 0.0), picture(19, 37, 0.7));
        let value = ssim(a.view(), b.view()).unwrap();
        assert!((value - brute_force(&a, &b, 0)).abs() < 1e-10);
        assert!((ssim_same(a.view(), b.view()) - brute_force(&a, &b, 5)).abs() < 1e-10);
        assert!(value < 0.95, "the two pictures differ: {value}");
    }

    #[test]
    fn ssim_of_constant_pictures_has_a_closed_form() {
        let (a, b) = (Array3::from_elem((12, 12, 3), 0.25_f32), Array3::from_elem((12, 12, 3), 0.75_f32));
        // No variance: (2 · 0.25 · 0.75 + 1e-4) / (0.25² + 0.75² + 1e-4).
        assert!((ssim(a.view(), b.view()).unwrap() - 0.3751 / 0.6251).abs() < 1e-9);
        assert!((ssim(a.view(), a.view()).unwrap() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn small_pictures_have_no_valid_window_but_a_padded_one() {
        let (a, b) = (picture(10, 30, 0.0), picture(10, 30, 1.0));
        assert_eq!(ssim(a.view(), b.view()), None);
        assert!((ssim_same(a.view(), b.view()) - brute_force(&a, &b, 5)).abs() < 1e-10);
        assert!((ssim_same(a.slice(ndarray::s![..1, ..1, ..]), a.slice(ndarray::s![..1, ..1, ..])) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn metrics_have_the_same_bits_for_any_number_of_threads() {
        let (a, b) = (picture(40, 50, 0.0), picture(40, 50, 0.3));
        let measure = || (psnr(a.view(), b.view()), ssim(a.view(), b.view()), ssim_same(a.view(), b.view()));
        let with = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(measure);
        assert_eq!(with(1), with(3));
    }
}
