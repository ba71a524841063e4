//! Asking for memory before it is read.
//!
//! Look-ups in a large table wait for memory one after the other if much happens between two of them. Where the next rows are known in advance,
//! asking for them lets the waits overlap. It changes no result; the safe twin is to leave it out.

#![allow(unsafe_code)]

/// Bytes that come from memory together.
const LINE: usize = 64;

/// Asks for the memory of a value that will be read soon. A hint: nothing happens on machines without it.
#[inline(always)]
pub fn prefetch<E: ?Sized>(value: &E) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let (start, size) = (std::ptr::from_ref(value).cast::<i8>(), size_of_val(value));
        let mut at = 0;
        while at < size {
            // SAFETY: every x86-64 has the instruction, which changes nothing and fails on no address; this one lies in the value.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(start.add(at)) };
            at += LINE;
        }
        if size > 1 {
            // SAFETY: as above; what began in the middle of a line may end in one more.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(start.add(size - 1)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}
