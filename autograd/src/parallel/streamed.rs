//! Streaming stores, which bypass the cache.
//!
//! An ordinary store first reads the cache line that it writes to. An op whose result does not fit into the cache is limited by memory bandwidth, and these
//! reads are a large part of its traffic. With streaming stores, gathering a million random rows of 112 bytes takes 0.88 of the time, and filling 64 MB takes
//! 0.8 of the time (`gather28` and `sum_16M` in `benches/history/2026-11-21.md`). Elementwise ops from one large array to another do not become faster. Small results and
//! other machines use an ordinary copy, which is safe code; the tests compare both.

#![allow(unsafe_code)]

use crate::pool::Pooled;

/// Size in bytes from which a result is not expected to stay in the cache until it is read. It is smaller in tests, so that they reach the streaming stores.
const LARGE: usize = if cfg!(test) { 32 << 10 } else { 32 << 20 };

/// Returns true if `out` is so large that streaming stores are faster, and the machine supports them.
pub(crate) fn worthwhile<T>(out: &[T]) -> bool {
    cfg!(target_arch = "x86_64") && size_of_val(out) >= LARGE
}

/// Size of a streaming store, in bytes. A slice that is not aligned to this size, and the remainder of an aligned slice, are written by ordinary stores.
pub(crate) const UNIT: usize = 16;

/// Fills a slice by streaming stores.
pub(crate) fn fill<T: Pooled>(out: &mut [T], value: T) {
    let block = [value; 64];
    let _fence = Fence;
    out.chunks_mut(block.len()).for_each(|out| store(&block[..out.len()], out));
}

/// Sets `out[i] = table[rows[i]]` by streaming stores. It is fast only if the size of a row is a multiple of [`UNIT`].
///
/// Panics if a row number is out of range.
pub(crate) fn copy_rows<T: Pooled, const W: usize>(table: &[[T; W]], rows: &[u32], out: &mut [[T; W]]) {
    let _fence = Fence;
    for (target, &row) in out.iter_mut().zip(rows) {
        store(&table[row as usize], target);
    }
}

/// Copies a slice by streaming stores. The caller must hold a [`Fence`] and must not read `to` before the fence is dropped.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn store<T: Pooled>(from: &[T], to: &mut [T]) {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_stream_si128};
    assert_eq!(from.len(), to.len());
    let units = if (to.as_ptr() as usize).is_multiple_of(UNIT) { size_of_val(to) / UNIT } else { 0 };
    let (source, target) = (from.as_ptr().cast::<__m128i>(), to.as_mut_ptr().cast::<__m128i>());
    for k in 0..units {
        // SAFETY: both slices have at least `units` units of 16 bytes. `target` is aligned to 16 bytes and borrowed uniquely; `source` needs no alignment.
        // Pooled types are plain numbers, which have no padding and for which every bit pattern is valid. The fence that both callers in this file hold
        // orders these stores before any later access.
        unsafe { _mm_stream_si128(target.add(k), _mm_loadu_si128(source.add(k))) };
    }
    let done = units * UNIT / size_of::<T>();
    to[done..].copy_from_slice(&from[done..]);
}

#[cfg(not(target_arch = "x86_64"))]
fn store<T: Pooled>(from: &[T], to: &mut [T]) {
    to.copy_from_slice(from);
}

/// A guard that executes a store fence when it is dropped. Streaming stores are not ordered otherwise: without the fence, a thread that is notified that the
/// work is done could still read the old contents.
struct Fence;

impl Drop for Fence {
    fn drop(&mut self) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: every x86-64 machine has this instruction.
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
        // All alignments that a part of a buffer can have.
        for shift in 0..5 {
            let mut out = vec![T::zero(); rows.len() * W + shift];
            copy_rows(table.as_chunks::<W>().0, &rows, out[shift..].as_chunks_mut::<W>().0);
            assert!(right(&out[shift..]), "rows of {W}, shifted by {shift}");
            fill(&mut out[shift..], T::one());
            assert!(out[..shift].iter().all(|&v| v == T::zero()) && out[shift..].iter().all(|&v| v == T::one()));
        }
        // In tests `LARGE` is so small that the callers below use streaming stores.
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
