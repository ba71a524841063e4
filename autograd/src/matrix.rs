//! Products of matrices in slices, computed on one thread by the `gemm` crate.
//!
//! The crate takes pointers, which requires one unsafe call, in `product_in_order`. The tests of the matrix product compare it with a safe triple loop.
#![allow(unsafe_code)]

use crate::pool::Buffer;
use crate::real::Real;

/// A view of a matrix in a slice.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a, T> {
    /// Entry (r, c) is at index r · `row` + c · `col`.
    data: &'a [T],
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    row: usize,
    col: usize,
}

impl<'a, T> Matrix<'a, T> {
    /// Returns a view of a `rows` × `cols` matrix that is stored in row-major order.
    ///
    /// Panics if the slice has another length.
    #[track_caller]
    pub fn new(data: &'a [T], rows: usize, cols: usize) -> Self {
        Self::stored(data, rows, cols, false)
    }

    /// Returns a view of a `rows` × `cols` matrix whose transpose is stored in row-major order.
    ///
    /// Panics if the slice has another length.
    #[track_caller]
    pub fn transposed(data: &'a [T], rows: usize, cols: usize) -> Self {
        Self::stored(data, rows, cols, true)
    }

    #[track_caller]
    pub(crate) fn stored(data: &'a [T], rows: usize, cols: usize, transposed: bool) -> Self {
        assert_eq!(data.len(), rows * cols, "matmul: a matrix of {rows} × {cols}");
        let (row, col) = if transposed { (1, rows) } else { (cols, 1) };
        Matrix { data, rows, cols, row, col }
    }

    /// Returns the transpose, a view of the same numbers.
    pub fn transpose(self) -> Self {
        Matrix { rows: self.cols, cols: self.rows, row: self.col, col: self.row, ..self }
    }

    pub(crate) fn rows(self, range: std::ops::Range<usize>) -> Self {
        assert!(range.end <= self.rows);
        Matrix { data: &self.data[(range.start * self.row).min(self.data.len())..], rows: range.len(), ..self }
    }

    pub(crate) fn cols(self, range: std::ops::Range<usize>) -> Self {
        assert!(range.end <= self.cols);
        Matrix { data: &self.data[(range.start * self.col).min(self.data.len())..], cols: range.len(), ..self }
    }

    /// Returns the index of the last entry plus one, or 0 for an empty matrix.
    fn reach(&self) -> usize {
        if self.rows == 0 || self.cols == 0 { 0 } else { (self.rows - 1) * self.row + (self.cols - 1) * self.col + 1 }
    }
}

/// Computes out = a · b on this thread, for kernels. `out` is in row-major order.
///
/// Panics if the sizes do not fit.
#[track_caller]
pub fn multiply<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T]) {
    product(a, b, out, false);
}

/// Computes out += a · b on this thread, for kernels. `out` is in row-major order.
///
/// Panics if the sizes do not fit.
#[track_caller]
pub fn add_product<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T]) {
    product(a, b, out, true);
}

/// Largest number of columns of a result that is computed transposed.
const NARROW: usize = 32;

#[track_caller]
fn product<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T], add: bool) {
    let (m, n) = (a.rows, b.cols);
    assert!(out.len() == m * n);
    // The library computes up to 64 numbers of a row at once. A narrow result has fewer; its transpose has long rows. They are contiguous in `a` if it is a
    // transposed view, as for the gradient of a weight.
    let is_transposed = a.row == 1 && a.col != 1;
    if !is_transposed || n == 0 || n >= m || n > NARROW {
        return product_in_order(a, b, out, add);
    }
    let mut transposed = Buffer::stale(m * n);
    product_in_order(b.transpose(), a.transpose(), &mut transposed, false);
    for (i, row) in out.chunks_exact_mut(n).enumerate() {
        for (j, entry) in row.iter_mut().enumerate() {
            let new = transposed[j * m + i];
            *entry = if add { *entry + new } else { new };
        }
    }
}

#[track_caller]
fn product_in_order<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T], add: bool) {
    let (m, k, n) = (a.rows, a.cols, b.cols);
    assert!(b.rows == k && out.len() == m * n && a.reach() <= a.data.len() && b.reach() <= b.data.len());
    if m == 0 || n == 0 || k == 0 {
        if !add {
            out.fill(T::zero());
        }
        return;
    }
    let kept = if add { T::one() } else { T::zero() };
    // SAFETY: the assertion ensures that every entry that the call reads or writes, at the given strides, lies inside the three slices. `out` is borrowed
    // uniquely, and `T` is f32 or f64, which the library supports.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            add,
            a.data.as_ptr(),
            a.col as isize,
            a.row as isize,
            b.data.as_ptr(),
            b.col as isize,
            b.row as isize,
            kept,
            T::one(),
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As for the gradient of a weight with few outputs: the result is narrow, and its transpose is computed.
    #[test]
    fn narrow_products_with_a_transposed_matrix_are_added() {
        let numbers = |n: usize| -> Vec<f64> { (0..n).map(|i| (i * 7919 % 1000) as f64 / 500.0 - 1.0).collect() };
        for (m, k, n) in [(40, 300, 16), (33, 5, 32), (3, 7, 1), (4, 0, 2)] {
            let (a, b) = (numbers(m * k), numbers(k * n));
            let mut out = numbers(m * n);
            let before = out.clone();
            add_product(Matrix::transposed(&a, m, k), Matrix::new(&b, k, n), &mut out);
            for (i, (out, before)) in out.iter().zip(before).enumerate() {
                let want = before + (0..k).map(|l| a[l * m + i / n] * b[l * n + i % n]).sum::<f64>();
                assert!((out - want).abs() < 1e-9, "{m} × {k} × {n}");
            }
        }
    }
}
