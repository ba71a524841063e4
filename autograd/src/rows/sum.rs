//! Parallel sums of many contributions to few rows, in an order that does not depend on the number of threads.
//!
//! A touch is one contribution of an item to a row. The items are divided into chunks of a size that does not depend on the number of threads, and each chunk
//! sorts its touches by bucket of rows. Each bucket then belongs to one task, which adds the touches chunk by chunk, in the order of the items.
//!
//! With short rows and few threads, [`add_short_rows`] is faster: each thread scans all row numbers for the rows of its part of the table, without sorting.

use super::buckets::{Buckets, buckets_of};
use super::sparse::RowSparse;
use crate::parallel::{self, dispatched, split_lengths};
use crate::pool::Buffer;
use crate::real::Real;

/// Size in bytes of the row values of a bucket: half of a typical second-level cache.
const BUCKET_BYTES: usize = 256 * 1024;

/// The items that touch each bucket of rows.
struct Grouping {
    /// A bucket has `1 << shift` rows, at least 64, so that each bucket has whole words of a bitmap.
    shift: u32,
    buckets: usize,
    /// For each chunk of items, the item numbers sorted by bucket.
    chunks: Vec<(Buckets, Buffer<u32>)>,
}

/// Item `i` touches the rows `touch(i).0` with the weights `touch(i).1`.
pub(crate) trait Touch<T, const K: usize>: Fn(usize) -> ([u32; K], [T; K]) + Sync {}
impl<T, const K: usize, F: Fn(usize) -> ([u32; K], [T; K]) + Sync> Touch<T, K> for F {}

impl Grouping {
    /// Groups items by bucket.
    ///
    /// Panics with the name of the op if an item touches a row that is out of range.
    #[track_caller]
    fn new<T: Real, const K: usize>(op: &str, table_rows: usize, width: usize, items: usize, touch: &impl Touch<T, K>) -> Self {
        let fitting = BUCKET_BYTES / (width.max(1) * size_of::<T>());
        let shift = fitting.max(64).ilog2();
        let buckets = table_rows.div_ceil(1 << shift);
        let chunks = parallel::map_chunks(items, items.div_ceil(64).max(4096), |range| {
            let mut largest = 0;
            let entries = range.clone().flat_map(|i| {
                let rows = touch(i).0;
                largest = rows.iter().fold(largest, |largest, &row| row.max(largest));
                buckets_of(rows, shift).filter(|&bucket| bucket < buckets)
            });
            let mut cursors = Buckets::count(buckets, entries);
            if largest as usize >= table_rows {
                return Err(largest);
            }
            let mut numbers = Buffer::stale(cursors.total());
            for i in range {
                buckets_of(touch(i).0, shift).for_each(|bucket| numbers[cursors.take(bucket)] = i as u32);
            }
            Ok((cursors.filled(), numbers))
        });
        match chunks.into_iter().collect() {
            Ok(chunks) => Grouping { shift, buckets, chunks },
            Err(row) => panic!("{op}: row {row} is out of range for a table of {table_rows} rows"),
        }
    }

    /// Returns the items that touch a bucket, in order, one slice for each chunk.
    fn items_of(&self, bucket: usize) -> impl Iterator<Item = &[u32]> {
        self.chunks.iter().map(move |(buckets, numbers)| &numbers[buckets.range(bucket)])
    }
}

/// Adds weights[k] · values[item] to row rows[k], for each item and each k, with `(rows, weights) = touch(item)`. Returns the touched rows, sorted, and their
/// sums.
///
/// Panics with the name of the op if an item touches a row that is out of range.
#[track_caller]
pub(crate) fn sum_into_rows<T: Real, const K: usize>(
    op: &str,
    shape: &[usize],
    items: usize,
    touch: impl Touch<T, K>,
    values: &[T],
) -> RowSparse<T> {
    let width: usize = shape[1..].iter().product();
    let grouping = Grouping::new(op, shape[0], width, items, &touch);
    let shift = grouping.shift;
    let words_per_bucket = (1usize << shift) / 64;

    let mut bitmap = Buffer::<u64>::zeros(grouping.buckets * words_per_bucket);
    let counts: Vec<usize> = {
        let words: Vec<&mut [u64]> = bitmap.chunks_mut(words_per_bucket).collect();
        let mut counts = vec![0usize; grouping.buckets];
        let work: Vec<_> = words.into_iter().zip(counts.iter_mut()).collect();
        parallel::for_each_item(work, |b, (words, count)| {
            for part in grouping.items_of(b) {
                for &i in part {
                    for row in touch(i as usize).0 {
                        if (row >> shift) as usize == b {
                            let local = row as usize & ((1 << shift) - 1);
                            words[local / 64] |= 1 << (local % 64);
                        }
                    }
                }
            }
            *count = words.iter().map(|w| w.count_ones() as usize).sum();
        });
        counts
    };

    let touched: usize = counts.iter().sum();
    let mut rows = Buffer::<u32>::stale(touched);
    let mut sums = Buffer::<T>::stale(touched * width);
    let work: Vec<_> = split_lengths(&mut rows, counts.iter().copied())
        .into_iter()
        .zip(split_lengths(&mut sums, counts.iter().map(|n| n * width)))
        .zip(bitmap.chunks(words_per_bucket))
        .collect();
    parallel::for_each_item(work, |b, ((rows, sums), words)| {
        let mut rank = Vec::with_capacity(words.len());
        let mut k = 0;
        for (w, &word) in words.iter().enumerate() {
            rank.push(k as u32);
            let mut left = word;
            while left != 0 {
                rows[k] = ((b << shift) + w * 64) as u32 + left.trailing_zeros();
                left &= left - 1;
                k += 1;
            }
        }
        sums.fill(T::zero());
        let slot = |local: usize| {
            let word = words[local / 64] & ((1 << (local % 64)) - 1);
            rank[local / 64] as usize + word.count_ones() as usize
        };
        accumulate(&grouping, b, &touch, values, width, sums, &slot);
    });
    RowSparse::new(shape, rows, sums)
}

/// Adds row i of `values` to row `rows[i]` of a table, in the order of i.
#[track_caller]
pub(crate) fn add_into_table<T: Real>(table: &mut [T], width: usize, rows: &[u32], values: &[T]) {
    let touch = |i: usize| ([rows[i]], [T::one()]);
    let grouping = Grouping::new("add_rows", table.len() / width.max(1), width, rows.len(), &touch);
    let parts: Vec<&mut [T]> = table.chunks_mut(width << grouping.shift).collect();
    parallel::for_each_item(parts, |b, part| accumulate(&grouping, b, &touch, values, width, part, &|local| local));
}

/// Adds row i of `values` to row `rows[i]` of a table with short rows, in the order of i. Each thread scans all row numbers for the rows of its part of the
/// table. With few threads this is less work than sorting the rows; the sums are the same.
pub(crate) fn add_short_rows<T: Real, const W: usize>(table: &mut [T], rows: &[u32], values: &[T]) {
    let part = (table.len() / W).div_ceil(parallel::threads()).max(1);
    let parts: Vec<&mut [T]> = table.chunks_mut(part * W).collect();
    parallel::for_each_item(parts, |p, part_table| add_own_rows::<T, W>((p * part) as u32, part_table, rows, values));
}

dispatched! {
/// Adds the contributions to the rows of a part of the table that begins at row `first`, and skips all others.
fn add_own_rows<T: Real, const W: usize>(first: u32, table: &mut [T], rows: &[u32], values: &[T]) {
    const RUN: usize = 1024;
    let table = table.as_chunks_mut::<W>().0;
    let mut own = [0u16; RUN];
    for (rows, values) in rows.chunks(RUN).zip(values.as_chunks::<W>().0.chunks(RUN)) {
        // Whether a row belongs to this part is unpredictable, so the loop has no branch that depends on it.
        let mut n = 0;
        for (i, &row) in rows.iter().enumerate() {
            own[n] = i as u16;
            n += usize::from((row.wrapping_sub(first) as usize) < table.len());
        }
        for &i in &own[..n] {
            let (target, value) = (&mut table[(rows[i as usize] - first) as usize], &values[i as usize]);
            for c in 0..W {
                target[c] += value[c];
            }
        }
    }
}
}

/// Adds the touches of one bucket, in the order of the items. Loops with a constant width exist for density (1), RGB (3) and spherical harmonics of degree 2
/// (27), and for the widths 4 and 28, which `benches/ops.rs` measures.
fn accumulate<T: Real, const K: usize>(
    grouping: &Grouping,
    bucket: usize,
    touch: &impl Touch<T, K>,
    values: &[T],
    width: usize,
    out: &mut [T],
    slot: &impl Fn(usize) -> usize,
) {
    let args = Bucket { grouping, bucket, values, width };
    match width {
        1 => accumulate_rows::<T, K, 1, _, _>(args, touch, out, slot),
        3 => accumulate_rows::<T, K, 3, _, _>(args, touch, out, slot),
        4 => accumulate_rows::<T, K, 4, _, _>(args, touch, out, slot),
        27 => accumulate_rows::<T, K, 27, _, _>(args, touch, out, slot),
        28 => accumulate_rows::<T, K, 28, _, _>(args, touch, out, slot),
        _ => accumulate_rows::<T, K, 0, _, _>(args, touch, out, slot),
    }
}

#[derive(Clone, Copy)]
struct Bucket<'a, T> {
    grouping: &'a Grouping,
    bucket: usize,
    values: &'a [T],
    width: usize,
}

dispatched! {
/// Adds the touches of one bucket. `W` is the width, or 0 if the width is known at run time only.
fn accumulate_rows<T: Real, const K: usize, const W: usize, F: Touch<T, K>, S: Fn(usize) -> usize>(
    args: Bucket<'_, T>,
    touch: &F,
    out: &mut [T],
    slot: &S,
) {
    let Bucket { grouping, bucket, values, width } = args;
    let width = if W == 0 { width } else { W };
    let shift = grouping.shift;
    for part in grouping.items_of(bucket) {
        for &i in part {
            let i = i as usize;
            let (rows, weights) = touch(i);
            let value = &values[i * width..][..width];
            for k in 0..K {
                if (rows[k] >> shift) as usize == bucket {
                    let local = rows[k] as usize & ((1 << shift) - 1);
                    let target = &mut out[slot(local) * width..][..width];
                    if W == 0 {
                        for (t, &v) in target.iter_mut().zip(value) {
                            *t += weights[k] * v;
                        }
                    } else {
                        for c in 0..W {
                            target[c] += weights[k] * value[c];
                        }
                    }
                }
            }
        }
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A multiplicative congruential sequence: enough disorder for a test.
    fn rows(n: usize, table: u32, seed: u64) -> Vec<u32> {
        let mut s = seed;
        (0..n)
            .map(|_| {
                s = s.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                ((s >> 33) as u32) % table
            })
            .collect()
    }

    #[test]
    fn sums_into_rows_equal_a_plain_loop_for_every_width() {
        for width in [1usize, 2, 3, 4, 12, 27, 28, 29, 48] {
            let (table, n) = (50_000usize, 30_000usize);
            let rows = rows(n, table as u32, 5);
            let values: Vec<f64> = (0..n * width).map(|i| (i % 1000) as f64 - 500.0).collect();
            let mut want = vec![0.0; table * width];
            for (i, &r) in rows.iter().enumerate() {
                for c in 0..width {
                    want[r as usize * width + c] += values[i * width + c];
                }
            }
            let got = sum_into_rows("test", &[table, width], n, |i| ([rows[i]], [1.0]), &values);
            assert!(got.rows().is_sorted_by(|a, b| a < b));
            assert_eq!(got.to_dense().data(), &want[..]);
            let mut dense = vec![0.0; table * width];
            add_into_table(&mut dense, width, &rows, &values);
            assert_eq!(dense, want);
        }
    }

    #[test]
    fn adding_rows_gives_the_same_bits_for_any_number_of_threads() {
        for width in [1usize, 3, 4, 28] {
            let (table, n) = (1003usize, 30_000usize);
            let rows = rows(n, table as u32, 6);
            let values: Vec<f32> = (0..n * width).map(|i| (i % 997) as f32 * 0.37 - 180.0).collect();
            let mut want = vec![0.5f32; table * width];
            for (i, &r) in rows.iter().enumerate() {
                for c in 0..width {
                    want[r as usize * width + c] += values[i * width + c];
                }
            }
            // With nine or more threads the rows are sorted.
            for threads in [1, 2, 3, 8, 9] {
                let mut got = vec![0.5f32; table * width];
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
                pool.install(|| crate::add_rows(&mut got, width, &rows, &values));
                assert!(got == want, "rows of {width}, {threads} threads");
            }
        }
    }
}
