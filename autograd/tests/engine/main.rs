//! What a user of the engine would notice: life and death of graphs, gradients as rows, messages, and bits that do not depend on threads.

mod graphs;
mod kernels;
mod messages;
mod row_gradients;
mod threads;
