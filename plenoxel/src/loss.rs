//! Losses and their weighted sum.
//!
//! A loss is a function from a training step to a scalar tensor. Built-in losses and closures are used in the same way:
//!
//! ```
//! use plenoxel::loss::mse;
//! use plenoxel::model::plenoxels::Objective;
//! let objective = Objective::<f32>::new()
//!     .with("mse", 1.0, mse)
//!     .with("bright", 0.01, |step| step.batch.mean(&(1.0 - &step.rendered.rgb).square()));
//! assert_eq!(objective.names().collect::<Vec<_>>(), ["mse", "bright"]);
//! ```
//!
//! Means over rays are those of [`RayBatch::mean`](crate::rays::RayBatch::mean): pixels may differ in how often they are drawn, and views in their weight.
//!
//! A loss may have parameters, which are trained together with the model ([`Objective::with_param`]): for example the shape of
//! [`robust`](AdaptiveRobust), or the exposure of each view ([`Objective::with_exposure`]). Losses compare the prediction with the
//! photographs. The prediction is the rendered color, unless [`Objective::predicting`] changes it.

mod exposure;
mod objective;
mod opacity;
mod outlier_views;
mod photometric;
mod poses;
mod robust;
mod sparsity;
mod total_variation;

pub use exposure::EXPOSURE;
pub use objective::{Evaluation, NAMES, Objective, Step};
pub use opacity::{beta, entropy, opacity_supervision};
pub use outlier_views::{OUTLIER_VIEWS, ViewWeight};
pub use photometric::{charbonnier, huber, mse, random_background, sample_color};
pub use poses::{POSE_RATE, POSES};
pub use robust::AdaptiveRobust;
pub use sparsity::{cauchy_sparsity, distortion};
pub use total_variation::{Cells, sampled_total_variation, total_variation, total_variation_of_bricks, tv_color, tv_density};
