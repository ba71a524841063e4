//! Time budget of the models that have a [`Recipe`]: a plan before the run begins ([`plan`]), and adjustments of its later stages ([`Pace`]).
//!
//! A plan is a number of steps for each stage. It is part of the settings of the run, which thus repeat the run bit by bit: neither measured steps that belong to
//! the plan nor adjustments change what the steps before were ([`Recipe::begins_as`]).

use super::budget::MEASURING;
use crate::error::{Error, Result};
use crate::evaluate::PIXEL_COST;
use crate::model::plenoxels::config::Config;
use crate::model::recipe::Recipe;
use crate::text::clock;
use crate::train::{Model, PlannedStage, Report, Trainer};
use std::time::Instant;

/// [`MEASURING`] for a plan that is adjusted later. The measured steps are steps of the run, which should not be too long in its first stage.
const MEASURING_FIRST: (f64, f64) = (0.01, 3.0);

/// A trainer, and the steps that it has taken.
pub struct Begun<M: Model<f32>> {
    /// The trainer.
    pub trainer: Trainer<f32, M>,
    /// Reports of its steps, with the seconds of training after each.
    pub reports: Vec<(Report, f64)>,
}

impl<M: Model<f32>> Begun<M> {
    /// A trainer that has taken no step here.
    pub fn new(trainer: Trainer<f32, M>) -> Self {
        Begun { trainer, reports: Vec::new() }
    }
}

/// Time for which a run is planned.
#[derive(Clone, Copy, Debug)]
pub struct TimeBudget {
    /// Seconds in all.
    pub seconds: f64,
    /// Seconds of it that were spent before the training.
    pub spent: f64,
    /// Number of pixels whose evaluation is included; 0 if it is not.
    pub evaluated: f64,
}

impl TimeBudget {
    /// Time for training alone.
    pub fn of_training(seconds: f64) -> Self {
        TimeBudget { seconds, spent: 0.0, evaluated: 0.0 }
    }

    /// Returns the seconds that are kept for an evaluation: `evaluation`, but at most half of what is left for training and evaluation.
    pub(super) fn kept_for(&self, evaluation: f64) -> f64 {
        evaluation.min(0.5 * (self.seconds - self.spent).max(0.0))
    }
}

/// Returns the expected duration of a step of a stage, in the unit of [`PlannedStage::ray_cost`].
fn step_cost(stage: &PlannedStage) -> f64 {
    stage.rays_per_step as f64 * stage.ray_cost
}

/// Settings that are planned for a time.
pub struct Planned<R: Recipe> {
    /// The settings.
    pub recipe: R,
    /// The settings that were asked for, fitted to the training views ([`Recipe::fitted_to`]).
    pub asked: R,
    /// The trainer whose speed was measured, if its steps belong to the plan.
    pub begun: Option<Begun<R::Model>>,
}

/// Fits settings to the training views, and scales them so that the run takes its `time` on this machine, including the measurement made here. `begin` creates a
/// trainer. If `keep` is false, the measured steps do not become steps of the run.
///
/// Errors: the time or the first stage is too short; those of [`Trainer::step`].
pub fn plan<R: Recipe + Clone>(
    recipe: &R,
    time: TimeBudget,
    keep: bool,
    begin: impl FnOnce(&R) -> Result<Trainer<f32, R::Model>>,
) -> Result<Planned<R>> {
    let start = Instant::now();
    plan_by(|| start.elapsed().as_secs_f64(), recipe, time, keep, begin)
}

/// [`plan`] with a clock, which returns the seconds since the beginning.
fn plan_by<R: Recipe + Clone>(
    elapsed: impl Fn() -> f64,
    recipe: &R,
    time: TimeBudget,
    keep: bool,
    begin: impl FnOnce(&R) -> Result<Trainer<f32, R::Model>>,
) -> Result<Planned<R>> {
    let seconds = time.seconds - time.spent;
    let (measured, duration) = recipe.likely_for(seconds);
    let mut trainer = begin(&measured)?;
    // The last step of a stage is not taken: a plan may have more steps in it.
    let most = measured.stages().first().map_or(0, |stage| stage.steps.saturating_sub(1));
    let mut reports = Vec::new();
    let mut step = |trainer: &mut Trainer<f32, R::Model>| -> Result<f64> {
        let report = trainer.step()?;
        let now = elapsed();
        reports.extend(report.map(|report| (report, now)));
        Ok(now)
    };
    let startup = step(&mut trainer)?;
    let (from, cost) = measured.measured_step(trainer.model());
    let mut measured_from = startup;
    // Measuring ends with the time, which is then too short.
    while trainer.steps_taken() < (from + 1).min(most) && measured_from < seconds {
        measured_from = step(&mut trainer)?;
    }
    let measuring = if keep && recipe.adjusted_until() > 0 { MEASURING_FIRST } else { MEASURING };
    let enough = (measuring.0 * seconds).min(measuring.1);
    let (mut count, mut spent) = (0, measured_from);
    while trainer.steps_taken() < most && (count < 20 || spent - measured_from < enough) && (count == 0 || spent < seconds) {
        spent = step(&mut trainer)?;
        count += 1;
    }
    if count == 0 {
        let found = "the first stage is too short to measure the speed of the machine";
        return Err(Error::usage("--time", found, "use more steps in the first stage, or leave out --time"));
    }
    let step = (spent - measured_from) / f64::from(count);
    let unit = step / cost / duration;
    let stages = trainer.plan();
    let evaluation = stages.last().map_or(0.0, |last| step / step_cost(&stages[0]) * last.ray_cost * PIXEL_COST * time.evaluated);
    let training = seconds - time.kept_for(evaluation);
    let asked = recipe.clone().fitted_to(trainer.model(), trainer.views());
    let planned = |left: f64, taken: u64| asked.with_cost(trainer.model(), left / unit, taken);
    let taken = trainer.steps_taken();
    let continued = (keep && startup < training).then(|| planned(training - startup, taken));
    if let Some(recipe) = continued.filter(|continued| continued.begins_as(&measured, taken)) {
        trainer.replan(|model| recipe.clone().change(model));
        return Ok(Planned { recipe, asked, begun: Some(Begun { trainer, reports }) });
    }
    let left = training - spent - startup;
    if left <= 0.0 {
        let found = format!("{} is too short: beginning to train takes {} or more", clock(time.seconds), clock(time.seconds - left));
        return Err(Error::usage("--time", found, "give it several times as much"));
    }
    Ok(Planned { recipe: planned(left, 0), asked, begun: None })
}

/// Estimates the seconds of the evaluation of a model.
type Evaluation<M> = Box<dyn Fn(&M) -> f64>;

/// Follows a planned run, and adjusts the stages to come so that it ends on time: after a fifth of the steps during which they may change
/// ([`Recipe::adjusted_until`]), after a third of the rest, and so on. The first steps of a run tell little: without silhouettes they have several times as many
/// samples as later ones. A run that is resumed keeps the plan with which it was saved.
pub struct Pace<R: Recipe> {
    recipe: R,
    asked: R,
    config: Config,
    time: TimeBudget,
    /// The evaluation, if it is part of the time.
    evaluation: Option<Evaluation<R::Model>>,
    /// Number of steps after which the plan is adjusted next; `None` if it is not.
    adjust_at: Option<u64>,
    /// Start of the steps whose speed is measured: the first step that was seen of a stage, or the last adjustment but one in it. The speed after the last
    /// adjustment alone is less certain: it differed by 5 percent from that of later steps.
    measured_from: Option<Mark>,
    /// The last adjustment.
    adjusted: Option<Mark>,
}

/// Place in a run.
#[derive(Clone, Copy, Debug)]
struct Mark {
    stage: usize,
    /// Steps that were taken in the run, and seconds that were spent.
    taken: u64,
    now: f64,
}

/// Fewest steps of a stage from which the speed is taken.
const MEASURED: u64 = 10;

/// Fewest steps from one adjustment to the next, as a share of the steps during which the stages to come may change.
const APART: f64 = 1.0 / 32.0;

impl<R: Recipe + Clone> Pace<R> {
    /// Follows a run with the settings of a plan, which are those of `config` for its model, planned for `time`, in which `evaluation` is included. `asked` are
    /// the settings that were asked for ([`Planned::asked`]).
    pub fn new(recipe: R, asked: R, config: Config, time: TimeBudget, evaluation: Option<Evaluation<R::Model>>) -> Self {
        let until = recipe.adjusted_until();
        let adjust_at = (until > 0).then_some(until / 5);
        Pace { recipe, asked, config, time, evaluation, adjust_at, measured_from: None, adjusted: None }
    }

    /// Looks at the time after a step; `now` is how much of it is spent, in seconds. Returns the new configuration if the plan changed.
    pub fn after_step(&mut self, trainer: &mut Trainer<f32, R::Model>, now: f64) -> Option<Config> {
        let (taken, plan) = (trainer.steps_taken(), trainer.plan());
        let stage = plan.iter().find(|stage| taken <= stage.first + stage.steps)?;
        let here = Mark { stage: stage.index, taken, now };
        // The step that begins a stage is not measured.
        if self.measured_from.is_none_or(|from| from.stage != here.stage) {
            self.measured_from = Some(here);
        }
        if taken < self.adjust_at? {
            return None;
        }
        if taken > self.recipe.adjusted_until() {
            self.adjust_at = None;
            return None;
        }
        let from = self.measured_from.filter(|from| taken >= from.taken + MEASURED)?;
        let unit = (now - from.now) / (taken - from.taken) as f64 / step_cost(stage);
        let last = plan.last()?;
        let start = Instant::now();
        let evaluation = self.evaluation.as_ref().map_or(0.0, |of| of(trainer.model()) * last.ray_cost / stage.ray_cost);
        // Time that is spent here is not that of a step.
        let now = now + start.elapsed().as_secs_f64();
        let left = self.time.seconds - self.time.kept_for(evaluation) - now;
        let adjusted = self.recipe.with_left(&self.asked, trainer.model(), left / unit, taken);
        assert!(adjusted.begins_as(&self.recipe, taken), "the steps before belong to both plans");
        trainer.replan(|model| adjusted.clone().change(model));
        self.recipe = adjusted;
        self.measured_from = self.adjusted.filter(|last| last.stage == here.stage).or(self.measured_from);
        self.adjusted = Some(Mark { now, ..here });
        let until = self.recipe.adjusted_until();
        let apart = (APART * until as f64).max(MEASURED as f64) as u64;
        self.adjust_at = Some(taken + until.saturating_sub(taken) / 3).filter(|next| *next >= taken + apart);
        self.recipe.clone().set(&mut self.config);
        Some(self.config.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};
    use crate::loss::{Objective, mse};
    use crate::model::ngp;
    use crate::model::tensorf::{self, Short, Stage};
    use crate::space::{Region, Space};
    use crate::train::TrainOptions;
    use std::cell::Cell;

    fn recipe(stages: &[(usize, u64)]) -> tensorf::Config {
        tensorf::Config {
            density_components: 2,
            appearance_components: 2,
            features: 4,
            hidden: 8,
            frozen_steps: 3,
            short: Some(Short { below: 0.5, hidden: 4, group: 0.2, cost: 0.8 }),
            stages: stages.iter().map(|&(resolution, steps)| Stage { resolution, steps, rays: 32 }).collect(),
            ..tensorf::Config::default()
        }
    }

    fn trainer<R: Recipe>(recipe: &R) -> Result<Trainer<f32, R::Model>> {
        let scene = ProceduralOptions { width: 16, height: 12, train: 3, val: 1, test: 1, ..ProceduralOptions::default() };
        let views = Dataset::procedural(scene)?.load(Split::Train, &|_, _| ())?;
        let region = Region { space: Space::Box, aabb: crate::geometry::Aabb::cube(1.5) };
        let model = Recipe::model(recipe, &Config::default(), region)?;
        Trainer::with_model(model, views, Objective::new().with("mse", 1.0, mse), TrainOptions::default())
    }

    /// A plan by a clock whose steps take ten milliseconds.
    fn planned(recipe: &tensorf::Config, time: TimeBudget, keep: bool) -> Result<Planned<tensorf::Config>> {
        let readings = Cell::new(0);
        let elapsed = || {
            readings.set(readings.get() + 1);
            0.01 * f64::from(readings.get())
        };
        plan_by(elapsed, recipe, time, keep, trainer)
    }

    /// Trains to the end; returns all parameters.
    fn trained(mut trainer: Trainer<f32, impl Model<f32>>) -> Vec<f32> {
        while trainer.step().unwrap().is_some() {}
        let mut values = Vec::new();
        trainer.model().visit(&mut |param| values.extend_from_slice(param.tensor().data()));
        values
    }

    #[test]
    fn measured_steps_of_the_plan_are_those_of_a_run_from_the_beginning() {
        let asked = recipe(&[(8, 2000), (12, 40_000), (40, 100_000)]);
        let Planned { recipe, begun, .. } = planned(&asked, TimeBudget::of_training(1.0), true).unwrap();
        assert_eq!((recipe.short, recipe.hidden, recipe.group), (None, 4, 0.2));
        let Begun { trainer: begun, reports } = begun.expect("a short plan is what a second leads to");
        assert!(reports.len() as u64 == begun.steps_taken() && reports.len() >= 24 && recipe.stages[0].steps > begun.steps_taken());
        assert!(reports.iter().all(|(report, _)| !report.ends_stage) && reports.is_sorted_by_key(|(_, seconds)| *seconds));
        assert_eq!(begun.model().settings(), serde_json::json!(recipe));
        // Fewer steps at the end, so that the test is short.
        let less = recipe.with_left(&recipe, begun.model(), 0.0, begun.steps_taken());
        let mut going_on = begun;
        going_on.replan(|model| less.clone().change(model));
        assert_eq!(trained(going_on), trained(trainer(&less).unwrap()));
        // An evaluation of so many pixels takes half of the time, and reading the views may take more than all of it.
        let steps = |time: TimeBudget| {
            planned(&asked, time, true).map(|planned| planned.recipe.stages.iter().map(|stage| stage.steps).sum::<u64>())
        };
        let [all, half] = [0.0, 1e15].map(|evaluated| steps(TimeBudget { evaluated, ..TimeBudget::of_training(1.0) }).unwrap());
        assert!((0.3..0.75).contains(&(half as f64 / all as f64)), "{half} of {all}");
        let late = steps(TimeBudget { spent: 1.5, ..TimeBudget::of_training(1.0) }).unwrap_err().to_string();
        assert!(late.contains("0:01 is too short"), "{late}");
        // On request, the run begins anew.
        assert!(planned(&asked, TimeBudget::of_training(1.0), false).unwrap().begun.is_none());
    }

    #[test]
    fn measuring_ends_before_the_first_stage_does_and_a_bounded_first_stage_begins_anew() {
        let asked = tensorf::Config { short: None, ..recipe(&[(8, 12), (40, 100_000)]) };
        let begun = planned(&asked, TimeBudget::of_training(2.0), true).unwrap().begun.expect("steps of the plan");
        assert!(begun.trainer.steps_taken() == 11 && begun.reports.iter().all(|(report, _)| !report.ends_stage));
        let bounded = tensorf::Config { pixels_per_cell: 4.0, ..recipe(&[(8, 100), (8, 200)]) };
        assert!(planned(&bounded, TimeBudget::of_training(60.0), true).unwrap().begun.is_none());
        let short = tensorf::Config { short: None, ..recipe(&[(8, 3), (8, 200)]) };
        assert!(planned(&short, TimeBudget::of_training(1.0), true).err().unwrap().to_string().contains("--time"));
    }

    #[test]
    fn a_plan_that_was_not_guessed_begins_anew() {
        let asked = recipe(&[(8, 100), (16, 200)]);
        // So long that the network stays, and too long for any steps to be guessed.
        let unlikely = tensorf::Config { short: Some(Short { below: 1e-9, ..asked.short.unwrap() }), last_rate: 0.5, ..asked };
        let Planned { recipe, begun, .. } = planned(&unlikely, TimeBudget::of_training(1.0), true).unwrap();
        assert!(begun.is_none() && recipe.hidden == 8);
        assert!(planned(&unlikely, TimeBudget::of_training(1e-9), true).err().unwrap().to_string().contains("--time"));
    }

    #[test]
    fn the_last_stage_is_adjusted_and_the_run_repeats_from_its_settings() {
        let with_cool_down = |cool_down: f64| tensorf::Config { short: None, cool_down, ..recipe(&[(8, 30), (8, 200)]) };
        // From a step on, steps take longer or shorter: before the learning rates fall, and while they do.
        for (cool_down, of_a_step, changes_at, factor) in [
            (0.4, 0.2, 35.0, 1.1),
            (0.4, 0.5, 35.0, 1.1),
            (0.4, 1.0, 35.0, 1.1),
            (0.75, 0.2, 35.0, 1.1),
            (0.75, 0.3, 35.0, 1.1),
            (0.4, 0.4, 170.0, 1.3),
            (0.4, 0.4, 170.0, 0.7),
            (0.75, 10.0, 35.0, 1.1),
        ] {
            let asked = with_cool_down(cool_down);
            let mut pace = Pace::new(asked.clone(), asked.clone(), Config::default(), TimeBudget::of_training(100.0), None);
            let (mut trainer, mut plans) = (trainer(&asked).unwrap(), Vec::new());
            let seconds = |taken: f64| of_a_step * (taken + (factor - 1.0) * (taken - changes_at).max(0.0));
            while trainer.step().unwrap().is_some() {
                let now = seconds(trainer.steps_taken() as f64);
                plans.extend(pace.after_step(&mut trainer, now).and_then(|config| config.tensorf));
            }
            let case = (cool_down, of_a_step, changes_at, factor);
            // Steps of ten seconds are too long for more than the beginning of the last stage.
            let (too_long, sudden) = (of_a_step > 5.0, changes_at > 100.0);
            assert!((3..10).contains(&plans.len()) || too_long, "{case:?}: {}", plans.len());
            let took = seconds(trainer.steps_taken() as f64);
            assert!((took - 100.0).abs() < if sudden { 2.5 } else { 2.0 } || too_long, "{case:?}: {took}");
            let last = plans.last().unwrap();
            let of_all = |taken: u64| taken as f64 / trainer.steps_taken() as f64;
            assert!(last.former_lengths.iter().any(|[_, taken]| of_all(*taken) > 1.0 - cool_down) || !sudden, "{case:?}");
            assert_eq!(trained(trainer), trained(super::tests::trainer(last).unwrap()));
        }
        // Rates that fall from the first step on know the whole length.
        let falling = tensorf::Config { last_rate: 0.1, ..with_cool_down(0.4) };
        assert!(Pace::new(falling.clone(), falling, Config::default(), TimeBudget::of_training(100.0), None).adjust_at.is_none());
    }

    #[test]
    fn an_evaluation_that_is_included_ends_on_time_and_takes_at_most_half_of_it() {
        // The time before the training is given, and half of the rest is for training at least.
        for (spent, evaluation, trained) in [(0.0, 30.0, 70.0), (0.0, 80.0, 50.0), (20.0, 30.0, 50.0), (20.0, 80.0, 40.0)] {
            let time = TimeBudget { seconds: 100.0, spent, evaluated: 1.0 };
            let asked = tensorf::Config { short: None, ..recipe(&[(8, 30), (8, 200)]) };
            let mut pace = Pace::new(asked.clone(), asked.clone(), Config::default(), time, Some(Box::new(move |_| evaluation)));
            let mut trainer = trainer(&asked).unwrap();
            while trainer.step().unwrap().is_some() {
                let now = spent + 0.5 * trainer.steps_taken() as f64;
                let _ = pace.after_step(&mut trainer, now);
            }
            let took = 0.5 * trainer.steps_taken() as f64;
            assert!((took - trained).abs() < 1.0, "{spent}, {evaluation}: {took}");
        }
    }

    #[test]
    fn a_hash_grid_whose_steps_become_faster_ends_on_time_and_repeats_from_its_settings() {
        let asked = ngp::Config {
            levels: 2,
            log2_rows: 6,
            finest_resolution: 24,
            hidden: 8,
            color_layers: 1,
            samples: 16.0,
            cells: 8,
            decay_from: 200,
            decay_every: 50,
            stages: vec![ngp::Stage { steps: 300, rays: 16 }],
            ..ngp::Config::default()
        };
        let mut pace = Pace::new(asked.clone(), asked.clone(), Config::default(), TimeBudget::of_training(100.0), None);
        let (mut trainer, mut plans) = (trainer(&asked).unwrap(), Vec::new());
        // The first twenty steps take 0.33 seconds, as the plan expects, and the others 0.1.
        let seconds = |taken: u64| 0.1 * taken as f64 + 0.23 * taken.min(20) as f64;
        // The steps that were measured for the plan are not seen.
        (0..21).for_each(|_| drop(trainer.step().unwrap()));
        while trainer.step().unwrap().is_some() {
            let now = seconds(trainer.steps_taken());
            plans.extend(pace.after_step(&mut trainer, now).and_then(|config| config.ngp));
        }
        let took = seconds(trainer.steps_taken());
        assert!(plans.len() > 2 && (98.0..101.0).contains(&took), "{took}, {}", plans.len());
        let last = plans.last().unwrap();
        let share = last.stages[0].steps as f64 / 300.0;
        // Rounded in each adjustment.
        assert!((last.decay_from as f64 / 200.0 - share).abs() < 0.1 && (last.decay_every as f64 / 50.0 - share).abs() < 0.1);
        assert_eq!(trained(trainer), trained(super::tests::trainer(last).unwrap()));
    }
}
