//! Ops that change the shape or the arrangement of a tensor.

use super::arithmetic::{broadcast_shape, broadcast_strides};
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use ndarray::{Dimension, IxDyn};

/// y = x with another shape.   ∂L/∂x = ∂L/∂y with the shape of x
#[derive(Debug)]
struct Reshape {
    from: Vec<usize>,
}
impl<T: Real> Op<T> for Reshape {
    fn name(&self) -> &'static str {
        "reshape"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().reshape(&self.from))]
    }
}

/// y = x repeated along new dimensions and dimensions of size 1.   ∂L/∂x = ∂L/∂y, which the engine sums over the repetitions
#[derive(Debug)]
struct Broadcast;
impl<T: Real> Op<T> for Broadcast {
    fn name(&self) -> &'static str {
        "broadcast_to"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().clone())]
    }
}

/// y = x with dimensions in the order `axes`.   ∂L/∂x = ∂L/∂y with dimensions in the inverse order
#[derive(Debug)]
struct Permute {
    axes: Vec<usize>,
}
impl<T: Real> Op<T> for Permute {
    fn name(&self) -> &'static str {
        "permute"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let mut inverse = vec![0; self.axes.len()];
        for (to, &from) in self.axes.iter().enumerate() {
            inverse[from] = to;
        }
        vec![cx.wrt(0, || cx.cotangent().permute(&inverse))]
    }
}

/// y = x[…, start..start+len, …].   ∂L/∂x = ∂L/∂y, padded with zeros
#[derive(Debug)]
struct Narrow {
    axis: usize,
    start: usize,
}
impl<T: Real> Op<T> for Narrow {
    fn name(&self) -> &'static str {
        "narrow"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().pad(self.axis, self.start, cx.input_shape(0)[self.axis]))]
    }
}

/// y = x, padded with zeros along an axis: the adjoint of [`Narrow`].   ∂L/∂x = ∂L/∂y[…, start..start+len, …]
#[derive(Debug)]
struct Pad {
    axis: usize,
    start: usize,
    len: usize,
}
impl<T: Real> Op<T> for Pad {
    fn name(&self) -> &'static str {
        "pad"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().narrow(self.axis, self.start, self.len))]
    }
}

/// y = the inputs concatenated along an axis.   The cotangent of each input is its part of ∂L/∂y.
#[derive(Debug)]
struct Concat {
    axis: usize,
}
impl<T: Real> Op<T> for Concat {
    fn name(&self) -> &'static str {
        "concat"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        let parts = cx.node.inputs.len();
        let mut start = 0;
        (0..parts)
            .map(|i| {
                let len = cx.input_shape(i)[self.axis];
                start += len;
                cx.wrt(i, || cx.cotangent().narrow(self.axis, start - len, len))
            })
            .collect()
    }
}

impl<T: Real> Tensor<T> {
    /// Returns the same values with another shape. The buffer is shared, not copied.
    ///
    /// Panics if the number of elements differs.
    #[track_caller]
    pub fn reshape(&self, shape: &[usize]) -> Self {
        assert_eq!(
            shape.iter().product::<usize>(),
            self.len(),
            "reshape: a tensor of shape {:?} has {} elements, which do not fill the shape {shape:?}",
            self.shape(),
            self.len()
        );
        if shape == self.shape() {
            return self.clone();
        }
        let value = Tensor { data: self.data.clone(), shape: IxDyn(shape), node: None };
        let from = self.shape().to_vec();
        value.recorded(&[self], Keep::NOTHING, || crate::graph::Rule::Op(Box::new(Reshape { from })))
    }

    /// Inserts a dimension of size 1 before `axis`.
    ///
    /// Panics if `axis` is larger than the number of dimensions.
    #[track_caller]
    pub fn unsqueeze(&self, axis: usize) -> Self {
        assert!(axis <= self.ndim(), "unsqueeze: axis {axis} is out of range for a tensor of shape {:?}", self.shape());
        let mut shape = self.shape().to_vec();
        shape.insert(axis, 1);
        self.reshape(&shape)
    }

    /// Repeats the values to a larger shape, by the broadcasting rule of NumPy.
    ///
    /// Panics if this tensor does not broadcast to `shape`.
    #[track_caller]
    pub fn broadcast_to(&self, shape: &[usize]) -> Self {
        assert_eq!(
            broadcast_shape(self.shape(), shape).as_deref(),
            Some(shape),
            "broadcast_to: {:?} does not broadcast to {shape:?}",
            self.shape()
        );
        let mut out = Buffer::stale(shape.iter().product());
        if self.len() == 1 {
            parallel::fill(&mut out, self.data()[0]);
        } else {
            copy_strided(self.data(), &broadcast_strides(self.shape(), shape), shape, &mut out);
        }
        Tensor::from_op(out, shape, &[self], Broadcast)
    }

    /// Reorders the dimensions: dimension `i` of the result is dimension `axes[i]` of this tensor.
    ///
    /// Panics if `axes` is not a permutation of the dimensions.
    #[track_caller]
    pub fn permute(&self, axes: &[usize]) -> Self {
        let mut sorted = axes.to_vec();
        sorted.sort_unstable();
        assert!(sorted.into_iter().eq(0..self.ndim()), "permute: {axes:?} is not a permutation of the dimensions of {:?}", self.shape());
        let mut strides = vec![1; self.ndim()];
        for i in (0..self.ndim().saturating_sub(1)).rev() {
            strides[i] = strides[i + 1] * self.shape()[i + 1];
        }
        let shape: Vec<usize> = axes.iter().map(|&a| self.shape()[a]).collect();
        let strides: Vec<usize> = axes.iter().map(|&a| strides[a]).collect();
        let mut out = Buffer::stale(self.len());
        copy_strided(self.data(), &strides, &shape, &mut out);
        Tensor::from_op(out, &shape, &[self], Permute { axes: axes.to_vec() })
    }

    /// Exchanges the last two dimensions.
    ///
    /// Panics if there are fewer than two dimensions.
    #[track_caller]
    pub fn transpose(&self) -> Self {
        let n = self.ndim();
        assert!(n >= 2, "transpose: shape {:?} has fewer than two dimensions", self.shape());
        let mut axes: Vec<usize> = (0..n).collect();
        axes.swap(n - 2, n - 1);
        self.permute(&axes)
    }

    /// Returns the entries `start..start + len` of one axis.
    ///
    /// Panics if the axis does not exist or the range exceeds it.
    #[track_caller]
    pub fn narrow(&self, axis: usize, start: usize, len: usize) -> Self {
        assert!(
            axis < self.ndim() && start + len <= self.shape()[axis],
            "narrow: the range {start}..{} of axis {axis} is out of range for a tensor of shape {:?}",
            start + len,
            self.shape()
        );
        let mut shape = self.shape().to_vec();
        shape[axis] = len;
        let inner: usize = shape[axis + 1..].iter().product();
        let (from, to) = (self.shape()[axis] * inner, len * inner);
        let mut out = Buffer::stale(shape.iter().product());
        let x = self.data();
        copy_rows(&mut out, to, |row| &x[row * from + start * inner..][..to]);
        Tensor::from_op(out, &shape, &[self], Narrow { axis, start })
    }

    /// Returns entry `at` of an axis, which is removed.
    ///
    /// Panics if the axis or the entry does not exist.
    #[track_caller]
    pub fn index_axis(&self, axis: usize, at: usize) -> Self {
        let shape = self.shape_without("index_axis", axis);
        assert!(at < self.shape()[axis], "index_axis: index {at} of axis {axis} is out of range for a tensor of shape {:?}", self.shape());
        self.narrow(axis, at, 1).reshape(&shape)
    }

    /// Pads an axis with zeros to the length `total`; this tensor begins at entry `start` of the result. This is the adjoint of [`Tensor::narrow`].
    ///
    /// Panics if the axis does not exist or if this tensor does not fit.
    #[track_caller]
    pub fn pad(&self, axis: usize, start: usize, total: usize) -> Self {
        self.check_axis("pad", axis);
        let len = self.shape()[axis];
        assert!(start + len <= total, "pad: axis {axis} of a tensor of shape {:?} does not fit into {start}..{total}", self.shape());
        let mut shape = self.shape().to_vec();
        shape[axis] = total;
        let inner: usize = shape[axis + 1..].iter().product();
        let (from, to) = (len * inner, total * inner);
        let mut out = Buffer::stale(shape.iter().product());
        let x = self.data();
        parallel::for_each_rows(&mut out, to, |first, chunk| {
            for (r, row) in chunk.chunks_exact_mut(to.max(1)).enumerate() {
                row[..start * inner].fill(T::zero());
                row[start * inner..][..from].copy_from_slice(&x[(first + r) * from..][..from]);
                row[start * inner + from..].fill(T::zero());
            }
        });
        Tensor::from_op(out, &shape, &[self], Pad { axis, start, len })
    }

    /// Concatenates tensors along an existing axis.
    ///
    /// Panics if there are no tensors, if the axis does not exist, or if the other dimensions differ.
    #[track_caller]
    pub fn concat(parts: &[&Tensor<T>], axis: usize) -> Self {
        assert!(!parts.is_empty(), "concat: no tensors");
        let mut shape = parts[0].shape().to_vec();
        assert!(axis < shape.len(), "concat: axis {axis} is out of range for tensors of shape {shape:?}");
        for part in parts {
            let same = part.ndim() == shape.len() && (0..shape.len()).all(|i| i == axis || part.shape()[i] == shape[i]);
            assert!(same, "concat: shapes {:?} and {:?} differ outside axis {axis}", parts[0].shape(), part.shape());
        }
        shape[axis] = parts.iter().map(|p| p.shape()[axis]).sum();
        let inner: usize = shape[axis + 1..].iter().product();
        let width = shape[axis] * inner;
        let mut out = Buffer::stale(shape.iter().product());
        parallel::for_each_rows(&mut out, width, |first, chunk| {
            for (r, row) in chunk.chunks_exact_mut(width.max(1)).enumerate() {
                let mut at = 0;
                for part in parts {
                    let n = part.shape()[axis] * inner;
                    row[at..at + n].copy_from_slice(&part.data()[(first + r) * n..][..n]);
                    at += n;
                }
            }
        });
        Tensor::from_op(out, &shape, parts, Concat { axis })
    }

    /// Stacks tensors of the same shape along a new axis.
    ///
    /// Panics if there are no tensors, if the shapes differ, or if `axis` is larger than their number of dimensions.
    #[track_caller]
    pub fn stack(parts: &[&Tensor<T>], axis: usize) -> Self {
        for part in parts {
            assert_eq!(part.shape(), parts[0].shape(), "stack: shapes {:?} and {:?} differ", parts[0].shape(), part.shape());
        }
        let parts: Vec<Tensor<T>> = parts.iter().map(|p| p.unsqueeze(axis)).collect();
        Self::concat(&parts.iter().collect::<Vec<_>>(), axis)
    }
}

fn copy_rows<'a, T: Real>(out: &mut [T], width: usize, row: impl Fn(usize) -> &'a [T] + Sync) {
    parallel::for_each_rows(out, width, |first, chunk| {
        let row = |r: usize| row(first + r);
        match width {
            1 => copy_short_rows::<T, 1>(chunk, row),
            2 => copy_short_rows::<T, 2>(chunk, row),
            3 => copy_short_rows::<T, 3>(chunk, row),
            4 => copy_short_rows::<T, 4>(chunk, row),
            _ => chunk.chunks_exact_mut(width.max(1)).enumerate().for_each(|(r, target)| target.copy_from_slice(row(r))),
        }
    });
}

/// Copies rows of a width that the compiler knows. Otherwise it would call `memcpy` for each row, which takes longer than the copy.
fn copy_short_rows<'a, T: Real, const WIDTH: usize>(out: &mut [T], row: impl Fn(usize) -> &'a [T]) {
    for (r, target) in out.as_chunks_mut::<WIDTH>().0.iter_mut().enumerate() {
        target.copy_from_slice(&row(r)[..WIDTH]);
    }
}

/// Copies `x`, read with the given strides in the order of `shape`, to `out`. A stride of 0 repeats values.
fn copy_strided<T: Real>(x: &[T], strides: &[usize], shape: &[usize], out: &mut [T]) {
    let Some((&cols, outer)) = shape.split_last() else {
        out.copy_from_slice(&x[..out.len()]);
        return;
    };
    if cols == 0 {
        return;
    }
    let step = strides[outer.len()];
    let outer = IxDyn(outer);
    parallel::for_each_rows(out, cols, |first, chunk| {
        for (r, row) in chunk.chunks_exact_mut(cols).enumerate() {
            let (mut rest, mut offset) = (first + r, 0);
            for i in (0..outer.ndim()).rev() {
                offset += rest % outer[i] * strides[i];
                rest /= outer[i];
            }
            match step {
                0 => row.fill(x[offset]),
                1 => row.copy_from_slice(&x[offset..offset + cols]),
                _ => row.iter_mut().enumerate().for_each(|(c, v)| *v = x[offset + c * step]),
            }
        }
    });
}
