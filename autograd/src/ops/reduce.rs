//! Sums, means and extrema, over all elements or along one axis.

use crate::graph::Rule;
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel::{self, CHUNK, dispatched};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// y = x summed to a shape that broadcasts to the shape of x.   ∂L/∂x = ∂L/∂y, repeated
#[derive(Debug)]
struct SumTo {
    from: Vec<usize>,
}
impl<T: Real> Op<T> for SumTo {
    fn name(&self) -> &'static str {
        "sum_to"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let g = cx.cotangent_factor();
        vec![cx.wrt(0, || if g.len() == 1 { g.reshape(&[]) } else { g.broadcast_to(&self.from) })]
    }
}

/// y = max x or min x.   ∂L/∂x = ∂L/∂y · shares. The shares are constants: 1 / (number of ties) for each element that equals y, and 0 for the others
#[derive(Debug)]
struct Extremum<T: Real> {
    largest: bool,
    shares: Tensor<T>,
}
impl<T: Real> Op<T> for Extremum<T> {
    fn name(&self) -> &'static str {
        if self.largest { "max" } else { "min" }
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent() * &self.shares)]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns y = Σ x, a scalar.   ∂L/∂x = ∂L/∂y for every element
    pub fn sum(&self) -> Self {
        self.sum_to(&[])
    }

    /// Returns the mean of all elements, a scalar.
    pub fn mean(&self) -> Self {
        self.sum() / self.len() as f64
    }

    /// Returns the sum along one axis, which is removed.
    ///
    /// Panics if the axis does not exist.
    #[track_caller]
    pub fn sum_axis(&self, axis: usize) -> Self {
        let mut kept = self.shape_without("sum_axis", axis);
        let reduced = self.sum_to(&with_one(self.shape(), axis));
        kept.shrink_to_fit();
        reduced.reshape(&kept)
    }

    /// Returns the mean along one axis, which is removed.
    ///
    /// Panics if the axis does not exist.
    #[track_caller]
    pub fn mean_axis(&self, axis: usize) -> Self {
        self.check_axis("mean_axis", axis);
        self.sum_axis(axis) / self.shape()[axis] as f64
    }

    /// Returns the largest element, a scalar. Ties divide the gradient equally; there is a kink at a tie.
    ///
    /// Panics if there are no elements.
    #[track_caller]
    pub fn max(&self) -> Self {
        self.extremum(self.shape().iter().map(|_| 1).collect(), true).reshape(&[])
    }

    /// Returns the smallest element, a scalar. Ties divide the gradient equally; there is a kink at a tie.
    ///
    /// Panics if there are no elements.
    #[track_caller]
    pub fn min(&self) -> Self {
        self.extremum(self.shape().iter().map(|_| 1).collect(), false).reshape(&[])
    }

    /// Returns the largest element along one axis, which is removed. Ties divide the gradient equally; there is a kink at a tie.
    ///
    /// Panics if the axis does not exist or if there are no elements.
    #[track_caller]
    pub fn max_axis(&self, axis: usize) -> Self {
        let kept = self.shape_without("max_axis", axis);
        self.extremum(with_one(self.shape(), axis), true).reshape(&kept)
    }

    /// Returns the smallest element along one axis, which is removed. Ties divide the gradient equally; there is a kink at a tie.
    ///
    /// Panics if the axis does not exist or if there are no elements.
    #[track_caller]
    pub fn min_axis(&self, axis: usize) -> Self {
        let kept = self.shape_without("min_axis", axis);
        self.extremum(with_one(self.shape(), axis), false).reshape(&kept)
    }

    /// Returns the sum over every dimension that is 1 or absent in `shape`, with the shape `shape`. This is the adjoint of [`Tensor::broadcast_to`].
    ///
    /// Panics if `shape` does not broadcast to the shape of this tensor.
    #[track_caller]
    pub fn sum_to(&self, shape: &[usize]) -> Self {
        let from = self.shape();
        let missing = from.len().checked_sub(shape.len());
        let fits = missing.is_some_and(|m| shape.iter().zip(&from[m..]).all(|(&to, &from)| to == from || to == 1));
        assert!(fits, "sum_to: shape {from:?} cannot be summed to {shape:?}");
        let kept: Vec<bool> =
            (0..from.len()).map(|i| i >= from.len() - shape.len() && shape[i + shape.len() - from.len()] == from[i]).collect();
        // Merges adjacent dimensions that are all kept or all summed.
        let mut dims: Vec<(usize, bool)> = Vec::new();
        for (&n, &kept) in from.iter().zip(&kept) {
            match dims.last_mut() {
                Some((m, k)) if *k == kept => *m *= n,
                _ => dims.push((n, kept)),
            }
        }
        let mut current: Option<Buffer<T>> = None;
        while let Some(axis) = dims.iter().rposition(|&(_, kept)| !kept) {
            let outer = dims[..axis].iter().map(|d| d.0).product();
            let inner = dims[axis + 1..].iter().map(|d| d.0).product();
            let data = current.as_deref().unwrap_or(self.data());
            current = Some(sum_middle(data, outer, dims[axis].0, inner));
            dims.remove(axis);
        }
        let out = current.unwrap_or_else(|| Buffer::copy_of(self.data()));
        Tensor::from_op(out, shape, &[self], SumTo { from: from.to_vec() })
    }

    #[track_caller]
    fn extremum(&self, shape: Vec<usize>, largest: bool) -> Self {
        assert!(!self.is_empty(), "{}: no elements", if largest { "max" } else { "min" });
        let axis = self.shape().iter().zip(&shape).rposition(|(a, b)| a != b);
        let all = shape.iter().all(|&n| n == 1);
        let (outer, middle, inner) = match axis {
            None => (self.len(), 1, 1),
            Some(_) if all => (1, self.len(), 1),
            Some(a) => (self.shape()[..a].iter().product(), self.shape()[a], self.shape()[a + 1..].iter().product()),
        };
        let pick = |a: T, b: T| if (b > a) == largest && b != a { b } else { a };
        let x = self.data();
        let mut out = Buffer::stale(outer * inner);
        if outer * inner == 1 {
            let best = parallel::map_chunks(middle, CHUNK, |range| x[range].iter().copied().reduce(pick));
            out[0] = best.into_iter().flatten().reduce(pick).unwrap_or(T::nan());
        } else {
            parallel::for_each_rows(&mut out, inner, |first, chunk| {
                for (o, row) in chunk.chunks_exact_mut(inner).enumerate() {
                    for (i, y) in row.iter_mut().enumerate() {
                        let start = (first + o) * middle * inner + i;
                        *y = (1..middle).fold(x[start], |best, j| pick(best, x[start + j * inner]));
                    }
                }
            });
        }
        let value = Tensor::from_buffer(out, &shape);
        if !self.is_tracked() {
            return value;
        }
        let chosen = self.detach().equal(&value);
        let ties = chosen.sum_to(&shape);
        value.recorded(&[self], Keep::NOTHING, || Rule::Op(Box::new(Extremum { largest, shares: chosen / ties })))
    }

    #[track_caller]
    pub(crate) fn check_axis(&self, op: &str, axis: usize) {
        assert!(axis < self.ndim(), "{op}: axis {axis} is out of range for a tensor of shape {:?}", self.shape());
    }

    #[track_caller]
    pub(crate) fn shape_without(&self, op: &str, axis: usize) -> Vec<usize> {
        self.check_axis(op, axis);
        let mut shape = self.shape().to_vec();
        shape.remove(axis);
        shape
    }
}

fn with_one(shape: &[usize], axis: usize) -> Vec<usize> {
    let mut shape = shape.to_vec();
    shape[axis] = 1;
    shape
}

/// Sums `[outer, middle, inner]` over the middle dimension, to `[outer, inner]`.
fn sum_middle<T: Real>(x: &[T], outer: usize, middle: usize, inner: usize) -> Buffer<T> {
    let mut out = Buffer::stale(outer * inner);
    if inner == 1 && outer < 16 {
        for (o, y) in out.iter_mut().enumerate() {
            *y = parallel::sum(&x[o * middle..(o + 1) * middle], |v| v);
        }
    } else if outer < 16 {
        // There are few results and many rows: fixed runs of rows are summed in parallel, and the partial sums are added in order.
        let run = (CHUNK / inner.max(1)).max(1);
        for (o, y) in out.chunks_exact_mut(inner.max(1)).enumerate() {
            let block = &x[o * middle * inner..(o + 1) * middle * inner];
            let partial = parallel::map_chunks(middle, run, |range| {
                let mut sum = vec![T::zero(); inner];
                sum_rows::<T, 0>(&block[range.start * inner..range.end * inner], inner, &mut sum);
                sum
            });
            y.fill(T::zero());
            for part in partial {
                y.iter_mut().zip(part).for_each(|(y, p)| *y += p);
            }
        }
    } else {
        let per_task = (CHUNK / (middle * inner).max(1)).max(1);
        parallel::for_each_chunk(&mut out, per_task * inner, |start, chunk| {
            let first = start / inner;
            let source = &x[first * middle * inner..][..chunk.len() / inner * middle * inner];
            sum_blocks(source, middle, inner, chunk);
        });
    }
    out
}

dispatched! {
fn sum_blocks<T: Real>(x: &[T], middle: usize, inner: usize, out: &mut [T]) {
    if middle == 0 {
        out.fill(T::zero());
        return;
    }
    for (y, block) in out.chunks_exact_mut(inner).zip(x.chunks_exact(middle * inner)) {
        match inner {
            1 => y[0] = sum_short(block),
            3 => sum_rows::<T, 3>(block, inner, y),
            _ => sum_rows::<T, 0>(block, inner, y),
        }
    }
}
}

/// Sums a short slice with four accumulators, which hide the latency of additions.
#[inline(always)]
fn sum_short<T: Real>(x: &[T]) -> T {
    let mut lanes = [T::zero(); 4];
    let (body, tail) = x.as_chunks::<4>();
    for block in body {
        for i in 0..4 {
            lanes[i] += block[i];
        }
    }
    let mut sum = (lanes[0] + lanes[2]) + (lanes[1] + lanes[3]);
    for &v in tail {
        sum += v;
    }
    sum
}

/// Sets `out` to the sum of rows of `width` elements. `W` is the width, or 0 if the width is known at run time only.
#[inline(always)]
fn sum_rows<T: Real, const W: usize>(rows: &[T], width: usize, out: &mut [T]) {
    if W == 0 {
        out.fill(T::zero());
        for row in rows.chunks_exact(width) {
            for (o, &v) in out.iter_mut().zip(row) {
                *o += v;
            }
        }
    } else {
        let mut sums = [[T::zero(); W]; 4];
        let (rows, _) = rows.as_chunks::<W>();
        let (body, tail) = rows.as_chunks::<4>();
        for four in body {
            for (sum, row) in sums.iter_mut().zip(four) {
                for c in 0..W {
                    sum[c] += row[c];
                }
            }
        }
        for row in tail {
            for c in 0..W {
                sums[0][c] += row[c];
            }
        }
        for c in 0..W {
            out[c] = (sums[0][c] + sums[2][c]) + (sums[1][c] + sums[3][c]);
        }
    }
}
