//! The backward pass: one loop over a heap of node ids.
//!
//! Ids grow with creation, so popping the largest id first visits every node after all of its users: no recursion and no visit marks.
//! The same loop serves first derivatives to the leaves, on constants, and differentiable ones to chosen tensors, on tracked values.
//! A kernel in a differentiable pass is replaced by its reference: the new nodes have the largest ids and are popped next.

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
use std::sync::Arc;

/// Gradients of the scalar `y` with respect to `wrt`, as tensors that can be differentiated again. Where `y` does not depend on one, zeros.
///
/// ```
/// use autograd::{Tensor, grad};
/// let x = Tensor::variable(ndarray::arr1(&[1.0, 2.0]));
/// let slope = &grad(&x.powi(3).sum(), &[&x])[0];       // 3x²
/// let curvature = slope.sum().backward().array(&x);   // 6x
/// assert_eq!(curvature.as_slice().unwrap(), [6.0, 12.0]);
/// ```
///
/// Panics if `y` has more than one element.
#[track_caller]
pub fn grad<T: Real>(y: &Tensor<T>, wrt: &[&Tensor<T>]) -> Vec<Tensor<T>> {
    assert_eq!(y.len(), 1, "grad: expected a scalar, got shape {:?}", y.shape());
    let targets: Vec<Option<u64>> = wrt.iter().map(|x| x.id()).collect();
    // Inside `no_grad` the result is constant: a kernel's reference would record nothing to go through.
    let needed = Needed::new(targets.iter().flatten().copied());
    let mut pass = Pass { tracked: graph::recording(), needed: Some(needed), pending: HashMap::new(), heap: BinaryHeap::new() };
    if let Some(root) = &y.node
        && pass.is_needed(root)
    {
        pass.push(root.clone(), Pending::Dense(Tensor::ones(y.shape())));
    }
    let mut found: HashMap<u64, Tensor<T>> = HashMap::new();
    while let Some((node, pending)) = pass.pop() {
        let cotangent = pending.dense(&node.shape);
        if targets.contains(&Some(node.id)) {
            found.insert(node.id, cotangent.clone());
        }
        pass.spread(node, cotangent);
    }
    wrt.iter().map(|x| x.id().and_then(|id| found.get(&id).cloned()).unwrap_or_else(|| Tensor::zeros(x.shape()))).collect()
}

/// Runs `f`, then its backward pass; the graph is gone before the gradients are returned, so parameters can be changed in place.
///
/// Panics if the result has more than one element.
#[track_caller]
pub fn value_and_grad<T: Real>(f: impl FnOnce() -> Tensor<T>) -> (T, Gradients<T>) {
    let y = f();
    let value = y.item();
    let seed = Tensor::ones(y.shape());
    let root = y.node.clone();
    drop(y);
    (value, to_leaves(root, seed))
}

/// First derivatives of ⟨seed, root⟩ to every leaf. Owning the root, it frees what it has passed. Rules see constants here, so nothing is
/// recorded.
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
            // A row gradient that arrives at an op is made dense: look up first and apply activations after.
            let cotangent = pending.dense(&node.shape);
            pass.spread(node, cotangent);
        }
    }
    Gradients { by_leaf }
}

struct Pass<T: Real> {
    tracked: bool,
    needed: Option<Needed>,
    pending: HashMap<u64, (Arc<Node<T>>, Pending<T>)>,
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

    /// Hands a node's cotangent on to its inputs.
    fn spread(&mut self, node: Arc<Node<T>>, cotangent: Tensor<T>) {
        let needed: Vec<bool> = node.inputs.iter().map(|edge| edge.node.as_ref().is_some_and(|n| self.is_needed(n))).collect();
        if !needed.contains(&true) {
            return;
        }
        let shares = match &node.rule {
            Rule::Leaf => return,
            Rule::Op(op) => {
                let shares = op.vjp(&Vjp { node: &node, cotangent: &cotangent, needed: &needed, tracked: self.tracked });
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
                assert_eq!(output.shape(), node.shape.slice(), "{}: the reference has another shape than the kernel", kernel.name());
                if let Some(reference) = &output.node {
                    self.push(reference.clone(), Pending::Dense(cotangent));
                }
                return;
            }
            Rule::Kernel(kernel) => {
                let mut sink = GradSink {
                    kernel: kernel.name(),
                    shapes: node.inputs.iter().map(|edge| edge.shape.clone()).collect(),
                    slots: node.inputs.iter().map(|_| None).collect(),
                };
                kernel.vjp(&KernelCall { node: &node, cotangent: &cotangent, needed: &needed }, &mut sink);
                sink.slots
            }
        };
        drop(cotangent);
        for ((share, edge), _) in shares.into_iter().zip(&node.inputs).zip(&needed).filter(|(_, needed)| **needed) {
            let (Some(share), Some(source)) = (share, &edge.node) else { continue };
            let share = match share {
                Cotangent::Dense(t) if t.shape() == edge.shape.slice() => Pending::Dense(t),
                Cotangent::Dense(t) => Pending::Dense(t.sum_to(edge.shape.slice())),
                Cotangent::Rows { rows, values } => Pending::Rows(vec![RowPart::Touches { rows, values }]),
                Cotangent::Merged(rows) => Pending::Rows(vec![RowPart::Merged(rows)]),
            };
            self.push(source.clone(), share);
        }
    }
}

/// What has arrived at a node so far.
enum Pending<T: Real> {
    Dense(Tensor<T>),
    Rows(Vec<RowPart<T>>),
}

enum RowPart<T: Real> {
    Touches { rows: Indices, values: Tensor<T> },
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

    /// The sum with a dense gradient, in its buffer if nobody else holds it.
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
            Pending::Rows(parts) => {
                parts.into_iter().map(|p| p.dense(shape)).reduce(|a, b| &a + &b).unwrap_or_else(|| Tensor::zeros(shape.slice()))
            }
        }
    }

    fn finish(self, shape: &IxDyn) -> Grad<T> {
        match self {
            Pending::Dense(t) => Grad::Dense(t),
            Pending::Rows(parts) => match parts.into_iter().map(|p| p.merged(shape)).reduce(RowSparse::plus) {
                Some(rows) => Grad::Rows(rows),
                None => Grad::Dense(Tensor::zeros(shape.slice())),
            },
        }
    }
}

/// a + b in the buffer of whichever nobody else holds.
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

/// Which nodes lie between the result and the targets, found by a search that remembers.
struct Needed {
    known: HashMap<u64, bool>,
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
            let verdict = if self.known.contains_key(&top.id) {
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
            if let Some(verdict) = verdict {
                self.known.insert(top.id, verdict);
            }
            stack.pop();
        }
        self.known[&node.id]
    }
}
