//! The extension surface: what an author of an op implements.
//!
//! An [`Op`] states its rule in tensor ops, so the rule can be differentiated again. A [`Kernel`] states its adjoint on plain arrays,
//! which is faster and cannot be differentiated; so it must also state the same computation in small ops, its `reference`, through
//! which second derivatives go and against which tests hold the adjoint.

use crate::gradients::RowSparse;
use crate::graph::{Edge, Node};
use crate::index::Indices;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use std::fmt::Debug;

/// Which values a rule reads: only those are kept until the backward pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Keep {
    inputs: u32,
    output: bool,
}

impl Keep {
    /// Neither inputs nor output.
    pub const NOTHING: Keep = Keep { inputs: 0, output: false };
    /// All inputs.
    pub const INPUTS: Keep = Keep { inputs: u32::MAX, output: false };
    /// The output.
    pub const OUTPUT: Keep = Keep { inputs: 0, output: true };
    /// Everything; what a rule gets that does not say.
    pub const INPUTS_AND_OUTPUT: Keep = Keep { inputs: u32::MAX, output: true };

    /// These inputs only.
    pub const fn some_inputs(which: &[usize]) -> Keep {
        let mut inputs = 0;
        let mut i = 0;
        while i < which.len() {
            inputs |= 1 << which[i];
            i += 1;
        }
        Keep { inputs, output: false }
    }

    pub(crate) fn keeps_input(self, i: usize) -> bool {
        self.inputs == u32::MAX || (i < 32 && self.inputs >> i & 1 == 1)
    }

    pub(crate) fn keeps_output(self) -> bool {
        self.output
    }
}

/// A differentiable operation whose rule is written in tensor ops.
pub trait Op<T: Real>: Debug + Send + Sync + 'static {
    /// The name, for messages.
    fn name(&self) -> &'static str;

    /// What the rule reads. Forgetting to narrow it costs memory, not correctness.
    fn keep(&self) -> Keep {
        Keep::INPUTS_AND_OUTPUT
    }

    /// The cotangent of each input, given that of the output. A contribution may have the output's (broadcast) shape: the engine sums
    /// it down to the input's.
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>>;
}

/// A hand-written adjoint on arrays, with the reference it is held to.
pub trait Kernel<T: Real>: Debug + Send + Sync + 'static {
    /// The name, for messages.
    fn name(&self) -> &'static str;

    /// What adjoint and reference read; the reference reads the inputs.
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }

    /// The meaning of this kernel, in small ops. Derivatives of second and higher order go through it.
    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T>;

    /// Puts the cotangents of the inputs into `out`.
    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>);
}

/// A share of an input's cotangent.
pub enum Cotangent<T: Real> {
    /// Of the input's shape, or of one that broadcasting made of it.
    Dense(Tensor<T>),
    /// Zero except that `values[k]` is added to row `rows[k]` of the input; rows may repeat, in any order.
    Rows {
        /// One row number for each row of `values`.
        rows: Indices,
        /// `[rows.len(), …]`, trailing dimensions those of the input.
        values: Tensor<T>,
    },
    /// The same with rows sorted and unique, or to be so when somebody asks: from a kernel.
    Merged(RowSparse<T>),
}

/// What a rule sees of the node it differentiates.
pub struct Vjp<'a, T: Real> {
    pub(crate) node: &'a std::sync::Arc<Node<T>>,
    pub(crate) cotangent: &'a Tensor<T>,
    pub(crate) needed: &'a [bool],
    /// True in a differentiable pass: inputs and output are then handed out with their place in the graph.
    pub(crate) tracked: bool,
}

impl<T: Real> Vjp<'_, T> {
    /// The cotangent of the output, of the output's shape.
    pub fn cotangent(&self) -> &Tensor<T> {
        self.cotangent
    }

    /// Input `i`. Panics, naming the op, if its [`Keep`] left it out.
    pub fn input(&self, i: usize) -> Tensor<T> {
        input(self.node, i, self.tracked)
    }

    /// The output. Panics, naming the op, if its [`Keep`] left it out.
    pub fn output(&self) -> Tensor<T> {
        let Some(data) = &self.node.output else { panic!("{}: the rule reads its output, which `keep` left out", self.node.rule.name()) };
        Tensor { data: data.clone(), shape: self.node.shape.clone(), node: self.tracked.then(|| self.node.clone()) }
    }

    /// The shape of input `i`, kept or not.
    pub fn input_shape(&self, i: usize) -> &[usize] {
        use ndarray::Dimension;
        self.node.inputs[i].shape.slice()
    }

    /// The dense cotangent of input `i`, computed only if somebody needs it.
    pub fn wrt(&self, i: usize, f: impl FnOnce() -> Tensor<T>) -> Option<Cotangent<T>> {
        self.needed[i].then(|| Cotangent::Dense(f()))
    }

    /// The cotangent of input `i` as rows, computed only if somebody needs it.
    pub fn wrt_rows(&self, i: usize, rows: &Indices, f: impl FnOnce() -> Tensor<T>) -> Option<Cotangent<T>> {
        self.needed[i].then(|| Cotangent::Rows { rows: rows.clone(), values: f() })
    }
}

pub(crate) fn input<T: Real>(node: &Node<T>, i: usize, tracked: bool) -> Tensor<T> {
    let Edge { shape, node: source, value } = &node.inputs[i];
    let Some(data) = value else { panic!("{}: the rule reads input {i}, which `keep` left out", node.rule.name()) };
    Tensor { data: data.clone(), shape: shape.clone(), node: if tracked { source.clone() } else { None } }
}

/// What a kernel's adjoint sees: plain arrays.
pub struct KernelCall<'a, T: Real> {
    pub(crate) node: &'a Node<T>,
    pub(crate) cotangent: &'a Tensor<T>,
    pub(crate) needed: &'a [bool],
}

impl<T: Real> KernelCall<'_, T> {
    /// The cotangent of the output, of the output's shape.
    pub fn cotangent(&self) -> &Tensor<T> {
        self.cotangent
    }

    /// Input `i` as a constant. Panics, naming the kernel, if its [`Keep`] left it out.
    pub fn input(&self, i: usize) -> Tensor<T> {
        input(self.node, i, false)
    }

    /// The output as a constant. Panics, naming the kernel, if its [`Keep`] left it out.
    pub fn output(&self) -> Tensor<T> {
        let Some(data) = &self.node.output else {
            panic!("{}: the adjoint reads its output, which `keep` left out", self.node.rule.name())
        };
        Tensor { data: data.clone(), shape: self.node.shape.clone(), node: None }
    }

    /// True if somebody needs the cotangent of input `i`.
    pub fn needs(&self, i: usize) -> bool {
        self.needed[i]
    }
}

/// Where a kernel's adjoint leaves its results.
pub struct GradSink<T: Real> {
    pub(crate) shapes: Vec<ndarray::IxDyn>,
    pub(crate) slots: Vec<Option<Cotangent<T>>>,
}

impl<T: Real> GradSink<T> {
    /// The cotangent of input `i`, in row-major order of its shape.
    ///
    /// Panics if the input has a cotangent already.
    #[track_caller]
    pub fn dense(&mut self, i: usize, values: Buffer<T>) {
        use ndarray::Dimension;
        assert!(self.slots[i].is_none(), "a dense cotangent for input {i}, which has one already");
        self.slots[i] = Some(Cotangent::Dense(Tensor::from_buffer(values, self.shapes[i].slice())));
    }

    /// The cotangent of input `i` as sorted, unique rows, added up now or later. Rows that are given in several calls are added to those before.
    ///
    /// Panics if the input has a dense cotangent already.
    #[track_caller]
    pub fn rows(&mut self, i: usize, rows: RowSparse<T>) {
        use ndarray::Dimension;
        debug_assert_eq!(rows.shape(), self.shapes[i].slice());
        self.slots[i] = Some(Cotangent::Merged(match self.slots[i].take() {
            Some(Cotangent::Merged(before)) => before.plus(rows),
            None => rows,
            Some(_) => panic!("rows for input {i}, which has a dense cotangent already"),
        }));
    }
}
