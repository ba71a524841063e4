//! A kernel with three inputs, any of which may need a gradient: a linear layer, x W + b, in one loop.

use autograd::{Buffer, GradSink, Kernel, KernelCall, Real, Tensor, check_kernel, gradcheck, parallel, random::Stream};

/// Returns y = x W + b, of shape `[n, outputs]`, for x `[n, inputs]`, W `[inputs, outputs]` and b `[outputs]`.
fn fused_layer<T: Real>(x: &Tensor<T>, weight: &Tensor<T>, bias: &Tensor<T>) -> Tensor<T> {
    let (n, inputs, outputs) = (x.shape()[0], x.shape()[1], bias.len());
    let mut y = Buffer::stale(n * outputs);
    // Each row of y is initialized with b. Then each row of W is added, times the corresponding entry of the row of x.
    parallel::for_each_rows(&mut y, outputs, |first, rows| {
        for (y, x) in rows.chunks_exact_mut(outputs).zip(x.data()[first * inputs..].chunks_exact(inputs)) {
            y.copy_from_slice(bias.data());
            add_combination(y, x, weight.data());
        }
    });
    Tensor::from_kernel(y, &[n, outputs], &[x, weight, bias], FusedLayer)
}

/// Adds Σ shareᵢ · rowᵢ to `out`.
fn add_combination<T: Real>(out: &mut [T], shares: &[T], rows: &[T]) {
    for (&share, row) in shares.iter().zip(rows.chunks_exact(out.len())) {
        out.iter_mut().zip(row).for_each(|(o, &v)| *o += share * v);
    }
}

#[derive(Debug)]
struct FusedLayer;
impl<T: Real> Kernel<T> for FusedLayer {
    fn name(&self) -> &'static str {
        "fused_layer"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        inputs[0].matmul(&inputs[1]) + &inputs[2]
    }

    /// With G = ∂L/∂y:  ∂L/∂x = G Wᵀ, ∂L/∂W = xᵀ G, ∂L/∂b = Σ G over the rows. [`KernelCall::needs`] tells which of them are needed.
    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (x, weight, g) = (call.input(0), call.input(1), call.cotangent());
        let (inputs, outputs) = (weight.shape()[0], weight.shape()[1]);
        if call.needs(0) {
            let mut slope = Buffer::zeros(x.len());
            parallel::for_each_rows(&mut slope, inputs, |first, rows| {
                for (slope, g) in rows.chunks_exact_mut(inputs).zip(g.data()[first * outputs..].chunks_exact(outputs)) {
                    for (s, w) in slope.iter_mut().zip(weight.data().chunks_exact(outputs)) {
                        *s = g.iter().zip(w).map(|(&g, &w)| g * w).sum();
                    }
                }
            });
            out.dense(0, slope);
        }
        if call.needs(1) {
            let mut slope = Buffer::zeros(weight.len());
            // Row i of the gradient of W is Σ xₙᵢ gₙ, summed over n.
            parallel::for_each_rows(&mut slope, outputs, |first, rows| {
                for (i, slope) in rows.chunks_exact_mut(outputs).enumerate() {
                    let column: Vec<T> = x.data().iter().skip(first + i).step_by(inputs).copied().collect();
                    add_combination(slope, &column, g.data());
                }
            });
            out.dense(1, slope);
        }
        if call.needs(2) {
            out.dense(2, Buffer::copy_of(g.sum_axis(0).data()));
        }
    }
}

pub fn main() {
    let layer = |x: &[Tensor<f64>]| fused_layer(&x[0], &x[1], &x[2]);
    let random = |name, shape: &[usize]| Stream::new(7).named(name).uniform_tensor::<f64>(shape, -1.0, 1.0).to_array();
    let inputs = [random("x", &[50, 7]), random("weight", &[7, 4]), random("bias", &[4])];

    // Compares the value and the gradient of each input with the reference, with all inputs tracked and with the other inputs constant.
    let report = check_kernel(layer, inputs.clone(), 1e-13).unwrap_or_else(|error| panic!("{error}"));
    for (name, gradient) in ["x", "W", "b"].iter().zip(&report.gradients) {
        println!("{name}: {gradient}");
    }
    // Second derivatives, including the mixed derivatives with respect to x and W, are computed through the reference.
    let report = gradcheck(|x| layer(x).tanh(), inputs);
    println!("worst relative errors of first and second derivatives: {:.0e}, {:.0e}", report.by_order[0], report.by_order[1]);
}
