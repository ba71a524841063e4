//! [`Adam`], with two treatments of row-sparse gradients.

use super::Rates;
use super::elementwise::{Elementwise, Rule};
use crate::real::Real;

/// The treatment of rows that a row-sparse gradient does not contain. The two modes are different algorithms and give different results.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AdamMode {
    /// Lazy mode: neither the values nor the moments of these rows change. A step visits only the touched rows, and the step size of a row does not depend
    /// on how rarely it is touched (TensorFlow's `LazyAdam`, PyTorch's `SparseAdam`).
    Lazy,
    /// Dense mode: these rows have a gradient of zero, so their moments decay and the values still change by the remaining momentum. This is Adam as
    /// published, but every step visits the whole table.
    Dense,
}

/// Adam: m ← β₁ m + (1 − β₁) g;  v ← β₂ v + (1 − β₂) g²;  θ ← θ − lr · m̂ / (√v̂ + ε),  m̂ = m / (1 − β₁ᵏ), v̂ = v / (1 − β₂ᵏ) (Kingma & Ba 2015).
///
/// k is the number of updates of the parameter since it got its identity, including the current one. In both modes it is counted for the whole parameter
/// and not for each row. With [`AdamMode::Lazy`], a row that is touched for the first time after many steps starts from zero moments, but the bias
/// correction has already vanished. Its first step is then lr (1 − β₁) / √(1 − β₂): lr with the defaults, as in the first step of training, but 3.2 lr with
/// β₂ = 0.999.
///
/// In both modes a parameter does not change in a step in which it has no gradient.
#[derive(Debug)]
pub struct Adam<T: Real>(pub(super) Elementwise<AdamRule, T, 3>);

#[derive(Debug)]
pub(super) struct AdamRule {
    mode: AdamMode,
    beta1: f64,
    beta2: f64,
    epsilon: f64,
    /// Weights of the penalty mean |θ|, by the name of the parameter.
    l1: Vec<(String, f64)>,
}

impl<T: Real> Adam<T> {
    /// Creates an optimizer with the given learning rates, β₁ = 0.9, β₂ = 0.99 (the value of Instant-NGP; the Adam paper has 0.999) and ε = 1e-8.
    pub fn new(rates: impl Into<Rates>, mode: AdamMode) -> Self {
        Adam(Elementwise::new(AdamRule { mode, beta1: 0.9, beta2: 0.99, epsilon: 1e-8, l1: Vec::new() }, rates))
    }

    /// Sets the decay rates β₁ and β₂ of the moments.
    pub fn betas(mut self, beta1: f64, beta2: f64) -> Self {
        (self.0.rule.beta1, self.0.rule.beta2) = (beta1, beta2);
        self
    }

    /// Adds λ sign(θ) / n to the gradient of the parameters with the given names, which have n elements: the gradient of the penalty λ mean |θ|. It costs
    /// no pass over the parameter. In lazy mode, only touched rows are penalised.
    pub fn l1(mut self, weights: Vec<(String, f64)>) -> Self {
        self.0.rule.l1 = weights;
        self
    }

    /// Sets ε.
    pub fn epsilon(mut self, epsilon: f64) -> Self {
        self.0.rule.epsilon = epsilon;
        self
    }
}

impl<T: Real> Rule<T, 3> for AdamRule {
    fn at(&self, rate: f64, updates: u64, l1: f64) -> impl Fn([T; 3], T) -> [T; 3] + Sync {
        let (b1, b2, epsilon) = (T::lit(self.beta1), T::lit(self.beta2), T::lit(self.epsilon));
        let (r1, r2) = (T::lit(1.0 - self.beta1), T::lit(1.0 - self.beta2));
        let left = |beta: f64| 1.0 - beta.powf(updates as f64);
        let rate = T::lit(rate / left(self.beta1));
        let scale = T::lit(1.0 / left(self.beta2).sqrt());
        let l1 = T::lit(l1);
        move |[theta, m, v], g| {
            let g = g + if theta == T::zero() { T::zero() } else { l1.copysign(theta) };
            let m = b1 * m + r1 * g;
            let v = b2 * v + r2 * g * g;
            [theta - rate * m / (v.sqrt() * scale + epsilon), m, v]
        }
    }

    fn l1(&self, name: &str) -> f64 {
        self.l1.iter().find(|(of, _)| of == name).map_or(0.0, |(_, weight)| *weight)
    }

    fn visits_all_rows(&self) -> bool {
        self.mode == AdamMode::Dense
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
    fn the_first_two_steps_are_those_of_the_paper() {
        let mut theta = Param::new("theta", arr1(&[1.0f64]));
        let mut optimizer = Adam::new(0.1, AdamMode::Dense).betas(0.9, 0.999).epsilon(0.0);
        let grads = (theta.tensor() * 3.0).sum().backward();
        optimizer.step(&mut theta, &grads, 0);
        // Corrected, m = g and v = g²: the step is the rate.
        assert_relative_eq!(theta.tensor().item(), 0.9, max_relative = 1e-12);
        let grads = (theta.tensor() * -1.0).sum().backward();
        optimizer.step(&mut theta, &grads, 1);
        // m = 0.9 · 0.3 − 0.1 = 0.17, v = 0.999 · 0.009 + 0.001 = 0.009991; corrected by 0.19 and 0.001999.
        let step = 0.1 * (0.17 / 0.19) / (0.009_991f64 / 0.001_999).sqrt();
        assert_relative_eq!(theta.tensor().item(), 0.9 - step, max_relative = 1e-12);
    }

    #[test]
    fn an_l1_penalty_adds_the_sign_of_the_value_to_the_gradient_of_named_parameters() {
        let stepped = |name: &str, l1: f64, slope: f64| {
            let mut theta = Param::new(name, arr1(&[2.0f64, -3.0, 0.0]));
            let mut optimizer = Adam::new(0.1, AdamMode::Dense).epsilon(0.1).l1(vec![("a".to_owned(), l1)]);
            let penalty = if slope == 0.0 { theta.tensor() * 0.0 } else { theta.tensor().abs() * (slope / 3.0) };
            let grads = (theta.tensor() * 0.3 + penalty).sum().backward();
            optimizer.step(&mut theta, &grads, 0);
            theta.tensor().data().to_vec()
        };
        assert_eq!(stepped("a", 0.5, 0.0)[..2], stepped("a", 0.0, 0.5)[..2]);
        assert_eq!(stepped("a", 0.5, 0.0)[2], stepped("b", 0.5, 0.0)[2]);
        assert_eq!(stepped("b", 0.5, 0.0), stepped("b", 0.0, 0.0));
    }

    /// Looks up row 0, then row 1, then row 0, with a gradient of 1.
    fn three_lookups(mode: AdamMode, as_rows: bool) -> Vec<f64> {
        let mut table = Param::new("table", arr2(&[[0.0f64], [0.0], [0.0]]));
        let mut optimizer = Adam::new(1.0, mode).betas(0.5, 0.75).epsilon(1e-30);
        for (step, row) in [0, 1, 0].into_iter().enumerate() {
            let tensor: Tensor<f64> = if as_rows { table.tensor().clone() } else { 1.0 * table.tensor() };
            let grads = tensor.gather_rows(&Indices::from(vec![row, 2])).sum().backward();
            drop(tensor);
            assert_eq!(grads.of(&table).is_some_and(|g| g.as_rows().is_some()), as_rows);
            optimizer.step(&mut table, &grads, step as u64);
        }
        table.tensor().data().to_vec()
    }

    #[test]
    fn lazy_lets_the_moments_of_untouched_rows_wait_and_dense_moves_them_on() {
        let (c1, c2) = ([0.5, 0.75, 0.875], [0.25f64, 0.4375, 0.578_125]);
        let step = |k: usize, m: f64, v: f64| (m / c1[k]) / (v / c2[k]).sqrt();
        let lazy = three_lookups(AdamMode::Lazy, true);
        // Row 0: m = ½, then ¾ in the third step; v = ¼, then 7/16. The second step passes it by.
        assert_relative_eq!(lazy[0], -step(0, 0.5, 0.25) - step(2, 0.75, 0.4375), max_relative = 1e-12);
        // Row 1: its first gradient comes with the second correction.
        assert_relative_eq!(lazy[1], -step(1, 0.5, 0.25), max_relative = 1e-12);
        let dense = three_lookups(AdamMode::Dense, true);
        // Row 0: m = ½, ¼, 5/8 and v = 1/4, 3/16, 25/64. Row 1: m = 0, ½, ¼ and v = 0, ¼, 3/16.
        assert_relative_eq!(dense[0], -step(0, 0.5, 0.25) - step(1, 0.25, 0.1875) - step(2, 0.625, 0.390_625), max_relative = 1e-12);
        assert_relative_eq!(dense[1], -step(1, 0.5, 0.25) - step(2, 0.25, 0.1875), max_relative = 1e-12);
        // Row 2 has a gradient in every step: no difference.
        assert_eq!(lazy[2], dense[2]);
    }

    #[test]
    fn dense_mode_does_the_same_with_rows_and_with_the_dense_gradient() {
        assert_eq!(three_lookups(AdamMode::Dense, true), three_lookups(AdamMode::Dense, false));
    }
}
