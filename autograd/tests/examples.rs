//! Runs the examples, which assert their results.

#[path = "../examples/01_first_gradient.rs"]
mod first_gradient;

#[path = "../examples/02_new_loss.rs"]
mod new_loss;

#[path = "../examples/03_custom_op.rs"]
mod custom_op;

#[path = "../examples/04_kernel_with_reference.rs"]
mod kernel_with_reference;

#[path = "../examples/05_gradient_penalty.rs"]
mod gradient_penalty;

#[path = "../examples/06_fused_layer.rs"]
mod fused_layer;

#[test]
fn the_first_gradient_is_the_expected_one() {
    first_gradient::main();
}

#[test]
fn a_new_loss_ignores_the_point_that_is_off() {
    new_loss::main();
}

#[test]
fn a_custom_op_passes_its_check_and_has_a_second_derivative() {
    custom_op::main();
}

#[test]
fn a_kernel_agrees_with_its_reference() {
    kernel_with_reference::main();
}

#[test]
fn a_gradient_penalty_makes_a_distance_field() {
    gradient_penalty::main();
}

#[test]
fn a_kernel_of_three_inputs_agrees_with_its_reference_in_both_orders() {
    fused_layer::main();
}
