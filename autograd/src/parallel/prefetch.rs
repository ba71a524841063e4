//! Memory that is read before it is needed: in order, or by prefetches.
//!
//! If there is much work between two lookups in a large table, each lookup waits for memory separately. Where the next rows are known in advance, a prefetch
//! lets these waits overlap. A prefetch never changes a result.

#![allow(unsafe_code)]

use std::hint::black_box;

/// Size of a cache line, in bytes.
const LINE: usize = 64;

/// Reads one value of every 64 bytes, in order. A processor fetches memory much faster in order than at random places, and later look-ups at random places find the
/// values in a cache. This saves time if most of the values are looked up, and if they fit in the cache.
pub fn load<E: Copy>(values: &[E]) {
    for line in values.chunks((LINE / size_of::<E>().max(1)).max(1)) {
        black_box(line[0]);
    }
}

/// Prefetches the cache lines of a value that will be read soon. On targets other than x86-64 it does nothing.
///
/// Prefetch a few lines at a time, between other work. A core can wait for only so many lines at once, 24 on AMD Zen 4; prefetches beyond that hold up the
/// loads behind them.
#[inline(always)]
pub fn prefetch<E: ?Sized>(value: &E) {
    prefetch_lines::<E, true>(value);
}

/// Prefetches the cache lines of a value into the second-level cache. On targets other than x86-64 it does nothing.
///
/// Use it for look-ups in tables larger than the caches, some dozens of rows ahead. The lines do not displace what is in use from the first-level cache. If the
/// core already waits for as many lines as it can, AMD Zen 4 drops the prefetch, so it does not hold up loads. Most of a burst is therefore dropped.
#[inline(always)]
pub fn prefetch_early<E: ?Sized>(value: &E) {
    prefetch_lines::<E, false>(value);
}

/// Prefetches the cache lines of a value, into the first-level cache if it is used `SOON`, otherwise into the second-level cache.
#[inline(always)]
fn prefetch_lines<E: ?Sized, const SOON: bool>(value: &E) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _MM_HINT_T1, _mm_prefetch};
        let (start, size) = (std::ptr::from_ref(value).cast::<i8>(), size_of_val(value));
        let line = |at: usize| {
            // SAFETY: every x86-64 machine has this instruction. It changes no memory and does not fault for any address; this address lies inside the value.
            unsafe {
                let place = start.add(at);
                if SOON { _mm_prefetch::<_MM_HINT_T0>(place) } else { _mm_prefetch::<_MM_HINT_T1>(place) }
            }
        };
        let mut at = 0;
        while at < size {
            line(at);
            at += LINE;
        }
        if size > align_of_val(value) {
            // A value that does not begin at the start of a cache line may end in one more line, unless its size is its alignment.
            line(size - 1);
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}
