//! The examples of `plenoxel` run. (Those of `autograd` do in its own tests.)

#[path = "../plenoxel/examples/custom_loss.rs"]
#[allow(dead_code)] // its `main`
mod custom_loss;

#[test]
fn the_custom_loss_trains() {
    custom_loss::run().expect("the example runs");
}
