//! Row-sparse gradients with lazy sums, which are computed bucket by bucket.

use super::sparse::RowSparse;
use crate::pool::Buffer;
use crate::real::Real;
use std::fmt::Debug;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard};

/// A row-sparse gradient whose sums have not been computed. The sums of each bucket of rows can be computed independently, in an order that depends on the
/// data only.
pub trait RowSums<T: Real>: Debug + Send + Sync {
    /// Returns the base-2 logarithm of the number of consecutive rows in a bucket, at least 6.
    fn bucket_shift(&self) -> u32;

    /// Returns true if the bucket has no contributions.
    fn is_empty(&self, bucket: usize) -> bool;

    /// Adds the contributions of a bucket to `sums`, which has one row of values for each row of the bucket, and sets the bit in `touched` of each row that has
    /// contributions. Rows whose sum is 0 may be left out. It must not write to the sums of rows whose bit it does not set.
    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]);
}

/// The lazy sum of two row-sparse gradients of one table. For each row, the contributions of the first are added before those of the second.
#[derive(Debug)]
pub(super) struct LazySum<T: Real> {
    parts: [Arc<dyn RowSums<T>>; 2],
    table_rows: usize,
    width: usize,
}

impl<T: Real> LazySum<T> {
    pub fn new(parts: [Arc<dyn RowSums<T>>; 2], table_rows: usize, width: usize) -> Self {
        LazySum { parts, table_rows, width }
    }

    /// Returns the buckets of a part that lie in a bucket of the sum. A bucket of the sum has the larger of the two bucket sizes.
    fn inside(&self, part: &dyn RowSums<T>, bucket: usize) -> Range<usize> {
        let finer = self.bucket_shift() - part.bucket_shift();
        let all = self.table_rows.div_ceil(1 << part.bucket_shift());
        bucket << finer..((bucket + 1) << finer).min(all)
    }
}

impl<T: Real> RowSums<T> for LazySum<T> {
    fn bucket_shift(&self) -> u32 {
        self.parts[0].bucket_shift().max(self.parts[1].bucket_shift())
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.parts.iter().all(|part| self.inside(&**part, bucket).all(|b| part.is_empty(b)))
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        for part in &self.parts {
            let rows = 1usize << part.bucket_shift();
            let buckets = self.inside(&**part, bucket);
            let chunks = sums.chunks_mut(rows * self.width).zip(touched.chunks_mut(rows / 64)).zip(buckets);
            for ((sums, touched), b) in chunks.filter(|(_, b)| !part.is_empty(*b)) {
                part.add(b, sums, touched);
            }
        }
    }
}

/// A gradient whose sums are known, in buckets of 2^`shift` rows.
#[derive(Debug)]
pub(super) struct Known<T: Real> {
    pub gradient: RowSparse<T>,
    pub shift: u32,
}

impl<T: Real> Known<T> {
    /// Returns the places of the rows of a bucket among all rows of the gradient.
    fn places(&self, bucket: usize) -> Range<usize> {
        let before = |bucket: usize| self.gradient.rows().partition_point(|&row| (row as usize) < bucket << self.shift);
        before(bucket)..before(bucket + 1)
    }
}

impl<T: Real> RowSums<T> for Known<T> {
    fn bucket_shift(&self) -> u32 {
        self.shift
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.places(bucket).is_empty()
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let (width, places) = (self.gradient.width(), self.places(bucket));
        let values = self.gradient.data()[places.start * width..places.end * width].chunks_exact(width.max(1));
        for (&row, values) in self.gradient.rows()[places].iter().zip(values) {
            let local = row as usize - (bucket << self.shift);
            sums[local * width..][..width].iter_mut().zip(values).for_each(|(sum, &value)| *sum += value);
            touched[local / 64] |= 1 << (local % 64);
        }
    }
}

/// The buckets of a table, in groups of consecutive buckets. One task processes one group. The number of groups does not depend on the number of threads.
pub(crate) struct RowGroups<T: Real> {
    pub(crate) count: usize,
    buckets: usize,
    bucket_rows: usize,
    table_rows: usize,
    width: usize,
    buckets_per_group: usize,
    /// Scratch arrays of tasks that have ended. The next task usually finds them in the cache of its thread.
    idle: Mutex<Vec<Scratch<T>>>,
}

/// Sums of the rows of a bucket, and the bits of rows with contributions; all zero between two buckets.
struct Scratch<T: Real> {
    sums: Buffer<T>,
    touched: Vec<u64>,
}

impl<T: Real> RowGroups<T> {
    pub(crate) fn new(table_rows: usize, bucket_rows: usize, width: usize) -> Self {
        let buckets = table_rows.div_ceil(bucket_rows);
        let buckets_per_group = buckets.div_ceil(64).max(1);
        let count = buckets.div_ceil(buckets_per_group);
        RowGroups { count, buckets, bucket_rows, table_rows, width, buckets_per_group, idle: Mutex::default() }
    }

    /// Returns the number of rows of a group; the last group may have fewer.
    pub(crate) fn rows_per_group(&self) -> usize {
        self.buckets_per_group * self.bucket_rows
    }

    fn idle(&self) -> MutexGuard<'_, Vec<Scratch<T>>> {
        self.idle.lock().unwrap_or_else(|e| e.into_inner())
    }

    fn scratch(&self) -> Scratch<T> {
        // The list must be unlocked while zeros are written: threads do that together, and one of them may begin another task meanwhile.
        let idle = self.idle().pop();
        let zeros = || Scratch { sums: Buffer::zeros(self.bucket_rows * self.width), touched: vec![0; self.bucket_rows.div_ceil(64)] };
        idle.unwrap_or_else(zeros)
    }

    /// Calls `f(bucket, sums, touched)` for each bucket of a group that has contributions. The sums of rows without contributions are zero. `f` must reset all
    /// sums to zero and clear all bits.
    pub(crate) fn for_each_bucket(&self, group: usize, rows: &dyn RowSums<T>, mut f: impl FnMut(usize, &mut [T], &mut [u64])) {
        let first = group * self.buckets_per_group;
        let mut buckets = (first..(first + self.buckets_per_group).min(self.buckets)).filter(|&bucket| !rows.is_empty(bucket)).peekable();
        if buckets.peek().is_none() {
            return;
        }
        let mut scratch = self.scratch();
        let Scratch { sums, touched } = &mut scratch;
        for bucket in buckets {
            let here = self.bucket_rows.min(self.table_rows - bucket * self.bucket_rows);
            rows.add(bucket, &mut sums[..here * self.width], touched);
            f(bucket, &mut sums[..here * self.width], touched);
            debug_assert!(sums.iter().all(|sum| *sum == T::zero()) && touched.iter().all(|bits| *bits == 0));
        }
        self.idle().push(scratch);
    }
}
