//! Graph nodes: the record of how a tensor was computed.
//!
//! A node owns references to the nodes of its inputs and has no other links, so a graph is freed when its last tensor is dropped. Ids increase in the
//! order of creation. The id of an input is therefore always smaller than the id of its user, and decreasing ids are a reverse topological order.

use crate::op::{Kernel, Op};
use crate::pool::Buffer;
use crate::real::Real;
use ndarray::IxDyn;
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A node of the graph: one variable or one recorded op.
pub(crate) struct Node<T: Real> {
    pub id: u64,
    pub shape: IxDyn,
    pub rule: Rule<T>,
    pub inputs: Vec<Edge<T>>,
    /// Value of the node, if its rule keeps the output ([`crate::Keep`]).
    pub output: Option<Arc<Buffer<T>>>,
}

/// The gradient rule of a node.
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

/// An input of a node.
pub(crate) struct Edge<T: Real> {
    pub shape: IxDyn,
    /// Node that receives the gradient, or `None` for a constant.
    pub node: Option<Arc<Node<T>>>,
    /// Value of the input, if the rule keeps it ([`crate::Keep`]).
    pub value: Option<Arc<Buffer<T>>>,
}

impl<T: Real> Node<T> {
    pub fn new(shape: IxDyn, rule: Rule<T>, inputs: Vec<Edge<T>>, output: Option<Arc<Buffer<T>>>) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Node { id: NEXT.fetch_add(1, Ordering::Relaxed), shape, rule, inputs, output }
    }
}

/// Drops the inputs in a loop: recursion would overflow the stack on a chain of a million nodes.
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

/// Returns true unless this thread is inside [`no_grad`].
pub fn recording() -> bool {
    RECORDING.get()
}

/// Runs `f` without recording a graph on this thread. Ops on constants never record a graph, so evaluation of a model on constants does not need this
/// function.
///
/// While `f` waits for a parallel op, rayon may run another task on this thread, and that task would record no graph either. Do not build graphs in
/// rayon tasks that run concurrently with `no_grad`.
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
