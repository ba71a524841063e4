//! Losses on the difference between predicted and photographed colors.

use super::Step;
use crate::render::PerSample;
use autograd::random::Stream;
use autograd::{Real, Tensor};

/// Returns the mean over rays and channels of (C − C*)², where C is the prediction. The source paper sums over channels, which is weight 3.
pub fn mse<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.batch.mean(&(&step.prediction - &step.batch.target).square())
}

/// Returns the mean of (C − C*)² after prediction and photograph are composited over a random color of each ray, uniform in [0, 1]³, instead
/// of the background (Müller et al. 2022). Unlike over one color, a transparent pixel then never looks like matter of this color.
///
/// With transmittance T_N and the alpha channel α, another background changes C by T_N times, and C* by 1 − α times, the difference of the
/// colors. It uses information that training over a white background does not; mention it when comparing results.
pub fn random_background<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let n = step.batch.len();
    let colors = Stream::new(step.seed).named("background").numbered(step.number).uniform_tensor::<T>(&[n, 3], 0.0, 1.0);
    let change = colors - Tensor::from_vec(step.background.map(|c| T::lit(f64::from(c))).to_vec(), &[3]);
    let transparent = step.rendered.log_transmittance.exp() - (1.0 - &step.batch.alpha);
    step.batch.mean(&(&step.prediction - &step.batch.target + transparent.unsqueeze(1) * change).square())
}

/// Returns the mean of √((C − C*)² + ε²) with ε = 10⁻³, a smooth absolute error (Charbonnier et al. 1994).
pub fn charbonnier<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.batch.mean(&((&step.prediction - &step.batch.target).square() + 1e-6).sqrt())
}

/// Returns the mean of Huber's loss of the error r with threshold δ = 0.1: r² / 2 if |r| <= δ, otherwise δ (|r| − δ / 2).
///
/// With c = min(|r|, δ), both branches are c (|r| − c / 2), which needs no mask.
pub fn huber<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let error = (&step.prediction - &step.batch.target).abs();
    let c = error.minimum(&Tensor::scalar(T::lit(0.1)));
    step.batch.mean(&(&c * (&error - 0.5 * &c)))
}

/// Returns the mean over rays of Σ wᵢ |cᵢ − C*|² over the samples of a ray, where the weights wᵢ are constants (DirectVoxGO): each sample that is seen has about
/// the color of its pixel.
pub fn sample_color<T: Real, M>(step: &Step<'_, T, M>, samples: &PerSample<T>) -> Tensor<T> {
    let target = step.batch.target.segment_repeat(&samples.samples.offsets);
    let errors = (&samples.radiance.rgb - target).square().sum_axis(1);
    step.batch.mean(&(errors * samples.weights.detach()).segment_sum(&samples.samples.offsets))
}
