//! Distance between rendered and photographed colors.

use super::Step;
use autograd::{Real, Tensor};

/// Mean over rays and channels of (C − C*)², C being the prediction. (The source paper sums over channels: weight 3.)
pub fn mse<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    (&step.prediction - &step.batch.target).square().mean()
}

/// Mean of √((C − C*)² + ε²) with ε = 10⁻³: absolute error with a smooth bottom (Charbonnier et al. 1994).
pub fn charbonnier<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    ((&step.prediction - &step.batch.target).square() + 1e-6).sqrt().mean()
}

/// Mean of Huber's loss with threshold δ = 0.1: r² / 2 for |r| <= δ, δ (|r| − δ / 2) beyond.
///
/// With c = min(|r|, δ) both branches are c (|r| − c / 2), which needs no mask.
pub fn huber<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let error = (&step.prediction - &step.batch.target).abs();
    let c = error.minimum(&Tensor::scalar(T::lit(0.1)));
    (&c * (&error - 0.5 * &c)).mean()
}
