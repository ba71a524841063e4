//! Vector lookups in a table.
//!
//! The compiler does not vectorise a loop over `table[at[i]]`, because each load has its own bounds check. With one bounds check for the whole vector, the
//! loop becomes a gather instruction on machines that have it. The tests compare the functions with safe loops.

#![allow(unsafe_code)]

use crate::real::Real;
use crate::single::is_single;
use std::mem::transmute_copy;

/// Returns `table[at[i]]` for every i.
///
/// Panics if an index is out of range or the table is empty.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // The compiler does not always inline `map`, which would cost a call for each vector.
pub fn gathered<T: Copy, const N: usize>(table: &[T], at: [u32; N]) -> [T; N] {
    let mut last = 0;
    for i in at {
        last = last.max(i);
    }
    assert!((last as usize) < table.len(), "index {last} is out of range for a table of {} entries", table.len());
    let mut found = [table[0]; N];
    for k in 0..N {
        // SAFETY: `last` is the largest index, and the assertion ensures that it is in range.
        found[k] = unsafe { *table.get_unchecked(at[k] as usize) };
    }
    found
}

/// Returns `table[at[i] + offsets[k]]` and the entry after it, for every k and i.
///
/// Panics if an index is out of range.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // The compiler does not inline iterators in dispatched loops.
pub fn pairs_around<T: Real, const N: usize, const K: usize>(table: &[T], at: [u32; N], offsets: [u32; K]) -> [[[T; N]; 2]; K] {
    let (mut last, mut farthest) = (0, 0);
    for i in at {
        last = last.max(i);
    }
    for offset in offsets {
        farthest = farthest.max(offset);
    }
    let end = u64::from(last) + u64::from(farthest) + 1;
    assert!(end < table.len() as u64, "index {end} is out of range for a table of {} entries", table.len());
    let mut found = [[[table[0]; N]; 2]; K];
    for k in 0..K {
        // One array after another, so that the compiler does not vectorise the outer loop.
        let [mut first, mut second] = [[table[0]; N]; 2];
        // SAFETY, here and below: `end` is the largest index of an entry that is read, and the assertion ensures that it is in range.
        let entry = |i: usize| unsafe { table.as_ptr().add(at[i] as usize + offsets[k] as usize) };
        if const { is_single::<T>() && cfg!(target_endian = "little") } {
            // One load of 64 bits instead of two of 32.
            let mut pairs = [0_u64; N];
            for i in 0..N {
                // SAFETY: see above; `T` is `f32`, two of which have the size of a `u64`.
                pairs[i] = unsafe { entry(i).cast::<u64>().read_unaligned() };
            }
            for i in 0..N {
                let halves = [pairs[i] as u32, (pairs[i] >> 32) as u32];
                // SAFETY: `T` is `f32`.
                (first[i], second[i]) = unsafe { (transmute_copy(&halves[0]), transmute_copy(&halves[1])) };
            }
        } else {
            for i in 0..N {
                // SAFETY: see above.
                (first[i], second[i]) = unsafe { (*entry(i), *entry(i).add(1)) };
            }
        }
        found[k] = [first, second];
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_plain_loop() {
        let table: Vec<u64> = (0..1000).map(|i| i * i).collect();
        for seed in 0..100u32 {
            let at: [u32; 16] = std::array::from_fn(|i| (seed * 16 + i as u32).wrapping_mul(2_654_435_761) % 1000);
            assert_eq!(gathered(&table, at), at.map(|i| table[i as usize]));
        }
        assert_eq!(gathered(&table, [999, 0]), [999 * 999, 0]);
    }

    #[test]
    fn pairs_are_those_at_the_sums() {
        let table: Vec<f32> = (0..101).map(|i| (i * i) as f32).collect();
        let (at, offsets) = ([0, 90, 7], [0, 9]);
        let pairs = offsets.map(|offset| [0, 1].map(|next| at.map(|at| table[(at + offset) as usize + next])));
        assert_eq!(pairs_around(&table, at, offsets), pairs);
        let double: Vec<f64> = table.iter().map(|&x| f64::from(x)).collect();
        assert_eq!(pairs_around(&double, at, offsets), pairs.map(|pair| pair.map(|entries| entries.map(f64::from))));
    }

    #[test]
    #[should_panic(expected = "index 3 is out of range for a table of 3 entries")]
    fn pairs_beyond_the_table_are_a_panic() {
        pairs_around(&[1.0, 2.0, 3.0], [0, 1], [1, 0]);
    }

    #[test]
    #[should_panic(expected = "index 3 is out of range for a table of 3 entries")]
    fn beyond_the_table_is_a_panic() {
        gathered(&[1, 2, 3], [0, 3, 1]);
    }
}
