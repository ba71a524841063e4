//! Look-ups of a whole vector at once.
//!
//! A loop over `table[at[i]]` stays a loop of single loads, each with a test of its own. With one test for all of them it becomes a gather
//! where the machine has one. The safe twin is the plain loop in the tests.

#![allow(unsafe_code)]

/// `table[at[i]]` for every i.
///
/// Panics if one of them is beyond the table, or the table is empty.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // A `map` is sometimes left as a call, one for each vector.
pub fn gathered<T: Copy, const N: usize>(table: &[T], at: [u32; N]) -> [T; N] {
    let mut last = 0;
    for i in at {
        last = last.max(i);
    }
    assert!((last as usize) < table.len(), "entry {last} of a table of {}", table.len());
    let mut found = [table[0]; N];
    for k in 0..N {
        // SAFETY: none is larger than the largest, which lies in the table.
        found[k] = unsafe { *table.get_unchecked(at[k] as usize) };
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
    #[should_panic(expected = "entry 3 of a table of 3")]
    fn beyond_the_table_is_a_panic() {
        gathered(&[1, 2, 3], [0, 3, 1]);
    }
}
