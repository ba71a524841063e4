//! [`Param`]: a named leaf that optimizers update. [`Module`]: a set of parameters.

mod module;

use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
pub use module::Module;
use ndarray::{Array, Dimension};
use std::sync::Arc;

/// A trainable parameter: a named leaf of the graph.
///
/// A parameter has an identity, by which optimizers find the state that they keep for it. [`Param::update`] keeps the identity; [`Param::replace`]
/// gives a new one, so old optimizer state is never applied to a new value.
#[derive(Debug)]
pub struct Param<T: Real> {
    name: String,
    tensor: Tensor<T>,
    bounds: Bounds<T>,
}

/// The interval of values that a parameter may take. Optimizers clamp the elements that they update to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds<T> {
    /// Smallest value, or −∞.
    pub low: T,
    /// Largest value, or +∞.
    pub high: T,
}

impl<T: Real> Bounds<T> {
    /// Returns the bounds that allow every value.
    pub fn none() -> Self {
        Bounds { low: T::neg_infinity(), high: T::infinity() }
    }

    /// Returns the allowed value nearest to `x`, or NaN if `x` is NaN.
    #[inline(always)]
    pub fn nearest(self, x: T) -> T {
        let x = if x < self.low { self.low } else { x };
        if x > self.high { self.high } else { x }
    }
}

impl<T: Real> Param<T> {
    /// Creates a parameter. Learning rates and parameter files refer to it by its name.
    pub fn new<D: Dimension>(name: impl Into<String>, value: Array<T, D>) -> Self {
        Self::from_tensor(name, Tensor::constant(value))
    }

    /// Creates a parameter with the value of a tensor. The graph of the tensor is dropped.
    pub fn from_tensor(name: impl Into<String>, value: Tensor<T>) -> Self {
        Param { name: name.into(), tensor: value.into_variable(), bounds: Bounds::none() }
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the tensor of the parameter, for use in computations.
    pub fn tensor(&self) -> &Tensor<T> {
        &self.tensor
    }

    /// Returns the shape.
    pub fn shape(&self) -> &[usize] {
        self.tensor.shape()
    }

    /// Returns the bounds of the values. By default every value is allowed.
    pub fn bounds(&self) -> Bounds<T> {
        self.bounds
    }

    /// Sets the bounds that optimizers enforce. The current values are not changed.
    pub fn set_bounds(&mut self, bounds: Bounds<T>) {
        self.bounds = bounds;
    }

    /// Updates the values in place. If a graph or another tensor shares the buffer, the buffer is copied first and the other owners keep the old values.
    pub fn update<R>(&mut self, f: impl FnOnce(&mut [T]) -> R) -> R {
        f(Arc::<Buffer<T>>::make_mut(&mut self.tensor.data))
    }

    /// Replaces the value by a tensor of any shape. The parameter gets a new identity.
    pub fn replace(&mut self, value: Tensor<T>) {
        self.tensor = value.into_variable();
    }

    /// Replaces the value by a tracked tensor, which keeps its graph node. Gradients then flow through the parameter to the inputs of that tensor, for
    /// example to the output of another network or to the input of a gradient check. The identity of the parameter becomes the identity of the tensor.
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
