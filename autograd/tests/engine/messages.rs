//! Misuse panics at the caller's line, with a message that names the op and the shapes.

use autograd::{Cotangent, GradSink, Indices, Keep, Kernel, KernelCall, Op, Param, Tensor, Vjp, grad, value_and_grad};
use std::cell::RefCell;
use std::panic::{self, AssertUnwindSafe};
use std::sync::Once;

thread_local! {
    /// Message and file of the panic on this thread, while `panic_of` runs.
    static CAUGHT: RefCell<Option<(String, String)>> = const { RefCell::new(None) };
}

/// Returns the message of the panic in `f` and the file of its location.
fn panic_of<R>(f: impl FnOnce() -> R) -> (String, String) {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let usual = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            let expected = CAUGHT.with_borrow_mut(|caught| {
                if let Some(caught) = caught {
                    let text = info.payload_as_str().unwrap_or_default();
                    *caught = (text.to_owned(), info.location().map(|l| l.file().to_owned()).unwrap_or_default());
                }
                caught.is_some()
            });
            if !expected {
                usual(info);
            }
        }));
    });
    CAUGHT.set(Some(Default::default()));
    let result = panic::catch_unwind(AssertUnwindSafe(f));
    let caught = CAUGHT.take().expect("set above");
    assert!(result.is_err(), "this should have panicked");
    caught
}

fn x(shape: &[usize]) -> Tensor<f32> {
    Tensor::ones(shape)
}

fn rows(rows: &[u32]) -> Indices {
    Indices::from(rows.to_vec())
}

/// Each row has a misuse and the parts that its message must contain.
#[test]
fn misuse_of_shapes_names_the_op_and_the_shapes_at_the_line_of_the_caller() {
    type Misuse = (fn() -> Tensor<f32>, &'static [&'static str]);
    let misuses: &[Misuse] = &[
        (|| x(&[2, 3]) + x(&[2]), &["add", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]) - &x(&[2]), &["sub", "[2, 3]", "[2]"]),
        (|| &x(&[2, 3]) * x(&[4, 1, 2]), &["mul", "[2, 3]", "[4, 1, 2]"]),
        (|| &x(&[2, 3]) / &x(&[2]), &["div", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).maximum(&x(&[2])), &["maximum", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).minimum(&x(&[2])), &["minimum", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).sum_axis(2), &["sum_axis", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).mean_axis(2), &["mean_axis", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).max_axis(5), &["max_axis", "axis 5", "[2, 3]"]),
        (|| x(&[2, 3]).min_axis(5), &["min_axis", "axis 5", "[2, 3]"]),
        (|| x(&[0, 3]).max(), &["max", "no elements"]),
        (|| x(&[0, 3]).min(), &["min", "no elements"]),
        (|| x(&[2, 3]).pow(&x(&[2])), &["pow", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).log_sum_exp(2), &["log_sum_exp", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).softmax(2), &["softmax", "axis 2", "[2, 3]"]),
        (|| x(&[2, 0]).softmax(1), &["no elements"]),
        (|| x(&[2, 3]).norm(2), &["norm", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).normalize(2), &["normalize", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).sum_to(&[2]), &["sum_to", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).reshape(&[4]), &["reshape", "[2, 3]", "[4]"]),
        (|| x(&[2, 3]).unsqueeze(3), &["unsqueeze", "axis 3", "[2, 3]"]),
        (|| x(&[2, 3]).broadcast_to(&[2, 4]), &["broadcast_to", "[2, 3]", "[2, 4]"]),
        (|| x(&[2, 3]).permute(&[0, 0]), &["permute", "[0, 0]", "[2, 3]"]),
        (|| x(&[2]).transpose(), &["transpose", "[2]"]),
        (|| x(&[2, 3]).narrow(1, 2, 2), &["narrow", "2..4", "axis 1", "[2, 3]"]),
        (|| x(&[2, 3]).index_axis(2, 0), &["index_axis", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).index_axis(1, 3), &["index_axis", "3", "axis 1", "[2, 3]"]),
        (|| x(&[2, 3]).pad(1, 2, 4), &["pad", "[2, 3]", "2", "4"]),
        (|| x(&[2, 3]).pad(2, 0, 4), &["pad", "axis 2", "[2, 3]"]),
        (|| Tensor::concat(&[&x(&[2, 3]), &x(&[3, 3])], 1), &["concat", "[2, 3]", "[3, 3]", "axis 1"]),
        (|| Tensor::concat(&[&x(&[2, 3])], 2), &["concat", "axis 2", "[2, 3]"]),
        (|| Tensor::<f32>::concat(&[], 0), &["concat", "no tensors"]),
        (|| Tensor::stack(&[&x(&[2, 3]), &x(&[3])], 0), &["stack", "[2, 3]", "[3]"]),
        (|| x(&[2, 3]).matmul(&x(&[2, 3])), &["matmul", "[2, 3]", "[2, 3]"]),
        (|| x(&[2, 3]).matmul(&x(&[3])), &["matmul", "[2, 3]", "[3]"]),
        (|| x(&[4, 2, 3]).matmul(&x(&[5, 3, 2])), &["matmul", "[4]", "[5]"]),
        (|| x(&[2, 3]).cumsum(2), &["cumsum", "axis 2", "[2, 3]"]),
        (|| x(&[2, 3]).exclusive_cumsum(2), &["exclusive_cumsum", "axis 2", "[2, 3]"]),
        (|| x(&[4]).segment_sum(&rows(&[0, 3])), &["segment_sum", "4", "3"]),
        (|| x(&[4]).segment_sum(&rows(&[0, 5, 4])), &["segment_sum", "ascend"]),
        (|| x(&[4]).segment_sum(&rows(&[])), &["segment_sum", "ascend"]),
        (|| x(&[]).segment_sum(&rows(&[0, 1])), &["segment_sum", "[]"]),
        (|| x(&[4]).segment_repeat(&rows(&[0, 3])), &["segment_repeat", "1 segments", "[4]"]),
        (|| x(&[4]).segment_repeat(&rows(&[])), &["segment_repeat", "offsets"]),
        (|| x(&[4]).segment_exclusive_sum(&rows(&[1, 4])), &["segment_exclusive_sum", "4", "1"]),
        (|| x(&[4, 2]).gather_rows(&rows(&[0, 4])), &["gather_rows", "row 4", "4 rows"]),
        (|| x(&[]).gather_rows(&rows(&[0])), &["gather_rows", "[]"]),
        (|| x(&[4, 2]).scatter_rows(&rows(&[0, 1]), 3), &["scatter_rows", "2 row numbers", "[4, 2]"]),
        (|| x(&[2, 2]).scatter_rows(&rows(&[0, 3]), 3), &["_rows", "row 3", "3 rows"]),
        (|| x(&[]).scatter_rows(&rows(&[0]), 3), &["scatter_rows", "[]"]),
        (|| x(&[8, 2]).trilinear(&x(&[5, 3]), [2, 2, 3]), &["trilinear", "[2, 2, 3]", "12", "[8, 2]"]),
        (|| x(&[8, 2]).trilinear(&x(&[5, 2]), [2, 2, 2]), &["trilinear", "[m, 3]", "[5, 2]"]),
        (|| x(&[8]).nearest(&x(&[5, 3]), [2, 2, 2]), &["nearest", "[2, 2, 2]", "[8]"]),
        (|| x(&[2, 3]).masked(&x(&[2])), &["masked", "[2]", "[2, 3]"]),
        (|| x(&[3]).masked(&x(&[2, 3])), &["masked", "[2, 3]", "[3]"]),
        (|| x(&[2, 3]).greater(&x(&[2])), &["greater", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).greater_equal(&x(&[2])), &["greater_equal", "[2, 3]", "[2]"]),
        (|| x(&[2, 3]).equal(&x(&[2])), &["equal", "[2, 3]", "[2]"]),
        (|| Tensor::where_(&x(&[2]), &x(&[2, 3]), &x(&[2, 3])), &["[2]", "[2, 3]"]),
        (|| Tensor::from_vec(vec![1.0], &[2]), &["from_buffer", "1 values", "[2]"]),
        (|| Tensor::scalar(x(&[2]).item()), &["item", "[2]"]),
        (|| grad(&x(&[2]), &[]).remove(0), &["grad", "[2]"]),
        (|| Tensor::scalar(value_and_grad(|| x(&[2])).0), &["[2]"]),
    ];
    let mut wrong = Vec::new();
    for (number, (misuse, parts)) in misuses.iter().enumerate() {
        let (message, file) = panic_of(misuse);
        let missing: Vec<_> = parts.iter().filter(|part| !message.contains(**part)).collect();
        if !missing.is_empty() || !file.ends_with("messages.rs") {
            wrong.push(format!("{number} ({parts:?}): {missing:?} missing in {message:?}, in {file}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn backward_of_more_than_a_scalar_says_what_to_do() {
    let y = x(&[2]).into_variable().square();
    assert!(panic_of(|| y.backward()).0.contains("backward_from"));
    let (message, file) = panic_of(|| y.backward_from(&x(&[3])));
    assert!(message.contains("backward_from") && message.contains("[3]") && file.ends_with("messages.rs"), "{message} in {file}");
}

/// An op and kernel that keeps nothing, but whose rule reads a value.
#[derive(Debug)]
struct Forgetful {
    reads: &'static str,
}
impl Op<f32> for Forgetful {
    fn name(&self) -> &'static str {
        "forgetful_op"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn vjp(&self, cx: &Vjp<'_, f32>) -> Vec<Option<Cotangent<f32>>> {
        vec![cx.wrt(0, || if self.reads == "input" { cx.input(0) } else { cx.output() })]
    }
}
impl Kernel<f32> for Forgetful {
    fn name(&self) -> &'static str {
        "forgetful_kernel"
    }
    fn keep(&self) -> Keep {
        Keep::NOTHING
    }
    fn reference(&self, inputs: &[Tensor<f32>]) -> Tensor<f32> {
        inputs[0].clone()
    }
    fn vjp(&self, call: &KernelCall<'_, f32>, out: &mut GradSink<f32>) {
        let value = if self.reads == "input" { call.input(0) } else { call.output() };
        out.dense(0, value.data().to_vec().into());
    }
}

#[test]
fn reading_what_was_not_kept_names_the_op_and_what_it_read() {
    for reads in ["input", "output"] {
        let w = Param::new("w", ndarray::arr1(&[1.0f32]));
        let y = Tensor::from_op(vec![1.0].into(), &[1], &[w.tensor()], Forgetful { reads });
        let (message, _) = panic_of(|| y.backward());
        assert!(message.contains("forgetful_op") && message.contains(reads) && message.contains("keep"), "{message}");
        let y = Tensor::from_kernel(vec![1.0].into(), &[1], &[w.tensor()], Forgetful { reads });
        let (message, _) = panic_of(|| y.backward());
        assert!(message.contains("forgetful_kernel") && message.contains(reads) && message.contains("keep"), "{message}");
    }
}
