//! Runs of captures: the viewer of the page, films, and what needs a box of the world.

use crate::capture_folders as captures;
use crate::command::{Folder, plenoxel};
use captures::{write_llff, write_transforms};
use glam::DVec3;
use plenoxel::camera::Camera;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::run::folder::RunFolder;
use plenoxel::run::training::{self, Outcome, RunOptions, RunSettings};
use serde_json::Value;
use std::fs;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

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

/// Trains a capture, whose viewer is to be `of` a space and whose views are compared. Returns the run folder.
fn train(input: &captures::Folder, folder: &Folder, of: &str) -> String {
    let (data, run) = (input.0.display().to_string(), folder.path("run"));
    let trained = plenoxel(&["train", &data, "--preset=photos", "--set", STAGES, "--no-images", "--out", &run]);
    assert!(trained.err.contains(&format!("of {of}, baked from the field")), "{}", trained.err);
    assert!(trained.json()["outlier_views"].is_array());
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
    // Distances in units of the dataset, whose cameras are at 4 from the middle; in the world of the run they are at 1.
    plenoxel(&["render", &run, "--view=0", "--channels=depth", "--format=npy"]).done();
    let depth = floats(&fs::read(format!("{run}/renders/test_000_r_0_depth.npy")).unwrap());
    let near = depth.iter().copied().fold(f32::INFINITY, f32::min);
    // After so few steps, the nearest matter depends on the recipe; in units of the run it would be nearer than 0.5.
    assert!(near > 1.0 && depth.iter().any(|depth| (2.5..5.5).contains(depth)), "nearest {near}");
    baked(&run, "contracted");
}

/// Bakes a run whose space has this name. The grid renders views and films as other runs do, in its space; exports refuse it and the field.
fn baked(run: &str, space: &str) {
    plenoxel(&["bake", run, "--resolution=24"]).done();
    let grid = format!("{run}-baked");
    let result: Value = serde_json::from_str(&fs::read_to_string(format!("{grid}/result.json")).unwrap()).unwrap();
    let field: Value = serde_json::from_str(&fs::read_to_string(format!("{run}/result.json")).unwrap()).unwrap();
    let (of_grid, of_field) = (result["psnr"].as_f64().unwrap(), field["psnr"].as_f64().unwrap());
    assert!((of_grid - of_field).abs() < 3.0, "{of_grid} dB instead of {of_field} dB");
    let scene = scene(&grid);
    assert!(scene["coordinates"]["space"].to_string().contains(space) && scene["grid"]["resolution"] == 24, "{}", scene["coordinates"]);
    plenoxel(&["evaluate", &grid]).done();
    plenoxel(&["render", &grid, "--view=0", "--channels=color,depth,normal", "--format=npy"]).done();
    let depths = [run, &grid].map(|run| {
        plenoxel(&["render", run, "--view=0", "--channels=depth", "--format=npy"]).done();
        let name = fs::read_dir(format!("{run}/renders"))
            .unwrap()
            .map(|file| file.unwrap().path())
            .find(|path| path.to_string_lossy().ends_with("_depth.npy"));
        let mut depths = floats(&fs::read(name.unwrap()).unwrap());
        depths.sort_by(f32::total_cmp);
        depths[depths.len() / 2]
    });
    assert!((depths[0] / depths[1] - 1.0).abs() < 0.3, "median depths {depths:?}");
    assert!(plenoxel(&["info", &grid]).done().contains(&format!("of the space `{space}`")));
    for run in [run, &grid] {
        plenoxel(&["export", "ply", run]).refused(3, &[&format!("coordinates of a capture ({space})"), "--space box"]);
    }
    goes_on(run, &grid);
    plenoxel(&["bake", &grid]).refused(3, &["this is a voxel grid already"]);
    // Points lie on straight rays.
    let config = fs::read_to_string(format!("{grid}/config.toml")).unwrap();
    let points = config.replace("[evaluation]\nstep = 1.0", "[evaluation]\nsamples = 64\nfar = 3.0");
    assert_ne!(points, config);
    fs::write(format!("{grid}/config.toml"), points).unwrap();
    plenoxel(&["evaluate", &grid]).refused(2, &["evaluation", space, "evaluation.step"]);
}

/// Trains a baked grid on its photographs, without a pause and with one.
fn goes_on(run: &str, grid: &str) {
    let record: Value = serde_json::from_slice(&fs::read(format!("{grid}/run.json")).unwrap()).unwrap();
    let (data, config) = (record["data"]["path"].as_str().unwrap(), format!("{grid}/config.toml"));
    let (straight, paused) = (format!("{run}-straight"), format!("{run}-paused"));
    let more = ["--config", &config, "--set=rays_per_step=256", "--set=stages[0].steps=30", "--no-report", "--no-images"];
    let train = |out: &str, last: &[&str]| plenoxel(&[&["train", data], &more[..], last, &["--out", out]].concat());
    train(&straight, &[]).refused(2, &["space", "initial grid", "--init-from"]);
    train(&straight, &["--init-from", grid]).done();
    let psnr = [grid, &straight].map(|run| plenoxel(&["evaluate", run, "--split", "train"]).json()["psnr"].as_f64().unwrap());
    assert!(psnr[1] > psnr[0] + 0.1, "{psnr:?} dB");
    let (_, settings, record) = RunFolder::open(straight.as_ref()).unwrap();
    let asked = AtomicU64::new(0);
    let options = RunOptions { stop: Box::new(move || asked.fetch_add(1, Relaxed) >= 11), ..RunOptions::default() };
    let settings = RunSettings { out: Some(paused.clone().into()), options, ..RunSettings::new(settings, record.data) };
    assert!(matches!(training::train(&settings, &mut |_| ()), Ok(Outcome::Stopped { .. })));
    plenoxel(&["train", "--resume", &paused]).done();
    let [a, b] = [&straight, &paused].map(|run| fs::read(format!("{run}/checkpoint.safetensors")).unwrap());
    assert!(a == b);
    plenoxel(&["export", "ply", &straight]).refused(3, &["--space box"]);
    train(&paused, &["--init-from", grid, "--force", "--set=capture.space=box", "--half-width=2"])
        .refused(3, &["the initial grid is in the space"]);
    train(&paused, &["--init-from", grid, "--force", "--set=stages[0].sampling={samples=8, far=3.0}"]).refused(2, &["sampling.step"]);
}

/// The numbers of an NPY file of 32-bit floats.
fn floats(npy: &[u8]) -> Vec<f32> {
    let header = 10 + usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    npy[header..].as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

/// The scale from the dataset to the world of a run.
fn scale_of(run: &str) -> f64 {
    let record: Value = serde_json::from_str(&fs::read_to_string(format!("{run}/run.json")).unwrap()).unwrap();
    let to_world: plenoxel::geometry::Similarity = serde_json::from_value(record["to_world"].clone()).unwrap();
    to_world.scale
}

#[test]
fn exports_of_a_capture_are_in_the_coordinates_of_the_dataset() {
    let folder = Folder::new("capture-box");
    let input = captures::Folder::new();
    write_transforms(&input, &around());
    let (data, run) = (input.0.display().to_string(), folder.path("run"));
    let grid = [
        "--preset=demo",
        "--space=box",
        "--half-width=0.4",
        "--set",
        "stages=[{resolution=16, steps=150, sampling={step=0.5}, density_rate=1.0, color_rate=0.05}]",
    ];
    plenoxel(&[&["train", &data, "--no-images", "--no-report", "--out", &run][..], &grid].concat()).done();
    // The half width of 0.4 in the world of the run is 1.74 in the dataset.
    let farthest = |file: &str, positions: Vec<[f64; 3]>| {
        let most = positions.iter().flatten().fold(0.0f64, |most, x| most.max(x.abs()));
        assert!((0.6..1.8).contains(&most), "{file}: {most}");
    };
    let keep = ["--min-alpha=0", "--min-weight=0", "--min-object=0"];
    plenoxel(&[&["export", "ply", &run][..], &keep].concat()).done();
    let cloud = plenoxel::point_cloud::ply::PlyFile::open(format!("{run}/exports/cloud.ply").as_ref()).unwrap();
    let side = 0.8 / 16.0 / scale_of(&run);
    assert!(cloud.header().remarks.contains(&format!("comment voxel_side {side}")), "{:?}", cloud.header().remarks);
    farthest("cloud", cloud.positions().unwrap().into_iter().map(|p| p.to_array()).collect());
    let middle = cloud.positions().unwrap().iter().sum::<DVec3>() / cloud.len() as f64;
    // A box is in the coordinates of the file.
    let within = format!("--bbox=-9,-9,{},9,9,9", middle[2]);
    plenoxel(&[&["export", "ply", &run, &within][..], &keep].concat()).done();
    let above = plenoxel::point_cloud::ply::PlyFile::open(format!("{run}/exports/cloud.ply").as_ref()).unwrap();
    assert!(above.positions().unwrap().iter().all(|p| p.z >= middle[2]) && above.len() < cloud.len() && !above.is_empty());
    plenoxel(&["export", "mesh", &run, "--level=1"]).done();
    let mesh = plenoxel::point_cloud::ply::PlyFile::open(format!("{run}/exports/mesh.ply").as_ref()).unwrap();
    farthest("mesh", mesh.positions().unwrap().into_iter().map(|p| p.to_array()).collect());
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
    baked(&run, "ndc");
}
