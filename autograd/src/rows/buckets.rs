//! A stable counting sort of entries by bucket. The caller stores the entries; this module computes their positions.

use std::ops::Range;

/// The index range of each bucket in an array of entries that is sorted by bucket.
///
/// Sorting takes two passes over the entries. [`Buckets::count`] counts the entries of each bucket. Then the caller visits the entries again in the same
/// order, gets the index of each from [`BucketCursors::take`], and stores its data at that index, in one or several arrays. The sort is stable: the entries
/// of a bucket keep their order.
///
/// ```
/// use autograd::rows::Buckets;
///
/// let rows = [70, 5, 130, 6];
/// let bucket = |row: u32| row as usize >> 6;
/// let mut cursors = Buckets::count(3, rows.iter().map(|&row| bucket(row)));
/// let mut sorted = vec![0; cursors.total()];
/// for row in rows {
///     sorted[cursors.take(bucket(row))] = row;
/// }
/// let buckets = cursors.filled();
/// assert_eq!(sorted, [5, 6, 70, 130]);
/// assert_eq!(sorted[buckets.range(1)], [70]);
/// ```
#[derive(Clone, Debug)]
pub struct Buckets {
    /// `starts[b]` is the index of the first entry of bucket b. The last two elements are the total number of entries.
    starts: Vec<u32>,
}

/// The next free index of each bucket, while the entries are being stored.
#[derive(Debug)]
pub struct BucketCursors {
    /// `starts[b + 1]` is the next free index of bucket b. When all entries are stored, it is the index of the first entry of bucket b + 1.
    starts: Vec<u32>,
}

impl Buckets {
    /// Counts the entries of each of `count` buckets, given the bucket of each entry. There must be fewer than 2³² entries.
    ///
    /// Panics if the bucket of an entry is `count` or more.
    #[inline(always)]
    pub fn count(count: usize, entries: impl IntoIterator<Item = usize>) -> BucketCursors {
        let mut starts = vec![0u32; count + 2];
        let counts = &mut starts[2..];
        entries.into_iter().for_each(|bucket| counts[bucket] += 1);
        for b in 2..starts.len() {
            starts[b] += starts[b - 1];
        }
        BucketCursors { starts }
    }

    /// Returns the index range of the entries of a bucket.
    #[inline(always)]
    pub fn range(&self, bucket: usize) -> Range<usize> {
        self.starts[bucket] as usize..self.starts[bucket + 1] as usize
    }

    /// Returns the index range of the entries of consecutive buckets.
    pub fn ranges(&self, buckets: Range<usize>) -> Range<usize> {
        self.starts[buckets.start] as usize..self.starts[buckets.end] as usize
    }
}

impl BucketCursors {
    /// Returns the number of entries of all buckets.
    pub fn total(&self) -> usize {
        self.starts[self.starts.len() - 1] as usize
    }

    /// Returns the index of the next entry of a bucket and advances the cursor of the bucket.
    #[inline(always)]
    pub fn take(&mut self, bucket: usize) -> usize {
        let next = &mut self.starts[bucket + 1];
        *next += 1;
        (*next - 1) as usize
    }

    /// Returns the index ranges of the buckets. The caller must have called [`BucketCursors::take`] once for each counted entry.
    pub fn filled(self) -> Buckets {
        Buckets { starts: self.starts }
    }
}

/// Returns the buckets of `1 << shift` rows that contain the given rows. Each bucket is returned once, in the order of its first row in `rows`.
#[inline(always)]
pub fn buckets_of<const K: usize>(rows: [u32; K], shift: u32) -> impl Iterator<Item = usize> {
    let all = rows.map(|row| row >> shift);
    (0..K).filter(move |&k| !all[..k].contains(&all[k])).map(move |k| all[k] as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A multiplicative congruential sequence: enough disorder for a test.
    fn random(state: &mut u64, below: usize) -> usize {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 33) as usize % below
    }

    #[test]
    fn entries_are_those_of_a_stable_sort_for_any_sizes() {
        let state = &mut 7;
        // The cases include no items, one bucket, and more buckets than entries.
        for case in 0..300 {
            let (items, shift) = (random(state, 1 + case), 6 + random(state, 3) as u32);
            let table = 1 + random(state, 1000);
            let buckets = table.div_ceil(1 << shift);
            // The rows of an item may lie in several buckets or in the same one.
            let rows: Vec<[u32; 4]> = (0..items).map(|_| std::array::from_fn(|_| random(state, table) as u32)).collect();

            let mut want: Vec<(usize, usize)> = Vec::new();
            for (item, rows) in rows.iter().enumerate() {
                let mut own = rows.map(|row| row as usize >> shift).to_vec();
                own.sort_unstable();
                own.dedup();
                want.extend(own.into_iter().map(|bucket| (bucket, item)));
            }
            want.sort_by_key(|&(bucket, _)| bucket);

            let mut cursors = Buckets::count(buckets, rows.iter().flat_map(|&rows| buckets_of(rows, shift)));
            assert_eq!(cursors.total(), want.len());
            let mut got = vec![(usize::MAX, 0); cursors.total()];
            for (item, &rows) in rows.iter().enumerate() {
                buckets_of(rows, shift).for_each(|bucket| got[cursors.take(bucket)] = (bucket, item));
            }
            let sorted = cursors.filled();
            assert_eq!(got, want, "{items} items, {buckets} buckets");
            assert_eq!(sorted.ranges(0..buckets), 0..want.len());
            for bucket in 0..buckets {
                assert!(want[sorted.range(bucket)].iter().all(|&(b, _)| b == bucket));
            }
        }
    }

    #[test]
    fn no_buckets_have_no_entries() {
        assert_eq!(Buckets::count(0, []).filled().ranges(0..0), 0..0);
    }

    #[test]
    #[should_panic(expected = "index out of bounds: the len is 3")]
    fn a_bucket_beyond_the_last_is_refused() {
        Buckets::count(3, [1, 3]);
    }
}
