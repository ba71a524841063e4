//! A custom op: the computation and the gradient rule. The rule is written in tensor ops, so it can be differentiated again.

use autograd::{Cotangent, Keep, Op, Real, Tensor, Vjp, grad, gradcheck};
use ndarray::arr1;

/// y = arctan x.   ∂L/∂x = ∂L/∂y / (1 + x²)
fn arctan<T: Real>(x: &Tensor<T>) -> Tensor<T> {
    let values: Vec<T> = x.data().iter().map(|x| x.atan()).collect();
    Tensor::from_op(values.into(), x.shape(), &[x], Arctan)
}

#[derive(Debug)]
struct Arctan;
impl<T: Real> Op<T> for Arctan {
    fn name(&self) -> &'static str {
        "arctan"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent() / (cx.input(0).square() + 1.0))]
    }
}

pub fn main() {
    // Compares first and second derivatives with finite differences. It panics with the order, the input and both numbers if a derivative is wrong.
    let report = gradcheck(|x| arctan(&x[0]), [arr1(&[-1.5, 0.2, 0.9]).into_dyn()]);
    println!("arctan: worst relative error {:.1e}", report.worst_relative_error);

    let x = Tensor::variable(arr1(&[0.5f64]));
    let slope = grad(&arctan(&x).sum(), &[&x]).remove(0);
    let curvature = grad(&slope.sum(), &[&x]).remove(0);
    println!("at 0.5: slope {:.6}, curvature {:.6}", slope.item(), curvature.item());
    // 1 / (1 + x²) and −2x / (1 + x²)²
    assert!((slope.item() - 0.8).abs() < 1e-15);
    assert!((curvature.item() + 0.64).abs() < 1e-15);
}
