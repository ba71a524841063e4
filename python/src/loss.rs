//! Losses and parameters of Python in the objective of a run.

use crate::arrays::{numbers, view};
use crate::errors::{array, dtype, invalid};
use crate::step::PyStep;
use crate::tensor::{PyTensor, Values};
use autograd::{Param as TrainedParam, Tensor};
use numpy::PyArrayDyn;
use plenoxel::loss::{Objective, Step};
use pyo3::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};

/// A loss: name, weight, function of a step.
pub type Loss = (String, f64, Py<PyAny>);

/// A parameter of losses or of a field, which is trained by Adam (β₁ = 0.9, β₂ = 0.99).
///
/// A loss reads it with `step.param(name)`, a field as `params[name]`.
///
/// Args:
///     name: Name, unique in a run.
///     value: Initial value, an array or a number.
///     rate: Learning rate.
#[pyclass(module = "plenoxel", frozen)]
pub struct Param {
    /// Name.
    #[pyo3(get)]
    pub name: String,
    /// Learning rate.
    #[pyo3(get)]
    pub rate: f64,
    value: Mutex<Tensor<f32>>,
}

impl Param {
    pub fn tensor(&self) -> Tensor<f32> {
        self.value.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Shows a value, as a constant.
    pub fn set(&self, value: &Tensor<f32>) {
        *self.value.lock().unwrap_or_else(PoisonError::into_inner) = value.detach();
    }
}

/// Errors: two parameters have the same name.
pub fn check_names(params: &[Py<Param>]) -> PyResult<()> {
    let names: Vec<&str> = params.iter().map(|param| param.get().name.as_str()).collect();
    match names.iter().enumerate().find_map(|(i, name)| names[..i].contains(name).then_some(name)) {
        Some(name) => Err(invalid("params", format!("two parameters `{name}`"), "different names")),
        None => Ok(()),
    }
}

#[pymethods]
impl Param {
    #[new]
    #[pyo3(signature = (name, value, *, rate = 1e-2))]
    fn new(name: String, value: &Bound<'_, PyAny>, rate: f64) -> PyResult<Self> {
        if name.is_empty() {
            return Err(invalid("name", "\"\"", "a name"));
        }
        if !(rate.is_finite() && rate >= 0.0) {
            return Err(invalid("rate", rate, "a finite number, 0 or more"));
        }
        let value = numbers::<f32>(value, &name)?;
        match value.iter().all(|value| value.is_finite()) {
            true => Ok(Param { name, rate, value: Mutex::new(Tensor::constant(value)) }),
            false => Err(array(&name, "a value is not finite", "expected finite numbers")),
        }
    }

    /// The value, as the last step that was taken read it; for a field, after its training.
    #[getter]
    fn value<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let tensor = self.tensor();
        Ok(view(&tensor, Bound::new(py, PyTensor(Values::Single(tensor.clone())))?.into_any()))
    }

    fn __repr__(&self) -> String {
        format!("Param({}, shape {:?}, rate {})", self.name, self.tensor().shape(), self.rate)
    }
}

/// The first exception of a loss or of a field.
#[derive(Clone, Default)]
pub struct Failure(Arc<Mutex<Option<PyErr>>>);

impl Failure {
    pub fn take(&self) -> Option<PyErr> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    pub fn is_set(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    pub fn set(&self, error: PyErr) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }
}

/// The losses and parameters of a run.
pub struct Losses {
    terms: Vec<(String, f64, Arc<Py<PyAny>>)>,
    params: Arc<Vec<Py<Param>>>,
    failure: Failure,
}

impl Losses {
    /// Errors: two losses or two parameters have the same name; a weight is not finite.
    pub fn new(py: Python<'_>, terms: Vec<Loss>, params: Vec<Py<Param>>, failure: Failure) -> PyResult<Self> {
        check_names(&params)?;
        if let Some((name, weight, _)) = terms.iter().find(|(_, weight, _)| !weight.is_finite()) {
            return Err(invalid(&format!("loss {name}"), weight, "a finite weight"));
        }
        if let Some((name, ..)) = terms.iter().find(|(_, _, function)| !function.bind(py).is_callable()) {
            return Err(dtype(&format!("loss {name}"), "this is not a function", "expected a function of the step"));
        }
        let terms = terms.into_iter().map(|(name, weight, function)| (name, weight, Arc::new(function))).collect();
        Ok(Losses { terms, params: Arc::new(params), failure })
    }

    /// The losses as an objective for any model.
    pub fn objective(&self) -> Objective<f32, ()> {
        let mut objective = Objective::new();
        for param in self.params.iter() {
            let Param { name, rate, .. } = param.get();
            objective = objective.with_param(TrainedParam::from_tensor(name.clone(), param.get().tensor()), *rate);
        }
        for (name, weight, function) in &self.terms {
            let (function, params, failure) = (function.clone(), self.params.clone(), self.failure.clone());
            let place = format!("loss {name}");
            objective = objective.with(name.clone(), *weight, move |step: &Step<'_, f32, ()>| {
                Python::attach(|py| evaluate(py, &place, &function, &params, step)).unwrap_or_else(|error| {
                    failure.set(error);
                    // The run ends with an error of its own, and without a step.
                    Tensor::scalar(f32::NAN)
                })
            });
        }
        objective
    }
}

/// Calls a loss with a step.
///
/// Errors: the function raises an exception, or does not return a scalar tensor of `float32`.
fn evaluate(py: Python<'_>, place: &str, function: &Py<PyAny>, params: &[Py<Param>], step: &Step<'_, f32, ()>) -> PyResult<Tensor<f32>> {
    let mut read = Vec::with_capacity(params.len());
    for param in params {
        let param = param.get();
        let tensor = step.param(&param.name);
        param.set(tensor);
        read.push((param.name.clone(), tensor.clone()));
    }
    let seen = Bound::new(py, PyStep::new(step, read))?;
    let result = function.bind(py).call1((&seen,));
    // The step may be referred to for longer, but not its graph: the tables of the model could not be updated in place.
    seen.get().close();
    let result = result?;
    let expected = "return a Tensor of the columns of the step, such as ((step.rgb - step.target) ** 2).mean()";
    let Ok(tensor) = result.cast::<PyTensor>() else {
        return Err(dtype(place, format!("the function returned a {}", result.get_type().name()?), expected));
    };
    match &tensor.get().0 {
        Values::Single(tensor) if tensor.len() == 1 => Ok(tensor.clone()),
        Values::Single(tensor) => {
            Err(array(place, format!("the loss has the shape {:?}", tensor.shape()), "expected one number; take its mean or sum"))
        }
        Values::Double(_) => Err(dtype(place, "the loss is float64", "expected float32, as the columns of the step are")),
    }
}
