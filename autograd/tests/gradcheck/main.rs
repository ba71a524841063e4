//! The table of gradient checks: one row for each op and each way of using it.
//!
//! For every row, first and second derivatives in `f64` are compared with finite differences, in both passes: `backward`, where kernels use their adjoints,
//! and `grad`, where they use their references. The gradient in `f32` is compared with the gradient in `f64`, as a vector.
//! `cargo test -p plenoxel-autograd --test gradcheck -- --nocapture` prints the table.

mod rows;
mod table;

use autograd::{Cotangent, Gradcheck, GradcheckError, Op, Tensor, Vjp, check_kernel, gradcheck};
use ndarray::arr1;
use std::collections::BTreeSet;
use std::path::Path;

#[test]
fn every_op_has_right_derivatives_of_both_orders_and_in_both_precisions() {
    let (mut worst, mut failures) = ([0.0f64; 3], Vec::new());
    println!("| op | case | order 1 | order 2 | f32 to f64 |\n| --- | --- | --- | --- | --- |");
    for row in rows::all() {
        match row.check() {
            Ok(errors) => {
                println!("| {} | {} | {:.0e} | {:.0e} | {:.0e} |", row.op, row.case, errors[0], errors[1], errors[2]);
                worst.iter_mut().zip(errors).for_each(|(w, e)| *w = w.max(e));
            }
            Err(error) => failures.push(error),
        }
    }
    let ops: BTreeSet<&str> = rows::all().iter().map(|row| row.op).filter(|op| !op.starts_with('(')).collect();
    println!("| **worst of {} ops, {} rows** | | {:.0e} | {:.0e} | {:.0e} |", ops.len(), rows::all().len(), worst[0], worst[1], worst[2]);
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

/// Returns the names in the list of ops, and the names of the public functions in their files that return a tensor.
fn names_of_ops() -> Vec<String> {
    let list = include_str!("../../src/ops.rs");
    let cells = list.lines().filter_map(|line| line.strip_prefix("//! | [`")?.split(" | ").nth(1));
    let mut names: Vec<String> =
        cells.flat_map(|cell| cell.split('`').skip(1).step_by(2)).flat_map(|code| code.split_whitespace()).map(String::from).collect();
    assert!(names.len() > 40, "the list of ops was not understood: {names:?}");
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/ops");
    for file in folder.read_dir().expect("the folder of ops") {
        let text = std::fs::read_to_string(file.expect("a file of ops").path()).expect("its text");
        let functions = text.lines().filter_map(|line| line.strip_prefix("    pub fn ")).filter(|line| line.contains("-> Self"));
        names.extend(functions.filter_map(|line| line.split('(').next()).filter(|name| !name.starts_with('$')).map(String::from));
    }
    names
}

#[test]
fn every_op_has_a_row_in_the_table() {
    let rows = rows::all();
    let missing: Vec<String> = names_of_ops().into_iter().filter(|name| rows.iter().all(|row| row.op != name)).collect();
    assert!(missing.is_empty(), "ops without a row in the table of gradients: {missing:?}");
}

/// Checks the value of the only kernel of this crate and its gradients with respect to table and positions, for every width with a specialised loop.
#[test]
fn the_trilinear_kernel_is_what_its_reference_says_in_both_precisions() {
    for (width, nodes) in [1, 2, 3, 4, 12, 27, 28, 48].into_iter().zip([[3, 4, 5], [1, 4, 2], [2, 2, 2], [6, 1, 1]].into_iter().cycle()) {
        let inputs = [table::numbers(&[nodes.iter().product(), width], 1), table::positions(70, nodes)];
        let report =
            check_kernel(|x: &[Tensor<f64>]| x[0].trilinear(&x[1], nodes), inputs.clone(), 1e-13).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(report.gradients.len(), 2);
        let inputs = inputs.map(|x| x.mapv(|v| v as f32));
        check_kernel(|x: &[Tensor<f32>]| x[0].trilinear(&x[1], nodes), inputs, 2e-6).unwrap_or_else(|e| panic!("{e}"));
    }
}

/// y = sin x, with a wrong rule that uses 1 instead of the cosine for the second entry.
#[derive(Debug)]
struct CarelessSine;
impl Op<f64> for CarelessSine {
    fn name(&self) -> &'static str {
        "careless_sine"
    }
    fn vjp(&self, cx: &Vjp<'_, f64>) -> Vec<Option<Cotangent<f64>>> {
        let careful = Tensor::from_vec(vec![1.0, 0.0, 1.0], &[3]);
        vec![cx.wrt(0, || cx.cotangent() * (cx.input(0).cos() * &careful + (1.0 - &careful)))]
    }
}

fn careless_sine(x: &Tensor<f64>) -> Tensor<f64> {
    let values: Vec<f64> = x.data().iter().map(|x| x.sin()).collect();
    Tensor::from_op(values.into(), x.shape(), &[x], CarelessSine)
}

#[test]
fn a_wrong_rule_is_caught_with_its_name_the_entry_and_both_numbers() {
    let input = arr1(&[0.3, 1.0, -0.4]).into_dyn();
    let error = Gradcheck::new(|x| careless_sine(&x[0]), [input.clone()]).named("careless_sine").elementwise().run();
    let error = error.expect_err("the rule is wrong");
    let GradcheckError::Derivative { input: which, ref index, order, analytic, numeric, .. } = error else { panic!("{error}") };
    assert_eq!((which, index.as_deref(), order), (0, Some(&[1][..]), 1));
    // The rule says 1 where the derivative is cos 1.
    assert!((numeric / analytic - 1.0f64.cos()).abs() < 1e-9);
    let text = error.to_string();
    for part in ["careless_sine", "input 0", "[1]", &format!("{analytic:.9e}"), &format!("{numeric:.9e}")] {
        assert!(text.contains(part), "{part} is not in: {text}");
    }
    // A check along a random direction also fails, but does not name the entry.
    let error = Gradcheck::new(|x| careless_sine(&x[0]), [input]).named("careless_sine").run().expect_err("the rule is wrong");
    assert!(error.to_string().contains("elementwise"), "{error}");
}

#[test]
#[should_panic(expected = "wrong derivative of order 1 with respect to input 0")]
fn the_short_form_panics_with_the_text_of_the_error() {
    gradcheck(|x| careless_sine(&x[0]), [arr1(&[0.3, 1.0, -0.4]).into_dyn()]);
}
