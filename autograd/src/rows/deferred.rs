//! Row gradients that are added up later, bucket by bucket.

use crate::pool::Buffer;
use crate::real::Real;
use std::fmt::Debug;
use std::sync::Arc;

/// A row gradient that is not added up: what each bucket of rows gets can be computed by itself, in an order that only the data decide.
pub trait RowSums<T: Real>: Debug + Send + Sync {
    /// A bucket is this power of two of consecutive rows; at least 6.
    fn bucket_shift(&self) -> u32;

    /// True if no row of the bucket gets anything.
    fn is_empty(&self, bucket: usize) -> bool;

    /// Adds to `sums`, one row of values for each row of the bucket, and sets the bit of each row that something was added to.
    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]);
}

/// Two of a table: what the first adds to a row, then the second.
#[derive(Debug)]
pub(super) struct Both<T: Real> {
    parts: [Arc<dyn RowSums<T>>; 2],
    table_rows: usize,
    width: usize,
}

impl<T: Real> Both<T> {
    pub fn new(parts: [Arc<dyn RowSums<T>>; 2], table_rows: usize, width: usize) -> Self {
        Both { parts, table_rows, width }
    }

    /// The buckets of one of them that lie in one of ours.
    fn inside(&self, part: &dyn RowSums<T>, bucket: usize) -> std::ops::Range<usize> {
        let finer = self.bucket_shift() - part.bucket_shift();
        let all = self.table_rows.div_ceil(1 << part.bucket_shift());
        bucket << finer..((bucket + 1) << finer).min(all)
    }
}

impl<T: Real> RowSums<T> for Both<T> {
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

/// Buckets in groups of neighbours, of a number that does not depend on the threads: a group is what one task works on.
pub(crate) struct RowGroups {
    pub(crate) count: usize,
    buckets: usize,
    bucket_rows: usize,
    table_rows: usize,
    buckets_per_group: usize,
}

impl RowGroups {
    pub(crate) fn new(table_rows: usize, bucket_rows: usize) -> Self {
        let buckets = table_rows.div_ceil(bucket_rows);
        let buckets_per_group = buckets.div_ceil(64).max(1);
        RowGroups { count: buckets.div_ceil(buckets_per_group), buckets, bucket_rows, table_rows, buckets_per_group }
    }

    /// Rows of one group; the last group may have fewer.
    pub(crate) fn rows_per_group(&self) -> usize {
        self.buckets_per_group * self.bucket_rows
    }

    /// Calls `f(bucket, sums, touched)` for the buckets of a group that get anything. `f` finds sums of zero wherever nothing was added, and
    /// must leave zeros everywhere and no bit set.
    pub(crate) fn for_each_bucket<T: Real>(
        &self,
        group: usize,
        width: usize,
        rows: &dyn RowSums<T>,
        mut f: impl FnMut(usize, &mut [T], &mut [u64]),
    ) {
        let first = group * self.buckets_per_group;
        let mut scratch: Option<(Buffer<T>, Vec<u64>)> = None;
        for bucket in first..(first + self.buckets_per_group).min(self.buckets) {
            if rows.is_empty(bucket) {
                continue;
            }
            let (sums, touched) =
                scratch.get_or_insert_with(|| (Buffer::zeros(self.bucket_rows * width), vec![0u64; self.bucket_rows.div_ceil(64)]));
            let here = self.bucket_rows.min(self.table_rows - bucket * self.bucket_rows);
            rows.add(bucket, &mut sums[..here * width], touched);
            f(bucket, &mut sums[..here * width], touched);
        }
    }
}
