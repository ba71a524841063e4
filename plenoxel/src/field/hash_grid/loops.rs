//! Inner loops of the hash encoding. Positions are processed in groups of [`TOGETHER`], level by level: the rows of a level are computed and
//! prefetched while those of the level before are read.

use super::Level;
use autograd::{Real, dispatched, parallel};

/// Number of positions that are processed together.
pub const TOGETHER: usize = 16;

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

#[inline(always)]
pub fn group<T: Real>(places: &[[T; 3]]) -> Group<T> {
    let mut group = [[T::zero(); TOGETHER]; 3];
    for (i, place) in places.iter().enumerate() {
        for a in 0..3 {
            group[a][i] = place[a].max(T::zero()).min(T::one());
        }
    }
    group
}

/// Cells of a group of positions at one level.
#[derive(Clone, Copy)]
pub struct Cells<T> {
    /// Row of each corner. Bit a of the number of a corner is set if it is the upper node along axis a.
    pub rows: [[u32; TOGETHER]; 8],
    /// Weights of the lower and of the upper node along each axis.
    pub shares: [[[T; TOGETHER]; 2]; 3],
}

impl<T: Real> Cells<T> {
    #[inline(always)]
    pub fn new<const FUSED: bool>(level: &Level, at: &Group<T>) -> Self {
        let (scale, half, factors) = (T::lit(level.scale), T::lit(0.5), level.factors());
        let mut shares = [[[T::zero(); TOGETHER]; 2]; 3];
        let mut parts = [[[0; TOGETHER]; 2]; 3];
        for a in 0..3 {
            for i in 0..TOGETHER {
                let u = at[a][i].multiply_add::<FUSED>(scale, half);
                let low = u.floor();
                (shares[a][0][i], shares[a][1][i]) = (T::one() - (u - low), u - low);
                let part = low.index().wrapping_mul(factors[a]);
                (parts[a][0][i], parts[a][1][i]) = (part, part.wrapping_add(factors[a]));
            }
        }
        let mut rows = [[0; TOGETHER]; 8];
        for c in 0..8 {
            let [x, y, z] = [&parts[0][c & 1], &parts[1][c >> 1 & 1], &parts[2][c >> 2]];
            if level.hashed {
                let (mask, first) = (level.rows as u32 - 1, level.first as u32);
                for i in 0..TOGETHER {
                    rows[c][i] = ((x[i] ^ y[i] ^ z[i]) & mask) + first;
                }
            } else {
                for i in 0..TOGETHER {
                    rows[c][i] = level.row([x[i], y[i], z[i]]);
                }
            }
        }
        Cells { rows, shares }
    }

    /// Returns the weights of the corners of a position.
    #[inline(always)]
    pub fn weights(&self, i: usize) -> [T; 8] {
        let [x, y, z] = [0, 1, 2].map(|a| [self.shares[a][0][i], self.shares[a][1][i]]);
        let xy = [x[0] * y[0], x[1] * y[0], x[0] * y[1], x[1] * y[1]];
        std::array::from_fn(|c| xy[c & 3] * z[c >> 2])
    }

    /// Prefetches the rows of the first `count` positions.
    #[inline(always)]
    fn prefetch<const F: usize>(&self, table: &[[T; F]], count: usize) {
        for rows in &self.rows {
            for &row in &rows[..count] {
                parallel::prefetch(&table[row as usize]);
            }
        }
    }
}

/// Number of bytes of a level above which its rows are prefetched: those of smaller levels stay in the cache.
const PREFETCHED: usize = 1 << 17;

#[inline(always)]
fn prefetched<const F: usize, T>(level: &Level) -> bool {
    level.rows * F * size_of::<T>() > PREFETCHED
}

/// Encodes positions: `out` is `[places, levels · features]`.
pub fn encode<T: Real>(levels: &[Level], features: usize, table: &[T], places: &[[T; 3]], out: &mut [T]) {
    with_features!(features, encode_loop::<T>(levels, table, places, out));
}

dispatched! {
fn encode_loop<T: Real, const F: usize, const FUSED: bool>(levels: &[Level], table: &[T], places: &[[T; 3]], out: &mut [T]) {
    let table = table.as_chunks::<F>().0;
    let width = levels.len();
    for (places, out) in places.chunks(TOGETHER).zip(out.as_chunks_mut::<F>().0.chunks_mut(TOGETHER * width)) {
        let at = group(places);
        let mut next = Cells::new::<FUSED>(&levels[0], &at);
        for l in 0..width {
            let cells = next;
            if let Some(level) = levels.get(l + 1) {
                next = Cells::new::<FUSED>(level, &at);
                if prefetched::<F, T>(level) {
                    next.prefetch(table, places.len());
                }
            }
            for i in 0..places.len() {
                let weights = cells.weights(i);
                let mut value = [T::zero(); F];
                for c in 0..8 {
                    let row = &table[cells.rows[c][i] as usize];
                    for f in 0..F {
                        value[f] = row[f].multiply_add::<FUSED>(weights[c], value[f]);
                    }
                }
                out[i * width + l] = value;
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
    let groups = places.chunks(TOGETHER).zip(g.as_chunks::<F>().0.chunks(TOGETHER * width));
    for ((places, g), out) in groups.zip(out.as_chunks_mut::<3>().0.chunks_mut(TOGETHER)) {
        let at = group(places);
        out.fill([T::zero(); 3]);
        for (l, level) in levels.iter().enumerate() {
            let cells = Cells::new::<FUSED>(level, &at);
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
