//! Numbers that change with the step: learning rates and weights of losses.

use std::fmt::Debug;

/// A number for each step, counted from 0.
pub trait Schedule: Send + Sync + Debug {
    /// The number at a step.
    fn at(&self, step: u64) -> f64;
}

/// A number is the schedule that never changes.
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

/// from^(1−t) · to^t with t = min(step / steps, 1): a straight line in the logarithm that stays at its end (JAXNeRF, svox2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exponential {
    from: f64,
    to: f64,
    steps: u64,
}

impl Exponential {
    /// From `from` at step 0 to `to` at step `steps` and ever after.
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

/// Another schedule times D(s) = m + (1 − m) sin(π/2 · min(s / S, 1)): starts at the share m and reaches all of it at step S (svox2's delay).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WarmUp<S> {
    schedule: S,
    share: f64,
    steps: u64,
}

impl<S: Schedule> WarmUp<S> {
    /// `schedule`, of which only `share` is used at step 0 and all from step `steps` on.
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

/// Constant between the steps at which it changes.
#[derive(Debug, Clone, PartialEq)]
pub struct Piecewise {
    first: f64,
    changes: Vec<(u64, f64)>,
}

impl Piecewise {
    /// `first` until the first change; changes are added by [`Piecewise::then`].
    pub fn new(first: f64) -> Self {
        Piecewise { first, changes: Vec::new() }
    }

    /// `value` from step `from` on.
    ///
    /// Panics unless `from` is larger than that of the change before.
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

    /// Printed to three digits in notes made from the original's code, hence the tolerance of half a unit in the third digit.
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
