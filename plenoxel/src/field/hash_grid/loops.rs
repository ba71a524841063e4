//! Inner loops of the hash encoding. A loop processes one level, because the rows of one level fit in a cache and those of all levels do not. It processes
//! groups of [`TOGETHER`] positions. With one or two features, [`encode`] reads all corners of a group before it interpolates them: only the loop that reads waits
//! for memory, and it has nothing else to do, so dozens of its reads are under way.
//!
//! Between the loops and the tensors `[m, levels · features]`, numbers are in blocks of [`BLOCK`] positions: `[level, position, feature]` in each block.

use super::Level;
use autograd::{Real, dispatched, parallel};

/// Number of positions that are processed together. With 16, the compiler unrolls the loops before it vectorizes, and parts of them stay scalar.
pub const TOGETHER: usize = 64;

/// Number of positions in a block, except for the last.
pub const BLOCK: usize = 4096;

const _: () = assert!(BLOCK.is_multiple_of(TOGETHER));

/// Calls a loop with the number of features as a constant, in the version for this machine.
macro_rules! with_features {
    ($features:expr, $loop:ident::<$T:ty>($($argument:expr),*)) => {
        match ($features, autograd::parallel::fused()) {
            (1, true) => $loop::<$T, 1, true>($($argument),*),
            (2, true) => $loop::<$T, 2, true>($($argument),*),
            (4, true) => $loop::<$T, 4, true>($($argument),*),
            (8, true) => $loop::<$T, 8, true>($($argument),*),
            (1, false) => $loop::<$T, 1, false>($($argument),*),
            (2, false) => $loop::<$T, 2, false>($($argument),*),
            (4, false) => $loop::<$T, 4, false>($($argument),*),
            (8, false) => $loop::<$T, 8, false>($($argument),*),
            (other, _) => unreachable!("{other} features"),
        }
    };
}
pub(super) use with_features;

/// Coordinates of a group of positions, one array for each axis, clamped to [0, 1]. Entries beyond the last position are 0.
pub type Group<T> = [[T; TOGETHER]; 3];

/// Returns the groups of positions.
pub fn groups<T: Real>(places: &[[T; 3]]) -> Vec<Group<T>> {
    let mut groups = vec![[[T::zero(); TOGETHER]; 3]; places.len().div_ceil(TOGETHER)];
    parallel::for_each_chunk(&mut groups, BLOCK / TOGETHER, |first, groups| {
        for (to, places) in groups.iter_mut().zip(places[first * TOGETHER..].chunks(TOGETHER)) {
            *to = group(places);
        }
    });
    groups
}

#[inline(always)]
fn group<T: Real>(places: &[[T; 3]]) -> Group<T> {
    let mut group = [[T::zero(); TOGETHER]; 3];
    for (i, place) in places.iter().enumerate() {
        for a in 0..3 {
            group[a][i] = place[a].max(T::zero()).min(T::one());
        }
    }
    group
}

/// Cells of a group of positions at one level.
pub struct Cells<T> {
    /// Coordinates of the lowest node of each cell, times the factors of the level.
    lowest: [[u32; TOGETHER]; 3],
    /// Row of each corner. Bit a of the number of a corner is set if it is the upper node along axis a.
    rows: [[u32; TOGETHER]; 8],
    /// Weights of the lower and of the upper node along each axis.
    pub shares: [[[T; TOGETHER]; 2]; 3],
}

impl<T: Real> Cells<T> {
    /// Creates cells that [`find`](Self::find) fills.
    pub fn none() -> Self {
        Cells { lowest: [[0; TOGETHER]; 3], rows: [[0; TOGETHER]; 8], shares: [[[T::zero(); TOGETHER]; 2]; 3] }
    }

    /// Finds the cells of a group of positions at a level. The first row of the level has the number `first`; numbers may wrap around.
    #[inline(always)]
    pub fn find<const FUSED: bool>(&mut self, level: &Level, first: u32, at: &Group<T>) {
        let Cells { lowest, rows, shares } = self;
        let (scale, half, factors) = (T::lit(level.scale), T::lit(0.5), level.factors());
        for a in 0..3 {
            for i in 0..TOGETHER {
                let u = at[a][i].multiply_add::<FUSED>(scale, half);
                let low = u.floor();
                (shares[a][0][i], shares[a][1][i]) = (T::one() - (u - low), u - low);
                lowest[a][i] = low.index().wrapping_mul(factors[a]);
            }
        }
        if level.hashed { find_rows::<true>(level, first, lowest, rows) } else { find_rows::<false>(level, first, lowest, rows) }
    }

    /// Returns the weights of the corners.
    #[inline(always)]
    fn weights(&self) -> [[T; TOGETHER]; 8] {
        let [x, y, z] = &self.shares;
        let mut weights = [[T::zero(); TOGETHER]; 8];
        for c in 0..8 {
            for i in 0..TOGETHER {
                weights[c][i] = x[c & 1][i] * y[c >> 1 & 1][i] * z[c >> 2][i];
            }
        }
        weights
    }

    /// Returns 0 for each position whose edges along x have neighboring rows: the upper row is the next one or, in a hashed level, differs in the last bit only.
    #[inline(always)]
    pub fn apart<const HASHED: bool>(&self) -> [u32; TOGETHER] {
        let mut apart = [0; TOGETHER];
        for [lower, upper] in self.edges() {
            for i in 0..TOGETHER {
                let difference = if HASHED { lower[i] ^ upper[i] } else { upper[i].wrapping_sub(lower[i]) };
                apart[i] |= difference ^ 1;
            }
        }
        apart
    }

    /// Returns the rows of the lower and of the upper node of the four edges along x.
    #[inline(always)]
    pub fn edges(&self) -> &[[[u32; TOGETHER]; 2]; 4] {
        self.rows.as_chunks().0.as_array().expect("eight corners")
    }

    /// Interpolates the corners of all cells: along x, then along y, then along z. All corners are read, into `corners`, before the first is interpolated: no
    /// arithmetic waits for the table. With `neighbors`, the two rows of an edge along x follow each other and are read as one; otherwise they mostly are in the
    /// same cache line.
    #[inline(always)]
    fn interpolate<const F: usize, const FUSED: bool>(
        &self,
        table: &[[T; F]],
        neighbors: bool,
        corners: &mut [[[T; F]; TOGETHER]; 8],
        out: &mut [[T; F]; TOGETHER],
    ) {
        for ([lower, upper], rows) in corners.as_chunks_mut::<2>().0.iter_mut().zip(self.edges()) {
            if neighbors {
                for i in 0..TOGETHER {
                    let row = rows[0][i] as usize;
                    let pair = table[row..row + 2].as_array::<2>().expect("two rows");
                    (lower[i], upper[i]) = (pair[0], pair[1]);
                }
            } else {
                for i in 0..TOGETHER {
                    lower[i] = table[rows[0][i] as usize];
                    upper[i] = table[rows[1][i] as usize];
                }
            }
        }
        let between = |low: T, high: T, share: T| (high - low).multiply_add::<FUSED>(share, low);
        let [x, y, z] = self.shares.each_ref().map(|[_, upper]| upper);
        for i in 0..TOGETHER {
            for f in 0..F {
                let along_x = |c: usize| between(corners[c][i][f], corners[c + 1][i][f], x[i]);
                let along_y = |c: usize| between(along_x(c), along_x(c + 2), y[i]);
                out[i][f] = between(along_y(0), along_y(4), z[i]);
            }
        }
    }

    /// Computes the sums of the weighted corners of one cell after another; the rows of a later cell are prefetched.
    #[inline(always)]
    fn interpolate_one_by_one<const F: usize, const FUSED: bool>(&self, table: &[[T; F]], sums: &mut [[T; F]; TOGETHER]) {
        const AHEAD: usize = 16;
        let prefetch = |i: usize| {
            for c in 0..8 {
                if let Some(row) = table.get(self.rows[c][i] as usize) {
                    parallel::prefetch(&row[0]);
                }
            }
        };
        (0..AHEAD).for_each(prefetch);
        let weights = self.weights();
        *sums = [[T::zero(); F]; TOGETHER];
        for i in 0..TOGETHER {
            if i + AHEAD < TOGETHER {
                prefetch(i + AHEAD);
            }
            for c in 0..8 {
                let row = &table[self.rows[c][i] as usize];
                for f in 0..F {
                    sums[i][f] = row[f].multiply_add::<FUSED>(weights[c][i], sums[i][f]);
                }
            }
        }
    }
}

/// Finds the rows of the corners of cells, from the coordinates of their lowest nodes times the factors of the level.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn find_rows<const HASHED: bool>(level: &Level, first: u32, lowest: &[[u32; TOGETHER]; 3], rows: &mut [[u32; TOGETHER]; 8]) {
    let factors = level.factors();
    for c in 0..8 {
        let up = [c & 1, c >> 1 & 1, c >> 2];
        for i in 0..TOGETHER {
            let node = [0, 1, 2].map(|a| lowest[a][i].wrapping_add(factors[a].wrapping_mul(up[a] as u32)));
            rows[c][i] = level.row_in_level::<HASHED>(node).wrapping_add(first);
        }
    }
}

/// Encodes positions at one level: `out` is `[positions, features]`.
pub fn encode<T: Real>(level: &Level, features: usize, table: &[T], groups: &[Group<T>], out: &mut [T]) {
    with_features!(features, encode_loop::<T>(level, table, groups, out));
}

dispatched! {
fn encode_loop<T: Real, const F: usize, const FUSED: bool>(level: &Level, table: &[T], groups: &[Group<T>], out: &mut [T]) {
    let table = &table.as_chunks::<F>().0[level.first..][..level.rows];
    let (mut cells, mut corners, mut spare) = (Cells::none(), [[[T::zero(); F]; TOGETHER]; 8], [[T::zero(); F]; TOGETHER]);
    for (group, out) in groups.iter().zip(out.as_chunks_mut::<F>().0.chunks_mut(TOGETHER)) {
        cells.find::<FUSED>(level, 0, group);
        let count = out.len();
        let values = if count == TOGETHER { out.first_chunk_mut().expect("a whole group") } else { &mut spare };
        // Rows of four features and more are vectors of their own; a buffer for their corners would fill the first-level cache.
        if const { F <= 2 } {
            cells.interpolate::<F, FUSED>(table, !level.hashed && cells.apart::<false>() == [0; TOGETHER], &mut corners, values);
        } else {
            cells.interpolate_one_by_one::<F, FUSED>(table, values);
        }
        if count < TOGETHER {
            out.copy_from_slice(&spare[..count]);
        }
    }
}
}

/// Copies a block to rows of a tensor `[m, levels · features]`, or such rows to a block.
pub fn copy_block<T: Real>(levels: usize, features: usize, to_rows: bool, from: &[T], to: &mut [T]) {
    with_features!(features, copy_loop::<T>(levels, to_rows, from, to));
}

dispatched! {
fn copy_loop<T: Real, const F: usize, const FUSED: bool>(levels: usize, to_rows: bool, from: &[T], to: &mut [T]) {
    let (from, to) = (from.as_chunks::<F>().0, to.as_chunks_mut::<F>().0);
    let count = to.len() / levels;
    // A few cache lines of each level at a time.
    const POSITIONS: usize = 16;
    for first in (0..count).step_by(POSITIONS) {
        for l in 0..levels {
            for i in first..count.min(first + POSITIONS) {
                let (in_block, in_rows) = (l * count + i, i * levels + l);
                let (source, target) = if to_rows { (in_block, in_rows) } else { (in_rows, in_block) };
                to[target] = from[source];
            }
        }
    }
}
}

/// Computes the cotangents of positions, `[places, 3]`, from those of their encodings.
pub fn slopes<T: Real>(levels: &[Level], features: usize, table: &[T], places: &[[T; 3]], g: &[T], out: &mut [T]) {
    with_features!(features, slopes_loop::<T>(levels, table, places, g, out));
}

dispatched! {
fn slopes_loop<T: Real, const F: usize, const FUSED: bool>(levels: &[Level], table: &[T], places: &[[T; 3]], g: &[T], out: &mut [T]) {
    let table = table.as_chunks::<F>().0;
    let width = levels.len();
    let mut cells = Cells::none();
    let groups = places.chunks(TOGETHER).zip(g.as_chunks::<F>().0.chunks(TOGETHER * width));
    for ((places, g), out) in groups.zip(out.as_chunks_mut::<3>().0.chunks_mut(TOGETHER)) {
        let at = group(places);
        out.fill([T::zero(); 3]);
        for (l, level) in levels.iter().enumerate() {
            cells.find::<FUSED>(level, level.first as u32, &at);
            for (i, out) in out.iter_mut().enumerate() {
                let g = &g[i * width + l];
                let [x, y, z] = [0, 1, 2].map(|a| [cells.shares[a][0][i], cells.shares[a][1][i]]);
                for c in 0..8 {
                    let row = &table[cells.rows[c][i] as usize];
                    let mut dot = T::zero();
                    for f in 0..F {
                        dot += g[f] * row[f];
                    }
                    dot *= T::lit(level.scale);
                    let [i, j, k] = [c & 1, c >> 1 & 1, c >> 2];
                    let signed = |up: usize| if up == 1 { dot } else { -dot };
                    out[0] += signed(i) * y[j] * z[k];
                    out[1] += signed(j) * x[i] * z[k];
                    out[2] += signed(k) * x[i] * y[j];
                }
            }
        }
        for (place, out) in places.iter().zip(out) {
            for a in 0..3 {
                if place[a] < T::zero() || place[a] > T::one() {
                    out[a] = T::zero();
                }
            }
        }
    }
}
}
