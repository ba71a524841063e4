//! Progress of a training run: a bar for each stage, or lines of text.

use super::{Console, Counted, Meter, Standing, metric};
use plenoxel::evaluate::PIXEL_COST;
use plenoxel::run::memory::{self, bytes};
use plenoxel::run::metrics::{Observation, figures};
use plenoxel::text::clock;
use plenoxel::train::{PlannedStage, Report};
use serde::Serialize;
use std::collections::BTreeMap;

/// An exponential moving average with smoothing factor `share`. The first values have larger weights, so that it is unbiased.
#[derive(Debug, Clone, Copy)]
struct Smoothed {
    share: f64,
    count: f64,
    value: f64,
}

impl Smoothed {
    fn new(share: f64) -> Self {
        Smoothed { share, count: 0.0, value: 0.0 }
    }

    fn add(&mut self, value: f64) {
        self.count += 1.0;
        self.value += (value - self.value) * self.share.max(1.0 / self.count);
    }
}

/// Progress of a training run.
pub struct Training<'c, 'a> {
    meter: Meter<'c, 'a>,
    plan: Vec<PlannedStage>,
    /// Number of rays of the final evaluation.
    rays_to_evaluate: f64,
    total: u64,
    mse: Smoothed,
    loss: Smoothed,
    samples: Smoothed,
    step_seconds: Smoothed,
    seconds: f64,
    validation_psnr: Option<f64>,
    /// Seconds of the final evaluation per cost of a ray, if they were measured.
    evaluation: Option<f64>,
}

/// Share by which the number of steps of a plan must change for a note.
const WORTH_A_NOTE: f64 = 0.1;

/// Returns the number of steps of a plan.
fn steps(plan: &[PlannedStage]) -> u64 {
    plan.iter().map(|stage| stage.steps).sum()
}

impl<'a> Console<'a> {
    /// Progress of a training run. `rays_to_evaluate` is the number of pixels of the final evaluation, `seconds` the training time of a resumed run.
    pub fn training(&self, plan: &[PlannedStage], rays_to_evaluate: f64, seconds: f64) -> Training<'_, 'a> {
        let total = steps(plan);
        Training {
            meter: Meter::new(self, total),
            plan: plan.to_vec(),
            rays_to_evaluate,
            total,
            mse: Smoothed::new(0.05),
            loss: Smoothed::new(0.05),
            samples: Smoothed::new(0.05),
            step_seconds: Smoothed::new(0.05),
            seconds,
            validation_psnr: None,
            evaluation: None,
        }
    }
}

impl Training<'_, '_> {
    /// Replaces the plan, and says so if its length differs enough.
    pub fn replace_plan(&mut self, plan: &[PlannedStage]) {
        let (before, now) = (self.total, steps(plan));
        if before.abs_diff(now) as f64 > WORTH_A_NOTE * before as f64 {
            self.meter.console.note(&format!("the plan was adjusted to the speed of this machine: {now} steps instead of {before}"));
        }
        (self.plan, self.total) = (plan.to_vec(), now);
    }

    /// Shows the progress of a countable task between two steps.
    pub fn count(&self, what: &str, done: usize, total: usize) {
        self.meter.show((done as u64, total as u64), false, || Counted { what, done, total });
    }

    /// Shows a step.
    pub fn step(&mut self, report: &Report, seen: &Observation) {
        let took = seen.seconds - self.seconds;
        self.seconds = seen.seconds;
        self.validation_psnr = seen.validation_psnr.or(self.validation_psnr);
        self.mse.add(10f64.powf(-0.1 * report.psnr));
        self.loss.add(report.loss);
        let stage = self.plan[report.stage];
        self.evaluation = seen.evaluation_seconds.map(|seconds| seconds / stage.ray_cost).or(self.evaluation);
        if report.step == stage.first {
            // The first step of a stage includes the creation of its grid, so its duration is not representative.
            (self.step_seconds, self.samples) = (Smoothed::new(0.05), Smoothed::new(0.05));
        } else {
            self.step_seconds.add(took);
        }
        self.samples.add(report.samples as f64 / report.rays.max(1) as f64);
        let place = (report.step + 1 - stage.first, stage.steps);
        self.meter.show(place, report.ends_stage, || self.now(report, &seen.facts));
    }

    fn now(&self, report: &Report, facts: &[(&'static str, f64)]) -> Now {
        let pace = Some(self.step_seconds.value).filter(|step| *step > 0.0);
        Now {
            what: "training",
            stage: report.stage + 1,
            stages: self.plan.len(),
            resolution: self.plan[report.stage].resolution,
            step: report.step + 1,
            steps: self.total,
            loss: self.loss.value,
            psnr: -10.0 * self.mse.value.log10(),
            validation_psnr: self.validation_psnr,
            rays_per_second: pace.map(|step| report.rays as f64 / step),
            samples_per_ray: self.samples.value,
            facts: figures(facts, &[]),
            size: facts.first().copied(),
            memory_bytes: memory::now(),
            eta_seconds: self.remaining(report),
            seconds: self.seconds,
        }
    }

    /// Estimates the remaining seconds of the run, including the final evaluation; `None` during the first two steps of a stage. The current stage is
    /// estimated with its measured pace, later stages with the relative costs of their rays. The evaluation was measured, or a pixel of a test view counts as
    /// [`PIXEL_COST`] training rays of the last stage.
    fn remaining(&self, report: &Report) -> Option<f64> {
        let now = &self.plan[report.stage];
        let step = Some(self.step_seconds.value).filter(|_| self.step_seconds.count > 0.0)?;
        let ray = step / (now.rays_per_step as f64 * now.ray_cost);
        let cost = |stage: &PlannedStage| ray * stage.ray_cost;
        let here = (now.first + now.steps - report.step - 1) as f64;
        let later = self.plan[report.stage + 1..].iter().map(|stage| (stage.steps * stage.rays_per_step as u64) as f64 * cost(stage));
        let evaluation = self.plan.last().map_or(0.0, |last| match self.evaluation {
            Some(measured) => measured * last.ray_cost,
            None => cost(last) * PIXEL_COST * self.rays_to_evaluate,
        });
        Some(step * here + later.sum::<f64>() + evaluation)
    }
}

/// Progress of training. Stages count from 1, and `step` is the number of steps taken. Losses, rates and the PSNR of training rays are smoothed; the
/// validation PSNR is the last measured one.
#[derive(Debug, Clone, Serialize)]
struct Now {
    what: &'static str,
    stage: usize,
    stages: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    resolution: Option<usize>,
    step: u64,
    steps: u64,
    loss: f64,
    psnr: f64,
    validation_psnr: Option<f64>,
    rays_per_second: Option<f64>,
    samples_per_ray: f64,
    /// Facts about the model by name.
    #[serde(flatten)]
    facts: BTreeMap<String, serde_json::Number>,
    /// The most important fact.
    #[serde(skip)]
    size: Option<(&'static str, f64)>,
    memory_bytes: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    eta_seconds: Option<f64>,
    seconds: f64,
}

impl Now {
    fn eta(&self) -> String {
        self.eta_seconds.map_or_else(String::new, |seconds| format!("  ETA {}", clock(seconds)))
    }

    fn psnr(&self) -> String {
        match self.validation_psnr {
            Some(validation) => format!("train {:.2} val {validation:.2} dB", self.psnr),
            None => format!("train {:.2} dB", self.psnr),
        }
    }

    /// Formats rays per second, voxels and memory, as far as they are known.
    fn sizes(&self) -> String {
        let pace = self.rays_per_second.map(|rays| format!("  {}rays/s", metric(rays)));
        let memory = self.memory_bytes.map(|n| format!("  {}", bytes(n)));
        let size = self.size.map(|(name, number)| format!("  {}{name}", metric(number)));
        [pace, size, memory].into_iter().flatten().collect()
    }
}

impl Standing for Now {
    fn line(&self) -> String {
        let Now { stage, stages, step, steps, loss, samples_per_ray, .. } = self;
        let resolution = self.resolution.map_or(String::new(), |n| format!(" ({n}³)"));
        format!(
            "stage {stage}/{stages}{resolution}  step {step}/{steps}{}  {}  loss {loss:.5}{}  {samples_per_ray:.0} samples/ray",
            self.eta(),
            self.psnr(),
            self.sizes(),
        )
    }

    fn beside_bar(&self) -> String {
        let Now { stage, stages, loss, samples_per_ray, .. } = self;
        let resolution = self.resolution.map_or(String::new(), |n| format!(" {n}³"));
        format!(
            "stage {stage}/{stages}{resolution}{}  {}{}  loss {loss:.5}  {samples_per_ray:.0} samples/ray",
            self.eta(),
            self.psnr(),
            self.sizes(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_smoothed_value_starts_as_the_plain_mean() {
        let mut mean = Smoothed::new(0.1);
        [1.0, 2.0, 6.0].into_iter().for_each(|x| mean.add(x));
        assert!((mean.value - 3.0).abs() < 1e-12);
    }

    #[test]
    fn lines_fit_into_a_log_and_what_matters_beside_a_bar_of_100_columns() {
        let now = Now {
            what: "training",
            stage: 2,
            stages: 4,
            resolution: Some(256),
            step: 10_203,
            steps: 14_400,
            loss: 0.001_234_5,
            psnr: 29.876,
            validation_psnr: Some(28.012),
            rays_per_second: Some(431_204.0),
            samples_per_ray: 38.2,
            facts: BTreeMap::new(),
            size: Some(("voxels", 1_234_567.0)),
            memory_bytes: Some(1_512_000_000),
            eta_seconds: Some(754.0),
            seconds: 100.0,
        };
        let line = now.line();
        assert!(line.chars().count() <= 140, "{line}");
        // A bar takes fourteen columns.
        let seen: String = now.beside_bar().chars().take(100 - 14).collect();
        for part in ["stage 2/4", "12:34", "29.88", "28.01", "431 krays/s", "1.23 Mvoxels", "1.5 GB"] {
            assert!(line.contains(part) && seen.contains(part), "{part}: {line} | {seen}");
        }
        let unknown = Now { validation_psnr: None, rays_per_second: None, memory_bytes: None, ..now };
        assert!(!unknown.line().contains("val ") && unknown.line().contains("train 29.88 dB"), "{}", unknown.line());
    }
}
