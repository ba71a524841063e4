//! Addition, subtraction, multiplication and division, with operators, NumPy broadcasting, and numbers on either side; also `maximum` and `minimum`.

use crate::graph::Rule;
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel::{self, dispatched};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// z = x + y.   ∂L/∂x = ∂L/∂y = ∂L/∂z
#[derive(Debug)]
struct AddOp;
impl<T: Real> Op<T> for AddOp {
    fn name(&self) -> &'static str {
        "add"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().clone()), cx.wrt(1, || cx.cotangent().clone())]
    }
}

/// z = x − y.   ∂L/∂x = ∂L/∂z, ∂L/∂y = −∂L/∂z
#[derive(Debug)]
struct SubOp;
impl<T: Real> Op<T> for SubOp {
    fn name(&self) -> &'static str {
        "sub"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().clone()), cx.wrt(1, || -cx.cotangent())]
    }
}

/// z = x · y.   ∂L/∂x = ∂L/∂z · y, ∂L/∂y = ∂L/∂z · x
#[derive(Debug)]
struct MulOp;
impl<T: Real> Op<T> for MulOp {
    fn name(&self) -> &'static str {
        "mul"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let g = cx.cotangent();
        vec![cx.wrt(0, || g.mul_sum_to(&cx.input(1), cx.input_shape(0))), cx.wrt(1, || g.mul_sum_to(&cx.input(0), cx.input_shape(1)))]
    }
}

/// z = x / y.   ∂L/∂x = ∂L/∂z / y, ∂L/∂y = −∂L/∂z · z / y
#[derive(Debug)]
struct DivOp;
impl<T: Real> Op<T> for DivOp {
    fn name(&self) -> &'static str {
        "div"
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let g = cx.cotangent();
        vec![cx.wrt(0, || g / cx.input(1)), cx.wrt(1, || -(g * cx.output() / cx.input(1)))]
    }
}

/// z = a x + b with numbers a and b.   ∂L/∂x = a ∂L/∂z
#[derive(Debug)]
struct Affine {
    scale: f64,
}
impl<T: Real> Op<T> for Affine {
    fn name(&self) -> &'static str {
        "affine"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent_factor().affine(self.scale, 0.0))]
    }
}

/// z = max(x, y) or min(x, y).   ∂L/∂z goes to the larger (smaller) input, and to x where they are equal, which is a kink.
#[derive(Debug)]
struct Extremum {
    largest: bool,
}
impl<T: Real> Op<T> for Extremum {
    fn name(&self) -> &'static str {
        if self.largest { "maximum" } else { "minimum" }
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let (x, y) = (cx.input(0).detach(), cx.input(1).detach());
        let first = if self.largest { x.greater_equal(&y) } else { y.greater_equal(&x) };
        vec![cx.wrt(0, || cx.cotangent() * &first), cx.wrt(1, || cx.cotangent() * (1.0 - &first))]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns z = scale · x + shift, elementwise.   ∂L/∂x = scale · ∂L/∂z
    pub fn affine(&self, scale: f64, shift: f64) -> Self {
        let (a, b) = (T::lit(scale), T::lit(shift));
        let mut out = Buffer::stale(self.len());
        match (scale, shift) {
            (1.0, _) => parallel::map(self.data(), &mut out, move |x| x + b),
            (_, 0.0) => parallel::map(self.data(), &mut out, move |x| x * a),
            _ => parallel::map(self.data(), &mut out, move |x| x * a + b),
        }
        Tensor::from_op(out, self.shape(), &[self], Affine { scale })
    }

    /// Returns max(x, y), elementwise with broadcasting; x is `self`. The gradient goes to the larger input, and to x where the inputs are equal.
    ///
    /// Panics if the shapes do not broadcast.
    #[track_caller]
    pub fn maximum(&self, other: &Self) -> Self {
        binary("maximum", self, other, Extremum { largest: true }, |x, y| if x >= y || x.is_nan() { x } else { y })
    }

    /// Returns min(x, y), elementwise with broadcasting; x is `self`. The gradient goes to the smaller input, and to x where the inputs are equal.
    ///
    /// Panics if the shapes do not broadcast.
    #[track_caller]
    pub fn minimum(&self, other: &Self) -> Self {
        binary("minimum", self, other, Extremum { largest: false }, |x, y| if x <= y || x.is_nan() { x } else { y })
    }

    /// Returns self · other, summed to `shape`: the cotangent of a factor of a product with broadcasting.
    fn mul_sum_to(&self, other: &Self, shape: &[usize]) -> Self {
        let product = self * other;
        if product.shape() == shape { product } else { product.sum_to(shape) }
    }
}

#[track_caller]
fn add<T: Real>(x: &Tensor<T>, y: &Tensor<T>) -> Tensor<T> {
    binary("add", x, y, AddOp, |x, y| x + y)
}

#[track_caller]
fn sub<T: Real>(x: &Tensor<T>, y: &Tensor<T>) -> Tensor<T> {
    binary("sub", x, y, SubOp, |x, y| x - y)
}

#[track_caller]
fn mul<T: Real>(x: &Tensor<T>, y: &Tensor<T>) -> Tensor<T> {
    binary("mul", x, y, MulOp, |x, y| x * y)
}

#[track_caller]
fn div<T: Real>(x: &Tensor<T>, y: &Tensor<T>) -> Tensor<T> {
    binary("div", x, y, DivOp, |x, y| x / y)
}

macro_rules! operators {
    ($($trait:ident $method:ident;)*) => {$(
        impl<T: Real> $trait<&Tensor<T>> for &Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: &Tensor<T>) -> Tensor<T> {
                $method(self, other)
            }
        }
        impl<T: Real> $trait<Tensor<T>> for &Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: Tensor<T>) -> Tensor<T> {
                $method(self, &other)
            }
        }
        impl<T: Real> $trait<&Tensor<T>> for Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: &Tensor<T>) -> Tensor<T> {
                $method(&self, other)
            }
        }
        impl<T: Real> $trait<Tensor<T>> for Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: Tensor<T>) -> Tensor<T> {
                $method(&self, &other)
            }
        }
    )*};
}
operators! { Add add; Sub sub; Mul mul; Div div; }

/// Implements operators with an `f64` number on either side of a tensor of any precision.
macro_rules! scalar_operators {
    ($($trait:ident $method:ident $right:expr, $left:expr;)*) => {$(
        impl<T: Real> $trait<f64> for &Tensor<T> {
            type Output = Tensor<T>;
            fn $method(self, scalar: f64) -> Tensor<T> {
                ($right)(self, scalar)
            }
        }
        impl<T: Real> $trait<f64> for Tensor<T> {
            type Output = Tensor<T>;
            fn $method(self, scalar: f64) -> Tensor<T> {
                ($right)(&self, scalar)
            }
        }
        impl<T: Real> $trait<&Tensor<T>> for f64 {
            type Output = Tensor<T>;
            fn $method(self, tensor: &Tensor<T>) -> Tensor<T> {
                ($left)(tensor, self)
            }
        }
        impl<T: Real> $trait<Tensor<T>> for f64 {
            type Output = Tensor<T>;
            fn $method(self, tensor: Tensor<T>) -> Tensor<T> {
                ($left)(&tensor, self)
            }
        }
    )*};
}
scalar_operators! {
    Add add |x: &Tensor<T>, s: f64| x.affine(1.0, s), |x: &Tensor<T>, s: f64| x.affine(1.0, s);
    Sub sub |x: &Tensor<T>, s: f64| x.affine(1.0, -s), |x: &Tensor<T>, s: f64| x.affine(-1.0, s);
    Mul mul |x: &Tensor<T>, s: f64| x.affine(s, 0.0), |x: &Tensor<T>, s: f64| x.affine(s, 0.0);
    Div div |x: &Tensor<T>, s: f64| x.affine(1.0 / s, 0.0), |x: &Tensor<T>, s: f64| x.powi(-1).affine(s, 0.0);
}

impl<T: Real> Neg for &Tensor<T> {
    type Output = Tensor<T>;
    fn neg(self) -> Tensor<T> {
        self.affine(-1.0, 0.0)
    }
}

impl<T: Real> Neg for Tensor<T> {
    type Output = Tensor<T>;
    fn neg(self) -> Tensor<T> {
        self.affine(-1.0, 0.0)
    }
}

/// Computes f(x, y), elementwise with broadcasting, and records it as `op`.
///
/// Panics with the name of the op and both shapes if the shapes do not broadcast.
#[track_caller]
pub(crate) fn binary<T: Real>(name: &str, x: &Tensor<T>, y: &Tensor<T>, op: impl Op<T>, f: impl Fn(T, T) -> T + Sync) -> Tensor<T> {
    if x.shape() == y.shape() {
        let mut out = Buffer::stale(x.len());
        parallel::zip(x.data(), y.data(), &mut out, f);
        return Tensor::from_op(out, x.shape(), &[x, y], op);
    }
    let Some(shape) = broadcast_shape(x.shape(), y.shape()) else {
        panic!("{name}: shapes {:?} and {:?} do not broadcast", x.shape(), y.shape())
    };
    let mut out = Buffer::stale(shape.iter().product());
    if y.len() == 1 {
        let s = y.data()[0];
        parallel::map(x.data(), &mut out, |v| f(v, s));
    } else if x.len() == 1 {
        let s = x.data()[0];
        parallel::map(y.data(), &mut out, |v| f(s, v));
    } else {
        broadcast_loop(x, y, &shape, &mut out, &f);
    }
    let keep = op.keep();
    Tensor::from_buffer(out, &shape).recorded(&[x, y], keep, || Rule::Op(Box::new(op)))
}

/// Returns the broadcast shape by the rule of NumPy: shapes are aligned at the last dimension, and sizes must be equal or one of them must be 1.
pub(crate) fn broadcast_shape(a: &[usize], b: &[usize]) -> Option<Vec<usize>> {
    let n = a.len().max(b.len());
    let size = |s: &[usize], i: usize| if i + s.len() >= n { s[i + s.len() - n] } else { 1 };
    (0..n)
        .map(|i| match (size(a, i), size(b, i)) {
            (x, y) if x == y => Some(x),
            (1, y) => Some(y),
            (x, 1) => Some(x),
            _ => None,
        })
        .collect()
}

/// Returns the strides that read a contiguous array of shape `from` as an array of shape `to`. The stride of a repeated dimension is 0.
pub(crate) fn broadcast_strides(from: &[usize], to: &[usize]) -> Vec<usize> {
    let mut strides = vec![0; to.len()];
    let mut step = 1;
    for i in (0..from.len()).rev() {
        let k = i + to.len() - from.len();
        if from[i] != 1 {
            strides[k] = step;
        }
        step *= from[i];
    }
    strides
}

/// Returns the loop nest of a broadcast, as (size, stride of a, stride of b). Adjacent dimensions are merged where the strides of both operands permit it.
fn collapse(shape: &[usize], a: &[usize], b: &[usize]) -> Vec<(usize, usize, usize)> {
    let mut dims: Vec<(usize, usize, usize)> = Vec::with_capacity(shape.len());
    for ((&n, &sa), &sb) in shape.iter().zip(a).zip(b) {
        if n == 1 {
            continue;
        }
        match dims.last_mut() {
            Some((m, ma, mb)) if *ma == sa * n && *mb == sb * n => (*m, *ma, *mb) = (*m * n, sa, sb),
            _ => dims.push((n, sa, sb)),
        }
    }
    dims
}

fn broadcast_loop<T: Real>(x: &Tensor<T>, y: &Tensor<T>, shape: &[usize], out: &mut [T], f: &(impl Fn(T, T) -> T + Sync)) {
    let mut dims = collapse(shape, &broadcast_strides(x.shape(), shape), &broadcast_strides(y.shape(), shape));
    let (cols, xc, yc) = dims.pop().unwrap_or((1, 0, 0));
    let (rows, xr, yr) = dims.pop().unwrap_or((1, 0, 0));
    parallel::for_each_rows(out, cols, |first, chunk| {
        let count = chunk.len() / cols;
        let mut done = 0;
        while done < count {
            let (block, row) = ((first + done) / rows, (first + done) % rows);
            let run = (rows - row).min(count - done);
            let (mut xo, mut yo, mut rest) = (row * xr, row * yr, block);
            for &(n, xs, ys) in dims.iter().rev() {
                xo += rest % n * xs;
                yo += rest % n * ys;
                rest /= n;
            }
            let part = &mut chunk[done * cols..(done + run) * cols];
            let (x, y) = (Rows { data: &x.data()[xo..], row: xr, col: xc }, Rows { data: &y.data()[yo..], row: yr, col: yc });
            if cols == 3 {
                rows_loop::<T, 3, _>(x, y, cols, part, f)
            } else {
                rows_loop::<T, 0, _>(x, y, cols, part, f)
            }
            done += run;
        }
    });
}

/// An operand of a two-dimensional loop, with its row and column strides. The column stride is 0 or 1.
#[derive(Clone, Copy)]
struct Rows<'a, T> {
    data: &'a [T],
    row: usize,
    col: usize,
}

dispatched! {
/// Computes rows of f(x, y). `C` is the number of columns, or 0 if the number is known at run time only.
fn rows_loop<T: Real, const C: usize, F: Fn(T, T) -> T>(x: Rows<'_, T>, y: Rows<'_, T>, cols: usize, out: &mut [T], f: &F) {
    let cols = if C == 0 { cols } else { C };
    for (r, row) in out.chunks_exact_mut(cols).enumerate() {
        let (x_row, y_row) = (&x.data[r * x.row..], &y.data[r * y.row..]);
        match (x.col, y.col) {
            (0, _) => {
                let s = x_row[0];
                row.iter_mut().zip(&y_row[..cols]).for_each(|(o, &v)| *o = f(s, v));
            }
            (_, 0) => {
                let s = y_row[0];
                row.iter_mut().zip(&x_row[..cols]).for_each(|(o, &v)| *o = f(v, s));
            }
            _ => row.iter_mut().zip(&x_row[..cols]).zip(&y_row[..cols]).for_each(|((o, &a), &b)| *o = f(a, b)),
        }
    }
}
}
