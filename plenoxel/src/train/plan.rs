//! The stages of a run, and how it learns in each.

use super::config::{Config, Initial, OptimizerConfig, Stage};
use autograd::Real;
use autograd::optim::{Adam, AdamMode, Exponential, Momentum, Optimizer, Rates, RmsProp, Schedule, Sgd, WarmUp};

/// A stage with its place in the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannedStage {
    /// As configured, fitted to the images ([`Config::fitted_to`]).
    pub stage: Stage,
    /// Its first step.
    pub first: u64,
    /// How many steps it has.
    pub steps: u64,
}

/// Values before the first step, of a scout or of the training itself.
pub fn initial(config: &Config, scouts: bool) -> Initial {
    let density = config.scout.as_ref().filter(|_| scouts).map_or(config.initial.density, |scout| scout.density);
    Initial { density, ..config.initial }
}

/// Stages one after another.
pub fn plan(config: &Config, stages: impl Iterator<Item = Stage>, rays: u64) -> Vec<PlannedStage> {
    let mut first = 0;
    let planned = stages.map(|stage| {
        let steps = stage.step_count(rays, config.rays_per_step);
        first += steps;
        PlannedStage { stage, first: first - steps, steps }
    });
    planned.collect()
}

/// A fresh optimizer for a stage.
pub fn optimizer<T: Real>(config: &Config, plan: &PlannedStage) -> Box<dyn Optimizer<T>> {
    let Stage { color_rate: of_color, harmonics_rate, .. } = plan.stage;
    let of_harmonics = harmonics_rate.unwrap_or(of_color);
    let rates = || {
        let rates = Rates::new(0.0).with("density", density_rate(plan)).with("color", color_rate(plan, of_color));
        rates.with("harmonics", color_rate(plan, of_harmonics))
    };
    match config.optimizer {
        OptimizerConfig::Sgd => Box::new(Sgd::new(rates())),
        OptimizerConfig::Momentum { decay } => Box::new(Momentum::new(rates(), decay)),
        OptimizerConfig::RmsProp { beta, epsilon } => Box::new(RmsProp::new(rates()).beta(beta).epsilon(epsilon)),
        OptimizerConfig::LazyAdam { beta1, beta2, epsilon } => {
            Box::new(Adam::new(rates(), AdamMode::Lazy).betas(beta1, beta2).epsilon(epsilon))
        }
    }
}

/// The density's rate over the steps of a stage.
pub fn density_rate(plan: &PlannedStage) -> Box<dyn Schedule> {
    // svox2's.
    const FIRST: f64 = 0.01;
    let whole = rate(plan, plan.stage.density_rate, plan.stage.rate_decay);
    if plan.stage.density_warm_up == 0 { whole } else { Box::new(WarmUp::new(whole, FIRST, plan.stage.density_warm_up)) }
}

/// That of colors or harmonics.
pub fn color_rate(plan: &PlannedStage, start: f64) -> Box<dyn Schedule> {
    rate(plan, start, plan.stage.color_decay())
}

fn rate(plan: &PlannedStage, start: f64, decay: f64) -> Box<dyn Schedule> {
    if start == 0.0 || decay == 1.0 { Box::new(start) } else { Box::new(Exponential::new(start, start * decay, plan.steps)) }
}
