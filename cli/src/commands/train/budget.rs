//! Training that ends on time: the length of the stages, planned once before the first step.
//!
//! A few steps that are thrown away say how fast this machine is. What stages cost against each other is taken from runs on lego of
//! NeRF-synthetic at 800 x 800 (`benches/RESULTS.md`): it differs between scenes by a quarter or so, and so does the time that a run takes.
//! The plan is in steps and part of the run's settings, so that they repeat the run bit by bit wherever it is run again.

use crate::progress::clock;
use plenoxel::dataset::View;
use plenoxel::error::{Error, Result};
use plenoxel::rays::RaySource;
use plenoxel::train::Trainer;
use plenoxel::train::config::{Config, Stage};
use std::time::Instant;

/// A step at k times the resolution takes k to this power times as long: 128 to 384 voxels a side.
const GROWTH: f64 = 0.75;
/// To begin a stage of 256 voxels a side takes as long as this many rays at 128, and more with the 1.5th power of the resolution: the grid is
/// resampled, and its voxels are looked at.
const RAYS_TO_BEGIN: f64 = 500_000.0;
/// The share of the time that goes into finding out how fast the machine is, at most.
const CALIBRATION: f64 = 0.03;

/// How fast the machine is, and what is gone by now.
struct Speed {
    /// Seconds for a step of the first stage.
    step: f64,
    /// Seconds before the first step: what can be known beforehand is.
    begin: f64,
    /// Seconds it took to find out.
    spent: f64,
}

/// The same settings with stages of such lengths that training takes `seconds`, this included.
pub fn on_time(config: Config, views: &[View], seconds: f64) -> Result<Config> {
    let rays = RaySource::new(views, config.background, config.seed).len();
    let steps = config.stages.iter().map(|stage| stage.step_count(rays, config.rays_per_step));
    let speed = measure(&config, views, CALIBRATION * seconds)?;
    let stages = planned(&config.stages, &steps.collect::<Vec<_>>(), config.rays_per_step, seconds, &speed)?;
    Ok(Config { stages, ..config })
}

/// Takes steps of the first stage until the time is over or the stage is.
fn measure(config: &Config, views: &[View], seconds: f64) -> Result<Speed> {
    let start = Instant::now();
    let mut trainer = Trainer::<f32>::new(config.clone(), views)?;
    // The first step begins the stage.
    trainer.step()?;
    let begin = start.elapsed().as_secs_f64();
    let (mut count, mut step) = (0, begin);
    while count + 1 < trainer.plan()[0].steps && (count < 3 || start.elapsed().as_secs_f64() < seconds) {
        trainer.step()?;
        count += 1;
        step = (start.elapsed().as_secs_f64() - begin) / count as f64;
    }
    Ok(Speed { step, begin, spent: start.elapsed().as_secs_f64() })
}

/// All stages longer or shorter by the same factor.
fn planned(stages: &[Stage], steps: &[u64], rays_per_step: usize, seconds: f64, speed: &Speed) -> Result<Vec<Stage>> {
    let growth = |stage: &Stage| stage.resolution as f64 / stages[0].resolution as f64;
    let begins = stages.windows(2).filter(|pair| pair[1].resolution != pair[0].resolution);
    let begins = begins.map(|pair| RAYS_TO_BEGIN / rays_per_step as f64 * (pair[1].resolution as f64 / 256.0).powf(1.5) * speed.step);
    let fixed = speed.spent + speed.begin + begins.sum::<f64>();
    let cost = stages.iter().zip(steps).map(|(stage, &steps)| steps as f64 * growth(stage).powf(GROWTH) * speed.step);
    let factor = (seconds - fixed) / cost.sum::<f64>();
    // Shorter than this a stage does not get to where the next one can begin.
    const LEAST: f64 = 0.1;
    if factor < LEAST {
        let least = clock(fixed + (seconds - fixed) * LEAST / factor);
        let needed = if factor > 0.0 { format!("more than {least}") } else { format!("more than {}", clock(fixed)) };
        return Err(Error::config("--time", format!("{seconds} seconds"), format!("{needed}, as these stages need here; or fewer voxels")));
    }
    let planned = stages.iter().zip(steps).map(|(&stage, &steps)| {
        let steps = ((steps as f64 * factor).round() as u64).max(1);
        Stage { steps: Some(steps), epochs: None, ..stage }
    });
    Ok(planned.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_keep_their_proportions_and_fill_the_time() {
        let stage = Config::default().stages[0];
        let stages = [64, 128, 256].map(|resolution| Stage { resolution, ..stage });
        let steps = [100, 200, 400];
        let speed = Speed { step: 0.01, begin: 0.5, spent: 0.5 };
        let of = |seconds: f64| planned(&stages, &steps, 10_000, seconds, &speed);
        let counts = |seconds: f64| of(seconds).unwrap().iter().map(|stage| stage.steps.unwrap()).collect::<Vec<_>>();
        let (short, long) = (counts(10.0), counts(100.0));
        for (short, long) in [(&short, &long), (&long, &counts(1000.0))] {
            assert!(short.iter().zip(long).all(|(short, long)| short < long), "{short:?} {long:?}");
        }
        assert!(long[2].abs_diff(2 * long[1]) < 3 && long[1].abs_diff(2 * long[0]) < 3, "{long:?}");
        // Two begins of a stage, and steps that cost 1, 2^0.75 and 4^0.75.
        let begins = 50.0 * 0.01 * (0.5f64.powf(1.5) + 1.0);
        let steps: f64 = long.iter().zip([1.0f64, 2.0, 4.0]).map(|(&n, k)| n as f64 * k.powf(0.75) * 0.01).sum();
        assert!((1.0 + begins + steps - 100.0).abs() < 0.1, "{long:?}");
        let error = of(2.0).unwrap_err().to_string();
        assert!(error.contains("--time") && error.contains("2 seconds") && error.contains("fewer voxels"), "{error}");
    }
}
