//! Sums over the segments of a packed array. For packed rays, one array holds the values of all samples, and the segment of ray `r` is the rows
//! `offsets[r]..offsets[r + 1]`.

use crate::index::Indices;
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// yᵣ = Σ of the rows of segment r.   ∂L/∂x repeats ∂L/∂y
#[derive(Debug)]
struct SegmentSum {
    offsets: Indices,
}
impl<T: Real> Op<T> for SegmentSum {
    fn name(&self) -> &'static str {
        "segment_sum"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().segment_repeat(&self.offsets))]
    }
}

/// Each row of segment r of the result x is yᵣ.   ∂L/∂yᵣ = Σ of ∂L/∂x over the rows of segment r
#[derive(Debug)]
struct SegmentRepeat {
    offsets: Indices,
}
impl<T: Real> Op<T> for SegmentRepeat {
    fn name(&self) -> &'static str {
        "segment_repeat"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().segment_sum(&self.offsets))]
    }
}

/// yᵢ = Σ of the rows before row i in its segment, or after row i if reversed.   ∂L/∂x is the same sum of ∂L/∂y in the opposite direction
#[derive(Debug)]
struct SegmentScan {
    offsets: Indices,
    reverse: bool,
}
impl<T: Real> Op<T> for SegmentScan {
    fn name(&self) -> &'static str {
        "segment_exclusive_sum"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || scan(cx.cotangent(), &self.offsets, !self.reverse))]
    }
}

impl<T: Real> Tensor<T> {
    /// Returns the sum of the rows of each segment. This tensor has shape `[m, …]` and the result `[n, …]`. The sum of an empty segment is 0. `offsets` has
    /// n + 1 entries, ascending from 0 to m.
    ///
    /// Panics if the offsets do not ascend from 0 to m.
    #[track_caller]
    pub fn segment_sum(&self, offsets: &Indices) -> Self {
        let n = segments("segment_sum", offsets, self.first_len("segment_sum"));
        let width: usize = self.shape()[1..].iter().product();
        let mut shape = self.shape().to_vec();
        shape[0] = n;
        let mut out = Buffer::stale(n * width);
        let x = self.data();
        for_each_segments(
            offsets,
            &mut out,
            |_| width,
            |first, chunk| {
                for (r, sum) in chunk.chunks_exact_mut(width.max(1)).enumerate() {
                    let rows = &x[offsets[first + r] as usize * width..offsets[first + r + 1] as usize * width];
                    match width {
                        1 => sum[0] = rows.iter().copied().sum(),
                        3 => {
                            let mut s = [T::zero(); 3];
                            for row in rows.as_chunks::<3>().0 {
                                (0..3).for_each(|c| s[c] += row[c]);
                            }
                            sum.copy_from_slice(&s);
                        }
                        _ => {
                            sum.fill(T::zero());
                            for row in rows.chunks_exact(width) {
                                sum.iter_mut().zip(row).for_each(|(s, &v)| *s += v);
                            }
                        }
                    }
                }
            },
        );
        Tensor::from_op(out, &shape, &[self], SegmentSum { offsets: offsets.clone() })
    }

    /// Repeats each row of this tensor for all rows of its segment: every row of segment r of the result is row r. This tensor has shape `[n, …]` and the
    /// result `[m, …]`, where m is the last offset. This is the adjoint of [`Tensor::segment_sum`].
    ///
    /// Panics if `offsets` does not have n + 1 entries that ascend from 0.
    #[track_caller]
    pub fn segment_repeat(&self, offsets: &Indices) -> Self {
        let m = *offsets.last().expect("segment_repeat: the offsets are empty") as usize;
        let n = segments("segment_repeat", offsets, m);
        assert_eq!(n, self.first_len("segment_repeat"), "segment_repeat: {n} segments for a tensor of shape {:?}", self.shape());
        let width: usize = self.shape()[1..].iter().product();
        let mut shape = self.shape().to_vec();
        shape[0] = m;
        let mut out = Buffer::stale(m * width);
        let x = self.data();
        for_each_segments(
            offsets,
            &mut out,
            |r| (offsets[r + 1] - offsets[r]) as usize * width,
            |first, mut chunk| {
                let mut r = first;
                while !chunk.is_empty() {
                    let (rows, rest) = chunk.split_at_mut((offsets[r + 1] - offsets[r]) as usize * width);
                    let row = &x[r * width..][..width];
                    match row {
                        [v] => rows.fill(*v),
                        _ => rows.chunks_exact_mut(width).for_each(|target| target.copy_from_slice(row)),
                    }
                    chunk = rest;
                    r += 1;
                }
            },
        );
        Tensor::from_op(out, &shape, &[self], SegmentRepeat { offsets: offsets.clone() })
    }

    /// Returns the exclusive cumulative sum within each segment: yᵢ = Σ of the rows before row i in its segment. The first row of each segment is 0. This
    /// tensor and the result have shape `[m, …]`.
    ///
    /// Panics if the offsets do not ascend from 0 to m.
    #[track_caller]
    pub fn segment_exclusive_sum(&self, offsets: &Indices) -> Self {
        segments("segment_exclusive_sum", offsets, self.first_len("segment_exclusive_sum"));
        scan(self, offsets, false)
    }
}

fn scan<T: Real>(x: &Tensor<T>, offsets: &Indices, reverse: bool) -> Tensor<T> {
    let width: usize = x.shape()[1..].iter().product();
    let mut out = Buffer::stale(x.len());
    let data = x.data();
    for_each_segments(
        offsets,
        &mut out,
        |r| (offsets[r + 1] - offsets[r]) as usize * width,
        |first, mut chunk| {
            let mut sums = vec![T::zero(); width];
            let mut r = first;
            while !chunk.is_empty() {
                let (out, rest) = chunk.split_at_mut((offsets[r + 1] - offsets[r]) as usize * width);
                let x = &data[offsets[r] as usize * width..][..out.len()];
                if width == 1 {
                    let mut sum = T::zero();
                    let mut step = |(o, &v): (&mut T, &T)| {
                        *o = sum;
                        sum += v;
                    };
                    if reverse { out.iter_mut().zip(x).rev().for_each(&mut step) } else { out.iter_mut().zip(x).for_each(&mut step) }
                } else {
                    sums.fill(T::zero());
                    let count = out.len() / width.max(1);
                    for k in 0..count {
                        let i = if reverse { count - 1 - k } else { k };
                        for ((o, &v), sum) in out[i * width..][..width].iter_mut().zip(&x[i * width..][..width]).zip(&mut sums) {
                            *o = *sum;
                            *sum += v;
                        }
                    }
                }
                chunk = rest;
                r += 1;
            }
        },
    );
    Tensor::from_op(out, x.shape(), &[x], SegmentScan { offsets: offsets.clone(), reverse })
}

/// Returns the number of segments.
///
/// Panics with the name of the op if the offsets do not ascend from 0 to `rows`.
#[track_caller]
fn segments(op: &str, offsets: &Indices, rows: usize) -> usize {
    let fits = offsets.first() == Some(&0) && offsets.last().is_some_and(|&m| m as usize == rows) && offsets.is_sorted();
    assert!(fits, "{op}: offsets must ascend from 0 to the number of rows, {rows}; got {:?} … {:?}", offsets.first(), offsets.last());
    offsets.len() - 1
}

/// Calls `f(first_segment, part)` for runs of 256 segments, in parallel. `part` is the part of `out` that belongs to the run; segment r has `length(r)`
/// elements of `out`.
fn for_each_segments<T: Real>(
    offsets: &Indices,
    out: &mut [T],
    length: impl Fn(usize) -> usize,
    f: impl Fn(usize, &mut [T]) + Sync + Send,
) {
    const RUN: usize = 256;
    let n = offsets.len() - 1;
    let mut rest = out;
    let mut parts = Vec::with_capacity(n.div_ceil(RUN));
    for first in (0..n).step_by(RUN) {
        let len = (first..(first + RUN).min(n)).map(&length).sum();
        let (part, tail) = std::mem::take(&mut rest).split_at_mut(len);
        parts.push((first, part));
        rest = tail;
    }
    parallel::for_each_item(parts, |_, (first, part)| f(first, part));
}
