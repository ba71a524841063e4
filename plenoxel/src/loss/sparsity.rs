//! Losses that reduce matter, or its spread along a ray.

use super::Step;
use autograd::{Real, Tensor};

/// Returns the mean over rays of Σ ln(1 + 2σᵢ²) (PlenOctrees). svox2 sums over rays, so its weight is this weight divided by the number of
/// rays.
pub fn cauchy_sparsity<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.batch.mean(&step.rendered.sparsity())
}

/// Returns the mean over rays of the distortion (mip-NeRF 360). Distances are in units of the longest side of the box.
pub fn distortion<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.batch.mean(&step.rendered.distortion()) / step.extent
}
