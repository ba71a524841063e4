//! Training a hash grid from the configuration of a run: memory, and lengths of stages.

use super::{Config, KIND, Ngp, Stage};
use crate::error::Result;
use crate::model::plenoxels::config::Config as RunConfig;
use crate::model::recipe::{Memory, Recipe};
use crate::render::Engine;
use crate::space::Region;
use crate::train::StageLength;
use std::iter;

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
            picture_tables: 0,
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

    fn with_cost(&self, _: &Ngp<f32>, cost: f64, taken: u64) -> Self {
        let whole: f64 = self.stages.iter().map(|stage| stage.steps as f64 * stage.rays as f64).sum();
        let factor = cost / whole;
        let least = iter::once(taken + 1).chain(iter::repeat(1));
        let scaled = |(stage, least): (&Stage, u64)| Stage { steps: scaled(stage.steps, factor).max(least), ..*stage };
        Config { stages: self.stages.iter().zip(least).map(scaled).collect(), ..self.clone() }.with_decays_of(self, factor)
    }

    fn begins_as(&self, other: &Self, steps: u64) -> bool {
        // The last stage and the decays may differ if they come later.
        let begin = |config: &Config| {
            let mut stages = config.stages.clone();
            stages.last_mut().into_iter().for_each(|last| last.steps = 0);
            Config { stages, decay_from: 0, decay_every: 1, ..config.clone() }
        };
        self == other || begin(self) == begin(other) && steps <= self.steps_at_full_rate().min(other.steps_at_full_rate())
    }

    fn adjusted_until(&self) -> u64 {
        self.steps_at_full_rate()
    }

    fn with_left(&self, _: &Self, _: &Ngp<f32>, left: f64, taken: u64) -> Self {
        let total: u64 = self.stages.iter().map(|stage| stage.steps).sum();
        let mut stages = self.stages.clone();
        let Some((last, earlier)) = stages.split_last_mut() else { return self.clone() };
        let before: u64 = earlier.iter().map(|stage| stage.steps).sum();
        let mut first = 0;
        let to_come = earlier.iter().map(|stage| {
            first += stage.steps;
            first.saturating_sub(taken).min(stage.steps) as f64 * stage.rays as f64
        });
        let steps = (left - to_come.sum::<f64>()) / last.rays as f64;
        // The rates decay after the steps that were taken.
        let least = (taken + 1) as f64 * total as f64 / self.decay_from.clamp(1, total) as f64;
        let total_steps = (before.max(taken) + steps.round().max(1.0) as u64).max(least.ceil() as u64 + 1);
        last.steps = total_steps - before;
        Config { stages, ..self.clone() }.with_decays_of(self, total_steps as f64 / total as f64)
    }

    fn change(self, model: &mut Ngp<f32>) {
        model.set_config(self);
    }

    fn set(self, config: &mut RunConfig) {
        config.ngp = Some(self);
    }
}

/// Returns a number of steps, multiplied by a factor.
fn scaled(steps: u64, factor: f64) -> u64 {
    ((steps as f64 * factor).round() as u64).max(1)
}

impl Config {
    /// Returns these settings with the decays of others, for steps that are `factor` times as many.
    fn with_decays_of(self, other: &Self, factor: f64) -> Self {
        Config { decay_from: scaled(other.decay_from, factor), decay_every: scaled(other.decay_every, factor), ..self }
    }

    /// Returns the number of steps before the first decay, without the last step of the run.
    fn steps_at_full_rate(&self) -> u64 {
        let total: u64 = self.stages.iter().map(|stage| stage.steps).sum();
        self.decay_from.min(total.saturating_sub(1))
    }
}
