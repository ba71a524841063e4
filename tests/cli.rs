//! The command line, called like any function: what a user types, what comes back, what lies in the folder afterwards.

use crate::command;
use crate::events;
use command::{Answer, Folder, SHORT, plenoxel};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{self, Dataset, OpenOptions, Split, exposure, image};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// `train` on the built-in scene, tiny, into `out`.
pub fn train(out: &str, more: &[&str]) -> Answer {
    command::train("6,1,3", out, more)
}

/// The built-in scene as files: 3 training views, 2 test views and no validation file, 16 x 16.
pub fn scene(folder: &Folder) -> String {
    let dir = folder.path("scene");
    let answer = plenoxel(&["scene", &dir, "--size", "16", "--train", "3", "--val", "0", "--test", "2"]);
    assert_eq!(answer.code, 0, "{}", answer.err);
    dir
}

/// `train` on files, tiny, into `out`.
pub fn train_on(data: &str, out: &str, more: &[&str]) -> Answer {
    plenoxel(&[&["train", data, "--set", SHORT, "--set", "rays_per_step=256", "--no-images", "--quiet", "--out", out], more].concat())
}

pub fn names(folder: &str) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_run_that_was_killed_before_its_figures_gets_them_by_resuming() {
    let folder = Folder::new("figures");
    let run = folder.path("run");
    let whole = train(&run, &["--no-report"]).json();
    let grid = fs::read(folder.path("run/checkpoint.safetensors")).unwrap();
    let strip = |run: &str| fs::read(folder.path(&format!("{run}/images/stages.png"))).unwrap();
    let before = strip("run");
    fs::remove_file(folder.path("run/result.json")).unwrap();
    let again = plenoxel(&["train", "--resume", &run]).json();
    assert_eq!((&again["psnr"], &again["steps"], &again["rays"]), (&whole["psnr"], &whole["steps"], &whole["rays"]));
    assert_eq!(
        (again["stages"].as_array().unwrap().len(), fs::read(folder.path("run/checkpoint.safetensors")).unwrap() == grid),
        (2, true)
    );
    assert!(fs::exists(folder.path("run/report.html")).unwrap());
    assert!(strip("run") == before, "the start and both stages are still in the strip");
    plenoxel(&["train", "--resume", &run]).refused(3, &["this run is finished"]);

    // One that began with a grid left the coarser stage out.
    let finer = folder.path("finer");
    let stages = |result: &Value| result["stages"].as_array().unwrap().iter().map(|stage| stage["resolution"].clone()).collect::<Vec<_>>();
    let whole = train(&finer, &["--no-report", "--init-from", &run]).json();
    let before = strip("finer");
    let picture = |name: &str| image::read(Path::new(&folder.path(name))).unwrap();
    let apart = |a: &str, b: &str| {
        let differences = picture(a).iter().zip(picture(b).iter()).map(|(a, b)| f64::from(a.abs_diff(*b))).collect::<Vec<_>>();
        differences.iter().sum::<f64>() / differences.len() as f64
    };
    // It begins where the other run ended, and that one began with fog.
    assert!(apart("finer/images/stage_0_12.png", "run/images/stage_2_12.png") < 1.0);
    assert!(apart("run/images/stage_0_8.png", "run/images/stage_2_12.png") > 10.0);
    fs::remove_file(folder.path("finer/result.json")).unwrap();
    let again = plenoxel(&["train", "--resume", &finer, "--no-report"]).json();
    assert_eq!((stages(&again), &again["steps"]), (vec![Value::from(12)], &whole["steps"]));
    assert_eq!(stages(&whole), [12]);
    assert!(strip("finer") == before, "the start and the stage are still in the strip");

    // One that was carved was not trained.
    let carved = folder.path("carved");
    plenoxel(&["carve", &scene(&folder), "--resolution", "8", "--no-report", "--out", &carved]).done();
    fs::remove_file(folder.path("carved/result.json")).unwrap();
    plenoxel(&["train", "--resume", &carved]).refused(3, &["a carved run cannot be resumed", "--init-from"]);
    assert!(!plenoxel(&["info", &carved]).done().contains("--resume"));
}

#[test]
fn a_grid_that_validation_views_liked_better_than_the_last_is_kept() {
    let folder = Folder::new("best");
    let run = folder.path("run");
    // What the first stage learned, the second spoils.
    let spoil = ["--set", "stages[0].steps=40", "--set", "stages[1].density_rate=500.0", "--set", "stages[1].color_rate=5.0"];
    let answer = train(&run, &[&spoil[..], &["--checkpoint-every", "0.000001s", "--no-report", "--no-images"]].concat());
    assert!(answer.err.contains("an earlier checkpoint has a better validation PSNR"), "{}", answer.err);
    let result = answer.json();
    let best = &result["best_validation"];
    let [last, kept] = [&[][..], &["--best"]].map(|flag| plenoxel(&[&["evaluate", run.as_str(), "--split", "val"], flag].concat()).json());
    assert_eq!((&last["steps"], kept["steps"].as_u64()), (&45.into(), best["step"].as_u64().map(|step| step + 1)));
    // At 24 x 24 validation views are not reduced.
    assert!((kept["psnr"].as_f64().unwrap() - best["psnr"].as_f64().unwrap()).abs() < 0.01, "{kept} {best}");
    assert!(kept["psnr"].as_f64().unwrap() > last["psnr"].as_f64().unwrap() + 1.0);
    assert!(kept["seconds"].is_null() && last["seconds"].is_f64());
    assert_eq!(plenoxel(&["export", "vox", &run, "--best"]).code, 0);
    assert_eq!(names(&folder.path("run/exports-best")).len(), 1);
    // A run whose last grid is its best keeps no other.
    let good = folder.path("good");
    train(&good, &["--checkpoint-every", "0.000001s", "--no-report", "--no-images"]).done();
    assert!(!fs::exists(folder.path("good/best.safetensors")).unwrap());
    plenoxel(&["evaluate", &good, "--best"]).refused(3, &["best.safetensors", "leave out --best"]);
}

#[test]
fn a_run_is_trained_evaluated_rendered_and_described() {
    let folder = Folder::new("whole");
    let run = folder.path("run");
    let trained = train(&run, &[]);
    let result = trained.json();
    for key in
        ["psnr", "ssim", "ssim_same", "seconds", "seconds_load", "seconds_evaluate", "baseline_background_psnr", "baseline_mean_image_psnr"]
    {
        assert!(result[key].is_f64(), "{key}: {result}");
    }
    assert_eq!((&result["views"], &result["width"], &result["height"]), (&3.into(), &24.into(), &24.into()));
    assert_eq!((&result["steps"], &result["rays"], &result["resolution"]), (&10.into(), &2560.into(), &12.into()));
    assert_eq!((&result["scene"], &result["preset"]), (&"procedural".into(), &"demo".into()));
    assert_eq!(result["background"], serde_json::json!([1.0, 1.0, 1.0]));
    assert!(cfg!(not(target_os = "linux")) || result["peak_memory_bytes"].as_u64().unwrap() > 1_000_000);
    assert!(result["stages"][0]["psnr"].is_f64() && result["stages"][1]["psnr"] == result["psnr"]);
    let per_view = result["per_view"].as_array().unwrap();
    let mean = per_view.iter().map(|view| view["psnr"].as_f64().unwrap()).sum::<f64>() / 3.0;
    assert!((mean - result["psnr"].as_f64().unwrap()).abs() < 1e-9);
    // Something was learned: all of the object's color is not white.
    assert!(result["psnr"].as_f64() > result["baseline_background_psnr"].as_f64(), "{result}");

    // The folder explains itself.
    let expected = [
        "README.md",
        "checkpoint.safetensors",
        "config.toml",
        "images",
        "loss.svg",
        "metrics.jsonl",
        "report.html",
        "result.json",
        "run.json",
        "run.lock",
    ];
    let mut left = names(&run);
    left.retain(|name| !name.starts_with("events.out.tfevents."));
    assert_eq!(left, expected);
    let saved: Value = serde_json::from_str(&fs::read_to_string(format!("{run}/result.json")).unwrap()).unwrap();
    assert_eq!(saved, result);
    let metrics = fs::read_to_string(format!("{run}/metrics.jsonl")).unwrap();
    let metrics: Vec<Value> = metrics.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(metrics.len(), 10 + 1);
    assert!(metrics[4]["ends_stage"] == true && metrics[4]["resolution"] == 8 && metrics[4]["rays"] == 5 * 256);
    // The preset's weights.
    let sum: f64 = [("mse", 1.0), ("tv_density_sampled", 1e-4), ("tv_color_sampled", 1e-2)]
        .map(|(name, weight)| weight * metrics[0]["losses"][name].as_f64().unwrap())
        .iter()
        .sum();
    assert!((sum - metrics[0]["loss"].as_f64().unwrap()).abs() < 1e-6 && metrics[9]["psnr"].is_f64());
    assert_eq!(metrics[10]["final"], result);
    let pictures = [
        "preview.png",
        "stage_0_8.png",
        "stage_1_8.png",
        "stage_2_12.png",
        "stages.png",
        "test_000_r_0.png",
        "test_001_r_1.png",
        "test_002_r_2.png",
    ];
    assert_eq!(names(&format!("{run}/images")), pictures);
    // The start, two stages and the target, and four panels, of 24 pixels with gaps of 2.
    let size = |name: &str| image::size(Path::new(&format!("{run}/images/{name}"))).unwrap();
    assert_eq!((size("stages.png"), size("test_000_r_0.png")), ((4 * 24 + 3 * 2, 24), (4 * 24 + 3 * 2, 24)));
    assert_eq!(size("preview.png"), (2 * 24 + 2, 24));
    assert!(fs::read_to_string(format!("{run}/loss.svg")).unwrap().contains("12³"));
    assert!(trained.err.contains("memory: about ") && trained.err.contains("stage 2/2 (12³)  step 10/10"), "{}", trained.err);

    // The same views, the same figures.
    let evaluated = plenoxel(&["evaluate", &run]).json();
    for key in ["psnr", "ssim", "ssim_same", "per_view", "seconds", "rays", "views", "width", "background", "resolution"] {
        assert_eq!(evaluated[key], result[key], "{key}");
    }
    plenoxel(&["evaluate", &run, "--downscale", "2", "--keep"]).refused(2, &["--keep", "from its training", "--no-evaluate"]);
    let evaluated = plenoxel(&["evaluate", &run, "--split", "val", "--json", "--samples", "40"]);
    assert_eq!(evaluated.out.lines().count(), 1);
    assert_eq!((&evaluated.json()["views"], &evaluated.json()["split"]), (&1.into(), &"val".into()));
    // 24 / 3 = 8 pixels are too few for a window of 11.
    let small = plenoxel(&["evaluate", &run, "--downscale", "3"]).json();
    assert!(small["width"] == 8 && small["ssim"].is_null() && small["ssim_same"].is_f64());

    let rendered = plenoxel(&["render", &run, "--view", "2", "--view", "r_0"]);
    assert_eq!(rendered.code, 0, "{}", rendered.err);
    let pictures = ["test_000_r_0.png", "test_000_r_0_depth.png", "test_000_r_0_normal.png", "test_000_r_0_opacity.png"];
    assert_eq!(names(&format!("{run}/renders"))[..4], pictures);
    assert_eq!(names(&format!("{run}/renders")).len(), 8);
    assert_eq!(plenoxel(&["render", &run, "--split", "train", "--downscale", "2", "-q"]).code, 0);
    assert_eq!(image::size(Path::new(&format!("{run}/renders/train_005_r_5.png"))).unwrap(), (12, 12));

    let described = plenoxel(&["info", &run]);
    for part in ["12³ voxels", "trilinear", "demo", "built in, 24 x 24", "PSNR", "threads"] {
        assert!(described.out.contains(part), "{part}: {}", described.out);
    }
    let checkpoint = plenoxel(&["info", &format!("{run}/checkpoint.safetensors")]);
    assert!(checkpoint.out.contains("10 steps, procedural, seed 42"), "{}", checkpoint.out);
}

#[test]
fn a_scene_on_disk_is_learned_and_its_configuration_repeats_the_run_to_the_bit() {
    let folder = Folder::new("repeat");
    let data = scene(&folder);
    let described = plenoxel(&["info", &data]);
    assert!(described.out.contains("3 train, 0 val, 2 test") && described.out.contains("16 x 16"), "{}", described.out);
    let [a, b, c, d] = ["a", "b", "c", "d"].map(|name| folder.path(name));
    let flags = ["--background", "0.3,0.2,0.1", "--half-width", "1.4", "--sh-degree", "1", "--tv", "1e-3", "--seed", "7", "--threads", "1"];
    let first = train_on(&data, &a, &flags).json();
    assert_eq!((&first["preset"], &first["views"]), (&"fast".into(), &2.into()));
    assert_eq!(names(&a).iter().filter(|name| *name == "images").count(), 0);

    // Another number of threads, and the resolved configuration instead of the flags.
    assert_eq!(train_on(&data, &b, &[&flags[..10], &["--threads", "3"]].concat()).json()["psnr"], first["psnr"]);
    let config = format!("{a}/config.toml");
    let again = plenoxel(&["train", &data, "--config", &config, "--no-images", "--quiet", "--out", &c]).json();
    assert_eq!((&again["psnr"], &again["preset"]), (&first["psnr"], &Value::Null));
    assert_eq!(train_on(&data, &d, &[&flags[..8], &["--seed", "8"]].concat()).code, 0);
    let [a, b, c, d] =
        [a, b, c, d].map(|run| [format!("{run}/checkpoint.safetensors"), format!("{run}/config.toml")].map(|f| fs::read(f).unwrap()));
    assert!(a == b && a == c, "threads or the file changed a bit");
    assert!(a[0] != d[0], "the seed changed nothing");
}

#[test]
fn a_run_remembers_its_data_until_the_data_moves() {
    let folder = Folder::new("moved");
    let (data, run, moved) = (scene(&folder), folder.path("run"), folder.path("moved"));
    let trained = train_on(&data, &run, &[]).json();
    assert_eq!(plenoxel(&["evaluate", &run]).json()["psnr"], trained["psnr"]);
    fs::rename(&data, &moved).unwrap();
    plenoxel(&["evaluate", &run]).refused(3, &[&data, "no longer exists", "--data"]);
    plenoxel(&["render", &run]).refused(3, &["--data"]);
    assert_eq!(plenoxel(&["evaluate", &run, "--data", &moved]).json()["psnr"], trained["psnr"]);
    plenoxel(&["evaluate", &run, "--data", &moved, "--split", "val"]).refused(2, &["--split", "val", "has no val views", "train or test"]);
    plenoxel(&["render", &run, "--data", &moved, "--view", "r_9"]).refused(2, &["--view", "r_9", "r_0 to r_1"]);
    plenoxel(&["evaluate", &run, "--data", &moved, "--downscale", "3"]).refused(2, &["downscale", "3", "1, 2, 4"]);
}

#[test]
fn without_test_views_training_ends_well_and_has_no_figures() {
    let folder = Folder::new("no-test");
    // A flag that is given twice counts the last time.
    let result = train(&folder.path("built-in"), &["--scene-views", "4,0,0"]).json();
    assert!(result["psnr"].is_null() && result["views"] == 0 && result["stages"][0]["psnr"].is_null(), "{result}");
    let pictures = names(&folder.path("built-in/images"));
    assert_eq!(pictures, ["preview.png", "stage_0_8.png", "stage_1_8.png", "stage_2_12.png", "stages.png"]);
    let data = scene(&folder);
    fs::remove_file(format!("{data}/transforms_test.json")).unwrap();
    let result = train_on(&data, &folder.path("run"), &["--set", "validation_every=3"]).json();
    assert!(result["psnr"].is_null() && result["views"] == 0 && result["ssim"].is_null(), "{result}");
    // Of three training views every third is held out.
    let val = plenoxel(&["evaluate", &folder.path("run"), "--split", "val"]).json();
    assert_eq!(val["views"], 1);
}

#[test]
fn a_run_is_overwritten_only_when_forced_and_leaves_nothing_of_the_old_one() {
    let folder = Folder::new("force");
    let run = folder.path("run");
    assert_eq!(train(&run, &["--quiet"]).code, 0);
    assert_eq!(plenoxel(&["render", &run, "--view", "0", "--quiet"]).code, 0);
    let before = fs::read(format!("{run}/checkpoint.safetensors")).unwrap();
    train(&run, &[]).refused(2, &["--out", &run, "--force"]);
    assert_eq!(fs::read(format!("{run}/checkpoint.safetensors")).unwrap(), before);
    let forced = train(&run, &["--force", "--no-images", "--seed", "5", "--quiet"]);
    assert!(forced.code == 0 && forced.err.is_empty(), "{}", forced.err);
    assert_ne!(fs::read(format!("{run}/checkpoint.safetensors")).unwrap(), before);
    assert!(names(&format!("{run}/images")).is_empty() && names(&format!("{run}/renders")).is_empty());
    let metrics = fs::read_to_string(format!("{run}/metrics.jsonl")).unwrap();
    assert_eq!(metrics.lines().count(), 11);

    let data = scene(&folder);
    plenoxel(&["scene", &data, "--size", "16"]).refused(2, &["--force"]);
    assert_eq!(plenoxel(&["scene", &data, "--size", "8", "--train", "1", "--val", "0", "--test", "0", "--force"]).code, 0);
    assert!(plenoxel(&["info", &data]).out.contains("1 train, 0 val, 0 test"));
    fs::write(folder.path("file"), "x").unwrap();
    plenoxel(&["scene", &folder.path("file")]).refused(2, &["is a file"]);
    train(&folder.path("file"), &["--force"]).refused(2, &["is a file"]);
    // A folder cannot be made below a file.
    train(&folder.path("file/run"), &["--quiet"]).refused(2, &["file/run", "is a file"]);
}

#[test]
fn who_watches_sees_the_same_figures_everywhere_and_changes_nothing() {
    let folder = Folder::new("watched");
    let [often, never] = ["often", "never"].map(|name| folder.path(name));
    let watched = train(&often, &["--preview-every", "1h", "--log-format", "json"]);
    let result = watched.json();
    assert_eq!(train(&never, &["--preview-every", "off"]).code, 0);
    let [checkpoint, of_never] = [&often, &never].map(|run| fs::read(format!("{run}/checkpoint.safetensors")).unwrap());
    assert!(checkpoint == of_never, "watching changed the grid");
    assert!(!names(&format!("{never}/images")).contains(&"preview.png".to_owned()));

    // Whatever was seen of validation views is in the lines; the final figures name the best of it.
    let lines = fs::read_to_string(format!("{often}/metrics.jsonl")).unwrap();
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let (lines, last) = lines.split_at(10);
    let seen: Vec<(u64, f64)> = lines.iter().filter_map(|line| Some((line["step"].as_u64()?, line["validation_psnr"].as_f64()?))).collect();
    assert!(seen.iter().any(|(step, _)| *step == 4) && seen.last().unwrap().0 == 9, "at the ends of the stages: {seen:?}");
    let best = seen.iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
    assert_eq!((result["best_validation"]["step"].as_u64(), result["best_validation"]["psnr"].as_f64()), (Some(best.0), Some(best.1)));
    assert_eq!((result["validation_psnr"].as_f64(), &last[0]["final"]), (Some(seen.last().unwrap().1), &result));
    let voxels = lines[9]["voxels"].as_u64().unwrap();
    assert!((1..=12 * 12 * 12).contains(&voxels) && lines[4]["voxels"].as_u64().unwrap() <= 8 * 8 * 8);
    let lines_of_never = fs::read_to_string(format!("{never}/metrics.jsonl")).unwrap();
    assert!(!lines_of_never.lines().take(10).any(|line| line.contains("validation")));

    // And in the events for TensorBoard.
    let files = events::files(Path::new(&often));
    assert_eq!(files.len(), 1);
    let events_of_run = events::read(&files[0]);
    assert_eq!(events_of_run[0].version, "brain.Event:2");
    let curves = events::scalars(Path::new(&often));
    let curve = |key: &str| -> Vec<(u64, f32)> {
        lines.iter().filter_map(|line| Some((line["step"].as_u64()?, line.pointer(key)?.as_f64()? as f32))).collect()
    };
    for (tag, key) in [
        ("loss", "/loss"),
        ("loss/mse", "/losses/mse"),
        ("psnr/train", "/psnr"),
        ("psnr/validation", "/validation_psnr"),
        ("resolution", "/resolution"),
        ("voxels", "/voxels"),
        ("density_rate", "/density_rate"),
        ("color_rate", "/color_rate"),
    ] {
        assert!(!curves[tag].is_empty() && curves[tag] == curve(key), "{tag}: {:?}", curves[tag]);
    }
    assert!(curves["rays_per_second"].len() == 10 && curves["rays_per_second"].iter().all(|(_, rays)| *rays > 0.0));
    assert_eq!(
        (curves["psnr/test"][0].1, curves["ssim/test"][0].1),
        (result["psnr"].as_f64().unwrap() as f32, result["ssim"].as_f64().unwrap() as f32)
    );
    let images: Vec<_> = events_of_run.iter().flat_map(|event| event.images.iter().map(|image| (event.step, image))).collect();
    assert_eq!(images.iter().map(|(step, _)| *step).collect::<Vec<_>>(), [4, 9]);
    let (_, (tag, size, png)) = images[1];
    assert_eq!((tag.as_str(), *size, png), ("preview", (2 * 24 + 2, 24), &fs::read(format!("{often}/images/preview.png")).unwrap()));

    // Each line on stderr is an object.
    let told: Vec<Value> = watched.err.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(
        told.iter().all(|event| event["time"].is_f64())
            && told.iter().any(|event| event["event"] == "note" && event["message"].is_string())
    );
    let progress = |what: &str| told.iter().filter(|event| event["event"] == "progress" && event["what"] == what).collect::<Vec<_>>();
    assert_eq!(progress("rendering train images of the built-in scene").last().unwrap()["done"], 6);
    let training = progress("training");
    let last = training.last().unwrap();
    for (key, value) in [("step", 10), ("steps", 10), ("stage", 2), ("stages", 2), ("resolution", 12), ("voxels", voxels)] {
        assert_eq!(last[key], value, "{key}");
    }
    for key in ["loss", "psnr", "validation_psnr", "rays_per_second", "samples_per_ray", "eta_seconds", "seconds"] {
        assert!(last[key].is_f64(), "{key}: {last}");
    }
    assert!(cfg!(not(target_os = "linux")) || last["memory_bytes"].as_u64().unwrap() > 1_000_000);
    assert_eq!(last["validation_psnr"].as_f64(), result["validation_psnr"].as_f64());

    let refused = plenoxel(&["evaluate", &folder.path("nowhere"), "--log-format", "json"]);
    let error: Value = serde_json::from_str(&refused.err).unwrap();
    assert_eq!((refused.code, &error["event"], &error["exit_code"]), (3, &"error".into(), &3.into()));
    assert!(error["message"].as_str().unwrap().contains("this run folder does not exist"), "{error}");
    plenoxel(&["train", "--preview-every", "sometimes"]).refused(2, &["--preview-every", "or off"]);
}

#[test]
fn a_run_is_exported_to_its_folder_or_to_a_file() {
    let folder = Folder::new("export");
    let run = folder.path("run");
    assert_eq!(train(&run, &["--no-images"]).code, 0);
    // Ten steps make fog: a low level finds some of it.
    for (what, file, start) in [("vox", "grid.vox", b"VOX ".as_slice()), ("mesh", "mesh.ply", b"ply\n")] {
        let fog = if what == "vox" { ["--min-alpha", "0"] } else { ["--level", "1e-3"] };
        let answer = plenoxel(&["export", what, &run, fog[0], fog[1]]);
        assert!(answer.code == 0 && answer.out.contains(file), "{} {}", answer.out, answer.err);
        assert!(fs::read(Path::new(&run).join("exports").join(file)).unwrap().starts_with(start));
    }
    let out = folder.path("fog.GLB");
    assert_eq!(plenoxel(&["export", "mesh", &run, "--level", "1e-3", "--color", "0,0,-1", "--out", &out]).code, 0);
    assert!(fs::read(&out).unwrap().starts_with(b"glTF"));
    let export = |args: &[&str]| plenoxel(&[&["export"], args].concat());
    export(&["mesh", &run, "--out", &out, "--format", "obj"]).refused(2, &["--out", "fog.GLB", ".obj"]);
    export(&["mesh", &run, "--level", "1e9"]).refused(2, &["--level", "above 0 and below"]);
    export(&["mesh", &run, "--level", "1e-3", "--max-triangles", "3"]).refused(2, &["--max-triangles", "a whole number from 4"]);
    let stl = export(&["mesh", &run, "--level", "1e-3", "--format", "stl", "--smooth", "2", "--max-triangles", "100"]);
    assert!(stl.code == 0 && stl.err.contains("stl files have no colors"), "{}", stl.err);
    // What flags alone can tell is told before a run is looked for.
    let none = folder.path("none");
    for what in ["vox", "mesh"] {
        for color in ["0,0,0", "seen", "1,2"] {
            export(&[what, &none, "--color", color]).refused(2, &["--color", "facing, or a direction of three numbers"]);
        }
    }
    export(&["mesh", &none, "--level", "0"]).refused(2, &["--level", "above 0"]);
    for (what, alpha) in [("vox", "1"), ("vox", "2"), ("ply", "1"), ("ply", "nan")] {
        export(&[what, &none, "--min-alpha", alpha]).refused(2, &["--min-alpha", "in [0, 1)"]);
    }
    export(&["ply", &none, "--out", "cloud.obj"]).refused(2, &["--out", "cloud.obj", ".ply"]);
    export(&["vox", &none]).refused(3, &["none", "this run folder does not exist"]);
    export(&["vox", &run, "--min-alpha", "0", "--out", &folder.path("none/a.vox")]).refused(5, &["a.vox", "spelling"]);
}

#[test]
fn help_mentions_every_command_and_flag() {
    let help = plenoxel(&["--help"]);
    assert!(help.code == 0 && help.err.is_empty());
    for part in ["train", "render", "evaluate", "export", "info", "scene", "Exit codes"] {
        assert!(help.out.contains(part), "{part}");
    }
    let version = plenoxel(&["--version"]);
    assert!(version.code == 0 && version.out.starts_with("plenoxel 0."), "{}", version.out);
    let flags = "--out --force --no-images --preset --config --set --seed --downscale --background --half-width --interpolation --color \
        --sh-degree --sh-reduction --engine --tv --threads --quiet --log-format --preview-every --scene-size --scene-views Examples:";
    for (command, flags) in [
        ("train", flags),
        ("render", "--split --view --downscale --data --path --frames --size --fps --channels --format Examples:"),
        ("evaluate", "--split --downscale --samples --json --data Examples:"),
        ("info", "Examples:"),
        ("export", "ply vox mesh svox2 plenoctree"),
        ("import", "--out --data --scene-scale --background --force --no-report Examples:"),
        ("export ply", "--out --color --min-alpha --min-weight --min-object --coords --bbox --sor-sigma Examples:"),
        ("export vox", "--out --color --min-alpha --solid Examples:"),
        ("export mesh", "--out --color --format --level --min-part --smooth --max-triangles Examples:"),
        ("export svox2", "--out --best --scene-scale Examples:"),
        ("export plenoctree", "--out --best --subdivide Examples:"),
        ("scene", "--width --height --train --val --test --exposure-spread --seed --force Examples:"),
    ] {
        let help = plenoxel(&[command.split(' ').collect(), vec!["--help"]].concat());
        assert_eq!(help.code, 0);
        assert!(flags.split_whitespace().all(|flag| help.out.contains(flag)), "{command}: {}", help.out);
    }
}

#[test]
fn a_scene_of_spread_exposures_has_other_training_views_and_the_same_test_views() {
    let folder = Folder::new("exposure");
    let data = folder.path("scene");
    let scene = ["scene", &data, "--size", "16", "--train", "3", "--val", "1", "--test", "2"];
    let with = |flags: &[&str]| plenoxel(&[&scene, flags].concat());
    for wrong in ["-0.1", "2.5", "NaN", "much"] {
        with(&[&format!("--exposure-spread={wrong}")]).refused(2, &["--exposure-spread", "a number from 0 to 2"]);
    }
    with(&["--seed", "7"]).refused(2, &["--exposure-spread"]);
    with(&["--exposure-spread", "0.4", "--seed", "7"]).done();
    let options = ProceduralOptions { width: 16, height: 16, train: 3, val: 1, test: 2, ..ProceduralOptions::default() };
    let (made, read) = (Dataset::procedural(options).unwrap(), dataset::open(Path::new(&data), &OpenOptions::default()).unwrap());
    for split in Split::ALL {
        let images = |dataset: &Dataset, spread: f64| {
            let mut views = dataset.load(split, &|_, _| {}).unwrap();
            exposure::spread(&mut views, spread, 7);
            views.into_iter().map(|view| view.image).collect::<Vec<_>>()
        };
        let spread = if split == Split::Train { 0.4 } else { 0.0 };
        assert!(images(&read, 0.0) == images(&made, spread), "{split}");
        assert!((images(&read, 0.0) == images(&made, 0.0)) == (split != Split::Train), "{split}");
    }
}

#[test]
fn what_is_carved_is_a_run_that_other_commands_take_and_training_starts_from() {
    let folder = Folder::new("carve");
    let (data, carved, trained) = (folder.path("scene"), folder.path("carved"), folder.path("trained"));
    plenoxel(&["scene", &data, "--size", "40", "--train", "10", "--val", "0", "--test", "2"]).done();
    let result = plenoxel(&["carve", &data, "--out", &carved, "--resolution", "24", "--sh-degree", "1", "--quiet"]).json();
    assert_eq!((result["resolution"].as_u64(), result["rule"].as_str()), (Some(24), Some("footprint")));
    let voxels = result["voxels"].as_u64().unwrap();
    assert!((100..5000).contains(&voxels), "{voxels}");
    for file in ["checkpoint.safetensors", "config.toml", "images/carved.png", "result.json", "run.json", "README.md"] {
        assert!(Path::new(&format!("{carved}/{file}")).exists(), "{file}");
    }
    // Scores of a part of the views are not written to the run folder.
    let few = plenoxel(&["evaluate", &carved, "--quiet", "--views", "1"]).json();
    assert!(few["views"] == 1 && !Path::new(&format!("{carved}/evaluation.json")).exists(), "{few}");
    plenoxel(&["evaluate", &carved, "--views", "1", "--keep"]).refused(2, &["--views", "--keep"]);
    let psnr = plenoxel(&["evaluate", &carved, "--quiet"]).json()["psnr"].as_f64().unwrap();
    assert!(psnr > 12.0, "{psnr}");
    let told = plenoxel(&["info", &carved]).done();
    assert!(told.contains("nearest") && told.contains("degree 1"), "{told}");
    // Its test views have panels. Scores and panels of another size are written only with --keep.
    let panel = || image::size(Path::new(&format!("{carved}/images/test_001_r_1.png"))).unwrap();
    let kept =
        || serde_json::from_str::<Value>(&fs::read_to_string(format!("{carved}/evaluation.json")).unwrap()).unwrap()["width"].clone();
    assert_eq!((panel(), kept()), ((4 * 40 + 3 * 2, 40), Value::from(40)));
    plenoxel(&["evaluate", &carved, "--quiet", "--downscale", "2"]).done();
    assert_eq!((panel(), kept()), ((4 * 40 + 3 * 2, 40), Value::from(40)));
    plenoxel(&["evaluate", &carved, "--quiet", "--downscale", "2", "--keep"]).done();
    assert_eq!((panel(), kept()), ((4 * 20 + 3 * 2, 20), Value::from(20)));
    let compared = folder.path("carved.html");
    plenoxel(&["compare", &carved, &carved, "--out", &compared]).done();
    // 20 pixels, each enlarged to 20.
    let page = fs::read_to_string(&compared).unwrap();
    assert_eq!(page.matches("<img width=\"400\" height=\"400\" alt=\"render of").count(), 4, "two views of two runs");
    plenoxel(&["evaluate", &carved, "--keep", "--split", "train"]).refused(2, &["--keep", "the train views", "the test views"]);
    plenoxel(&["evaluate", &carved, "--keep", "--samples", "9"]).refused(2, &["--keep", "--samples"]);
    plenoxel(&["evaluate", &carved, "--quiet"]).done();
    // The same settings again give the same bits.
    let again = folder.path("again");
    plenoxel(&["carve", &data, "--out", &again, "--config", &format!("{carved}/config.toml"), "--quiet"]).done();
    let [a, b] = [&carved, &again].map(|run| fs::read(format!("{run}/checkpoint.safetensors")).unwrap());
    assert!(a == b);
    let stages = "stages=[{resolution=24, steps=2, sampling={step=0.5}, density_rate=0.1, color_rate=0.01}]";
    let start = ["train", &data, "--out", &trained, "--init-from", &carved, "--set", stages, "--set", "rays_per_step=256", "--quiet"];
    let warm = plenoxel(&start).json()["psnr"].as_f64().unwrap();
    let cold = folder.path("cold");
    let from_nothing = [&start[..2], &["--out", &cold, "--hull", "off"], &start[6..]].concat();
    let cold = plenoxel(&from_nothing).json()["psnr"].as_f64().unwrap();
    assert!(warm > cold + 0.5, "{warm} against {cold}");
    assert!(fs::read_to_string(format!("{trained}/config.toml")).unwrap().contains("init_from = "));
}

#[test]
fn harmonics_are_drawn_into_a_file() {
    let folder = Folder::new("harmonics");
    let out = folder.path("two.png");
    let told = plenoxel(&["harmonics", "--degree", "2", "--size", "20", "--out", &out]).done();
    assert!(told.contains("9 functions, 100 x 60 pixels"), "{told}");
    assert_eq!(image::size(Path::new(&out)).unwrap(), (100, 60));
    plenoxel(&["harmonics", "--degree", "4"]).refused(2, &["--degree", "a whole number from 0 to 3"]);
    plenoxel(&["harmonics", "--size", "5"]).refused(2, &["--size", "a whole number from 16 to 1024"]);
    plenoxel(&["harmonics", "--size", "16", "--out", &folder.path("none/there.png")]).refused(5, &["none"]);
}

#[test]
fn a_time_may_include_the_evaluation_and_the_run_says_so() {
    let folder = Folder::new("including");
    let run = folder.path("run");
    let stages = "tensorf.stages=[{resolution=8, steps=20000, rays=32}, {resolution=8, steps=20000, rays=32}]";
    let tiny = ["train", "--preset=quality", "--scene-size=16", "--scene-views=4,0,2", "--set", stages, "--out", &run, "--no-report"];
    let with = |more: &[&str]| plenoxel(&[&tiny, more].concat());
    with(&["--including-evaluation"]).refused(2, &["--time"]);
    with(&["--including-evaluation", "--time=3s", "--no-evaluate"]).refused(2, &["--including-evaluation", "--no-evaluate"]);
    let answer = with(&["--including-evaluation", "--time=12s"]);
    assert!(answer.err.contains("planned for 0:12 with evaluation"), "{}", answer.err);
    assert_eq!(answer.json()["views"], 2);
    let record: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.path("run/run.json")).unwrap()).unwrap();
    assert_eq!((&record["seconds_planned"], &record["with_evaluation"]), (&12.0.into(), &true.into()));
}

#[test]
fn some_test_views_or_none_are_compared_and_the_figures_say_so() {
    let folder = Folder::new("some-views");
    let [some, none] = ["some", "none"].map(|name| folder.path(name));
    let answer = command::train("4,0,5", &some, &["--test-views", "3"]);
    assert!(answer.out.contains("means over 3 test views of 24 x 24, evenly spaced among all 5"), "{}", answer.out);
    let result = answer.json();
    assert_eq!((result["views"].as_u64(), result["per_view"].as_array().map(Vec::len)), (Some(3), Some(3)));
    let panels = names(&format!("{some}/images")).into_iter().filter(|name| name.starts_with("test_")).count();
    assert_eq!(panels, 3);

    let answer = command::train("4,0,5", &none, &["--no-evaluate"]);
    assert!(answer.out.contains("not evaluated on the 5 test views"), "{}", answer.out);
    assert!(answer.json()["psnr"].is_null());
    let evaluated = plenoxel(&["evaluate", &none]).json();
    let compared = plenoxel(&["compare", &none, &some, "--out", &folder.path("page.html")]).done();
    let psnr = format!("| {:.2} |", evaluated["psnr"].as_f64().unwrap());
    assert!(compared.contains(&psnr), "{psnr} in {compared}");
}
