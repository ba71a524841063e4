//! The only place that knows rayon: fixed chunks, in-order reductions, loops compiled for several instruction sets.
//!
//! Chunk bounds depend on sizes and never on the number of threads, and partial sums are combined in chunk order, so every result has
//! the same bits for any thread count.

use crate::gradients::{RowGroups, RowSums};
use crate::real::Real;
use rayon::prelude::*;

/// Compiles a function for several instruction sets and picks the best at run time. Their results differ at most in the last place of an exponential: see [`fused`].
/// Builds with debug assertions, in which the tests run, have the portable version only: every crate that uses
/// a generic loop compiles it anew, and four versions of each would take minutes.
#[macro_export]
macro_rules! dispatched {
    ($(#[$meta:meta])* $visibility:vis fn $($rest:tt)*) => {
        $(#[$meta])*
        #[cfg_attr(not(debug_assertions), multiversion::multiversion(targets(
            "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
            "x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
            "aarch64+neon",
        )))]
        $visibility fn $($rest)*
    };
}
pub(crate) use dispatched; // The macro is exported: a crate that uses it needs `multiversion`.

/// True if the loops below run in a version that multiplies and adds in one instruction.
pub fn fused() -> bool {
    #[cfg(target_arch = "x86_64")]
    let available = std::is_x86_feature_detected!("avx2")
        && std::is_x86_feature_detected!("fma")
        && std::is_x86_feature_detected!("bmi1")
        && std::is_x86_feature_detected!("bmi2")
        && std::is_x86_feature_detected!("lzcnt")
        && std::is_x86_feature_detected!("popcnt");
    #[cfg(not(target_arch = "x86_64"))]
    let available = cfg!(target_arch = "aarch64");
    available && !cfg!(debug_assertions)
}

/// Elements handed to a thread at a time: large enough to hide the hand-over, small enough to stay in a core's cache.
pub const CHUNK: usize = 16 * 1024;

/// Chunk length for rows of `width` elements, in rows.
pub fn rows_per_chunk(width: usize) -> usize {
    (CHUNK / width.max(1)).max(1)
}

/// Calls `f(first_row, rows)` for consecutive chunks of rows of `out`, in parallel.
pub fn for_each_rows<E: Send>(out: &mut [E], width: usize, f: impl Fn(usize, &mut [E]) + Sync) {
    let rows = rows_per_chunk(width);
    for_each_chunk(out, rows * width.max(1), |start, chunk| f(start / width.max(1), chunk));
}

/// Calls `f(start, chunk)` for consecutive chunks of `size` elements of `out`, in parallel.
pub fn for_each_chunk<E: Send>(out: &mut [E], size: usize, f: impl Fn(usize, &mut [E]) + Sync) {
    if out.len() <= size {
        if !out.is_empty() {
            f(0, out);
        }
        return;
    }
    out.par_chunks_mut(size).enumerate().for_each(|(i, chunk)| f(i * size, chunk));
}

/// Calls `f(i)` for `0..n`, in parallel, and collects in order.
pub fn map_indices<R: Send>(n: usize, f: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    if n <= 1 {
        return (0..n).map(f).collect();
    }
    (0..n).into_par_iter().map(f).collect()
}

/// Calls `f(i, item)` for every item, in parallel, in no particular order.
pub fn for_each_item<I: Send>(items: Vec<I>, f: impl Fn(usize, I) + Sync + Send) {
    items.into_par_iter().enumerate().for_each(|(i, item)| f(i, item));
}

/// Calls `f(i, item)` for every item, in parallel, and collects in order.
pub fn map_items<I: Send, R: Send>(items: Vec<I>, f: impl Fn(usize, I) -> R + Sync + Send) -> Vec<R> {
    items.into_par_iter().enumerate().map(|(i, item)| f(i, item)).collect()
}

/// Calls `f(start..end)` for consecutive chunks of `0..n` and collects the results in chunk order.
pub fn map_chunks<R: Send>(n: usize, size: usize, f: impl Fn(std::ops::Range<usize>) -> R + Sync + Send) -> Vec<R> {
    let chunks = n.div_ceil(size);
    map_indices(chunks, |i| f(i * size..((i + 1) * size).min(n)))
}

/// Cuts a slice into parts of the given lengths, which must not exceed it.
pub fn split_lengths<E>(mut rest: &mut [E], lengths: impl Iterator<Item = usize>) -> Vec<&mut [E]> {
    lengths
        .map(|n| {
            let (head, tail) = std::mem::take(&mut rest).split_at_mut(n);
            rest = tail;
            head
        })
        .collect()
}

/// Calls `f(k, row)` for the rows `rows[k]` of a table, in parallel. The row numbers are ascending and unique, so runs of them own
/// disjoint parts of the table.
pub fn for_each_table_row<E: Send>(table: &mut [E], width: usize, rows: &[u32], f: impl Fn(usize, &mut [E]) + Sync + Send) {
    let run = rows_per_chunk(width);
    let mut parts = Vec::with_capacity(rows.len().div_ceil(run));
    let (mut rest, mut begin) = (table, 0);
    for (i, rows) in rows.chunks(run).enumerate() {
        let (first, last) = (rows[0] as usize, rows[rows.len() - 1] as usize);
        let (_, tail) = std::mem::take(&mut rest).split_at_mut((first - begin) * width);
        let (part, tail) = tail.split_at_mut((last + 1 - first) * width);
        parts.push((i * run, rows, part));
        (rest, begin) = (tail, last + 1);
    }
    for_each_item(parts, |_, (k, rows, part)| {
        let first = rows[0] as usize;
        for (i, &row) in rows.iter().enumerate() {
            f(k + i, &mut part[(row as usize - first) * width..][..width]);
        }
    });
}

/// Fills a slice.
pub fn fill<E: Copy + Send + Sync>(out: &mut [E], value: E) {
    for_each_chunk(out, 4 * CHUNK, |_, chunk| chunk.fill(value));
}

/// Copies a slice.
pub fn copy<E: Copy + Send + Sync>(source: &[E], out: &mut [E]) {
    for_each_chunk(out, 4 * CHUNK, |start, chunk| chunk.copy_from_slice(&source[start..start + chunk.len()]));
}

/// `out[i] = f(x[i])`
pub fn map<T: Real>(x: &[T], out: &mut [T], f: impl Fn(T) -> T + Sync) {
    for_each_chunk(out, 2 * CHUNK, |start, chunk| map_loop(&x[start..start + chunk.len()], chunk, &f));
}

/// `out[i] = f(x[i], y[i])`
pub fn zip<T: Real>(x: &[T], y: &[T], out: &mut [T], f: impl Fn(T, T) -> T + Sync) {
    for_each_chunk(out, CHUNK, |start, chunk| {
        let range = start..start + chunk.len();
        zip_loop(&x[range.clone()], &y[range], chunk, &f);
    });
}

/// `x[i] = f(x[i], y[i])`
pub fn zip_in_place<T: Real>(x: &mut [T], y: &[T], f: impl Fn(T, T) -> T + Sync) {
    for_each_chunk(x, CHUNK, |start, chunk| zip_in_place_loop(chunk, &y[start..start + chunk.len()], &f));
}

/// `(x₁[i], x₂[i], …) = f((x₁[i], x₂[i], …), g[i])`: how an optimizer changes values and what it remembers of them.
pub fn update<T: Real, const N: usize>(x: [&mut [T]; N], g: &[T], f: impl Fn([T; N], T) -> [T; N] + Sync) {
    fn halves<T: Real, const N: usize, F: Fn([T; N], T) -> [T; N] + Sync>(x: [&mut [T]; N], g: &[T], f: &F) {
        if g.len() <= CHUNK {
            return update_loop(x, g, f);
        }
        let middle = (g.len() / 2).next_multiple_of(CHUNK);
        let (low, high) = split(x, middle);
        rayon::join(|| halves(low, &g[..middle], f), || halves(high, &g[middle..], f));
    }
    halves(x, g, &f);
}

/// The same for some rows of tables of `width` columns. `rows` ascend without repetition and `g` has one row for each; other rows stay.
pub fn update_rows<T: Real, const N: usize>(x: [&mut [T]; N], width: usize, rows: &[u32], g: &[T], f: impl Fn([T; N], T) -> [T; N] + Sync) {
    update_part::<T, N, false, _>(x, TableRows { first: 0, width, rows, g }, &f);
}

/// The same for the rows of a gradient that is not added up: each bucket's sums are computed and used while they are in the cache.
pub(crate) fn update_deferred<T: Real, const N: usize>(
    x: [&mut [T]; N],
    width: usize,
    rows: &dyn RowSums<T>,
    f: impl Fn([T; N], T) -> [T; N] + Sync,
) {
    let bucket_rows = 1usize << rows.bucket_shift();
    let groups = RowGroups::new(x[0].len() / width.max(1), bucket_rows);
    let mut parts: Vec<[&mut [T]; N]> = Vec::with_capacity(groups.count);
    let mut rest = x;
    for _ in 0..groups.count {
        let at = (groups.rows_per_group() * width).min(rest[0].len());
        let (part, tail) = split(rest, at);
        parts.push(part);
        rest = tail;
    }
    for_each_item(parts, |group, mut x| {
        let first = group * groups.rows_per_group();
        groups.for_each_bucket(group, width, rows, |bucket, sums, touched| {
            let start = (bucket * bucket_rows - first) * width;
            let x = x.each_mut().map(|x| &mut x[start..][..sums.len()]);
            match width {
                1 => update_touched::<T, N, 1, _>(x, width, sums, touched, &f),
                3 => update_touched::<T, N, 3, _>(x, width, sums, touched, &f),
                27 => update_touched::<T, N, 27, _>(x, width, sums, touched, &f),
                _ => update_touched::<T, N, 0, _>(x, width, sums, touched, &f),
            }
        });
    });
}

/// The same for all rows, `g` being zero in those that `rows` does not list.
pub fn update_all_rows<T: Real, const N: usize>(
    x: [&mut [T]; N],
    width: usize,
    rows: &[u32],
    g: &[T],
    f: impl Fn([T; N], T) -> [T; N] + Sync,
) {
    update_part::<T, N, true, _>(x, TableRows { first: 0, width, rows, g }, &f);
}

/// A part of a table that begins at row `first`, and which of its rows have a gradient.
#[derive(Clone, Copy)]
struct TableRows<'a, T> {
    first: usize,
    width: usize,
    rows: &'a [u32],
    g: &'a [T],
}

/// Halves the work until it is a chunk. A half of the ascending rows lies in a part of the table of its own, so nothing is shared.
/// `ALL` visits the rows without a gradient too.
fn update_part<T: Real, const N: usize, const ALL: bool, F: Fn([T; N], T) -> [T; N] + Sync>(
    x: [&mut [T]; N],
    part: TableRows<'_, T>,
    f: &F,
) {
    let TableRows { first, width, rows, g } = part;
    let count = if ALL { x[0].len() / width.max(1) } else { rows.len() };
    if count <= rows_per_chunk(width) {
        return match width {
            1 if !ALL => update_short_rows::<T, N, 1, F>(x, part, f),
            3 if !ALL => update_short_rows::<T, N, 3, F>(x, part, f),
            4 if !ALL => update_short_rows::<T, N, 4, F>(x, part, f),
            _ => update_runs::<T, N, ALL, F>(x, part, f),
        };
    }
    let cut = if ALL { first + count / 2 } else { rows[count / 2] as usize };
    let middle = rows.partition_point(|&row| (row as usize) < cut);
    let (low, high) = split(x, (cut - first) * width);
    let ((low_rows, high_rows), (low_g, high_g)) = (rows.split_at(middle), g.split_at(middle * width));
    rayon::join(
        || update_part::<T, N, ALL, F>(low, TableRows { rows: low_rows, g: low_g, ..part }, f),
        || update_part::<T, N, ALL, F>(high, TableRows { first: cut, rows: high_rows, g: high_g, ..part }, f),
    );
}

fn split<T, const N: usize>(x: [&mut [T]; N], at: usize) -> ([&mut [T]; N], [&mut [T]; N]) {
    let mut high = [const { None }; N];
    let mut k = 0;
    let low = x.map(|slice| {
        let (a, b) = slice.split_at_mut(at);
        high[k] = Some(b);
        k += 1;
        a
    });
    (low, high.map(Option::unwrap_or_default))
}

/// `Σ f(x[i])`: 64 running sums inside a chunk, chunk sums added in order.
pub fn sum<T: Real>(x: &[T], f: impl Fn(T) -> T + Sync + Send) -> T {
    map_chunks(x.len(), 4 * CHUNK, |range| sum_loop(&x[range], &f)).into_iter().sum()
}

dispatched! {
fn map_loop<T: Real, F: Fn(T) -> T>(x: &[T], out: &mut [T], f: &F) {
    for (o, &v) in out.iter_mut().zip(x) {
        *o = f(v);
    }
}
}

dispatched! {
fn zip_loop<T: Real, F: Fn(T, T) -> T>(x: &[T], y: &[T], out: &mut [T], f: &F) {
    for ((o, &a), &b) in out.iter_mut().zip(x).zip(y) {
        *o = f(a, b);
    }
}
}

dispatched! {
fn zip_in_place_loop<T: Real, F: Fn(T, T) -> T>(x: &mut [T], y: &[T], f: &F) {
    for (a, &b) in x.iter_mut().zip(y) {
        *a = f(*a, b);
    }
}
}

dispatched! {
fn update_loop<T: Real, const N: usize, F: Fn([T; N], T) -> [T; N]>(x: [&mut [T]; N], g: &[T], f: &F) {
    update_slices(x, g.len(), |i| g[i], f);
}
}

dispatched! {
/// Rows too short for a loop of their own are gathered, updated together and put back.
fn update_short_rows<T: Real, const N: usize, const W: usize, F: Fn([T; N], T) -> [T; N]>(x: [&mut [T]; N], part: TableRows<'_, T>, f: &F) {
    const TOGETHER: usize = 16;
    let mut x = x.map(|x| x.as_chunks_mut::<W>().0);
    let mut block = [[[T::zero(); W]; TOGETHER]; N];
    for (rows, g) in part.rows.chunks(TOGETHER).zip(part.g.chunks(TOGETHER * W)) {
        for (block, x) in block.iter_mut().zip(&x) {
            block.iter_mut().zip(rows).for_each(|(to, &row)| *to = x[row as usize - part.first]);
        }
        let slices = block.each_mut().map(|b| b.as_flattened_mut());
        // A constant length is worth a copy of the loop.
        if g.len() == TOGETHER * W { update_slices(slices, TOGETHER * W, |i| g[i], f) } else { update_slices(slices, g.len(), |i| g[i], f) }
        for (block, x) in block.iter().zip(&mut x) {
            block.iter().zip(rows).for_each(|(&from, &row)| x[row as usize - part.first] = from);
        }
    }
}
}

dispatched! {
/// Neighbouring rows are updated as one run; `ALL` fills the gaps with zero gradients.
fn update_runs<T: Real, const N: usize, const ALL: bool, F: Fn([T; N], T) -> [T; N]>(mut x: [&mut [T]; N], part: TableRows<'_, T>, f: &F) {
    let TableRows { first, width, rows, g } = part;
    let mut done = 0;
    let mut k = 0;
    while k < rows.len() {
        let run = (1..).take_while(|&n| rows.get(k + n).is_some_and(|&row| (row - rows[k]) as usize == n)).count() + 1;
        let (start, len) = ((rows[k] as usize - first) * width, run * width);
        if ALL {
            update_slices(x.each_mut().map(|x| &mut x[done..start]), start - done, |_| T::zero(), f);
            done = start + len;
        }
        let g = &g[k * width..][..len];
        update_slices(x.each_mut().map(|x| &mut x[start..][..len]), len, |i| g[i], f);
        k += run;
    }
    if ALL {
        let len = x[0].len() - done;
        update_slices(x.each_mut().map(|x| &mut x[done..]), len, |_| T::zero(), f);
    }
}
}

#[inline(always)]
#[allow(clippy::needless_range_loop)] // N arrays are walked at once.
fn update_slices<T: Real, const N: usize>(x: [&mut [T]; N], len: usize, g: impl Fn(usize) -> T, f: &impl Fn([T; N], T) -> [T; N]) {
    let x = x.map(|x| &mut x[..len]);
    for i in 0..len {
        let new = f(std::array::from_fn(|k| x[k][i]), g(i));
        for k in 0..N {
            x[k][i] = new[k];
        }
    }
}

dispatched! {
/// Updates the rows whose bits are set, neighbours together, and clears their sums and bits; `sums` has a row for each row of the tables.
/// `W` is the width, or 0 for one only known at run time.
pub(crate) fn update_touched<T: Real, const N: usize, const W: usize, F: Fn([T; N], T) -> [T; N]>(
    mut x: [&mut [T]; N],
    width: usize,
    sums: &mut [T],
    touched: &mut [u64],
    f: &F,
) {
    let width = if W == 0 { width } else { W };
    for (w, word) in touched.iter_mut().enumerate() {
        let mut left = std::mem::take(word);
        while left != 0 {
            let bit = left.trailing_zeros();
            let run = (left >> bit).trailing_ones();
            left &= if bit + run == 64 { 0 } else { !0 << (bit + run) };
            let start = (w * 64 + bit as usize) * width;
            if W != 0 && run == 1 {
                let g = &mut sums[start..][..W];
                update_slices(x.each_mut().map(|x| &mut x[start..][..W]), W, |i| g[i], f);
                g.fill(T::zero());
            } else {
                let len = run as usize * width;
                let g = &mut sums[start..][..len];
                update_slices(x.each_mut().map(|x| &mut x[start..][..len]), len, |i| g[i], f);
                g.fill(T::zero());
            }
        }
    }
}
}

dispatched! {
fn sum_loop<T: Real, F: Fn(T) -> T>(x: &[T], f: &F) -> T {
    const LANES: usize = 64;
    let mut lanes = [T::zero(); LANES];
    let (body, tail) = x.as_chunks::<LANES>();
    for block in body {
        for (lane, &v) in lanes.iter_mut().zip(block) {
            *lane += f(v);
        }
    }
    for (lane, &v) in lanes.iter_mut().zip(tail) {
        *lane += f(v);
    }
    // Halving keeps the error small and the order fixed.
    let mut width = LANES / 2;
    while width > 0 {
        for i in 0..width {
            lanes[i] += lanes[i + width];
        }
        width /= 2;
    }
    lanes[0]
}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn updates_of_rows_equal_a_plain_loop_for_every_width_and_leave_the_other_rows_alone() {
        let rule = |[x, v]: [f64; 2], g: f64| [x - g, 0.5 * v + g];
        for width in [1usize, 2, 3, 4, 28] {
            // Rows alone, rows in runs, and enough of both for several chunks.
            let table = 100_000 / width.min(4);
            let rows: Vec<u32> = (0..table as u32).filter(|r| r % 7 != 0 && (r % 64 < 20 || r % 3 == 0)).collect();
            let g: Vec<f64> = (0..rows.len() * width).map(|i| (i % 1000) as f64 + 1.0).collect();
            let start: Vec<f64> = (0..table * width).map(|i| i as f64).collect();

            let (mut x, mut v) = (start.clone(), start.clone());
            let mut dense = vec![0.0; table * width];
            for (k, &row) in rows.iter().enumerate() {
                for c in 0..width {
                    let at = row as usize * width + c;
                    dense[at] = g[k * width + c];
                    [x[at], v[at]] = rule([x[at], v[at]], dense[at]);
                }
            }
            let (mut got_x, mut got_v) = (start.clone(), start.clone());
            update_rows([&mut got_x, &mut got_v], width, &rows, &g, rule);
            assert!(got_x == x && got_v == v, "rows of width {width}");

            let (mut x, mut v) = (start.clone(), start.clone());
            update([&mut x, &mut v], &dense, rule);
            let (mut got_x, mut got_v) = (start.clone(), start.clone());
            update_all_rows([&mut got_x, &mut got_v], width, &rows, &g, rule);
            assert!(got_x == x && got_v == v, "all rows of width {width}");
            assert!(v.iter().zip(&start).zip(&dense).all(|((v, s), g)| *v == 0.5 * s + g));
        }
    }
}
