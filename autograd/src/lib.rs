//! Reverse-mode automatic differentiation over `ndarray`, small enough to read in an evening.
#![deny(unsafe_code)]
#![warn(missing_docs)]

mod backward;
mod error;
mod gradcheck;
mod gradients;
mod graph;
mod index;
mod op;
pub mod ops;
pub mod optim;
pub mod parallel;
mod param;
mod pool;
mod real;
mod tensor;

pub use backward::{grad, value_and_grad};
pub use error::GradcheckError;
pub use gradcheck::{Closeness, Gradcheck, KernelReport, Report, check_kernel, gradcheck};
pub use gradients::{Grad, Gradients, RowSparse};
pub use graph::no_grad;
pub use index::Indices;
pub use op::{Cotangent, GradSink, Keep, Kernel, KernelCall, Op, Vjp};
pub use ops::lookup::add_rows;
pub use param::{Module, Param};
pub use pool::{Buffer, Pooled, release_free_buffers};
pub use real::Real;
pub use tensor::Tensor;
