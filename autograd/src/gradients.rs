//! Gradients of leaves, dense or row-sparse: the input of optimizers.

use crate::param::Param;
use crate::real::Real;
use crate::rows::sparse::RowSparse;
use crate::tensor::Tensor;
use ndarray::{ArrayD, ArrayViewD};
use std::collections::HashMap;

/// The gradient of one leaf.
#[derive(Debug, Clone)]
pub enum Grad<T: Real> {
    /// A dense gradient: one number for each element.
    Dense(Tensor<T>),
    /// A row-sparse gradient: it stores only the touched rows; all other rows are zero.
    Rows(RowSparse<T>),
}

impl<T: Real> Grad<T> {
    /// Returns the whole gradient as a dense array.
    pub fn to_array(&self) -> ArrayD<T> {
        match self {
            Grad::Dense(g) => g.to_array(),
            Grad::Rows(g) => g.to_dense().to_array(),
        }
    }

    /// Returns the dense gradient, or `None` if the gradient is row-sparse.
    pub fn as_dense(&self) -> Option<ArrayViewD<'_, T>> {
        match self {
            Grad::Dense(g) => Some(g.value()),
            Grad::Rows(_) => None,
        }
    }

    /// Returns the row-sparse gradient, or `None` if the gradient is dense.
    pub fn as_rows(&self) -> Option<&RowSparse<T>> {
        match self {
            Grad::Dense(_) => None,
            Grad::Rows(g) => Some(g),
        }
    }

    /// Returns the stored values in row-major order: all values of a dense gradient, or the values of the touched rows.
    pub fn data(&self) -> &[T] {
        match self {
            Grad::Dense(g) => g.data(),
            Grad::Rows(g) => g.data(),
        }
    }
}

/// The gradients from a backward pass, one for each leaf that the result depends on.
#[derive(Debug)]
pub struct Gradients<T: Real> {
    pub(crate) by_leaf: HashMap<u64, Grad<T>>,
}

impl<T: Real> Gradients<T> {
    /// Returns the gradient of a leaf, or `None` if the result did not depend on it.
    pub fn get(&self, leaf: &Tensor<T>) -> Option<&Grad<T>> {
        self.by_leaf.get(&leaf.id()?)
    }

    /// Returns the gradient of a parameter, or `None` if the result did not depend on it.
    pub fn of(&self, param: &Param<T>) -> Option<&Grad<T>> {
        self.get(param.tensor())
    }

    /// Returns the gradient of a leaf as a dense array, or zeros if the result did not depend on it. This is convenient in tests and experiments.
    pub fn array(&self, leaf: &Tensor<T>) -> ArrayD<T> {
        self.get(leaf).map_or_else(|| ArrayD::zeros(leaf.shape()), Grad::to_array)
    }

    /// Adds the gradients of another backward pass to these, for example if a batch is processed in chunks.
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
