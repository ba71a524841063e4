//! [`RowSparse`]: row-sparse gradients.

use super::deferred::{Known, LazySum, RowGroups, RowSums};
use super::merge::union;
use crate::parallel::{self, split_lengths};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use ndarray::{ArrayView2, Dimension, IxDyn};
use std::sync::{Arc, OnceLock};

/// A row-sparse gradient of a table `[R, …]`: sorted, unique row numbers, and one row of values for each.
///
/// The sums may be lazy ([`RowSums`]). An optimizer then computes them bucket by bucket while it updates the table, and [`RowSparse::rows`],
/// [`RowSparse::values`] and [`RowSparse::data`] compute all of them on first use. The values are the same in both cases.
#[derive(Debug, Clone)]
pub struct RowSparse<T: Real> {
    shape: IxDyn,
    sums: Option<Arc<dyn RowSums<T>>>,
    merged: OnceLock<Merged<T>>,
}

/// Sorted, unique rows and their sums.
#[derive(Debug, Clone)]
struct Merged<T: Real> {
    rows: Buffer<u32>,
    values: Buffer<T>,
}

impl<T: Real> RowSparse<T> {
    /// Creates a row-sparse gradient of a table with the given shape from sorted, unique row numbers and one row of values for each.
    ///
    /// Panics if the row numbers are not sorted and unique, if one is out of range, or if the number of values does not fit.
    #[track_caller]
    pub fn new(shape: &[usize], rows: Buffer<u32>, values: Buffer<T>) -> Self {
        let width: usize = shape[1..].iter().product();
        assert_eq!(rows.len() * width, values.len(), "RowSparse: {} values for {} rows of width {width}", values.len(), rows.len());
        assert!(rows.is_sorted_by(|a, b| a < b), "RowSparse: rows must be sorted and unique");
        assert!(
            rows.last().is_none_or(|&last| (last as usize) < shape[0]),
            "RowSparse: a row number is out of range for a table of {} rows",
            shape[0]
        );
        RowSparse { shape: IxDyn(shape), sums: None, merged: OnceLock::from(Merged { rows, values }) }
    }

    /// Creates a row-sparse gradient of a table with the given shape, with lazy sums.
    ///
    /// Panics if a bucket of the sums has fewer than 64 rows.
    pub fn deferred(shape: &[usize], sums: Arc<dyn RowSums<T>>) -> Self {
        assert!(sums.bucket_shift() >= 6, "RowSparse: a bucket has at least 64 rows");
        RowSparse { shape: IxDyn(shape), sums: Some(sums), merged: OnceLock::new() }
    }

    /// Returns the sum of two gradients of the same table. The sum is lazy if one of them is lazy and not yet computed.
    pub(crate) fn plus(self, other: Self) -> Self {
        let (shape, width) = (self.shape().to_vec(), self.width());
        // The sums of a lazy part come first, so that the sum of both has the bits of the union.
        let with_known = |lazy: Arc<dyn RowSums<T>>, gradient: Self| -> [Arc<dyn RowSums<T>>; 2] {
            let shift = lazy.bucket_shift();
            [lazy, Arc::new(Known { gradient, shift })]
        };
        let parts = match (self.lazy(), other.lazy()) {
            (Some(a), Some(b)) => [a, b],
            (Some(lazy), None) => with_known(lazy, other),
            (None, Some(lazy)) => with_known(lazy, self),
            (None, None) => return union(self, other),
        };
        Self::deferred(&shape, Arc::new(LazySum::new(parts, shape[0], width)))
    }

    /// Returns the lazy sums to share them, or `None` if they have already been computed.
    fn lazy(&self) -> Option<Arc<dyn RowSums<T>>> {
        self.sums.clone().filter(|_| self.merged.get().is_none())
    }

    /// Computes the sums now and drops the contributions, which frees their memory.
    pub fn added_up(mut self) -> Self {
        self.merged();
        self.sums = None;
        self
    }

    /// Returns the shape of the table.
    pub fn shape(&self) -> &[usize] {
        self.shape.slice()
    }

    /// Returns the number of elements in a row.
    pub fn width(&self) -> usize {
        self.shape()[1..].iter().product()
    }

    /// Returns the numbers of the touched rows, in ascending order.
    pub fn rows(&self) -> &[u32] {
        &self.merged().rows
    }

    /// Returns the values of the touched rows, `[rows, width]`.
    pub fn values(&self) -> ArrayView2<'_, T> {
        ArrayView2::from_shape((self.rows().len(), self.width()), self.data()).expect("one row of values for each row")
    }

    /// Returns the values of the touched rows, in row-major order.
    pub fn data(&self) -> &[T] {
        &self.merged().values
    }

    /// Returns the gradient as a dense tensor of the shape of the table.
    pub fn to_dense(&self) -> Tensor<T> {
        let mut out = Buffer::zeros(self.shape.size());
        self.add_to(&mut out);
        Tensor::from_buffer(out, self.shape())
    }

    /// Adds the gradient to a table.
    pub(crate) fn add_to(&self, table: &mut [T]) {
        let width = self.width();
        match self.unmerged() {
            None => parallel::for_each_table_row(table, width, self.rows(), |k, row| {
                row.iter_mut().zip(&self.data()[k * width..]).for_each(|(t, &v)| *t += v);
            }),
            Some(sums) => {
                let bucket_rows = 1usize << sums.bucket_shift();
                parallel::for_each_chunk(table, bucket_rows * width, |start, bucket| {
                    sums.add(start / (bucket_rows * width), bucket, &mut vec![0; bucket_rows / 64]);
                });
            }
        }
    }

    /// Returns the lazy sums, or `None` if they have already been computed.
    pub(crate) fn unmerged(&self) -> Option<&dyn RowSums<T>> {
        self.sums.as_deref().filter(|_| self.merged.get().is_none())
    }

    /// Returns the rows and their sums, which are computed on first use.
    fn merged(&self) -> &Merged<T> {
        self.merged.get_or_init(|| {
            let sums = self.sums.as_deref().expect("sums or their result");
            let (width, rows) = (self.width(), self.shape()[0]);
            let bucket_rows = 1usize << sums.bucket_shift();
            let groups = RowGroups::new(rows, bucket_rows, width);
            let parts = parallel::map_indices(groups.count, |group| {
                let (mut found, mut values) = (Vec::new(), Vec::new());
                groups.for_each_bucket(group, sums, |bucket, sums, touched| {
                    take_bits(touched, |local| {
                        let row = &mut sums[local * width..][..width];
                        found.push((bucket * bucket_rows + local) as u32);
                        values.extend_from_slice(row);
                        row.fill(T::zero());
                    });
                });
                (found, values)
            });
            let total: usize = parts.iter().map(|(rows, _)| rows.len()).sum();
            let (mut rows, mut values) = (Buffer::stale(total), Buffer::stale(total * width));
            let lengths = || parts.iter().map(|(rows, _)| rows.len());
            let targets: Vec<_> =
                split_lengths(&mut rows, lengths()).into_iter().zip(split_lengths(&mut values, lengths().map(|n| n * width))).collect();
            parallel::for_each_item(targets, |i, (rows, values)| {
                rows.copy_from_slice(&parts[i].0);
                values.copy_from_slice(&parts[i].1);
            });
            Merged { rows, values }
        })
    }
}

/// Calls `f` with the index of each bit that is set, and clears the bit.
fn take_bits(words: &mut [u64], mut f: impl FnMut(usize)) {
    for (w, word) in words.iter_mut().enumerate() {
        let mut left = std::mem::take(word);
        while left != 0 {
            f(w * 64 + left.trailing_zeros() as usize);
            left &= left - 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradients::{Grad, Gradients};
    use crate::optim::{Adam, AdamMode, Momentum, Optimizer, RmsProp, Sgd};
    use crate::param::{Bounds, Param};
    use std::collections::HashMap;

    /// Adds i to the even columns and −i to the odd columns of row (37 i) mod 1003, for i below 300.
    #[derive(Debug)]
    struct Some300 {
        width: usize,
        shift: u32,
    }

    fn row(i: usize) -> usize {
        37 * i % 1003
    }

    impl RowSums<f64> for Some300 {
        fn bucket_shift(&self) -> u32 {
            self.shift
        }
        fn is_empty(&self, bucket: usize) -> bool {
            self.shift <= 7 && (bucket << self.shift) >> 7 == 3
        }
        fn add(&self, bucket: usize, sums: &mut [f64], touched: &mut [u64]) {
            for i in (0..300).filter(|&i| row(i) >> self.shift == bucket && row(i) >> 7 != 3) {
                let local = row(i) - (bucket << self.shift);
                for c in 0..self.width {
                    sums[self.width * local + c] += if c % 2 == 0 { i as f64 } else { -(i as f64) };
                }
                touched[local / 64] |= 1 << (local % 64);
            }
        }
    }

    fn deferred(width: usize) -> RowSparse<f64> {
        deferred_by(7, width)
    }

    fn deferred_by(shift: u32, width: usize) -> RowSparse<f64> {
        RowSparse::deferred(&[1003, width], Arc::new(Some300 { width, shift }))
    }

    #[test]
    fn two_sums_for_later_are_one_whatever_their_buckets() {
        let twice = deferred(3).to_dense() * 2.0;
        for (a, b) in [(6, 6), (6, 9), (8, 7), (7, 12)] {
            let both = deferred_by(a, 3).plus(deferred_by(b, 3));
            assert!(both.unmerged().is_some());
            assert_eq!(both.to_dense().data(), twice.data(), "buckets of 2^{a} and 2^{b} rows");
            assert_eq!(both.rows(), deferred(3).rows());
            assert_eq!(both.plus(deferred_by(a, 3)).to_dense().data(), (deferred(3).to_dense() * 3.0).data());
        }
    }

    #[test]
    fn a_sum_for_later_and_known_rows_have_the_bits_of_their_union() {
        let mut known: Vec<u32> = (0..1003).filter(|row| row % 5 == 0 || (400..520).contains(row)).collect();
        known.push(1002);
        let values: Vec<f64> = (0..3 * known.len()).map(|i| 1.0 / (i as f64 + 3.0)).collect();
        let known = || RowSparse::new(&[1003, 3], known.clone().into(), values.clone().into());
        let want = union(deferred(3).added_up(), known());
        for sum in [deferred(3).plus(known()), known().plus(deferred(3)), known().plus(deferred_by(6, 3))] {
            assert!(sum.unmerged().is_some());
            assert_eq!(sum.to_dense().data(), want.to_dense().data());
            assert_eq!((sum.rows(), sum.data()), (want.rows(), want.data()));
        }
    }

    #[test]
    fn sums_for_later_are_those_rows_in_order() {
        let rows = deferred(2);
        assert!(rows.unmerged().is_some());
        let dense = rows.to_dense();
        assert!(rows.unmerged().is_some(), "the table alone does not need the rows");
        assert!(rows.rows().is_sorted_by(|a, b| a < b) && !rows.rows().iter().any(|row| row >> 7 == 3));
        assert!(rows.unmerged().is_none());
        let mut want = vec![0.0; 2006];
        for i in (0..300).filter(|&i| row(i) >> 7 != 3) {
            want[2 * row(i)] += i as f64;
            want[2 * row(i) + 1] -= i as f64;
        }
        assert_eq!(dense.data(), want);
        assert_eq!(rows.to_dense().data(), want);
    }

    #[test]
    fn every_optimizer_does_the_same_with_sums_for_later_and_with_their_rows() {
        type Make = fn() -> Box<dyn Optimizer<f64>>;
        let optimizers: [Make; 5] = [
            || Box::new(Sgd::new(0.01)),
            || Box::new(Momentum::new(0.01, 0.9)),
            || Box::new(RmsProp::new(0.1)),
            || Box::new(Adam::new(0.1, AdamMode::Lazy)),
            || Box::new(Adam::new(0.1, AdamMode::Dense)),
        ];
        // Rows that are updated in groups, one by one and, for 5 and 12, in runs.
        for (make, width) in optimizers.into_iter().flat_map(|make| [1, 2, 3, 5, 12, 27].map(|width| (make, width))) {
            let run = |merge: bool| {
                let mut param = Param::from_tensor("table", Tensor::full(&[1003, width], 0.5));
                param.set_bounds(Bounds { low: 0.45, high: 0.55 });
                let mut optimizer = make();
                for step in 0..3 {
                    let rows = deferred(width);
                    if merge {
                        rows.rows();
                    }
                    let by_leaf = HashMap::from([(param.tensor().id().expect("a leaf"), Grad::Rows(rows))]);
                    optimizer.step(&mut param, &Gradients { by_leaf }, step);
                }
                param.tensor().data().to_vec()
            };
            let (later, now) = (run(false), run(true));
            assert!(later == now);
            assert!(later.iter().all(|v| (0.45..=0.55).contains(v)) && later.contains(&0.45) && (width == 1 || later.contains(&0.55)));
        }
    }
}
