//! Comparisons and selection by masks. A mask is a constant tensor of ones and zeros.

use super::arithmetic::{binary, broadcast_shape};
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::real::Real;
use crate::tensor::Tensor;

/// A comparison. Its inputs are detached, so it is never recorded and its rule never runs.
#[derive(Debug)]
struct Compare;
impl<T: Real> Op<T> for Compare {
    fn name(&self) -> &'static str {
        "compare"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, _: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![None, None]
    }
}

/// z = x where the mask is not 0, else 0, even if x is infinite or NaN there.   ∂L/∂x = ∂L/∂z, masked in the same way
#[derive(Debug)]
struct Masked<T: Real> {
    mask: Tensor<T>,
}
impl<T: Real> Op<T> for Masked<T> {
    fn name(&self) -> &'static str {
        "masked"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().masked(&self.mask))]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns a constant mask with broadcasting: 1 where x >= y, else 0.
    ///
    /// Panics if the shapes do not broadcast.
    #[track_caller]
    pub fn greater_equal(&self, other: &Self) -> Self {
        compare("greater_equal", self, other, |x, y| x >= y)
    }

    /// Returns a constant mask with broadcasting: 1 where x > y, else 0.
    ///
    /// Panics if the shapes do not broadcast.
    #[track_caller]
    pub fn greater(&self, other: &Self) -> Self {
        compare("greater", self, other, |x, y| x > y)
    }

    /// Returns a constant mask with broadcasting: 1 where x = y, else 0.
    ///
    /// Panics if the shapes do not broadcast.
    #[track_caller]
    pub fn equal(&self, other: &Self) -> Self {
        compare("equal", self, other, |x, y| x == y)
    }

    /// Returns x where the mask is not 0, and 0 elsewhere, even if x is infinite or NaN there.
    ///
    /// Panics if the mask does not broadcast to the shape of x.
    #[track_caller]
    pub fn masked(&self, mask: &Self) -> Self {
        assert_eq!(
            broadcast_shape(self.shape(), mask.shape()).as_deref(),
            Some(self.shape()),
            "masked: a mask of shape {:?} does not broadcast to {:?}",
            mask.shape(),
            self.shape()
        );
        let value = binary("masked", &self.detach(), &mask.detach(), Compare, |x, m| if m != T::zero() { x } else { T::zero() });
        let keep = Keep::NOTHING;
        value.recorded(&[self], keep, || crate::graph::Rule::Op(Box::new(Masked { mask: mask.detach() })))
    }

    /// Returns x where the mask is not 0, and y elsewhere. An infinite or NaN value that is not selected affects neither the result nor the gradient.
    ///
    /// Panics if the shapes do not fit.
    #[track_caller]
    pub fn where_(mask: &Self, x: &Self, y: &Self) -> Self {
        let otherwise = mask.constant_map(|m| if m != T::zero() { T::zero() } else { T::one() });
        x.masked(mask) + y.masked(&otherwise)
    }
}

#[track_caller]
fn compare<T: Real>(name: &str, x: &Tensor<T>, y: &Tensor<T>, f: impl Fn(T, T) -> bool + Sync) -> Tensor<T> {
    binary(name, &x.detach(), &y.detach(), Compare, |x, y| if f(x, y) { T::one() } else { T::zero() })
}
