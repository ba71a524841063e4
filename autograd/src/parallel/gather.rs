//! Vector lookups in a table.
//!
//! The compiler does not vectorise a loop over `table[at[i]]`, because each load has its own bounds check. With one bounds check for the whole vector, the
//! loop becomes a gather instruction on machines that have it. The tests compare the function with the safe loop.

#![allow(unsafe_code)]

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

/// Returns `table[at[i] + offsets[k]]` for every k and i.
///
/// Panics if an index is out of range.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // The compiler does not inline iterators in dispatched loops.
pub fn gathered_around<T: Copy, const N: usize, const K: usize>(table: &[T], at: [u32; N], offsets: [u32; K]) -> [[T; N]; K] {
    let (mut last, mut farthest) = (0, 0);
    for i in at {
        last = last.max(i);
    }
    for offset in offsets {
        farthest = farthest.max(offset);
    }
    let end = last as usize + farthest as usize;
    assert!(end < table.len(), "index {end} is out of range for a table of {} entries", table.len());
    let mut found = [[table[0]; N]; K];
    for k in 0..K {
        // One array after another, so that the compiler does not vectorise the outer loop.
        let mut of_offset = [table[0]; N];
        for i in 0..N {
            // SAFETY: `end` is the largest sum of an index and an offset, and the assertion ensures that it is in range.
            of_offset[i] = unsafe { *table.get_unchecked(at[i] as usize + offsets[k] as usize) };
        }
        found[k] = of_offset;
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
    fn entries_around_are_those_at_the_sums() {
        let table: Vec<u32> = (0..100).map(|i| i * i).collect();
        assert_eq!(gathered_around(&table, [0, 90, 7], [0, 9]), [[0, 8100, 49], [81, 9801, 256]]);
    }

    #[test]
    #[should_panic(expected = "index 3 is out of range for a table of 3 entries")]
    fn entries_around_beyond_the_table_are_a_panic() {
        gathered_around(&[1, 2, 3], [0, 2], [1, 0]);
    }

    #[test]
    #[should_panic(expected = "index 3 is out of range for a table of 3 entries")]
    fn beyond_the_table_is_a_panic() {
        gathered(&[1, 2, 3], [0, 3, 1]);
    }
}
