//! Nodes: what a tensor remembers of its computation.
//!
//! A node points at the nodes of its inputs and at nothing else, so a graph is freed by dropping its last tensor. Ids grow with
//! creation; an input's id is therefore always smaller than its user's, and "largest id first" is a reverse topological order.

use crate::op::{Kernel, Op};
use crate::pool::Buffer;
use crate::real::Real;
use ndarray::IxDyn;
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

pub(crate) struct Node<T: Real> {
    pub id: u64,
    pub shape: IxDyn,
    pub rule: Rule<T>,
    pub inputs: Vec<Edge<T>>,
    /// The value of the node, if its rule asked to keep it.
    pub output: Option<Arc<Buffer<T>>>,
}

pub(crate) enum Rule<T: Real> {
    Leaf,
    Op(Box<dyn Op<T>>),
    Kernel(Box<dyn Kernel<T>>),
}

impl<T: Real> Rule<T> {
    pub fn name(&self) -> &'static str {
        match self {
            Rule::Leaf => "variable",
            Rule::Op(op) => op.name(),
            Rule::Kernel(kernel) => kernel.name(),
        }
    }
}

/// An input of a node: where its gradient goes, and its value if the rule asked to keep it.
pub(crate) struct Edge<T: Real> {
    pub shape: IxDyn,
    pub node: Option<Arc<Node<T>>>,
    pub value: Option<Arc<Buffer<T>>>,
}

impl<T: Real> Node<T> {
    pub fn new(shape: IxDyn, rule: Rule<T>, inputs: Vec<Edge<T>>, output: Option<Arc<Buffer<T>>>) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Node { id: NEXT.fetch_add(1, Ordering::Relaxed), shape, rule, inputs, output }
    }
}

/// A chain of a million nodes is dropped by a loop and not by a million nested calls.
impl<T: Real> Drop for Node<T> {
    fn drop(&mut self) {
        let mut orphans: Vec<Arc<Node<T>>> = self.inputs.drain(..).filter_map(|edge| edge.node).collect();
        while let Some(node) = orphans.pop() {
            if let Some(mut node) = Arc::into_inner(node) {
                orphans.extend(node.inputs.drain(..).filter_map(|edge| edge.node));
            }
        }
    }
}

thread_local! {
    static RECORDING: Cell<bool> = const { Cell::new(true) };
}

/// True unless this thread is inside [`no_grad`].
pub fn recording() -> bool {
    RECORDING.get()
}

/// Runs `f` without recording a graph, on this thread. Evaluation does not need it: ops on constants record nothing anyway.
///
/// While `f` waits for a parallel op, rayon may run another task on this thread. Do not build graphs in tasks of rayon's that run beside a
/// `no_grad`.
pub fn no_grad<R>(f: impl FnOnce() -> R) -> R {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            RECORDING.set(self.0);
        }
    }
    let _restore = Restore(RECORDING.replace(false));
    f()
}
