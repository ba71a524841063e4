//! Rows of a table by number, and back: each other's adjoint.

use crate::index::Indices;
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel::{self, dispatched, streamed};
use crate::pool::Buffer;
use crate::real::Real;
use crate::rows::sum;
use crate::tensor::Tensor;

/// yₖ = x[rowsₖ].   ∂L/∂x is ∂L/∂y as rows, never a dense table
#[derive(Debug)]
struct GatherRows {
    rows: Indices,
}
impl<T: Real> Op<T> for GatherRows {
    fn name(&self) -> &'static str {
        "gather_rows"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt_rows(0, &self.rows, || cx.cotangent().clone())]
    }
}

/// y = zeros, with xₖ added to row rowsₖ.   ∂L/∂xₖ = ∂L/∂y[rowsₖ]
#[derive(Debug)]
struct ScatterRows {
    rows: Indices,
}
impl<T: Real> Op<T> for ScatterRows {
    fn name(&self) -> &'static str {
        "scatter_rows"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent().gather_rows(&self.rows))]
    }
}

impl<T: Real> Tensor<T> {
    /// `[R, …]` to `[k, …]`: row `rows[i]` of this table, for each i. The gradient is row-sparse.
    ///
    /// Panics if a row number is R or more.
    #[track_caller]
    pub fn gather_rows(&self, rows: &Indices) -> Self {
        check_rows("gather_rows", rows, self.first_len("gather_rows"));
        let width: usize = self.shape()[1..].iter().product();
        let mut shape = self.shape().to_vec();
        shape[0] = rows.len();
        let mut out = Buffer::stale(rows.len() * width);
        let table = self.data();
        // Widths of grids, and 4 and 28, which `benches/ops.rs` measures.
        match width {
            1 => gather_into::<T, 1>(table, rows, &mut out),
            3 => gather_into::<T, 3>(table, rows, &mut out),
            4 => gather_into::<T, 4>(table, rows, &mut out),
            27 => gather_into::<T, 27>(table, rows, &mut out),
            28 => gather_into::<T, 28>(table, rows, &mut out),
            _ => parallel::for_each_rows(&mut out, width, |first, chunk| {
                for (target, &row) in chunk.chunks_exact_mut(width.max(1)).zip(&rows[first..]) {
                    target.copy_from_slice(&table[row as usize * width..][..width]);
                }
            }),
        }
        Tensor::from_op(out, &shape, &[self], GatherRows { rows: rows.clone() })
    }

    /// `[k, …]` to `[table_rows, …]`: zeros, with row i of this added to row `rows[i]`, in the order of i.
    ///
    /// Panics if there is not one row number for each row, or one is too large.
    #[track_caller]
    pub fn scatter_rows(&self, rows: &Indices, table_rows: usize) -> Self {
        assert_eq!(
            rows.len(),
            self.first_len("scatter_rows"),
            "scatter_rows: {} row numbers for a tensor of shape {:?}",
            rows.len(),
            self.shape()
        );
        let mut shape = self.shape().to_vec();
        shape[0] = table_rows;
        let mut out = Buffer::zeros(shape.iter().product());
        add_rows(&mut out, self.shape()[1..].iter().product(), rows, self.data());
        Tensor::from_op(out, &shape, &[self], ScatterRows { rows: rows.clone() })
    }
}

impl<T: Real> Tensor<T> {
    /// The number of rows. Panics, naming the op, if there are none because this is a scalar.
    #[track_caller]
    pub(crate) fn first_len(&self, op: &str) -> usize {
        assert!(self.ndim() > 0, "{op}: expected rows, got a tensor of shape []");
        self.shape()[0]
    }
}

/// Adds row i of `values` to row `rows[i]` of a table of `width` columns, in place and in the order of i.
///
/// Panics if a row number lies beyond the table.
#[track_caller]
pub fn add_rows<T: Real>(table: &mut [T], width: usize, rows: &[u32], values: &[T]) {
    check_rows("add_rows", rows, table.len() / width.max(1));
    assert_eq!(values.len(), rows.len() * width, "add_rows: {} values for {} rows of {width}", values.len(), rows.len());
    // More threads would spend more on looking through the rows than they save.
    let few = parallel::threads() <= 8;
    match width {
        1 if few => sum::add_short_rows::<T, 1>(table, rows, values),
        3 if few => sum::add_short_rows::<T, 3>(table, rows, values),
        4 if few => sum::add_short_rows::<T, 4>(table, rows, values),
        _ => sum::add_into_table(table, width, rows, values),
    }
}

#[track_caller]
fn check_rows(op: &str, rows: &[u32], table: usize) {
    let largest = parallel::map_chunks(rows.len(), parallel::CHUNK, |range| largest(&rows[range])).into_iter().max().unwrap_or(0);
    assert!(rows.is_empty() || (largest as usize) < table, "{op}: row {largest} of a table of {table} rows");
}

dispatched! {
fn largest(rows: &[u32]) -> u32 {
    rows.iter().copied().fold(0, u32::max)
}
}

fn gather_into<T: Real, const W: usize>(table: &[T], rows: &[u32], out: &mut [T]) {
    let past_cache = (W * size_of::<T>()).is_multiple_of(streamed::UNIT) && streamed::worthwhile(out);
    parallel::for_each_rows(out, W, |first, chunk| {
        let rows = &rows[first..];
        if past_cache {
            streamed::copy_rows::<T, W>(table.as_chunks().0, rows, chunk.as_chunks_mut().0);
        } else {
            copy_rows::<T, W>(table, rows, chunk);
        }
    });
}

dispatched! {
fn copy_rows<T: Real, const W: usize>(table: &[T], rows: &[u32], out: &mut [T]) {
    let (table, _) = table.as_chunks::<W>();
    let (out, _) = out.as_chunks_mut::<W>();
    for (target, &row) in out.iter_mut().zip(rows) {
        *target = table[row as usize];
    }
}
}
