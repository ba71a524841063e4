//! How a stage learns: its optimizer and its learning rates.

use super::config::{Config, OptimizerConfig, Stage};
use autograd::Real;
use autograd::optim::{Adam, AdamMode, Exponential, Momentum, Optimizer, Rates, RmsProp, Schedule, Sgd, WarmUp};

/// A fresh optimizer for a stage.
pub fn optimizer<T: Real>(config: &Config, stage: &Stage, steps: u64) -> Box<dyn Optimizer<T>> {
    let Stage { color_rate: of_color, harmonics_rate, .. } = *stage;
    let of_harmonics = harmonics_rate.unwrap_or(of_color);
    let rates = || {
        let rates = Rates::new(0.0).with("density", density_rate(stage, steps)).with("color", color_rate(stage, of_color, steps));
        rates.with("harmonics", color_rate(stage, of_harmonics, steps))
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

/// Learning rate of the density over the steps of a stage.
fn density_rate(stage: &Stage, steps: u64) -> Box<dyn Schedule> {
    // svox2's.
    const FIRST: f64 = 0.01;
    let whole = rate(stage.density_rate, stage.rate_decay, steps);
    if stage.density_warm_up == 0 { whole } else { Box::new(WarmUp::new(whole, FIRST, stage.density_warm_up)) }
}

/// Learning rate of colors or harmonics that begins with `start`.
fn color_rate(stage: &Stage, start: f64, steps: u64) -> Box<dyn Schedule> {
    rate(start, stage.color_decay(), steps)
}

fn rate(start: f64, decay: f64, steps: u64) -> Box<dyn Schedule> {
    if start == 0.0 || decay == 1.0 { Box::new(start) } else { Box::new(Exponential::new(start, start * decay, steps)) }
}
