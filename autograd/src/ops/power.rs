//! Powers with real exponents.

use super::arithmetic::binary;
use super::elementwise::unary;
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::real::Real;
use crate::tensor::Tensor;

/// z = xʸ.   ∂L/∂x = ∂L/∂z · y xʸ⁻¹, ∂L/∂y = ∂L/∂z · z ln x
#[derive(Debug)]
struct Pow;
impl<T: Real> Op<T> for Pow {
    fn name(&self) -> &'static str {
        "pow"
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let g = cx.cotangent();
        vec![cx.wrt(0, || g * (cx.input(1) * cx.input(0).pow(&(cx.input(1) - 1.0)))), cx.wrt(1, || g * (cx.output() * cx.input(0).ln()))]
    }
}

/// y = xᵖ for a number p.   ∂L/∂x = ∂L/∂y · p xᵖ⁻¹
#[derive(Debug)]
struct Powf(f64);
impl<T: Real> Op<T> for Powf {
    fn name(&self) -> &'static str {
        "powf"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || match self.0 {
            0.0 => Tensor::zeros(cx.input_shape(0)),
            p => cx.cotangent_factor() * (p * cx.input(0).powf(p - 1.0)),
        })]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns z = xʸ for x > 0, elementwise with broadcasting; x is `self`.   ∂L/∂x = ∂L/∂z · y xʸ⁻¹, ∂L/∂y = ∂L/∂z · z ln x
    ///
    /// Where x = 0, the gradients may be infinite or NaN. Where x < 0, the gradient with respect to y is NaN.
    ///
    /// Panics if the shapes do not broadcast.
    #[track_caller]
    pub fn pow(&self, exponent: &Self) -> Self {
        binary("pow", self, exponent, Pow, |x, y| x.powf(y))
    }

    /// Returns y = xᵖ for x > 0 and a number p, which is rounded to the precision of x.   ∂L/∂x = ∂L/∂y · p xᵖ⁻¹
    ///
    /// Where x = 0, the gradient is infinite if p < 1 and p is not 0. Where x < 0, the result is NaN unless p is an integer; use [`Tensor::powi`] for integers.
    pub fn powf(&self, p: f64) -> Self {
        let exponent = T::lit(p);
        unary(self, Powf(p), move |x: T| x.powf(exponent))
    }
}
