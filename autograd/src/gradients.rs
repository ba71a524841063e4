//! Gradients as optimizers take them: dense, or the rows that were touched.

use crate::param::Param;
use crate::real::Real;
use crate::rows::sparse::RowSparse;
use crate::tensor::Tensor;
use ndarray::{ArrayD, ArrayViewD};
use std::collections::HashMap;

/// The gradient of one leaf.
#[derive(Debug, Clone)]
pub enum Grad<T: Real> {
    /// One number for each element.
    Dense(Tensor<T>),
    /// Only the rows that something looked up; all others are zero.
    Rows(RowSparse<T>),
}

impl<T: Real> Grad<T> {
    /// The whole gradient as an array.
    pub fn to_array(&self) -> ArrayD<T> {
        match self {
            Grad::Dense(g) => g.to_array(),
            Grad::Rows(g) => g.to_dense().to_array(),
        }
    }

    /// The dense gradient, or `None` if it is rows.
    pub fn as_dense(&self) -> Option<ArrayViewD<'_, T>> {
        match self {
            Grad::Dense(g) => Some(g.value()),
            Grad::Rows(_) => None,
        }
    }

    /// The touched rows, or `None` if the gradient is dense.
    pub fn as_rows(&self) -> Option<&RowSparse<T>> {
        match self {
            Grad::Dense(_) => None,
            Grad::Rows(g) => Some(g),
        }
    }

    /// The values that are present: all of them, or those of the touched rows.
    pub fn data(&self) -> &[T] {
        match self {
            Grad::Dense(g) => g.data(),
            Grad::Rows(g) => g.data(),
        }
    }
}

/// The gradients of one backward pass, by leaf.
#[derive(Debug)]
pub struct Gradients<T: Real> {
    pub(crate) by_leaf: HashMap<u64, Grad<T>>,
}

impl<T: Real> Gradients<T> {
    /// The gradient of a leaf, or `None` if the result did not depend on it.
    pub fn get(&self, leaf: &Tensor<T>) -> Option<&Grad<T>> {
        self.by_leaf.get(&leaf.id()?)
    }

    /// The gradient of a parameter, or `None` if the result did not depend on it.
    pub fn of(&self, param: &Param<T>) -> Option<&Grad<T>> {
        self.get(param.tensor())
    }

    /// The gradient of a leaf as an array, zeros if there is none: convenient in tests and experiments.
    pub fn array(&self, leaf: &Tensor<T>) -> ArrayD<T> {
        self.get(leaf).map_or_else(|| ArrayD::zeros(leaf.shape()), Grad::to_array)
    }

    /// Adds another pass's gradients to these: a batch may come in chunks.
    pub fn add(&mut self, other: Gradients<T>) {
        for (id, grad) in other.by_leaf {
            let sum = match self.by_leaf.remove(&id) {
                None => grad,
                Some(mine) => crate::backward::add_grads(mine, grad),
            };
            self.by_leaf.insert(id, sum);
        }
    }
}
