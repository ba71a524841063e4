//! Corrections of the poses of the training views, trained together with the scene.
//!
//! The poses of a capture are estimates. A field that has to agree with poses that are slightly off is blurred. Here each training view has a correction of its
//! rotation and of its position. The trainer applies it to the rays of the view ([`train::poses`](crate::train::poses)); the loss keeps it small. Related work: BARF
//! (Lin et al. 2021); the camera optimizer of nerfstudio, whose mode `SO3xR3` has the same six numbers for each view, and a penalty.

use super::Objective;
use autograd::optim::{Exponential, Schedule};
use autograd::{Param, Real, Tensor};

/// Name of the loss and of its parameter, `[views, 6]`.
pub const POSES: &str = "poses";

/// Learning rate of the corrections at the first step, in rad and in units of the spread of the cameras. lego at 100 x 100, poses with errors of 0.5 degrees and
/// 1 % of the distance, which are 2.68 pixels: 0.49 pixels are left with 5e-4 after 800 steps, 0.72 pixels with 2e-3 after 1000 steps.
pub const POSE_RATE: f64 = 5e-4;

/// Share of the learning rate that is left at the end of the run.
const LAST: f64 = 0.01;

impl<T: Real, M> Objective<T, M> {
    /// Adds a correction of the pose of each of the `views` training views. The loss is the mean square of the corrections.
    ///
    /// Panics if the objective already has corrections of poses.
    #[track_caller]
    pub fn with_poses(self, weight: impl Schedule + 'static, views: usize) -> Self {
        let objective = self.with_param(Param::from_tensor(POSES, Tensor::zeros(&[views, 6])), POSE_RATE);
        objective.with(POSES, weight, |step| step.param(POSES).square().mean())
    }

    /// Lets the learning rate of the corrections fall exponentially from `rate` to 1 % of it over a run of `steps` steps.
    ///
    /// Panics if the objective has no corrections of poses.
    #[track_caller]
    pub fn with_pose_rate(self, rate: f64, steps: u64) -> Self {
        self.with_rate(POSES, Exponential::new(rate, LAST * rate, steps))
    }
}
