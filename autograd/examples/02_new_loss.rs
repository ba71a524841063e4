//! A custom loss. A loss is a function of tensors. The robust loss of this example fits a line to points and ignores an outlier.

use autograd::optim::{Adam, AdamMode, Exponential, Optimizer};
use autograd::{Param, Real, Tensor, value_and_grad};
use ndarray::arr1;

/// The Charbonnier loss: quadratic for errors well below `scale`, linear for errors well above it, and smooth.
fn charbonnier<T: Real>(prediction: &Tensor<T>, target: &Tensor<T>, scale: f64) -> Tensor<T> {
    let error = prediction - target;
    (error.square() + scale * scale).sqrt().mean()
}

fn mean_squared<T: Real>(prediction: &Tensor<T>, target: &Tensor<T>, _: f64) -> Tensor<T> {
    (prediction - target).square().mean()
}

type Loss = fn(&Tensor<f64>, &Tensor<f64>, f64) -> Tensor<f64>;

/// Returns the slope and the offset of the line that minimizes a loss.
fn fit(loss: Loss) -> [f64; 2] {
    // y = 2x + 1, except for the last point.
    let x = Tensor::constant(arr1(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]));
    let y = Tensor::constant(arr1(&[1.0, 3.0, 5.0, 7.0, 9.0, -20.0]));
    let mut line = vec![Param::new("slope", arr1(&[0.0])), Param::new("offset", arr1(&[0.0]))];
    let mut adam = Adam::new(Exponential::new(0.3, 1e-4, 2000), AdamMode::Dense);
    for step in 0..2000 {
        let (_, gradients) = value_and_grad(|| loss(&(&x * line[0].tensor() + line[1].tensor()), &y, 0.01));
        adam.step(&mut line, &gradients, step);
    }
    [line[0].tensor().item(), line[1].tensor().item()]
}

pub fn main() {
    let [robust, squared] = [fit(charbonnier), fit(mean_squared)];
    println!("Charbonnier: y = {:.3} x + {:.3};  mean square: y = {:.3} x + {:.3}", robust[0], robust[1], squared[0], squared[1]);
    assert!((robust[0] - 2.0).abs() < 0.02 && (robust[1] - 1.0).abs() < 0.02);
    assert!((squared[0] - 2.0).abs() > 1.0, "the mean square error should follow the outlier");
}
