//! Elementwise functions of one argument.

use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// Defines elementwise ops: for each, the method, the op struct, the values that the rule keeps, the function, and the rule.
macro_rules! elementwise {
    ($($(#[$doc:meta])* $(@$kind:ident)? $name:ident, $op:ident, $keep:expr, $f:expr, $rule:expr;)*) => {$(
        #[derive(Debug)]
        struct $op;
        impl<T: Real> Op<T> for $op {
            fn name(&self) -> &'static str {
                stringify!($name)
            }
            fn keep(&self) -> Keep {
                $keep
            }
            fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
                vec![cx.wrt(0, || ($rule)(cx))]
            }
        }
        impl<T: Real> Tensor<T> {
            $(#[$doc])*
            pub fn $name(&self) -> Self {
                apply!($($kind)? self, $op, $f)
            }
        }
    )*};
}

/// Applies a function to each element. A function marked `exponential` is used in the version for this machine ([`parallel::fused`]). A function marked
/// `periodic` is a pair: the first is used for |x| <= [`Real::SINE_LIMIT`], the second for larger |x|.
macro_rules! apply {
    (periodic $x:expr, $op:ident, $f:expr) => {{
        let (inside, outside) = $f;
        let mut out = Buffer::stale($x.len());
        parallel::map_within($x.data(), &mut out, T::SINE_LIMIT, inside, outside);
        Tensor::from_op(out, $x.shape(), &[$x], $op)
    }};
    (exponential $x:expr, $op:ident, $f:expr) => {
        if parallel::fused() {
            const FUSED: bool = true;
            unary($x, $op, $f)
        } else {
            const FUSED: bool = false;
            unary($x, $op, $f)
        }
    };
    ($x:expr, $op:ident, $f:expr) => {
        unary($x, $op, $f)
    };
}

elementwise! {
    /// Returns y = eˣ.   ∂L/∂x = ∂L/∂y · y
    @exponential exp, Exp, Keep::OUTPUT, T::exp_::<FUSED>, |cx: &Vjp<'_, T>| cx.cotangent_factor() * cx.output();

    /// Returns y = eˣ − 1 without cancellation for small x, accurate to two units in the last place.   ∂L/∂x = ∂L/∂y · eˣ
    ///
    /// The rule computes eˣ again, since y + 1 would lose its digits for large negative x.
    expm1, Expm1, Keep::INPUTS, T::expm1_, |cx: &Vjp<'_, T>| cx.cotangent_factor() * cx.input(0).exp();

    /// Returns y = 1 − e⁻ˣ without cancellation for small x: the opacity for an optical depth x.   ∂L/∂x = ∂L/∂y · e⁻ˣ
    ///
    /// The rule computes e⁻ˣ again, since 1 − y would lose its digits where y is near 1.
    @exponential one_minus_exp_neg, OneMinusExpNeg, Keep::INPUTS, T::one_minus_exp_neg::<FUSED>, |cx: &Vjp<'_, T>| cx.cotangent_factor() * (-cx.input(0)).exp();

    /// Returns y = ln x, for x > 0.   ∂L/∂x = ∂L/∂y / x
    ln, Ln, Keep::INPUTS, |x: T| x.ln(), |cx: &Vjp<'_, T>| cx.cotangent_factor() / cx.input(0);

    /// Returns y = √x, for x >= 0. It is not differentiable at 0.   ∂L/∂x = ∂L/∂y / 2y
    sqrt, Sqrt, Keep::OUTPUT, |x: T| x.sqrt(), |cx: &Vjp<'_, T>| cx.cotangent_factor() / (2.0 * cx.output());

    /// Returns y = x².   ∂L/∂x = ∂L/∂y · 2x
    square, Square, Keep::INPUTS, |x: T| x * x, |cx: &Vjp<'_, T>| 2.0 * cx.cotangent_factor() * cx.input(0);

    /// Returns y = |x|. The gradient at 0 is 0.   ∂L/∂x = ∂L/∂y · sign x
    abs, Abs, Keep::INPUTS, |x: T| x.abs(), |cx: &Vjp<'_, T>| cx.cotangent_factor() * cx.input(0).sign();

    /// Returns y = 1 / (1 + e⁻ˣ).   ∂L/∂x = ∂L/∂y · y (1 − y)
    @exponential sigmoid, Sigmoid, Keep::OUTPUT,
    |x: T| {
        // e^-|x| cannot overflow.
        let e = (-x.abs()).exp_::<FUSED>();
        let small = e / (T::one() + e);
        if x >= T::zero() { T::one() - small } else { small }
    },
    |cx: &Vjp<'_, T>| {
        let y = cx.output();
        cx.cotangent_factor() * (&y * (1.0 - &y))
    };

    /// Returns y = ln(1 + eˣ), computed as max(x, 0) + ln(1 + e^−|x|).   ∂L/∂x = ∂L/∂y · sigmoid x
    @exponential softplus, Softplus, Keep::INPUTS, |x: T| x.max(T::zero()) + (-x.abs()).exp_::<FUSED>().ln_1p(), |cx: &Vjp<'_, T>| cx.cotangent_factor() * cx.input(0).sigmoid();

    /// Returns y = max(x, 0), and NaN where x is NaN.   ∂L/∂x = ∂L/∂y where x >= 0, else 0
    relu, Relu, Keep::INPUTS, |x: T| if x < T::zero() { T::zero() } else { x }, |cx: &Vjp<'_, T>| {
        let x = cx.input(0).detach();
        cx.cotangent_factor() * x.greater_equal(&Tensor::scalar(T::zero()))
    };

    /// Returns y = tanh x, accurate to three units in the last place.   ∂L/∂x = ∂L/∂y · (1 − y²)
    tanh, Tanh, Keep::OUTPUT, T::tanh_, |cx: &Vjp<'_, T>| cx.cotangent_factor() * (1.0 - cx.output().square());

    /// Returns y = sin x, accurate to one unit in the last place.   ∂L/∂x = ∂L/∂y · cos x
    ///
    /// For |x| > 2²⁰ the sine is computed by the math library of the system, one number at a time.
    @periodic sin, Sin, Keep::INPUTS, (T::sin_, |x: T| x.sin()), |cx: &Vjp<'_, T>| cx.cotangent_factor() * cx.input(0).cos();

    /// Returns y = cos x, computed like [`Tensor::sin`].   ∂L/∂x = −∂L/∂y · sin x
    @periodic cos, Cos, Keep::INPUTS, (T::cos_, |x: T| x.cos()), |cx: &Vjp<'_, T>| -(cx.cotangent_factor() * cx.input(0).sin());
}

/// y = xⁿ.   ∂L/∂x = ∂L/∂y · n xⁿ⁻¹
#[derive(Debug)]
struct Powi(i32);
impl<T: Real> Op<T> for Powi {
    fn name(&self) -> &'static str {
        "powi"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || match self.0 {
            0 => Tensor::zeros(cx.input_shape(0)),
            n => cx.cotangent_factor() * cx.input(0).powi(n - 1).affine(f64::from(n), 0.0),
        })]
    }
}

/// y = x where x >= 0, else slope · x.   ∂L/∂x = ∂L/∂y where x >= 0, else slope · ∂L/∂y
#[derive(Debug)]
struct LeakyRelu {
    slope: f64,
}
impl<T: Real> Op<T> for LeakyRelu {
    fn name(&self) -> &'static str {
        "leaky_relu"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let slope = T::lit(self.slope);
        vec![cx.wrt(0, || cx.cotangent_factor() * cx.input(0).constant_map(|x| if x < T::zero() { slope } else { T::one() }))]
    }
}

/// y = min(max(x, low), high).   ∂L/∂x = ∂L/∂y where low <= x <= high, else 0
#[derive(Debug)]
struct Clamp {
    low: f64,
    high: f64,
}
impl<T: Real> Op<T> for Clamp {
    fn name(&self) -> &'static str {
        "clamp"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let (low, high) = (T::lit(self.low), T::lit(self.high));
        vec![cx.wrt(0, || cx.cotangent_factor() * cx.input(0).constant_map(|x| if x >= low && x <= high { T::one() } else { T::zero() }))]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns y = xⁿ for an integer n, which may be negative.   ∂L/∂x = ∂L/∂y · n xⁿ⁻¹
    pub fn powi(&self, n: i32) -> Self {
        unary(self, Powi(n), move |x: T| x.powi(n))
    }

    /// Returns y = x where x >= 0, y = slope · x where x < 0, and NaN where x is NaN.   ∂L/∂x = ∂L/∂y where x >= 0, else slope · ∂L/∂y
    pub fn leaky_relu(&self, slope: f64) -> Self {
        let factor = T::lit(slope);
        unary(self, LeakyRelu { slope }, move |x: T| if x < T::zero() { factor * x } else { x })
    }

    /// Returns y = min(max(x, low), high).   ∂L/∂x = ∂L/∂y where low <= x <= high, else 0
    pub fn clamp(&self, low: f64, high: f64) -> Self {
        let (a, b) = (T::lit(low), T::lit(high));
        unary(self, Clamp { low, high }, move |x: T| {
            if x < a {
                a
            } else if x > b {
                b
            } else {
                x
            }
        })
    }

    /// Returns the sign of each element, −1, 0 or 1, as a constant. The result is 0 where x is NaN.
    pub fn sign(&self) -> Self {
        self.constant_map(|x| {
            if x > T::zero() {
                T::one()
            } else if x < T::zero() {
                -T::one()
            } else {
                T::zero()
            }
        })
    }

    /// Returns f(x), elementwise, as a constant. It is for functions without a gradient, such as masks, rounding and signs.
    pub fn constant_map(&self, f: impl Fn(T) -> T + Sync) -> Self {
        let mut out = Buffer::stale(self.len());
        parallel::map(self.data(), &mut out, f);
        Tensor::from_buffer(out, self.shape())
    }
}

/// Computes f(x), elementwise, and records it as `op`.
pub(crate) fn unary<T: Real>(x: &Tensor<T>, op: impl Op<T>, f: impl Fn(T) -> T + Sync) -> Tensor<T> {
    let mut out = Buffer::stale(x.len());
    parallel::map(x.data(), &mut out, f);
    Tensor::from_op(out, x.shape(), &[x], op)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sines_beyond_the_range_of_the_polynomials_are_the_librarys() {
        let x = [0.5f32, 1e6, -1e7, 3e30, f32::INFINITY, f32::NAN, -2.0];
        let (sine, cosine) = (Tensor::from_vec(x.to_vec(), &[7]).sin(), Tensor::from_vec(x.to_vec(), &[7]).cos());
        for (i, x) in x.into_iter().enumerate() {
            if x.is_finite() {
                assert!((f64::from(sine.data()[i]) - f64::from(x).sin()).abs() < 1e-7, "sin {x}");
                assert!((f64::from(cosine.data()[i]) - f64::from(x).cos()).abs() < 1e-7, "cos {x}");
            } else {
                assert!(sine.data()[i].is_nan() && cosine.data()[i].is_nan());
            }
        }
    }

    /// In release builds the left side is compiled for this machine's instruction set.
    #[test]
    fn functions_without_fused_operations_have_the_same_bits_in_every_instruction_set() {
        let x = crate::random::Stream::new(1).uniform_tensor::<f32>(&[1003], -9.0, 9.0);
        let wide = Tensor::from_vec(x.data().iter().map(|&x| f64::from(x)).collect(), &[1003]);
        let check = |name, single: (Tensor<f32>, fn(f32) -> f32), double: (Tensor<f64>, fn(f64) -> f64)| {
            assert!(single.0.data().iter().zip(x.data()).all(|(y, &x)| y.to_bits() == single.1(x).to_bits()), "{name} in f32");
            assert!(double.0.data().iter().zip(wide.data()).all(|(y, &x)| y.to_bits() == double.1(x).to_bits()), "{name} in f64");
        };
        check("sin", (x.sin(), Real::sin_), (wide.sin(), Real::sin_));
        check("cos", (x.cos(), Real::cos_), (wide.cos(), Real::cos_));
        check("tanh", (x.tanh(), Real::tanh_), (wide.tanh(), Real::tanh_));
        check("expm1", (x.expm1(), Real::expm1_), (wide.expm1(), Real::expm1_));
    }
}
