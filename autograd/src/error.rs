//! What a check has to say when it fails. Misuse of shapes is no error value: it panics at the caller's line, naming op and shapes.

use crate::gradcheck::Closeness;
use std::fmt;

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
        /// `value` or `gradient of input i`.
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
