//! Cumulative sums along an axis.

use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel::{self, dispatched};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// yᵢ = Σ_{j<=i} xⱼ, or Σ_{j<i} xⱼ if exclusive; the sum runs over j >= i, or j > i, if reversed.
/// ∂L/∂x is the cumulative sum of ∂L/∂y in the opposite direction.
#[derive(Debug, Clone, Copy)]
struct Cumsum {
    axis: usize,
    exclusive: bool,
    reverse: bool,
}
impl<T: Real> Op<T> for Cumsum {
    fn name(&self) -> &'static str {
        if self.exclusive { "exclusive_cumsum" } else { "cumsum" }
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || scan(cx.cotangent(), Cumsum { reverse: !self.reverse, ..*self }))]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns the cumulative sum yᵢ = Σ_{j<=i} xⱼ along an axis.
    ///
    /// Panics if the axis does not exist.
    #[track_caller]
    pub fn cumsum(&self, axis: usize) -> Self {
        assert!(axis < self.ndim(), "cumsum: axis {axis} is out of range for a tensor of shape {:?}", self.shape());
        scan(self, Cumsum { axis, exclusive: false, reverse: false })
    }

    /// Returns the exclusive cumulative sum yᵢ = Σ_{j<i} xⱼ along an axis. The first element is 0.
    ///
    /// Panics if the axis does not exist.
    #[track_caller]
    pub fn exclusive_cumsum(&self, axis: usize) -> Self {
        assert!(axis < self.ndim(), "exclusive_cumsum: axis {axis} is out of range for a tensor of shape {:?}", self.shape());
        scan(self, Cumsum { axis, exclusive: true, reverse: false })
    }
}

fn scan<T: Real>(x: &Tensor<T>, op: Cumsum) -> Tensor<T> {
    let (middle, inner): (usize, usize) = (x.shape()[op.axis], x.shape()[op.axis + 1..].iter().product());
    let mut out = Buffer::stale(x.len());
    let width = middle * inner;
    let data = x.data();
    parallel::for_each_rows(&mut out, width, |first, chunk| {
        let source = &data[first * width..][..chunk.len()];
        match (inner, op.exclusive, op.reverse) {
            (1, false, false) => scan_lines::<T, false, false>(source, middle, chunk),
            (1, false, true) => scan_lines::<T, false, true>(source, middle, chunk),
            (1, true, false) => scan_lines::<T, true, false>(source, middle, chunk),
            (1, true, true) => scan_lines::<T, true, true>(source, middle, chunk),
            _ => scan_blocks(source, middle, inner, op, chunk),
        }
    });
    Tensor::from_op(out, x.shape(), &[x], op)
}

dispatched! {
/// Computes the cumulative sums of lines of `n` numbers. Eight lines are processed together, because each addition of one line depends on the previous one.
fn scan_lines<T: Real, const EXCLUSIVE: bool, const REVERSE: bool>(x: &[T], n: usize, out: &mut [T]) {
    const LINES: usize = 8;
    let mut groups = out.chunks_exact_mut(LINES * n);
    let mut sources = x.chunks_exact(LINES * n);
    for (out, x) in (&mut groups).zip(&mut sources) {
        let mut sums = [T::zero(); LINES];
        for step in 0..n {
            let i = if REVERSE { n - 1 - step } else { step };
            for (line, sum) in sums.iter_mut().enumerate() {
                let at = line * n + i;
                let next = *sum + x[at];
                out[at] = if EXCLUSIVE { *sum } else { next };
                *sum = next;
            }
        }
    }
    for (out, x) in groups.into_remainder().chunks_exact_mut(n).zip(sources.remainder().chunks_exact(n)) {
        let mut sum = T::zero();
        for step in 0..n {
            let i = if REVERSE { n - 1 - step } else { step };
            let next = sum + x[i];
            out[i] = if EXCLUSIVE { sum } else { next };
            sum = next;
        }
    }
}
}

/// Computes the cumulative sums of blocks of `middle` rows, separately for each of the `inner` columns.
fn scan_blocks<T: Real>(x: &[T], middle: usize, inner: usize, op: Cumsum, out: &mut [T]) {
    let width = middle * inner;
    for (out, x) in out.chunks_exact_mut(width).zip(x.chunks_exact(width)) {
        let mut sums = vec![T::zero(); inner];
        for step in 0..middle {
            let i = if op.reverse { middle - 1 - step } else { step };
            for ((o, &v), sum) in out[i * inner..][..inner].iter_mut().zip(&x[i * inner..][..inner]).zip(&mut sums) {
                let next = *sum + v;
                *o = if op.exclusive { *sum } else { next };
                *sum = next;
            }
        }
    }
}
