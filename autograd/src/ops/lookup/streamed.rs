//! Rows copied past the cache.
//!
//! An ordinary store reads the line it writes to first. Copying a million random rows of 112 bytes waits for memory alone, and a quarter of
//! what it moves are those reads: stores that go around the cache take 0.78 of the time (`gather28` of the op table in
//! `benches/RESULTS.md`). The safe twin is [`super::copy_rows`]; the tests hold one against the other.

#![allow(unsafe_code)]

use crate::real::Real;

/// Bytes from which on a result is not expected to be in the cache when it is next read.
const LARGE: usize = 32 << 20;

/// True if [`copy_rows`] can be used for a result of this many bytes, and is worth it.
pub(super) fn worthwhile<T: Real, const W: usize>(out: &[T]) -> bool {
    cfg!(target_arch = "x86_64") && size_of_val(out) >= LARGE && size_of::<[T; W]>() % 16 == 0 && out.as_ptr() as usize % 16 == 0
}

/// `out[i] = table[rows[i]]` for a part of a result for which [`worthwhile`] is true; it begins with a whole row.
///
/// Panics if a row is not in the table.
#[cfg(target_arch = "x86_64")]
pub(super) fn copy_rows<T: Real, const W: usize>(table: &[[T; W]], rows: &[u32], out: &mut [[T; W]]) {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_sfence, _mm_stream_si128};
    let units = size_of::<[T; W]>() / 16;
    assert!(units * 16 == size_of::<[T; W]>() && out.as_ptr() as usize % 16 == 0, "rows are whole units of 16 bytes, and aligned");
    for (target, &row) in out.iter_mut().zip(rows) {
        let (from, to) = (table[row as usize].as_ptr().cast::<__m128i>(), target.as_mut_ptr().cast::<__m128i>());
        for k in 0..units {
            // SAFETY: by the assertion a row is `units` units of 16 bytes and `to`, whole rows after the start of `out`, is aligned to
            // them; `from` may lie anywhere. `T` is f32 or f64: no padding, every pattern valid. `target` is borrowed uniquely.
            unsafe { _mm_stream_si128(to.add(k), _mm_loadu_si128(from.add(k))) };
        }
    }
    // SAFETY: every x86-64 has the instruction. Streamed stores are ordered by nothing else: without it, a thread that is told
    // of the end of this call could still read what was there before.
    unsafe { _mm_sfence() };
}

#[cfg(not(target_arch = "x86_64"))]
pub(super) fn copy_rows<T: Real, const W: usize>(table: &[[T; W]], rows: &[u32], out: &mut [[T; W]]) {
    out.iter_mut().zip(rows).for_each(|(target, &row)| *target = table[row as usize]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pool::Buffer;

    fn check<T: Real, const W: usize>() {
        let table: Vec<T> = (0..1000 * W).map(|i| T::lit(i as f64)).collect();
        let rows: Vec<u32> = (0..LARGE.div_ceil(size_of::<[T; W]>()) as u32).map(|i| i.wrapping_mul(2_654_435_761) % 1000).collect();
        let mut streamed = Buffer::<T>::zeros(rows.len() * W);
        assert_eq!(worthwhile::<T, W>(&streamed), cfg!(target_arch = "x86_64"));
        copy_rows(table.as_chunks::<W>().0, &rows, streamed.as_chunks_mut::<W>().0);
        let mut plain = Buffer::<T>::zeros(rows.len() * W);
        super::super::copy_rows::<T, W>(&table, &rows, &mut plain);
        assert!(streamed[..] == plain[..], "rows of {W}");
        assert!(!worthwhile::<T, W>(&streamed[..1024]), "small results are read again at once");
    }

    #[test]
    fn streamed_rows_are_the_rows_that_an_ordinary_copy_writes() {
        check::<f32, 4>();
        check::<f32, 28>();
        check::<f64, 4>();
    }
}
