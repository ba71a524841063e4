//! Conversion of NumPy arrays to tensors and tables, and back.
//!
//! Arrays that come in may have any strides; they are copied. Tensors and tables that go out are read-only views of their own memory.

use crate::errors::{array, dtype};
use autograd::{Real, Tensor};
use ndarray::{Array1, ArrayD, Dimension};
use numpy::{Element, PyArray, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyString;

/// Returns a read-only array of the values of a tensor, without a copy. `owner` keeps the buffer of the tensor alive.
pub fn view<'py, T: Real + Element>(tensor: &Tensor<T>, owner: Bound<'py, PyAny>) -> Bound<'py, PyArrayDyn<T>> {
    // The buffer of a tensor is shared, and is never modified or moved while it is. `owner` is an immutable object of Python that holds a clone of the tensor, and
    // the array holds `owner`. The array is made read-only before anyone else sees it.
    #[expect(unsafe_code, reason = "NumPy cannot know the lifetime of the memory of an array")]
    let view = unsafe { PyArray::borrow_from_array(&tensor.value(), owner) };
    view.readwrite().make_nonwriteable();
    view
}

/// Returns an object as an array of NumPy.
///
/// Errors: it cannot be one, such as a list of rows of several lengths.
fn as_array<'py>(object: &Bound<'py, PyAny>, name: &str) -> PyResult<Bound<'py, PyUntypedArray>> {
    if let Ok(given) = object.cast::<PyUntypedArray>() {
        return Ok(given.clone());
    }
    if object.is_none() || object.is_instance_of::<PyString>() {
        return Err(dtype(name, format!("this is a {}", object.get_type().name()?), "expected an array of numbers"));
    }
    let made = object.py().import("numpy")?.call_method1("asarray", (object,));
    let made = made.and_then(|made| Ok(made.cast_into::<PyUntypedArray>()?));
    made.map_err(|error| array(name, format!("this is not an array ({error})"), "expected an array of numbers"))
}

/// Returns numbers of any real type as an array of `f64` or `f32`.
///
/// Errors: the object is not an array of real numbers.
pub fn numbers<T: Element + Copy>(object: &Bound<'_, PyAny>, name: &str) -> PyResult<ArrayD<T>> {
    let given = as_array(object, name)?;
    let kind = given.dtype().kind();
    if !matches!(kind, b'f' | b'i' | b'u' | b'b') {
        return Err(dtype(name, format!("the array has the dtype {}", given.dtype()), "expected real numbers"));
    }
    let py = object.py();
    let numbers = given.call_method1("astype", (T::get_dtype(py),))?;
    Ok(numbers.extract::<PyReadonlyArrayDyn<'_, T>>().map_err(PyErr::from)?.as_array().to_owned())
}

/// Returns finite numbers as an array of `f64`.
///
/// Errors: those of [`numbers`]; a number is NaN or infinite.
pub fn finite(object: &Bound<'_, PyAny>, name: &str) -> PyResult<ArrayD<f64>> {
    let numbers = numbers::<f64>(object, name)?;
    match numbers.indexed_iter().find(|(_, value)| !value.is_finite()) {
        None => Ok(numbers),
        Some((place, value)) => Err(array(name, format!("the number at {:?} is {value}", place.slice()), "expected finite numbers")),
    }
}

/// Returns three finite numbers.
pub fn triple(object: &Bound<'_, PyAny>, name: &str) -> PyResult<[f64; 3]> {
    let numbers = finite(object, name)?;
    let found = numbers.shape().to_vec();
    <[f64; 3]>::try_from(numbers.into_raw_vec_and_offset().0)
        .ok()
        .filter(|_| found == [3])
        .ok_or_else(|| array(name, format!("the array has the shape {found:?}"), "expected three numbers"))
}

/// Values of 8 bits per channel, `[h, w, channels]`.
///
/// Errors: the array has another number of dimensions or of channels, another type than `uint8`, `float32` and `float64`, or a float outside of [0, 1].
pub fn image(object: &Bound<'_, PyAny>, name: &str) -> PyResult<image::RgbaImage> {
    let given = as_array(object, name)?;
    let shape = given.shape().to_vec();
    let expected = "expected [height, width, 3] or [height, width, 4]";
    let &[height, width, channels @ 3..=4] = &shape[..] else {
        let hint = if matches!(shape[..], [1 | 3 | 4, _, _]) { "; the channels must be the last axis" } else { "" };
        return Err(array(name, format!("the image has the shape {shape:?}"), format!("{expected}{hint}")));
    };
    let bytes: Vec<u8> = if let Ok(bytes) = object.extract::<PyReadonlyArrayDyn<'_, u8>>() {
        bytes.as_array().iter().copied().collect()
    } else if given.dtype().kind() == b'f' {
        let floats = numbers::<f64>(object, name)?;
        if let Some((place, value)) = floats.indexed_iter().find(|(_, value)| !(0.0..=1.0).contains(*value)) {
            let found = format!("the value at {:?} is {value}", place.slice());
            return Err(array(name, found, "expected floats in [0, 1], or uint8 from 0 to 255"));
        }
        floats.iter().map(|value| (value * 255.0).round() as u8).collect()
    } else {
        let found = format!("the image has the dtype {}", given.dtype());
        return Err(dtype(name, found, "expected uint8, or floats in [0, 1]"));
    };
    let pixels = match channels {
        4 => bytes,
        _ => bytes.as_chunks::<3>().0.iter().flat_map(|&[r, g, b]| [r, g, b, 255]).collect(),
    };
    let sides = u32::try_from(width).ok().zip(u32::try_from(height).ok());
    let image = sides.and_then(|(width, height)| image::RgbaImage::from_raw(width, height, pixels));
    image.ok_or_else(|| array(name, format!("the image has the shape {shape:?}"), expected))
}

/// The entries along the first axis of an array, or those of a list of arrays.
///
/// Errors: the object is neither, or has no entries.
pub fn entries<'py>(object: &Bound<'py, PyAny>, name: &str) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let entries: Option<Vec<_>> = match object.is_instance_of::<PyString>() {
        true => None,
        false => object.try_iter().and_then(Iterator::collect).ok(),
    };
    let entries =
        entries.ok_or_else(|| dtype(name, format!("this is a {}", object.get_type()), "expected an array or a list of arrays"))?;
    if entries.is_empty() { Err(array(name, "there is no entry", "give at least one")) } else { Ok(entries) }
}

/// Returns integers as row numbers below `rows`; negative ones count from the end.
///
/// Errors: the array is not one-dimensional or has no integers; a number is out of range.
pub fn rows(object: &Bound<'_, PyAny>, name: &str, rows: usize) -> PyResult<Vec<u32>> {
    let given = as_array(object, name)?;
    if !matches!(given.dtype().kind(), b'i' | b'u') {
        return Err(dtype(name, format!("the index has the dtype {}", given.dtype()), "expected integers"));
    }
    let numbers = numbers::<i64>(object, name)?;
    let found = format!("the index has the shape {:?}", numbers.shape());
    let numbers: Array1<i64> = numbers.into_dimensionality().map_err(|_| array(name, found, "expected one dimension"))?;
    let row = |number: &i64| {
        let from_start = if *number < 0 { number.checked_add(rows as i64) } else { Some(*number) };
        let row = from_start.and_then(|row| u32::try_from(row).ok()).filter(|row| (*row as usize) < rows);
        row.ok_or_else(|| array(name, format!("the index {number} is out of range"), format!("there are {rows} rows")))
    };
    numbers.iter().map(row).collect()
}
