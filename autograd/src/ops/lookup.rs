//! Gathering rows of a table and scattering values into rows. Each op is the adjoint of the other.

use crate::index::Indices;
use crate::op::{Cotangent, Keep, Op, Vjp};
use crate::parallel::{self, dispatched, streamed};
use crate::pool::Buffer;
use crate::real::Real;
use crate::rows::sum;
use crate::tensor::Tensor;

/// yₖ = x[rowsₖ].   ∂L/∂x is row-sparse: ∂L/∂yₖ is added to row rowsₖ
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

/// y = Σ over k of xₖ in row rowsₖ.   ∂L/∂xₖ = ∂L/∂y[rowsₖ]
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
    /// Gathers rows of this table: row i of the result is row `rows[i]` of the table. The table has shape `[R, …]` and the result `[rows.len(), …]`. The
    /// gradient of the table is row-sparse.
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
        // Loops with a constant width: the widths of voxel grids (1, 3 and 27), and 4 and 28, which `benches/ops.rs` measures.
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

    /// Adds the rows of this tensor to a table of zeros: row i is added to row `rows[i]`, in the order of i. This tensor has shape `[rows.len(), …]` and the
    /// result `[table_rows, …]`.
    ///
    /// Panics if the number of row numbers differs from the number of rows, or if a row number is `table_rows` or more.
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
    /// Returns the size of the first dimension.
    ///
    /// Panics with the name of the op if the tensor has no dimensions.
    #[track_caller]
    pub(crate) fn first_len(&self, op: &str) -> usize {
        assert!(self.ndim() > 0, "{op}: expected rows, got a tensor of shape []");
        self.shape()[0]
    }
}

/// Adds row i of `values` to row `rows[i]` of a table with `width` columns, in place and in the order of i.
///
/// Panics if a row number is out of range (unless `width` is 0), or if `values` does not have one row of `width` values for each row number.
#[track_caller]
pub fn add_rows<T: Real>(table: &mut [T], width: usize, rows: &[u32], values: &[T]) {
    if let Some(count) = table.len().checked_div(width) {
        check_rows("add_rows", rows, count);
    }
    assert_eq!(values.len(), rows.len() * width, "add_rows: {} values for {} rows of {width}", values.len(), rows.len());
    // With more threads, scanning all row numbers on every thread costs more than sorting them.
    let few = parallel::threads() <= 8;
    match width {
        0 => {}
        1 if few => sum::add_short_rows::<T, 1>(table, rows, values),
        3 if few => sum::add_short_rows::<T, 3>(table, rows, values),
        4 if few => sum::add_short_rows::<T, 4>(table, rows, values),
        _ => sum::add_into_table(table, width, rows, values),
    }
}

#[track_caller]
fn check_rows(op: &str, rows: &[u32], table: usize) {
    let largest = parallel::map_chunks(rows.len(), parallel::CHUNK, |range| largest(&rows[range])).into_iter().max().unwrap_or(0);
    assert!(rows.is_empty() || (largest as usize) < table, "{op}: row {largest} is out of range for a table of {table} rows");
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
