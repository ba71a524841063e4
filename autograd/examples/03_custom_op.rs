//! An op of your own: how it is computed, and its rule. The rule is written in tensor ops, so it can be differentiated again.

use autograd::{Cotangent, Keep, Op, Real, Tensor, Vjp, grad, gradcheck};
use ndarray::arr1;

/// y = tanh x.   ∂L/∂x = ∂L/∂y · (1 − y²)
fn tanh<T: Real>(x: &Tensor<T>) -> Tensor<T> {
    let values: Vec<T> = x.data().iter().map(|x| x.tanh()).collect();
    Tensor::from_op(values.into(), x.shape(), &[x], Tanh)
}

#[derive(Debug)]
struct Tanh;
impl<T: Real> Op<T> for Tanh {
    fn name(&self) -> &'static str {
        "tanh"
    }
    fn keep(&self) -> Keep {
        Keep::OUTPUT
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent() * (1.0 - cx.output().square()))]
    }
}

pub fn main() {
    // First and second derivatives against finite differences; panics with op, entry and both numbers if one is wrong.
    let report = gradcheck(|x| tanh(&x[0]), [arr1(&[-1.5, 0.2, 0.9]).into_dyn()]);
    println!("tanh: worst relative error {:.1e}", report.worst_relative_error);

    let x = Tensor::variable(arr1(&[0.5]));
    let slope = grad(&tanh(&x).sum(), &[&x]).remove(0);
    let curvature = grad(&slope.sum(), &[&x]).remove(0);
    println!("at 0.5: slope {:.6}, curvature {:.6}", slope.item(), curvature.item());
    let t = 0.5f64.tanh();
    assert!((slope.item() - (1.0 - t * t)).abs() < 1e-15);
    assert!((curvature.item() + 2.0 * t * (1.0 - t * t)).abs() < 1e-15);
}
