//! [`Tensor`]: an immutable array with an optional graph node.

use crate::backward;
use crate::gradients::Gradients;
use crate::graph::{self, Edge, Node, Rule};
use crate::op::{Kernel, Op};
use crate::pool::Buffer;
use crate::real::Real;
use ndarray::{Array, ArrayD, ArrayViewD, Dimension, IxDyn};
use std::fmt;
use std::sync::Arc;

/// An immutable array of `T` in standard (row-major) layout. If it depends on a variable, it also has a graph node that records how it was computed.
///
/// A clone copies the shape and shares the buffer and the node. Ops are methods and operators; they panic at the caller's line if the shapes do not fit.
/// Several tensors may share one buffer, since `reshape` does not copy. A shared buffer is never modified.
#[derive(Clone)]
pub struct Tensor<T: Real> {
    pub(crate) data: Arc<Buffer<T>>,
    pub(crate) shape: IxDyn,
    pub(crate) node: Option<Arc<Node<T>>>,
}

impl<T: Real> Tensor<T> {
    /// Returns a constant: a tensor without a gradient.
    pub fn constant<D: Dimension>(value: Array<T, D>) -> Self {
        let shape = IxDyn(value.shape());
        let value = if value.is_standard_layout() { value } else { value.as_standard_layout().into_owned() };
        let (mut data, offset) = value.into_raw_vec_and_offset();
        let offset = offset.unwrap_or(0);
        if offset != 0 {
            data.drain(..offset);
        }
        data.truncate(shape.size());
        Tensor { data: Arc::new(data.into()), shape, node: None }
    }

    /// Returns a variable: a leaf of the graph, for which gradients are computed. A model should store its parameters as [`crate::Param`], which
    /// optimizers can update.
    pub fn variable<D: Dimension>(value: Array<T, D>) -> Self {
        Self::constant(value).into_variable()
    }

    /// Returns a constant of shape `[]`.
    pub fn scalar(value: T) -> Self {
        Self::from_buffer(vec![value].into(), &[])
    }

    /// Returns a constant from values in row-major order.
    ///
    /// Panics if the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_vec(values: Vec<T>, shape: &[usize]) -> Self {
        Self::from_buffer(values.into(), shape)
    }

    /// Returns a constant that owns `data`, in row-major order.
    ///
    /// Panics if the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_buffer(data: Buffer<T>, shape: &[usize]) -> Self {
        let shape = IxDyn(shape);
        assert_eq!(data.len(), shape.size(), "from_buffer: {} values do not fill the shape {:?}", data.len(), shape.slice());
        Tensor { data: Arc::new(data), shape, node: None }
    }

    /// Returns a constant of zeros.
    pub fn zeros(shape: &[usize]) -> Self {
        Self::from_buffer(Buffer::zeros(IxDyn(shape).size()), shape)
    }

    /// Returns a constant of ones.
    pub fn ones(shape: &[usize]) -> Self {
        Self::full(shape, 1.0)
    }

    /// Returns a constant whose elements all have the given value.
    pub fn full(shape: &[usize], value: f64) -> Self {
        let mut data = Buffer::stale(IxDyn(shape).size());
        crate::parallel::fill(&mut data, T::lit(value));
        Self::from_buffer(data, shape)
    }

    /// Returns the result of an op on `inputs`. `data` is the computed value, and `op` is the gradient rule.
    /// If no input is tracked, or inside [`crate::no_grad`], the result is a constant and `op` is dropped.
    ///
    /// Panics if the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_op(data: Buffer<T>, shape: &[usize], inputs: &[&Tensor<T>], op: impl Op<T>) -> Self {
        let keep = op.keep();
        Self::from_buffer(data, shape).recorded(inputs, keep, || Rule::Op(Box::new(op)))
    }

    /// Returns the result of a kernel on `inputs`; see [`Kernel`]. It is recorded under the same conditions as in [`Tensor::from_op`].
    ///
    /// Panics if the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_kernel(data: Buffer<T>, shape: &[usize], inputs: &[&Tensor<T>], kernel: impl Kernel<T>) -> Self {
        let keep = kernel.keep();
        Self::from_buffer(data, shape).recorded(inputs, keep, || Rule::Kernel(Box::new(kernel)))
    }

    /// Attaches a graph node to this value if recording is on and at least one input is tracked.
    pub(crate) fn recorded(mut self, inputs: &[&Tensor<T>], keep: crate::op::Keep, rule: impl FnOnce() -> Rule<T>) -> Self {
        if graph::recording() && inputs.iter().any(|x| x.is_tracked()) {
            let edges = inputs
                .iter()
                .enumerate()
                .map(|(i, x)| Edge { shape: x.shape.clone(), node: x.node.clone(), value: keep.keeps_input(i).then(|| x.data.clone()) })
                .collect();
            let output = keep.keeps_output().then(|| self.data.clone());
            self.node = Some(Arc::new(Node::new(self.shape.clone(), rule(), edges, output)));
        }
        self
    }

    /// Returns the same value as a new variable, without its previous graph node.
    pub fn into_variable(mut self) -> Self {
        self.node = Some(Arc::new(Node::new(self.shape.clone(), Rule::Leaf, Vec::new(), None)));
        self
    }

    /// Returns a view of the value.
    pub fn value(&self) -> ArrayViewD<'_, T> {
        ArrayViewD::from_shape(self.shape.clone(), &self.data[..]).expect("the data fill the shape")
    }

    /// Returns a copy of the value.
    pub fn to_array(&self) -> ArrayD<T> {
        self.value().to_owned()
    }

    /// Returns the values in row-major order.
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// Returns the shape.
    pub fn shape(&self) -> &[usize] {
        self.shape.slice()
    }

    /// Returns the number of dimensions.
    pub fn ndim(&self) -> usize {
        self.shape.ndim()
    }

    /// Returns the number of elements.
    pub fn len(&self) -> usize {
        self.data.len()
    }

    /// Returns true if there are no elements.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// Returns the value of a tensor with exactly one element.
    ///
    /// Panics if the tensor has another number of elements.
    #[track_caller]
    pub fn item(&self) -> T {
        assert_eq!(self.len(), 1, "item: expected one element, got shape {:?}", self.shape());
        self.data[0]
    }

    /// Returns true if this tensor has a graph node, so gradients flow to or through it.
    pub fn is_tracked(&self) -> bool {
        self.node.is_some()
    }

    /// Returns the same value as a constant, without its graph node.
    pub fn detach(&self) -> Self {
        Tensor { data: self.data.clone(), shape: self.shape.clone(), node: None }
    }

    /// Returns the gradients of this scalar with respect to every leaf that it depends on. The graph is kept, so the function may be called again.
    ///
    /// Panics if the tensor does not have exactly one element. [`Tensor::backward_from`] takes a cotangent for such tensors.
    #[track_caller]
    pub fn backward(&self) -> Gradients<T> {
        assert_eq!(self.len(), 1, "backward: expected a scalar, got shape {:?}; use backward_from with a cotangent", self.shape());
        self.backward_from(&Tensor::ones(self.shape()))
    }

    /// Returns the gradients of ⟨cotangent, self⟩ with respect to every leaf that this tensor depends on.
    ///
    /// Panics if the shapes differ.
    #[track_caller]
    pub fn backward_from(&self, cotangent: &Tensor<T>) -> Gradients<T> {
        assert_eq!(self.shape(), cotangent.shape(), "backward_from: the cotangent and the tensor must have the same shape");
        backward::to_leaves(self.node.clone(), cotangent.detach())
    }

    pub(crate) fn id(&self) -> Option<u64> {
        self.node.as_ref().map(|n| n.id)
    }
}

impl<T: Real> fmt::Debug for Tensor<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let place = match &self.node {
            None => "constant",
            Some(node) => node.rule.name(),
        };
        write!(f, "Tensor({place}, {:?}", self.shape())?;
        if self.len() <= 16 { write!(f, ", {:?})", &self.data[..]) } else { write!(f, ")") }
    }
}

impl<T: Real, D: Dimension> From<Array<T, D>> for Tensor<T> {
    fn from(value: Array<T, D>) -> Self {
        Tensor::constant(value)
    }
}
