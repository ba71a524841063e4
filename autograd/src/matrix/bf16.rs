//! Products of `f32` matrices with [`Precision::Mixed`](super::Precision::Mixed), by the instruction `vdpbf16ps` of AVX512-BF16: out += x₀ y₀ + x₁ y₁ in each of 16
//! lanes, where x and y are bf16 and the sum is `f32`.
//!
//! Both matrices are copied first: their entries are rounded, and the two factors of a pair are put side by side. Then tiles of 8 × 32 numbers of the result are
//! computed in registers.

use super::Matrix;
use crate::pool::Buffer;
use std::arch::x86_64::*;
use std::array::from_fn;

/// Numbers of a vector.
const LANES: usize = 16;
/// Rows of a tile.
const ROWS: usize = 8;
/// Columns of a tile.
const COLS: usize = 2 * LANES;
/// Distance of prefetches, in numbers. The rows of the activations of a network follow one another in memory, block by block.
const AHEAD: usize = 2048;

/// Returns true if this processor has the instructions.
pub fn is_available() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512bw") && is_x86_feature_detected!("avx512bf16")
}

/// Computes out = a · b, or out += a · b if `add`, where the sizes fit.
///
/// Panics if the processor does not have the instructions.
pub fn product(a: Matrix<'_, f32>, b: Matrix<'_, f32>, out: &mut [f32], add: bool) {
    assert!(is_available());
    // SAFETY: the processor has the instructions.
    unsafe { product_of_copies(a, b, out, add) }
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn product_of_copies(a: Matrix<'_, f32>, b: Matrix<'_, f32>, out: &mut [f32], add: bool) {
    let (pairs, n) = (a.cols.div_ceil(2), b.cols);
    // Tiles of a power of two of bytes would share a few sets of the first-level cache.
    let depth = pairs.next_multiple_of(LANES) + 1;
    let (of_a, of_b) = (packed::<LANES>(a.transpose(), depth), packed::<COLS>(b, depth));
    for (tile, b) in of_b.chunks_exact(depth * COLS).enumerate() {
        let (b, col) = (&b.as_chunks::<COLS>().0[..pairs], tile * COLS);
        for (a, out) in of_a.chunks_exact(depth * LANES).zip(out.chunks_mut(LANES * n)) {
            let a = &a.as_chunks::<LANES>().0[..pairs];
            for (half, out) in out.chunks_mut(ROWS * n).enumerate() {
                match (half, n - col <= LANES) {
                    (0, true) => tile_of::<0, 1>(a, b, out, (n, col, add)),
                    (0, false) => tile_of::<0, 2>(a, b, out, (n, col, add)),
                    (_, true) => tile_of::<ROWS, 1>(a, b, out, (n, col, add)),
                    (_, false) => tile_of::<ROWS, 2>(a, b, out, (n, col, add)),
                }
            }
        }
    }
}

/// Computes a tile of `V` vectors in each row, from row `FIRST` of `a` on.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn tile_of<const FIRST: usize, const V: usize>(
    a: &[[u32; LANES]],
    b: &[[u32; COLS]],
    out: &mut [f32],
    (n, col, add): (usize, usize, bool),
) {
    let mut sums = [[_mm512_setzero_ps(); V]; ROWS];
    for (x, y) in a.iter().zip(b) {
        let y: [__m512i; V] = from_fn(|v| load(&y[LANES * v..]));
        for (row, sums) in sums.iter_mut().enumerate() {
            let x = _mm512_set1_epi32(x[FIRST + row].cast_signed());
            for (sum, y) in sums.iter_mut().zip(y) {
                *sum = _mm512_dpbf16_ps(*sum, as_bf16(x), as_bf16(y));
            }
        }
    }
    for (row, sums) in out.chunks_exact_mut(n).zip(sums) {
        for (out, sum) in row[col..].chunks_mut(LANES).zip(sums) {
            let sum = if add { _mm512_add_ps(load_part(out), sum) } else { sum };
            store_part(out, sum);
        }
    }
}

/// Returns the pairs of entries (2p, c) and (2p + 1, c) of a matrix, `[columns / WIDTH, depth, WIDTH]`. The last row of an odd number has the partner 0;
/// pairs after the last row, and columns after the last column, are unspecified.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn packed<const WIDTH: usize>(matrix: Matrix<'_, f32>, depth: usize) -> Buffer<u32> {
    let (rows, cols) = (matrix.rows, matrix.cols);
    let mut out = Buffer::<u32>::stale(cols.next_multiple_of(WIDTH) * depth);
    let place = |pair: usize, col: usize| (col / WIDTH * depth + pair) * WIDTH + col % WIDTH;
    if matrix.is_transposed() {
        for first in (0..cols).step_by(LANES) {
            let column = |c: usize| &matrix.data[(first + c).min(cols - 1) * matrix.col..][..rows];
            let columns: [&[f32]; LANES] = from_fn(column);
            for pair in (0..rows.div_ceil(2)).step_by(LANES) {
                let of_columns = if rows >= 2 * (pair + LANES) {
                    from_fn(|c| {
                        let (low, high) = columns[c][2 * pair..2 * (pair + LANES)].split_at(LANES);
                        as_integers(_mm512_cvtne2ps_pbh(load_part(high), load_part(low)))
                    })
                } else {
                    columns.map(|column| {
                        let (low, high) = column[2 * pair..].split_at(LANES.min(rows - 2 * pair));
                        as_integers(_mm512_cvtne2ps_pbh(load_part(high), load_part(low)))
                    })
                };
                let out = &mut out[place(pair, first)..];
                for (i, of_pair) in transpose(of_columns).into_iter().enumerate() {
                    store(&mut out[WIDTH * i..], of_pair);
                }
            }
        }
    } else {
        // Numbers 0, 16, 1, 17, … of 32 numbers of 16 bits.
        let order = _mm512_or_si512(_mm512_slli_epi32::<16>(_mm512_add_epi32(lanes(), _mm512_set1_epi32(16))), lanes());
        for pair in 0..rows.div_ceil(2) {
            let row = |r: usize| if r < rows { &matrix.data[r * matrix.row..][..cols] } else { &[] };
            let (even, odd) = (row(2 * pair), row(2 * pair + 1));
            for line in (0..2 * cols).step_by(LANES) {
                _mm_prefetch::<_MM_HINT_T0>(even.as_ptr().wrapping_add(line + AHEAD).cast());
            }
            for (block, (even, odd)) in even.chunks(LANES).zip(odd.chunks(LANES).chain(std::iter::repeat(&[][..]))).enumerate() {
                let both = _mm512_cvtne2ps_pbh(load_part(odd), load_part(even));
                store(&mut out[place(pair, LANES * block)..], _mm512_permutexvar_epi16(order, as_integers(both)));
            }
        }
    }
    out
}

/// Returns the columns of a square matrix with these rows: bit d of the row and of the column are exchanged, for each d.
#[target_feature(enable = "avx512f")]
#[inline]
fn transpose(rows: [__m512i; LANES]) -> [__m512i; LANES] {
    exchange::<8>(exchange::<4>(exchange::<2>(exchange::<1>(rows))))
}

/// Exchanges one bit of the row and of the column.
#[target_feature(enable = "avx512f")]
#[inline]
fn exchange<const BIT: usize>(rows: [__m512i; LANES]) -> [__m512i; LANES] {
    let bit = _mm512_set1_epi32(BIT as i32);
    let has_bit = _mm512_test_epi32_mask(lanes(), bit);
    // The lanes of two rows are numbered from 0 to 31.
    let upper = _mm512_mask_add_epi32(lanes(), has_bit, lanes(), _mm512_set1_epi32(16 - BIT as i32));
    let lower = _mm512_mask_add_epi32(_mm512_add_epi32(lanes(), bit), has_bit, lanes(), _mm512_set1_epi32(16));
    from_fn(|i| _mm512_permutex2var_epi32(rows[i & !BIT], if i & BIT == 0 { upper } else { lower }, rows[i | BIT]))
}

/// The numbers 0 to 15.
#[target_feature(enable = "avx512f")]
#[inline]
fn lanes() -> __m512i {
    _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
}

#[target_feature(enable = "avx512f")]
#[inline]
fn load(from: &[u32]) -> __m512i {
    let from: &[u32; LANES] = from.first_chunk().expect("a vector");
    // SAFETY: the array has the size of a vector.
    unsafe { _mm512_loadu_si512(from.as_ptr().cast()) }
}

#[target_feature(enable = "avx512f")]
#[inline]
fn store(to: &mut [u32], x: __m512i) {
    let to: &mut [u32; LANES] = to.first_chunk_mut().expect("a vector");
    // SAFETY: the array has the size of a vector.
    unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), x) }
}

/// Loads the first numbers of a slice, and 0 in lanes after its end.
#[target_feature(enable = "avx512f")]
#[inline]
fn load_part(from: &[f32]) -> __m512 {
    // SAFETY: a vector is read if the slice has one, or else the lanes that lie inside it.
    unsafe {
        if from.len() >= LANES { _mm512_loadu_ps(from.as_ptr()) } else { _mm512_maskz_loadu_ps((1 << from.len()) - 1, from.as_ptr()) }
    }
}

/// Stores the first lanes in a slice.
#[target_feature(enable = "avx512f")]
#[inline]
fn store_part(to: &mut [f32], x: __m512) {
    // SAFETY: a vector is written if the slice has one, or else the lanes that lie inside it.
    unsafe {
        if to.len() >= LANES {
            _mm512_storeu_ps(to.as_mut_ptr(), x)
        } else {
            _mm512_mask_storeu_ps(to.as_mut_ptr(), (1 << to.len()) - 1, x)
        }
    }
}

#[target_feature(enable = "avx512f")]
#[inline]
fn as_bf16(x: __m512i) -> __m512bh {
    // SAFETY: both types are 512 bits, and all bits are valid.
    unsafe { std::mem::transmute(x) }
}

#[target_feature(enable = "avx512f")]
#[inline]
fn as_integers(x: __m512bh) -> __m512i {
    // SAFETY: as above.
    unsafe { std::mem::transmute(x) }
}
