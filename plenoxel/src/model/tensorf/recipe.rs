//! Training a factored field from the configuration of a run: memory, and lengths of stages.

use super::{Config, KIND, Short, Stage, Tensorf, total_variation};
use crate::dataset::View;
use crate::error::Result;
use crate::field::factored::fused::{Densities, LANES};
use crate::loss::Objective;
use crate::model::plenoxels::config::Config as RunConfig;
use crate::model::recipe::{Memory, Recipe};
use crate::render::Engine;
use crate::space::{Region, Space};
use crate::train::StageLength;
use autograd::parallel;
use std::{iter, mem};

impl Recipe for Config {
    type Model = Tensorf<f32>;

    fn kind(&self) -> &'static str {
        KIND
    }

    fn validate(&self) -> Result<()> {
        Config::validate(self)
    }

    fn warnings(&self, engine: Engine) -> Vec<String> {
        let slow = self.engine(engine) != engine;
        let text = || {
            format!(
                "tensorf.density_components = {}, tensorf.appearance_components = {}: the fused kernel needs multiples of {LANES}. The graph is used, which takes about ten \
                 times as long",
                self.density_components, self.appearance_components
            )
        };
        slow.then(text).into_iter().collect()
    }

    fn stages(&self) -> Vec<StageLength> {
        self.lengths(Space::Box)
    }

    fn uses_silhouettes(&self) -> bool {
        true
    }

    fn tracks_rays(&self) -> bool {
        true
    }

    fn memory(&self, engine: Engine) -> Memory {
        let engine = self.engine(engine);
        let parameters = self.stages.iter().map(|stage| bytes_of_planes(self, stage.resolution)).max().unwrap_or(0);
        Memory {
            parameters,
            ray: bytes_of_ray(self, engine),
            ray_of_picture: bytes_of_ray(self, engine),
            picture_tables: if engine == Engine::Fused { (Densities::<f32>::MOST * parameters as f64) as u64 } else { 0 },
            rays: "stages[*].rays",
            size: "stages[*].resolution",
            smaller: "fewer nodes a side, or fewer components",
        }
    }

    fn model(&self, config: &RunConfig, region: Region) -> Result<Tensorf<f32>> {
        let mut model = Tensorf::in_region(self.clone(), region, config.seed)?.with_hull(config.hull);
        model.engine = config.engine;
        Ok(model)
    }

    fn measured_step(&self, model: &Tensorf<f32>) -> (u64, f64) {
        // While the density is constant, rays end at other samples: in opaque matter at their first ones.
        (self.frozen_steps, self.cost_in(model.space).step(&self.stages[0]))
    }

    fn own_losses(&self, objective: Objective<f32, Tensorf<f32>>) -> Objective<f32, Tensorf<f32>> {
        total_variation::with_density(objective, self.density_tv)
    }

    fn fitted_to(self, model: &Tensorf<f32>, views: &[View]) -> Self {
        let region = model.sampled();
        let bounded = |stage: &Stage| Stage { resolution: self.bounded(stage.resolution, region, views), ..*stage };
        let stages = self.stages.iter().map(bounded).collect();
        Config { stages, ..self }
    }

    fn with_cost(&self, model: &Tensorf<f32>, cost: f64, taken: u64) -> Self {
        self.planned(self.cost_in(model.space), cost, taken)
    }

    fn likely_for(&self, seconds: f64) -> (Self, f64) {
        let whole = UNIT / parallel::threads() as f64 * Cost { across: 1.0 }.total(&self.stages);
        let short = self.short.filter(|short| seconds < short.below * whole);
        (self.shortened(short), short.map_or(1.0, |short| short.cost))
    }

    fn begins_as(&self, other: &Self, steps: u64) -> bool {
        let without_stages = |config: &Config| Config { stages: Vec::new(), former_lengths: Vec::new(), ..config.clone() };
        // The stages up to the last of these steps; of that one, the length does not matter.
        let stages = |config: &Config| {
            let mut first = 0;
            let begun = config.stages.iter().map(|stage| {
                let begun = Stage { steps: stage.steps.min(steps.saturating_sub(first)), ..*stage };
                first += stage.steps;
                begun
            });
            begun.take_while(|stage| stage.steps > 0).collect::<Vec<Stage>>()
        };
        let [own, others] = [self, other].map(Config::cooling);
        let all = own.steps().max(others.steps());
        let same_rates = || self.last_rate == 1.0 && (0..steps.min(all)).all(|step| own.at(step) == others.at(step));
        without_stages(self) == without_stages(other) && stages(self) == stages(other) && (own == others || same_rates())
    }

    fn adjusted_until(&self) -> u64 {
        // Rates that fall exponentially know the whole length.
        const SHARE: f64 = 0.95;
        if self.last_rate == 1.0 { (SHARE * self.total_steps() as f64) as u64 } else { 0 }
    }

    fn with_left(&self, asked: &Self, model: &Tensorf<f32>, left: f64, taken: u64) -> Self {
        let costs = self.cost_in(model.space);
        let firsts = self.stages.iter().scan(0, |first, stage| Some(mem::replace(first, *first + stage.steps)));
        let spent = |(first, stage): (u64, &Stage)| taken.saturating_sub(first).min(stage.steps) as f64 * costs.step(stage);
        let spent: f64 = firsts.clone().zip(&self.stages).map(spent).sum();
        let mut stages = costs.scaled(&asked.stages, spent + left.max(0.0), 0);
        // What has begun stays, later stages are not coarser, and steps have the rays of the plan.
        let mut finest = 0;
        for (stage, (first, planned)) in stages.iter_mut().zip(firsts.zip(&self.stages)) {
            if first <= taken {
                finest = planned.resolution;
                *stage = *planned;
            } else {
                let steps = (stage.steps as f64 * stage.rays as f64 / planned.rays as f64).round().max(1.0) as u64;
                *stage = Stage { resolution: stage.resolution.max(finest), steps, rays: planned.rays };
            }
        }
        if let Some((last, earlier)) = stages.split_last_mut() {
            let before: u64 = earlier.iter().map(|stage| stage.steps).sum();
            let steps = (spent + left - costs.total(earlier)) / costs.step(last);
            // Some steps for the rates to fall in, even if the time is over.
            let least = taken + (self.total_steps() / 20).max(2);
            last.steps = (steps.round().max(1.0) as u64).max(least.saturating_sub(before));
        }
        let mut adjusted = Config { stages, ..self.clone() };
        if !adjusted.begins_as(self, taken) {
            adjusted.former_lengths.push([self.total_steps(), taken]);
        }
        adjusted
    }

    fn change(self, model: &mut Tensorf<f32>) {
        model.set_config(self);
    }

    fn set(self, config: &mut RunConfig) {
        config.tensorf = Some(self);
    }
}

impl Config {
    /// Returns the costs in a space. Cells that are longer along the depth make the planes across it larger.
    fn cost_in(&self, space: Space) -> Cost {
        Cost { across: if matches!(space, Space::Ndc { .. }) { self.cell_depth.cbrt() } else { 1.0 } }
    }

    /// Returns the stages of a run in a space.
    pub(super) fn lengths(&self, space: Space) -> Vec<StageLength> {
        let costs = self.cost_in(space);
        self.stages.iter().map(|stage| stage.length(costs.step(stage) / stage.rays as f64)).collect()
    }

    /// Returns settings whose steps cost this much in total, with more than `taken` in the first stage.
    fn planned(&self, costs: Cost, cost: f64, taken: u64) -> Self {
        let short = self.short.filter(|short| cost < short.below * costs.total(&self.stages));
        let stages = costs.scaled(&self.stages, cost / short.map_or(1.0, |short| short.cost), taken);
        Config { stages, ..self.shortened(short) }
    }

    /// Returns these settings with the changes for a short run, or without any.
    fn shortened(&self, short: Option<Short>) -> Self {
        let (hidden, group) = short.map_or((self.hidden, self.group), |short| (short.hidden, short.group));
        Config { hidden, group, short: None, former_lengths: Vec::new(), ..self.clone() }
    }
}

/// Bytes of the planes of a factored field, in a box of usual proportions. With longer cells there are more nodes across: these are the planes in normalized
/// device coordinates; in other spaces they are smaller.
fn bytes_of_planes(config: &Config, resolution: usize) -> u64 {
    const LONG: f64 = 1.2;
    let components = (config.density_components + config.appearance_components) as f64;
    let nodes = (resolution * resolution) as f64;
    let planes = config.cell_depth.powf(2.0 / 3.0) + 2.0 * config.cell_depth.powf(-1.0 / 3.0);
    (LONG * planes * nodes * components) as u64 * size_of::<f32>() as u64
}

/// Bytes of a ray of a factored field: of its samples, and of the groups for which the color network is evaluated.
fn bytes_of_ray(config: &Config, engine: Engine) -> u64 {
    // Measured on lego with one drawn sample in each group; in the first stage, a ray has more groups.
    const SAMPLES: u64 = 24;
    const COLORED: u64 = 6;
    let of_sample = 120 + if engine == Engine::Graph { 400 * config.density_components as u64 } else { 0 };
    // Products are three for each component; the graph keeps both these and their cotangents.
    let products = if engine == Engine::Graph { 6 } else { 3 } * config.appearance_components;
    let of_color = 4 * (products + 4 * config.features + 4 * config.hidden) as u64;
    SAMPLES * of_sample + COLORED * of_color
}

/// Usual duration of the unit of [`Cost::step`] on a core, in seconds. If it leads to a wrong guess, the measured steps are discarded, and the run begins anew.
const UNIT: f64 = 11.6e-6;

/// Share of the configured duration below which steps have fewer rays, in proportion to the root of the share. lego, ten held-out views: at 0.017 of the whole,
/// 28.73 dB, with fewer rays 29.55 dB; at 0.033, 31.31 and 31.57 dB, with 0.2 in place of 0.1 31.48 dB.
const MANY_STEPS: f64 = 0.1;

/// Durations of steps.
#[derive(Clone, Copy, Debug)]
struct Cost {
    /// Nodes along a side of the largest plane, relative to the resolution.
    across: f64,
}

impl Cost {
    /// Scales stages to a total cost. In a short run, the earlier stages are shortened less than the last, and the finest stages become coarser: without geometry,
    /// and with few steps for each node, finer planes gain nothing. In a very short run, the steps after the first stage have fewer rays. The first stage has more
    /// than `taken` steps.
    fn scaled(self, stages: &[Stage], budget: f64, taken: u64) -> Vec<Stage> {
        let factor = budget / self.total(stages);
        let finest = stages.iter().map(|stage| stage.resolution).max().unwrap_or(0);
        let most = ((finest as f64 * factor.min(1.0).powf(0.13)) as usize).max(2);
        let fewer = (factor / MANY_STEPS).sqrt().min(1.0);
        let shortened = |(number, stage): (usize, &Stage)| {
            // The speed is measured in the first stage, whose steps have few rays already.
            let rays = if number == 0 { stage.rays } else { (stage.rays as f64 * fewer).ceil() as usize };
            let steps = (stage.steps as f64 * factor.max(factor.sqrt().min(1.0)) * stage.rays as f64 / rays as f64).round() as u64;
            Stage { resolution: stage.resolution.min(most), steps: steps.max(1), rays }
        };
        let mut stages: Vec<Stage> = stages.iter().enumerate().map(shortened).collect();
        if let Some((last, earlier)) = stages.split_last_mut() {
            // At least a third for the last stage.
            let shrink = (budget / 1.5 / self.total(earlier)).min(1.0);
            let least = iter::once(taken + 1).chain(iter::repeat(1));
            earlier.iter_mut().zip(least).for_each(|(stage, least)| stage.steps = ((stage.steps as f64 * shrink) as u64).max(least));
            let left = (budget - self.total(earlier)).max(budget / 3.0);
            last.steps = ((left / self.step(last)).round() as u64).max(1);
        }
        stages
    }

    /// Returns the duration of stages, in the units of [`step`](Cost::step).
    fn total(self, stages: &[Stage]) -> f64 {
        stages.iter().map(|stage| stage.steps as f64 * self.step(stage)).sum()
    }

    /// Returns the duration of a step, in units of a ray at a resolution of 0. On lego, a ray took 5.8, 6.5 and 7.0 µs at 90, 180 and 300 nodes on two cores of an
    /// AMD EPYC with AVX-512, and 7.7 to 8.4, 8.6, 10.7 and 13.0 µs at 90, 252, 334 and 418 nodes on two cores of an Intel Xeon with AVX-512. The costs are
    /// those of the Xeon. Steps of the first stage, after the opaque ones, took 0.95 to 1.3 times as long as their cost says. The more it is, the earlier a
    /// planned run ends.
    fn step(self, stage: &Stage) -> f64 {
        (stage.rays as f64 + 150.0) * (1.0 + self.across * stage.resolution as f64 / 500.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_components_that_the_kernel_does_not_compute_are_warned_of() {
        let config = Config { appearance_components: 24, ..Config::default() };
        let warnings = config.warnings(Engine::Fused);
        assert!(warnings.len() == 1 && warnings[0].contains("tensorf.appearance_components = 24"), "{warnings:?}");
        assert_eq!(config.memory(Engine::Fused).ray, config.memory(Engine::Graph).ray);
        // Nothing is slower than was asked for.
        assert!(config.warnings(Engine::Graph).is_empty() && Config::default().warnings(Engine::Fused).is_empty());
    }

    #[test]
    fn stages_of_a_factored_field_cost_what_they_may_and_short_runs_are_coarser() {
        let (stages, costs) = (Config::default().stages, Cost { across: 1.5 });
        let whole = costs.total(&stages);
        for factor in [0.03, 0.1, 0.4, 1.0, 3.0] {
            let planned = costs.scaled(&stages, factor * whole, 0);
            let share = costs.total(&planned) / (factor * whole);
            assert!((0.95..1.05).contains(&share), "{factor}: {share}");
            let finest = |stages: &[Stage]| stages.iter().map(|stage| stage.resolution).max();
            assert_eq!(finest(&planned) < finest(&stages), factor < 1.0, "{factor}");
            assert!(factor > 1.0 || planned[0].steps as f64 >= factor * stages[0].steps as f64);
            assert_eq!(planned[0].rays, stages[0].rays);
            assert!(
                planned[1..].iter().zip(&stages[1..]).all(|(planned, stage)| (planned.rays < stage.rays) == (factor < MANY_STEPS)),
                "{factor}"
            );
        }
    }

    #[test]
    fn short_runs_have_the_settings_of_short_runs_and_more_steps_for_them() {
        let short = Short { below: 0.3, hidden: 64, group: 0.1, cost: 0.7 };
        let config = Config { hidden: 128, group: 0.04, short: Some(short), ..Config::default() };
        let costs = config.cost_in(Space::Box);
        let whole = costs.total(&config.stages);
        let planned = [0.2, 0.5].map(|share| config.planned(costs, share * whole, 0));
        assert_eq!(planned.each_ref().map(|planned| (planned.hidden, planned.short)), [(64, None), (128, None)]);
        assert_eq!(planned.each_ref().map(|planned| planned.group), [0.1, 0.04]);
        assert!((costs.total(&planned[0].stages) / (0.2 * whole / 0.7) - 1.0).abs() < 0.05);
        // Without them, a short run has the same network.
        assert_eq!(Config { short: None, ..config }.planned(costs, 0.2 * whole, 0).hidden, 128);
    }

    #[test]
    fn stages_to_come_are_those_of_a_plan_that_knew_the_speed_and_begun_ones_stay() {
        let asked = Config { density_components: 2, appearance_components: 2, short: None, ..Config::default() };
        let region = Region { space: Space::Box, aabb: crate::geometry::Aabb::cube(1.5) };
        let model = Recipe::model(&asked, &RunConfig::default(), region).unwrap();
        let costs = asked.cost_in(Space::Box);
        let whole = costs.total(&asked.stages);
        let slow = asked.with_cost(&model, 0.2 * whole, 0);
        let knowing = asked.with_cost(&model, 0.8 * whole, 0);
        let taken = slow.stages[0].steps + 5;
        let spent = costs.total(&slow.stages[..1]) + 5.0 * costs.step(&slow.stages[1]);
        let adjusted = slow.with_left(&asked, &model, 0.8 * whole - spent, taken);
        assert_eq!((&adjusted.stages[..2], &adjusted.stages[2..4]), (&slow.stages[..2], &knowing.stages[2..4]));
        assert!(adjusted.stages[4].resolution == knowing.stages[4].resolution && slow.stages[4].resolution < knowing.stages[4].resolution);
        assert!((costs.total(&adjusted.stages) / (0.8 * whole) - 1.0).abs() < 0.01);
        // In the last stage, only its length changes, and no step that was taken.
        let late = slow.with_left(&asked, &model, 0.0, slow.total_steps() - 50);
        assert_eq!((&late.stages[..4], late.stages[4].resolution), (&slow.stages[..4], slow.stages[4].resolution));
        let whole = slow.total_steps();
        assert_eq!((late.total_steps(), &late.former_lengths[..]), (whole - 50 + whole / 20, &[[whole, whole - 50]][..]));
        assert!(late.begins_as(&slow, whole - 50) && !late.begins_as(&slow, whole - 48));
        // A slower machine does not make the planes coarser.
        let slower = slow.with_left(&asked, &model, 1.0, taken + slow.stages[1].steps + slow.stages[2].steps);
        assert!(slower.stages.is_sorted_by_key(|stage| stage.resolution));
    }
}
