//! Exposure and white balance of each photograph, learned beside the scene.
//!
//! Cameras choose both anew for each picture. A field that has to explain the differences grows fog in front of the cameras. Here each
//! training view v has a color matrix Aᵥ, and a photograph shows Aᵥ times what the field emits, over the background:
//!
//! C = Aᵥ (C_field − T_N b) + T_N b,  Aᵥ = I + Dᵥ − mean over views of D.
//!
//! The mean of all matrices is the identity, so that the field keeps the mean exposure of the photographs; test views are rendered with the
//! identity. (Per-view color matrices: svox2 and nerfstudio's bilateral grids have larger ones; Urban Radiance Fields, Rematas et al. 2022, learn 3 x 3
//! matrices from a code for each view.)

use super::{Objective, Step};
use autograd::optim::Schedule;
use autograd::{Indices, Param, Real, Tensor};

/// Name of the loss and of its parameter D, `[views, 9]`.
pub const EXPOSURE: &str = "exposure";

/// Learning rate of the matrices: our choice, see `benches/RESULTS.md`.
const RATE: f64 = 5e-3;

impl<T: Real, M: 'static> Objective<T, M> {
    /// Learns a color matrix for each of the training views, of which there are `views`. The prediction becomes the rendered color times the matrix
    /// of its view; the loss is the mean square of D, which keeps the matrices near the identity.
    ///
    /// Panics if it was called before.
    #[track_caller]
    pub fn with_exposure(self, weight: impl Schedule + 'static, views: usize) -> Self {
        let objective = self.with_param(Param::from_tensor(EXPOSURE, Tensor::zeros(&[views, 9])), RATE).predicting(exposed);
        objective.with(EXPOSURE, weight, |step| step.param(EXPOSURE).square().mean())
    }
}

/// Colors `[n, 3]` as the views of their rays show them.
fn exposed<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let (table, n) = (step.param(EXPOSURE), step.batch.len());
    let deviations = table - table.mean_axis(0).unsqueeze(0);
    let of_rays = deviations.gather_rows(&Indices::from(step.batch.view.clone())).reshape(&[n, 3, 3]);
    let background = Tensor::from_vec(step.background.map(|c| T::lit(f64::from(c))).to_vec(), &[1, 3]);
    let emitted = &step.prediction - step.rendered.log_transmittance.exp().unsqueeze(1) * background;
    &step.prediction + (of_rays * emitted.unsqueeze(1)).sum_axis(2)
}
