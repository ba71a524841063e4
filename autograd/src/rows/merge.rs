//! The sum of two merged row-sparse gradients.

use super::sparse::RowSparse;
use crate::parallel::{self, split_lengths};
use crate::pool::Buffer;
use crate::real::Real;

/// Returns the sum of two row-sparse gradients: the union of their rows, with the values of common rows added.
pub(crate) fn union<T: Real>(a: RowSparse<T>, b: RowSparse<T>) -> RowSparse<T> {
    let shape = a.shape().to_vec();
    let width = a.width();
    let block = shape[0].div_ceil(64).max(1);
    let ranges = |rows: &[u32]| -> Vec<usize> {
        (0..=shape[0].div_ceil(block)).map(|k| rows.partition_point(|&r| (r as usize) < k * block)).collect()
    };
    let (cuts_a, cuts_b) = (ranges(a.rows()), ranges(b.rows()));
    let counts: Vec<usize> = parallel::map_indices(cuts_a.len() - 1, |k| {
        let mut n = 0;
        merge_walk(&a.rows()[cuts_a[k]..cuts_a[k + 1]], &b.rows()[cuts_b[k]..cuts_b[k + 1]], |_, _, _| n += 1);
        n
    });
    let total: usize = counts.iter().sum();
    let (mut rows, mut values) = (Buffer::<u32>::stale(total), Buffer::<T>::stale(total * width));
    let work: Vec<_> = split_lengths(&mut rows, counts.iter().copied())
        .into_iter()
        .zip(split_lengths(&mut values, counts.iter().map(|n| n * width)))
        .collect();
    parallel::for_each_item(work, |k, (rows, values)| {
        let (base_a, base_b) = (cuts_a[k], cuts_b[k]);
        let mut n = 0;
        merge_walk(&a.rows()[base_a..cuts_a[k + 1]], &b.rows()[base_b..cuts_b[k + 1]], |row, i, j| {
            rows[n] = row;
            let out = &mut values[n * width..][..width];
            match (i.map(|i| &a.data()[(base_a + i) * width..][..width]), j.map(|j| &b.data()[(base_b + j) * width..][..width])) {
                (Some(x), Some(y)) => out.iter_mut().zip(x).zip(y).for_each(|((o, &x), &y)| *o = x + y),
                (Some(x), None) | (None, Some(x)) => out.copy_from_slice(x),
                (None, None) => unreachable!("a row of the union is in one of the lists"),
            }
            n += 1;
        });
    });
    RowSparse::new(&shape, rows, values)
}

/// Calls `visit` for each row in the union of two ascending lists, with the index of the row in each list, or `None` if the list does not contain it.
fn merge_walk(a: &[u32], b: &[u32], mut visit: impl FnMut(u32, Option<usize>, Option<usize>)) {
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let (x, y) = (a.get(i).copied().unwrap_or(u32::MAX), b.get(j).copied().unwrap_or(u32::MAX));
        let row = x.min(y);
        let (in_a, in_b) = (i < a.len() && x == row, j < b.len() && y == row);
        visit(row, in_a.then_some(i), in_b.then_some(j));
        i += usize::from(in_a);
        j += usize::from(in_b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_union_of_row_gradients_adds_common_rows() {
        let make = |rows: Vec<u32>, x: f64| {
            let values: Vec<f64> = rows.iter().map(|&r| f64::from(r) * x).collect();
            RowSparse::new(&[100, 1], rows.into(), values.into())
        };
        let sum = union(make(vec![1, 5, 99], 1.0), make(vec![0, 5, 6], 10.0));
        assert_eq!(sum.rows(), [0, 1, 5, 6, 99]);
        assert_eq!(sum.data(), [0.0, 1.0, 55.0, 60.0, 99.0]);
    }
}
