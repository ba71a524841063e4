//! What a ray lets through.

use super::Step;
use autograd::{Real, Tensor};

/// Mean of (opacity − α)², α being the alpha channel of the photograph: uses what white-background comparisons leave unused, so say so
/// beside a figure.
pub fn opacity_supervision<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    (&step.rendered.opacity - &step.batch.alpha).square().mean()
}

/// Mean of the binary entropy −o ln o − (1 − o) ln(1 − o) of the opacity, kept off 0 and 1 by 10⁻⁶ (DirectVoxGO): rays should be
/// full or empty. No gradient flows where the bound holds.
pub fn entropy<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let o = step.rendered.opacity.clamp(1e-6, 1.0 - 1e-6);
    let clear = 1.0 - &o;
    -(&o * o.ln() + &clear * clear.ln()).mean()
}

/// Mean of ln T_N + ln(1 − T_N + 10⁻³): the beta prior of Neural Volumes on the transmittance, in svox2's regularised form.
/// (svox2 guards only the derivative; here value and derivative agree.)
pub fn beta<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    (&step.rendered.log_transmittance + (&step.rendered.opacity + 1e-3).ln()).mean()
}
