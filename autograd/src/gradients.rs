//! Gradients as optimizers take them: dense, or the rows that were touched.

use crate::param::Param;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use ndarray::{ArrayD, ArrayView2, ArrayViewD, Dimension, IxDyn};
use std::collections::HashMap;

/// The gradient of one leaf.
#[derive(Debug, Clone)]
pub enum Grad<T: Real> {
    /// One number for each element.
    Dense(Tensor<T>),
    /// Only the rows that something looked up; all others are zero.
    Rows(RowSparse<T>),
}

/// Rows of a table `[R, …]`: sorted, unique, with one row of values each.
#[derive(Debug, Clone)]
pub struct RowSparse<T: Real> {
    shape: IxDyn,
    rows: Buffer<u32>,
    values: Buffer<T>,
}

impl<T: Real> RowSparse<T> {
    /// Panics if `rows` is not sorted and unique and below the table's length, or if `values` does not hold one table row for each.
    #[track_caller]
    pub fn new(shape: &[usize], rows: Buffer<u32>, values: Buffer<T>) -> Self {
        let width: usize = shape[1..].iter().product();
        assert_eq!(rows.len() * width, values.len(), "RowSparse: {} rows of {width} values got {} values", rows.len(), values.len());
        assert!(rows.is_sorted_by(|a, b| a < b), "RowSparse: rows must be sorted and unique");
        assert!(rows.last().is_none_or(|&last| (last as usize) < shape[0]), "RowSparse: a row lies beyond the table of {} rows", shape[0]);
        RowSparse { shape: IxDyn(shape), rows, values }
    }

    /// Shape of the whole table.
    pub fn shape(&self) -> &[usize] {
        self.shape.slice()
    }

    /// Elements of one row.
    pub fn width(&self) -> usize {
        self.shape()[1..].iter().product()
    }

    /// The touched rows, ascending.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// `[rows, width]`
    pub fn values(&self) -> ArrayView2<'_, T> {
        ArrayView2::from_shape((self.rows.len(), self.width()), &self.values[..]).expect("one row of values for each row")
    }

    /// The values, row after row.
    pub fn data(&self) -> &[T] {
        &self.values
    }

    /// The same gradient with its zeros.
    pub fn to_dense(&self) -> Tensor<T> {
        let width = self.width();
        let mut out = Buffer::zeros(self.shape.size());
        for (k, &row) in self.rows.iter().enumerate() {
            out[row as usize * width..][..width].copy_from_slice(&self.values[k * width..][..width]);
        }
        Tensor::from_buffer(out, self.shape())
    }
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
