//! Entries by bucket: a stable counting sort that leaves it to its caller what an entry is and where it is stored.

use std::ops::Range;

/// Where the entries of each bucket begin, once they are sorted by bucket.
///
/// Sorting takes two passes over the entries. [`Buckets::count`] reads the bucket of each; then the caller takes them in the same order, asks
/// [`Places::take`] for the place of each and stores there whatever belongs to it, in as many arrays as it likes. So the entries of a bucket keep
/// their order.
///
/// ```
/// use autograd::rows::Buckets;
///
/// let rows = [70, 5, 130, 6];
/// let bucket = |row: u32| row as usize >> 6;
/// let mut places = Buckets::count(3, rows.iter().map(|&row| bucket(row)));
/// let mut sorted = vec![0; places.total()];
/// for row in rows {
///     sorted[places.take(bucket(row))] = row;
/// }
/// let buckets = places.filled();
/// assert_eq!(sorted, [5, 6, 70, 130]);
/// assert_eq!(sorted[buckets.range(1)], [70]);
/// ```
#[derive(Clone, Debug)]
pub struct Buckets {
    /// Of bucket b at b; the number of all entries from the number of buckets on.
    starts: Vec<u32>,
}

/// The places that the entries of each bucket will have, some of them taken.
#[derive(Debug)]
pub struct Places {
    /// The next free place of bucket b at b + 1. When all are taken, this is where bucket b + 1 begins.
    starts: Vec<u32>,
}

impl Buckets {
    /// Counts the entries of `count` buckets, given the bucket of each entry.
    ///
    /// Panics if an entry has a bucket of `count` or more. There must be fewer than 2³² entries.
    #[inline(always)]
    pub fn count(count: usize, entries: impl IntoIterator<Item = usize>) -> Places {
        let mut starts = vec![0u32; count + 2];
        let counts = &mut starts[2..];
        entries.into_iter().for_each(|bucket| counts[bucket] += 1);
        for b in 2..starts.len() {
            starts[b] += starts[b - 1];
        }
        Places { starts }
    }

    /// The places of the entries of a bucket.
    #[inline(always)]
    pub fn range(&self, bucket: usize) -> Range<usize> {
        self.starts[bucket] as usize..self.starts[bucket + 1] as usize
    }

    /// The places of the entries of consecutive buckets.
    pub fn ranges(&self, buckets: Range<usize>) -> Range<usize> {
        self.starts[buckets.start] as usize..self.starts[buckets.end] as usize
    }
}

impl Places {
    /// The number of entries of all buckets.
    pub fn total(&self) -> usize {
        self.starts[self.starts.len() - 1] as usize
    }

    /// The place of the next entry of a bucket.
    #[inline(always)]
    pub fn take(&mut self, bucket: usize) -> usize {
        let next = &mut self.starts[bucket + 1];
        *next += 1;
        (*next - 1) as usize
    }

    /// The buckets, for a caller who has taken a place for each entry that was counted.
    pub fn filled(self) -> Buckets {
        Buckets { starts: self.starts }
    }
}

/// The buckets of `1 << shift` rows in which some rows lie: each once, in the order in which the rows come to them.
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
        // No items, one bucket, and more buckets than entries are among them.
        for case in 0..300 {
            let (items, shift) = (random(state, 1 + case), 6 + random(state, 3) as u32);
            let table = 1 + random(state, 1000);
            let buckets = table.div_ceil(1 << shift);
            // An item has rows in several buckets, or repeats one.
            let rows: Vec<[u32; 4]> = (0..items).map(|_| std::array::from_fn(|_| random(state, table) as u32)).collect();

            let mut want: Vec<(usize, usize)> = Vec::new();
            for (item, rows) in rows.iter().enumerate() {
                let mut own = rows.map(|row| row as usize >> shift).to_vec();
                own.sort_unstable();
                own.dedup();
                want.extend(own.into_iter().map(|bucket| (bucket, item)));
            }
            want.sort_by_key(|&(bucket, _)| bucket);

            let mut places = Buckets::count(buckets, rows.iter().flat_map(|&rows| buckets_of(rows, shift)));
            assert_eq!(places.total(), want.len());
            let mut got = vec![(usize::MAX, 0); places.total()];
            for (item, &rows) in rows.iter().enumerate() {
                buckets_of(rows, shift).for_each(|bucket| got[places.take(bucket)] = (bucket, item));
            }
            let sorted = places.filled();
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
