//! Training DirectVoxGO from the configuration of a run: memory, losses, and lengths of stages.

use super::{Config, Dvgo, KIND, Stage, own_losses};
use crate::error::Result;
use crate::loss::Objective;
use crate::model::plenoxels::config::Config as RunConfig;
use crate::model::recipe::{Memory, Recipe};
use crate::render::Engine;
use crate::space::Region;
use crate::train::StageLength;

impl Config {
    fn all_stages(&self) -> impl Iterator<Item = &Stage> {
        [&self.coarse].into_iter().chain(&self.fine)
    }

    /// Returns the stages of a run.
    pub(super) fn lengths(&self) -> Vec<StageLength> {
        self.all_stages().map(|stage| stage.length(1.0)).collect()
    }
}

impl Recipe for Config {
    type Model = Dvgo<f32>;

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
        // Expected samples per ray in the coarse stage, and those of them that have a color.
        const SAMPLES: u64 = 150;
        const COLORED: u64 = 20;
        let voxels = self.all_stages().map(|stage| stage.resolution.pow(3)).max().unwrap_or(0);
        let numbers = 2 * (self.features + self.directions.width() + self.hidden * self.depth);
        Memory {
            parameters: (voxels * (1 + self.features) * size_of::<f32>()) as u64,
            ray: SAMPLES * 60 + COLORED * (numbers * size_of::<f32>()) as u64,
            ray_of_picture: SAMPLES * 60 + COLORED * (self.hidden * size_of::<f32>()) as u64,
            picture_tables: 0,
            rays: "fine[*].rays",
            size: "fine[*].resolution",
            smaller: "use fewer voxels per side",
        }
    }

    fn model(&self, config: &RunConfig, region: Region) -> Result<Dvgo<f32>> {
        let mut model = Dvgo::new(self.clone(), region.in_box(KIND)?, config.seed)?;
        model.engine = config.engine;
        Ok(model)
    }

    fn own_losses(&self, objective: Objective<f32, Dvgo<f32>>) -> Objective<f32, Dvgo<f32>> {
        own_losses(self, objective)
    }

    fn measured_step(&self, _: &Dvgo<f32>) -> (u64, f64) {
        (0, cost(&self.coarse))
    }

    fn with_cost(&self, _: &Dvgo<f32>, budget: f64, _: u64) -> Self {
        let total = |stages: &[Stage]| stages.iter().map(|stage| stage.steps as f64 * cost(stage)).sum::<f64>();
        let coarse = total(&[self.coarse]);
        // Without enough coarse steps, nothing is opaque: a short run shortens them last.
        let share = (budget / (coarse + total(&self.fine))).max((budget / (2.0 * coarse)).min(1.0));
        let of_coarse = ((self.coarse.steps as f64 * share).round() as u64).max(1);
        let factor = (budget - of_coarse as f64 * cost(&self.coarse)).max(0.0) / total(&self.fine);
        let scaled = |steps: u64| ((steps as f64 * factor).round() as u64).max(1);
        Config {
            coarse: Stage { steps: of_coarse, ..self.coarse },
            fine: self.fine.iter().map(|stage| Stage { steps: scaled(stage.steps), ..*stage }).collect(),
            tenth_every: scaled(self.tenth_every),
            ..self.clone()
        }
    }

    fn set(self, config: &mut RunConfig) {
        config.dvgo = Some(self);
    }
}

/// Duration of a step, in units of a ray.
fn cost(stage: &Stage) -> f64 {
    stage.rays as f64
}
