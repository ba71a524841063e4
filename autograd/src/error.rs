//! What a check and a file have to say when they fail. Misuse of shapes is no error value: it panics at the caller's line, naming op and shapes.

use crate::gradcheck::Closeness;
use std::fmt;
use std::io;
use std::path::PathBuf;

/// A gradient that is not the derivative of its function.
#[derive(Debug, Clone, PartialEq)]
pub enum GradcheckError {
    /// A rule and finite differences disagree.
    Derivative {
        /// The name the check was given.
        name: String,
        /// Which input, from 0.
        input: usize,
        /// Which entry of it, in an elementwise check; a directional one does not know.
        index: Option<Vec<usize>>,
        /// 1 for the gradient, 2 for the gradient of the gradient, …
        order: usize,
        /// The pass that gave the wrong number: `backward` (on constants, kernels by their adjoints) or `grad` (differentiable, kernels by
        /// their references).
        pass: &'static str,
        /// What the rule gives.
        analytic: f64,
        /// What finite differences give.
        numeric: f64,
        /// Their difference as a share of the gradient's size.
        relative_error: f64,
        /// The share that was allowed.
        tolerance: f64,
    },
    /// Finite differences would step across a place where the function has no derivative, so they say nothing.
    Kink {
        /// The name the check was given.
        name: String,
        /// The input that was varied.
        input: usize,
        /// The number that must keep its sign, at the input and after a step.
        distances: (f64, f64),
    },
    /// A kernel and its reference disagree.
    Kernel {
        /// The kernel's name.
        name: String,
        /// `value`, `gradient of input i`, or the latter with `, when the others are constants`.
        what: String,
        /// How far they are apart.
        closeness: Closeness,
        /// The relative L2 distance that was allowed; the other measures have bounds made of it.
        tolerance: f64,
    },
}

impl fmt::Display for GradcheckError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            GradcheckError::Derivative { name, input, index, order, pass, analytic, numeric, relative_error, tolerance } => {
                write!(f, "{name}: wrong derivative of order {order} with respect to input {input}")?;
                match index {
                    Some(index) => write!(f, " at {index:?}")?,
                    None => write!(f, " along a random direction")?,
                }
                write!(
                    f,
                    ": {pass} gives {analytic:.9e}, finite differences give {numeric:.9e} (relative error {relative_error:.1e}, allowed {tolerance:.1e})"
                )?;
                if index.is_none() { write!(f, "; `.elementwise()` names the entry") } else { Ok(()) }
            }
            GradcheckError::Kink { name, input, distances: (before, after) } => write!(
                f,
                "{name}: finite differences in input {input} step across a kink (its distance goes from {before:.3e} to {after:.3e}); move the input away from it"
            ),
            GradcheckError::Kernel { name, what, closeness, tolerance } => {
                write!(f, "{name}: the kernel differs from its reference in its {what}: {closeness} (allowed: relative L2 {tolerance:.1e})")
            }
        }
    }
}

impl std::error::Error for GradcheckError {}

/// A file of tensors that cannot be written, read or used.
#[derive(Debug)]
pub enum FileError {
    /// The system refuses to read or write it.
    Io {
        /// The file.
        path: PathBuf,
        /// `reading the file` or `writing the file`.
        doing: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// It is of another format, or damaged.
    Format {
        /// The file.
        path: PathBuf,
        /// What it is.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A tensor of it, or a parameter, is not the one that is wanted.
    Tensor {
        /// The file.
        path: PathBuf,
        /// The name of the tensor.
        tensor: String,
        /// What the file or the module has.
        found: String,
        /// What it should have.
        expected: String,
    },
}

impl fmt::Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FileError::Io { path, doing, source } => write!(f, "{}: {doing} failed: {source}", path.display()),
            FileError::Format { path, found, expected } => write!(f, "{}: found {found}; expected {expected}", path.display()),
            FileError::Tensor { path, tensor, found, expected } => {
                write!(f, "{}: tensor `{tensor}`: found {found}; expected {expected}", path.display())
            }
        }
    }
}

impl std::error::Error for FileError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            FileError::Io { source, .. } => Some(source),
            FileError::Format { .. } | FileError::Tensor { .. } => None,
        }
    }
}
