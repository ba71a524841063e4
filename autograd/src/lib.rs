#![doc = include_str!("../README.md")]
//!
//! # The tour, in the order to read the files
//!
//! 1. **Value.** [`Tensor`] (`tensor.rs`): a shared buffer, a shape and, if it depends on a variable, a node. [`Real`] (`real.rs`) are the two
//!    scalar types; [`Buffer`] (`pool.rs`) recycles large arrays; [`parallel`] is the only module that knows of threads.
//! 2. **Graph.** `graph.rs`: a node points at the nodes of its inputs and keeps what its rule reads ([`Keep`]). Nothing else holds a graph
//!    together, so it lives as long as its last tensor. Ids grow with creation.
//! 3. **Rule.** `op.rs`: an [`Op`] says in tensor ops how a cotangent goes back; a [`Kernel`] says it in a loop over arrays and names its
//!    reference. All ops are in [`ops`], each beside its rule.
//! 4. **Backward.** `backward.rs`: the largest id first, which is every node after all its users. [`Tensor::backward`] and
//!    [`value_and_grad`] give numbers for an optimizer, [`grad`] gives tensors to go on computing with. [`Gradients`] (`gradients.rs`)
//!    holds one [`Grad`] for each leaf, dense or rows; [`rows`] is how contributions to rows are sorted and added up.
//! 5. **Gradcheck.** [`gradcheck`](gradcheck()) (`gradcheck.rs`) holds a rule to finite differences, [`check_kernel`] a kernel to its
//!    reference; `tests/gradcheck` has a row for each op.
//!
//! Then [`Lattice`] (`lattice.rs`), where the nodes of a grid lie in a table; [`Param`] and [`Module`] (`param.rs`, `param/module.rs`), the
//! leaves that training changes, and [`optim`], which changes them. For fields of one's own: [`nn`], layers and their initial values, drawn
//! from a [`random::Stream`]; [`save_safetensors`], [`load_safetensors`], [`Tensor::save_npy`] and [`Tensor::load_npy`] (`files.rs`).
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod backward;
mod error;
pub mod files;
mod gradcheck;
mod gradients;
mod graph;
mod index;
pub mod lattice;
pub mod nn;
mod op;
pub mod ops;
pub mod optim;
pub mod parallel;
mod param;
mod pool;
pub mod random;
mod real;
pub mod rows;
pub mod single;
mod tensor;

pub use backward::{grad, value_and_grad};
pub use error::{FileError, GradcheckError};
pub use files::{load_safetensors, save_safetensors};
pub use gradcheck::{Closeness, Gradcheck, KernelReport, Report, check_kernel, gradcheck};
pub use gradients::{Grad, Gradients};
pub use graph::{no_grad, recording as is_recording};
pub use index::Indices;
pub use lattice::Lattice;
#[doc(hidden)]
pub use multiversion; // `dispatched!` uses it in other crates.
pub use op::{Cotangent, GradSink, Keep, Kernel, KernelCall, Op, Vjp};
pub use ops::lookup::add_rows;
pub use param::{Bounds, Module, Param};
pub use pool::{Buffer, Pooled, release_free_buffers};
pub use real::Real;
pub use rows::deferred::RowSums;
pub use rows::sparse::RowSparse;
pub use tensor::Tensor;
