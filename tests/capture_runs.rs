//! Runs of captures: the viewer of the page, films, and what needs a box of the world.

use crate::capture_folders as captures;
use crate::command::{Folder, plenoxel};
use captures::{write_llff, write_transforms};
use glam::DVec3;
use plenoxel::camera::Camera;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use serde_json::Value;
use std::fs;

/// Views of the built-in scene, from all around.
fn around() -> Vec<View> {
    let options = ProceduralOptions { width: 24, height: 16, train: 10, val: 0, test: 0, supersample: 1 };
    Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| ()).unwrap()
}

/// Pictures of [`around`], as if they were taken from places before the scene.
fn forward() -> Vec<View> {
    let place = |k: usize| DVec3::new(0.1 * (k % 3) as f64, 0.1 * (k / 3) as f64, 0.02 * (k % 2) as f64);
    let moved = |(k, view): (usize, View)| {
        let camera = Camera::look_at(place(k), place(k) - DVec3::Z, DVec3::Y, view.camera.intrinsics);
        View { camera, ..view }
    };
    around().into_iter().enumerate().map(moved).collect()
}

const STAGES: &str = "tensorf.stages=[{resolution=12, steps=40, rays=256}, {resolution=20, steps=60, rays=256}]";

/// The settings of the viewer in the page of a run.
fn scene(run: &str) -> Value {
    let page = fs::read_to_string(format!("{run}/report.html")).unwrap();
    let start = page.split("id=\"scene\">").nth(1).expect("the page has a viewer");
    serde_json::from_str(start.split("</script>").next().unwrap()).unwrap()
}

/// Trains a capture, whose viewer is to be `of` a space. Returns the run folder.
fn train(input: &captures::Folder, folder: &Folder, of: &str) -> String {
    let (data, run) = (input.0.display().to_string(), folder.path("run"));
    let trained = plenoxel(&["train", &data, "--preset=photos", "--set", STAGES, "--no-images", "--out", &run]);
    assert!(trained.err.contains(&format!("of {of}, baked from the field")), "{}", trained.err);
    trained.done();
    run
}

/// Renders films along camera paths.
fn render(run: &str, paths: &[&str]) {
    for path in paths {
        plenoxel(&["render", run, "--path", path, "--frames", "2"]).done();
        assert!(fs::exists(format!("{run}/renders/{path}/frame_0001.png")).unwrap());
    }
}

#[test]
fn a_capture_from_all_around_has_a_viewer_and_films() {
    let folder = Folder::new("capture-around");
    let input = captures::Folder::new();
    write_transforms(&input, &around());
    let run = train(&input, &folder, "the contracted world");
    let scene = scene(&run);
    assert_eq!(scene["coordinates"]["space"], "contracted");
    // Training views, though there are test views.
    assert_eq!(scene["views"].as_array().unwrap().len(), 8);
    render(&run, &["orbit", "spiral", "cameras"]);
    plenoxel(&["bake", &run]).refused(3, &["coordinates of a capture (contracted)", "--space box"]);
    plenoxel(&["export", "ply", &run]).refused(3, &["coordinates of a capture (contracted)", "--space box"]);
}

#[test]
fn a_forward_facing_capture_has_a_viewer_and_the_spiral_of_llff() {
    let folder = Folder::new("capture-forward");
    let input = captures::Folder::new();
    write_llff(&input, &forward());
    let run = train(&input, &folder, "normalized device coordinates");
    let coordinates = &scene(&run)["coordinates"];
    assert!(coordinates["space"]["ndc"]["a"].is_f64() && coordinates["stretch"][2].as_f64().unwrap() < 0.5, "{coordinates}");
    render(&run, &["spiral", "cameras"]);
    plenoxel(&["render", &run, "--path", "orbit"]).refused(2, &["forward-facing capture", "--path spiral"]);
}
