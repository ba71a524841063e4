//! Schedules of learning rates and of loss weights.

use std::fmt::Debug;

/// A number as a function of the step, which counts from 0.
pub trait Schedule: Send + Sync + Debug {
    /// Returns the number at a step.
    fn at(&self, step: u64) -> f64;
}

/// A constant schedule.
impl Schedule for f64 {
    fn at(&self, _: u64) -> f64 {
        *self
    }
}

impl<S: Schedule + ?Sized> Schedule for Box<S> {
    fn at(&self, step: u64) -> f64 {
        (**self).at(step)
    }
}

/// Exponential decay: from^(1−t) · to^t with t = min(step / steps, 1). The logarithm changes linearly from step 0 to `steps`, then the value stays at `to`
/// (JAXNeRF, svox2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exponential {
    from: f64,
    to: f64,
    steps: u64,
}

impl Exponential {
    /// Creates a schedule that starts with `from` at step 0 and has the value `to` from step `steps` on.
    ///
    /// Panics unless both ends are positive and finite.
    #[track_caller]
    pub fn new(from: f64, to: f64, steps: u64) -> Self {
        assert!(
            from > 0.0 && to > 0.0 && from.is_finite() && to.is_finite(),
            "Exponential: both ends must be positive and finite, got {from} and {to}"
        );
        Exponential { from, to, steps }
    }
}

impl Schedule for Exponential {
    fn at(&self, step: u64) -> f64 {
        if step >= self.steps {
            return self.to;
        }
        let t = step as f64 / self.steps as f64;
        ((1.0 - t) * self.from.ln() + t * self.to.ln()).exp()
    }
}

/// Warm-up: another schedule multiplied by D(s) = m + (1 − m) sin(π/2 · min(s / S, 1)) at step s. The factor starts at m and reaches 1 at step S (the delay
/// of svox2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WarmUp<S> {
    schedule: S,
    share: f64,
    steps: u64,
}

impl<S: Schedule> WarmUp<S> {
    /// Creates a schedule that multiplies `schedule` by a factor: `share` (m) at step 0, rising to 1 at step `steps` (S).
    pub fn new(schedule: S, share: f64, steps: u64) -> Self {
        WarmUp { schedule, share, steps }
    }
}

impl<S: Schedule> Schedule for WarmUp<S> {
    fn at(&self, step: u64) -> f64 {
        let delay = if step >= self.steps {
            1.0
        } else {
            let s = step as f64 / self.steps as f64;
            self.share + (1.0 - self.share) * (std::f64::consts::FRAC_PI_2 * s).sin()
        };
        delay * self.schedule.at(step)
    }
}

/// A piecewise constant schedule.
#[derive(Debug, Clone, PartialEq)]
pub struct Piecewise {
    first: f64,
    changes: Vec<(u64, f64)>,
}

impl Piecewise {
    /// Creates a schedule with the value `first`. [`Piecewise::then`] adds changes.
    pub fn new(first: f64) -> Self {
        Piecewise { first, changes: Vec::new() }
    }

    /// Changes the value to `value` from step `from` on.
    ///
    /// Panics unless `from` is larger than the step of the previous change and larger than 0.
    #[track_caller]
    pub fn then(mut self, from: u64, value: f64) -> Self {
        let last = self.changes.last().map_or(0, |&(step, _)| step);
        assert!(from > last, "Piecewise: a change at step {from} must come after step {last}");
        self.changes.push((from, value));
        self
    }
}

impl Schedule for Piecewise {
    fn at(&self, step: u64) -> f64 {
        let passed = self.changes.partition_point(|&(from, _)| from <= step);
        passed.checked_sub(1).map_or(self.first, |i| self.changes[i].1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// Relative tolerance. The expected values come from notes on the original code and have three digits, so they may be off by half a unit in the third.
    const THREE_DIGITS: f64 = 5e-3;

    #[test]
    fn the_density_rate_of_plenoxels_warms_up_and_decays_as_published() {
        let rate = WarmUp::new(Exponential::new(30.0, 0.05, 250_000), 0.01, 15_000);
        let table = [
            (0, 0.300),
            (1000, 3.32),
            (5000, 13.3),
            (12_800, 21.1),
            (15_000, 20.4),
            (38_400, 11.2),
            (64_000, 5.83),
            (102_400, 2.18),
            (128_000, 1.13),
        ];
        for (step, want) in table {
            assert_relative_eq!(rate.at(step), want, max_relative = THREE_DIGITS);
        }
    }

    #[test]
    fn the_color_rate_of_plenoxels_decays_without_delay() {
        let rate = Exponential::new(0.01, 5e-6, 250_000);
        let table = [
            (0, 0.0100),
            (1000, 0.009_70),
            (5000, 0.008_59),
            (12_800, 0.006_78),
            (15_000, 0.006_34),
            (38_400, 0.003_11),
            (64_000, 0.001_43),
            (102_400, 0.000_445),
            (128_000, 0.000_204),
        ];
        for (step, want) in table {
            assert_relative_eq!(rate.at(step), want, max_relative = THREE_DIGITS);
        }
    }

    #[test]
    fn an_exponential_stays_at_its_end() {
        let rate = Exponential::new(1.0, 0.25, 10);
        assert_eq!(rate.at(0), 1.0);
        assert_relative_eq!(rate.at(5), 0.5, max_relative = 1e-14);
        assert_eq!(rate.at(10), 0.25);
        assert_eq!(rate.at(u64::MAX), 0.25);
        assert_eq!(Exponential::new(1.0, 0.25, 0).at(0), 0.25);
    }

    #[test]
    fn a_piecewise_schedule_changes_at_its_steps_and_not_before() {
        let rate = Piecewise::new(3.0).then(10, 2.0).then(20, 0.0);
        let values: Vec<f64> = [0, 9, 10, 19, 20, 1000].map(|s| rate.at(s)).into();
        assert_eq!(values, [3.0, 3.0, 2.0, 2.0, 0.0, 0.0]);
    }
}
