//! [`Tensor`]: an immutable array with an optional place in a graph.

use crate::backward;
use crate::gradients::Gradients;
use crate::graph::{self, Edge, Node, Rule};
use crate::op::{Kernel, Op};
use crate::pool::Buffer;
use crate::real::Real;
use ndarray::{Array, ArrayD, ArrayViewD, Dimension, IxDyn};
use std::fmt;
use std::sync::Arc;

/// An immutable array of `T` in standard (row-major) layout that remembers how it was computed, if anything it depends on is a variable.
///
/// Cloning copies two pointers. Ops are methods and operators; those that get shapes they cannot use panic at the caller's line.
/// Two tensors may share one buffer (a reshape copies nothing); nobody can change it while they do.
#[derive(Clone)]
pub struct Tensor<T: Real> {
    pub(crate) data: Arc<Buffer<T>>,
    pub(crate) shape: IxDyn,
    pub(crate) node: Option<Arc<Node<T>>>,
}

impl<T: Real> Tensor<T> {
    /// A value that no gradient flows to.
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

    /// A leaf: a value that gradients flow to. Parameters of a model are better kept in a [`crate::Param`], which an optimizer can change.
    pub fn variable<D: Dimension>(value: Array<T, D>) -> Self {
        Self::constant(value).into_variable()
    }

    /// A constant of shape `[]`.
    pub fn scalar(value: T) -> Self {
        Self::from_buffer(vec![value].into(), &[])
    }

    /// A constant from values in row-major order.
    ///
    /// Panics if the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_vec(values: Vec<T>, shape: &[usize]) -> Self {
        Self::from_buffer(values.into(), shape)
    }

    /// A constant that takes over a buffer.
    ///
    /// Panics if the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_buffer(data: Buffer<T>, shape: &[usize]) -> Self {
        let shape = IxDyn(shape);
        assert_eq!(data.len(), shape.size(), "from_buffer: {} values do not fill the shape {:?}", data.len(), shape.slice());
        Tensor { data: Arc::new(data), shape, node: None }
    }

    /// A constant of zeros.
    pub fn zeros(shape: &[usize]) -> Self {
        Self::from_buffer(Buffer::zeros(IxDyn(shape).size()), shape)
    }

    /// A constant of ones.
    pub fn ones(shape: &[usize]) -> Self {
        Self::full(shape, 1.0)
    }

    /// A constant with one value everywhere.
    pub fn full(shape: &[usize], value: f64) -> Self {
        let mut data = Buffer::stale(IxDyn(shape).size());
        crate::parallel::fill(&mut data, T::lit(value));
        Self::from_buffer(data, shape)
    }

    /// The result of an op on `inputs`. `data` is what the op computed; `op` says how gradients go back.
    /// If no input tracks, or inside [`crate::no_grad`], nothing is recorded and `op` is dropped.
    #[track_caller]
    pub fn from_op(data: Buffer<T>, shape: &[usize], inputs: &[&Tensor<T>], op: impl Op<T>) -> Self {
        let keep = op.keep();
        Self::from_buffer(data, shape).recorded(inputs, keep, || Rule::Op(Box::new(op)))
    }

    /// The result of a kernel on `inputs`; see [`Kernel`].
    #[track_caller]
    pub fn from_kernel(data: Buffer<T>, shape: &[usize], inputs: &[&Tensor<T>], kernel: impl Kernel<T>) -> Self {
        let keep = kernel.keep();
        Self::from_buffer(data, shape).recorded(inputs, keep, || Rule::Kernel(Box::new(kernel)))
    }

    /// Places this fresh value in the graph, if anybody will ask.
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

    /// The same value as a fresh leaf.
    pub fn into_variable(mut self) -> Self {
        self.node = Some(Arc::new(Node::new(self.shape.clone(), Rule::Leaf, Vec::new(), None)));
        self
    }

    /// The value.
    pub fn value(&self) -> ArrayViewD<'_, T> {
        ArrayViewD::from_shape(self.shape.clone(), &self.data[..]).expect("a tensor's data fill its shape")
    }

    /// The value, copied out.
    pub fn to_array(&self) -> ArrayD<T> {
        self.value().to_owned()
    }

    /// The values in row-major order.
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// The shape.
    pub fn shape(&self) -> &[usize] {
        self.shape.slice()
    }

    /// The number of dimensions.
    pub fn ndim(&self) -> usize {
        self.shape.ndim()
    }

    /// The number of elements.
    pub fn len(&self) -> usize {
        self.data.len()
    }

    /// True if there are no elements.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// The one element of a tensor that has one. Panics otherwise.
    #[track_caller]
    pub fn item(&self) -> T {
        assert_eq!(self.len(), 1, "item: expected one element, got shape {:?}", self.shape());
        self.data[0]
    }

    /// True if gradients flow to or through this tensor.
    pub fn is_tracked(&self) -> bool {
        self.node.is_some()
    }

    /// The same value, cut off from the graph.
    pub fn detach(&self) -> Self {
        Tensor { data: self.data.clone(), shape: self.shape.clone(), node: None }
    }

    /// Gradients of this scalar with respect to every leaf it depends on. The graph stays, so it may be called again.
    ///
    /// Panics if the tensor has more than one element; [`Tensor::backward_from`] takes a cotangent for those.
    #[track_caller]
    pub fn backward(&self) -> Gradients<T> {
        assert_eq!(self.len(), 1, "backward: expected a scalar, got shape {:?}; use backward_from with a cotangent", self.shape());
        self.backward_from(&Tensor::ones(self.shape()))
    }

    /// Gradients of ⟨cotangent, self⟩ with respect to every leaf.
    ///
    /// Panics if the shapes differ.
    #[track_caller]
    pub fn backward_from(&self, cotangent: &Tensor<T>) -> Gradients<T> {
        assert_eq!(self.shape(), cotangent.shape(), "backward_from: the cotangent must have the shape of the tensor");
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
