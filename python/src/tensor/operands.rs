//! Operands of binary ops: tensors, numbers and arrays.

use super::{PyTensor, Values};
use crate::errors::{array, dtype, raised};
use plenoxel::error::Error;
use plenoxel::run::memory::available;
use pyo3::prelude::*;
use pyo3::types::{PyFloat, PyInt};

/// An operand.
pub enum Operand {
    /// A number, which has the precision of the other operand.
    Number(f64),
    Tensor(Values),
}

impl Operand {
    /// Reads an operand for an op with `other`.
    ///
    /// Errors: it is a tensor of another precision, or not an array of numbers.
    pub fn read(value: &Bound<'_, PyAny>, other: &Values, op: &str) -> PyResult<Self> {
        if let Ok(tensor) = value.cast::<PyTensor>() {
            let values = tensor.get().0.clone();
            if values.dtype() != other.dtype() {
                let found = format!("tensors of {} and {}", other.dtype(), values.dtype());
                return Err(dtype(op, found, "convert one of them with .to(\"float32\") or .to(\"float64\")"));
            }
            return Ok(Operand::Tensor(values));
        }
        if value.is_instance_of::<PyFloat>() || value.is_instance_of::<PyInt>() {
            return Ok(Operand::Number(value.extract()?));
        }
        Ok(Operand::Tensor(Values::constant(value, matches!(other, Values::Double(_)), op)?))
    }

    /// The operand as a tensor of the precision of `other`.
    pub fn tensor(self, other: &Values) -> Values {
        match self {
            Operand::Number(number) => other.scalar_like(number),
            Operand::Tensor(values) => values,
        }
    }
}

/// Returns the shape to which two shapes broadcast.
///
/// Errors: they do not; the result does not fit into the memory.
pub fn broadcast(op: &str, a: &[usize], b: &[usize]) -> PyResult<Vec<usize>> {
    let n = a.len().max(b.len());
    let side = |shape: &[usize], axis: usize| (axis + shape.len()).checked_sub(n).map_or(1, |axis| shape[axis]);
    let sides = (0..n).map(|axis| match (side(a, axis), side(b, axis)) {
        (x, y) if x == y => Some(x),
        (1, y) => Some(y),
        (x, 1) => Some(x),
        _ => None,
    });
    let shape: Option<Vec<usize>> = sides.collect();
    let shape =
        shape.ok_or_else(|| array(op, format!("the shapes {a:?} and {b:?} do not broadcast"), "expected equal sides, or sides of 1"))?;
    check_size(op, &shape)?;
    Ok(shape)
}

/// Errors if a tensor of this shape does not fit into the memory.
pub fn check_size(op: &str, shape: &[usize]) -> PyResult<()> {
    // Small tensors are not worth asking the system.
    const SMALL: usize = 1 << 24;
    let bytes = shape.iter().try_fold(8_usize, |bytes, side| bytes.checked_mul(*side)).unwrap_or(usize::MAX);
    if bytes > SMALL && available().is_some_and(|available| bytes as u64 > available) {
        return Err(raised(Error::usage(op, format!("a tensor of shape {shape:?} does not fit into the memory"), "use a smaller one")));
    }
    Ok(())
}
