//! [`Scaled`]: an optimizer with a learning rate for each element of a parameter.

use super::{Optimizer, Remembered};
use crate::gradients::Gradients;
use crate::parallel;
use crate::param::{Module, Param};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// Another optimizer, whose changes of one parameter are multiplied by a factor for each element: θ ← θ + s (θ' − θ), where θ' is the value that the other
/// optimizer sets. This is a learning rate for each element, for optimizers whose steps are proportional to the learning rate.
///
/// A parameter of another shape than the factors is not scaled: it is not the one for which they were made.
#[derive(Debug)]
pub struct Scaled<T: Real, O> {
    inner: O,
    name: String,
    factors: Tensor<T>,
}

impl<T: Real, O: Optimizer<T>> Scaled<T, O> {
    /// Creates an optimizer that multiplies the steps of `inner` for the parameter with this name by `factors`.
    pub fn new(inner: O, name: impl Into<String>, factors: Tensor<T>) -> Self {
        Scaled { inner, name: name.into(), factors }
    }

    fn scales(&self, param: &Param<T>) -> bool {
        param.name() == self.name && param.shape() == self.factors.shape()
    }
}

impl<T: Real, O: Optimizer<T>> Optimizer<T> for Scaled<T, O> {
    fn step(&mut self, module: &mut dyn Module<T>, grads: &Gradients<T>, step: u64) {
        let mut old = None;
        module.visit(&mut |param| {
            if self.scales(param) && grads.of(param).is_some() {
                old = Some(Buffer::copy_of(param.tensor().data()));
            }
        });
        self.inner.step(module, grads, step);
        let Some(old) = old else { return };
        module.visit_mut(&mut |param| {
            if self.scales(param) {
                let factors = self.factors.data();
                param.update(|values| {
                    parallel::for_each_chunk(values, parallel::CHUNK, |start, values| {
                        for ((new, &old), &s) in values.iter_mut().zip(&old[start..]).zip(&factors[start..]) {
                            *new = old + s * (*new - old);
                        }
                    });
                });
            }
        });
    }

    /// Returns the learning rate of the inner optimizer, without the factors.
    fn rate(&self, parameter: &str, step: u64) -> f64 {
        self.inner.rate(parameter, step)
    }

    fn memory_of(&self, param: &Param<T>) -> Option<Remembered<'_, T>> {
        self.inner.memory_of(param)
    }

    fn recall(&mut self, param: &Param<T>, updates: u64, arrays: Vec<Buffer<T>>) -> bool {
        self.inner.recall(param, updates, arrays)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optim::{Adam, AdamMode};
    use approx::assert_relative_eq;
    use ndarray::arr1;

    #[test]
    fn each_element_has_its_own_rate_and_other_parameters_have_the_common_one() {
        let params = || vec![Param::new("a", arr1(&[1.0f64, 2.0, 3.0])), Param::new("b", arr1(&[1.0, 2.0, 3.0]))];
        let adam = |rate: f64| Adam::new(rate, AdamMode::Dense);
        let trained = |optimizer: &mut dyn Optimizer<f64>| {
            let mut params = params();
            for step in 0..3 {
                // The gradients do not depend on the values.
                let grads = (params[0].tensor() * 2.0 - params[1].tensor()).sum().backward();
                optimizer.step(&mut params, &grads, step);
            }
            [0, 1].map(|i| params[i].tensor().data().to_vec())
        };
        let factors = Tensor::from_vec(vec![0.0, 0.5, 1.0], &[3]);
        let [scaled, other] = trained(&mut Scaled::new(adam(0.1), "a", factors));
        for (i, rate) in [0.0, 0.05, 0.1].into_iter().enumerate() {
            assert_relative_eq!(scaled[i], trained(&mut adam(rate))[0][i], max_relative = 1e-12);
        }
        assert_eq!(other, trained(&mut adam(0.1))[1]);
    }
}
