//! Matrix product, batched.

use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use ndarray::linalg::general_mat_mul;
use ndarray::{ArrayView2, ArrayViewMut2, Axis};

/// C = op(A) op(B), where op transposes the last two dimensions or not.
#[derive(Debug, Clone, Copy)]
struct Matmul {
    transpose_a: bool,
    transpose_b: bool,
}

/// With G = ∂L/∂C:  C = A B gives ∂L/∂A = G Bᵀ, ∂L/∂B = Aᵀ G; the transposed forms follow by transposing both sides.
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
    /// `[…, m, k]` times `[…, k, n]` gives `[…, m, n]`. Leading dimensions are equal, or one operand has none and serves every batch.
    ///
    /// Panics, with both shapes, if they do not fit.
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

fn product<T: Real>(a: &Tensor<T>, b: &Tensor<T>, transpose_a: bool, transpose_b: bool) -> Tensor<T> {
    let batch = if a.ndim() >= b.ndim() { &a.shape()[..a.ndim() - 2] } else { &b.shape()[..b.ndim() - 2] };
    let count: usize = batch.iter().product();
    let sides = |x: &Tensor<T>, transposed: bool| {
        let (r, c) = (x.shape()[x.ndim() - 2], x.shape()[x.ndim() - 1]);
        if transposed { (c, r) } else { (r, c) }
    };
    let ((m, k), (_, n)) = (sides(a, transpose_a), sides(b, transpose_b));
    let matrix = |x: &Tensor<T>, i: usize| {
        let size = x.shape()[x.ndim() - 2] * x.shape()[x.ndim() - 1];
        let start = if x.ndim() == 2 { 0 } else { i * size };
        start..start + size
    };
    let mut out = Buffer::stale(count * m * n);
    if count == 1 {
        large(view(&a.data()[matrix(a, 0)], m, k, transpose_a), view(&b.data()[matrix(b, 0)], k, n, transpose_b), &mut out);
    } else {
        // Many small products: a task takes as many as make a chunk.
        parallel::for_each_rows(&mut out, m * n, |first, chunk| {
            for (i, c) in chunk.chunks_exact_mut((m * n).max(1)).enumerate() {
                let (x, y) = (view(&a.data()[matrix(a, first + i)], m, k, transpose_a), view(&b.data()[matrix(b, first + i)], k, n, transpose_b));
                small(x, y, c);
            }
        });
    }
    let mut shape = batch.to_vec();
    shape.extend([m, n]);
    Tensor::from_op(out, &shape, &[a, b], Matmul { transpose_a, transpose_b })
}

fn view<T: Real>(data: &[T], rows: usize, cols: usize, transposed: bool) -> ArrayView2<'_, T> {
    if transposed {
        ArrayView2::from_shape((cols, rows), data).expect("a matrix of the tensor").reversed_axes()
    } else {
        ArrayView2::from_shape((rows, cols), data).expect("a matrix of the tensor")
    }
}

fn small<T: Real>(a: ArrayView2<'_, T>, b: ArrayView2<'_, T>, out: &mut [T]) {
    let shape = (a.nrows(), b.ncols());
    general_mat_mul(T::one(), &a, &b, T::zero(), &mut ArrayViewMut2::from_shape(shape, out).expect("the output of the product"));
}

/// One product, cut into blocks of fixed size: rows of the result or, when the inner dimension is the long one, partial sums that are
/// added in order.
fn large<T: Real>(a: ArrayView2<'_, T>, b: ArrayView2<'_, T>, out: &mut [T]) {
    const BLOCK: usize = 256;
    const DEEP: usize = 8192;
    let (m, k, n) = (a.nrows(), a.ncols(), b.ncols());
    if k > 4 * m.max(n) && k > DEEP {
        let parts = parallel::map_chunks(k, DEEP, |range| {
            let mut part = Buffer::<T>::zeros(m * n);
            let (a, b) = (a.slice_axis(Axis(1), range.clone().into()), b.slice_axis(Axis(0), range.into()));
            small(a, b, &mut part);
            part
        });
        out.fill(T::zero());
        for part in parts {
            out.iter_mut().zip(part.iter()).for_each(|(o, &p)| *o += p);
        }
    } else {
        parallel::for_each_chunk(out, BLOCK * n.max(1), |start, block| {
            let (first, rows) = (start / n, block.len() / n);
            small(a.slice_axis(Axis(0), (first..first + rows).into()), b, block);
        });
    }
}
