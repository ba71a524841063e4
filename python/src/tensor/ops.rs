//! The methods of `Tensor` that compute. Each calls the op of `autograd` of the same name.

use super::operands::{Operand, broadcast, check_size};
use super::{PyTensor, Values, each};
use crate::errors::{array, compute, dtype, invalid};
use autograd::Tensor;
use pyo3::prelude::*;

/// An axis, several axes, or all if there is none.
#[derive(FromPyObject)]
pub enum Axes {
    One(isize),
    Many(Vec<isize>),
}

/// Computes an op of two tensors of the same precision.
macro_rules! pair {
    ($a:expr, $b:expr, $x:ident, $y:ident => $result:expr) => {
        match ($a, $b) {
            (Values::Single($x), Values::Single($y)) => Values::Single($result),
            (Values::Double($x), Values::Double($y)) => Values::Double($result),
            // `Operand::read` has refused tensors of two precisions.
            _ => unreachable!("operands of two precisions"),
        }
    };
}

impl PyTensor {
    /// Computes an op of this tensor and another operand.
    fn with(
        &self,
        py: Python<'_>,
        other: &Bound<'_, PyAny>,
        name: &str,
        op: impl FnOnce(&Values, &Values) -> Values + Send,
    ) -> PyResult<PyTensor> {
        let other = Operand::read(other, &self.0, name)?.tensor(&self.0);
        broadcast(name, self.0.shape(), other.shape())?;
        compute(py, || PyTensor(op(&self.0, &other)))
    }

    /// The axes of a reduction, in decreasing order.
    fn reduced(&self, name: &str, axes: Option<Axes>) -> PyResult<Vec<usize>> {
        let mut axes = match axes {
            None => (0..self.0.shape().len()).collect(),
            Some(Axes::One(axis)) => vec![self.axis(name, axis)?],
            Some(Axes::Many(axes)) => axes.into_iter().map(|axis| self.axis(name, axis)).collect::<PyResult<_>>()?,
        };
        axes.sort_unstable_by(|a, b| b.cmp(a));
        match axes.windows(2).find(|pair| pair[0] == pair[1]) {
            Some(pair) => Err(array(name, format!("axis {} is given twice", pair[0]), "give each axis once")),
            None => Ok(axes),
        }
    }

    /// Reduces axes one after another, or all at once with `whole`.
    fn reduce(
        &self,
        py: Python<'_>,
        name: &str,
        axis: Option<Axes>,
        keepdims: bool,
        whole: impl FnOnce(&Values) -> Values + Send,
        along: impl Fn(&Values, usize) -> Values + Send,
    ) -> PyResult<PyTensor> {
        let all = axis.is_none();
        let axes = self.reduced(name, axis)?;
        let mut shape = self.0.shape().to_vec();
        axes.iter().for_each(|axis| shape[*axis] = 1);
        compute(py, move || {
            let reduced = if all { whole(&self.0) } else { axes.iter().fold(self.0.clone(), |values, axis| along(&values, *axis)) };
            PyTensor(if keepdims { each!(&reduced, x => x.reshape(&shape)) } else { reduced })
        })
    }

    /// Errors if there are no elements to take the largest of.
    fn check_not_empty(&self, name: &str) -> PyResult<()> {
        match self.0.shape().contains(&0) {
            true => Err(array(name, format!("a tensor of shape {:?} has no elements", self.0.shape()), "expected at least one")),
            false => Ok(()),
        }
    }

    fn along(&self, py: Python<'_>, name: &str, axis: isize, op: impl FnOnce(&Values, usize) -> Values + Send) -> PyResult<PyTensor> {
        let axis = self.axis(name, axis)?;
        self.map(py, |values| op(values, axis))
    }
}

#[pymethods]
impl PyTensor {
    fn __add__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        match Operand::read(other, &self.0, "+")? {
            Operand::Number(c) => self.map(py, |values| each!(values, x => x.affine(1.0, c))),
            Operand::Tensor(_) => self.with(py, other, "+", |a, b| pair!(a, b, x, y => x + y)),
        }
    }

    fn __radd__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.__add__(py, other)
    }

    fn __sub__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        match Operand::read(other, &self.0, "-")? {
            Operand::Number(c) => self.map(py, |values| each!(values, x => x.affine(1.0, -c))),
            Operand::Tensor(_) => self.with(py, other, "-", |a, b| pair!(a, b, x, y => x - y)),
        }
    }

    fn __rsub__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        match Operand::read(other, &self.0, "-")? {
            Operand::Number(c) => self.map(py, |values| each!(values, x => x.affine(-1.0, c))),
            Operand::Tensor(_) => self.with(py, other, "-", |a, b| pair!(a, b, x, y => y - x)),
        }
    }

    fn __mul__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        match Operand::read(other, &self.0, "*")? {
            Operand::Number(c) => self.map(py, |values| each!(values, x => x.affine(c, 0.0))),
            Operand::Tensor(_) => self.with(py, other, "*", |a, b| pair!(a, b, x, y => x * y)),
        }
    }

    fn __rmul__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.__mul__(py, other)
    }

    fn __truediv__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.with(py, other, "/", |a, b| pair!(a, b, x, y => x / y))
    }

    fn __rtruediv__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.with(py, other, "/", |a, b| pair!(a, b, x, y => y / x))
    }

    fn __pow__(&self, py: Python<'_>, exponent: &Bound<'_, PyAny>, modulus: Option<&Bound<'_, PyAny>>) -> PyResult<PyTensor> {
        if modulus.is_some() {
            return Err(dtype("**", "there is a modulus", "leave it out"));
        }
        match Operand::read(exponent, &self.0, "**")? {
            Operand::Number(2.0) => self.square(py),
            Operand::Number(n) if n.fract() == 0.0 && n.abs() <= 1024.0 => self.map(py, |values| each!(values, x => x.powi(n as i32))),
            Operand::Number(p) => self.map(py, |values| each!(values, x => x.powf(p))),
            Operand::Tensor(_) => self.with(py, exponent, "**", |a, b| pair!(a, b, x, y => x.pow(y))),
        }
    }

    fn __rpow__(&self, py: Python<'_>, base: &Bound<'_, PyAny>, modulus: Option<&Bound<'_, PyAny>>) -> PyResult<PyTensor> {
        if modulus.is_some() {
            return Err(dtype("**", "there is a modulus", "leave it out"));
        }
        self.with(py, base, "**", |a, b| pair!(a, b, x, y => y.pow(x)))
    }

    fn __matmul__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        let other = Operand::read(other, &self.0, "@")?.tensor(&self.0);
        product(py, &self.0, &other)
    }

    fn __rmatmul__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        let other = Operand::read(other, &self.0, "@")?.tensor(&self.0);
        product(py, &other, &self.0)
    }

    fn __neg__(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => -x))
    }

    fn __abs__(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.abs(py)
    }

    /// 1 where this tensor is larger, else 0; a constant.
    fn __gt__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.with(py, other, ">", |a, b| pair!(a, b, x, y => x.greater(y)))
    }

    /// 1 where this tensor is larger or equal, else 0; a constant.
    fn __ge__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.with(py, other, ">=", |a, b| pair!(a, b, x, y => x.greater_equal(y)))
    }

    /// 1 where this tensor is smaller, else 0; a constant.
    fn __lt__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.with(py, other, "<", |a, b| pair!(a, b, x, y => y.greater(x)))
    }

    /// 1 where this tensor is smaller or equal, else 0; a constant.
    fn __le__(&self, py: Python<'_>, other: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
        self.with(py, other, "<=", |a, b| pair!(a, b, x, y => y.greater_equal(x)))
    }

    /// Returns e to the power of each element.
    fn exp(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.exp()))
    }

    /// Returns exp(x) - 1, accurate for small x.
    fn expm1(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.expm1()))
    }

    /// Returns the natural logarithm.
    fn log(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.ln()))
    }

    /// Returns the square root.
    fn sqrt(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.sqrt()))
    }

    /// Returns the square.
    fn square(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.square()))
    }

    /// Returns the absolute value.
    fn abs(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.abs()))
    }

    /// Returns 1 / (1 + exp(-x)).
    fn sigmoid(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.sigmoid()))
    }

    /// Returns ln(1 + exp(x)).
    fn softplus(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.softplus()))
    }

    /// Returns max(x, 0).
    fn relu(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.relu()))
    }

    /// Returns x where x >= 0, and slope * x elsewhere.
    #[pyo3(signature = (slope = 0.01))]
    fn leaky_relu(&self, py: Python<'_>, slope: f64) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.leaky_relu(slope)))
    }

    /// Returns the hyperbolic tangent.
    fn tanh(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.tanh()))
    }

    /// Returns the sine.
    fn sin(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.sin()))
    }

    /// Returns the cosine.
    fn cos(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.cos()))
    }

    /// Returns the sign, -1, 0 or 1, as a constant.
    fn sign(&self, py: Python<'_>) -> PyResult<PyTensor> {
        self.map(py, |values| each!(values, x => x.sign()))
    }

    /// Returns min(max(x, low), high). The gradient is 0 outside.
    fn clamp(&self, py: Python<'_>, low: f64, high: f64) -> PyResult<PyTensor> {
        if low.is_nan() || high.is_nan() || low > high {
            return Err(invalid("clamp", format!("{low}, {high}"), "low <= high"));
        }
        self.map(py, |values| each!(values, x => x.clamp(low, high)))
    }

    /// Returns the sum over all elements, or along axes.
    #[pyo3(signature = (axis = None, *, keepdims = false))]
    fn sum(&self, py: Python<'_>, axis: Option<Axes>, keepdims: bool) -> PyResult<PyTensor> {
        self.reduce(py, "sum", axis, keepdims, |values| each!(values, x => x.sum()), |values, axis| each!(values, x => x.sum_axis(axis)))
    }

    /// Returns the mean over all elements, or along axes.
    #[pyo3(signature = (axis = None, *, keepdims = false))]
    fn mean(&self, py: Python<'_>, axis: Option<Axes>, keepdims: bool) -> PyResult<PyTensor> {
        self.reduce(py, "mean", axis, keepdims, |values| each!(values, x => x.mean()), |values, axis| each!(values, x => x.mean_axis(axis)))
    }

    /// Returns the largest element, or the largest along axes. Ties divide the gradient equally.
    #[pyo3(signature = (axis = None, *, keepdims = false))]
    fn max(&self, py: Python<'_>, axis: Option<Axes>, keepdims: bool) -> PyResult<PyTensor> {
        self.check_not_empty("max")?;
        self.reduce(py, "max", axis, keepdims, |values| each!(values, x => x.max()), |values, axis| each!(values, x => x.max_axis(axis)))
    }

    /// Returns the smallest element, or the smallest along axes. Ties divide the gradient equally.
    #[pyo3(signature = (axis = None, *, keepdims = false))]
    fn min(&self, py: Python<'_>, axis: Option<Axes>, keepdims: bool) -> PyResult<PyTensor> {
        self.check_not_empty("min")?;
        self.reduce(py, "min", axis, keepdims, |values| each!(values, x => x.min()), |values, axis| each!(values, x => x.min_axis(axis)))
    }

    /// Returns exp(x) / sum of exp(x) along an axis.
    fn softmax(&self, py: Python<'_>, axis: isize) -> PyResult<PyTensor> {
        self.check_not_empty("softmax")?;
        self.along(py, "softmax", axis, |values, axis| each!(values, x => x.softmax(axis)))
    }

    /// Returns the logarithm of the sum of exp(x) along an axis, which is removed.
    fn logsumexp(&self, py: Python<'_>, axis: isize) -> PyResult<PyTensor> {
        self.check_not_empty("logsumexp")?;
        self.along(py, "logsumexp", axis, |values, axis| each!(values, x => x.log_sum_exp(axis)))
    }

    /// Returns the Euclidean norm along an axis, which is removed. Its gradient is 0 where the norm is 0.
    fn norm(&self, py: Python<'_>, axis: isize) -> PyResult<PyTensor> {
        self.along(py, "norm", axis, |values, axis| each!(values, x => x.norm(axis)))
    }

    /// Returns x / |x| along an axis.
    fn normalize(&self, py: Python<'_>, axis: isize) -> PyResult<PyTensor> {
        self.along(py, "normalize", axis, |values, axis| each!(values, x => x.normalize(axis)))
    }

    /// Returns the cumulative sum along an axis.
    fn cumsum(&self, py: Python<'_>, axis: isize) -> PyResult<PyTensor> {
        self.along(py, "cumsum", axis, |values, axis| each!(values, x => x.cumsum(axis)))
    }

    /// Returns the same values with another shape. One side may be -1.
    #[pyo3(signature = (*shape))]
    fn reshape(&self, py: Python<'_>, shape: Sides) -> PyResult<PyTensor> {
        let Sides(mut sides) = shape;
        let wrong = |problem: String| array("reshape", problem, "expected as many elements; one side may be -1");
        let len = self.0.shape().iter().product::<usize>();
        let known = sides.iter().filter(|side| **side >= 0).try_fold(1_usize, |product, side| product.checked_mul(side.unsigned_abs()));
        let open = sides.iter().filter(|side| **side == -1).count();
        let known = known.filter(|_| open <= 1 && sides.iter().all(|side| *side >= -1));
        let known = known.ok_or_else(|| wrong(format!("the shape {sides:?} is impossible")))?;
        if open == 1 && known > 0 && len.is_multiple_of(known) {
            sides.iter_mut().filter(|side| **side == -1).for_each(|side| *side = (len / known) as isize);
        } else if open == 1 || known != len {
            return Err(wrong(format!("a tensor of shape {:?} has {len} elements, which do not fill the shape {sides:?}", self.0.shape())));
        }
        let shape: Vec<usize> = sides.iter().map(|side| side.unsigned_abs()).collect();
        self.map(py, |values| each!(values, x => x.reshape(&shape)))
    }

    /// Inserts an axis of one element before `axis`.
    fn unsqueeze(&self, py: Python<'_>, axis: isize) -> PyResult<PyTensor> {
        let n = self.0.shape().len();
        let found = if axis < 0 { axis.checked_add_unsigned(n + 1) } else { Some(axis) };
        let axis = found.and_then(|axis| usize::try_from(axis).ok()).filter(|axis| *axis <= n).ok_or_else(|| {
            array("unsqueeze", format!("axis {axis} is out of range for the shape {:?}", self.0.shape()), format!("there are {n} axes"))
        })?;
        self.map(py, |values| each!(values, x => x.unsqueeze(axis)))
    }

    /// Repeats the values to a larger shape, by the broadcasting rule of NumPy.
    fn broadcast_to(&self, py: Python<'_>, shape: Vec<usize>) -> PyResult<PyTensor> {
        let found = broadcast("broadcast_to", self.0.shape(), &shape)?;
        if found != shape {
            return Err(array("broadcast_to", format!("{:?} does not broadcast to {shape:?}", self.0.shape()), "expected a larger shape"));
        }
        self.map(py, |values| each!(values, x => x.broadcast_to(&shape)))
    }

    /// Reorders the axes: axis i of the result is axis `axes[i]` of this tensor.
    fn permute(&self, py: Python<'_>, axes: Vec<isize>) -> PyResult<PyTensor> {
        let axes = axes.into_iter().map(|axis| self.axis("permute", axis)).collect::<PyResult<Vec<usize>>>()?;
        let mut sorted = axes.clone();
        sorted.sort_unstable();
        if !sorted.into_iter().eq(0..self.0.shape().len()) {
            return Err(array("permute", format!("{axes:?} is not an order of the axes of {:?}", self.0.shape()), "give each axis once"));
        }
        self.map(py, |values| each!(values, x => x.permute(&axes)))
    }

    /// The transposed matrix: the last two axes are exchanged.
    #[getter(T)]
    fn transposed(&self, py: Python<'_>) -> PyResult<PyTensor> {
        if self.0.shape().len() < 2 {
            return Err(array("T", format!("the tensor has the shape {:?}", self.0.shape()), "expected two axes or more"));
        }
        self.map(py, |values| each!(values, x => x.transpose()))
    }
}

/// The sides of a shape: integers, or one list of them.
pub struct Sides(Vec<isize>);

impl<'a, 'py> FromPyObject<'a, 'py> for Sides {
    type Error = PyErr;

    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        if let Ok(sides) = object.extract::<Vec<isize>>() {
            return Ok(Sides(sides));
        }
        let (sides,): (Vec<isize>,) = object.extract().map_err(|_| dtype("reshape", "the shape has no integers", "expected integers"))?;
        Ok(Sides(sides))
    }
}

/// Computes a matrix product.
fn product(py: Python<'_>, a: &Values, b: &Values) -> PyResult<PyTensor> {
    let (m, n) = (a.shape(), b.shape());
    let batches = |shape: &[usize]| shape.len().saturating_sub(2);
    let fits = m.len() >= 2 && n.len() >= 2 && m[m.len() - 1] == n[n.len() - 2];
    let (x, y) = (&m[..batches(m)], &n[..batches(n)]);
    if !fits || !(x == y || x.is_empty() || y.is_empty()) {
        let expected = "expected [..., m, k] and [..., k, n] with equal leading axes";
        return Err(array("@", format!("the shapes {m:?} and {n:?} do not fit"), expected));
    }
    let shape = [if x.is_empty() { y } else { x }, &[m[m.len() - 2], n[n.len() - 1]]].concat();
    check_size("@", &shape)?;
    compute(py, || PyTensor(pair!(a, b, x, y => x.matmul(y))))
}

/// Returns the larger of two values, elementwise. The gradient goes to the larger, and to the first where both are equal.
#[pyfunction]
pub fn maximum(py: Python<'_>, x: &Bound<'_, PyAny>, y: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
    let (x, y) = two("maximum", x, y)?;
    compute(py, || PyTensor(pair!(&x, &y, x, y => x.maximum(y))))
}

/// Returns the smaller of two values, elementwise. The gradient goes to the smaller, and to the first where both are equal.
#[pyfunction]
pub fn minimum(py: Python<'_>, x: &Bound<'_, PyAny>, y: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
    let (x, y) = two("minimum", x, y)?;
    compute(py, || PyTensor(pair!(&x, &y, x, y => x.minimum(y))))
}

/// Reads two operands, at least one of which is a tensor, and checks that they broadcast.
fn two(op: &str, x: &Bound<'_, PyAny>, y: &Bound<'_, PyAny>) -> PyResult<(Values, Values)> {
    let like = x.cast::<PyTensor>().or_else(|_| y.cast::<PyTensor>());
    let like = like.map_err(|_| dtype(op, "there is no Tensor", "give at least one"))?.get();
    let read = |value| Ok::<_, PyErr>(Operand::read(value, &like.0, op)?.tensor(&like.0));
    let (x, y) = (read(x)?, read(y)?);
    broadcast(op, x.shape(), y.shape())?;
    Ok((x, y))
}

/// Returns x where the mask is not 0, and y elsewhere. What is not selected affects neither the value nor the gradient.
#[pyfunction]
#[pyo3(name = "where")]
pub fn where_(py: Python<'_>, mask: &Bound<'_, PyAny>, x: &Bound<'_, PyAny>, y: &Bound<'_, PyAny>) -> PyResult<PyTensor> {
    let (x, y) = two("where", x, y)?;
    let mask = Operand::read(mask, &x, "where")?.tensor(&x);
    let shape = broadcast("where", &broadcast("where", x.shape(), y.shape())?, mask.shape())?;
    compute(py, || {
        let [mask, x, y] = [&mask, &x, &y].map(|values| each!(values, v => v.broadcast_to(&shape)));
        PyTensor(match (&mask, &x, &y) {
            (Values::Single(mask), Values::Single(x), Values::Single(y)) => Values::Single(Tensor::where_(mask, x, y)),
            (Values::Double(mask), Values::Double(x), Values::Double(y)) => Values::Double(Tensor::where_(mask, x, y)),
            _ => unreachable!("operands of two precisions"),
        })
    })
}

/// Joins tensors along an axis.
#[pyfunction]
#[pyo3(signature = (tensors, axis = 0))]
pub fn concat(py: Python<'_>, tensors: Vec<PyTensor>, axis: isize) -> PyResult<PyTensor> {
    let axis = joined("concat", &tensors, axis, |first, axis| first.axis("concat", axis), true)?;
    join(py, &tensors, |parts| Tensor::concat(parts, axis), |parts| Tensor::concat(parts, axis))
}

/// Joins tensors of one shape along a new axis.
#[pyfunction]
#[pyo3(signature = (tensors, axis = 0))]
pub fn stack(py: Python<'_>, tensors: Vec<PyTensor>, axis: isize) -> PyResult<PyTensor> {
    let place = |first: &PyTensor, axis: isize| match usize::try_from(axis) {
        Ok(axis) if axis <= first.0.shape().len() => Ok(axis),
        _ => Err(array("stack", format!("axis {axis} is out of range"), format!("expected 0 to {}", first.0.shape().len()))),
    };
    let axis = joined("stack", &tensors, axis, place, false)?;
    join(py, &tensors, |parts| Tensor::stack(parts, axis), |parts| Tensor::stack(parts, axis))
}

/// Checks that tensors have one shape, but for the joined axis if `differs`. Returns the axis.
fn joined(
    op: &str,
    tensors: &[PyTensor],
    axis: isize,
    place: impl FnOnce(&PyTensor, isize) -> PyResult<usize>,
    differs: bool,
) -> PyResult<usize> {
    let first = tensors.first().ok_or_else(|| array(op, "there are no tensors", "give at least one"))?;
    let axis = place(first, axis)?;
    let side = |shape: &[usize]| shape.iter().enumerate().filter(|(k, _)| !differs || *k != axis).map(|(_, n)| *n).collect::<Vec<_>>();
    for other in tensors {
        let (a, b) = (first.0.shape(), other.0.shape());
        if a.len() != b.len() || side(a) != side(b) {
            return Err(array(op, format!("the shapes {a:?} and {b:?} do not fit"), "expected equal sides"));
        }
        if first.0.dtype() != other.0.dtype() {
            return Err(dtype(op, "tensors of float32 and float64", "convert some of them"));
        }
    }
    Ok(axis)
}

fn join(
    py: Python<'_>,
    tensors: &[PyTensor],
    single: impl FnOnce(&[&Tensor<f32>]) -> Tensor<f32> + Send,
    double: impl FnOnce(&[&Tensor<f64>]) -> Tensor<f64> + Send,
) -> PyResult<PyTensor> {
    compute(py, || {
        let singles: Vec<&Tensor<f32>> = tensors.iter().filter_map(|x| if let Values::Single(x) = &x.0 { Some(x) } else { None }).collect();
        let doubles: Vec<&Tensor<f64>> = tensors.iter().filter_map(|x| if let Values::Double(x) = &x.0 { Some(x) } else { None }).collect();
        PyTensor(if doubles.is_empty() { Values::Single(single(&singles)) } else { Values::Double(double(&doubles)) })
    })
}
