//! Time budget of the voxel grid: the lengths of the stages for training of a given duration, computed once before the first step.
//!
//! The speed of the machine is measured with up to twenty seconds of discarded steps. The relative cost of the stages is taken from runs on
//! lego of NeRF-synthetic at 800 x 800 (`benches/history`). It varies between scenes by about a quarter, and so does the actual duration. The
//! plan is a number of steps for each stage and is part of the settings of the run, which thus repeat the run bit by bit on any machine.

use super::pace::TimeBudget;
use crate::dataset::View;
use crate::error::{Error, Result};
use crate::evaluate::PIXEL_COST;
use crate::model::plenoxels::config::{Config, Stage, Weight};
use crate::model::plenoxels::{Objective, Trainer, ray_cost};
use crate::run::training::InitialGrid;
use std::sync::Arc;
use std::time::Instant;

/// Cost of the k-th step of the first stage relative to the mean step, 1 + a ln(b / k), and its lower bound after some thousand steps: the cost
/// falls as the initial fog clears. Extrapolated from 150 steps or more in 17 runs on lego, it gave 0.83 to 1.12 of the true duration, and 0.92 to
/// 1.05 for stages of 2000 steps.
const CLEARING: (f64, f64) = (0.147, 780.0);
const CLEARED: f64 = 0.8;
/// Cost of the start of a stage at 256 voxels per side, as a number of training rays at 128. It grows with the square of the resolution: the grid
/// is resampled and pruned.
const RAYS_TO_BEGIN: f64 = 2.2e6;
/// Share of that cost if the resolution does not change: the grid is pruned only.
const ONLY_LOOKED_AT: f64 = 0.5;
/// Duration of the speed measurement: its share of the planned time, and its maximum in seconds. It takes at least a few steps. With 3 seconds,
/// two plans for eleven minutes, made half an hour apart, differed by half in their number of steps.
pub(super) const MEASURING: (f64, f64) = (0.03, 20.0);
/// Share of the configured steps below which the finest stages become coarser, and the factor of their resolution: in short runs, more steps
/// improve the result more than more voxels. On lego, `fast` reaches in 29 seconds at 256 voxels per side, measurement included, the PSNR that
/// it reaches at 320 in 30 seconds without the measurement.
const COARSER: (f64, f64) = (0.6, 0.8);

/// Measured speed of the machine, and the time used so far.
struct Speed {
    /// Voxels per side of the measured grid.
    resolution: usize,
    /// Mean duration of a step of the first stage, in seconds.
    step: f64,
    /// True if training begins in fog, not with an initial grid.
    from_fog: bool,
    /// Seconds before the first step.
    begin: f64,
    /// Seconds that are not for steps of the run: those of the measurement, and of what else is included in the time.
    spent: f64,
}

/// Scales the stages so that the run takes its `time` on this machine, including the measurement made here. Everything counted in steps is
/// scaled: stages, warm-ups and loss schedules. If the time is short, the finest stages also become coarser.
///
/// The result depends on the speed of the machine. It is a number of steps, so a run with these settings repeats bit by bit.
///
/// The measured steps have the `objective` of the config and the number of training views, and start from the `initial` grid, if there is one. The stages then
/// keep their resolutions, and those that the grid leaves out their steps.
///
/// Errors: the time is too short for the stages; those of `objective` and of [`Trainer::step`].
pub fn on_time(
    mut config: Config,
    views: &Arc<[View]>,
    time: TimeBudget,
    initial: Option<&InitialGrid>,
    objective: &dyn Fn(&Config, usize) -> Result<Objective<f32>>,
) -> Result<Config> {
    // An initial grid leaves out stages by the resolutions that fit the images.
    config = config.fitted_to(views.iter().map(|view| &view.camera));
    let left_out = initial.filter(|initial| !initial.carved).map_or(0, |initial| config.stages_left_out(initial.grid.shape().resolution));
    let trained = config.stages.split_off(left_out);
    let left_out = std::mem::replace(&mut config.stages, trained);
    let rays = views.iter().map(|view| view.size().iter().product::<usize>() as u64).sum();
    let steps: Vec<u64> = config.stages.iter().map(|stage| stage.step_count(rays, config.rays_per_step)).collect();
    let speed = measure(&config, views, time.seconds, initial, objective(&config, views.len())?)?;
    let finest = config.stages.last().map_or(0, |stage| stage.resolution);
    let ray = speed.step * ray_cost(finest) / ray_cost(speed.resolution) / config.rays_per_step as f64;
    let otherwise = time.spent + time.kept_for(PIXEL_COST * ray * time.evaluated);
    let planned = planned(config, &steps, time.seconds, &Speed { spent: speed.spent + otherwise, ..speed })?;
    Ok(Config { stages: [left_out, planned.stages].concat(), ..planned })
}

/// The plan for a machine of this speed; `steps` are the configured numbers of steps.
fn planned(config: Config, steps: &[u64], seconds: f64, speed: &Speed) -> Result<Config> {
    let factor = |config: &Config| factor(&config.stages, steps, config.rays_per_step, seconds, speed);
    let (config, factor) = match factor(&config) {
        Ok(enough) if enough >= COARSER.0 => (config, enough),
        enough if !speed.from_fog => (config, enough?),
        _ => {
            let config = coarser(config);
            let factor = factor(&config)?;
            (config, factor)
        }
    };
    let scaled = |steps: u64| ((steps as f64 * factor).round() as u64).max(1);
    let stages = config.stages.iter().zip(steps).map(|(&stage, &steps)| {
        let density_warm_up = if stage.density_warm_up == 0 { 0 } else { scaled(stage.density_warm_up) };
        Stage { steps: Some(scaled(steps)), epochs: None, density_warm_up, ..stage }
    });
    let stages = stages.collect();
    let losses = config.losses.into_iter().map(|(name, weight)| {
        let weight = match weight {
            Weight::Constant(_) => weight,
            Weight::Until { weight, until } => Weight::Until { weight, until: scaled(until) },
            Weight::Exponential { from, to, steps } => Weight::Exponential { from, to, steps: scaled(steps) },
        };
        (name, weight)
    });
    Ok(Config { stages, losses: losses.collect(), ..config })
}

/// Reduces the resolution of the finest stages.
fn coarser(config: Config) -> Config {
    let finest = config.stages.iter().map(|stage| stage.resolution).max().unwrap_or(0);
    let stages = config.stages.iter().map(|stage| stage.at_most((COARSER.1 * finest as f64) as usize)).collect();
    Config { stages, ..config }
}

/// Measures the speed with steps of the first stage, for a share of the planned `seconds`.
fn measure(config: &Config, views: &Arc<[View]>, seconds: f64, initial: Option<&InitialGrid>, objective: Objective<f32>) -> Result<Speed> {
    let start = Instant::now();
    let endless = Stage { steps: Some(1 << 20), epochs: None, ..config.stages[0] };
    let trainer = Trainer::with_losses(Config { stages: vec![endless], ..config.clone() }, views.clone(), objective, Arc::default())?;
    let mut trainer = match initial {
        Some(initial) => initial.begin(trainer),
        None => trainer,
    };
    // The first step begins the stage; a scout comes before it.
    let last = trainer.plan().len() - 1;
    while trainer.step()?.is_some_and(|report| report.stage < last) {}
    let from_fog = initial.is_none_or(|initial| initial.carved);
    speed(config.stages[0].resolution, from_fog, start.elapsed().as_secs_f64(), seconds, || {
        let start = Instant::now();
        trainer.step()?;
        Ok(start.elapsed().as_secs_f64())
    })
}

/// Measures the speed of a machine that took `begin` seconds before the first step. `step` takes a step and returns its duration; it is called for a
/// share of the planned `seconds`.
fn speed(resolution: usize, from_fog: bool, begin: f64, seconds: f64, mut step: impl FnMut() -> Result<f64>) -> Result<Speed> {
    let enough = (MEASURING.0 * seconds).min(MEASURING.1);
    let (mut count, mut steps, mut taken) = (0, 0.0, 0.0);
    while count < 3 || taken < enough {
        taken += step()?;
        count += 1;
        steps += if from_fog { in_fog(count) } else { 1.0 };
    }
    Ok(Speed { resolution, step: taken / steps, from_fog, begin, spent: begin + taken })
}

/// Cost of the k-th step of the first stage, relative to the mean step.
fn in_fog(k: u32) -> f64 {
    let (slope, usual) = CLEARING;
    (1.0 + slope * (usual / f64::from(k)).ln()).max(CLEARED)
}

/// Factor for the lengths of all stages with which training takes the planned time.
fn factor(stages: &[Stage], steps: &[u64], rays_per_step: usize, seconds: f64, speed: &Speed) -> Result<f64> {
    // Duration of a step at a resolution, in seconds.
    let step = |resolution: usize| speed.step * ray_cost(resolution) / ray_cost(speed.resolution);
    let begin = |stages: &[Stage]| {
        let share = if stages[0].resolution == stages[1].resolution { ONLY_LOOKED_AT } else { 1.0 };
        share * RAYS_TO_BEGIN / rays_per_step as f64 * step(128) * (stages[1].resolution as f64 / 256.0).powi(2)
    };
    let fixed = speed.spent + speed.begin + stages.windows(2).map(begin).sum::<f64>();
    let cost = stages.iter().zip(steps).map(|(stage, &steps)| steps as f64 * step(stage.resolution)).sum::<f64>();
    // With fewer steps, a stage does not converge enough for the next one.
    const LEAST: f64 = 0.1;
    if seconds < fixed + LEAST * cost {
        // Rounded up to ten seconds: durations vary by that much on a shared machine.
        let least = 10.0 * ((fixed + LEAST * cost) / 10.0).ceil();
        let finest = stages.iter().map(|stage| stage.resolution).max().unwrap_or(0);
        let coarser = if finest > 64 { ", or coarser stages such as --set stages[*].resolution=64" } else { "" };
        return Err(Error::usage("--time", format!("{seconds}s is too short for these stages"), format!("use {least}s or more{coarser}")));
    }
    Ok((seconds - fixed) / cost)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};
    use crate::field::voxel_grid::VoxelGrid;
    use crate::model::plenoxels::objective;

    #[test]
    fn fog_clears_until_a_step_is_cheaper_than_the_mean() {
        let steps: Vec<f64> = (1..=4000).map(in_fog).collect();
        assert!(steps.is_sorted_by(|earlier, later| earlier >= later) && steps[0] > 1.9 && steps[3999] == CLEARED);
        let mean = steps[..2000].iter().sum::<f64>() / 2000.0;
        assert!((mean - 1.0).abs() < 0.02, "{mean}");
    }

    /// Seconds of the k-th step of `fast` at 128 voxels a side, as they were recorded on lego (`benches/history`).
    fn recorded(k: u64) -> f64 {
        const STEPS: [(f64, f64); 5] = [(10.0, 0.026), (40.0, 0.022), (120.0, 0.019), (400.0, 0.016), (1000.0, 0.014)];
        let k = (k as f64).clamp(STEPS[0].0, STEPS[4].0);
        let next = STEPS.partition_point(|(at, _)| *at < k).max(1);
        let [(from, first), (to, last)] = [STEPS[next - 1], STEPS[next]];
        first + (last - first) * (k / from).ln() / (to / from).ln()
    }

    #[test]
    fn a_run_of_recorded_step_times_ends_when_it_was_promised_to() {
        let config = Config::preset("fast").unwrap();
        let asked = [750, 1070];
        assert_eq!(
            config.stages.iter().map(|stage| (stage.resolution, stage.steps)).collect::<Vec<_>>(),
            [(128, Some(750)), (320, Some(1070))]
        );
        // Seconds of a step at 320 voxels a side, and until the first step of each stage; the machine as it was, and others.
        const FINE: f64 = 0.036;
        const BEGIN: [f64; 2] = [1.4, 5.9];
        for slower in [0.5, 1.0, 3.0] {
            for promised in [60.0, 120.0, 300.0, 900.0].map(|seconds| seconds * slower) {
                let mut taken = 0;
                let step = || {
                    taken += 1;
                    Ok(slower * recorded(taken))
                };
                let speed = speed(128, true, slower * BEGIN[0], promised, step).unwrap();
                let spent = speed.spent;
                assert!(spent >= slower * BEGIN[0] + (MEASURING.0 * promised).min(MEASURING.1), "{spent} s");
                let plan = planned(config.clone(), &asked, promised, &speed).unwrap();
                let [first, second] = [0, 1].map(|stage| plan.stages[stage].steps.unwrap());
                assert_eq!(plan.stages[1].resolution, 320);
                let steps = (1..=first).map(recorded).sum::<f64>() + FINE * second as f64;
                let took = spent + slower * (BEGIN.iter().sum::<f64>() + steps);
                assert!(
                    (0.95..=1.05).contains(&(took / promised)),
                    "{promised} s were promised, and {first} + {second} steps took {took} s"
                );
            }
        }
    }

    #[test]
    fn stages_fill_the_time() {
        let stage = Config::default().stages[0];
        let stages = [64, 128, 256].map(|resolution| Stage { resolution, ..stage });
        let speed = Speed { resolution: 64, step: 0.01, from_fog: true, begin: 0.5, spent: 0.5 };
        let of = |seconds: f64| factor(&stages, &[100, 200, 400], 10_000, seconds, &speed);
        let factors = [10.0, 100.0, 1000.0].map(|seconds| of(seconds).unwrap());
        assert!(factors.is_sorted_by(|short, long| short < long), "{factors:?}");
        // What the grid of 128 voxels a side costs: a step, and what 220 steps do to begin another of 256, a quarter of it for its own.
        let twice = ray_cost(2);
        let begins = 220.0 * 0.01 * twice * (0.25 + 1.0);
        let steps = 0.01 * (100.0 + 200.0 * twice + 400.0 * twice * twice);
        assert!((1.0 + begins + factors[1] * steps - 100.0).abs() < 1e-9, "{factors:?}");
        let error = of(2.0).unwrap_err().to_string();
        let least = format!("{}s or more", 10.0 * ((1.0 + begins + 0.1 * steps) / 10.0).ceil());
        assert!(error.contains("--time") && error.contains("2s") && error.contains(&least), "{error}");
    }

    #[test]
    fn coarser_stages_are_as_they_were_but_for_the_finest() {
        let stage = Config::default().stages[0];
        let stages = [128, 320, 320].map(|resolution| Stage { resolution, density_rate: 10.0, ..stage });
        let found = coarser(Config { stages: stages.into(), ..Config::default() }).stages;
        let of = |k: usize| (found[k].resolution, found[k].density_rate);
        assert_eq!([of(0), of(1), of(2)], [(128, 10.0), (256, 8.0), (256, 8.0)]);
    }

    #[test]
    fn all_that_is_counted_in_steps_is_planned() {
        let scene = ProceduralOptions { width: 8, height: 8, train: 4, val: 1, test: 1, ..ProceduralOptions::default() };
        let views = Dataset::procedural(scene).unwrap().load(Split::Train, &|_, _| ()).unwrap().into();
        let stage = Stage { resolution: 8, steps: Some(1000), density_warm_up: 500, ..Config::default().stages[0] };
        let losses = [("mse", Weight::Constant(1.0)), ("beta", Weight::Until { weight: 1e-9, until: 250 })];
        let losses = losses.map(|(name, weight)| (name.to_owned(), weight)).into();
        let config = Config { stages: vec![stage], losses, rays_per_step: 16, ..Config::default() };
        let planned = on_time(config.clone(), &views, TimeBudget::of_training(10.0), None, &objective::<f32>).unwrap();
        let Stage { steps: Some(steps), density_warm_up, .. } = planned.stages[0] else { panic!("steps are planned") };
        let Weight::Until { until, .. } = planned.losses["beta"] else { panic!("a weight keeps its form") };
        assert!(steps.abs_diff(2 * density_warm_up) <= 2 && density_warm_up.abs_diff(2 * until) <= 2, "{steps} {density_warm_up} {until}");
        // From a grid of eight voxels a side, the stage before is left out. A short time leaves the resolution as it is.
        let grid = VoxelGrid::uniform(config.grid_shape(8), 1.0, 0.5);
        let stages = vec![Stage { resolution: 4, ..stage }, stage];
        let from = Config { init_from: Some("run".into()), stages: stages.clone(), ..config };
        let initial = InitialGrid { grid, carved: false };
        let planned = on_time(from, &views, TimeBudget::of_training(1.0), Some(&initial), &objective::<f32>).unwrap();
        assert_eq!((planned.stages[0], planned.stages[1].resolution, planned.stages.len()), (stages[0], 8, 2));
        assert!(planned.stages[1].steps != stage.steps, "{:?}", planned.stages[1]);
    }
}
