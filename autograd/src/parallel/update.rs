//! Elementwise updates of tables by optimizers, for gradients that are dense, row-sparse, or row-sparse with lazy sums.

use super::{CHUNK, dispatched, for_each_item, prefetch_early, rows_per_chunk};
use crate::gradients::Grad;
use crate::real::Real;
use crate::rows::deferred::{RowGroups, RowSums};

/// Sets `(x₁[i], x₂[i], …) = f((x₁[i], x₂[i], …), g[i])` wherever there is a gradient g. An optimizer updates values and state arrays by this function. Rows
/// that a row-sparse gradient does not contain are unchanged, or have g = 0 if `all_rows` is true.
pub fn update<T: Real, const N: usize>(x: [&mut [T]; N], grad: &Grad<T>, all_rows: bool, f: impl Fn([T; N], T) -> [T; N] + Sync) {
    let rows = match grad {
        Grad::Dense(g) => return update_dense(x, g.data(), &f),
        Grad::Rows(rows) => rows,
    };
    if !all_rows && let Some(sums) = rows.unmerged() {
        return update_deferred(x, rows.width(), sums, &f);
    }
    let part = TableRows { first: 0, width: rows.width(), rows: rows.rows(), g: rows.data() };
    if all_rows { update_part::<T, N, true, _>(x, part, &f) } else { update_part::<T, N, false, _>(x, part, &f) }
}

/// Updates with a dense gradient. It splits the work recursively into chunks.
fn update_dense<T: Real, const N: usize, F: Fn([T; N], T) -> [T; N] + Sync>(x: [&mut [T]; N], g: &[T], f: &F) {
    if g.len() <= CHUNK {
        return update_loop(x, g, f);
    }
    let middle = (g.len() / 2).next_multiple_of(CHUNK);
    let (low, high) = split(x, middle);
    rayon::join(|| update_dense(low, &g[..middle], f), || update_dense(high, &g[middle..], f));
}

/// Updates with lazy row sums: the sums of each bucket are computed and used while they are in the cache.
fn update_deferred<T: Real, const N: usize, F: Fn([T; N], T) -> [T; N] + Sync>(
    x: [&mut [T]; N],
    width: usize,
    rows: &dyn RowSums<T>,
    f: &F,
) {
    let bucket_rows = 1usize << rows.bucket_shift();
    let groups = RowGroups::new(x[0].len() / width.max(1), bucket_rows, width);
    let mut parts = x.map(|x| x.chunks_mut((groups.rows_per_group() * width).max(1)));
    let mut parts: Vec<(usize, [&mut [T]; N])> =
        (0..groups.count).map(|group| (group, parts.each_mut().map(|parts| parts.next().unwrap_or_default()))).collect();
    // The last bucket of a hash grid takes the longest, so it begins first.
    parts.reverse();
    for_each_item(parts, |_, (group, mut x)| {
        let first = group * groups.rows_per_group();
        groups.for_each_bucket(group, rows, |bucket, sums, touched| {
            let start = (bucket * bucket_rows - first) * width;
            let x = x.each_mut().map(|x| &mut x[start..][..sums.len()]);
            match width {
                1 => update_touched::<T, N, 1, _>(x, width, sums, touched, f),
                2 => update_touched::<T, N, 2, _>(x, width, sums, touched, f),
                3 => update_touched::<T, N, 3, _>(x, width, sums, touched, f),
                4 => update_touched::<T, N, 4, _>(x, width, sums, touched, f),
                16 => update_touched::<T, N, 16, _>(x, width, sums, touched, f),
                24 => update_touched::<T, N, 24, _>(x, width, sums, touched, f),
                27 => update_touched::<T, N, 27, _>(x, width, sums, touched, f),
                48 => update_touched::<T, N, 48, _>(x, width, sums, touched, f),
                _ => update_touched::<T, N, 0, _>(x, width, sums, touched, f),
            }
        });
    });
}

/// A part of a table that begins at row `first`, and the rows in it that have a gradient `g`.
#[derive(Clone, Copy)]
struct TableRows<'a, T> {
    first: usize,
    width: usize,
    rows: &'a [u32],
    g: &'a [T],
}

/// Updates with a row-sparse gradient. It splits the work recursively into chunks; since the rows are ascending, each half of them lies in its own part of
/// the table. If `ALL` is true, rows without a gradient are also visited.
fn update_part<T: Real, const N: usize, const ALL: bool, F: Fn([T; N], T) -> [T; N] + Sync>(
    x: [&mut [T]; N],
    part: TableRows<'_, T>,
    f: &F,
) {
    let TableRows { first, width, rows, g } = part;
    let count = if ALL { x[0].len() / width.max(1) } else { rows.len() };
    if count <= rows_per_chunk(width) {
        return match width {
            1 if !ALL => update_short_rows::<T, N, 1, F>(x, part, f),
            3 if !ALL => update_short_rows::<T, N, 3, F>(x, part, f),
            _ => update_runs::<T, N, ALL, F>(x, part, f),
        };
    }
    let cut = if ALL { first + count / 2 } else { rows[count / 2] as usize };
    let middle = rows.partition_point(|&row| (row as usize) < cut);
    let (low, high) = split(x, (cut - first) * width);
    let ((low_rows, high_rows), (low_g, high_g)) = (rows.split_at(middle), g.split_at(middle * width));
    rayon::join(
        || update_part::<T, N, ALL, F>(low, TableRows { rows: low_rows, g: low_g, ..part }, f),
        || update_part::<T, N, ALL, F>(high, TableRows { first: cut, rows: high_rows, g: high_g, ..part }, f),
    );
}

/// Splits each of `N` slices at index `at`.
fn split<T, const N: usize>(x: [&mut [T]; N], at: usize) -> ([&mut [T]; N], [&mut [T]; N]) {
    let mut high = [const { None }; N];
    let mut k = 0;
    let low = x.map(|slice| {
        let (a, b) = slice.split_at_mut(at);
        high[k] = Some(b);
        k += 1;
        a
    });
    (low, high.map(Option::unwrap_or_default))
}

dispatched! {
fn update_loop<T: Real, const N: usize, F: Fn([T; N], T) -> [T; N]>(mut x: [&mut [T]; N], g: &[T], f: &F) {
    update_slices(&mut x, 0, g.len(), |i| g[i], f);
}
}

dispatched! {
/// Updates rows that are too short for a separate loop each: groups of rows are gathered, updated in one loop and scattered back.
fn update_short_rows<T: Real, const N: usize, const W: usize, F: Fn([T; N], T) -> [T; N]>(x: [&mut [T]; N], part: TableRows<'_, T>, f: &F) {
    const TOGETHER: usize = 16;
    let mut x = x.map(|x| x.as_chunks_mut::<W>().0);
    let mut block = [[[T::zero(); W]; TOGETHER]; N];
    for (rows, g) in part.rows.chunks(TOGETHER).zip(part.g.chunks(TOGETHER * W)) {
        for (block, x) in block.iter_mut().zip(&x) {
            block.iter_mut().zip(rows).for_each(|(to, &row)| *to = x[row as usize - part.first]);
        }
        let mut slices = block.each_mut().map(|b| b.as_flattened_mut());
        // The case of a constant length has its own copy of the loop, which is faster.
        let len = TOGETHER * W;
        if g.len() == len { update_slices(&mut slices, 0, len, |i| g[i], f) } else { update_slices(&mut slices, 0, g.len(), |i| g[i], f) }
        for (block, x) in block.iter().zip(&mut x) {
            block.iter().zip(rows).for_each(|(&from, &row)| x[row as usize - part.first] = from);
        }
    }
}
}

dispatched! {
/// Updates each run of consecutive rows in one loop. If `ALL` is true, rows between the runs are updated with zero gradients.
fn update_runs<T: Real, const N: usize, const ALL: bool, F: Fn([T; N], T) -> [T; N]>(mut x: [&mut [T]; N], part: TableRows<'_, T>, f: &F) {
    let TableRows { first, width, rows, g } = part;
    let mut done = 0;
    let mut k = 0;
    while k < rows.len() {
        let run = (1..).take_while(|&n| rows.get(k + n).is_some_and(|&row| (row - rows[k]) as usize == n)).count() + 1;
        let (start, len) = ((rows[k] as usize - first) * width, run * width);
        if ALL {
            update_slices(&mut x, done, start - done, |_| T::zero(), f);
            done = start + len;
        }
        let g = &g[k * width..][..len];
        update_slices(&mut x, start, len, |i| g[i], f);
        k += run;
    }
    if ALL {
        let len = x[0].len() - done;
        update_slices(&mut x, done, len, |_| T::zero(), f);
    }
}
}

/// Updates the elements `start..start + len` of each slice. They are selected here, because `map` with a closure of a dispatched function is not inlined.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // The loops index N arrays.
fn update_slices<T: Real, const N: usize>(
    x: &mut [&mut [T]; N],
    start: usize,
    len: usize,
    g: impl Fn(usize) -> T,
    f: &impl Fn([T; N], T) -> [T; N],
) {
    let mut parts: [&mut [T]; N] = std::array::from_fn(|_| Default::default());
    for (part, x) in parts.iter_mut().zip(x.iter_mut()) {
        *part = &mut x[start..start + len];
    }
    for i in 0..len {
        let mut old = [T::zero(); N];
        for k in 0..N {
            old[k] = parts[k][i];
        }
        let new = f(old, g(i));
        for k in 0..N {
            parts[k][i] = new[k];
        }
    }
}

/// Number of elements, and of short rows, that are updated together.
const LANES: usize = 8;

/// Rows that are updated together.
struct Unit {
    /// First row.
    row: usize,
    rows: usize,
    /// If they are a group of eight short rows, the bits of those that are updated.
    bits: Option<u8>,
}

/// Iterates over the rows whose bits are set in a bitmap: in groups of eight if rows are short, in runs of at most eight if `W` is 0, otherwise one by one.
struct Units<'a, const W: usize> {
    touched: &'a [u64],
    /// Number of rows of the tables.
    rows: usize,
    word: usize,
    /// Bits of this word that are left.
    left: u64,
}

impl<'a, const W: usize> Units<'a, W> {
    fn new(touched: &'a [u64], rows: usize) -> Self {
        Units { touched, rows, word: 0, left: touched.first().copied().unwrap_or(0) }
    }
}

impl<const W: usize> Iterator for Units<'_, W> {
    type Item = Unit;

    #[inline(always)]
    fn next(&mut self) -> Option<Unit> {
        while self.left == 0 {
            self.left = *self.touched.get(self.word + 1)?;
            self.word += 1;
        }
        let bit = self.left.trailing_zeros() as usize;
        let eight = bit & !(LANES - 1);
        if const { 1 <= W && W <= 3 } && self.word * 64 + eight + LANES <= self.rows {
            let bits = Some((self.left >> eight) as u8);
            self.left &= !(0xff << eight);
            return Some(Unit { row: self.word * 64 + eight, rows: LANES, bits });
        }
        let rows = if W == 0 { ((self.left >> bit).trailing_ones() as usize).min(LANES) } else { 1 };
        self.left &= if bit + rows == 64 { 0 } else { !0 << (bit + rows) };
        Some(Unit { row: self.word * 64 + bit, rows, bits: None })
    }
}

dispatched! {
/// Updates the rows whose bits are set in `touched`, and clears their sums and bits. `sums` has a row for each row of the tables. `W` is the width, or 0 if
/// the width is known at run time only. Short rows are updated in groups of eight; rows of a group that are not touched keep their values.
fn update_touched<T: Real, const N: usize, const W: usize, F: Fn([T; N], T) -> [T; N]>(
    mut x: [&mut [T]; N],
    width: usize,
    sums: &mut [T],
    touched: &mut [u64],
    f: &F,
) {
    /// Number of units between the one that is updated and the one that is prefetched.
    const AHEAD: usize = 32;
    let width = if W == 0 { width } else { W };
    let rows = sums.len() / width.max(1);
    // Both iterate over the same bits, so the bits are cleared at the end.
    let mut later = Units::<W>::new(touched, rows);
    later.by_ref().take(AHEAD).for_each(|unit| prefetch_rows(&x, width, &unit));
    for unit in Units::<W>::new(touched, rows) {
        if let Some(later) = later.next() {
            prefetch_rows(&x, width, &later);
        }
        let start = unit.row * width;
        if let Some(bits) = unit.bits {
            update_eight::<T, N, W, F>(&mut x, &mut sums[start..][..LANES * W], start, bits, f);
            continue;
        }
        // The case of a constant length has its own copy of the loop, which is faster.
        let len = if W == 0 { unit.rows * width } else { W };
        let g = &mut sums[start..][..len];
        update_slices(&mut x, start, len, |i| g[i], f);
        g.fill(T::zero());
    }
    touched.fill(0);
}
}

/// Prefetches the rows of a unit in all tables.
#[inline(always)]
fn prefetch_rows<T: Real, const N: usize>(x: &[&mut [T]; N], width: usize, unit: &Unit) {
    x.iter().for_each(|x| prefetch_early(&x[unit.row * width..][..unit.rows * width]));
}

/// Updates the rows whose bits are set among the eight rows from element `start` on, and clears the sums of all eight.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // The loop indexes N arrays.
fn update_eight<T: Real, const N: usize, const W: usize, F: Fn([T; N], T) -> [T; N]>(
    x: &mut [&mut [T]; N],
    sums: &mut [T],
    start: usize,
    bits: u8,
    f: &F,
) {
    let sums = sums.as_chunks_mut::<LANES>().0;
    for part in 0..W {
        let at = start + part * LANES;
        let mut values = [[T::zero(); LANES]; N];
        for k in 0..N {
            values[k].copy_from_slice(&x[k][at..at + LANES]);
        }
        for i in 0..LANES {
            let old: [T; N] = std::array::from_fn(|k| values[k][i]);
            let new = f(old, sums[part][i]);
            let on = u32::from(bits) & (1 << ((part * LANES + i) / W)) != 0;
            for k in 0..N {
                values[k][i] = if on { new[k] } else { old[k] };
            }
        }
        for k in 0..N {
            x[k][at..at + LANES].copy_from_slice(&values[k]);
        }
        sums[part] = [T::zero(); LANES];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rows::sparse::RowSparse;
    use crate::tensor::Tensor;
    use std::sync::Arc;

    #[test]
    fn updates_of_rows_equal_a_plain_loop_for_every_width_and_leave_the_other_rows_alone() {
        let rule = |[x, v]: [f64; 2], g: f64| [x - g, 0.5 * v + g];
        for width in [1usize, 2, 3, 4, 27] {
            // Single rows and runs of rows, enough of both for several chunks.
            let table = 100_000 / width.min(4);
            let rows: Vec<u32> = (0..table as u32).filter(|r| r % 7 != 0 && (r % 64 < 20 || r % 3 == 0)).collect();
            let g: Vec<f64> = (0..rows.len() * width).map(|i| (i % 1000) as f64 + 1.0).collect();
            let start: Vec<f64> = (0..table * width).map(|i| i as f64).collect();

            let (mut x, mut v) = (start.clone(), start.clone());
            let mut dense = vec![0.0; table * width];
            for (k, &row) in rows.iter().enumerate() {
                for c in 0..width {
                    let at = row as usize * width + c;
                    dense[at] = g[k * width + c];
                    [x[at], v[at]] = rule([x[at], v[at]], dense[at]);
                }
            }
            let (mut got_x, mut got_v) = (start.clone(), start.clone());
            let g = Grad::Rows(RowSparse::new(&[table, width], rows.into(), g.into()));
            update([&mut got_x, &mut got_v], &g, false, rule);
            assert!(got_x == x && got_v == v, "rows of width {width}");

            let (mut x, mut v) = (start.clone(), start.clone());
            update([&mut x, &mut v], &Grad::Dense(Tensor::from_vec(dense.clone(), &[table, width])), false, rule);
            let (mut got_x, mut got_v) = (start.clone(), start.clone());
            update([&mut got_x, &mut got_v], &g, true, rule);
            assert!(got_x == x && got_v == v, "all rows of width {width}");
            assert!(v.iter().zip(&start).zip(&dense).all(|((v, s), g)| *v == 0.5 * s + g));
        }
    }

    /// Sums of a table of 1500 rows in buckets of 1024: full words, empty words, and words with runs and single rows.
    #[derive(Debug)]
    struct Sums {
        width: usize,
    }

    impl Sums {
        const ROWS: usize = 1500;

        fn touches(row: usize) -> bool {
            row < 200 || (450..500).contains(&row) || row >= 512 && (row % 64 >= 59 || row % 7 < 2)
        }

        fn number(element: usize) -> f64 {
            (element % 1000) as f64 + 1.0
        }
    }

    impl RowSums<f64> for Sums {
        fn bucket_shift(&self) -> u32 {
            10
        }

        fn is_empty(&self, _: usize) -> bool {
            false
        }

        fn add(&self, bucket: usize, sums: &mut [f64], touched: &mut [u64]) {
            for (local, sums) in sums.chunks_mut(self.width).enumerate() {
                let row = (bucket << self.bucket_shift()) + local;
                if Self::touches(row) {
                    touched[local / 64] |= 1 << (local % 64);
                    sums.iter_mut().enumerate().for_each(|(c, sum)| *sum += Self::number(row * self.width + c));
                }
            }
        }
    }

    /// With one thread, the second group of buckets gets the sums of the first.
    #[test]
    fn updates_with_sums_for_later_reach_each_touched_row_once_for_every_width() {
        for (width, threads) in [1, 2, 3, 4, 5, 12, 16, 24, 27, 48].into_iter().flat_map(|width| [(width, 1), (width, 2)]) {
            let (mut x, mut count) = (vec![0.5; Sums::ROWS * width], vec![0.0; Sums::ROWS * width]);
            let g = Grad::Rows(RowSparse::deferred(&[Sums::ROWS, width], Arc::new(Sums { width })));
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| update([&mut x, &mut count], &g, false, |[x, count]: [f64; 2], g| [x - g, count + 1.0]));
            for (at, (&x, &count)) in x.iter().zip(&count).enumerate() {
                let want = if Sums::touches(at / width) { (0.5 - Sums::number(at), 1.0) } else { (0.5, 0.0) };
                assert_eq!((x, count), want, "rows of width {width}, element {at}");
            }
        }
    }
}
