//! Comparisons and choices. A mask is a constant tensor of ones and zeros.

use super::arithmetic::{binary, broadcast_shape};
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::real::Real;
use crate::tensor::Tensor;

/// A comparison: constant, so its rule is never run.
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

/// z = mask · x, and 0 where the mask is 0 even if x is not finite there.
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
    /// 1 where x >= y and 0 elsewhere, with broadcasting: a constant.
    #[track_caller]
    pub fn greater_equal(&self, other: &Self) -> Self {
        compare("greater_equal", self, other, |x, y| x >= y)
    }

    /// 1 where x > y and 0 elsewhere, with broadcasting: a constant.
    #[track_caller]
    pub fn greater(&self, other: &Self) -> Self {
        compare("greater", self, other, |x, y| x > y)
    }

    /// 1 where x = y and 0 elsewhere, with broadcasting: a constant.
    #[track_caller]
    pub fn equal(&self, other: &Self) -> Self {
        compare("equal", self, other, |x, y| x == y)
    }

    /// x where the mask is not 0, and 0 elsewhere, even where x is infinite or NaN. The mask broadcasts to x.
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

    /// x where the mask is not 0, y elsewhere. Neither's infinities leak into the other's places, in value or gradient.
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
