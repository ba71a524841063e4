//! `plenoxel bake`, and the page and the exports of fields without voxels.

use crate::command::{Answer, Folder, plenoxel};
use autograd::{Tensor, random::Stream};
use plenoxel::bake::Source;
use plenoxel::run::folder::RunFolder;
use plenoxel::sampling::Samples;
use serde_json::Value;
use std::fs;

const STAGES: &str = "tensorf.stages=[{resolution=12, steps=40, rays=256}, {resolution=20, steps=40, rays=256}]";

/// Trains a tiny factored field of the built-in scene.
fn train(out: &str, more: &[&str]) -> Answer {
    let tiny = [
        "train",
        "--preset=tensorf",
        "--scene-size=24",
        "--scene-views=8,1,2",
        "--set",
        STAGES,
        "--set=tensorf.frozen_steps=5",
        "--out",
        out,
    ];
    plenoxel(&[&tiny[..], more].concat())
}

#[test]
fn the_page_of_a_factored_field_shows_a_baked_grid() {
    let folder = Folder::new("bake-page");
    let run = folder.path("field");
    let trained = train(&run, &["--no-images"]);
    assert!(trained.err.contains("baked from the field") && trained.err.contains("that of the field"), "{}", trained.err);
    trained.done();
    let page = fs::read_to_string(folder.path("field/report.html")).unwrap();
    assert!(page.contains("<figure id=\"viewer\">") && page.contains("id=\"grid\"") && page.contains("baked from the field"));
    // The bits do not depend on the number of threads.
    plenoxel(&["report", &run, "--threads=3"]).done();
    assert!(fs::read_to_string(folder.path("field/report.html")).unwrap() == page);
}

/// Colors of a field are those of its features, seen along the rays.
fn shades_its_features(run: &str) {
    let (folder, config, _) = RunFolder::open(run.as_ref()).unwrap();
    let (model, _) = plenoxel::model::open(&folder.existing_checkpoint().unwrap(), &config).unwrap();
    let field = Source::of(&*model).expect("a field").field;
    let (count, random) = (50, Stream::new(7));
    let directions: Vec<f32> = random.named("directions").normal_tensor::<f32>(&[count, 3], 0.0, 1.0).data().to_vec();
    let unit = |d: &[f32; 3]| glam::Vec3::from(*d).normalize().to_array();
    let samples = Samples {
        t: Tensor::full(&[count], 3.0),
        delta: Tensor::full(&[count], 0.1),
        positions: random.named("positions").uniform_tensor(&[count, 3], -0.9, 0.9),
        directions: Tensor::from_vec(directions.as_chunks().0.iter().flat_map(unit).collect(), &[count, 3]),
        offsets: (0..=count as u32).collect::<Vec<_>>().into(),
    };
    let (radiance, shaded) = (field.radiance(&samples), field.shade(&field.features(&samples.positions), &samples.directions));
    let (sigma, density) = (radiance.sigma.data(), field.density(&samples.positions));
    let mut compared = 0;
    for ((sigma, density), (a, b)) in
        sigma.iter().zip(density.data()).zip(radiance.rgb.data().as_chunks::<3>().0.iter().zip(shaded.data().as_chunks::<3>().0))
    {
        assert!((sigma - density).abs() <= 1e-4 * density, "{run}: densities {sigma} and {density}");
        // Samples of little weight have no color.
        if *a != [0.0; 3] {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5), "{run}: {a:?} and {b:?}");
            compared += 1;
        }
    }
    assert!(compared > 5, "{run}: {compared} colors");
}

#[test]
fn every_model_without_voxels_can_be_baked() {
    let folder = Folder::new("bake-models");
    let presets: [(&str, &[&str]); 3] = [
        ("ngp", &["ngp.stages=[{steps=60, rays=512}]", "ngp.log2_rows=12", "ngp.finest_resolution=64", "ngp.samples=64", "ngp.cells=32"]),
        (
            "dvgo",
            &[
                "dvgo.coarse={resolution=12, steps=40, rays=256}",
                "dvgo.fine=[{resolution=24, steps=200, rays=256}]",
                "dvgo.coarse_opacity=1e-2",
                "dvgo.hidden=16",
            ],
        ),
        (
            "nerf",
            &[
                "nerf.steps=30",
                "nerf.rays=64",
                "nerf.width=8",
                "nerf.depth=2",
                "nerf.skip=1",
                "nerf.color_width=8",
                "nerf.position_octaves=3",
                "nerf.coarse_samples=16",
                "nerf.fine_samples=16",
            ],
        ),
    ];
    for (preset, settings) in presets {
        let [run, baked] = [preset.to_owned(), format!("{preset}-baked")].map(|name| folder.path(&name));
        let settings: Vec<String> = settings.iter().map(|setting| format!("--set={setting}")).collect();
        let words = ["train", "--preset", preset, "--scene-size=24", "--scene-views=8,1,2", "--no-images", "--no-report", "--out", &run];
        plenoxel(&words.into_iter().chain(settings.iter().map(|setting| &setting[..])).collect::<Vec<_>>()).done();
        shades_its_features(&run);
        plenoxel(&["export", "mesh", &run]).refused(3, &[&format!("a model of kind `{preset}` has no voxels")]);
        let result = plenoxel(&["bake", &run, "--resolution=24", "--no-report", "--out", &baked]).json();
        let number = |key: &str| result[key].as_f64().unwrap();
        assert!((number("psnr") - number("psnr_of_field")).abs() < 3.0, "{preset}: {} and {}", number("psnr"), number("psnr_of_field"));
        // The few steps of nerf make fog, which has no visible voxels, and no opaque ones if they are small.
        let keep = ["--min-alpha=0", "--min-weight=0", "--min-object=0"];
        plenoxel(&[&["export", "ply", &baked][..], &keep].concat()).done();
        let shown = plenoxel(&["report", &run]);
        let wanted = if preset == "nerf" { "no voxel is opaque" } else { "baked from the field" };
        assert!(shown.err.contains(wanted), "{}", shown.err);
        shown.done();
    }
}

#[test]
fn a_baked_field_is_a_run_that_other_commands_take() {
    let folder = Folder::new("bake");
    let [run, baked] = ["field", "baked"].map(|name| folder.path(name));
    // Voxels have no gradients of poses, so the settings of the grid are without this loss.
    train(&run, &["--no-report", "--no-images", "--refine-poses"]).done();
    plenoxel(&["export", "mesh", &run])
        .refused(3, &["a model of kind `tensorf` has no voxels", &format!("run `plenoxel bake {run}` first")]);
    for format in ["svox2", "plenoctree"] {
        plenoxel(&["export", format, &run]).refused(3, &[&format!("run `plenoxel bake {run}` first")]);
    }
    plenoxel(&["render", &run, "--channels", "normal"]).refused(3, &["run `plenoxel bake RUN` first"]);

    let answer = plenoxel(&["bake", &run, "--resolution", "24", "--out", &baked]);
    assert!(answer.out.contains("PSNR ") && answer.out.contains(" the field, which has "), "{}", answer.out);
    let result = answer.json();
    let number = |key: &str| result[key].as_f64().unwrap();
    assert!((number("psnr") - number("psnr_of_field")).abs() < 3.0, "{result}");
    assert_eq!((&result["resolution"], &result["views"]), (&Value::from(24), &Value::from(2)));
    let evaluated = plenoxel(&["evaluate", &baked]).json();
    assert!((evaluated["psnr"].as_f64().unwrap() - number("psnr")).abs() < 1e-9);

    plenoxel(&["export", "mesh", &baked, "--level", "5"]).done();
    plenoxel(&["export", "ply", &baked]).done();
    plenoxel(&["export", "vox", &baked]).done();
    plenoxel(&["render", &baked, "--view", "0", "--channels", "normal"]).done();
    let about = plenoxel(&["info", &baked]).done();
    assert!(about.contains("none: the grid was baked") && about.contains(&run), "{about}");
    let page = fs::read_to_string(folder.path("baked/report.html")).unwrap();
    assert!(page.contains("<figure id=\"viewer\">") && page.contains("<h2>Baked grid</h2>") && page.contains("PSNR of the field"));

    // A grid is not baked, a baked run is not resumed, and nothing is overwritten unasked.
    plenoxel(&["bake", &baked]).refused(3, &["this is a voxel grid already"]);
    plenoxel(&["train", "--resume", &baked]).refused(3, &["a baked run cannot be resumed"]);
    plenoxel(&["bake", &run, "--out", &baked]).refused(2, &["is not empty", "--force"]);

    // The command in the settings repeats the run.
    let checkpoint = || fs::read(folder.path("baked/checkpoint.safetensors")).unwrap();
    let (before, settings) = (checkpoint(), fs::read_to_string(folder.path("baked/config.toml")).unwrap());
    let line = settings.lines().find_map(|line| line.strip_prefix("# plenoxel ")).unwrap();
    let words: Vec<&str> = line.split_whitespace().chain(["--out", &baked, "--force", "--no-report", "--threads=3"]).collect();
    plenoxel(&words).done();
    assert!(checkpoint() == before);
}
