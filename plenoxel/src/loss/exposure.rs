//! Exposure and white balance of each photograph, trained together with the scene.
//!
//! Cameras choose exposure and white balance for each picture. A field that has to explain the differences forms fog in front of the
//! cameras. Here each training view v has a color matrix Aᵥ that multiplies the light of the field, but not the background:
//!
//! C = Aᵥ (C_field − T_N b) + T_N b,  Aᵥ = I + Dᵥ − mean over views of D.
//!
//! The mean of all matrices is the identity, so the field has the mean exposure of the photographs. Test views are rendered with the
//! identity. Related work: svox2 has per-view color matrices; nerfstudio's bilateral grids are larger; Urban Radiance Fields (Rematas et
//! al. 2022) computes 3 x 3 matrices from a learned code per view.

use super::{Objective, Step};
use autograd::optim::Schedule;
use autograd::{Indices, Param, Real, Tensor};

/// Name of the loss and of its parameter D, `[views, 9]`.
pub const EXPOSURE: &str = "exposure";

/// Learning rate of the matrices. Our choice: on the built-in scene with spread exposures, validation PSNR was 32.73, 32.80 and 32.76 dB with 2e-3, 5e-3 and 1e-2.
const RATE: f64 = 5e-3;

impl<T: Real, M: 'static> Objective<T, M> {
    /// Adds a color matrix for each of the `views` training views. The prediction becomes the rendered color times the matrix of its view.
    /// The loss is the mean square of D, which keeps the matrices near the identity.
    ///
    /// Panics if the objective already has an exposure.
    #[track_caller]
    pub fn with_exposure(self, weight: impl Schedule + 'static, views: usize) -> Self {
        let objective = self.with_param(Param::from_tensor(EXPOSURE, Tensor::zeros(&[views, 9])), RATE).predicting(exposed);
        objective.with(EXPOSURE, weight, |step| step.param(EXPOSURE).square().mean())
    }
}

/// Returns the colors `[n, 3]` with the exposure of their rays' views.
fn exposed<T: Real, M>(step: &Step<'_, T, M>) -> Tensor<T> {
    let background = Tensor::from_vec(step.background.map(|c| T::lit(f64::from(c))).to_vec(), &[1, 3]);
    let behind = step.rendered.log_transmittance.exp().unsqueeze(1) * background;
    through_matrices(&step.prediction, &behind, step.param(EXPOSURE), &Indices::from(step.batch.view.clone()))
}

/// Returns A (C − B) + B for colors C and their background part B, `[n, 3]`, where A is the matrix of each ray's view from the table D,
/// `[views, 9]`.
fn through_matrices<T: Real>(colors: &Tensor<T>, behind: &Tensor<T>, table: &Tensor<T>, views: &Indices) -> Tensor<T> {
    let deviations = table - table.mean_axis(0).unsqueeze(0);
    let of_rays = deviations.gather_rows(views).reshape(&[views.len(), 3, 3]);
    colors + (of_rays * (colors - behind).unsqueeze(1)).sum_axis(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::Gradcheck;
    use ndarray::{Array, arr2};

    #[test]
    fn matrices_act_on_what_the_field_emits_and_have_the_identity_as_their_mean() {
        let colors = Tensor::constant(arr2(&[[0.5, 0.25, 1.0], [0.5, 0.25, 1.0]]));
        let behind = Tensor::constant(arr2(&[[0.25, 0.25, 0.25], [0.25, 0.25, 0.25]]));
        // View 0 doubles red and view 1 removes it: the deviations from the mean are +0.5 and -0.5.
        let mut table = Array::zeros((2, 9));
        table[[0, 0]] = 1.0;
        let shown = through_matrices(&colors, &behind, &Tensor::constant(table), &Indices::from(vec![0, 1]));
        assert_eq!(shown.data(), [0.625, 0.25, 1.0, 0.375, 0.25, 1.0]);
    }

    #[test]
    fn exposure_agrees_with_finite_differences() {
        let views = Indices::from(vec![0, 2, 2, 1]);
        let f = |x: &[Tensor<f64>]| through_matrices(&x[0], &x[1], &x[2], &views);
        let numbers =
            |rows: usize, width: usize, k: f64| Array::from_shape_fn((rows, width), |(i, j)| (k * (7 * i + j) as f64).sin()).into_dyn();
        let inputs = vec![numbers(4, 3, 1.1), numbers(4, 3, 0.7), numbers(3, 9, 1.7)];
        Gradcheck::new(f, inputs).named("exposure").order(2).run().unwrap_or_else(|e| panic!("{e}"));
    }
}
