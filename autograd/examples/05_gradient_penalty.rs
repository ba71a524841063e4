//! A loss that contains a gradient: a small network learns the signed distance to a circle. The loss requires only that the function is 0 on the circle and
//! that its gradient has length 1 everywhere (the eikonal equation; Gropp et al. 2020).

use autograd::optim::{Adam, AdamMode, Exponential, Optimizer};
use autograd::{Param, Real, Tensor, grad, value_and_grad};
use ndarray::{Array1, Array2, arr1, arr2};
use std::f64::consts::TAU;

/// A network with one hidden layer, `[n, 2]` to `[n]`. The activation is softplus, because the loss needs second derivatives.
fn field<T: Real>(x: &Tensor<T>, net: &[Param<T>]) -> Tensor<T> {
    let hidden = (x.matmul(net[0].tensor()) + net[1].tensor()).softplus();
    hidden.matmul(net[2].tensor()).sum_axis(1) + net[3].tensor()
}

/// The eikonal loss, the mean of (|∇f| − 1)².
fn eikonal<T: Real>(x: &Tensor<T>, net: &[Param<T>]) -> Tensor<T> {
    let x = x.clone().into_variable();
    let slope = &grad(&field(&x, net).sum(), &[&x])[0];
    ((slope.square().sum_axis(1) + 1e-12).sqrt() - 1.0).square().mean()
}

pub fn main() {
    const HIDDEN: usize = 24;
    // Unit vectors in all directions, and points that multiples of the golden ratio distribute over a square.
    let directions = |n: usize| Array2::from_shape_fn((n, 2), |(i, axis)| (TAU * (i as f64 / n as f64 - axis as f64 / 4.0)).cos());
    let spread = |i: usize| 2.0 * (i as f64 * 0.618_033_988_75).fract() - 1.0;
    let circle = Tensor::constant(directions(64));
    let around = Tensor::constant(Array2::from_shape_fn((200, 2), |(i, axis)| 1.8 * spread(i * [1, 13][axis])));
    let mut net = vec![
        Param::new("w1", directions(HIDDEN).t().mapv(|w| 4.0 * w)),
        Param::new("b1", Array1::from_shape_fn(HIDDEN, |h| 2.0 * spread(h))),
        Param::new("w2", Array2::from_elem((HIDDEN, 1), 0.02)),
        Param::new("b2", arr1(&[-0.5])),
    ];

    let before = eikonal(&around, &net).item();
    let mut adam = Adam::new(Exponential::new(0.02, 0.001, 400), AdamMode::Dense);
    for step in 0..400 {
        let (_, gradients) = value_and_grad(|| field(&circle, &net).square().mean() + 0.1 * eikonal(&around, &net));
        adam.step(&mut net, &gradients, step);
    }
    let after = eikonal(&around, &net).item();

    // Points half a radius outside and inside the circle. Only the eikonal loss constrains the values there.
    let distances = field(&Tensor::constant(arr2(&[[1.5, 0.0], [0.5, 0.0]])), &net);
    println!("mean (|∇f| − 1)²: {before:.3}, then {after:.3};  f at radius 1.5 and 0.5: {:.2?}", distances.data());
    assert!(before > 0.1 && after < 0.05);
    assert!((distances.data()[0] - 0.5).abs() < 0.1 && (distances.data()[1] + 0.5).abs() < 0.1);
}
