//! The adaptive robust loss (Barron, "A General and Adaptive Robust Loss Function", CVPR 2019), which learns how heavy the tails of the
//! errors are.
//!
//! With residual x, shape α and scale c (eq. 1 for 0 < α < 2)
//!
//! ρ(x, α, c) = (2 − α)/α · (((x/c)² / (2 − α) + 1)^{α/2} − 1).
//!
//! It interpolates between the Cauchy loss (α → 0), Charbonnier's loss (α = 1) and the squared error (α → 2). Minimising ρ over α as well
//! would always give α = 0. The loss is therefore the negative log-likelihood −ln p = ρ + ln c + ln Z(α) (eq. 16). Its partition function
//!
//! Z(α) = ∫ exp(−ρ(x, α, 1)) dx
//!
//! adds a cost for heavy tails. Barron approximates ln Z by a spline. Here it is computed to rounding error, as a graph of small ops that
//! is differentiable any number of times: see [`log_partition`].

use super::{Objective, Step};
use autograd::optim::Schedule;
use autograd::{Param, Real, Tensor};

/// Initial values and learning rate of the adaptive robust loss. Shape and scale are learned for each of the three color channels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdaptiveRobust {
    /// Shape α before the first step, in (0.001, 1.999).
    pub shape: f64,
    /// Scale c before the first step, sRGB in [0, 1], above 0: about the size of errors that are not outliers.
    pub scale: f64,
    /// Learning rate of both parameters.
    pub rate: f64,
}

/// Shape 1, the middle of its range, as in Barron. Scale 0.1 and rate 0.01 are our choice.
impl Default for AdaptiveRobust {
    fn default() -> Self {
        AdaptiveRobust { shape: 1.0, scale: 0.1, rate: 0.01 }
    }
}

/// Range of α. At both ends the formulas are limits that cannot be evaluated (Barron, appendix D).
const SHAPES: [f64; 2] = [0.001, 1.999];

impl<T: Real, M: 'static> Objective<T, M> {
    /// Adds the adaptive robust loss of the prediction: the mean over rays and channels of −ln p. Its parameters are `<name>.shape` `[3]`,
    /// with α = 0.001 + 1.998 sigmoid(·), and `<name>.scale` `[3]`, with c = exp(·).
    ///
    /// Panics if shape or scale are out of range.
    #[track_caller]
    pub fn with_adaptive_robust(self, name: &str, weight: impl Schedule + 'static, start: AdaptiveRobust) -> Self {
        let [low, high] = SHAPES;
        let share = (start.shape - low) / (high - low);
        assert!(share > 0.0 && share < 1.0, "adaptive robust loss: shape {} is not in ({low}, {high})", start.shape);
        assert!(start.scale > 0.0 && start.scale.is_finite(), "adaptive robust loss: scale {} is not finite and above 0", start.scale);
        let param = |suffix: &str, value: f64| Param::from_tensor(format!("{name}.{suffix}"), Tensor::full(&[3], value));
        let objective = self.with_param(param("shape", (share / (1.0 - share)).ln()), start.rate);
        let objective = objective.with_param(param("scale", start.scale.ln()), start.rate);
        let (shape, scale) = (format!("{name}.shape"), format!("{name}.scale"));
        objective.with(name, weight, move |step: &Step<'_, T, M>| {
            let residual = &step.prediction - &step.batch.target;
            let alpha = (SHAPES[1] - SHAPES[0]) * step.param(&shape).sigmoid() + SHAPES[0];
            step.batch.mean(&negative_log_likelihood(&residual, &alpha, step.param(&scale)))
        })
    }
}

/// Returns −ln p `[n, k]` of residuals `[n, k]`, for shapes α and logarithms of scales c `[k]`: ρ(x, α, c) + ln c + ln Z(α).
fn negative_log_likelihood<T: Real>(residual: &Tensor<T>, alpha: &Tensor<T>, log_scale: &Tensor<T>) -> Tensor<T> {
    let two_minus = 2.0 - alpha;
    let squared = residual.square() * ((-2.0 * log_scale).exp() / &two_minus);
    let power = (squared + 1.0).ln() * (0.5 * alpha);
    let rho = &two_minus / alpha * exp_m1(&power);
    rho + (log_scale + log_partition(alpha))
}

/// Returns ln Z(α) of shapes `[k]`.
///
/// With x = √(2 − α) sinh u the integrand is √(2 − α) cosh u · exp(−(2 − α)/α · (coshᵅ u − 1)). It is analytic in a strip of half width π/4
/// around the real axis and decreases at least as fast as e^{−|u|}. The trapezoidal rule therefore converges exponentially: with step 1/8
/// up to u = 40 its relative error is below 10⁻¹⁵ (Trefethen and Weideman 2014).
pub(crate) fn log_partition<T: Real>(alpha: &Tensor<T>) -> Tensor<T> {
    const STEP: f64 = 0.125;
    const NODES: usize = 320;
    // ln cosh u = u + ln((1 + e^{−2u}) / 2), without overflow.
    let node = |k: usize| k as f64 * STEP;
    let log_cosh = (0..NODES).map(|k| T::lit(node(k) + (0.5 * (1.0 + (-2.0 * node(k)).exp())).ln()));
    let log_cosh = Tensor::from_vec(log_cosh.collect(), &[1, NODES]);
    // The integrand is even: every node but the middle one counts twice.
    let weights = (0..NODES).map(|k| T::lit(if k == 0 { STEP } else { 2.0 * STEP }));
    let weights = Tensor::from_vec(weights.collect(), &[1, NODES]);
    let (a, two_minus) = (alpha.unsqueeze(1), (2.0 - alpha).unsqueeze(1));
    let exponent = &log_cosh - two_minus / &a * exp_m1(&(a * &log_cosh));
    (exponent.exp() * weights).sum_axis(1).ln() + 0.5 * (2.0 - alpha).ln()
}

/// Returns eˣ − 1, without cancellation near 0.
fn exp_m1<T: Real>(x: &Tensor<T>) -> Tensor<T> {
    -(-x).one_minus_exp_neg()
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::Gradcheck;
    use ndarray::{arr1, arr2};

    fn partition(alpha: f64) -> f64 {
        log_partition(&Tensor::constant(arr1(&[alpha]))).item().exp()
    }

    #[test]
    fn the_partition_function_has_its_known_values() {
        // α = 1: 2 e K₁(1). α → 0, 1 / (1 + x²/2): √2 π. α → 2, the normal distribution: √(2 π).
        let k1 = 0.601_907_230_197_234_6;
        assert!((partition(1.0) / (2.0 * std::f64::consts::E * k1) - 1.0).abs() < 1e-13, "{}", partition(1.0));
        assert!((partition(1e-6) / (2f64.sqrt() * std::f64::consts::PI) - 1.0).abs() < 1e-5, "{}", partition(1e-6));
        assert!((partition(2.0 - 1e-9) / (2.0 * std::f64::consts::PI).sqrt() - 1.0).abs() < 1e-7, "{}", partition(2.0 - 1e-9));
    }

    #[test]
    fn the_partition_function_is_the_integral() {
        // Midpoint rule in y, with x = tan(πy/2) and many nodes.
        for alpha in [0.3, 0.7, 1.5, 1.9, 1.999] {
            let n = 2_000_000;
            let rho = |x: f64| (2.0 - alpha) / alpha * ((x * x / (2.0 - alpha) + 1.0f64).powf(0.5 * alpha) - 1.0);
            let half_pi = std::f64::consts::FRAC_PI_2;
            let integrand = |y: f64| (-rho((half_pi * y).tan())).exp() * half_pi / (half_pi * y).cos().powi(2);
            let sum: f64 = (0..n).map(|i| integrand((i as f64 + 0.5) / n as f64)).sum();
            let integral = 2.0 * sum / n as f64;
            assert!((partition(alpha) / integral - 1.0).abs() < 1e-9, "α = {alpha}: {} against {integral}", partition(alpha));
        }
    }

    #[test]
    fn its_derivatives_agree_with_finite_differences() {
        let alpha = arr1(&[0.02, 0.4, 1.0, 1.7, 1.95]).into_dyn();
        Gradcheck::new(|x: &[Tensor<f64>]| log_partition(&x[0]), vec![alpha])
            .named("ln Z")
            .order(2)
            .run()
            .unwrap_or_else(|e| panic!("{e}"));
        let residuals = arr2(&[[0.3, -0.01, 2.0], [-0.7, 0.2, 0.1]]).into_dyn();
        let (alpha, log_scale) = (arr1(&[0.3, 1.0, 1.9]).into_dyn(), arr1(&[-1.0, 0.2, -3.0]).into_dyn());
        Gradcheck::new(|x: &[Tensor<f64>]| negative_log_likelihood(&x[0], &x[1], &x[2]), vec![residuals, alpha, log_scale])
            .named("adaptive robust loss")
            .order(2)
            .run()
            .unwrap_or_else(|e| panic!("{e}"));
    }

    #[test]
    fn at_a_shape_of_one_it_is_the_loss_of_charbonnier() {
        let residual = Tensor::constant(arr2(&[[0.5], [-2.0]]));
        let loss = negative_log_likelihood(&residual, &Tensor::constant(arr1(&[1.0])), &Tensor::constant(arr1(&[0.5f64.ln()])));
        for (got, x) in loss.data().iter().zip([0.5f64, -2.0]) {
            let want = ((x / 0.5).powi(2) + 1.0).sqrt() - 1.0 + 0.5f64.ln() + partition(1.0).ln();
            assert!((got - want).abs() < 1e-12, "{got} against {want}");
        }
    }
}
