//! Gradient descent: [`Sgd`] and [`Momentum`].

use super::elementwise::{Elementwise, Rule, update};
use super::{Optimizer, Rates, Remembered};
use crate::gradients::Gradients;
use crate::param::{Module, Param};
use crate::pool::Buffer;
use crate::real::Real;

/// Gradient descent: θ ← θ − lr · g. It has no state, so a row-sparse gradient and the equal dense gradient give the same result.
#[derive(Debug)]
pub struct Sgd {
    rates: Rates,
}

impl Sgd {
    /// Creates an optimizer with the given learning rates.
    pub fn new(rates: impl Into<Rates>) -> Self {
        Sgd { rates: rates.into() }
    }
}

impl<T: Real> Optimizer<T> for Sgd {
    fn step(&mut self, module: &mut dyn Module<T>, grads: &Gradients<T>, step: u64) {
        module.visit_mut(&mut |param| {
            if let Some(grad) = grads.of(param) {
                let rate = T::lit(self.rates.at(param.name(), step));
                update(param, &mut [], grad, false, |[theta], g| [theta - rate * g]);
            }
        });
    }

    fn rate(&self, parameter: &str, step: u64) -> f64 {
        self.rates.at(parameter, step)
    }

    fn memory_of(&self, _: &Param<T>) -> Option<Remembered<'_, T>> {
        None
    }

    fn recall(&mut self, _: &Param<T>, _: u64, arrays: Vec<Buffer<T>>) -> bool {
        arrays.is_empty()
    }
}

/// Gradient descent with momentum: m ← μ m + g,  θ ← θ − lr · m (Polyak's heavy ball, as in PyTorch).
///
/// For a row-sparse gradient, only the touched rows are visited: neither the momentum nor the values of other rows change. This is not the same algorithm
/// as with the equal dense gradient, where the momentum moves every row in every step.
#[derive(Debug)]
pub struct Momentum<T: Real>(pub(super) Elementwise<MomentumRule, T, 2>);

#[derive(Debug)]
pub(super) struct MomentumRule {
    momentum: f64,
}

impl<T: Real> Momentum<T> {
    /// Creates an optimizer with the given learning rates and the momentum μ, usually 0.9.
    pub fn new(rates: impl Into<Rates>, momentum: f64) -> Self {
        Momentum(Elementwise::new(MomentumRule { momentum }, rates))
    }
}

impl<T: Real> Rule<T, 2> for MomentumRule {
    fn at(&self, rate: f64, _: u64, _: f64) -> impl Fn([T; 2], T) -> [T; 2] + Sync {
        let (rate, mu) = (T::lit(rate), T::lit(self.momentum));
        move |[theta, m], g| {
            let m = mu * m + g;
            [theta - rate * m, m]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Indices;
    use approx::assert_relative_eq;
    use ndarray::{arr1, arr2};

    #[test]
    fn plain_descent_takes_the_step_of_the_textbook() {
        let mut theta = Param::new("theta", arr1(&[3.0f64, -1.0]));
        let grads = theta.tensor().square().sum().backward();
        Sgd::new(0.25).step(&mut theta, &grads, 0);
        // g = 2θ, so θ − g/4 = θ/2.
        assert_eq!(theta.tensor().data(), [1.5, -0.5]);
    }

    #[test]
    fn plain_descent_does_the_same_with_rows_and_with_the_dense_gradient() {
        let table = arr2(&[[1.0f64, 2.0], [3.0, 4.0], [5.0, 6.0]]);
        let (mut rows, mut dense) = (Param::new("rows", table.clone()), Param::new("dense", table));
        let looked_up = Indices::from(vec![2, 0, 2]);
        let grads = rows.tensor().gather_rows(&looked_up).square().sum().backward();
        assert!(grads.of(&rows).is_some_and(|g| g.as_rows().is_some()));
        Sgd::new(0.1).step(&mut rows, &grads, 0);
        // The row-sparse gradient becomes dense because it passes through an op.
        let grads = (1.0 * dense.tensor()).gather_rows(&looked_up).square().sum().backward();
        assert!(grads.of(&dense).is_some_and(|g| g.as_dense().is_some()));
        Sgd::new(0.1).step(&mut dense, &grads, 0);
        assert_eq!(rows.tensor().data(), dense.tensor().data());
        // Row 2 was gathered twice: 5 − 0.1 · 2 · (2 · 5) = 3.
        assert_relative_eq!(rows.tensor().data()[4], 3.0, max_relative = 1e-14);
    }

    #[test]
    fn momentum_carries_the_previous_direction() {
        let mut theta = Param::new("theta", arr1(&[1.0f64]));
        let mut optimizer = Momentum::new(0.1, 0.5);
        for (step, want) in [0.9, 0.75, 0.575].into_iter().enumerate() {
            // g = 1 always: m = 1, 1.5, 1.75.
            let grads = theta.tensor().sum().backward();
            optimizer.step(&mut theta, &grads, step as u64);
            assert_relative_eq!(theta.tensor().item(), want, max_relative = 1e-14);
        }
    }
}
