//! [`Param`]: a named leaf that an optimizer may change. [`Module`]: a set of them.

mod module;

use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
pub use module::Module;
use ndarray::{Array, Dimension};
use std::sync::Arc;

/// A named leaf. Its identity survives updates and not a change of shape, so state that an optimizer keeps for it cannot be applied to
/// something else.
#[derive(Debug)]
pub struct Param<T: Real> {
    name: String,
    tensor: Tensor<T>,
    bounds: Bounds<T>,
}

/// The values a parameter may take: an optimizer brings what it changed back to the nearest of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds<T> {
    /// Smallest value, or −∞.
    pub low: T,
    /// Largest value, or +∞.
    pub high: T,
}

impl<T: Real> Bounds<T> {
    /// All values.
    pub fn none() -> Self {
        Bounds { low: T::neg_infinity(), high: T::infinity() }
    }

    /// The allowed value nearest to x; NaN stays NaN.
    #[inline(always)]
    pub fn nearest(self, x: T) -> T {
        let x = if x < self.low { self.low } else { x };
        if x > self.high { self.high } else { x }
    }
}

impl<T: Real> Param<T> {
    /// A parameter; names are what rates, schedules and checkpoints go by.
    pub fn new<D: Dimension>(name: impl Into<String>, value: Array<T, D>) -> Self {
        Self::from_tensor(name, Tensor::constant(value))
    }

    /// A parameter that takes over a tensor's value.
    pub fn from_tensor(name: impl Into<String>, value: Tensor<T>) -> Self {
        Param { name: name.into(), tensor: value.into_variable(), bounds: Bounds::none() }
    }

    /// The name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The leaf, to compute with.
    pub fn tensor(&self) -> &Tensor<T> {
        &self.tensor
    }

    /// The shape.
    pub fn shape(&self) -> &[usize] {
        self.tensor.shape()
    }

    /// The values it may take; all of them, unless [`Param::set_bounds`] said otherwise.
    pub fn bounds(&self) -> Bounds<T> {
        self.bounds
    }

    /// Says which values optimizers may give it. Values it has now are not changed.
    pub fn set_bounds(&mut self, bounds: Bounds<T>) {
        self.bounds = bounds;
    }

    /// Changes the values in place. If somebody still holds a graph or a clone with the old values, they keep them: the buffer is then
    /// copied first, which is slower and never wrong.
    pub fn update<R>(&mut self, f: impl FnOnce(&mut [T]) -> R) -> R {
        f(Arc::<Buffer<T>>::make_mut(&mut self.tensor.data))
    }

    /// Takes a new value, of any shape, and a new identity.
    pub fn replace(&mut self, value: Tensor<T>) {
        self.tensor = value.into_variable();
    }

    /// Computes with `tensor` from now on and leaves it its place in a graph: gradients flow through the parameter to what the tensor came
    /// from, be it another network's output or the input of a gradient check. The identity is the tensor's.
    ///
    /// Panics if the tensor is a constant.
    #[track_caller]
    pub fn bind(&mut self, tensor: Tensor<T>) {
        assert!(tensor.is_tracked(), "bind: parameter `{}` was given a constant; use replace", self.name);
        self.tensor = tensor;
    }

    pub(crate) fn id(&self) -> u64 {
        self.tensor.id().expect("a parameter is a leaf")
    }
}
