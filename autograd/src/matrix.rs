//! Products of matrices in slices, computed on one thread by the `gemm` crate, or, in mixed precision, by `bf16.rs`.
//!
//! The crate takes pointers, which requires one unsafe call, in `product_in_order`. The tests of the matrix product compare it with a safe triple loop.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod bf16;

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

    /// Returns true if the columns are contiguous, and not the rows.
    fn is_transposed(&self) -> bool {
        self.row == 1 && self.col != 1
    }

    /// Returns the index of the last entry plus one, or 0 for an empty matrix.
    fn reach(&self) -> usize {
        if self.rows == 0 || self.cols == 0 { 0 } else { (self.rows - 1) * self.row + (self.cols - 1) * self.col + 1 }
    }
}

#[cfg(target_arch = "x86_64")]
impl<'a, T: Real> Matrix<'a, T> {
    fn as_f32(self) -> Option<Matrix<'a, f32>> {
        let Matrix { rows, cols, row, col, .. } = self;
        T::as_f32(self.data).map(|data| Matrix { data, rows, cols, row, col })
    }
}

/// Precision of products of `f32` matrices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Factors and sums are `f32`.
    #[default]
    Full,
    /// Factors are rounded to bf16, which has the exponent of `f32` and eight binary digits; sums are `f32`, and subnormal numbers count as 0. `torch.autocast` on
    /// a CPU also rounds the results. It needs a processor with AVX512-BF16, such as AMD Zen 4; there, a network of eight layers of 128 takes 0.6 times as long, and
    /// one with 32, 64 and 16 columns is not faster. On other processors it is [`Precision::Full`]. Products of `f64` matrices are always `f64`.
    Mixed,
}

impl Precision {
    /// Returns `Mixed` if `mixed`, otherwise `Full`.
    pub fn mixed_if(mixed: bool) -> Self {
        if mixed { Precision::Mixed } else { Precision::Full }
    }

    /// Returns true if this processor has the instructions. Without them, `Mixed` is `Full`.
    pub fn is_available(self) -> bool {
        match self {
            Precision::Full => true,
            #[cfg(target_arch = "x86_64")]
            Precision::Mixed => bf16::is_available(),
            #[cfg(not(target_arch = "x86_64"))]
            Precision::Mixed => false,
        }
    }
}

/// Computes out = a · b on this thread, for kernels. `out` is in row-major order.
///
/// Panics if the sizes do not fit.
#[track_caller]
pub fn multiply<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T], precision: Precision) {
    product(a, b, out, false, precision);
}

/// Computes out += a · b on this thread, for kernels. `out` is in row-major order.
///
/// Panics if the sizes do not fit.
#[track_caller]
pub fn add_product<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T], precision: Precision) {
    product(a, b, out, true, precision);
}

/// Largest number of columns of a result that is computed transposed.
const NARROW: usize = 32;

#[track_caller]
fn product<T: Real>(a: Matrix<'_, T>, b: Matrix<'_, T>, out: &mut [T], add: bool, precision: Precision) {
    let (m, n) = (a.rows, b.cols);
    assert!(
        b.rows == a.cols && out.len() == m * n,
        "multiply: {m} × {} times {} × {n} into {} numbers; expected [m, k] times [k, n] into m · n numbers",
        a.cols,
        b.rows,
        out.len()
    );
    #[cfg(not(target_arch = "x86_64"))]
    let _ = precision;
    #[cfg(target_arch = "x86_64")]
    if precision == Precision::Mixed
        && precision.is_available()
        && let (Some(a), Some(b)) = (a.as_f32(), b.as_f32())
        && let Some(out) = T::as_f32_mut(out)
    {
        return bf16::product(a, b, out, add);
    }
    // The library computes up to 64 numbers of a row at once. A narrow result has fewer; its transpose has long rows. They are contiguous in `a` if it is a
    // transposed view, as for the gradient of a weight.
    if !a.is_transposed() || n == 0 || n >= m || n > NARROW {
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
    use crate::random::Stream;

    /// As for the gradient of a weight with few outputs: the result is narrow, and its transpose is computed.
    #[test]
    fn narrow_products_with_a_transposed_matrix_are_added() {
        let numbers = |n: usize| -> Vec<f64> { (0..n).map(|i| (i * 7919 % 1000) as f64 / 500.0 - 1.0).collect() };
        for (m, k, n) in [(40, 300, 16), (33, 5, 32), (3, 7, 1), (4, 0, 2)] {
            let (a, b) = (numbers(m * k), numbers(k * n));
            let mut out = numbers(m * n);
            let before = out.clone();
            add_product(Matrix::transposed(&a, m, k), Matrix::new(&b, k, n), &mut out, Precision::Full);
            for (i, (out, before)) in out.iter().zip(before).enumerate() {
                let want = before + (0..k).map(|l| a[l * m + i / n] * b[l * n + i % n]).sum::<f64>();
                assert!((out - want).abs() < 1e-9, "{m} × {k} × {n}");
            }
        }
    }

    /// The nearest bf16 number, the even one of two.
    fn rounded(x: f32) -> f64 {
        let bits = x.to_bits();
        f64::from(f32::from_bits((bits + 0x7fff + (bits >> 16 & 1)) & 0xffff_0000))
    }

    /// Puts numbers that are not finite in the pool of buffers, from which copies of factors are made.
    fn spoil_free_buffers(m: usize, k: usize, n: usize) {
        let sizes = [m, n].map(|width| width.next_multiple_of(32) * (k.div_ceil(2).next_multiple_of(16) + 1));
        drop(sizes.map(|size| Buffer::from(vec![0x7fc0_7fc0u32; size])));
    }

    #[test]
    fn mixed_products_are_those_of_rounded_factors() {
        let random = Stream::new(5);
        let numbers = |name: &str, n: usize| random.named(name).normal_tensor::<f32>(&[n], 0.0, 1.0).data().to_vec();
        let factor = |x: f32| if Precision::Mixed.is_available() { rounded(x) } else { f64::from(x) };
        let small = [(1, 1, 1), (3, 7, 1), (0, 3, 2), (2, 0, 5), (3, 2, 0), (17, 33, 35), (50, 64, 70)];
        let large = [(40, 300, 16), (33, 5, 32), (256, 128, 128), (256, 48, 3), (101, 157, 67), (7, 515, 129)];
        for (m, k, n) in small.into_iter().chain(large) {
            let (a, b, before) = (numbers("a", m * k), numbers("b", k * n), numbers("out", m * n));
            for case in 0..8 {
                let [is_a_transposed, is_b_transposed, add] = [1, 2, 4].map(|bit| case & bit != 0);
                let (x, y) = (Matrix::stored(&a, m, k, is_a_transposed), Matrix::stored(&b, k, n, is_b_transposed));
                let mut out = before.clone();
                spoil_free_buffers(m, k, n);
                product(x, y, &mut out, add, Precision::Mixed);
                for (i, (&out, &before)) in out.iter().zip(&before).enumerate() {
                    let term = |l: usize| factor(a[i / n * x.row + l * x.col]) * factor(b[l * y.row + i % n * y.col]);
                    let want = (0..k).map(term).sum::<f64>() + if add { f64::from(before) } else { 0.0 };
                    // Sums of f32. Factors that are not rounded as expected have an error of about 0.002 √k.
                    assert!((f64::from(out) - want).abs() < 1e-6 * (k + 10) as f64, "{m} × {k} × {n}, case {case}: {out}, {want}");
                }
            }
        }
    }

    #[test]
    fn a_number_that_is_not_finite_stays_in_its_row_and_column_in_mixed_precision() {
        let (m, k, n) = (19, 21, 37);
        for bad in [f32::NAN, f32::INFINITY] {
            let (mut a, b) = (vec![1.0; m * k], vec![1.0; k * n]);
            a[5 * k + k - 1] = bad;
            let mut out = vec![0.0; m * n];
            multiply(Matrix::new(&a, m, k), Matrix::new(&b, k, n), &mut out, Precision::Mixed);
            assert!(out.iter().enumerate().all(|(i, &x)| if i / n == 5 { !x.is_finite() } else { x == k as f32 }));
        }
    }

    #[test]
    fn products_of_f64_are_exact_in_mixed_precision_too() {
        let mut out = [0.0];
        multiply(Matrix::new(&[1.0 / 3.0], 1, 1), Matrix::new(&[3.0], 1, 1), &mut out, Precision::Mixed);
        assert_eq!(out, [1.0]);
    }

    #[test]
    #[should_panic(expected = "multiply: 1 × 2 times 1 × 1 into 1 numbers")]
    fn sizes_that_do_not_fit_are_refused_in_mixed_precision() {
        multiply(Matrix::new(&[1.0f32, 2.0], 1, 2), Matrix::new(&[3.0], 1, 1), &mut [0.0], Precision::Mixed);
    }
}
