//! Parallel loops with reproducible results, and loops compiled for several instruction sets. Only this module uses rayon.
//!
//! Chunk bounds depend on sizes and never on the number of threads, and partial sums are combined in chunk order. Every result therefore has the same bits
//! for any number of threads.

mod gather;
mod prefetch;
pub(crate) mod streamed;
mod update;

use crate::pool::Pooled;
use crate::real::Real;
pub use gather::{gathered, pairs_around};
pub use prefetch::{load, prefetch, prefetch_early};
use rayon::prelude::*;
pub(crate) use update::update;

/// Compiles a function for several instruction sets and selects the best version at run time: AVX-512, AVX2 with FMA, NEON, or the baseline of the target.
///
/// The macro is for the inner loops of kernels. The function may be generic and may take closures, but not `self`. Functions that it calls must be
/// `#[inline(always)]`; otherwise they are compiled for the baseline only. Results differ between the versions if a loop uses fused multiply-add: see
/// [`fused`](crate::parallel::fused).
///
/// A crate that uses the macro needs no dependency except this one, since the macro refers to the crate `multiversion` through it. Test
/// builds choose among the same versions, but the compiler vectorizes loops only at `opt-level = 2` and above. Also test kernels with `--release`.
///
/// ```
/// use autograd::{Real, dispatched, parallel};
///
/// dispatched! {
/// /// out[i] = a x[i] + y[i]
/// fn axpy_loop<T: Real, const FUSED: bool>(a: T, x: &[T], y: &[T], out: &mut [T]) {
///     for ((o, &x), &y) in out.iter_mut().zip(x).zip(y) {
///         *o = a.multiply_add::<FUSED>(x, y);
///     }
/// }
/// }
///
/// fn axpy<T: Real>(a: T, x: &[T], y: &[T], out: &mut [T]) {
///     let chunk = |start: usize, out: &mut [T]| {
///         let range = start..start + out.len();
///         if parallel::fused() {
///             axpy_loop::<T, true>(a, &x[range.clone()], &y[range], out);
///         } else {
///             axpy_loop::<T, false>(a, &x[range.clone()], &y[range], out);
///         }
///     };
///     parallel::for_each_chunk(out, parallel::CHUNK, chunk);
/// }
///
/// let mut out = [0.0; 2];
/// axpy(2.0, &[1.0, 2.0], &[10.0, 20.0], &mut out);
/// assert_eq!(out, [12.0, 24.0]);
/// ```
#[macro_export]
macro_rules! dispatched {
    ($(#[$meta:meta])* $visibility:vis fn $($rest:tt)*) => {
        $(#[$meta])*
        #[$crate::multiversion::multiversion(targets(
            "x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
            "x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
            "aarch64+neon",
        ))]
        $visibility fn $($rest)*
    };
}
pub(crate) use dispatched;

/// Returns true if [`dispatched!`](crate::dispatched) loops run in a version that has fused multiply-add instructions.
pub fn fused() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        std::is_x86_feature_detected!("avx2")
            && std::is_x86_feature_detected!("fma")
            && std::is_x86_feature_detected!("bmi1")
            && std::is_x86_feature_detected!("bmi2")
            && std::is_x86_feature_detected!("lzcnt")
            && std::is_x86_feature_detected!("popcnt")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        cfg!(target_arch = "aarch64")
    }
}

/// Returns the number of threads of the current pool. Results must not depend on it.
pub fn threads() -> usize {
    rayon::current_num_threads()
}

/// Number of elements in a task: large enough to hide the overhead of scheduling, small enough for the cache of a core.
pub const CHUNK: usize = 16 * 1024;

/// Returns the number of rows of `width` elements in a task.
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
    chunks_by(out, size, &f);
}

/// Returns the largest number of consecutive items that one thread processes without a break. Without a limit, rayon makes few large parts, and threads wait for
/// the last of them: two threads get four parts.
fn part_of(items: usize) -> usize {
    (items / 4096).max(1)
}

// These call a function by reference: the compiler makes one copy of rayon's code for each type of elements, and not for each function.

fn chunks_by<E: Send>(out: &mut [E], size: usize, f: &(dyn Fn(usize, &mut [E]) + Sync)) {
    let part = part_of(out.len() / size);
    out.par_chunks_mut(size).with_max_len(part).enumerate().for_each(|(i, chunk)| f(i * size, chunk));
}

fn indices_by<R: Send>(n: usize, f: &(dyn Fn(usize) -> R + Sync)) -> Vec<R> {
    (0..n).into_par_iter().with_max_len(part_of(n)).map(f).collect()
}

fn items_by<I: Send, R: Send>(items: Vec<I>, f: &(dyn Fn(usize, I) -> R + Sync)) -> Vec<R> {
    let part = part_of(items.len());
    items.into_par_iter().with_max_len(part).enumerate().map(|(i, item)| f(i, item)).collect()
}

/// Calls `f(i)` for each i in `0..n`, in parallel, and collects the results in order.
pub fn map_indices<R: Send>(n: usize, f: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    if n <= 1 {
        return (0..n).map(f).collect();
    }
    indices_by(n, &f)
}

/// Calls `f(i, item)` for every item, in parallel and in no particular order.
pub fn for_each_item<I: Send>(items: Vec<I>, f: impl Fn(usize, I) + Sync + Send) {
    // A list of units takes no memory.
    items_by(items, &f);
}

/// Calls `f(i, item)` for every item, in parallel, and collects the results in order.
pub fn map_items<I: Send, R: Send>(items: Vec<I>, f: impl Fn(usize, I) -> R + Sync + Send) -> Vec<R> {
    items_by(items, &f)
}

/// Calls `f(start..end)` for consecutive chunks of `0..n`, in parallel, and collects the results in chunk order.
pub fn map_chunks<R: Send>(n: usize, size: usize, f: impl Fn(std::ops::Range<usize>) -> R + Sync + Send) -> Vec<R> {
    let chunks = n.div_ceil(size);
    map_indices(chunks, |i| f(i * size..((i + 1) * size).min(n)))
}

/// Splits a slice into consecutive parts of the given lengths. Panics if the slice is shorter than their sum.
pub fn split_lengths<E>(mut rest: &mut [E], lengths: impl Iterator<Item = usize>) -> Vec<&mut [E]> {
    lengths
        .map(|n| {
            let (head, tail) = std::mem::take(&mut rest).split_at_mut(n);
            rest = tail;
            head
        })
        .collect()
}

/// Calls `f(k, row)` for row `rows[k]` of a table, for each k, in parallel. The row numbers must be ascending and unique, so that runs of them belong to
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
pub fn fill<E: Pooled>(out: &mut [E], value: E) {
    let past_cache = streamed::worthwhile(out);
    for_each_chunk(out, 4 * CHUNK, |_, chunk| if past_cache { streamed::fill(chunk, value) } else { chunk.fill(value) });
}

/// Copies a slice.
pub fn copy<E: Copy + Send + Sync>(source: &[E], out: &mut [E]) {
    for_each_chunk(out, 4 * CHUNK, |start, chunk| chunk.copy_from_slice(&source[start..start + chunk.len()]));
}

/// `out[i] = f(x[i])`
pub fn map<T: Real>(x: &[T], out: &mut [T], f: impl Fn(T) -> T + Sync) {
    for_each_chunk(out, 2 * CHUNK, |start, chunk| map_loop(&x[start..start + chunk.len()], chunk, &f));
}

/// `out[i] = outside(x[i])` where |x| > `limit`, and `inside(x[i])` elsewhere. `inside` is computed for every i, so that its loop vectorises; its results
/// for |x| > `limit` are overwritten.
pub fn map_within<T: Real>(x: &[T], out: &mut [T], limit: T, inside: impl Fn(T) -> T + Sync, outside: impl Fn(T) -> T + Sync) {
    for_each_chunk(out, 2 * CHUNK, |start, chunk| {
        let x = &x[start..start + chunk.len()];
        map_loop(x, chunk, &inside);
        if x.iter().fold(false, |any, x| any | (x.abs() > limit)) {
            chunk.iter_mut().zip(x).filter(|(_, x)| x.abs() > limit).for_each(|(y, &x)| *y = outside(x));
        }
    });
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

/// Returns `Σ f(x[i])`. Each chunk is summed with 64 accumulators, and the sums of the chunks are added in order.
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
    // A pairwise sum of the accumulators has a small rounding error and a fixed order.
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
