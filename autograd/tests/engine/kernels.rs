//! Kernels with several inputs.

use autograd::{Buffer, GradSink, Gradcheck, Kernel, KernelCall, Tensor, check_kernel, grad};
use ndarray::arr1;

/// y = a x + b, elementwise. The adjoint computes the cotangents that are needed. A careless adjoint omits the cotangent of `a` if `x` is a constant.
#[derive(Debug)]
struct MultiplyAdd {
    careless: bool,
}
impl Kernel<f64> for MultiplyAdd {
    fn name(&self) -> &'static str {
        "multiply_add"
    }
    fn reference(&self, inputs: &[Tensor<f64>]) -> Tensor<f64> {
        &inputs[0] * &inputs[1] + &inputs[2]
    }
    fn vjp(&self, call: &KernelCall<'_, f64>, out: &mut GradSink<f64>) {
        let g = call.cotangent();
        let times = |i: usize| Buffer::copy_of((g * call.input(i)).data());
        if call.needs(0) && (call.needs(1) || !self.careless) {
            out.dense(0, times(1));
        }
        if call.needs(1) {
            out.dense(1, times(0));
        }
        if call.needs(2) {
            out.dense(2, Buffer::copy_of(g.data()));
        }
    }
}

fn multiply_add(a: &Tensor<f64>, x: &Tensor<f64>, b: &Tensor<f64>, careless: bool) -> Tensor<f64> {
    let y: Vec<f64> = a.data().iter().zip(x.data()).zip(b.data()).map(|((a, x), b)| a * x + b).collect();
    Tensor::from_kernel(y.into(), x.shape(), &[a, x, b], MultiplyAdd { careless })
}

fn inputs() -> [ndarray::ArrayD<f64>; 3] {
    [[2.0, -1.0], [0.5, 3.0], [1.0, 0.25]].map(|x| arr1(&x).into_dyn())
}

#[test]
fn all_derivatives_of_both_orders_are_right_for_three_inputs() {
    let y = |x: &[Tensor<f64>]| multiply_add(&x[0], &x[1], &x[2], false);
    assert_eq!(check_kernel(y, inputs(), 1e-14).expect("a right kernel").gradients.len(), 3);
    Gradcheck::new(move |x| y(x).exp(), inputs()).order(3).run().expect("right derivatives");
}

#[test]
fn each_subset_of_the_inputs_may_be_tracked() {
    let constants = inputs().map(Tensor::constant);
    let want = [[0.5, 3.0], [2.0, -1.0], [1.0, 1.0]];
    for subset in 1..8 {
        let x: [Tensor<f64>; 3] =
            std::array::from_fn(|i| if subset >> i & 1 == 1 { constants[i].clone().into_variable() } else { constants[i].clone() });
        let y = multiply_add(&x[0], &x[1], &x[2], false).sum();
        let (gradients, slopes) = (y.backward(), grad(&y, &[&x[0], &x[1], &x[2]]));
        for i in 0..3 {
            let want = if x[i].is_tracked() { want[i] } else { [0.0; 2] };
            assert_eq!((gradients.array(&x[i]).as_slice(), slopes[i].data()), (Some(&want[..]), &want[..]), "input {i} of subset {subset}");
        }
    }
}

#[test]
fn one_tensor_may_be_several_inputs() {
    let x = Tensor::variable(arr1(&[2.0, -1.0]));
    let y = multiply_add(&x, &x, &x, false).sum();
    // y = x² + x
    assert_eq!(y.backward().array(&x).as_slice(), Some(&[5.0, -1.0][..]));
    let slope = grad(&y, &[&x]).remove(0);
    assert_eq!(slope.data(), [5.0, -1.0]);
    assert_eq!(slope.sum().backward().array(&x).as_slice(), Some(&[2.0, 2.0][..]));
}

/// With all inputs tracked the gradient is correct. Earlier versions of the check tested only that case.
#[test]
fn a_gradient_that_is_lost_when_others_are_not_wanted_is_found() {
    let error = check_kernel(|x| multiply_add(&x[0], &x[1], &x[2], true), inputs(), 1e-14).expect_err("a lost gradient").to_string();
    assert!(error.contains("multiply_add") && error.contains("input 0 with the other inputs constant"), "{error}");
}
