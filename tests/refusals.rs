//! Refusals of the command line: broken data, settings, runs and outputs end with a message and an exit code, and nothing is written.

use crate::cli::{names, scene, train, train_on};
use crate::command::{Folder, plenoxel};
use plenoxel::dataset::image;
use plenoxel_cli::Streams;
use serde_json::Value;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

#[test]
fn each_broken_dataset_is_refused_with_the_place_and_the_remedy() {
    let folder = Folder::new("broken");
    let refused = |data: &str, parts: &[&str]| {
        let run = folder.path("run");
        train_on(data, &run, &[]).refused(3, parts);
        assert!(!Path::new(&run).exists(), "bad input made a run folder");
    };
    refused(&folder.path("missing"), &["missing", "there is no such folder"]);
    fs::write(folder.path("file"), "x").unwrap();
    refused(&folder.path("file"), &["this is a file", "give the folder"]);
    fs::create_dir(folder.path("empty")).unwrap();
    refused(&folder.path("empty"), &["no format is recognized", "it is empty"]);

    // Each of these breaks one file of a whole scene, which is then mended.
    let data = scene(&folder);
    let broken = |name: &str, content: Vec<u8>, parts: &[&str]| {
        let path = format!("{data}/{name}");
        let whole = fs::read(&path).unwrap();
        fs::write(&path, content).unwrap();
        refused(&data, &[&[name][..], parts].concat());
        fs::write(&path, whole).unwrap();
    };
    let png = fs::read(format!("{data}/train/r_1.png")).unwrap();
    broken("train/r_1.png", png[..png.len() / 2].to_vec(), &["truncated"]);
    broken("train/r_1.png", b"\xff\xd8\xff\xe0 a photograph".to_vec(), &["the JPEG is truncated"]);
    broken("train/r_1.png", Vec::new(), &["empty"]);

    let json = fs::read_to_string(format!("{data}/transforms_train.json")).unwrap();
    broken("transforms_train.json", json.as_bytes()[..json.len() / 2].to_vec(), &["ends early", "line"]);
    let edit = |f: &dyn Fn(&mut Value)| {
        let mut value: Value = serde_json::from_str(&json).unwrap();
        f(&mut value);
        value.to_string().into_bytes()
    };
    let broken = |content: Vec<u8>, parts: &[&str]| broken("transforms_train.json", content, parts);
    broken(edit(&|v| drop(v.as_object_mut().unwrap().remove("camera_angle_x"))), &["frame 0 has no focal length", "camera_angle_x"]);
    broken(edit(&|v| drop(v["frames"][1].as_object_mut().unwrap().remove("transform_matrix"))), &["frame 1", "transform_matrix"]);
    broken(edit(&|v| drop(v["frames"][2]["transform_matrix"].as_array_mut().unwrap().pop())), &["frame 2", "3 rows"]);
    broken(edit(&|v| v["frames"][0]["transform_matrix"][1][2] = Value::Null), &["frame 0", "null", "finite"]);
    broken(edit(&|v| v["frames"][0]["file_path"] = "./train/r_77".into()), &["frame 0", "r_77", "does not exist"]);
    broken(edit(&|v| v["frames"] = serde_json::json!([])), &["frames is empty", "at least one"]);
    broken(json.replacen("0.", "1e999, 0.", 1).into_bytes(), &["transforms_train.json"]);
    assert_eq!(train_on(&data, &folder.path("run"), &[]).code, 0, "the scene was mended");
}

#[test]
fn settings_that_cannot_be_used_are_refused_before_anything_is_written() {
    let folder = Folder::new("settings");
    let run = folder.path("run");
    let refused = |more: &[&str], parts: &[&str]| {
        train(&run, more).refused(2, parts);
        assert!(!Path::new(&run).exists());
    };
    refused(&["--downscale", "5"], &["downscale", "5", "24 x 24", "1, 2, 3, 4, 6, 8, 12, 24"]);
    refused(&["--set", "stages[1].resolution=1024", "--sh-degree", "3"], &["stages[1].resolution", "GB of memory", "fewer voxels"]);
    refused(&["--half-width", "-1"], &["half_width (--half-width)", "from 1e-9"]);
    refused(&["--set", "stages[0].rezolution=4"], &["--set stages[0].rezolution", "did you mean `resolution`?"]);
    refused(&["--set", "stages[4].resolution=4"], &["stages[0] to stages[1]"]);
    refused(&["--set", "losses.tv=1"], &["unknown key `tv`"]);
    refused(&["--set", "jitter=perhaps"], &["--set jitter", "true or false"]);
    refused(&["--threads", "0"], &["--threads", "1 to 1024"]);
    refused(&["--threads", "5000"], &["--threads"]);
    refused(&["--sh-degree", "4"], &["--sh-degree", "from 0 to 3"]);
    refused(&["--color", "rgb", "--sh-degree", "1"], &["--sh-degree", "--color rgb", "leave out one of the two"]);
    refused(&["--background", "gray"], &["--background", "white, black"]);
    refused(&["--preset", "best"], &["--preset", "demo", "paper"]);
    refused(&["--engine", "magic"], &["--engine", "graph"]);
    refused(&["--tv", "-1"], &["--tv"]);
    refused(&["--colour", "sh"], &["--colour", "--color"]);
    plenoxel(&["train", "somewhere", "--scene-size", "32"]).refused(2, &["--scene-size", "cannot be used with"]);
    plenoxel(&["scene", &run, "--size", "16000", "--train", "1000"]).refused(2, &["GB of memory", "fewer or smaller views"]);
    plenoxel(&["trian"]).refused(2, &["train"]);
    assert_eq!(plenoxel(&[]).code, 2);

    let config = folder.path("my.toml");
    let with_file = |text: &str| {
        fs::write(&config, text).unwrap();
        train(&run, &["--config", &config])
    };
    with_file("seed = 3\n[initial]\ndensitty = 1\n").refused(2, &["my.toml, line 3", "`densitty`", "did you mean `density`?"]);
    with_file("seed = 3\nhalf_width = 0\n").refused(2, &["half_width", "my.toml, line 2", "from 1e-9"]);
    with_file("seed = \n").refused(3, &["my.toml", "line 1", "not valid TOML"]);
    train(&run, &["--config", &folder.path("none.toml")]).refused(3, &["none.toml", "does not exist"]);
    train(&run, &["--config", &folder.path("")]).refused(3, &["this is a folder"]);
    // What a file leaves open the preset fills in, and a flag goes before both.
    let run_config = || fs::read_to_string(format!("{run}/config.toml")).unwrap();
    fs::write(&config, "seed = 3\nsh_degree = 1\n[losses]\nsparsity = { from = 1e-4, to = 1e-6, steps = 10 }\n").unwrap();
    assert_eq!(train(&run, &["--config", &config, "--seed", "9", "--quiet"]).code, 0);
    for line in ["seed = 9\n", "sh_degree = 1\n", "mse = 1.0\n", "from = 0.0001\n", "rays_per_step = 256\n"] {
        assert!(run_config().contains(line), "{line}{}", run_config());
    }
}

#[test]
fn numbers_that_are_not_finite_end_the_run_and_leave_the_metrics_but_no_checkpoint() {
    let folder = Folder::new("nan");
    let run = folder.path("run");
    let diverging = ["--set", "optimizer={kind=\"sgd\"}", "--set", "stages[1].color_rate=1e30"];
    train(&run, &diverging).refused(4, &["step ", "rates"]);
    let metrics = fs::read_to_string(format!("{run}/metrics.jsonl")).unwrap();
    assert!(metrics.lines().count() > 5, "the first stage is there");
    let last: Value = serde_json::from_str(metrics.lines().last().unwrap()).unwrap();
    assert!(last["failure"].as_str().unwrap().contains("step"), "{last}");
    let left = names(&run);
    assert!(
        left.contains(&"loss.svg".to_owned()) && !left.iter().any(|name| name.contains("checkpoint") || name.contains("result")),
        "{left:?}"
    );
    plenoxel(&["evaluate", &run]).refused(3, &["no checkpoint.safetensors", "not finished"]);
    assert!(plenoxel(&["info", &run]).out.contains("the run is not finished"));
}

#[test]
fn a_damaged_run_is_refused() {
    let folder = Folder::new("damaged");
    let run = folder.path("run");
    plenoxel(&["evaluate", &run]).refused(3, &["this run folder does not exist"]);
    plenoxel(&["info", &run]).refused(3, &["run"]);
    plenoxel(&["render", &folder.path("")]).refused(3, &["no run.json"]);
    assert_eq!(train(&run, &["--no-images", "--quiet"]).code, 0);
    let checkpoint = format!("{run}/checkpoint.safetensors");
    plenoxel(&["evaluate", &checkpoint]).refused(3, &["not a run folder"]);
    let whole = fs::read(&checkpoint).unwrap();
    fs::write(&checkpoint, &whole[..whole.len() - 9]).unwrap();
    plenoxel(&["evaluate", &run]).refused(3, &["checkpoint.safetensors"]);
    plenoxel(&["info", &checkpoint]).refused(3, &["checkpoint.safetensors"]);
    fs::write(&checkpoint, whole).unwrap();
    fs::write(format!("{run}/run.json"), "{}").unwrap();
    plenoxel(&["evaluate", &run]).refused(3, &["run.json", "not a valid record of a run"]);
}

/// A run whose files are replaced one by one.
#[cfg(unix)]
#[test]
fn a_file_of_a_run_that_never_ends_is_refused_by_its_name() {
    let folder = Folder::new("endless");
    let run = folder.path("run");
    assert_eq!(train(&run, &["--no-images", "--no-report", "--quiet"]).code, 0);
    let all = [
        ("run.json", "evaluate"),
        ("config.toml", "evaluate"),
        ("checkpoint.safetensors", "evaluate"),
        ("result.json", "evaluate"),
        ("result.json", "info"),
        ("run.json", "info"),
        ("metrics.jsonl", "report"),
        ("result.json", "report"),
    ];
    for (name, command) in all {
        let (path, kept) = (format!("{run}/{name}"), folder.path("kept"));
        fs::rename(&path, &kept).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
        plenoxel(&[command, &run]).refused(3, &[name, "this is a device, not a plain file"]);
        fs::remove_file(&path).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        plenoxel(&[command, &run]).refused(3, &[name, "this is a pipe, not a plain file"]);
        fs::remove_file(&path).unwrap();
        fs::rename(&kept, &path).unwrap();
    }
    fs::remove_file(format!("{run}/run.json")).unwrap();
    plenoxel(&["evaluate", &run]).refused(3, &["it has no run.json"]);
}

#[cfg(unix)]
#[test]
fn names_of_files_move_nothing_on_a_screen() {
    let folder = Folder::new("names");
    let data = scene(&folder);
    let name = "a\x1b[2J\nerror: b\u{9b}";
    fs::rename(&data, folder.path(name)).unwrap();
    let shown = "a\\u{1b}[2J\\nerror: b\\u{9b}";
    let info = plenoxel(&["info", &folder.path(name)]).done();
    assert!(info.contains(&format!("scene          {shown}\n")) && !info.contains('\x1b'), "{info}");
    fs::write(folder.path(&format!("{name}/transforms_test.json")), "{").unwrap();
    let told = plenoxel(&["info", &folder.path(name)]);
    assert_eq!((told.code, told.err.lines().count()), (3, 1), "{}", told.err);
    assert!(told.err.contains(shown) && !told.err.contains(['\x1b', '\u{9b}']), "{}", told.err);
    let told = plenoxel(&["info", &folder.path(name), "--log-format", "json"]);
    let line: Value = serde_json::from_str(told.err.trim_end()).unwrap();
    assert!(line["message"].as_str().unwrap().contains(shown), "{line}");
}

/// A stream that refuses everything.
struct Closed(io::ErrorKind);

impl Write for Closed {
    fn write(&mut self, _: &[u8]) -> io::Result<usize> {
        Err(self.0.into())
    }

    fn flush(&mut self) -> io::Result<()> {
        Err(self.0.into())
    }
}

#[test]
fn a_reader_that_went_away_is_no_failure_and_a_full_disk_is() {
    let info = |out: io::ErrorKind| {
        let (mut out, mut err) = (Closed(out), Closed(io::ErrorKind::BrokenPipe));
        plenoxel_cli::run(["plenoxel", "info"], Streams { out: &mut out, err: &mut err, terminal: false, read_by_people: false })
    };
    assert_eq!(info(io::ErrorKind::BrokenPipe), 0);
    assert_eq!(info(io::ErrorKind::StorageFull), 5);
}

#[test]
fn carving_refuses_what_it_cannot_carve_and_writes_nothing() {
    let folder = Folder::new("carve-refused");
    let (data, out) = (folder.path("scene"), folder.path("out"));
    plenoxel(&["scene", &data, "--size", "24", "--train", "3", "--val", "0", "--test", "1"]).done();
    plenoxel(&["carve", &data, "--out", &out, "--resolution", "1"]).refused(2, &["--resolution", "from 2 to 1024"]);
    plenoxel(&["carve", &data, "--out", &out, "--set", "carve.rezolution=8"]).refused(2, &["`rezolution`", "`resolution`"]);
    plenoxel(&["carve", &data, "--out", &out, "--set", "carve.depth=-1"]).refused(2, &["carve.depth", "0.001 to 1000"]);
    plenoxel(&["carve", &data, "--out", &out, "--half-width", "1e9", "--resolution", "8"])
        .refused(2, &["half_width", "a box around the object only, below"]);
    plenoxel(&["carve", &data, "--out", &out, "--photo-consistency=1e-9"]).refused(2, &["carve.photo.noise", "1e-6 to 1"]);
    plenoxel(&["train", &data, "--out", &out, "--set", "stages=[]"]).refused(2, &["stages", "at least one"]);
    plenoxel(&["train", &data, "--out", &out, "--init-from", &folder.path("none")]).refused(3, &["this run folder does not exist"]);
    for view in 0..3 {
        let path = PathBuf::from(format!("{data}/train/r_{view}.png"));
        let mut picture = image::read(&path).unwrap();
        picture.pixels_mut().for_each(|p| p.0[3] = 255);
        image::write_rgba(&path, &picture).unwrap();
    }
    plenoxel(&["carve", &data, "--out", &out, "--resolution", "8"])
        .refused(3, &["no transparent pixel", "alpha channel", "--photo-consistency"]);
    assert!(!Path::new(&out).exists());
}

#[test]
fn no_command_writes_its_result_over_what_it_reads() {
    let folder = Folder::new("over");
    let (run, data) = (folder.path("run"), scene(&folder));
    assert_eq!(train_on(&data, &run, &[]).code, 0);
    let (checkpoint, transforms) = (format!("{run}/checkpoint.safetensors"), format!("{data}/transforms_train.json"));
    let before = [&checkpoint, &transforms].map(|path| fs::read(path).unwrap());
    for (line, owner) in [
        (vec!["evaluate", &run, "--out", &checkpoint], "the run"),
        (vec!["evaluate", &run, "--out", &transforms], "the dataset"),
        (vec!["compare", &run, "--out", &checkpoint], "the run"),
        (vec!["sweep", "--scene", "procedural", "--preset", "demo", "--out", &run], "not a sweep"),
    ] {
        let answer = plenoxel(&line);
        assert!(answer.code == 2 && answer.err.contains(owner) && answer.err.contains("--out"), "{}", answer.err);
    }
    assert!(before == [&checkpoint, &transforms].map(|path| fs::read(path).unwrap()));
    let answer = plenoxel(&["train", "--set", "seed=9223372036854775808"]);
    assert!(answer.code == 2 && answer.err.contains("a whole number from") && !answer.err.contains("string"), "{}", answer.err);
}
