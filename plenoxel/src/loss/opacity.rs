//! Losses on the opacity of rays.

use super::Step;
use autograd::{Real, Tensor};

/// Returns the mean of (opacity − α)², where α is the alpha channel of the photograph. It uses information that training over a white
/// background does not; mention it when comparing results.
pub fn opacity_supervision<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.batch.mean(&(&step.rendered.opacity - &step.batch.alpha).square())
}

/// Returns the mean binary entropy −o ln o − (1 − o) ln(1 − o) of the opacity (DirectVoxGO). It makes rays opaque or empty. The opacity is
/// clamped to [10⁻⁶, 1 − 10⁻⁶]; clamped rays have no gradient.
pub fn entropy<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let o = step.rendered.opacity.clamp(1e-6, 1.0 - 1e-6);
    let clear = 1.0 - &o;
    -step.batch.mean(&(&o * o.ln() + &clear * clear.ln()))
}

/// Returns the mean of ln T_N + ln(1 − T_N + 10⁻³): the beta prior of Neural Volumes on the transmittance, in svox2's regularised form.
/// svox2 regularises the derivative only; here the derivative is that of the value.
pub fn beta<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    step.batch.mean(&(&step.rendered.log_transmittance + (&step.rendered.opacity + 1e-3).ln()))
}
