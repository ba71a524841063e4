//! Less matter, and less of it spread along a ray.

use super::Step;
use autograd::{Real, Tensor};

/// Mean over rays of Σ ln(1 + 2σᵢ²) (PlenOctrees; svox2 sums over rays instead, so its weight is this one's divided by the batch).
pub fn cauchy_sparsity<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.rendered.sparsity().mean()
}

/// Mean over rays of the distortion (mip-NeRF 360), with distances in units of the side of the box.
pub fn distortion<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.rendered.distortion().mean() / step.extent
}
