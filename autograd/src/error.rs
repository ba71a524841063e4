//! Errors of gradient checks and of tensor files. Misuse of shapes is not an error value: it panics at the caller's line with the op and the shapes.

use crate::gradcheck::Closeness;
use std::fmt;
use std::io;
use std::path::PathBuf;

/// The error of a gradient check.
#[derive(Debug, Clone, PartialEq)]
pub enum GradcheckError {
    /// A rule and finite differences disagree.
    Derivative {
        /// Name of the check.
        name: String,
        /// Index of the input, from 0.
        input: usize,
        /// Index of the entry in the input. `None` in a directional check, which does not determine the entry.
        index: Option<Vec<usize>>,
        /// Order of the derivative: 1 for the gradient, 2 for the gradient of the gradient, and so on.
        order: usize,
        /// Pass that computed the wrong value: `backward` (on constants; kernels use their adjoints) or `grad` (differentiable; kernels use
        /// their references).
        pass: &'static str,
        /// Value from the rule.
        analytic: f64,
        /// Value from finite differences.
        numeric: f64,
        /// Difference of the two values relative to the magnitude of the gradient.
        relative_error: f64,
        /// Largest relative error that was allowed.
        tolerance: f64,
    },
    /// A finite difference would step across a point where the function is not differentiable, so it could not be compared.
    Kink {
        /// Name of the check.
        name: String,
        /// Index of the input that was varied.
        input: usize,
        /// Value of the kink function, which must keep its sign, at the input and after the step.
        distances: (f64, f64),
    },
    /// A kernel and its reference disagree.
    Kernel {
        /// Name of the kernel.
        name: String,
        /// Compared quantity: `value`, `gradient of input i`, or `gradient of input i with the other inputs constant`.
        what: String,
        /// Distance between the two results.
        closeness: Closeness,
        /// Largest relative L2 distance that was allowed. [`Closeness::within`] derives the limits of the other measures from it.
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
                "{name}: finite differences in input {input} step across a kink (the kink function changes from {before:.3e} to {after:.3e}); move the input away from it"
            ),
            GradcheckError::Kernel { name, what, closeness, tolerance } => {
                write!(f, "{name}: the kernel differs from its reference in its {what}: {closeness} (allowed: relative L2 {tolerance:.1e})")
            }
        }
    }
}

impl std::error::Error for GradcheckError {}

/// The error of reading or writing a tensor file.
#[derive(Debug)]
pub enum FileError {
    /// The operating system reported an error.
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Failed operation: `reading the file` or `writing the file`.
        doing: &'static str,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file has another format or is damaged.
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Content that was found.
        found: String,
        /// Content that was expected.
        expected: String,
    },
    /// A tensor in the file does not match the parameters of the module, or two parameters have the same name.
    Tensor {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// Property that was found in the file or the module.
        found: String,
        /// Property that was expected.
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
