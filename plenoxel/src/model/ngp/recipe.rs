//! Training a hash grid from the configuration of a run: memory, and lengths of stages.

use super::{Config, KIND, Ngp, Stage};
use crate::error::Result;
use crate::model::plenoxels::config::Config as RunConfig;
use crate::model::recipe::{Memory, Recipe};
use crate::render::Engine;
use crate::space::Region;
use crate::train::StageLength;

impl Recipe for Config {
    type Model = Ngp<f32>;

    fn kind(&self) -> &'static str {
        KIND
    }

    fn validate(&self) -> Result<()> {
        Config::validate(self)
    }

    fn stages(&self) -> Vec<StageLength> {
        let length = |stage: &Stage| StageLength { resolution: None, steps: stage.steps, rays_per_step: Some(stage.rays), ray_cost: 1.0 };
        self.stages.iter().map(length).collect()
    }

    fn uses_silhouettes(&self) -> bool {
        true
    }

    fn memory(&self, _: Engine) -> Memory {
        // Expected samples per ray: more in the first steps, fewer once the occupancy is known.
        const SAMPLES: u64 = 40;
        let encoded = self.levels * self.features;
        let numbers = 2 * encoded + 4 * self.hidden * (1 + self.color_layers);
        Memory {
            parameters: (encoded << self.log2_rows) as u64 * size_of::<f32>() as u64,
            ray: SAMPLES * (numbers * size_of::<f32>()) as u64,
            ray_of_picture: SAMPLES * ((encoded + 2 * self.hidden) * size_of::<f32>()) as u64,
            rays: "stages[*].rays",
            size: "log2_rows",
            smaller: "use fewer rows, levels or features",
        }
    }

    fn model(&self, config: &RunConfig, region: Region) -> Result<Ngp<f32>> {
        let mut model = Ngp::new(self.clone(), region.in_box(KIND)?, config.seed)?.with_hull(config.hull);
        model.engine = config.engine;
        Ok(model)
    }

    fn measured_step(&self, _: &Ngp<f32>) -> (u64, f64) {
        (0, self.stages[0].rays as f64)
    }

    fn with_cost(&self, _: &Ngp<f32>, cost: f64, _: u64) -> Self {
        let whole: f64 = self.stages.iter().map(|stage| stage.steps as f64 * stage.rays as f64).sum();
        let scaled = |steps: u64| ((steps as f64 * cost / whole).round() as u64).max(1);
        Config {
            stages: self.stages.iter().map(|stage| Stage { steps: scaled(stage.steps), ..*stage }).collect(),
            decay_from: scaled(self.decay_from),
            decay_every: scaled(self.decay_every),
            ..self.clone()
        }
    }

    fn set(self, config: &mut RunConfig) {
        config.ngp = Some(self);
    }
}
