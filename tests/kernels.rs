//! Gradients, and fused kernels against their references. One binary compiles the generic code that its modules share once.

#[path = "support/factored.rs"]
mod factored;
#[path = "support/own_losses.rs"]
mod own_losses;
#[path = "support/mod.rs"]
mod support;

#[path = "fused_matches_graph.rs"]
mod fused_matches_graph;
#[path = "gradients.rs"]
mod gradients;
#[path = "poses.rs"]
mod poses;
#[path = "sparse_gradients.rs"]
mod sparse_gradients;
#[path = "tensorf.rs"]
mod tensorf;
