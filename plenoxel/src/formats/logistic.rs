//! Colors that are the logistic function of harmonics, as in PlenOctrees, c = 1 / (1 + exp(−Σ Yₖ(d) cₖ)), and those of this crate, c =
//! max(0, ½ + Σ Yₖ(d) cₖ).
//!
//! A color that does not depend on the direction is converted exactly, if it is in (0, 1). Any other is fitted in the directions of a
//! quadrature of the sphere, which integrates products of two functions of degree 3 exactly.

use crate::field::sh;
use crate::field::sh::least_squares::improve;
use autograd::Tensor;
use std::f64::consts::TAU;

/// Positive nodes and the weights of the Gauss-Legendre quadrature in z (8 nodes).
const NODES: [(f64, f64); 4] = [
    (0.183_434_642_495_649_8, 0.362_683_783_378_361_96),
    (0.525_532_409_916_329, 0.313_706_645_877_887_3),
    (0.796_666_477_413_626_7, 0.222_381_034_453_374_48),
    (0.960_289_856_497_536_2, 0.101_228_536_290_376_26),
];
/// Most harmonics.
const MOST: usize = sh::count(sh::MAX_DEGREE);
/// Equal angles around z.
const ANGLES: usize = 12;
/// Smallest distance of a color from 0 and 1 that is converted. The logistic function reaches neither.
const LEAST: f32 = 1.0 / 1024.0;
/// Steps of Gauss-Newton after the first fit.
const STEPS: usize = 2;
/// Ridge of the fits, relative to the weight of all directions.
const RIDGE: f32 = 1e-4;

/// Harmonics of a degree in the directions of the quadrature.
#[derive(Debug)]
pub(super) struct Sphere {
    /// Number of harmonics.
    count: usize,
    /// `[directions, count]`.
    basis: Vec<f32>,
    /// Weights of the directions, which add up to 4π.
    weights: Vec<f32>,
}

impl Sphere {
    /// Evaluates the harmonics up to a degree of at most 3.
    pub fn new(degree: usize) -> Self {
        let (mut directions, mut weights) = (Vec::new(), Vec::new());
        for (z, weight) in NODES.into_iter().flat_map(|(z, weight)| [(z, weight), (-z, weight)]) {
            for k in 0..ANGLES {
                let (angle, radius) = (TAU * k as f64 / ANGLES as f64, (1.0 - z * z).sqrt());
                directions.extend([radius * angle.cos(), radius * angle.sin(), z]);
                weights.push((weight * TAU / ANGLES as f64) as f32);
            }
        }
        let basis = sh::basis(&Tensor::<f64>::from_vec(directions, &[weights.len(), 3]), degree);
        Sphere { count: sh::count(degree), basis: basis.data().iter().map(|value| *value as f32).collect(), weights }
    }

    /// Returns Σ Yₖ cₖ in each direction.
    fn sums<'a>(&'a self, coefficients: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        self.basis.chunks_exact(self.count).map(move |basis| basis.iter().zip(coefficients).map(|(y, c)| y * c).sum())
    }

    /// Converts the coefficients of a channel from logistic colors: the least-squares fit of degree `to`, which has the same directions.
    pub fn fit_plain(&self, from: &[f32], to: &Sphere, fitted: &mut [f32]) {
        fitted.fill(0.0);
        if from.len() == 1 {
            fitted[0] = (logistic(sh::Y0 as f32 * from[0]) - 0.5) / sh::Y0 as f32;
            return;
        }
        for ((sum, basis), weight) in self.sums(from).zip(to.basis.chunks_exact(to.count)).zip(&self.weights) {
            let color = weight * (logistic(sum) - 0.5);
            fitted.iter_mut().zip(basis).for_each(|(c, y)| *c += color * y);
        }
    }

    /// Converts the coefficients of a channel to logistic colors of the same degree.
    ///
    /// minimize Σ wᵢ (c(dᵢ) − logistic(Σ Yₖ(dᵢ) cₖ))², from the fit to ln(c / (1 − c)) with weights (c (1 − c))².
    pub fn fit_logistic(&self, from: &[f32], fitted: &mut [f32]) {
        let colors = |sum: f32| (0.5 + sum).clamp(LEAST, 1.0 - LEAST);
        fitted.fill(0.0);
        if from[1..].iter().all(|c| *c == 0.0) {
            fitted[0] = logit(colors(sh::Y0 as f32 * from[0])) / sh::Y0 as f32;
            return;
        }
        for step in 0..=STEPS {
            let (mut left, mut right) = ([0.0; MOST * (MOST + 1) / 2], [0.0; MOST]);
            let sums = self.sums(from).zip(self.sums(fitted)).zip(self.basis.chunks_exact(self.count)).zip(&self.weights);
            for (((sum, now), basis), weight) in sums {
                let color = colors(sum);
                let (slope, missing) = if step == 0 {
                    (color * (1.0 - color), logit(color))
                } else {
                    let is = logistic(now);
                    let slope = (is * (1.0 - is)).max(LEAST);
                    (slope, (color - is) / slope)
                };
                let weight = weight * slope * slope;
                let mut at = 0;
                for (k, y) in basis.iter().enumerate() {
                    right[k] += weight * missing * y;
                    for other in &basis[..=k] {
                        left[at] += weight * y * other;
                        at += 1;
                    }
                }
            }
            let (left, right) = (&left[..self.count * (self.count + 1) / 2], &right[..self.count]);
            improve(fitted, left, right, RIDGE * left[0]);
        }
    }
}

/// 1 / (1 + e⁻ˣ).
pub(super) fn logistic(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// ln(c / (1 − c)), the inverse of [`logistic`].
fn logit(color: f32) -> f32 {
    (color / (1.0 - color)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest difference of two functions of the directions.
    fn difference(a: impl Iterator<Item = f32>, b: impl Iterator<Item = f32>) -> f32 {
        a.zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn a_color_without_directions_is_converted_exactly() {
        let (sphere, plain) = (Sphere::new(2), Sphere::new(0));
        for color in [0.01_f32, 0.3, 0.5, 0.98] {
            let from = [(color - 0.5) / sh::Y0 as f32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            let (mut there, mut back) = ([1.0; 9], [1.0]);
            sphere.fit_logistic(&from, &mut there);
            plain.fit_plain(&there[..1], &plain, &mut back);
            assert!((logistic(there[0] * sh::Y0 as f32) - color).abs() < 1e-6 && (back[0] - from[0]).abs() < 1e-5, "{color}");
        }
    }

    #[test]
    fn a_color_that_depends_on_the_direction_is_fitted() {
        // Colors from 0.3 to 0.75.
        let from = [0.1_f32, 0.1, -0.15, 0.05, 0.08, -0.02, 0.04, 0.1, -0.06];
        let (sphere, finer) = (Sphere::new(2), Sphere::new(3));
        let (mut there, mut back) = ([0.0; 9], [0.0; 16]);
        sphere.fit_logistic(&from, &mut there);
        let colors: Vec<f32> = sphere.sums(&from).map(|sum| 0.5 + sum).collect();
        let logistics = || sphere.sums(&there).map(logistic);
        assert!(difference(colors.iter().copied(), logistics()) < 0.004, "{}", difference(colors.iter().copied(), logistics()));
        sphere.fit_plain(&there, &finer, &mut back);
        let again = || finer.sums(&back).map(|sum| 0.5 + sum);
        assert!(difference(logistics(), again()) < 0.002, "{}", difference(logistics(), again()));
    }
}
