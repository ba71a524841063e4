//! [`RmsProp`], as used by Plenoxels.

use super::Rates;
use super::elementwise::{Elementwise, Rule};
use crate::real::Real;

/// RMSProp: v ← g² if v = 0, else β v + (1 − β) g²;  θ ← θ − lr · g / (√v + ε) (svox2).
///
/// Because of the rule for v = 0, the first step of every element is lr · sign g if ε is negligible. It is not always negligible: the gradients of a mean
/// over a batch of rays are very small. Summing the loss instead of averaging it, or another batch size, therefore changes the result of training.
///
/// For a row-sparse gradient, only the touched rows are visited, with all of their columns. Sparse grids are trained with RMSProp and not with Adam for
/// this reason: all moments of Adam would have to decay in every step. A zero in a dense gradient does not change the value either, but it decays v. An
/// element that is rarely touched therefore takes larger steps with dense gradients than with row-sparse ones.
#[derive(Debug)]
pub struct RmsProp<T: Real>(pub(super) Elementwise<RmsPropRule, T, 2>);

#[derive(Debug)]
pub(super) struct RmsPropRule {
    beta: f64,
    epsilon: f64,
}

impl<T: Real> RmsProp<T> {
    /// Creates an optimizer with the given learning rates, β = 0.95 and ε = 1e-8 (the values of svox2).
    pub fn new(rates: impl Into<Rates>) -> Self {
        RmsProp(Elementwise::new(RmsPropRule { beta: 0.95, epsilon: 1e-8 }, rates))
    }

    /// Sets the decay rate β of v.
    pub fn beta(mut self, beta: f64) -> Self {
        self.0.rule.beta = beta;
        self
    }

    /// Sets ε.
    pub fn epsilon(mut self, epsilon: f64) -> Self {
        self.0.rule.epsilon = epsilon;
        self
    }
}

impl<T: Real> Rule<T, 2> for RmsPropRule {
    fn at(&self, rate: f64, _: u64, _: f64) -> impl Fn([T; 2], T) -> [T; 2] + Sync {
        let (rate, epsilon) = (T::lit(rate), T::lit(self.epsilon));
        let (beta, rest) = (T::lit(self.beta), T::lit(1.0 - self.beta));
        move |[theta, v], g| {
            let v = if v == T::zero() { g * g } else { beta * v + rest * g * g };
            [theta - rate * g / (v.sqrt() + epsilon), v]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Indices;
    use crate::optim::Optimizer;
    use crate::param::Param;
    use crate::tensor::Tensor;
    use approx::assert_relative_eq;
    use ndarray::{arr1, arr2};

    #[test]
    fn the_first_step_is_the_rate_and_the_second_the_published_rule() {
        let mut theta = Param::new("theta", arr1(&[2.0f64, -3.0]));
        let mut optimizer = RmsProp::new(0.1).epsilon(0.0);
        let grads = theta.tensor().square().sum().backward();
        optimizer.step(&mut theta, &grads, 0);
        // v = g², so the step is 0.1 · sign g.
        assert_relative_eq!(theta.tensor().data()[0], 1.9, max_relative = 1e-14);
        assert_relative_eq!(theta.tensor().data()[1], -2.9, max_relative = 1e-14);
        let grads = theta.tensor().square().sum().backward();
        optimizer.step(&mut theta, &grads, 1);
        // g = 3.8, v = 0.95 · 16 + 0.05 · 14.44 = 15.922
        assert_relative_eq!(theta.tensor().data()[0], 1.9 - 0.1 * 3.8 / 15.922f64.sqrt(), max_relative = 1e-14);
    }

    #[test]
    fn epsilon_damps_gradients_of_its_own_size() {
        let mut theta = Param::new("theta", arr1(&[0.0f64]));
        let grads = (theta.tensor() * 1e-8).sum().backward();
        RmsProp::new(1.0).step(&mut theta, &grads, 0);
        // 1e-8 / (1e-8 + 1e-8)
        assert_relative_eq!(theta.tensor().item(), -0.5, max_relative = 1e-14);
    }

    /// Row 0 is gathered in every step, row 1 only in the first and the third.
    #[test]
    fn rows_equal_dense_where_touched_and_an_untouched_row_keeps_its_v_while_a_dense_zero_decays_it() {
        let value = arr2(&[[2.0f64], [2.0]]);
        let (mut rows, mut dense) = (Param::new("rows", value.clone()), Param::new("dense", value));
        let (mut by_rows, mut by_dense) = (RmsProp::new(0.1).epsilon(0.0), RmsProp::new(0.1).epsilon(0.0));
        for (step, looked_up) in [vec![0, 1], vec![0], vec![0, 1]].into_iter().enumerate() {
            let looked_up = Indices::from(looked_up);
            let loss = |table: &Tensor<f64>| table.gather_rows(&looked_up).sum();
            let grads = loss(rows.tensor()).backward();
            by_rows.step(&mut rows, &grads, step as u64);
            let grads = loss(&(1.0 * dense.tensor())).backward();
            by_dense.step(&mut dense, &grads, step as u64);
            assert_eq!(rows.tensor().data()[0], dense.tensor().data()[0]);
        }
        // g = 1, so v stays 1 and two steps of 0.1 are taken; the dense zero makes v = 0.95, then 0.95² + 0.05.
        assert_relative_eq!(rows.tensor().data()[1], 1.8, max_relative = 1e-14);
        assert_relative_eq!(dense.tensor().data()[1], 1.9 - 0.1 / (0.95f64 * 0.95 + 0.05).sqrt(), max_relative = 1e-14);
    }
}
