//! The common part of elementwise optimizers: state, learning rates, and the loop over the parameters.

use super::{Optimizer, Rates, Remembered};
use crate::gradients::{Grad, Gradients};
use crate::parallel;
use crate::param::{Module, Param};
use crate::pool::Buffer;
use crate::real::Real;
use std::collections::HashMap;

/// The update rule of one element, which has `N` numbers: the value θ and then its `N` − 1 state values.
pub(super) trait Rule<T: Real, const N: usize>: Send {
    /// Returns the function from `[θ, …]` and the gradient g to the new `[θ, …]`, for a parameter with the given learning rate. `updates` is the number of
    /// updates of the parameter, including the current one; `l1` is the weight of the penalty Σ |θ|.
    fn at(&self, rate: f64, updates: u64, l1: f64) -> impl Fn([T; N], T) -> [T; N] + Sync;

    /// Returns the weight of the penalty mean |θ| of a parameter.
    fn l1(&self, _: &str) -> f64 {
        0.0
    }

    /// Returns true if rows that a row-sparse gradient does not contain are also updated, with a gradient of 0.
    fn visits_all_rows(&self) -> bool {
        false
    }
}

/// An optimizer that applies a [`Rule`] and keeps `N` − 1 state values for each element.
#[derive(Debug)]
pub(super) struct Elementwise<R, T: Real, const N: usize> {
    pub(super) rule: R,
    rates: Rates,
    pub(super) memory: Memory<T>,
}

impl<R, T: Real, const N: usize> Elementwise<R, T, N> {
    pub(super) fn new(rule: R, rates: impl Into<Rates>) -> Self {
        Elementwise { rule, rates: rates.into(), memory: Memory { by_id: HashMap::new(), round: 0 } }
    }
}

impl<R: Rule<T, N>, T: Real, const N: usize> Optimizer<T> for Elementwise<R, T, N> {
    fn step(&mut self, module: &mut dyn Module<T>, grads: &Gradients<T>, step: u64) {
        self.memory.visit(module, grads, N - 1, |param, grad, state, updates| {
            let rule = self.rule.at(self.rates.at(param.name(), step), updates, self.rule.l1(param.name()) / param.tensor().len() as f64);
            update(param, state, grad, self.rule.visits_all_rows(), rule);
        });
    }

    fn rate(&self, parameter: &str, step: u64) -> f64 {
        self.rates.at(parameter, step)
    }

    fn memory_of(&self, param: &Param<T>) -> Option<Remembered<'_, T>> {
        self.memory.of(param)
    }

    fn recall(&mut self, param: &Param<T>, updates: u64, arrays: Vec<Buffer<T>>) -> bool {
        arrays.len() == N - 1 && self.memory.recall(param, updates, arrays)
    }
}

/// Replaces the elements of a parameter that have a gradient, and their values in `state`, by `rule([θ, …], g)`, and clamps θ to the bounds of the
/// parameter. Rows that a row-sparse gradient does not contain are unchanged, or have a gradient of 0 if `all_rows` is true.
pub(super) fn update<T: Real, const N: usize>(
    param: &mut Param<T>,
    state: &mut [Buffer<T>],
    grad: &Grad<T>,
    all_rows: bool,
    rule: impl Fn([T; N], T) -> [T; N] + Sync,
) {
    let bounds = param.bounds();
    // The closure captures by value. If it captured references, the compiler would have to assume that a store to a table may change the learning rate,
    // and could not vectorise the loop.
    let bounded = move |x: [T; N], g: T| {
        let mut new = rule(x, g);
        new[0] = bounds.nearest(new[0]);
        new
    };
    param.update(|theta| {
        let mut tables = std::iter::once(theta).chain(state.iter_mut().map(|array| &mut array[..]));
        let tables = std::array::from_fn(|_| tables.next().expect("N - 1 state arrays"));
        parallel::update(tables, grad, all_rows, bounded);
    });
}

/// The optimizer state of all parameters.
#[derive(Debug)]
pub(super) struct Memory<T: Real> {
    /// State of each parameter, by the identity of the parameter.
    pub(super) by_id: HashMap<u64, ParamState<T>>,
    /// Number of steps of this optimizer so far.
    round: u64,
}

/// The optimizer state of one parameter.
#[derive(Debug)]
pub(super) struct ParamState<T: Real> {
    /// State arrays of the length of the parameter, or `None` before its first gradient.
    state: Option<Vec<Buffer<T>>>,
    /// Number of updates of the parameter.
    updates: u64,
    /// Last round in which the module contained the parameter.
    last_seen: u64,
}

impl<T: Real> Memory<T> {
    /// Calls `f(parameter, gradient, state, updates)` for every parameter that has a gradient. `updates` includes the current update, so it is at least 1.
    /// The state consists of `arrays` arrays of the length of the parameter, which are zero in its first update.
    fn visit(
        &mut self,
        module: &mut dyn Module<T>,
        grads: &Gradients<T>,
        arrays: usize,
        mut f: impl FnMut(&mut Param<T>, &Grad<T>, &mut [Buffer<T>], u64),
    ) {
        self.round += 1;
        let round = self.round;
        module.visit_mut(&mut |param| {
            let slot = self.by_id.entry(param.id()).or_insert(ParamState { state: None, updates: 0, last_seen: round });
            slot.last_seen = round;
            if let Some(grad) = grads.of(param) {
                let len = param.tensor().len();
                let state = slot.state.get_or_insert_with(|| (0..arrays).map(|_| Buffer::zeros(len)).collect());
                slot.updates += 1;
                f(param, grad, state, slot.updates);
            }
        });
        self.by_id.retain(|_, slot| slot.last_seen == round);
    }

    fn of(&self, param: &Param<T>) -> Option<Remembered<'_, T>> {
        let slot = self.by_id.get(&param.id())?;
        let arrays = slot.state.as_ref()?.iter().map(|array| &array[..]).collect();
        Some(Remembered { updates: slot.updates, arrays })
    }

    fn recall(&mut self, param: &Param<T>, updates: u64, arrays: Vec<Buffer<T>>) -> bool {
        let fits = arrays.iter().all(|array| array.len() == param.tensor().len());
        if fits {
            self.by_id.insert(param.id(), ParamState { state: Some(arrays), updates, last_seen: self.round });
        }
        fits
    }
}
