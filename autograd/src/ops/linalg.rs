//! The batched matrix product.
//!
//! This module distributes the work over threads in blocks of a fixed size, so the bits do not depend on the number of threads.

use crate::matrix::{Matrix, Precision, multiply};
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// C = op(A) op(B), where op transposes the last two dimensions or not.
#[derive(Debug, Clone, Copy)]
struct Matmul {
    transpose_a: bool,
    transpose_b: bool,
}

/// The gradient rule, with G = ∂L/∂C: C = A B has ∂L/∂A = G Bᵀ and ∂L/∂B = Aᵀ G. The rules of the transposed forms follow by transposing both sides.
impl<T: Real> Op<T> for Matmul {
    fn name(&self) -> &'static str {
        "matmul"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let g = cx.cotangent();
        let (ta, tb) = (self.transpose_a, self.transpose_b);
        vec![
            cx.wrt(0, || if ta { product(&cx.input(1), g, tb, true) } else { product(g, &cx.input(1), false, !tb) }),
            cx.wrt(1, || if tb { product(g, &cx.input(0), true, ta) } else { product(&cx.input(0), g, !ta, false) }),
        ]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns the matrix product of `[…, m, k]` and `[…, k, n]`, of shape `[…, m, n]`. The leading (batch) dimensions must be equal, or one operand must have
    /// none; that operand is then used for every matrix of the batch.
    ///
    /// Panics with both shapes if they do not fit.
    #[track_caller]
    pub fn matmul(&self, other: &Self) -> Self {
        assert!(
            self.ndim() >= 2 && other.ndim() >= 2 && self.shape()[self.ndim() - 1] == other.shape()[other.ndim() - 2],
            "matmul: shapes {:?} and {:?} do not fit: expected […, m, k] and […, k, n]",
            self.shape(),
            other.shape()
        );
        let (a, b) = (&self.shape()[..self.ndim() - 2], &other.shape()[..other.ndim() - 2]);
        assert!(a == b || a.is_empty() || b.is_empty(), "matmul: batch dimensions {a:?} and {b:?} differ");
        product(self, other, false, false)
    }
}

/// Computes and records op(A) op(B).
fn product<T: Real>(a: &Tensor<T>, b: &Tensor<T>, transpose_a: bool, transpose_b: bool) -> Tensor<T> {
    let batch = if a.ndim() >= b.ndim() { &a.shape()[..a.ndim() - 2] } else { &b.shape()[..b.ndim() - 2] };
    let count: usize = batch.iter().product();
    let sides = |x: &Tensor<T>, transposed: bool| {
        let (r, c) = (x.shape()[x.ndim() - 2], x.shape()[x.ndim() - 1]);
        if transposed { (c, r) } else { (r, c) }
    };
    let ((m, k), (_, n)) = (sides(a, transpose_a), sides(b, transpose_b));
    let matrix = |x: &'_ Tensor<T>, i: usize| {
        let size = x.shape()[x.ndim() - 2] * x.shape()[x.ndim() - 1];
        let start = if x.ndim() == 2 { 0 } else { i * size };
        start..start + size
    };
    let mut out = Buffer::stale(count * m * n);
    if count == 1 {
        let (x, y) =
            (Matrix::stored(&a.data()[matrix(a, 0)], m, k, transpose_a), Matrix::stored(&b.data()[matrix(b, 0)], k, n, transpose_b));
        multiply_blocked(x, y, &mut out);
    } else {
        // Many small products: each task computes as many as fill a chunk.
        parallel::for_each_rows(&mut out, m * n, |first, chunk| {
            for (i, c) in chunk.chunks_exact_mut((m * n).max(1)).enumerate() {
                let x = Matrix::stored(&a.data()[matrix(a, first + i)], m, k, transpose_a);
                let y = Matrix::stored(&b.data()[matrix(b, first + i)], k, n, transpose_b);
                multiply(x, y, c, Precision::Full);
            }
        });
    }
    let mut shape = batch.to_vec();
    shape.extend([m, n]);
    Tensor::from_op(out, &shape, &[a, b], Matmul { transpose_a, transpose_b })
}

/// Computes out = a · b in parallel, in blocks of a fixed size. The blocks are rows of the result or, if the inner dimension is much longer than the
/// others, ranges of the inner dimension, whose partial sums are added in order.
fn multiply_blocked<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T]) {
    const ROWS: usize = 128;
    const DEEP: usize = 4096;
    let (m, k, n) = (a.rows, a.cols, b.cols);
    if k > 4 * m.max(n) && k > DEEP {
        let parts = parallel::map_chunks(k, DEEP, |range| {
            let mut part = Buffer::<T>::stale(m * n);
            multiply(a.cols(range.clone()), b.rows(range), &mut part, Precision::Full);
            part
        });
        out.fill(T::zero());
        for part in parts {
            out.iter_mut().zip(part.iter()).for_each(|(o, &p)| *o += p);
        }
    } else {
        parallel::for_each_chunk(out, ROWS * n.max(1), |start, rows| {
            let first = start / n;
            multiply(a.rows(first..first + rows.len() / n), b, rows, Precision::Full);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_every_shape_and_transposition_equal_the_triple_loop() {
        let numbers =
            |n: usize, seed: usize| -> Vec<f64> { (0..n).map(|i| ((i * 7919 + seed * 104_729) % 1000) as f64 / 500.0 - 1.0).collect() };
        for (m, k, n) in [(1, 1, 1), (3, 5, 2), (130, 7, 33), (2, 9000, 3), (5, 0, 4), (257, 64, 1), (40, 300, 16), (3, 4, 0)] {
            for (ta, tb) in [(false, false), (true, false), (false, true), (true, true)] {
                let (x, y) = (numbers(m * k, 1), numbers(k * n, 2));
                let at =
                    |v: &[f64], r: usize, c: usize, rows: usize, cols: usize, t: bool| if t { v[c * rows + r] } else { v[r * cols + c] };
                let a = Tensor::from_vec(x.clone(), &if ta { [k, m] } else { [m, k] });
                let b = Tensor::from_vec(y.clone(), &if tb { [n, k] } else { [k, n] });
                let got = product(&a, &b, ta, tb);
                for r in 0..m {
                    for c in 0..n {
                        let want: f64 = (0..k).map(|i| at(&x, r, i, m, k, ta) * at(&y, i, c, k, n, tb)).sum();
                        assert!((got.value()[[r, c]] - want).abs() < 1e-9, "{m}×{k}×{n} {ta} {tb} at ({r}, {c})");
                    }
                }
            }
        }
    }
}
