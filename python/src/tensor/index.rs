//! Indexing: integers, slices, `None`, `...`, and rows by number.

use super::{PyTensor, Values, each};
use crate::arrays::rows;
use crate::errors::{array, dtype};
use autograd::Indices;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyEllipsis, PySlice, PyTuple};

/// A part of an index, for an axis of the result so far.
enum Part {
    At { axis: usize, entry: usize },
    Range { axis: usize, start: usize, len: usize },
    New { axis: usize },
}

/// The integer of an index: one of Python or of NumPy.
fn integer(part: &Bound<'_, PyAny>) -> Option<isize> {
    if part.is_instance_of::<PyBool>() { None } else { part.call_method0("__index__").ok()?.extract().ok() }
}

/// Reads an index as parts.
fn parts(index: &[Bound<'_, PyAny>], shape: &[usize]) -> PyResult<Vec<Part>> {
    let is_new = |part: &Bound<'_, PyAny>| part.is_none();
    let is_ellipsis = |part: &Bound<'_, PyAny>| part.is_instance_of::<PyEllipsis>();
    let taken = index.iter().filter(|part| !is_new(part) && !is_ellipsis(part)).count();
    if taken > shape.len() || index.iter().filter(|part| is_ellipsis(part)).count() > 1 {
        let found = format!("{taken} indices for a tensor of shape {shape:?}");
        return Err(array("index", found, "expected at most one for each axis, and one ellipsis"));
    }
    // `from` counts the axes of the tensor, `axis` those of the result.
    let (mut from, mut axis) = (0, 0);
    let mut parts = Vec::new();
    for part in index {
        if is_new(part) {
            parts.push(Part::New { axis });
            axis += 1;
        } else if is_ellipsis(part) {
            (from, axis) = (from + shape.len() - taken, axis + shape.len() - taken);
        } else if let Ok(slice) = part.cast::<PySlice>() {
            let range = slice.indices(shape[from] as isize)?;
            if range.step != 1 {
                return Err(array("index", format!("the slice has the step {}", range.step), "only slices of step 1 are supported"));
            }
            parts.push(Part::Range { axis, start: range.start.unsigned_abs(), len: range.slicelength });
            (from, axis) = (from + 1, axis + 1);
        } else if let Some(entry) = integer(part) {
            let n = shape[from];
            let place = if entry < 0 { entry.checked_add_unsigned(n) } else { Some(entry) };
            let place = place.and_then(|place| usize::try_from(place).ok()).filter(|place| *place < n);
            let place = place.ok_or_else(|| array("index", format!("{entry} is out of range"), format!("axis {from} has {n} entries")))?;
            parts.push(Part::At { axis, entry: place });
            from += 1;
        } else {
            let found = format!("a {} among several indices", part.get_type().name()?);
            return Err(dtype("index", found, "expected integers, slices, None or ...; an array of row numbers must be alone"));
        }
    }
    Ok(parts)
}

#[pymethods]
impl PyTensor {
    fn __getitem__(&self, py: Python<'_>, index: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        let index: Vec<Bound<'_, PyAny>> = match index.cast::<PyTuple>() {
            Ok(tuple) => tuple.iter().collect(),
            Err(_) => vec![index.clone()],
        };
        let shape = self.0.shape();
        if let [alone] = &index[..]
            && !(alone.is_none() || integer(alone).is_some() || alone.is_instance_of::<PySlice>() || alone.is_instance_of::<PyEllipsis>())
        {
            let table = shape.first().ok_or_else(|| array("index", "the tensor has no axes", "expected one axis or more"))?;
            let rows = Indices::from(rows(alone, "index", *table)?);
            return self.map(py, |values| each!(values, x => x.gather_rows(&rows)));
        }
        let parts = parts(&index, shape)?;
        self.map(py, |values| parts.iter().fold(values.clone(), apply))
    }
}

fn apply(values: Values, part: &Part) -> Values {
    match *part {
        Part::At { axis, entry } => each!(values, x => x.index_axis(axis, entry)),
        Part::Range { axis, start, len } => each!(values, x => x.narrow(axis, start, len)),
        Part::New { axis } => each!(values, x => x.unsqueeze(axis)),
    }
}
