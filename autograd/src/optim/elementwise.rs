//! What optimizers that treat every element alike have in common: memory, rates, and the walk over the parameters.

use super::{Optimizer, Rates, Remembered};
use crate::gradients::{Grad, Gradients};
use crate::parallel;
use crate::param::{Module, Param};
use crate::pool::Buffer;
use crate::real::Real;
use std::collections::HashMap;

/// How one element changes: `N` numbers, the value θ first and then what is remembered of it.
pub(super) trait Rule<T: Real, const N: usize>: Send {
    /// The function from `[θ, …]` and g to the new `[θ, …]`, for a parameter that has this learning rate. `updates` counts its updates, this one
    /// included.
    fn at(&self, rate: f64, updates: u64) -> impl Fn([T; N], T) -> [T; N] + Sync;

    /// True if rows that a row gradient does not mention are updated too, with a gradient of 0.
    fn visits_all_rows(&self) -> bool {
        false
    }
}

/// The optimizer of a [`Rule`] that remembers `N` − 1 numbers of each element.
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
            let rule = self.rule.at(self.rates.at(param.name(), step), updates);
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

/// Replaces the elements of a parameter that have a gradient, and what is remembered of them in `state`, by `rule([θ, …], g)`, θ then brought
/// back to its bounds. Rows that a row gradient does not mention stay, or have a gradient of 0 if it is `all_rows`.
pub(super) fn update<T: Real, const N: usize>(
    param: &mut Param<T>,
    state: &mut [Buffer<T>],
    grad: &Grad<T>,
    all_rows: bool,
    rule: impl Fn([T; N], T) -> [T; N] + Sync,
) {
    let bounds = param.bounds();
    // By value: behind a reference of its own, a rate could change with each number that is written, and no loop would be vectorised.
    let bounded = move |x: [T; N], g: T| {
        let mut new = rule(x, g);
        new[0] = bounds.nearest(new[0]);
        new
    };
    param.update(|theta| {
        let mut tables = std::iter::once(theta).chain(state.iter_mut().map(|array| &mut array[..]));
        let tables = std::array::from_fn(|_| tables.next().expect("N - 1 numbers are remembered of each element"));
        parallel::update(tables, grad, all_rows, bounded);
    });
}

/// What an optimizer remembers of each parameter: some numbers for each element, and how many updates it had.
#[derive(Debug)]
pub(super) struct Memory<T: Real> {
    pub(super) by_id: HashMap<u64, Slot<T>>,
    round: u64,
}

#[derive(Debug)]
pub(super) struct Slot<T: Real> {
    state: Option<Vec<Buffer<T>>>,
    updates: u64,
    last_seen: u64,
}

impl<T: Real> Memory<T> {
    /// Calls `f(parameter, gradient, state, updates)` for every parameter that has a gradient; `updates` counts this one, so it is at
    /// least 1. The state is `arrays` times as many zeros as the parameter has values the first time.
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
            let slot = self.by_id.entry(param.id()).or_insert(Slot { state: None, updates: 0, last_seen: round });
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
            self.by_id.insert(param.id(), Slot { state: Some(arrays), updates, last_seen: self.round });
        }
        fits
    }
}
