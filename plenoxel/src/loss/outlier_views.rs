//! Smaller weights for training views that do not fit the others.
//!
//! Some photographs of a capture disagree with the rest: something moved, a stabilizer bent the picture, the pose is wrong. A field that is trained for long follows
//! such a view, and pictures near it become worse. Its error stays above that of the other views. So the mean squared error eᵥ of each view v is learned by the loss
//!
//! mean over rays of (r + 10⁻⁸) / eᵥ + ln eᵥ,
//!
//! where r is the squared error of a ray of v, as a constant. Its minimum is at the mean of r + 10⁻⁸. Only its gradient counts; a constant is subtracted, so that its
//! value is 0. The views are compared by the modified z-score (Iglewicz and Hoaglin 1993) of sᵥ = ln eᵥ:
//!
//! zᵥ = (sᵥ − median s) / max(1.4826 median |s − median s|, 0.1).
//!
//! 1.4826 times the median deviation is the standard deviation of normal numbers. Where views differ much, a hard view therefore keeps its weight. The rays of a view
//! have the weight
//!
//! wᵥ = max(0.1, exp(−½ max(0, zᵥ − 2.5)²))
//!
//! in all means over rays ([`RayBatch::mean`](crate::rays::RayBatch::mean)). Views that no ray was drawn from have weight 1, and do not count in the medians. With
//! Adam, what only one view shows is still learned, for its steps do not depend on the size of a gradient.

use super::{Objective, Step};
use autograd::optim::Schedule;
use autograd::{Indices, Param, Real, Tensor};
use serde::Serialize;

/// Name of the loss and of its parameter s, `[views, 1]`.
pub const OUTLIER_VIEWS: &str = "outlier_views";

/// Mean squared error of a view before its first ray. A view whose error is exactly this one has had no ray.
const FIRST: f64 = 0.01;
/// Squared error of a ray that is exact; without it, s of a view that is exact would fall without end.
const SMALLEST_ERROR: f64 = 1e-8;
/// Learning rate of s.
const RATE: f64 = 0.01;
/// Smallest standard deviation of s; 0.1 are 0.43 dB.
const SMALLEST_DEVIATION: f64 = 0.1;
/// Standard deviations up to which a view has weight 1.
const TYPICAL: f64 = 2.5;
/// Smallest weight of a view.
const SMALLEST_WEIGHT: f64 = 0.1;

/// Weight of a training view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewWeight {
    /// Name of the view.
    pub name: String,
    /// Weight of its rays, in [0.1, 1].
    pub weight: f64,
}

impl<T: Real, M: 'static> Objective<T, M> {
    /// Gives smaller weights to the rays of those of the `views` training views that do not fit the others. The weights of the views hardly depend
    /// on `weight`; in steps where it is 0, they stay as they are.
    ///
    /// Panics if the objective has them already.
    #[track_caller]
    pub fn with_outlier_views(self, weight: impl Schedule + 'static, views: usize) -> Self {
        let objective = self.with_param(Param::from_tensor(OUTLIER_VIEWS, Tensor::full(&[views, 1], FIRST.ln())), RATE);
        objective.with(OUTLIER_VIEWS, weight, learned_errors)
    }
}

impl<T: Real, M> Objective<T, M> {
    /// Returns the weight of each training view; `None` without [`with_outlier_views`](Self::with_outlier_views).
    pub(crate) fn view_weights(&self) -> Option<Vec<f64>> {
        let first = T::lit(FIRST.ln());
        let logarithms = self.param(OUTLIER_VIEWS)?.data().iter().map(|&s| (s != first).then(|| s.as_f64()));
        Some(weights(&logarithms.collect::<Vec<_>>()))
    }
}

/// Returns 0, with the gradient of the mean of (r + 10⁻⁸) / eᵥ + ln eᵥ.
fn learned_errors<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let errors = (&step.prediction - &step.batch.target).square().mean_axis(1).detach() + SMALLEST_ERROR;
    let logarithms = step.param(OUTLIER_VIEWS).gather_rows(&Indices::from(step.batch.view.clone())).reshape(&[step.batch.len()]);
    let loss = step.batch.mean(&misfit(&errors, &logarithms));
    &loss - loss.detach()
}

/// Returns r exp(−s) + s, `[n]`.
fn misfit<T: Real>(errors: &Tensor<T>, logarithms: &Tensor<T>) -> Tensor<T> {
    errors * (-logarithms).exp() + logarithms
}

/// Returns the weights of views from the logarithms of their mean squared errors; `None` for a view that no ray was drawn from.
fn weights(logarithms: &[Option<f64>]) -> Vec<f64> {
    let known: Vec<f64> = logarithms.iter().copied().flatten().collect();
    let middle = median(&known);
    let distances: Vec<f64> = known.iter().map(|s| (s - middle).abs()).collect();
    let deviation = (1.4826 * median(&distances)).max(SMALLEST_DEVIATION);
    let weight = |s: f64| {
        let excess = ((s - middle) / deviation - TYPICAL).max(0.0);
        (-0.5 * excess * excess).exp().max(SMALLEST_WEIGHT)
    };
    logarithms.iter().map(|s| s.map_or(1.0, weight)).collect()
}

/// Returns the middle of some numbers, or the mean of the two in the middle; 0 without numbers.
fn median(numbers: &[f64]) -> f64 {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => 0.0,
        n => 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::Gradcheck;
    use ndarray::arr1;

    #[test]
    fn the_loss_is_least_at_the_mean_error_and_agrees_with_finite_differences() {
        let errors = arr1(&[0.02, 0.05, 0.11]).into_dyn();
        let of_errors = |x: &[Tensor<f64>]| misfit(&x[0], &x[1]).mean();
        let inputs = vec![errors.clone(), arr1(&[-3.0, -2.5, -4.0]).into_dyn()];
        Gradcheck::new(of_errors, inputs).named("misfit").order(2).run().unwrap_or_else(|e| panic!("{e}"));
        let s = Tensor::variable(arr1(&[0.06f64.ln(); 3]));
        let gradient: f64 = misfit(&Tensor::constant(errors), &s).mean().backward().array(&s).iter().sum();
        assert!(gradient.abs() < 1e-12, "{gradient}");
    }

    #[test]
    fn a_view_that_is_much_worse_than_the_views_differ_has_a_small_weight() {
        // With a sixth view, the median is −5.95 or −6.05, and the median deviation 0.15: a standard deviation of 0.22.
        let others = [-6.2, -6.1, -6.0, -5.9, -5.8];
        let weights = |all: &[f64]| super::weights(&all.iter().copied().map(Some).collect::<Vec<_>>());
        let of = |last: f64| weights(&[&others[..], &[last]].concat());
        assert_eq!(of(-5.6), [1.0; 6]);
        assert_eq!(of(-7.0), [1.0; 6]);
        let outlier = of(-4.0);
        assert!(outlier[..5] == [1.0; 5] && outlier[5] == SMALLEST_WEIGHT);
        let between = of(-5.2)[5];
        assert!(between > SMALLEST_WEIGHT && between < 1.0, "{between}");
        // Views that differ more, and as many as one view.
        assert_eq!(weights(&[-8.0, -7.0, -6.0, -5.0, -4.0]), [1.0; 5]);
        assert_eq!(weights(&[-5.0]), [1.0]);
        assert!(weights(&[]).is_empty());
        assert_eq!(super::weights(&[None, None, Some(-6.0), Some(-6.1), None]), [1.0; 5]);
    }
}
