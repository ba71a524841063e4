//! A pool that recycles buffers of 4 KiB and more.
//!
//! Every training step allocates the same few dozen arrays. A new allocation from the system costs a page fault for every 4 KiB, which takes longer than
//! most ops. A dropped [`Buffer`] therefore returns to a pool, and the next request of about the same size reuses it. Buffers that stay unused for many
//! requests are freed. On Linux, new buffers request 2 MiB pages, because random lookups in a large table would otherwise miss the TLB at every row.
//!
//! The contents of a recycled buffer are stale but never uninitialised. The only unsafe code here is the `madvise` call.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Debug;
use std::ops::{Deref, DerefMut};
use std::sync::Mutex;

/// Size of the smallest pooled buffer, in bytes. For smaller buffers the system allocator is as fast.
const SMALLEST: usize = 4 * 1024;
/// Fewest requests during which a free buffer is unused before it is returned to the system. They span several typical training steps.
const LIFETIME: u64 = 1000;
/// Fewest bytes that are requested meanwhile, relative to the size of the buffer: a large buffer outlives a step with thousands of small requests.
const PASSES: u64 = 64;
/// Number of requests between two searches for buffers to be returned to the system.
const SEARCH_EVERY: u64 = 250;

/// Requests so far.
#[derive(Clone, Copy, Debug)]
struct Clock {
    /// Number of requests.
    requests: u64,
    /// Sum of the sizes of the requests.
    bytes: u64,
}

impl Clock {
    /// Returns true if a buffer of `bytes` bytes that was dropped at `then` has been unused for too long.
    fn is_over(&self, then: Clock, bytes: usize) -> bool {
        self.requests - then.requests > LIFETIME && self.bytes - then.bytes > PASSES * bytes as u64
    }
}

/// The free buffers of one element type.
#[derive(Debug)]
pub struct Pool<E> {
    /// Free buffers by their capacity, in the order in which they were dropped, each with the clock at that time. The one that was dropped first is taken first, so
    /// that no buffer stays unused while others of its size are in use.
    free: BTreeMap<usize, VecDeque<(Clock, Vec<E>)>>,
    clock: Clock,
}

impl<E> Pool<E> {
    const fn new() -> Self {
        Pool { free: BTreeMap::new(), clock: Clock { requests: 0, bytes: 0 } }
    }
}

mod sealed {
    pub trait Sealed {}
}

/// Element types of pooled buffers: `f32`, `f64`, `u32` and `u64`. Each has its own pool.
pub trait Pooled: Copy + Default + Send + Sync + Debug + sealed::Sealed + 'static {
    #[doc(hidden)]
    fn pool() -> &'static Mutex<Pool<Self>>;
}

macro_rules! pooled {
    ($($t:ty),*) => {$(
        impl sealed::Sealed for $t {}
        impl Pooled for $t {
            fn pool() -> &'static Mutex<Pool<Self>> {
                static POOL: Mutex<Pool<$t>> = Mutex::new(Pool::new());
                &POOL
            }
        }
    )*};
}
pooled!(f32, f64, u32, u64);

/// An owned array that returns to the pool when dropped.
#[derive(Debug, Default)]
pub struct Buffer<E: Pooled> {
    /// All initialised elements. It may be longer than `len`, so a shortened buffer can be reused without filling it again.
    all: Vec<E>,
    len: usize,
}

impl<E: Pooled> Buffer<E> {
    /// Returns a buffer of `len` elements with unspecified (but initialised) contents, for a caller that overwrites all of them.
    pub fn stale(len: usize) -> Self {
        let all = take(len).map_or_else(
            || allocate(len),
            |mut found| {
                found.resize(found.len().max(len), E::default());
                found
            },
        );
        Buffer { all, len }
    }

    /// Returns a buffer of `len` zeros.
    pub fn zeros(len: usize) -> Self {
        match take(len) {
            Some(mut all) => {
                all.resize(all.len().max(len), E::default());
                crate::parallel::fill(&mut all[..len], E::default());
                Buffer { all, len }
            }
            None => Buffer { all: allocate(len), len },
        }
    }

    /// Returns a copy of a slice.
    pub fn copy_of(source: &[E]) -> Self {
        let mut out = Self::stale(source.len());
        crate::parallel::copy(source, &mut out);
        out
    }

    /// Shortens the buffer to its first `len` elements; does nothing if it is not longer.
    pub fn truncate(&mut self, len: usize) {
        self.len = self.len.min(len);
    }

    /// Extends the buffer to `len` elements; does nothing if it is not shorter. The contents of the new elements are unspecified.
    pub fn grow(&mut self, len: usize) {
        if len > self.len {
            let mut grown = Self::stale(len);
            grown[..self.len].copy_from_slice(self);
            *self = grown;
        }
    }
}

impl<E: Pooled> From<Vec<E>> for Buffer<E> {
    fn from(all: Vec<E>) -> Self {
        Buffer { len: all.len(), all }
    }
}

impl<E: Pooled> Clone for Buffer<E> {
    fn clone(&self) -> Self {
        Self::copy_of(self)
    }
}

impl<E: Pooled> Deref for Buffer<E> {
    type Target = [E];
    fn deref(&self) -> &[E] {
        &self.all[..self.len]
    }
}

impl<E: Pooled> DerefMut for Buffer<E> {
    fn deref_mut(&mut self) -> &mut [E] {
        &mut self.all[..self.len]
    }
}

impl<E: Pooled> Drop for Buffer<E> {
    fn drop(&mut self) {
        let v = std::mem::take(&mut self.all);
        if v.capacity() * size_of::<E>() >= SMALLEST {
            let mut pool = E::pool().lock().unwrap_or_else(|e| e.into_inner());
            let now = pool.clock;
            pool.free.entry(v.capacity()).or_default().push_back((now, v));
        }
    }
}

/// Returns every free buffer to the system. This is useful when buffer sizes change permanently, for example after upsampling a grid.
pub fn release_free_buffers() {
    fn clear<E: Pooled>() {
        let freed = std::mem::take(&mut E::pool().lock().unwrap_or_else(|e| e.into_inner()).free);
        drop(freed);
    }
    clear::<f32>();
    clear::<f64>();
    clear::<u32>();
    clear::<u64>();
}

/// Takes the smallest free buffer with a capacity from `len` elements to `len` plus a quarter plus 4 KiB. Now and then, it returns buffers to the system that
/// have been unused for long.
fn take<E: Pooled>(len: usize) -> Option<Vec<E>> {
    let bytes = len * size_of::<E>();
    if bytes < SMALLEST {
        return None;
    }
    let mut pool = E::pool().lock().unwrap_or_else(|e| e.into_inner());
    pool.clock.requests += 1;
    pool.clock.bytes += bytes as u64;
    let now = pool.clock;
    let mut fitting = pool.free.range_mut(len..=len + len / 4 + SMALLEST / size_of::<E>());
    let found = fitting.find_map(|(_, buffers)| buffers.pop_front()).map(|(_, v)| v);
    let mut outdated = Vec::new();
    if now.requests % SEARCH_EVERY == 0 {
        pool.free.retain(|capacity, buffers| {
            let bytes = capacity * size_of::<E>();
            while let Some(buffer) = buffers.pop_front_if(|(then, _)| now.is_over(*then, bytes)) {
                outdated.push(buffer);
            }
            !buffers.is_empty()
        });
    }
    drop(pool);
    drop(outdated);
    found
}

/// Allocates `len` zeros. Spare capacity of 1/16 lets a slightly larger request reuse the buffer: the number of packed samples varies between steps.
fn allocate<E: Pooled>(len: usize) -> Vec<E> {
    if len * size_of::<E>() < SMALLEST {
        return vec![E::default(); len];
    }
    let mut v = vec![E::default(); len + len / 16];
    advise_huge_pages(&v);
    v.truncate(len);
    v
}

#[cfg(target_os = "linux")]
#[allow(unsafe_code)]
fn advise_huge_pages<E>(v: &[E]) {
    const HUGE: usize = 2 << 20;
    let start = (v.as_ptr() as usize).next_multiple_of(HUGE);
    let end = (v.as_ptr() as usize + size_of_val(v)) / HUGE * HUGE;
    if start < end {
        // SAFETY: the range lies inside the live allocation `v`, and MADV_HUGEPAGE does not change its contents. A failure costs only speed.
        unsafe {
            libc::madvise(start as *mut libc::c_void, end - start, libc::MADV_HUGEPAGE);
        }
    }
}

#[cfg(not(target_os = "linux"))]
fn advise_huge_pages<E>(_: &[E]) {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_buffer_is_handed_out_again_and_zeros_are_zeros() {
        // A size no other test uses.
        let len = 123_457;
        let mut a = Buffer::<u64>::zeros(len);
        a.fill(7);
        let address = a.as_ptr();
        drop(a);
        let b = Buffer::<u64>::zeros(len - 5);
        assert_eq!(b.as_ptr(), address);
        assert!(b.iter().all(|&x| x == 0));
    }
}
