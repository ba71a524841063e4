//! Least squares for the coefficients of a voxel, from the normal equations of weighted colors in some directions.

use super::{MAX_DEGREE, count};

/// Computes x ← x + A⁻¹ (g − ridge x) for each channel, where the ridge is also added to the diagonal of A. The coefficient of degree 0 has no
/// ridge. `a` is the lower triangle of Σ w S Sᵀ, row after row, and `g` is Σ w S (c − S·x), for one channel after another.
pub fn improve(x: &mut [f32], a: &[f32], g: &[f32], ridge: f32) {
    const MOST: usize = count(MAX_DEGREE);
    // a has count (count + 1) / 2 numbers.
    let count = (2 * a.len()).isqrt();
    // A small ridge for degree 0 too: if all directions are equal, A is singular up to rounding.
    let least = 1e-6 * f64::from(a[0]);
    let mut l = [[0.0_f64; MOST]; MOST];
    let mut at = 0;
    for i in 0..count {
        for j in 0..=i {
            let mut sum = f64::from(a[at]) - (0..j).map(|k| l[i][k] * l[j][k]).sum::<f64>();
            at += 1;
            if i == j {
                sum += least + if i > 0 { f64::from(ridge) } else { 0.0 };
                l[i][i] = sum.max(least).sqrt();
            } else {
                l[i][j] = sum / l[j][j];
            }
        }
    }
    for (x, g) in x.chunks_exact_mut(count).zip(g.chunks_exact(count)) {
        let mut y = [0.0_f64; MOST];
        for i in 0..count {
            let pull = if i > 0 { ridge * x[i] } else { 0.0 };
            y[i] = (f64::from(g[i] - pull) - (0..i).map(|k| l[i][k] * y[k]).sum::<f64>()) / l[i][i];
        }
        for i in (0..count).rev() {
            y[i] = (y[i] - (i + 1..count).map(|k| l[k][i] * y[k]).sum::<f64>()) / l[i][i];
            x[i] += y[i] as f32;
        }
    }
}
