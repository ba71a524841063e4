//! Gradients of lookups: row-sparse at a leaf, dense otherwise.

use autograd::{Grad, Indices, Param, Tensor, value_and_grad};
use ndarray::{Array2, arr2};

fn table() -> Param<f64> {
    Param::new("table", Array2::from_shape_fn((6, 2), |(r, c)| (r * 2 + c) as f64 + 1.0))
}

fn rows(rows: &[u32]) -> Indices {
    Indices::from(rows.to_vec())
}

/// Returns the rows of the gradient of a loss with respect to the table, or `None` if it is dense, and the whole gradient as a dense array.
fn gradient(table: &Param<f64>, loss: impl FnOnce(&Tensor<f64>) -> Tensor<f64>) -> (Option<Vec<u32>>, Vec<f64>) {
    let (_, gradients) = value_and_grad(|| loss(table.tensor()));
    let gradient = gradients.of(table).expect("the loss depends on the table");
    (gradient.as_rows().map(|g| g.rows().to_vec()), gradient.to_array().into_iter().collect())
}

#[test]
fn a_look_up_gives_sorted_unique_rows_with_repetitions_added() {
    let (touched, values) = gradient(&table(), |t| t.gather_rows(&rows(&[4, 1, 4])).sum());
    assert_eq!(touched, Some(vec![1, 4]));
    assert_eq!(values, [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 0.0, 0.0]);
}

#[test]
fn rows_and_rows_stay_rows() {
    let (touched, values) = gradient(&table(), |t| t.gather_rows(&rows(&[4, 1])).sum() + 10.0 * t.gather_rows(&rows(&[5, 4])).sum());
    assert_eq!(touched, Some(vec![1, 4, 5]));
    assert_eq!(values, [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 11.0, 11.0, 10.0, 10.0]);
}

#[test]
fn rows_of_a_kernel_and_of_an_op_are_added() {
    let positions = Tensor::from_vec(vec![0.0, 0.25, 0.0], &[1, 3]);
    let (touched, values) = gradient(&table(), |t| t.gather_rows(&rows(&[3])).sum() + t.trilinear(&positions, [1, 6, 1]).sum());
    // An axis with one node gives the same row twice, with weight 0 the second time.
    assert_eq!(touched, Some(vec![0, 1, 3]));
    assert_eq!(values, [0.75, 0.75, 0.25, 0.25, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
}

#[test]
fn rows_and_dense_are_dense_whichever_comes_first() {
    let want = [1.0, 1.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
    for (touched, values) in [
        gradient(&table(), |t| t.gather_rows(&rows(&[1])).sum() + t.sum()),
        gradient(&table(), |t| t.sum() + t.gather_rows(&rows(&[1])).sum()),
    ] {
        assert_eq!(touched, None);
        assert_eq!(values, want);
    }
}

#[test]
fn rows_that_arrive_at_an_op_are_made_dense_so_look_up_before_activating() {
    let looked_up = rows(&[2]);
    let (before, _) = gradient(&table(), |t| t.gather_rows(&looked_up).exp().sum());
    let (after, _) = gradient(&table(), |t| t.exp().gather_rows(&looked_up).sum());
    assert_eq!((before, after), (Some(vec![2]), None));
}

#[test]
fn gradients_of_the_chunks_of_a_batch_add_up() {
    let table = table();
    let part = |looked_up: &[u32]| value_and_grad(|| table.tensor().gather_rows(&rows(looked_up)).sum()).1;
    let mut sum = part(&[1, 2]);
    sum.add(part(&[2, 3]));
    let gradient = sum.of(&table).and_then(Grad::as_rows).expect("rows");
    assert_eq!((gradient.rows(), gradient.data()), (&[1, 2, 3][..], &[1.0, 1.0, 2.0, 2.0, 1.0, 1.0][..]));
    sum.add(value_and_grad(|| table.tensor().sum()).1);
    assert_eq!(sum.of(&table).expect("dense").data(), [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0]);
    // A gradient that only the other pass has is added as it is.
    let other = Param::new("other", arr2(&[[1.0]]));
    sum.add(value_and_grad(|| other.tensor().square().sum()).1);
    assert_eq!(sum.of(&other).expect("taken over").data(), [2.0]);
}
