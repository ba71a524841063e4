//! `Tensor`: the tensors of `autograd`, with operators, broadcasting and gradients of gradients.
//!
//! Shapes and axes are checked here, so that a mistake is an exception and not a panic.

mod gradients;
mod index;
mod operands;
mod ops;

pub use gradients::{external, grad, gradcheck};
pub use ops::{concat, maximum, minimum, stack, where_};

use crate::arrays::{numbers, view};
use crate::errors::{array, compute, dtype, invalid};
use autograd::{Real, Tensor};
use pyo3::prelude::*;

/// The numbers of a tensor, in one of two precisions.
#[derive(Clone)]
pub enum Values {
    Single(Tensor<f32>),
    Double(Tensor<f64>),
}

/// An immutable array that records how it was computed, if it depends on a variable.
///
/// Operators broadcast as in NumPy. `grad` differentiates, as often as wanted.
///
/// Args:
///     value: An array, a list or a number.
///     requires_grad: True for a variable, for which gradients are computed.
///     dtype: "float32" or "float64"; the default is that of `value`, and "float32" if it has none of both.
#[pyclass(name = "Tensor", module = "plenoxel", frozen, from_py_object)]
#[derive(Clone)]
pub struct PyTensor(pub Values);

/// Computes the same expression in both precisions.
macro_rules! each {
    ($values:expr, $x:ident => $result:expr) => {
        match $values {
            $crate::tensor::Values::Single($x) => $crate::tensor::Values::Single($result),
            $crate::tensor::Values::Double($x) => $crate::tensor::Values::Double($result),
        }
    };
}
/// Reads the same property in both precisions.
macro_rules! read {
    ($values:expr, $x:ident => $result:expr) => {
        match $values {
            $crate::tensor::Values::Single($x) => $result,
            $crate::tensor::Values::Double($x) => $result,
        }
    };
}
pub(crate) use {each, read};

impl Values {
    pub fn shape(&self) -> &[usize] {
        read!(self, x => x.shape())
    }

    pub fn dtype(&self) -> &'static str {
        match self {
            Values::Single(_) => "float32",
            Values::Double(_) => "float64",
        }
    }

    fn len(&self) -> usize {
        read!(self, x => x.len())
    }

    /// Returns a constant of the same precision.
    fn scalar_like(&self, value: f64) -> Values {
        match self {
            Values::Single(_) => Values::Single(Tensor::scalar(value as f32)),
            Values::Double(_) => Values::Double(Tensor::scalar(value)),
        }
    }

    /// Returns a constant from an array, in the precision of `dtype`.
    fn constant(value: &Bound<'_, PyAny>, double: bool, name: &str) -> PyResult<Values> {
        Ok(match double {
            true => Values::Double(Tensor::constant(numbers::<f64>(value, name)?)),
            false => Values::Single(Tensor::constant(numbers::<f32>(value, name)?)),
        })
    }
}

impl PyTensor {
    /// The tensor of `float32`.
    ///
    /// Errors: it is of `float64`.
    pub fn single(&self, place: &str) -> PyResult<Tensor<f32>> {
        match &self.0 {
            Values::Single(tensor) => Ok(tensor.clone()),
            Values::Double(_) => Err(dtype(place, "the tensor is float64", "expected float32")),
        }
    }

    /// The axis, counted from the end if negative.
    fn axis(&self, place: &str, axis: isize) -> PyResult<usize> {
        let n = self.0.shape().len();
        let found = if axis < 0 { axis.checked_add_unsigned(n) } else { Some(axis) };
        found.and_then(|axis| usize::try_from(axis).ok()).filter(|axis| *axis < n).ok_or_else(|| {
            array(place, format!("axis {axis} is out of range for the shape {:?}", self.0.shape()), format!("there are {n} axes"))
        })
    }

    /// Applies an op of one tensor.
    fn map(&self, py: Python<'_>, op: impl FnOnce(&Values) -> Values + Send) -> PyResult<PyTensor> {
        compute(py, || PyTensor(op(&self.0)))
    }
}

#[pymethods]
impl PyTensor {
    #[new]
    #[pyo3(signature = (value, *, requires_grad = false, dtype = None))]
    fn new(value: &Bound<'_, PyAny>, requires_grad: bool, dtype: Option<&str>) -> PyResult<Self> {
        let double = match dtype {
            Some("float64") => true,
            Some("float32") => false,
            Some(other) => return Err(invalid("dtype", format!("\"{other}\""), "\"float32\" or \"float64\"")),
            None => value.getattr("dtype").and_then(|dtype| Ok(dtype.str()? == "float64")).unwrap_or(false),
        };
        let values = match value.cast::<PyTensor>() {
            Ok(tensor) => tensor.get().converted(double),
            Err(_) => Values::constant(value, double, "Tensor")?,
        };
        Ok(PyTensor(if requires_grad { each!(values, x => x.into_variable()) } else { values }))
    }

    /// Shape.
    #[getter]
    fn shape<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, pyo3::types::PyTuple>> {
        pyo3::types::PyTuple::new(py, self.0.shape())
    }

    /// Number of axes.
    #[getter]
    fn ndim(&self) -> usize {
        self.0.shape().len()
    }

    /// Number of elements.
    #[getter]
    fn size(&self) -> usize {
        self.0.len()
    }

    /// Type of the numbers: "float32" or "float64".
    #[getter]
    fn dtype(&self) -> &'static str {
        self.0.dtype()
    }

    /// True if gradients flow to or through this tensor.
    #[getter]
    fn requires_grad(&self) -> bool {
        read!(&self.0, x => x.is_tracked())
    }

    /// Returns the values as a read-only array, without a copy.
    fn numpy<'py>(slf: &Bound<'py, Self>) -> Bound<'py, PyAny> {
        let owner = slf.clone().into_any();
        read!(&slf.get().0, x => view(x, owner).into_any())
    }

    /// For `numpy.asarray`.
    #[pyo3(signature = (dtype = None, copy = None))]
    fn __array__<'py>(slf: &Bound<'py, Self>, dtype: Option<&Bound<'py, PyAny>>, copy: Option<bool>) -> PyResult<Bound<'py, PyAny>> {
        let mut values = Self::numpy(slf);
        if let Some(dtype) = dtype {
            values = values.call_method1("astype", (dtype,))?;
        }
        if copy == Some(true) { values.call_method0("copy") } else { Ok(values) }
    }

    /// NumPy leaves operators between an array and a tensor to the tensor.
    #[classattr]
    #[pyo3(name = "__array_ufunc__")]
    fn array_ufunc() -> Option<u8> {
        None
    }

    /// Returns the value of a tensor with one element.
    fn item(&self) -> PyResult<f64> {
        match self.0.len() {
            1 => Ok(read!(&self.0, x => x.data()[0].as_f64())),
            _ => Err(array("item", format!("the tensor has the shape {:?}", self.0.shape()), "expected one element")),
        }
    }

    fn __float__(&self) -> PyResult<f64> {
        self.item()
    }

    fn __len__(&self) -> PyResult<usize> {
        self.0.shape().first().copied().ok_or_else(|| array("len", "the tensor has no axes", "expected one axis or more"))
    }

    fn __bool__(&self) -> PyResult<bool> {
        Ok(self.item()? != 0.0)
    }

    /// Returns the same values as a constant.
    fn detach(&self) -> Self {
        PyTensor(each!(&self.0, x => x.detach()))
    }

    /// Returns the same values in another precision, "float32" or "float64", as a constant if it changes.
    fn to(&self, dtype: &str) -> PyResult<Self> {
        match dtype {
            "float32" => Ok(PyTensor(self.converted(false))),
            "float64" => Ok(PyTensor(self.converted(true))),
            _ => Err(invalid("dtype", format!("\"{dtype}\""), "\"float32\" or \"float64\"")),
        }
    }

    fn __repr__(&self) -> String {
        let tracked = if self.requires_grad() { ", requires_grad" } else { "" };
        let values = read!(&self.0, x => match x.len() {
            0..=16 => format!("{:?}", x.value()).split(", shape=").next().unwrap_or_default().to_owned(),
            _ => "...".to_owned(),
        });
        format!("Tensor({values}, shape {:?}, {}{tracked})", self.0.shape(), self.dtype())
    }
}

impl PyTensor {
    fn converted(&self, double: bool) -> Values {
        match (&self.0, double) {
            (Values::Single(x), true) => Values::Double(Tensor::constant(x.value().mapv(f64::from))),
            (Values::Double(x), false) => Values::Single(Tensor::constant(x.value().mapv(|x| x as f32))),
            (same, _) => same.clone(),
        }
    }
}
