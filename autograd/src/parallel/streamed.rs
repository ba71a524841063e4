//! Stores that go around the cache.
//!
//! An ordinary store reads the line it writes to first. An op with a result too large for the cache waits for memory alone, and those reads
//! are a large part of what it moves: without them a million random rows of 112 bytes take 0.88 of the time, and filling 64 MB 0.8
//! (`gather28` and `sum_16M` in `benches/RESULTS.md`). Maps from one large array to another gain nothing. The safe twin of all this is the plain copy that small results and other
//! machines get; the tests hold one against the other.

#![allow(unsafe_code)]

use crate::pool::Pooled;

/// Bytes from which on a result is not expected to be in the cache when it is next read.
const LARGE: usize = if cfg!(test) { 32 << 10 } else { 32 << 20 };

/// True if a result is so large that it is better written past the cache, and this machine can.
pub(crate) fn worthwhile<T>(out: &[T]) -> bool {
    cfg!(target_arch = "x86_64") && size_of_val(out) >= LARGE
}

/// Bytes of a store. A slice that is not aligned to them, and what is left over at its end, is written the ordinary way.
pub(crate) const UNIT: usize = 16;

/// Fills a slice.
pub(crate) fn fill<T: Pooled>(out: &mut [T], value: T) {
    let block = [value; 64];
    let _fence = Fence;
    out.chunks_mut(block.len()).for_each(|out| store(&block[..out.len()], out));
}

/// `out[i] = table[rows[i]]`; worth it where a row is whole units.
///
/// Panics if a row is not in the table.
pub(crate) fn copy_rows<T: Pooled, const W: usize>(table: &[[T; W]], rows: &[u32], out: &mut [[T; W]]) {
    let _fence = Fence;
    for (target, &row) in out.iter_mut().zip(rows) {
        store(&table[row as usize], target);
    }
}

/// Copies a slice. Its caller holds a [`Fence`], and reads nothing of `to` before that is dropped.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn store<T: Pooled>(from: &[T], to: &mut [T]) {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_stream_si128};
    assert_eq!(from.len(), to.len());
    let units = if (to.as_ptr() as usize).is_multiple_of(UNIT) { size_of_val(to) / UNIT } else { 0 };
    let (source, target) = (from.as_ptr().cast::<__m128i>(), to.as_mut_ptr().cast::<__m128i>());
    for k in 0..units {
        // SAFETY: both slices hold `units` units of 16 bytes, `target` is aligned to them and borrowed uniquely, and `source` may lie
        // anywhere. The types with a pool are plain numbers: no padding, and every pattern is valid. What is stored is ordered before
        // any other access by the fence that both callers in this file hold.
        unsafe { _mm_stream_si128(target.add(k), _mm_loadu_si128(source.add(k))) };
    }
    let done = units * UNIT / size_of::<T>();
    to[done..].copy_from_slice(&from[done..]);
}

#[cfg(not(target_arch = "x86_64"))]
fn store<T: Pooled>(from: &[T], to: &mut [T]) {
    to.copy_from_slice(from);
}

/// Orders the stores before it is dropped with what follows: nothing else does, and a thread that is told of the end of the work could
/// otherwise still read what was there before.
struct Fence;

impl Drop for Fence {
    fn drop(&mut self) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: every x86-64 has the instruction.
        unsafe {
            std::arch::x86_64::_mm_sfence();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Indices;
    use crate::parallel;
    use crate::real::Real;
    use crate::tensor::Tensor;

    fn check<T: Real, const W: usize>() {
        let table: Vec<T> = (0..1000 * W).map(|i| T::lit(i as f64)).collect();
        let rows: Vec<u32> = (0..5000u32).map(|i| i.wrapping_mul(2_654_435_761) % 1000).collect();
        let right = |out: &[T]| out.chunks(W).zip(&rows).all(|(got, &row)| got == &table[row as usize * W..][..W]);
        // From every alignment that a part of a buffer can have.
        for shift in 0..5 {
            let mut out = vec![T::zero(); rows.len() * W + shift];
            copy_rows(table.as_chunks::<W>().0, &rows, out[shift..].as_chunks_mut::<W>().0);
            assert!(right(&out[shift..]), "rows of {W}, shifted by {shift}");
            fill(&mut out[shift..], T::one());
            assert!(out[..shift].iter().all(|&v| v == T::zero()) && out[shift..].iter().all(|&v| v == T::one()));
        }
        // In tests, large begins early enough for what calls these functions to call them.
        assert!(cfg!(not(target_arch = "x86_64")) || worthwhile(&vec![T::zero(); rows.len() * W]));
        let mut whole = vec![T::zero(); rows.len() * W];
        parallel::fill(&mut whole, T::one());
        assert!(whole.iter().all(|&v| v == T::one()));
        let gathered = Tensor::from_vec(table.clone(), &[1000, W]).gather_rows(&Indices::from(rows.clone()));
        assert!(right(gathered.data()), "rows of {W} through the op");
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
