//! Training NeRF from the configuration of a run: memory, losses, and the number of steps.

use super::{Config, KIND, Nerf, SAMPLES_IN_PICTURES, coarse_mse};
use crate::error::Result;
use crate::loss::Objective;
use crate::model::plenoxels::config::Config as RunConfig;
use crate::model::recipe::{Memory, Recipe};
use crate::render::Engine;
use crate::space::Region;
use crate::train::StageLength;

impl Recipe for Config {
    type Model = Nerf<f32>;

    fn kind(&self) -> &'static str {
        KIND
    }

    fn validate(&self) -> Result<()> {
        Config::validate(self)
    }

    fn stages(&self) -> Vec<StageLength> {
        self.lengths()
    }

    fn uses_silhouettes(&self) -> bool {
        false
    }

    fn memory(&self, _: Engine) -> Memory {
        let numbers = self.width * self.depth + self.width + self.color_width + 6 * (self.position_octaves + self.direction_octaves);
        let weights = 2 * (self.depth * self.width * self.width + 2 * self.width * self.width);
        // Pictures evaluate a bounded number of samples at a time, of 4096 rays in a batch.
        let ray_of_picture = (SAMPLES_IN_PICTURES * 2 * self.width * size_of::<f32>() / 4096) as u64;
        Memory {
            ray_of_picture,
            picture_tables: 0,
            parameters: (weights * size_of::<f32>()) as u64,
            ray: ((2 * self.coarse_samples + self.fine_samples) * 2 * numbers * size_of::<f32>()) as u64,
            rays: "rays",
            size: "width",
            smaller: "use fewer or narrower layers",
        }
    }

    fn model(&self, config: &RunConfig, region: Region) -> Result<Nerf<f32>> {
        Nerf::new(self.clone(), region.in_box(KIND)?, config.seed)
    }

    fn own_losses(&self, objective: Objective<f32, Nerf<f32>>) -> Objective<f32, Nerf<f32>> {
        objective.with("coarse", 1.0, coarse_mse)
    }

    fn measured_step(&self, _: &Nerf<f32>) -> (u64, f64) {
        (0, 1.0)
    }

    fn with_cost(&self, _: &Nerf<f32>, cost: f64, _: u64) -> Self {
        let steps = (cost.round() as u64).max(1);
        let share = steps as f64 / self.steps as f64;
        let decay_steps = ((self.decay_steps as f64 * share).round() as u64).max(1);
        Config { steps, decay_steps, crop_steps: self.crop_steps.min(steps / 2), ..self.clone() }
    }

    fn set(self, config: &mut RunConfig) {
        config.nerf = Some(self);
    }
}
