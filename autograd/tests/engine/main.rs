//! Tests of the public behaviour of the engine: lifetime of graphs, row-sparse gradients, messages, and bits that do not depend on threads.

mod graphs;
mod kernels;
mod messages;
mod row_gradients;
mod threads;
