//! Optimizers and learning rates of stages.

use super::config::{Config, OptimizerConfig, Stage};
use autograd::Real;
use autograd::optim::{Adam, AdamMode, Exponential, Momentum, Optimizer, Rates, RmsProp, Schedule, Sgd, WarmUp};

/// Creates the optimizer of a stage.
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

/// Returns the learning rate of the density over the steps of a stage.
fn density_rate(stage: &Stage, steps: u64) -> Box<dyn Schedule> {
    // Initial factor of the warm-up in svox2.
    const FIRST: f64 = 0.01;
    let whole = rate(stage.density_rate, stage.rate_decay, steps);
    if stage.density_warm_up == 0 { whole } else { Box::new(WarmUp::new(whole, FIRST, stage.density_warm_up)) }
}

/// Returns the learning rate of colors or harmonics over the steps of a stage. `start` is the rate of the first step.
fn color_rate(stage: &Stage, start: f64, steps: u64) -> Box<dyn Schedule> {
    rate(start, stage.color_decay(), steps)
}

fn rate(start: f64, decay: f64, steps: u64) -> Box<dyn Schedule> {
    if start == 0.0 || decay == 1.0 { Box::new(start) } else { Box::new(Exponential::new(start, start * decay, steps)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rates_of_the_preset_plenoxels_are_those_of_svox2() {
        let config = Config::preset("plenoxels").unwrap();
        // By step: 30 to 0.05 and 0.01 to 5e-6 over 250 000 steps, the first with svox2's delay of 15 000 steps.
        let published = [
            (0, 0.300, 0.0100),
            (1000, 3.32, 0.00970),
            (5000, 13.3, 0.00859),
            (12_800, 21.1, 0.00678),
            (15_000, 20.4, 0.00634),
            (38_400, 11.2, 0.00311),
            (64_000, 5.83, 0.00143),
            (102_400, 2.18, 0.000_445),
            (128_000, 1.13, 0.000_204),
        ];
        for (step, density, color) in published {
            let [first, second] = &config.stages[..] else { panic!("two stages") };
            let change = first.steps.unwrap();
            let (stage, at) = if step < change { (first, step) } else { (second, step - change) };
            let steps = stage.steps.unwrap();
            // svox2 shrinks the world by 2/3, so its unit of length is 1.5 here.
            let found = [1.5 * density_rate(stage, steps).at(at), color_rate(stage, stage.color_rate, steps).at(at)];
            for (found, published) in found.into_iter().zip([density, color]) {
                assert!((found / published - 1.0).abs() < 0.005, "step {step}: {found}, published {published}");
            }
        }
    }
}
