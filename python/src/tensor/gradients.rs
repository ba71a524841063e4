//! Gradients, their checks, and values that another program has differentiated.

use super::{PyTensor, Values};
use crate::arrays::numbers;
use crate::errors::{array, compute, dtype, gradcheck as failed, state};
use autograd::{GradSink, Gradcheck, Kernel, KernelCall, Real, Tensor, no_grad};
use ndarray::ArrayD;
use pyo3::prelude::*;
use std::cell::Cell;
use std::sync::{Mutex, PoisonError};

/// Returns the gradients of the scalar `y` with respect to a tensor, or to each of a list of tensors. The gradient is zero where `y` does not depend on a tensor.
///
/// With `create_graph`, they can be differentiated again.
#[pyfunction]
#[pyo3(signature = (y, wrt, *, create_graph = false))]
pub fn grad<'py>(py: Python<'py>, y: &PyTensor, wrt: &Bound<'py, PyAny>, create_graph: bool) -> PyResult<Bound<'py, PyAny>> {
    if let Ok(one) = wrt.extract::<PyTensor>() {
        let mut all = gradients(py, y, &[one], create_graph)?;
        return Ok(Bound::new(py, all.remove(0))?.into_any());
    }
    let wrt: Vec<PyTensor> = wrt.extract().map_err(|_| dtype("grad", "wrt is not a Tensor", "expected a Tensor or a list of them"))?;
    Ok(pyo3::types::PyList::new(py, gradients(py, y, &wrt, create_graph)?)?.into_any())
}

fn gradients(py: Python<'_>, y: &PyTensor, wrt: &[PyTensor], create_graph: bool) -> PyResult<Vec<PyTensor>> {
    if y.0.len() != 1 {
        return Err(array("grad", format!("y has the shape {:?}", y.0.shape()), "expected a scalar; take its sum or mean"));
    }
    if let Some(number) = wrt.iter().position(|x| !super::read!(&x.0, x => x.is_tracked())) {
        return Err(state(
            "grad",
            &format!("tensor {number} of wrt is a constant"),
            "make it a variable with Tensor(value, requires_grad=True)",
        ));
    }
    if wrt.iter().any(|x| x.0.dtype() != y.0.dtype()) {
        return Err(dtype("grad", "y and wrt are of float32 and float64", "use one precision"));
    }
    let found = compute(py, || {
        let (single, double) =
            (|| of_all(&y.0, wrt, Values::as_single, Values::Single), || of_all(&y.0, wrt, Values::as_double, Values::Double));
        let all = || if let Values::Single(_) = y.0 { single() } else { double() };
        once_only(|| if create_graph { all() } else { no_grad(all) })
    })?;
    found.ok_or_else(|| state("grad", ONCE, REMEDY))
}

const ONCE: &str = "a value that was differentiated elsewhere, such as that of torch_loss, has no second derivative";
const REMEDY: &str = "use create_graph=False, or write the function with Tensor";

impl Values {
    fn as_single(&self) -> Option<&Tensor<f32>> {
        if let Values::Single(x) = self { Some(x) } else { None }
    }

    fn as_double(&self) -> Option<&Tensor<f64>> {
        if let Values::Double(x) = self { Some(x) } else { None }
    }
}

fn of_all<T: Real>(y: &Values, wrt: &[PyTensor], read: fn(&Values) -> Option<&Tensor<T>>, write: fn(Tensor<T>) -> Values) -> Vec<PyTensor> {
    let Some(y) = read(y) else { return Vec::new() };
    let wrt: Vec<&Tensor<T>> = wrt.iter().filter_map(|x| read(&x.0)).collect();
    autograd::grad(y, &wrt).into_iter().map(|gradient| PyTensor(write(gradient))).collect()
}

thread_local! {
    /// True if a second derivative was asked of a value that has none.
    static REFUSED: Cell<bool> = const { Cell::new(false) };
}

/// Runs a computation; `None` if it needed a second derivative of a value of [`external`].
fn once_only<R>(f: impl FnOnce() -> R) -> Option<R> {
    REFUSED.set(false);
    let result = f();
    if REFUSED.take() { None } else { Some(result) }
}

/// A scalar with its gradients, computed elsewhere.
#[derive(Debug)]
struct External<T: Real> {
    gradients: Vec<Tensor<T>>,
}

impl<T: Real> Kernel<T> for External<T> {
    fn name(&self) -> &'static str {
        "external"
    }

    /// There is no reference. The caller learns of it from [`once_only`].
    fn reference(&self, _: &[Tensor<T>]) -> Tensor<T> {
        REFUSED.set(true);
        Tensor::scalar(T::nan())
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let cotangent = call.cotangent().item();
        for (i, gradient) in self.gradients.iter().enumerate().filter(|(i, _)| call.needs(*i)) {
            out.dense(i, (gradient * &Tensor::scalar(cotangent)).data().to_vec().into());
        }
    }
}

/// Returns the scalar `value` as a function of `columns`, of which another program has computed the `gradients`. It can be differentiated once.
#[pyfunction]
pub fn external(value: f64, columns: Vec<PyTensor>, gradients: Vec<Bound<'_, PyAny>>) -> PyResult<PyTensor> {
    let double = columns.first().is_some_and(|column| matches!(column.0, Values::Double(_)));
    Ok(PyTensor(if double {
        Values::Double(external_of(value, &columns, &gradients, Values::as_double)?)
    } else {
        Values::Single(external_of(value as f32, &columns, &gradients, Values::as_single)?)
    }))
}

fn external_of<T: Real + numpy::Element>(
    value: T,
    columns: &[PyTensor],
    gradients: &[Bound<'_, PyAny>],
    read: fn(&Values) -> Option<&Tensor<T>>,
) -> PyResult<Tensor<T>> {
    if columns.len() != gradients.len() {
        return Err(array("gradients", format!("there are {} for {} columns", gradients.len(), columns.len()), "give one for each column"));
    }
    let mut inputs = Vec::with_capacity(columns.len());
    let mut found = Vec::with_capacity(columns.len());
    for (column, gradient) in columns.iter().zip(gradients) {
        let column = read(&column.0).ok_or_else(|| dtype("columns", "they are of float32 and float64", "use one precision"))?;
        let gradient = numbers::<T>(gradient, "gradients")?;
        if gradient.shape() != column.shape() {
            let found = format!("a gradient of the shape {:?} for a column of {:?}", gradient.shape(), column.shape());
            return Err(array("gradients", found, "expected the shape of the column"));
        }
        inputs.push(column);
        found.push(Tensor::constant(gradient));
    }
    Ok(Tensor::from_kernel(vec![value].into(), &[], &inputs, External { gradients: found }))
}

/// Compares the derivatives of `f`, a function of tensors of float64, with central differences at `inputs`. Returns the largest relative error.
#[pyfunction]
#[pyo3(signature = (f, inputs, *, order = 2, tolerance = 1e-7, directions = 3, elementwise = false))]
pub fn gradcheck(
    py: Python<'_>,
    f: Py<PyAny>,
    inputs: Vec<Bound<'_, PyAny>>,
    order: usize,
    tolerance: f64,
    directions: usize,
    elementwise: bool,
) -> PyResult<f64> {
    let arrays = inputs.iter().map(|input| numbers::<f64>(input, "inputs")).collect::<PyResult<Vec<ArrayD<f64>>>>()?;
    let call = |inputs: &[Tensor<f64>]| {
        Python::attach(|py| {
            let inputs = inputs.iter().map(|x| Bound::new(py, PyTensor(Values::Double(x.clone())))).collect::<PyResult<Vec<_>>>()?;
            let result = f.bind(py).call1(pyo3::types::PyTuple::new(py, inputs)?)?;
            match result.cast::<PyTensor>().map(|tensor| tensor.get().0.clone()) {
                Ok(Values::Double(tensor)) => Ok(tensor),
                Ok(Values::Single(_)) => Err(dtype("gradcheck", "the function returned float32", "compute in the precision of the inputs")),
                Err(_) => {
                    let found = format!("the function returned a {}", result.get_type().name()?);
                    Err(dtype("gradcheck", found, "return a Tensor"))
                }
            }
        })
    };
    let constants: Vec<Tensor<f64>> = arrays.iter().map(|x| Tensor::constant(x.clone())).collect();
    let shape = call(&constants)?.shape().to_vec();
    let error = Mutex::new(None);
    // The check cannot fail in the middle: it goes on with NaN, and the first exception is raised at its end.
    let checked = |inputs: &[Tensor<f64>]| {
        let result = call(inputs).and_then(|tensor| match tensor.shape() == shape {
            true => Ok(tensor),
            false => Err(array("gradcheck", format!("the shapes {shape:?} and {:?}", tensor.shape()), "return the same shape each time")),
        });
        result.unwrap_or_else(|e| {
            error.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(e);
            Tensor::full(&shape, f64::NAN)
        })
    };
    let report = compute(py, || {
        let mut check = Gradcheck::new(checked, arrays).named("gradcheck").order(order).tolerance(tolerance).directions(directions);
        if elementwise {
            check = check.elementwise();
        }
        once_only(|| check.run())
    })?;
    if let Some(error) = error.into_inner().unwrap_or_else(PoisonError::into_inner) {
        return Err(error);
    }
    let report = report.ok_or_else(|| state("gradcheck", ONCE, "use order=1, or write the function with Tensor"))?;
    report.map(|report| report.worst_relative_error).map_err(failed)
}
