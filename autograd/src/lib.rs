#![doc = include_str!("../README.md")]
//!
//! # Source files, in reading order
//!
//! 1. **Value.** A [`Tensor`] (`tensor.rs`) has a shared buffer, a shape and, if it depends on a variable, a graph node. [`Real`] (`real.rs`) is the
//!    trait of the two scalar types. [`Buffer`] (`pool.rs`) recycles large arrays. [`parallel`] is the only module that uses threads.
//! 2. **Graph.** A node (`graph.rs`) owns references to the nodes of its inputs and keeps the values that its rule reads ([`Keep`]). There is no
//!    other owner, so a graph lives as long as its last tensor. Node ids increase in the order of creation.
//! 3. **Rule.** An [`Op`] (`op.rs`) expresses its vector-Jacobian product in tensor ops. A [`Kernel`] computes it in a loop over arrays and has a
//!    reference in tensor ops. All ops are in [`ops`], each next to its rule.
//! 4. **Backward.** The backward pass (`backward.rs`) visits nodes by decreasing id, so a node is visited after all of its users.
//!    [`Tensor::backward`] and [`value_and_grad`] return numbers for an optimizer. [`grad`] returns tensors that can be differentiated again.
//!    [`Gradients`] (`gradients.rs`) holds one [`Grad`], dense or row-sparse, for each leaf. [`rows`] sorts and sums contributions to rows.
//! 5. **Gradcheck.** [`gradcheck`](gradcheck()) (`gradcheck.rs`) compares a rule with finite differences. [`check_kernel`] compares a kernel with its
//!    reference. `tests/gradcheck` has at least one row for each op.
//!
//! The remaining modules build on these. [`Lattice`] (`lattice.rs`) maps the nodes of a grid to rows of a table. [`Param`] (`param.rs`) is a
//! trainable leaf, [`Module`] (`param/module.rs`) is a set of parameters, and [`optim`] updates them. [`nn`] has layers and their initialization from
//! a [`random::Stream`]. [`files`] reads and writes tensors: [`save_safetensors`], [`load_safetensors`], [`Tensor::save_npy`], [`Tensor::load_npy`].
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
mod matrix;
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
pub use gradcheck::{Closeness, Gradcheck, GradcheckReport, KernelReport, check_kernel, gradcheck};
pub use gradients::{Grad, Gradients};
pub use graph::{no_grad, recording as is_recording};
pub use index::Indices;
pub use lattice::Lattice;
pub use matrix::{Matrix, Precision, add_product, multiply};
#[doc(hidden)]
pub use multiversion; // `dispatched!` expands to this path in other crates.
pub use op::{Cotangent, GradSink, Keep, Kernel, KernelCall, Op, Vjp};
pub use ops::lookup::add_rows;
pub use param::{Bounds, Module, Param};
pub use pool::{Buffer, Pooled, release_free_buffers};
pub use real::Real;
pub use rows::deferred::RowSums;
pub use rows::sparse::RowSparse;
pub use tensor::Tensor;
