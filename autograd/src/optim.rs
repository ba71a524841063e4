//! Optimizers and learning rate schedules.
//!
//! An optimizer reads a [`Module`], its [`Gradients`] and the step number. It does not depend on models or losses. Each optimizer documents how it treats
//! row-sparse gradients: [`Sgd`], [`Momentum`], [`RmsProp`] and lazy [`Adam`] visit only the touched rows, and neither the values nor the state of other
//! rows change. No optimizer changes a parameter in a step in which it has no gradient.
//!
//! Optimizer state belongs to the identity of a parameter. After [`Param::replace`] the state starts again from zero. State of identities that the module
//! no longer contains is dropped in the next step, so an optimizer must be used with one module only.
//!
//! Updated elements of a parameter with [`Bounds`](crate::Bounds) are clamped to them (projected gradient descent). If all values start within the bounds,
//! this equals clamping the whole parameter.
//!
//! Every update is elementwise and in place, and has the same bits for any number of threads.

mod adam;
mod elementwise;
mod rmsprop;
mod scaled;
mod schedule;
mod sgd;

pub use adam::{Adam, AdamMode};
pub use rmsprop::RmsProp;
pub use scaled::Scaled;
pub use schedule::{Exponential, Piecewise, Schedule, WarmUp};
pub use sgd::{Momentum, Sgd};

use crate::gradients::Gradients;
use crate::param::{Module, Param};
use crate::pool::Buffer;
use crate::real::Real;

/// An algorithm that updates parameters from their gradients.
pub trait Optimizer<T: Real>: Send {
    /// Updates every parameter of the module that has a gradient. `step` counts from 0 and determines the learning rates.
    fn step(&mut self, module: &mut dyn Module<T>, grads: &Gradients<T>, step: u64);

    /// Returns the learning rate at a step of the parameter with the given name.
    fn rate(&self, parameter: &str, step: u64) -> f64;

    /// Returns the optimizer state of a parameter, for a checkpoint, or `None` if there is none.
    fn memory_of(&self, param: &Param<T>) -> Option<Remembered<'_, T>>;

    /// Restores the optimizer state of a parameter from a checkpoint; the arguments are the fields of [`Remembered`]. Returns false, and changes nothing,
    /// if the number or the length of the arrays does not fit this optimizer and the parameter.
    #[must_use]
    fn recall(&mut self, param: &Param<T>, updates: u64, arrays: Vec<Buffer<T>>) -> bool;
}

/// Implements [`Optimizer`] for a wrapper type by forwarding every call to the wrapped optimizer.
macro_rules! forward_to {
    ([$($generics:tt)*] $type:ty, $self:ident => $inner:expr) => {
        impl<$($generics)*> Optimizer<T> for $type {
            fn step(&mut $self, module: &mut dyn Module<T>, grads: &Gradients<T>, step: u64) {
                $inner.step(module, grads, step);
            }

            fn rate(&$self, parameter: &str, step: u64) -> f64 {
                $inner.rate(parameter, step)
            }

            fn memory_of(&$self, param: &Param<T>) -> Option<Remembered<'_, T>> {
                $inner.memory_of(param)
            }

            fn recall(&mut $self, param: &Param<T>, updates: u64, arrays: Vec<Buffer<T>>) -> bool {
                $inner.recall(param, updates, arrays)
            }
        }
    };
}

forward_to!([T: Real] Momentum<T>, self => self.0);
forward_to!([T: Real] RmsProp<T>, self => self.0);
forward_to!([T: Real] Adam<T>, self => self.0);
forward_to!([T: Real, O: Optimizer<T> + ?Sized] Box<O>, self => (**self));

/// The state that an optimizer keeps for a parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Remembered<'a, T: Real> {
    /// Number of steps in which the parameter had a gradient.
    pub updates: u64,
    /// State arrays, each of the length of the parameter: m for [`Momentum`], v for [`RmsProp`], m and v for [`Adam`].
    pub arrays: Vec<&'a [T]>,
}

/// Learning rates: schedules for listed parameter names, and a default schedule for all other names.
///
/// ```
/// use autograd::optim::{Exponential, Rates};
/// let rates = Rates::new(0.01).with("density", Exponential::new(30.0, 0.05, 250_000));
/// assert_eq!(rates.at("density", 250_000), 0.05);
/// assert_eq!(rates.at("color", 250_000), 0.01);
/// assert!(rates.names().eq(["density"]));
/// let joined = rates.joined(Rates::new(1.0).with("color", 0.5));
/// assert_eq!((joined.at("color", 0), joined.at("other", 0)), (0.5, 0.01));
/// ```
#[derive(Debug)]
pub struct Rates {
    default: Box<dyn Schedule>,
    by_name: Vec<(String, Box<dyn Schedule>)>,
}

impl Rates {
    /// Creates learning rates with the given default schedule.
    pub fn new(default: impl Schedule + 'static) -> Self {
        Rates { default: Box::new(default), by_name: Vec::new() }
    }

    /// Sets the schedule of the parameter with the given name. If a name is set several times, the last schedule is used.
    pub fn with(mut self, name: impl Into<String>, schedule: impl Schedule + 'static) -> Self {
        self.by_name.push((name.into(), Box::new(schedule)));
        self
    }

    /// Adds the schedules of the names of `other`, whose default is dropped.
    pub fn joined(mut self, other: Rates) -> Self {
        self.by_name.extend(other.by_name);
        self
    }

    /// Returns the names that have their own schedule, in the order in which they were set.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.by_name.iter().map(|(name, _)| &name[..])
    }

    /// Returns the learning rate of a parameter at a step.
    pub fn at(&self, name: &str, step: u64) -> f64 {
        let named = self.by_name.iter().rev().find(|(n, _)| n == name).map(|(_, schedule)| schedule);
        named.unwrap_or(&self.default).at(step)
    }
}

impl<S: Schedule + 'static> From<S> for Rates {
    fn from(schedule: S) -> Self {
        Rates::new(schedule)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Indices;
    use crate::tensor::Tensor;
    use ndarray::{Array1, arr1};

    fn all() -> Vec<(&'static str, Box<dyn Optimizer<f32>>)> {
        vec![
            ("sgd", Box::new(Sgd::new(0.1))),
            ("momentum", Box::new(Momentum::new(0.1, 0.9))),
            ("rmsprop", Box::new(RmsProp::new(0.1))),
            ("adam, lazy", Box::new(Adam::new(0.1, AdamMode::Lazy))),
            ("adam, dense", Box::new(Adam::new(0.1, AdamMode::Dense))),
        ]
    }

    fn params(len: usize) -> Vec<Param<f32>> {
        vec![Param::new("a", Array1::from_shape_fn(len, |i| (i % 101) as f32 * 0.01)), Param::new("b", arr1(&[1.0f32, 2.0]))]
    }

    /// Gradients of Σ a[rows]², where `rows` is every third row.
    fn gradients(params: &[Param<f32>]) -> Gradients<f32> {
        let rows: Vec<u32> = (0..params[0].shape()[0] as u32).step_by(3).collect();
        params[0].tensor().gather_rows(&Indices::from(rows)).square().sum().backward()
    }

    #[test]
    fn a_parameter_without_a_gradient_and_untouched_rows_are_left_alone() {
        for (name, mut optimizer) in all() {
            let mut params = params(7);
            let before: Vec<f32> = params[0].tensor().data().to_vec();
            for step in 0..3 {
                let grads = gradients(&params);
                optimizer.step(&mut params, &grads, step);
            }
            let after = params[0].tensor().data();
            for i in 0..7 {
                // The value of row 0 is 0, so its gradient is 0.
                assert_eq!(before[i] != after[i], i % 3 == 0 && i > 0, "{name}, row {i}");
            }
            assert_eq!(params[1].tensor().data(), [1.0, 2.0], "{name}");
        }
    }

    #[test]
    fn a_replaced_parameter_starts_afresh() {
        for ((name, mut used), (_, mut fresh)) in all().into_iter().zip(all()) {
            let mut old = params(7);
            for step in 0..5 {
                let grads = gradients(&old);
                used.step(&mut old, &grads, step);
            }
            let mut new = params(10);
            old[0].replace(new[0].tensor().clone());
            let (grads_old, grads_new) = (gradients(&old), gradients(&new));
            used.step(&mut old, &grads_old, 5);
            fresh.step(&mut new, &grads_new, 5);
            assert_eq!(old[0].tensor().data(), new[0].tensor().data(), "{name}");
        }
    }

    #[test]
    fn one_that_recalls_goes_on_as_the_one_that_remembered() {
        for ((name, mut first), (_, mut second)) in all().into_iter().zip(all()) {
            let mut whole = params(7);
            for step in 0..3 {
                let grads = gradients(&whole);
                first.step(&mut whole, &grads, step);
            }
            let mut copy: Vec<Param<f32>> = whole.iter().map(|p| Param::from_tensor(p.name(), p.tensor().detach())).collect();
            for (old, new) in whole.iter().zip(&copy) {
                if let Some(Remembered { updates, arrays }) = first.memory_of(old) {
                    let arrays: Vec<_> = arrays.into_iter().map(Buffer::copy_of).collect();
                    let short = arrays.iter().map(|array| Buffer::copy_of(&array[1..])).collect();
                    assert!(!second.recall(new, updates, short), "{name}");
                    assert!(!second.recall(new, updates, vec![Buffer::zeros(7); 3]), "{name}");
                    assert!(second.recall(new, updates, arrays), "{name}");
                }
            }
            for step in 3..6 {
                let (grads, grads_of_copy) = (gradients(&whole), gradients(&copy));
                first.step(&mut whole, &grads, step);
                second.step(&mut copy, &grads_of_copy, step);
            }
            assert_eq!(whole[0].tensor().data(), copy[0].tensor().data(), "{name}");
        }
    }

    #[test]
    fn what_is_remembered_of_a_vanished_parameter_is_dropped() {
        let mut optimizer = RmsProp::new(0.1);
        let mut params = params(7);
        let grads = gradients(&params);
        optimizer.step(&mut params, &grads, 0);
        let id = params[0].id();
        assert!(optimizer.0.memory.by_id.contains_key(&id));
        let value = Tensor::zeros(&[3]);
        params[0].replace(value);
        let grads = gradients(&params);
        optimizer.step(&mut params, &grads, 1);
        assert!(!optimizer.0.memory.by_id.contains_key(&id));
        assert_eq!(optimizer.0.memory.by_id.len(), 2);
    }

    #[test]
    fn updates_are_in_place_and_have_the_same_bits_for_any_number_of_threads() {
        // The length spans several chunks and is not a multiple of any chunk size.
        let len = 300_001;
        let train = |threads: usize, optimizer: &mut dyn Optimizer<f32>| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
            pool.install(|| {
                let mut params = params(len);
                let address = params[0].tensor().data().as_ptr();
                for step in 0..4 {
                    let grads = if step % 2 == 0 { gradients(&params) } else { params[0].tensor().powi(3).sum().backward() };
                    optimizer.step(&mut params, &grads, step);
                }
                assert_eq!(address, params[0].tensor().data().as_ptr(), "the values moved");
                params[0].tensor().data().to_vec()
            })
        };
        for i in 0..all().len() {
            let (name, mut optimizer) = all().swap_remove(i);
            let want = train(1, &mut *optimizer);
            for threads in [2, 3, 8] {
                assert!(train(threads, &mut *all().swap_remove(i).1) == want, "{name} with {threads} threads");
            }
        }
    }

    #[test]
    fn a_rate_goes_by_the_name_of_the_parameter_and_by_the_step() {
        let mut optimizer = Sgd::new(Rates::new(1.0).with("b", Piecewise::new(0.0).then(1, 0.5)));
        let mut params = vec![Param::new("a", arr1(&[1.0f64])), Param::new("b", arr1(&[1.0]))];
        for (step, want) in [(0, [0.0, 1.0]), (1, [-1.0, 0.5])] {
            let grads = (params[0].tensor() + params[1].tensor()).sum().backward();
            optimizer.step(&mut params, &grads, step);
            assert_eq!([params[0].tensor().item(), params[1].tensor().item()], want);
        }
    }
    #[test]
    fn every_optimizer_tells_the_rate_it_goes_by_in_a_box_too() {
        let rates = || Rates::new(1.0).with("b", Piecewise::new(0.0).then(1, 0.5));
        let all: [Box<dyn Optimizer<f64>>; 4] = [
            Box::new(Sgd::new(rates())),
            Box::new(Momentum::new(rates(), 0.9)),
            Box::new(RmsProp::new(rates())),
            Box::new(Box::new(Adam::new(rates(), AdamMode::Lazy))),
        ];
        for optimizer in all {
            assert_eq!(["a", "b"].map(|name| optimizer.rate(name, 0)), [1.0, 0.0]);
            assert_eq!(["a", "b"].map(|name| optimizer.rate(name, 1)), [1.0, 0.5]);
        }
    }
}
