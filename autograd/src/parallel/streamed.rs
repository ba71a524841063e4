//! Stores that go around the cache.
//!
//! An ordinary store reads the line it writes to first. An op with a result too large for the cache waits for memory alone, and those reads
//! are a large part of what it moves: without them a million random rows of 112 bytes take 0.88 of the time, and filling 64 MB 0.8
//! (`gather28` and `sum_16M` in `benches/RESULTS.md`; maps from one large array to another gain nothing). The safe twin of all this is the plain copy that small results and other
//! machines get; the tests hold one against the other.

#![allow(unsafe_code)]

use crate::pool::Pooled;

/// Bytes from which on a result is not expected to be in the cache when it is next read.
const LARGE: usize = 32 << 20;

/// True if a result is so large that it is better written past the cache, and this machine can.
pub(crate) fn worthwhile<T>(out: &[T]) -> bool {
    cfg!(target_arch = "x86_64") && size_of_val(out) >= LARGE
}

/// Fills a slice.
pub(crate) fn fill<T: Pooled>(out: &mut [T], value: T) {
    let block = [value; 64];
    out.chunks_mut(block.len()).for_each(|out| store(&block[..out.len()], out));
    fence();
}

/// `out[i] = table[rows[i]]`.
///
/// Panics if a row is not in the table.
pub(crate) fn copy_rows<T: Pooled, const W: usize>(table: &[[T; W]], rows: &[u32], out: &mut [[T; W]]) {
    for (target, &row) in out.iter_mut().zip(rows) {
        store(&table[row as usize], target);
    }
    fence();
}

/// Copies a slice; what it writes may not be visible to other threads before a [`fence`].
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn store<T: Pooled>(from: &[T], to: &mut [T]) {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_stream_si128};
    const UNIT: usize = 16;
    assert_eq!(from.len(), to.len());
    let units = if (to.as_ptr() as usize).is_multiple_of(UNIT) { size_of_val(to) / UNIT } else { 0 };
    let (source, target) = (from.as_ptr().cast::<__m128i>(), to.as_mut_ptr().cast::<__m128i>());
    for k in 0..units {
        // SAFETY: both slices hold `units` units of 16 bytes, `target` is aligned to them and borrowed uniquely, and `source` may lie
        // anywhere. The types with a pool are plain
        // numbers: no padding, and every pattern is valid.
        unsafe { _mm_stream_si128(target.add(k), _mm_loadu_si128(source.add(k))) };
    }
    let done = units * UNIT / size_of::<T>();
    to[done..].copy_from_slice(&from[done..]);
}

#[cfg(not(target_arch = "x86_64"))]
fn store<T: Pooled>(from: &[T], to: &mut [T]) {
    to.copy_from_slice(from);
}

/// Orders the stores before with those that follow: nothing else does, and a thread that is told of the end of the work could otherwise
/// still read what was there before.
fn fence() {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: every x86-64 has the instruction.
    unsafe {
        std::arch::x86_64::_mm_sfence();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::real::Real;

    fn check<T: Real, const W: usize>() {
        let table: Vec<T> = (0..1000 * W).map(|i| T::lit(i as f64)).collect();
        let rows: Vec<u32> = (0..5000u32).map(|i| i.wrapping_mul(2_654_435_761) % 1000).collect();
        // From every alignment that a part of a buffer can have.
        for shift in 0..5 {
            let mut out = vec![T::zero(); rows.len() * W + shift];
            copy_rows(table.as_chunks::<W>().0, &rows, out[shift..].as_chunks_mut::<W>().0);
            for (got, &row) in out[shift..].chunks(W).zip(&rows) {
                assert_eq!(got, &table[row as usize * W..][..W], "rows of {W}, shifted by {shift}");
            }
            fill(&mut out[shift..], T::one());
            assert!(out[..shift].iter().all(|&v| v == T::zero()) && out[shift..].iter().all(|&v| v == T::one()));
        }
    }

    #[test]
    fn streamed_values_are_those_that_an_ordinary_store_writes() {
        check::<f32, 3>();
        check::<f32, 4>();
        check::<f32, 28>();
        check::<f64, 1>();
        check::<f64, 4>();
        assert!(!worthwhile(&[0f32; 1024]), "small results are read again at once");
    }
}
