//! The examples of `plenoxel` run. (Those of `autograd` do in its own tests.)

#[path = "../plenoxel/examples/custom_field.rs"]
#[allow(dead_code)] // its `main`
mod custom_field;
#[path = "../plenoxel/examples/custom_loss.rs"]
#[allow(dead_code)]
mod custom_loss;
#[path = "../plenoxel/examples/own_losses.rs"]
#[allow(dead_code)]
mod own_losses;
#[path = "../plenoxel/examples/run_events.rs"]
#[allow(dead_code)]
mod run_events;

#[test]
fn the_custom_loss_trains() {
    custom_loss::run().expect("the example runs");
}

#[test]
fn the_custom_field_is_short_and_trains_saves_resumes_and_is_evaluated() {
    let lines = include_str!("../plenoxel/examples/custom_field.rs").lines().filter(|line| !line.starts_with("//!") && !line.is_empty());
    assert!(lines.count() <= 60, "an example that a newcomer reads at once");
    // A field that learned nothing shows the mean: 12 dB.
    let psnr = custom_field::run(60).expect("the example runs");
    assert!(psnr > 13.0, "{psnr}");
    // Files name the kind of their model, and the program says what it can do with another's.
    let file = std::env::temp_dir().join(format!("custom-field-{}.safetensors", std::process::id()));
    let refused = plenoxel::checkpoint::load::<f32>(&file).expect_err("it has no voxels").to_string();
    assert!(refused.contains("a model of kind `encoded mlp` has no voxels"), "{refused}");
    let mut out = Vec::new();
    let streams = plenoxel_cli::Streams { out: &mut out, err: &mut std::io::sink(), terminal: false, read_by_people: true };
    assert_eq!(plenoxel_cli::run(["plenoxel".as_ref(), "info".as_ref(), file.as_os_str()], streams), 0);
    let said = String::from_utf8_lossy(&out).into_owned();
    assert!(said.contains("encoded mlp") && said.contains("net.0.weight [30, 64]"), "{said}");
    std::fs::remove_file(file).expect("the example wrote it");
}

#[test]
fn losses_with_parameters_and_channels_train() {
    own_losses::run(10).expect("the example runs");
}

#[test]
fn a_run_is_driven_by_a_closure_on_its_events() {
    let folder = std::env::temp_dir().join(format!("plenoxel-events-{}", std::process::id()));
    run_events::run(folder.clone()).expect("the example runs");
    let result = std::fs::read_to_string(folder.join("result.json")).expect("the figures are written");
    assert!(result.contains("\"psnr\"") && folder.join("checkpoint.safetensors").exists());
    std::fs::remove_dir_all(folder).expect("the folder can be removed");
}
