//! Colors of an opaque grid, fitted to the photographs without gradients.
//!
//! Each voxel v has harmonics xᵥ and shows the color S(d)·xᵥ in direction d. The source paper's second extension is one small weighted
//! least-squares problem for each voxel on its own,
//!
//! ```text
//! min Σ wᵣᵥ |pᵣ − S(dᵣ)·xᵥ|² + λ Σ wᵣᵥ Σ_{k≥1} |xᵥₖ|²        over the rays r that see v with weight wᵣᵥ.
//! ```
//!
//! [`fit_exactly`] solves the normal equations Aᵥ xᵥ = bᵥ with Aᵥ = Σ w S Sᵀ + λ (Σ w) diag(0, 1, …, 1), bᵥ = Σ w S p. With degree 0 the
//! solution is the weighted mean of the paper's first extension. But several voxels share a pixel, Cᵣ = Σᵥ wᵣᵥ S(dᵣ)·xᵥ + rest, and the
//! visible error is that of Cᵣ. Joint sweeps therefore follow: xᵥ ← xᵥ + Aᵥ⁻¹ (Σ w S (pᵣ − Cᵣ) − ridge). The weights of a ray sum to at
//! most 1, so the sum of the voxels' own problems is a convex upper bound of the sum over rays that touches it at x (Jensen). Every sweep
//! therefore decreases Σᵣ |pᵣ − Cᵣ|² plus its ridge while colors are not clamped, and no rate has to be chosen.
//!
//! [`fit_by_descent`] is the paper's stochastic gradient descent, with its lost updates fixed.

use super::light::{Light, Opaque, Pixel, object_pixels};
use crate::dataset::View;
use crate::field::neighbours::smoothed;
use crate::field::sh;
use crate::field::sh::least_squares::improve;
use crate::random::{Permutation, Purpose};
use autograd::{Lattice, parallel};

/// Inputs of a fit.
pub struct Seen<'a> {
    /// Voxels.
    pub opaque: &'a Opaque<'a>,
    /// Lattice that maps voxels to rows.
    pub lattice: &'a Lattice,
    /// Photographs.
    pub views: &'a [View],
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Degree of the harmonics.
    pub degree: usize,
    /// Color of zero coefficients.
    pub offset: f32,
}

/// Result of a fit.
pub struct Fitted {
    /// Coefficients of every row, all of red, then green, then blue: `[rows, 3 (degree + 1)²]`. Those of voxels that no pixel shows are 0.
    pub table: Vec<f32>,
    /// Fraction of object pixels that show no voxel.
    pub missed: f64,
}

/// Bytes of [`Light`] that a fit keeps from one pass to the next.
pub const KEPT_LIGHT: usize = 1 << 28;
/// Number of passes of [`fit_by_descent`] over the pixels.
pub const EPOCHS: usize = RATES.len();
const RATES: [f32; 4] = [0.9, 0.9, 0.1, 0.1];

impl Seen<'_> {
    fn count(&self) -> usize {
        sh::count(self.degree)
    }

    fn light(&self, pixels: &[Pixel]) -> Light {
        self.opaque.light(self.views, pixels, self.background, self.degree)
    }

    /// Sets the value of each pixel to its color minus the color of the voxels.
    fn compare(&self, light: &mut Light, table: &[f32]) {
        let count = self.count();
        light.say_errors(|row, basis| {
            let row = &table[row * 3 * count..][..3 * count];
            [0, 1, 2].map(|c| (self.offset + dot(&row[c * count..][..count], basis)).max(0.0))
        });
    }
}

/// Passes over the light of all object pixels in batches. The first batches are kept for the next pass.
struct Passes<'a> {
    seen: &'a Seen<'a>,
    kept: Vec<Light>,
    /// Bytes left for further batches.
    room: usize,
}

impl<'a> Passes<'a> {
    fn new(seen: &'a Seen<'a>) -> Self {
        Passes { seen, kept: Vec::new(), room: KEPT_LIGHT }
    }

    fn pass(&mut self, mut f: impl FnMut(&mut Light)) {
        self.kept.iter_mut().for_each(&mut f);
        for pixels in object_pixels(self.seen.views).skip(self.kept.len()) {
            let mut light = self.seen.light(&pixels);
            f(&mut light);
            self.room = self.room.saturating_sub(light.bytes());
            if self.room > 0 {
                self.kept.push(light);
            }
        }
    }
}

/// Solves every voxel's own problem, then runs `sweeps` joint sweeps. `passed(passes)` is called after each pass.
pub fn fit_exactly(seen: &Seen<'_>, ridge: f32, sweeps: usize, passed: &dyn Fn(usize)) -> Fitted {
    let count = seen.count();
    let (triangle, width) = (count * (count + 1) / 2, 3 * count);
    let rows = seen.lattice.rows();
    // One pass for both sides: the triangle of A, then b.
    let mut sides = vec![0.0_f32; rows * (triangle + width)];
    let (mut pixels_all, mut pixels_missed) = (0, 0);
    let mut passes = Passes::new(seen);
    passes.pass(|light| {
        pixels_all += light.pixels();
        pixels_missed += light.missed();
        light.for_each_part([(&mut sides, triangle + width)], |hits, [sides]| {
            for hit in hits.iter() {
                let (a, b) = sides[hit.row * (triangle + width)..][..triangle + width].split_at_mut(triangle);
                let mut at = 0;
                for i in 0..count {
                    for (a, s) in a[at..=at + i].iter_mut().zip(hit.basis) {
                        *a += hit.weight * hit.basis[i] * s;
                    }
                    at += i + 1;
                }
                add_products(b, count, hit.weight, hit.value.map(|color| color - seen.offset), hit.basis);
            }
        });
    });
    let weight: Vec<f32> = sides.chunks_exact(triangle + width).map(|row| row[0] / (sh::Y0 * sh::Y0) as f32).collect();
    // The right sides are the last numbers of each row of `right`, which has `of` numbers per row.
    let solve = |table: &mut [f32], right: &[f32], of: usize| {
        parallel::for_each_rows(table, width, |first, chunk| {
            for (r, x) in chunk.chunks_exact_mut(width).enumerate() {
                let row = first + r;
                if weight[row] > 0.0 {
                    let a = &sides[row * (triangle + width)..][..triangle];
                    improve(x, a, &right[(row + 1) * of - width..][..width], ridge * weight[row]);
                }
            }
        });
    };
    let mut table = vec![0.0; rows * width];
    solve(&mut table, &sides, triangle + width);
    passed(1);
    for sweep in 0..sweeps {
        let mut error = vec![0.0; rows * width];
        passes.pass(|light| {
            seen.compare(light, &table);
            light.for_each_part([(&mut error, width)], |hits, [error]| {
                for hit in hits.iter() {
                    add_products(&mut error[hit.row * width..][..width], count, hit.weight, hit.value, hit.basis);
                }
            });
        });
        solve(&mut table, &error, width);
        passed(sweep + 2);
    }
    Fitted { table, missed: pixels_missed as f64 / pixels_all as f64 }
}

/// Fits colors with the source paper's descent: rays of object pixels in random order, 5000 per step, rates 0.9, 0.9, 0.1, 0.1 in four
/// epochs, colors smoothed after the first. The paper's program keeps the update of only one of the rays that meet in a voxel. Here a voxel
/// moves by their mean,
///
/// ```text
/// xᵥ ← xᵥ + 2 rate Σ w S (pᵣ − Cᵣ) / Σ w,
/// ```
///
/// Here the composite includes the background, and rays are not jittered.
pub fn fit_by_descent(seen: &Seen<'_>, seed: u64, passed: &dyn Fn(usize)) -> Fitted {
    const RAYS: usize = 5000;
    let (count, width) = (seen.count(), 3 * seen.count());
    let mean = fit_exactly(&Seen { degree: 0, ..*seen }, 0.0, 0, &|_| {});
    passed(1);
    let mut table = vec![0.0; seen.lattice.rows() * width];
    for (row, mean) in table.chunks_exact_mut(width).zip(mean.table.chunks_exact(3)) {
        row.iter_mut().step_by(count).zip(mean).for_each(|(x, mean)| *x = *mean);
    }
    let pixels: Vec<Pixel> = object_pixels(seen.views).flatten().collect();
    // Σ w S (p − C), then Σ w, for each voxel; zero between steps.
    let mut sums = vec![0.0; seen.lattice.rows() * (width + 1)];
    for (epoch, rate) in RATES.into_iter().enumerate() {
        let order = Permutation::new(pixels.len() as u64, seed, Purpose::RayOrder, epoch as u64);
        for start in (0..pixels.len()).step_by(RAYS) {
            let batch: Vec<Pixel> = (start..(start + RAYS).min(pixels.len())).map(|i| pixels[order.at(i as u64) as usize]).collect();
            let mut light = seen.light(&batch);
            seen.compare(&mut light, &table);
            light.for_each_part([(&mut table, width), (&mut sums, width + 1)], |hits, [table, sums]| {
                for seen in hits.iter() {
                    let sums = &mut sums[seen.row * (width + 1)..][..width + 1];
                    add_products(&mut sums[..width], count, seen.weight, seen.value, seen.basis);
                    sums[width] += seen.weight;
                }
                for seen in hits.iter() {
                    let sums = &mut sums[seen.row * (width + 1)..][..width + 1];
                    if sums[width] > 0.0 {
                        let scale = 2.0 * rate / sums[width];
                        table[seen.row * width..][..width].iter_mut().zip(&*sums).for_each(|(x, sum)| *x += scale * sum);
                        sums.fill(0.0);
                    }
                }
            });
        }
        if epoch == 0 {
            table = smoothed(seen.lattice, &table, width);
        }
        passed(epoch + 2);
    }
    Fitted { table, missed: mean.missed }
}

/// Computes row += w S valueᶜ for the three channels.
#[inline(always)]
fn add_products(row: &mut [f32], count: usize, w: f32, value: [f32; 3], basis: &[f32]) {
    for (row, value) in row.chunks_exact_mut(count).zip(value) {
        for (x, s) in row.iter_mut().zip(basis) {
            *x += w * value * s;
        }
    }
}

fn dot(x: &[f32], y: &[f32]) -> f32 {
    x.iter().zip(y).map(|(x, y)| x * y).sum()
}
