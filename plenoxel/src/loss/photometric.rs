//! Losses on the difference between predicted and photographed colors.

use super::Step;
use autograd::{Real, Tensor};

/// Returns the mean over rays and channels of (C − C*)², where C is the prediction. The source paper sums over channels, which is weight 3.
pub fn mse<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    (&step.prediction - &step.batch.target).square().mean()
}

/// Returns the mean of √((C − C*)² + ε²) with ε = 10⁻³, a smooth absolute error (Charbonnier et al. 1994).
pub fn charbonnier<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    ((&step.prediction - &step.batch.target).square() + 1e-6).sqrt().mean()
}

/// Returns the mean of Huber's loss of the error r with threshold δ = 0.1: r² / 2 if |r| <= δ, otherwise δ (|r| − δ / 2).
///
/// With c = min(|r|, δ), both branches are c (|r| − c / 2), which needs no mask.
pub fn huber<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let error = (&step.prediction - &step.batch.target).abs();
    let c = error.minimum(&Tensor::scalar(T::lit(0.1)));
    (&c * (&error - 0.5 * &c)).mean()
}
