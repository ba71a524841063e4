//! The interface for custom ops.
//!
//! An [`Op`] expresses its rule in tensor ops, so the rule can be differentiated again. A [`Kernel`] computes its adjoint on plain arrays, which is
//! faster but cannot be differentiated. A kernel must therefore also provide a `reference`: the same computation in small tensor ops. Second
//! derivatives are computed through the reference, and tests compare the adjoint with it.

use crate::graph::{Edge, Node};
use crate::index::Indices;
use crate::pool::Buffer;
use crate::real::Real;
use crate::rows::sparse::RowSparse;
use crate::rows::sum::sum_into_rows;
use crate::tensor::Tensor;
use ndarray::Dimension;
use std::fmt::Debug;
use std::sync::OnceLock;

/// The set of values that a rule reads. Only these are kept until the backward pass.
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
    /// All inputs and the output: the default of [`Op::keep`].
    pub const INPUTS_AND_OUTPUT: Keep = Keep { inputs: u32::MAX, output: true };

    /// Returns the set of the inputs with the given indices, which must be below 32.
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

/// A differentiable op whose rule is written in tensor ops.
pub trait Op<T: Real>: Debug + Send + Sync + 'static {
    /// Returns the name of the op, for error messages.
    fn name(&self) -> &'static str;

    /// Returns the values that the rule reads. The default keeps all inputs and the output; a smaller set saves memory.
    fn keep(&self) -> Keep {
        Keep::INPUTS_AND_OUTPUT
    }

    /// Computes the vector-Jacobian product: the cotangent of each input, given the cotangent of the output. A dense cotangent may have the
    /// broadcast shape of the output; the engine sums it to the shape of the input. `None` means zero.
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>>;
}

/// A differentiable op with a hand-written adjoint on arrays, and the reference that it is compared with.
pub trait Kernel<T: Real>: Debug + Send + Sync + 'static {
    /// Returns the name of the kernel, for error messages.
    fn name(&self) -> &'static str;

    /// Returns the values that the adjoint and the reference read. The reference needs all inputs.
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }

    /// Computes the same function as the kernel in small tensor ops. Second and higher derivatives are computed through this reference.
    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T>;

    /// Computes the vector-Jacobian product and writes the cotangents of the inputs to `out`.
    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>);
}

/// A contribution to the cotangent of an input.
pub enum Cotangent<T: Real> {
    /// A dense contribution. Its shape is the shape of the input, or a shape that the input broadcasts to; or it is a scalar, which is added to each element of the
    /// input, as from a sum over all elements.
    Dense(Tensor<T>),
    /// A row-sparse contribution: row k of `values` is added to row `rows[k]` of the input. Rows may repeat and may have any order.
    Rows {
        /// One row number for each row of `values`.
        rows: Indices,
        /// Values of the rows, `[rows.len(), …]`, with the trailing dimensions of the input.
        values: Tensor<T>,
    },
    /// A row-sparse contribution of a kernel, whose rows are sorted and unique. The sums may be lazy ([`RowSparse::deferred`]).
    Merged(RowSparse<T>),
}

/// The arguments of [`Op::vjp`]: the cotangent of the output and the kept values.
pub struct Vjp<'a, T: Real> {
    pub(crate) node: &'a std::sync::Arc<Node<T>>,
    /// Cotangent of the output, or a scalar if it is known to be uniform.
    pub(crate) factor: &'a Tensor<T>,
    /// `factor`, repeated to the shape of the output on first use.
    pub(crate) spread: OnceLock<Tensor<T>>,
    pub(crate) needed: &'a [bool],
    /// True in a differentiable pass: inputs and output are then returned with their graph nodes.
    pub(crate) tracked: bool,
}

impl<T: Real> Vjp<'_, T> {
    /// Returns the cotangent of the output, which has the shape of the output.
    pub fn cotangent(&self) -> &Tensor<T> {
        let shape = self.node.shape.slice();
        if self.factor.shape() == shape { self.factor } else { self.spread.get_or_init(|| self.factor.broadcast_to(shape)) }
    }

    /// Returns a factor for products and quotients with tensors of the shape of the output: a scalar if the cotangent is known to be uniform, as that of the
    /// terms of a sum, or else [`Vjp::cotangent`]. The scalar saves memory traffic.
    ///
    /// It is also a cotangent of an input that has the shape of the output. For an input that is repeated to that shape (broadcasting), use [`Vjp::cotangent`]: the
    /// scalar would leave out the repetitions.
    pub fn cotangent_factor(&self) -> &Tensor<T> {
        self.factor
    }

    /// Returns input `i`.
    ///
    /// Panics with the name of the op if [`Op::keep`] does not include the input.
    pub fn input(&self, i: usize) -> Tensor<T> {
        input(self.node, i, self.tracked)
    }

    /// Returns the output.
    ///
    /// Panics with the name of the op if [`Op::keep`] does not include the output.
    pub fn output(&self) -> Tensor<T> {
        let Some(data) = &self.node.output else {
            panic!("{}: the rule reads its output, which `keep` does not include", self.node.rule.name())
        };
        Tensor { data: data.clone(), shape: self.node.shape.clone(), node: self.tracked.then(|| self.node.clone()) }
    }

    /// Returns the shape of input `i`, which is available even if the value was not kept.
    pub fn input_shape(&self, i: usize) -> &[usize] {
        self.node.inputs[i].shape.slice()
    }

    /// Returns the dense cotangent of input `i`. `f` is called only if this cotangent is needed.
    pub fn wrt(&self, i: usize, f: impl FnOnce() -> Tensor<T>) -> Option<Cotangent<T>> {
        self.needed[i].then(|| Cotangent::Dense(f()))
    }

    /// Returns the row-sparse cotangent of input `i`. `f` computes the values of the rows and is called only if this cotangent is needed.
    pub fn wrt_rows(&self, i: usize, rows: &Indices, f: impl FnOnce() -> Tensor<T>) -> Option<Cotangent<T>> {
        self.needed[i].then(|| Cotangent::Rows { rows: rows.clone(), values: f() })
    }
}

pub(crate) fn input<T: Real>(node: &Node<T>, i: usize, tracked: bool) -> Tensor<T> {
    let Edge { shape, node: source, value } = &node.inputs[i];
    let Some(data) = value else { panic!("{}: the rule reads input {i}, which `keep` does not include", node.rule.name()) };
    Tensor { data: data.clone(), shape: shape.clone(), node: if tracked { source.clone() } else { None } }
}

/// The arguments of [`Kernel::vjp`]: the cotangent of the output and the kept values, as constants.
pub struct KernelCall<'a, T: Real> {
    pub(crate) node: &'a Node<T>,
    pub(crate) cotangent: &'a Tensor<T>,
    pub(crate) needed: &'a [bool],
}

impl<T: Real> KernelCall<'_, T> {
    /// Returns the cotangent of the output, which has the shape of the output.
    pub fn cotangent(&self) -> &Tensor<T> {
        self.cotangent
    }

    /// Returns input `i` as a constant.
    ///
    /// Panics with the name of the kernel if [`Kernel::keep`] does not include the input.
    pub fn input(&self, i: usize) -> Tensor<T> {
        input(self.node, i, false)
    }

    /// Returns the output as a constant.
    ///
    /// Panics with the name of the kernel if [`Kernel::keep`] does not include the output.
    pub fn output(&self) -> Tensor<T> {
        let Some(data) = &self.node.output else {
            panic!("{}: the adjoint reads its output, which `keep` does not include", self.node.rule.name())
        };
        Tensor { data: data.clone(), shape: self.node.shape.clone(), node: None }
    }

    /// Returns true if the cotangent of input `i` is needed.
    pub fn needs(&self, i: usize) -> bool {
        self.needed[i]
    }
}

/// The output of [`Kernel::vjp`]: collects the cotangents of the inputs.
pub struct GradSink<T: Real> {
    pub(crate) kernel: &'static str,
    pub(crate) shapes: Vec<ndarray::IxDyn>,
    pub(crate) slots: Vec<Option<Cotangent<T>>>,
}

impl<T: Real> GradSink<T> {
    /// Sets the dense cotangent of input `i`, in row-major order of its shape.
    ///
    /// Panics if the input already has a cotangent, or if the number of values does not fit its shape.
    #[track_caller]
    pub fn dense(&mut self, i: usize, values: Buffer<T>) {
        assert!(self.slots[i].is_none(), "{}: a dense cotangent for input {i}, which already has a cotangent", self.kernel);
        self.slots[i] = Some(Cotangent::Dense(Tensor::from_buffer(values, self.shapes[i].slice())));
    }

    /// Adds a row-sparse cotangent to input `i`. Its rows are sorted and unique, and its sums may be lazy. The results of several calls are summed.
    ///
    /// Panics if the input already has a dense cotangent.
    #[track_caller]
    pub fn rows(&mut self, i: usize, rows: RowSparse<T>) {
        debug_assert_eq!(rows.shape(), self.shapes[i].slice());
        self.slots[i] = Some(Cotangent::Merged(match self.slots[i].take() {
            Some(Cotangent::Merged(before)) => before.plus(rows),
            None => rows,
            Some(_) => panic!("{}: rows for input {i}, which already has a dense cotangent", self.kernel),
        }));
    }

    /// Adds contributions to rows of the cotangent of input `i`, a table `[R, …]`: row j of `values`, `[rows.len(), …]`, is added to row `rows[j]`.
    ///
    /// Rows may have any order and may repeat; the gradient of all other rows is zero. Contributions are added in the order of j, so the bits do not
    /// depend on the number of threads. The results of several calls are summed.
    ///
    /// Panics if `values` does not have one row for each of `rows`, if a row number is R or more, or if the input already has a dense cotangent.
    #[track_caller]
    pub fn scatter(&mut self, i: usize, rows: &[u32], values: &[T]) {
        let (found, want) = (values.len(), rows.len() * self.width(i));
        assert_eq!(found, want, "{}: {found} values for {} rows of input {i}, {:?}", self.kernel, rows.len(), self.shapes[i].slice());
        self.scatter_weighted(i, |j| ([rows[j]], [T::one()]), values);
    }

    /// Adds weighted contributions to rows of the cotangent of input `i`, a table `[R, …]`. Each item contributes to `K` rows: for each item j and
    /// each k, with `(rows, weights) = touch(j)`, `weights[k]` times row j of `values`, `[items, …]`, is added to row `rows[k]`.
    ///
    /// Order, repeated rows and several calls are handled as in [`GradSink::scatter`]. `touch` is called several times for each item, from any
    /// thread, and must always return the same result.
    ///
    /// Example: linear interpolation between the rows of a table, yⱼ = (1 − f) x\[r\] + f x\[r + 1\] at position r + f:
    ///
    /// ```
    /// use autograd::{GradSink, Indices, Kernel, KernelCall, Real, Tensor, check_kernel};
    ///
    /// #[derive(Debug)]
    /// struct InterpolateRows {
    ///     positions: Vec<f64>,
    /// }
    ///
    /// impl InterpolateRows {
    ///     fn touch<T: Real>(&self, j: usize) -> ([u32; 2], [T; 2]) {
    ///         let (r, f) = (self.positions[j] as u32, self.positions[j].fract());
    ///         ([r, r + 1], [T::lit(1.0 - f), T::lit(f)])
    ///     }
    /// }
    ///
    /// impl<T: Real> Kernel<T> for InterpolateRows {
    ///     fn name(&self) -> &'static str {
    ///         "interpolate_rows"
    ///     }
    ///     fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
    ///         let n = self.positions.len();
    ///         let part = |k: usize| {
    ///             let (rows, weights) = (0..n).map(|j| self.touch::<T>(j)).map(|(rows, weights)| (rows[k], weights[k])).unzip::<u32, T, Vec<_>, Vec<_>>();
    ///             inputs[0].gather_rows(&Indices::from(rows)) * Tensor::from_vec(weights, &[n, 1])
    ///         };
    ///         part(0) + part(1)
    ///     }
    ///     fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
    ///         out.scatter_weighted(0, |j| self.touch(j), call.cotangent().data());
    ///     }
    /// }
    ///
    /// /// Interpolates a table `[R, C]` at positions in [0, R − 1); the result is `[positions, C]`.
    /// fn interpolate_rows<T: Real>(table: &Tensor<T>, positions: Vec<f64>) -> Tensor<T> {
    ///     let (kernel, width) = (InterpolateRows { positions }, table.shape()[1]);
    ///     let mut values = Vec::new();
    ///     for j in 0..kernel.positions.len() {
    ///         let ([low, high], [a, b]) = kernel.touch::<T>(j);
    ///         let row = |r: u32| &table.data()[r as usize * width..][..width];
    ///         values.extend(row(low).iter().zip(row(high)).map(|(&x, &y)| a * x + b * y));
    ///     }
    ///     Tensor::from_kernel(values.into(), &[kernel.positions.len(), width], &[table], kernel)
    /// }
    ///
    /// let table = ndarray::arr2(&[[1.0, 5.0], [2.0, 7.0], [4.0, 3.0]]).into_dyn();
    /// check_kernel(|x| interpolate_rows(&x[0], vec![1.25, 0.5, 1.75]), [table], 1e-12).unwrap();
    /// ```
    ///
    /// Panics if the length of `values` is not a multiple of the row width, if a row number is R or more, or if the input already has a dense
    /// cotangent.
    #[track_caller]
    pub fn scatter_weighted<const K: usize>(&mut self, i: usize, touch: impl Fn(usize) -> ([u32; K], [T; K]) + Sync, values: &[T]) {
        let (shape, width) = (self.shapes[i].slice(), self.width(i));
        let items = values.len() / width.max(1);
        assert_eq!(items * width, values.len(), "{}: {} values for rows of input {i}, {shape:?}", self.kernel, values.len());
        let rows = sum_into_rows(self.kernel, shape, items, touch, values);
        self.rows(i, rows);
    }

    /// Returns the number of elements in a row of input `i`.
    #[track_caller]
    fn width(&self, i: usize) -> usize {
        let shape = self.shapes[i].slice();
        assert!(!shape.is_empty(), "{}: rows for input {i}, which is a scalar", self.kernel);
        shape[1..].iter().product()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sink(shape: &[usize]) -> GradSink<f64> {
        GradSink { kernel: "test", shapes: vec![ndarray::IxDyn(shape)], slots: vec![None] }
    }

    fn rows(sink: &GradSink<f64>) -> &RowSparse<f64> {
        let Some(Cotangent::Merged(rows)) = &sink.slots[0] else { panic!("rows") };
        rows
    }

    #[test]
    fn scattered_rows_come_in_any_order_repeat_and_add_up_over_calls() {
        let mut sink = sink(&[5, 2]);
        sink.scatter(0, &[3, 0, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!((rows(&sink).rows(), rows(&sink).data()), (&[0, 3][..], &[3.0, 4.0, 6.0, 8.0][..]));
        // One item that contributes to row 4 twice.
        sink.scatter_weighted(0, |_| ([4, 0, 4], [1.0, 2.0, 0.5]), &[10.0, 20.0]);
        assert_eq!((rows(&sink).rows(), rows(&sink).data()), (&[0, 3, 4][..], &[23.0, 44.0, 6.0, 8.0, 15.0, 30.0][..]));
        sink.scatter(0, &[], &[]);
        assert_eq!(rows(&sink).rows(), [0, 3, 4]);
    }

    #[test]
    fn scattering_has_the_same_bits_for_any_number_of_threads() {
        let n = 30_000;
        let numbers: Vec<u32> = (0..n as u32).map(|j| j.wrapping_mul(2_654_435_761) % 1003).collect();
        let values: Vec<f64> = (0..3 * n).map(|j| (j % 997) as f64 * 0.37 - 180.0).collect();
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            let mut sink = sink(&[1003, 3]);
            pool.install(|| sink.scatter_weighted(0, |j| ([numbers[j], numbers[n - 1 - j]], [0.3, 0.7]), &values));
            rows(&sink).data().to_vec()
        };
        let want = run(1);
        assert!([2, 3, 8].into_iter().all(|threads| run(threads) == want));
    }

    #[test]
    #[should_panic(expected = "test: 3 values for 2 rows of input 0, [5, 2]")]
    fn rows_without_values_are_refused() {
        sink(&[5, 2]).scatter(0, &[0, 1], &[1.0; 3]);
    }

    #[test]
    #[should_panic(expected = "test: row 50000 is out of range for a table of 5 rows")]
    fn a_row_beyond_the_input_is_refused() {
        sink(&[5, 2]).scatter(0, &[0, 50_000, 2], &[1.0; 6]);
    }
}
