//! Polynomial distortion of the image plane and its inverse.

use glam::{DMat2, DVec2, dvec2};
use std::f64::consts::{FRAC_PI_2, PI};

/// Most steps of Newton's method. It needs four to six within the image of a usual lens.
const NEWTON_STEPS: usize = 50;
/// Steps in the search for the fold along a radius, equally spaced in the angle to the axis.
const RADIAL_STEPS: usize = 256;
/// Directions in which the fold is searched, if it is not a circle.
const DIRECTIONS: usize = 32;

/// Distortion of the image plane, in focal lengths. With r² = x² + y²,
///
/// ```text
/// g  = (1 + k₁ r² + k₂ r⁴ + k₃ r⁶ + k₄ r⁸)/(1 + d₁ r² + d₂ r⁴ + d₃ r⁶)
/// x' = g x + 2 p₁ x y + p₂ (r² + 2 x²) + s₁ r²
/// y' = g y + 2 p₂ x y + p₁ (r² + 2 y²) + s₂ r²
/// ```
///
/// k are the coefficients `k1`, `k2`, `k3` of OpenCV, and `k4` of its fisheye lens and of nerfstudio; d are `k4`, `k5`, `k6` of OpenCV's
/// rational model; p are its tangential coefficients (decentred lenses), s the thin prism of COLMAP's THIN_PRISM_FISHEYE.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distortion {
    numerator: [f64; 4],
    denominator: [f64; 3],
    tangential: [f64; 2],
    prism: [f64; 2],
    /// Largest r without a fold. A fold that is not a circle is replaced by the largest circle inside of it.
    reach: f64,
}

impl Distortion {
    pub(super) fn of_perspective(numerator: [f64; 4], denominator: [f64; 3], tangential: [f64; 2]) -> Self {
        // r is the tangent of the angle to the axis. The last step, 90°, is not reached.
        let radius = |share: f64| (FRAC_PI_2 * share).tan();
        Distortion { numerator, denominator, tangential, prism: [0.0; 2], reach: f64::INFINITY }.within_fold(radius)
    }

    pub(super) fn of_fisheye(radial: [f64; 4], tangential: [f64; 2], prism: [f64; 2]) -> Self {
        // r is the angle to the axis itself.
        Distortion { numerator: radial, denominator: [0.0; 3], tangential, prism, reach: PI }.within_fold(|share| PI * share)
    }

    /// Reduces the reach to the fold. `radius` gives r at a share of all angles to the axis.
    fn within_fold(mut self, radius: impl Fn(f64) -> f64) -> Self {
        let is_circle = self.tangential == [0.0; 2] && self.prism == [0.0; 2];
        for direction in 0..if is_circle { 1 } else { DIRECTIONS } {
            let towards = DVec2::from_angle(2.0 * PI * direction as f64 / DIRECTIONS as f64);
            let at = |step: usize| radius(step as f64 / RADIAL_STEPS as f64);
            let Some(step) = (1..RADIAL_STEPS).find(|&step| !self.is_lens_at(at(step) * towards)) else { continue };
            let (mut inside, mut outside) = (at(step - 1), at(step));
            loop {
                let middle = 0.5 * (inside + outside);
                if middle <= inside || middle >= outside {
                    break;
                }
                *if self.is_lens_at(middle * towards) { &mut inside } else { &mut outside } = middle;
            }
            self.reach = self.reach.min(inside);
        }
        self
    }

    /// Returns true if the map neither folds nor has a pole at p.
    fn is_lens_at(&self, p: DVec2) -> bool {
        let r = p.length_squared();
        let [d1, d2, d3] = self.denominator;
        1.0 + r * (d1 + r * (d2 + r * d3)) > 0.0 && self.value_and_jacobian(p).1.determinant() > 0.0
    }

    /// Returns the image of p; `None` beyond the fold.
    pub(super) fn apply(&self, p: DVec2) -> Option<DVec2> {
        (p.length() <= self.reach).then(|| self.value_and_jacobian(p).0)
    }

    /// Returns the image of p and the Jacobian there, whose columns are the derivatives by x and y.
    #[inline]
    pub(super) fn value_and_jacobian(&self, p: DVec2) -> (DVec2, DMat2) {
        let ([k1, k2, k3, k4], [d1, d2, d3]) = (self.numerator, self.denominator);
        let ([p1, p2], [s1, s2]) = (self.tangential, self.prism);
        let DVec2 { x, y } = p;
        let r = p.length_squared();
        let below = 1.0 / (1.0 + r * (d1 + r * (d2 + r * d3)));
        let g = (1.0 + r * (k1 + r * (k2 + r * (k3 + r * k4)))) * below;
        // The derivative of g by r².
        let slope = ((k1 + r * (2.0 * k2 + r * (3.0 * k3 + r * 4.0 * k4))) - g * (d1 + r * (2.0 * d2 + r * 3.0 * d3))) * below;
        let value =
            dvec2(g * x + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x) + s1 * r, g * y + 2.0 * p2 * x * y + p1 * (r + 2.0 * y * y) + s2 * r);
        let mixed = 2.0 * (x * y * slope + p1 * x + p2 * y);
        let by_x = dvec2(g + 2.0 * (x * x * slope + p1 * y + (3.0 * p2 + s1) * x), mixed + 2.0 * s2 * x);
        let by_y = dvec2(mixed + 2.0 * s1 * y, g + 2.0 * (y * y * slope + p2 * x + (3.0 * p1 + s2) * y));
        (value, DMat2::from_cols(by_x, by_y))
    }

    /// Returns the point within the fold whose image is q, to rounding errors; `None` if there is none. Newton's method with the analytic
    /// Jacobian; steps that would leave the reach go half of the way to it.
    pub(super) fn invert(&self, q: DVec2) -> Option<DVec2> {
        let mut p = q.clamp_length_max(0.99 * self.reach);
        for _ in 0..NEWTON_STEPS {
            let (value, jacobian) = self.value_and_jacobian(p);
            let error = value - q;
            let step = jacobian.inverse() * error;
            let mut next = p - step;
            if next.length() > self.reach {
                next = next.normalize() * (0.5 * (p.length().min(self.reach) + self.reach));
            } else if step.length() <= 1e-12 * (1.0 + p.length()) || error.length() <= 4.0 * f64::EPSILON * q.length() {
                // Convergence is quadratic: the next step would be below the rounding errors.
                return Some(next);
            }
            p = next;
        }
        None
    }

    /// Returns the distance of the image of the fold from the centre, towards a direction; infinite without a fold.
    pub(super) fn image_radius(&self, towards: DVec2) -> f64 {
        match self.reach.is_finite() {
            true => self.value_and_jacobian(self.reach * towards.normalize_or_zero()).0.length(),
            false => f64::INFINITY,
        }
    }
}
