//! The rows of the table, in the order of the list of ops.

use crate::table::*;
use autograd::Tensor;
use autograd::nn::Activation;
use ndarray::ArrayD;

/// Each row is `op, case, [inputs], function` and, for a function with kinks, a kink function that is zero at them.
macro_rules! rows {
    ($($op:literal, $case:literal, [$($input:expr),*], $f:expr $(, kinks: $kinks:expr)?;)*) => {
        vec![$(Row {
            op: $op,
            case: $case,
            double: $f,
            single: $f,
            inputs: vec![$($input),*],
            kinks: [$($kinks as Function<f64>)?].first().copied(),
        }),*]
    };
}

pub fn all() -> Vec<Row> {
    [
        arithmetic(),
        elementwise(),
        power(),
        reduce(),
        normalization(),
        shape(),
        linalg(),
        scan(),
        segment(),
        lookup(),
        trilinear(),
        select(),
        networks(),
        compositions(),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn arithmetic() -> Vec<Row> {
    rows! {
        "+", "same shape", [numbers(&[2, 3], 1), numbers(&[2, 3], 2)], |x| (&x[0] + &x[1]).square();
        "+", "[2, 3] + [3]", [numbers(&[2, 3], 1), numbers(&[3], 2)], |x| (&x[0] + &x[1]).square();
        "+", "[2, 1] + [1, 3]", [numbers(&[2, 1], 1), numbers(&[1, 3], 2)], |x| (&x[0] + &x[1]).square();
        "+", "[2, 3, 4] + [3, 1]", [numbers(&[2, 3, 4], 1), numbers(&[3, 1], 2)], |x| (&x[0] + &x[1]).square();
        "+", "[] + [2, 3]", [numbers(&[], 1), numbers(&[2, 3], 2)], |x| (&x[0] + &x[1]).square();
        "+", "numbers on either side", [numbers(&[4], 1)], |x| 1.0 + (&x[0] + 2.5).square();
        "-", "same shape", [numbers(&[2, 3], 1), numbers(&[2, 3], 2)], |x| (&x[0] - &x[1]).square();
        "-", "[3] - [2, 3]", [numbers(&[3], 1), numbers(&[2, 3], 2)], |x| (&x[0] - &x[1]).square();
        "-", "numbers on either side", [numbers(&[4], 1)], |x| (1.0 - (&x[0] - 2.5)).square();
        "-", "in front", [numbers(&[4], 1)], |x| (-&x[0]) * x[0].square();
        "*", "same shape", [numbers(&[2, 3], 1), numbers(&[2, 3], 2)], |x| &x[0] * &x[1];
        "*", "[4, 3] * [4, 1]", [numbers(&[4, 3], 1), numbers(&[4, 1], 2)], |x| &x[0] * &x[1];
        "*", "[3] * [2, 3]", [numbers(&[3], 1), numbers(&[2, 3], 2)], |x| &x[0] * &x[1];
        "*", "[2, 3, 4] * [2, 1, 4]", [numbers(&[2, 3, 4], 1), numbers(&[2, 1, 4], 2)], |x| &x[0] * &x[1];
        "*", "[1, 1] * []", [numbers(&[1, 1], 1), numbers(&[], 2)], |x| &x[0] * &x[1];
        "*", "one tensor twice", [numbers(&[4], 1)], |x| &x[0] * &x[0];
        "*", "numbers on either side", [numbers(&[4], 1)], |x| 2.0 * (&x[0] * -1.5).square();
        "/", "same shape", [numbers(&[2, 3], 1), numbers(&[2, 3], 2)], |x| &x[0] / &x[1];
        "/", "[2, 3] / [3]", [numbers(&[2, 3], 1), numbers(&[3], 2)], |x| &x[0] / &x[1];
        "/", "[3] / [2, 3]", [numbers(&[3], 1), numbers(&[2, 3], 2)], |x| &x[0] / &x[1];
        "/", "numbers on either side", [numbers(&[4], 1)], |x| 2.0 / (&x[0] / 1.5);
        "affine", "a x + b", [numbers(&[4], 1)], |x| x[0].affine(2.0, -0.5).square();
        "maximum", "[2, 3] and [3]", [numbers(&[2, 3], 1), numbers(&[3], 5)], |x| x[0].maximum(&x[1]).square(), kinks: |x| &x[0] - &x[1];
        "minimum", "[2, 3] and []", [numbers(&[2, 3], 1), numbers(&[], 5)], |x| x[0].minimum(&x[1]).square(), kinks: |x| &x[0] - &x[1];
    }
}

fn elementwise() -> Vec<Row> {
    rows! {
        "exp", "both signs", [numbers(&[2, 3], 3)], |x| x[0].exp();
        "expm1", "both signs", [numbers(&[2, 3], 3)], |x| x[0].expm1();
        "one_minus_exp_neg", "both signs", [numbers(&[2, 3], 3)], |x| x[0].one_minus_exp_neg();
        "one_minus_exp_neg", "at 0", [ArrayD::zeros(vec![3])], |x| x[0].one_minus_exp_neg() + 1.0;
        "ln", "x > 0", [positive(&[2, 3], 3)], |x| x[0].ln();
        "sqrt", "x > 0", [positive(&[2, 3], 3)], |x| x[0].sqrt();
        "square", "both signs", [numbers(&[2, 3], 3)], |x| x[0].square();
        "abs", "both signs", [numbers(&[2, 3], 3)], |x| x[0].abs() * &x[0], kinks: |x| x[0].clone();
        "sign", "constant", [numbers(&[2, 3], 3)], |x| x[0].sign(), kinks: |x| x[0].clone();
        "constant_map", "constant", [numbers(&[2, 3], 3)], |x| x[0].constant_map(|x| x.floor()), kinks: |x| at_integers(&x[0]);
        "sigmoid", "both signs", [numbers(&[2, 3], 3)], |x| x[0].sigmoid();
        "softplus", "both signs", [numbers(&[2, 3], 3)], |x| x[0].softplus();
        "relu", "both signs", [numbers(&[2, 3], 3)], |x| x[0].relu().square(), kinks: |x| x[0].clone();
        "leaky_relu", "both signs", [numbers(&[2, 3], 3)], |x| x[0].leaky_relu(0.1).square(), kinks: |x| x[0].clone();
        "tanh", "both signs", [numbers(&[2, 3], 3)], |x| x[0].tanh();
        "clamp", "inside and on both sides", [numbers(&[3, 5], 3)], |x| x[0].clamp(-0.8, 0.7).square(), kinks: |x| (&x[0] + 0.8) * (&x[0] - 0.7);
        "sin", "both signs", [numbers(&[2, 3], 3)], |x| x[0].sin();
        "cos", "both signs", [numbers(&[2, 3], 3)], |x| x[0].cos();
        "powi", "3", [numbers(&[2, 3], 3)], |x| x[0].powi(3);
        "powi", "-2", [numbers(&[2, 3], 3)], |x| x[0].powi(-2);
        "powi", "1", [numbers(&[2, 3], 3)], |x| x[0].powi(1).square();
        "powi", "0", [numbers(&[2, 3], 3)], |x| x[0].powi(0) * &x[0];
    }
}

fn power() -> Vec<Row> {
    rows! {
        "pow", "same shape", [positive(&[2, 3], 19), numbers(&[2, 3], 20)], |x| x[0].pow(&x[1]);
        "pow", "[2, 3] to the power [3]", [positive(&[2, 3], 19), numbers(&[3], 20)], |x| x[0].pow(&x[1]);
        "pow", "[3] to the power [2, 1]", [positive(&[3], 19), numbers(&[2, 1], 20)], |x| x[0].pow(&x[1]);
        "powf", "2.2", [positive(&[2, 3], 19)], |x| x[0].powf(2.2);
        "powf", "-0.5", [positive(&[2, 3], 19)], |x| x[0].powf(-0.5);
        "powf", "1", [positive(&[2, 3], 19)], |x| x[0].powf(1.0).square();
        "powf", "0", [positive(&[2, 3], 19)], |x| x[0].powf(0.0) * &x[0];
    }
}

fn reduce() -> Vec<Row> {
    rows! {
        "sum", "everything", [numbers(&[2, 3, 4], 4)], |x| x[0].sum().square();
        "mean", "everything", [numbers(&[2, 3, 4], 4)], |x| x[0].mean().square();
        "sum_axis", "first", [numbers(&[2, 3, 4], 4)], |x| x[0].sum_axis(0).square();
        "sum_axis", "middle", [numbers(&[2, 3, 4], 4)], |x| x[0].sum_axis(1).square();
        "sum_axis", "last", [numbers(&[2, 3, 4], 4)], |x| x[0].sum_axis(2).square();
        "sum_axis", "many short lines", [numbers(&[40, 3], 4)], |x| x[0].sum_axis(1).square();
        "mean_axis", "middle", [numbers(&[2, 3, 4], 4)], |x| x[0].mean_axis(1).square();
        "sum_to", "[3, 1]", [numbers(&[2, 3, 4], 4)], |x| x[0].sum_to(&[3, 1]).square();
        "sum_to", "[2, 1, 4]", [numbers(&[2, 3, 4], 4)], |x| x[0].sum_to(&[2, 1, 4]).square();
        "sum_to", "its own shape", [numbers(&[2, 3], 4)], |x| x[0].sum_to(&[2, 3]).square();
        "max", "everything", [distinct(&[3, 5])], |x| x[0].max().exp(), kinks: |x| differences(&x[0]);
        "min", "everything", [distinct(&[3, 5])], |x| x[0].min().exp(), kinks: |x| differences(&x[0]);
        "max_axis", "first", [distinct(&[3, 5])], |x| x[0].max_axis(0).exp(), kinks: |x| differences(&x[0]);
        "max_axis", "last", [distinct(&[3, 5])], |x| x[0].max_axis(1).exp(), kinks: |x| differences(&x[0]);
        "min_axis", "middle", [distinct(&[2, 4, 2])], |x| x[0].min_axis(1).exp(), kinks: |x| differences(&x[0]);
    }
}

fn normalization() -> Vec<Row> {
    rows! {
        "log_sum_exp", "first axis", [numbers(&[4, 3], 21)], |x| x[0].log_sum_exp(0).square();
        "log_sum_exp", "middle axis", [numbers(&[2, 4, 3], 21)], |x| x[0].log_sum_exp(1).square();
        "softmax", "first axis", [numbers(&[4, 3], 21)], |x| x[0].softmax(0).square();
        "softmax", "last axis", [numbers(&[2, 4, 3], 21)], |x| x[0].softmax(2).square();
        "norm", "first axis", [numbers(&[3, 4], 21)], |x| x[0].norm(0).exp();
        "norm", "middle axis", [numbers(&[2, 4, 3], 21)], |x| x[0].norm(1).exp();
        "normalize", "first axis", [numbers(&[3, 4], 21)], |x| x[0].normalize(0).exp();
        "normalize", "last axis", [numbers(&[2, 4, 3], 21)], |x| x[0].normalize(2).exp();
    }
}

fn shape() -> Vec<Row> {
    rows! {
        "reshape", "[2, 6] to [3, 4]", [numbers(&[2, 6], 5)], |x| x[0].reshape(&[3, 4]).square();
        "unsqueeze", "in the middle", [numbers(&[2, 3], 5)], |x| x[0].unsqueeze(1).square() * x[0].unsqueeze(0);
        "broadcast_to", "[3] to [2, 3]", [numbers(&[3], 5)], |x| x[0].broadcast_to(&[2, 3]).square();
        "broadcast_to", "[2, 1] to [4, 2, 3]", [numbers(&[2, 1], 5)], |x| x[0].broadcast_to(&[4, 2, 3]).square();
        "broadcast_to", "[] to [2, 2]", [numbers(&[], 5)], |x| x[0].broadcast_to(&[2, 2]).square();
        "permute", "[2, 0, 1]", [numbers(&[2, 3, 4], 5)], |x| x[0].permute(&[2, 0, 1]).square();
        "transpose", "times itself", [numbers(&[3, 3], 5)], |x| x[0].transpose() * &x[0];
        "narrow", "first axis", [numbers(&[4, 3], 5)], |x| x[0].narrow(0, 1, 2).square();
        "narrow", "middle axis", [numbers(&[2, 4, 3], 5)], |x| x[0].narrow(1, 2, 2).square();
        "narrow", "last axis", [numbers(&[2, 5], 5)], |x| x[0].narrow(1, 0, 3).square();
        "index_axis", "middle axis", [numbers(&[2, 4, 3], 5)], |x| x[0].index_axis(1, 3).square();
        "pad", "first axis", [numbers(&[2, 3], 5)], |x| x[0].pad(0, 1, 4).square();
        "pad", "last axis", [numbers(&[2, 3], 5)], |x| x[0].pad(1, 2, 5).square();
        "concat", "first axis", [numbers(&[2, 3], 5), numbers(&[1, 3], 6)], |x| Tensor::concat(&[&x[0], &x[1], &x[0]], 0).square();
        "concat", "last axis", [numbers(&[2, 1], 5), numbers(&[2, 3], 6)], |x| Tensor::concat(&[&x[0], &x[1]], 1).square();
        "stack", "first axis", [numbers(&[2, 3], 5), numbers(&[2, 3], 6)], |x| Tensor::stack(&[&x[0], &x[1]], 0).square();
        "stack", "last axis", [numbers(&[2, 3], 5), numbers(&[2, 3], 6)], |x| Tensor::stack(&[&x[0], &x[1]], 2).square();
    }
}

fn linalg() -> Vec<Row> {
    rows! {
        "matmul", "[2, 3] · [3, 4]", [numbers(&[2, 3], 6), numbers(&[3, 4], 7)], |x| x[0].matmul(&x[1]);
        "matmul", "[5, 2, 3] · [5, 3, 4]", [numbers(&[5, 2, 3], 6), numbers(&[5, 3, 4], 7)], |x| x[0].matmul(&x[1]);
        "matmul", "[5, 2, 3] · [3, 4]", [numbers(&[5, 2, 3], 6), numbers(&[3, 4], 7)], |x| x[0].matmul(&x[1]);
        "matmul", "[2, 3] · [5, 3, 4]", [numbers(&[2, 3], 6), numbers(&[5, 3, 4], 7)], |x| x[0].matmul(&x[1]);
        "matmul", "[2, 2, 1, 3] · [2, 2, 3, 2]", [numbers(&[2, 2, 1, 3], 6), numbers(&[2, 2, 3, 2], 7)], |x| x[0].matmul(&x[1]);
        "matmul", "xᵀ x", [numbers(&[4, 3], 6)], |x| x[0].transpose().matmul(&x[0]);
        "matmul", "x y x", [numbers(&[2, 3], 6), numbers(&[3, 2], 7)], |x| x[0].matmul(&x[1]).matmul(&x[0]);
    }
}

fn scan() -> Vec<Row> {
    rows! {
        "cumsum", "a line", [numbers(&[7], 8)], |x| x[0].cumsum(0).square();
        "cumsum", "first axis", [numbers(&[2, 3, 4], 8)], |x| x[0].cumsum(0).square();
        "cumsum", "middle axis", [numbers(&[2, 3, 4], 8)], |x| x[0].cumsum(1).square();
        "cumsum", "last axis, eleven lines", [numbers(&[11, 4], 8)], |x| x[0].cumsum(1).square();
        "exclusive_cumsum", "first axis", [numbers(&[3, 4], 8)], |x| x[0].exclusive_cumsum(0).square();
        "exclusive_cumsum", "last axis, eleven lines", [numbers(&[11, 4], 8)], |x| x[0].exclusive_cumsum(1).square();
    }
}

fn segment() -> Vec<Row> {
    rows! {
        "segment_sum", "[6], empty segments", [numbers(&[6], 9)], |x| x[0].segment_sum(&indices(&[0, 0, 2, 2, 5, 6, 6])).square();
        "segment_sum", "[6, 3]", [numbers(&[6, 3], 9)], |x| x[0].segment_sum(&indices(&[0, 2, 2, 5, 6])).square();
        "segment_sum", "[6, 2, 2]", [numbers(&[6, 2, 2], 9)], |x| x[0].segment_sum(&indices(&[0, 4, 6])).square();
        "segment_repeat", "[4], empty segments", [numbers(&[4], 9)], |x| x[0].segment_repeat(&indices(&[0, 0, 2, 5, 5])).square();
        "segment_repeat", "[3, 2]", [numbers(&[3, 2], 9)], |x| x[0].segment_repeat(&indices(&[0, 1, 4, 6])).square();
        "segment_exclusive_sum", "[6], empty segments", [numbers(&[6], 9)], |x| x[0].segment_exclusive_sum(&indices(&[0, 0, 2, 2, 5, 6, 6])).square();
        "segment_exclusive_sum", "[6, 3]", [numbers(&[6, 3], 9)], |x| x[0].segment_exclusive_sum(&indices(&[0, 2, 2, 6])).square();
    }
}

fn lookup() -> Vec<Row> {
    rows! {
        "gather_rows", "[5], repeated", [numbers(&[5], 10)], |x| x[0].gather_rows(&indices(&[0, 3, 3, 1, 0])).square();
        "gather_rows", "[5, 3], repeated", [numbers(&[5, 3], 10)], |x| x[0].gather_rows(&indices(&[4, 3, 3, 1, 3, 0])).square();
        "gather_rows", "[5, 2, 2]", [numbers(&[5, 2, 2], 10)], |x| x[0].gather_rows(&indices(&[4, 1])).square();
        "gather_rows", "no rows", [numbers(&[5, 2], 10)], |x| x[0].gather_rows(&indices(&[])).square();
        "gather_rows", "two lookups in one table", [numbers(&[5, 2], 10)],
            |x| x[0].gather_rows(&indices(&[4, 1, 1])) * x[0].gather_rows(&indices(&[0, 1, 2]));
        "gather_rows", "a lookup and a dense use of one table", [numbers(&[3, 2], 10)], |x| x[0].gather_rows(&indices(&[2, 1, 1])) * x[0].square();
        "scatter_rows", "[4], repeated", [numbers(&[4], 10)], |x| x[0].scatter_rows(&indices(&[2, 0, 2, 4]), 6).square();
        "scatter_rows", "[4, 3], repeated", [numbers(&[4, 3], 10)], |x| x[0].scatter_rows(&indices(&[1, 1, 1, 0]), 3).square();
    }
}

fn trilinear() -> Vec<Row> {
    rows! {
        "trilinear", "table and positions, one channel", [numbers(&[24, 1], 11), positions(9, [2, 3, 4])],
            |x| x[0].trilinear(&x[1], [2, 3, 4]).square(), kinks: |x| at_integers(&x[1]);
        "trilinear", "three channels", [numbers(&[27, 3], 11), positions(9, [3, 3, 3])],
            |x| x[0].trilinear(&x[1], [3, 3, 3]).square(), kinks: |x| at_integers(&x[1]);
        "trilinear", "five channels, one node along an axis", [numbers(&[8, 5], 11), positions(9, [2, 1, 4])],
            |x| x[0].trilinear(&x[1], [2, 1, 4]).square(), kinks: |x| at_integers(&x[1]);
        "trilinear", "28 channels", [numbers(&[8, 28], 11), positions(5, [2, 2, 2])],
            |x| x[0].trilinear(&x[1], [2, 2, 2]).square(), kinks: |x| at_integers(&x[1]);
        "trilinear", "a single node", [numbers(&[1, 2], 11), positions(4, [1, 1, 1])],
            |x| x[0].trilinear(&x[1], [1, 1, 1]).square(), kinks: |x| at_integers(&x[1]);
        "nearest", "table; constant in the positions", [numbers(&[24, 2], 11), positions(9, [2, 3, 4])],
            |x| x[0].nearest(&x[1], [2, 3, 4]).square(), kinks: |x| at_halves(&x[1]);
    }
}

fn select() -> Vec<Row> {
    rows! {
        "greater", "constant", [numbers(&[2, 3], 12), numbers(&[3], 15)], |x| x[0].greater(&x[1]) * &x[0], kinks: |x| &x[0] - &x[1];
        "greater_equal", "constant", [numbers(&[2, 3], 12), numbers(&[3], 15)], |x| x[0].greater_equal(&x[1]) * &x[0], kinks: |x| &x[0] - &x[1];
        "equal", "constant", [numbers(&[2, 3], 12), numbers(&[3], 15)], |x| x[0].equal(&x[1]) * &x[0], kinks: |x| &x[0] - &x[1];
        "masked", "same shape", [numbers(&[2, 3], 12)], |x| x[0].masked(&mask(&[2, 3])).square();
        "masked", "[2, 3] by [2, 1]", [numbers(&[2, 3], 12)], |x| x[0].masked(&mask(&[2, 1])).square();
        "where_", "same shape", [numbers(&[2, 3], 12), numbers(&[2, 3], 13)], |x| Tensor::where_(&mask(&[2, 3]), &x[0].square(), &x[1].exp());
    }
}

/// Networks, whose kernel is not a method of a tensor.
fn networks() -> Vec<Row> {
    rows! {
        "(mlp)", "softplus", [numbers(&[4, 2], 22), numbers(&[2, 3], 23), numbers(&[3], 24), numbers(&[3, 2], 25), numbers(&[2], 26)],
            |x| network(&[2, 3, 2], Activation::Softplus, None, x);
        "(mlp)", "tanh, a skip connection", [numbers(&[4, 2], 22), numbers(&[2, 3], 23), numbers(&[3], 24), numbers(&[5, 2], 25), numbers(&[2], 26)],
            |x| network(&[2, 3, 2], Activation::Tanh, Some(1), x);
        "(mlp)", "relu, two hidden layers",
            [numbers(&[3, 2], 22), numbers(&[2, 3], 23), numbers(&[3], 24), numbers(&[5, 3], 25), numbers(&[3], 26), numbers(&[3, 1], 27), numbers(&[1], 28)],
            |x| network(&[2, 3, 3, 1], Activation::Relu, Some(1), x).square(),
            kinks: |x| {
                let first = x[0].matmul(&x[1]) + &x[2];
                let second = Tensor::concat(&[&x[0], &first.relu()], 1).matmul(&x[3]) + &x[4];
                Tensor::concat(&[&first, &second], 1)
            };
    }
}

/// Typical compositions of several ops.
fn compositions() -> Vec<Row> {
    rows! {
        "(composition)", "emission and absorption along packed rays", [numbers(&[8, 1], 14), numbers(&[8, 3], 15), positions(6, [2, 2, 2])],
            |x| {
                let rays = indices(&[0, 4, 4, 6]);
                let depth = x[0].trilinear(&x[2], [2, 2, 2]).softplus() * 0.4;
                let weights = (-depth.segment_exclusive_sum(&rays)).exp() * depth.one_minus_exp_neg();
                (weights * x[1].trilinear(&x[2], [2, 2, 2]).sigmoid()).segment_sum(&rays)
            }, kinks: |x| at_integers(&x[2]);
        "(composition)", "a layer of a network", [numbers(&[5, 3], 16), numbers(&[3, 4], 17), numbers(&[4], 18)],
            |x| (x[0].matmul(&x[1]) + &x[2]).softplus().mean_axis(0);
    }
}
