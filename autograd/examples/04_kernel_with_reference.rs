//! A kernel: one loop instead of five ops, a hand-written adjoint, and the reference that both are compared with.

use autograd::{Buffer, GradSink, Kernel, KernelCall, Real, Tensor, check_kernel, grad};
use ndarray::{Array2, arr2};

/// Returns yᵣ = ln Σc e^x[r, c], of shape `[rows]`, for x of shape `[rows, columns]`.
fn log_sum_exp<T: Real>(x: &Tensor<T>) -> Tensor<T> {
    let row_value = |row: &[T]| {
        let largest = row.iter().copied().fold(T::neg_infinity(), T::max);
        largest + row.iter().map(|&x| (x - largest).exp()).sum::<T>().ln()
    };
    let values: Vec<T> = x.data().chunks_exact(x.shape()[1]).map(row_value).collect();
    Tensor::from_kernel(values.into(), &[x.shape()[0]], &[x], LogSumExp)
}

#[derive(Debug)]
struct LogSumExp;
impl<T: Real> Kernel<T> for LogSumExp {
    fn name(&self) -> &'static str {
        "log_sum_exp"
    }

    /// The reference: this function in small ops. Second derivatives are computed through it.
    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        inputs[0].log_sum_exp(1)
    }

    /// ∂L/∂x[r, c] = ∂L/∂yᵣ · e^(x[r, c] − yᵣ)
    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (x, g) = (call.input(0), call.cotangent());
        let y = log_sum_exp(&x);
        let mut gradient = Buffer::stale(x.len());
        let columns = x.shape()[1];
        for (i, (slope, &x)) in gradient.iter_mut().zip(x.data()).enumerate() {
            *slope = g.data()[i / columns] * (x - y.data()[i / columns]).exp();
        }
        out.dense(0, gradient);
    }
}

pub fn main() {
    let x = Array2::from_shape_fn((50, 7), |(r, c)| ((r * 7 + c) as f64 * 1.7).sin() * 4.0);
    for (precision, report) in [
        ("f64", check_kernel(|x: &[Tensor<f64>]| log_sum_exp(&x[0]), [x.clone().into_dyn()], 1e-13)),
        ("f32", check_kernel(|x: &[Tensor<f32>]| log_sum_exp(&x[0]), [x.mapv(|v| v as f32).into_dyn()], 2e-6)),
    ] {
        let report = report.unwrap_or_else(|error| panic!("{error}"));
        println!("{precision}: value: {};  gradient: {}", report.value, report.gradients[0]);
    }

    // For two equal numbers, the softmax p is ½ for each, and the Hessian is diag(p) − p pᵀ.
    let x = Tensor::variable(arr2(&[[1.0f64, 1.0]]));
    let softmax = grad(&log_sum_exp(&x).sum(), &[&x]).remove(0);
    let row = grad(&softmax.narrow(1, 0, 1).sum(), &[&x]).remove(0);
    println!("softmax {:?}, first row of the Hessian {:?}", softmax.data(), row.data());
    assert!((row.data()[0] - 0.25).abs() < 1e-15 && (row.data()[1] + 0.25).abs() < 1e-15);
}
