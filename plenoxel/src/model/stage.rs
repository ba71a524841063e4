//! Stages of models whose resolution grows.

use crate::error::{Error, Result};
use crate::train::StageLength;
use serde::{Deserialize, Serialize};

/// Most nodes along an axis of a cube.
pub(super) const MOST_NODES: usize = 4096;

/// A stage of training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Nodes along each axis if the box is a cube. Another box has as many cells, with about equal sides.
    pub resolution: usize,
    /// Steps.
    pub steps: u64,
    /// Rays per step.
    pub rays: usize,
}

impl Stage {
    /// Checks the numbers. `key` names the stage in errors.
    pub(super) fn validate(&self, key: &str) -> Result<()> {
        let check = |valid: bool, field: &str, value: u64, expected: &str| match valid {
            true => Ok(()),
            false => Err(Error::config(format!("{key}.{field}"), value, expected)),
        };
        check((2..=MOST_NODES).contains(&self.resolution), "resolution", self.resolution as u64, "2 to 4096")?;
        check(self.steps > 0, "steps", self.steps, "at least 1")?;
        check((1..=1 << 20).contains(&self.rays), "rays", self.rays as u64, "1 to 1048576")
    }

    /// Returns the stage as the plan of a run states it, with the expected duration of a ray.
    pub(super) fn length(&self, ray_cost: f64) -> StageLength {
        StageLength { resolution: Some(self.resolution), steps: self.steps, rays_per_step: Some(self.rays), ray_cost }
    }
}
