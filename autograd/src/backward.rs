//! The backward pass: one loop over a heap of node ids.
//!
//! Ids increase in the order of creation. Popping the largest id first therefore visits every node after all of its users, without recursion and
//! without visit marks. The same loop computes first derivatives with respect to all leaves, on constants, and differentiable derivatives with respect
//! to chosen tensors, on tracked values. A differentiable pass replaces a kernel by its reference: the new nodes have the largest ids and are popped next.

use crate::gradients::{Grad, Gradients};
use crate::graph::{self, Node, Rule};
use crate::index::Indices;
use crate::op::{Cotangent, GradSink, KernelCall, Vjp};
use crate::ops::lookup::add_rows;
use crate::parallel;
use crate::pool::Buffer;
use crate::real::Real;
use crate::rows::sparse::RowSparse;
use crate::rows::sum::sum_into_rows;
use crate::single::{cast, is_single};
use crate::tensor::Tensor;
use ndarray::{Dimension, IxDyn};
use std::collections::{BinaryHeap, HashMap};
use std::sync::{Arc, OnceLock};

/// Returns the gradients of the scalar `y` with respect to each tensor in `wrt`, as tensors that can be differentiated again. The gradient is zero if
/// `y` does not depend on the tensor.
///
/// ```
/// use autograd::{Tensor, grad};
/// let x = Tensor::variable(ndarray::arr1(&[1.0, 2.0]));
/// let slope = &grad(&x.powi(3).sum(), &[&x])[0];       // 3x²
/// let curvature = slope.sum().backward().array(&x);   // 6x
/// assert_eq!(curvature.as_slice().unwrap(), [6.0, 12.0]);
/// ```
///
/// Panics if `y` does not have exactly one element.
#[track_caller]
pub fn grad<T: Real>(y: &Tensor<T>, wrt: &[&Tensor<T>]) -> Vec<Tensor<T>> {
    assert_eq!(y.len(), 1, "grad: expected a scalar, got shape {:?}", y.shape());
    let targets: Vec<Option<u64>> = wrt.iter().map(|x| x.id()).collect();
    // Inside `no_grad` the pass must not be differentiable: the reference of a kernel would record no graph, and its gradient would be lost.
    let needed = Needed::new(targets.iter().flatten().copied());
    let mut pass = Pass { tracked: graph::recording(), needed: Some(needed), pending: HashMap::new(), heap: BinaryHeap::new() };
    if let Some(root) = &y.node
        && pass.is_needed(root)
    {
        pass.push(root.clone(), Pending::Dense(Tensor::ones(y.shape())));
    }
    let mut found: HashMap<u64, Tensor<T>> = HashMap::new();
    while let Some((node, pending)) = pass.pop() {
        let cotangent = pending.factor(&node.shape);
        if targets.contains(&Some(node.id)) {
            found.insert(node.id, spread(cotangent.clone(), &node.shape));
        }
        pass.propagate(node, cotangent);
    }
    wrt.iter().map(|x| x.id().and_then(|id| found.get(&id).cloned()).unwrap_or_else(|| Tensor::zeros(x.shape()))).collect()
}

/// Runs `f` and the backward pass of its result, and returns the result and its gradients with respect to all leaves. The graph is freed before the
/// function returns, so parameters can be updated in place.
///
/// Panics if the result of `f` does not have exactly one element.
#[track_caller]
pub fn value_and_grad<T: Real>(f: impl FnOnce() -> Tensor<T>) -> (T, Gradients<T>) {
    let y = f();
    let value = y.item();
    let seed = Tensor::ones(y.shape());
    let root = y.node.clone();
    drop(y);
    (value, to_leaves(root, seed))
}

/// Computes the first derivatives of ⟨seed, root⟩ with respect to every leaf. If the caller holds no other reference to the root, each node is freed
/// as soon as the pass has visited it. Rules receive constants, so nothing is recorded.
pub(crate) fn to_leaves<T: Real>(root: Option<Arc<Node<T>>>, seed: Tensor<T>) -> Gradients<T> {
    if const { is_single::<T>() } { cast(to_leaves_single(cast(root), cast(seed))) } else { to_leaves_of(root, seed) }
}

#[inline(never)]
fn to_leaves_single(root: Option<Arc<Node<f32>>>, seed: Tensor<f32>) -> Gradients<f32> {
    to_leaves_of(root, seed)
}

fn to_leaves_of<T: Real>(root: Option<Arc<Node<T>>>, seed: Tensor<T>) -> Gradients<T> {
    let mut pass = Pass { tracked: false, needed: None, pending: HashMap::new(), heap: BinaryHeap::new() };
    let mut by_leaf = HashMap::new();
    if let Some(root) = root {
        pass.push(root, Pending::Dense(seed));
    }
    while let Some((node, pending)) = pass.pop() {
        if matches!(node.rule, Rule::Leaf) {
            by_leaf.insert(node.id, pending.finish(&node.shape));
        } else {
            // A row-sparse gradient that reaches an op becomes dense. Models should therefore gather rows first and apply activations afterwards.
            let cotangent = pending.factor(&node.shape);
            pass.propagate(node, cotangent);
        }
    }
    Gradients { by_leaf }
}

/// The state of a backward pass.
struct Pass<T: Real> {
    /// True if the pass is differentiable.
    tracked: bool,
    /// Nodes that lead to the targets, or `None` if every leaf is a target.
    needed: Option<Needed>,
    /// Sums of the contributions to nodes that have not been visited, by node id.
    pending: HashMap<u64, (Arc<Node<T>>, Pending<T>)>,
    /// Ids of the nodes in `pending`.
    heap: BinaryHeap<u64>,
}

impl<T: Real> Pass<T> {
    fn push(&mut self, node: Arc<Node<T>>, share: Pending<T>) {
        let id = node.id;
        let tracked = self.tracked;
        match self.pending.remove(&id) {
            None => {
                self.heap.push(id);
                self.pending.insert(id, (node, share));
            }
            Some((_, before)) => {
                let sum = before.plus(share, &node.shape, tracked);
                self.pending.insert(id, (node, sum));
            }
        }
    }

    fn pop(&mut self) -> Option<(Arc<Node<T>>, Pending<T>)> {
        let id = self.heap.pop()?;
        self.pending.remove(&id)
    }

    fn is_needed(&mut self, node: &Arc<Node<T>>) -> bool {
        self.needed.as_mut().is_none_or(|needed| needed.contains(node))
    }

    /// Applies the rule of a node: computes the cotangents of its inputs from the cotangent of its output, which may be a scalar for all elements, and adds them to
    /// the pending sums.
    fn propagate(&mut self, node: Arc<Node<T>>, cotangent: Tensor<T>) {
        let needed: Vec<bool> = node.inputs.iter().map(|edge| edge.node.as_ref().is_some_and(|n| self.is_needed(n))).collect();
        if !needed.contains(&true) {
            return;
        }
        let shares = match &node.rule {
            Rule::Leaf => return,
            Rule::Op(op) => {
                let shares =
                    op.vjp(&Vjp { node: &node, factor: &cotangent, spread: OnceLock::new(), needed: &needed, tracked: self.tracked });
                assert_eq!(
                    shares.len(),
                    node.inputs.len(),
                    "{}: the rule returned {} cotangents for {} inputs",
                    op.name(),
                    shares.len(),
                    node.inputs.len()
                );
                shares
            }
            Rule::Kernel(kernel) if self.tracked => {
                let inputs: Vec<Tensor<T>> = (0..node.inputs.len()).map(|i| crate::op::input(&node, i, true)).collect();
                let output = kernel.reference(&inputs);
                assert_eq!(
                    output.shape(),
                    node.shape.slice(),
                    "{}: the outputs of the reference and the kernel differ in shape",
                    kernel.name()
                );
                if let Some(reference) = &output.node {
                    self.push(reference.clone(), Pending::Dense(spread(cotangent, &node.shape)));
                }
                return;
            }
            Rule::Kernel(kernel) => {
                let mut sink = GradSink {
                    kernel: kernel.name(),
                    shapes: node.inputs.iter().map(|edge| edge.shape.clone()).collect(),
                    slots: node.inputs.iter().map(|_| None).collect(),
                };
                let cotangent = spread(cotangent.clone(), &node.shape);
                kernel.vjp(&KernelCall { node: &node, cotangent: &cotangent, needed: &needed }, &mut sink);
                sink.slots
            }
        };
        drop(cotangent);
        for ((share, edge), _) in shares.into_iter().zip(&node.inputs).zip(&needed).filter(|(_, needed)| **needed) {
            let (Some(share), Some(source)) = (share, &edge.node) else { continue };
            let share = match share {
                Cotangent::Dense(t) if t.shape() == edge.shape.slice() => Pending::Dense(t),
                Cotangent::Dense(t) if t.ndim() == 0 => Pending::Uniform(t),
                Cotangent::Dense(t) => Pending::Dense(t.sum_to(edge.shape.slice())),
                Cotangent::Rows { rows, values } => Pending::Rows(vec![RowPart::Touches { rows, values }]),
                Cotangent::Merged(rows) => Pending::Rows(vec![RowPart::Merged(rows)]),
            };
            self.push(source.clone(), share);
        }
    }
}

/// The sum of the contributions that have arrived at a node so far.
enum Pending<T: Real> {
    Dense(Tensor<T>),
    /// A scalar that is the sum for each element.
    Uniform(Tensor<T>),
    Rows(Vec<RowPart<T>>),
}

/// A row-sparse contribution to a node.
enum RowPart<T: Real> {
    /// Unsorted rows, which may repeat.
    Touches { rows: Indices, values: Tensor<T> },
    /// Sorted, unique rows.
    Merged(RowSparse<T>),
}

impl<T: Real> RowPart<T> {
    fn merged(self, shape: &IxDyn) -> RowSparse<T> {
        match self {
            RowPart::Merged(rows) => rows,
            RowPart::Touches { rows, values } => {
                sum_into_rows("backward", shape.slice(), rows.len(), |i| ([rows[i]], [T::one()]), values.data())
            }
        }
    }

    /// Returns the sum with a dense gradient. It reuses the buffer of the dense gradient if that buffer is not shared.
    fn added_to(self, mut dense: Tensor<T>) -> Tensor<T> {
        let width = dense.shape()[1..].iter().product();
        let table = Arc::<Buffer<T>>::make_mut(&mut dense.data);
        match self {
            RowPart::Merged(rows) => rows.add_to(table),
            RowPart::Touches { rows, values } => add_rows(table, width, &rows, values.data()),
        }
        dense
    }

    fn dense(self, shape: &IxDyn) -> Tensor<T> {
        match self {
            RowPart::Merged(rows) => rows.to_dense(),
            RowPart::Touches { rows, values } => values.scatter_rows(&rows, shape[0]),
        }
    }
}

impl<T: Real> Pending<T> {
    fn plus(self, other: Self, shape: &IxDyn, tracked: bool) -> Self {
        match (self, other) {
            (Pending::Uniform(a), Pending::Uniform(b)) => Pending::Uniform(&a + &b),
            (Pending::Uniform(t), other) | (other, Pending::Uniform(t)) => Pending::Dense(spread(t, shape)).plus(other, shape, tracked),
            (Pending::Rows(mut a), Pending::Rows(b)) => {
                a.extend(b);
                Pending::Rows(a)
            }
            (Pending::Dense(dense), Pending::Rows(parts)) | (Pending::Rows(parts), Pending::Dense(dense)) if !tracked => {
                Pending::Dense(parts.into_iter().fold(dense, |sum, part| part.added_to(sum)))
            }
            (a, b) => {
                let (a, b) = (a.dense(shape), b.dense(shape));
                Pending::Dense(if tracked { &a + &b } else { add_in_place(a, b) })
            }
        }
    }

    fn dense(self, shape: &IxDyn) -> Tensor<T> {
        match self {
            Pending::Dense(t) => t,
            Pending::Uniform(t) => spread(t, shape),
            Pending::Rows(parts) => {
                parts.into_iter().map(|p| p.dense(shape)).reduce(|a, b| &a + &b).unwrap_or_else(|| Tensor::zeros(shape.slice()))
            }
        }
    }

    /// Returns the sum, or the scalar that it is for each element.
    fn factor(self, shape: &IxDyn) -> Tensor<T> {
        match self {
            Pending::Uniform(t) => t,
            other => other.dense(shape),
        }
    }

    fn finish(self, shape: &IxDyn) -> Grad<T> {
        match self {
            Pending::Dense(t) => Grad::Dense(t),
            Pending::Uniform(t) => Grad::Dense(spread(t, shape)),
            Pending::Rows(parts) => match parts.into_iter().map(|p| p.merged(shape)).reduce(RowSparse::plus) {
                Some(rows) => Grad::Rows(rows),
                None => Grad::Dense(Tensor::zeros(shape.slice())),
            },
        }
    }
}

/// Repeats a uniform cotangent to a shape; returns others as they are.
fn spread<T: Real>(cotangent: Tensor<T>, shape: &IxDyn) -> Tensor<T> {
    if cotangent.shape() == shape.slice() { cotangent } else { cotangent.broadcast_to(shape.slice()) }
}

/// Returns a + b. It reuses the buffer of `a` or `b` if one of them is not shared.
fn add_in_place<T: Real>(mut a: Tensor<T>, mut b: Tensor<T>) -> Tensor<T> {
    if let Some(x) = Arc::<Buffer<T>>::get_mut(&mut a.data) {
        parallel::zip_in_place(x, b.data(), |x, y| x + y);
        return a;
    }
    if let Some(y) = Arc::<Buffer<T>>::get_mut(&mut b.data) {
        parallel::zip_in_place(y, a.data(), |y, x| x + y);
        return b;
    }
    &a + &b
}

pub(crate) fn add_grads<T: Real>(a: Grad<T>, b: Grad<T>) -> Grad<T> {
    match (a, b) {
        (Grad::Rows(a), Grad::Rows(b)) => Grad::Rows(a.plus(b)),
        (Grad::Dense(a), Grad::Dense(b)) => Grad::Dense(add_in_place(a, b)),
        (Grad::Dense(dense), Grad::Rows(rows)) | (Grad::Rows(rows), Grad::Dense(dense)) => {
            Grad::Dense(RowPart::Merged(rows).added_to(dense))
        }
    }
}

/// The nodes on the paths from the result to the targets, found by a memoized depth-first search.
struct Needed {
    /// True for each visited node that leads to a target, false for the other visited nodes.
    known: HashMap<u64, bool>,
    /// Smallest id of a target. A node with a smaller id cannot lead to a target.
    smallest: u64,
}

impl Needed {
    fn new(targets: impl Iterator<Item = u64>) -> Self {
        let known: HashMap<u64, bool> = targets.map(|id| (id, true)).collect();
        let smallest = known.keys().copied().min().unwrap_or(u64::MAX);
        Needed { known, smallest }
    }

    fn contains<T: Real>(&mut self, node: &Arc<Node<T>>) -> bool {
        let mut stack = vec![node];
        while let Some(top) = stack.last() {
            let leads_to_target = if self.known.contains_key(&top.id) {
                None
            } else if top.id < self.smallest {
                Some(false)
            } else {
                let sources = || top.inputs.iter().filter_map(|edge| edge.node.as_ref());
                if sources().any(|n| self.known.get(&n.id) == Some(&true)) {
                    Some(true)
                } else if let Some(unknown) = sources().find(|n| !self.known.contains_key(&n.id)) {
                    stack.push(unknown);
                    continue;
                } else {
                    Some(false)
                }
            };
            if let Some(leads_to_target) = leads_to_target {
                self.known.insert(top.id, leads_to_target);
            }
            stack.pop();
        }
        self.known[&node.id]
    }
}
