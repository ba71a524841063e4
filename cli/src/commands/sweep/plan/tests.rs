use super::*;
use crate::commands::sweep::job::State;
use crate::commands::table::figures;
use plenoxel::run::folder::{RunFolder, RunKind, RunRecord};
use plenoxel::run::settings::values;
use std::ffi::OsString;
use std::path::PathBuf;

/// Reads a sweep from a file of a test's own.
fn read(name: &str, text: &str) -> Result<Plan> {
    let path = std::env::temp_dir().join(format!("plenoxel-sweep-{}-{name}.toml", std::process::id()));
    std::fs::write(&path, text).unwrap();
    let plan = Plan::from_file(&path, &[], &["seed=5".to_owned()], Path::new("out"));
    std::fs::remove_file(path).unwrap();
    plan
}

#[test]
fn every_scene_meets_every_method_unless_it_chooses() {
    let plan = read(
        "whole",
        r#"
        set = ["seed=1", "rays_per_step=77"]
        [[scenes]]
        data = "data/my.lego"
        downscale = 4
        [[scenes]]
        name = "small"
        scene_size = "32x24"
        scene_views = [6, 0, 2]
        methods = ["fast"]
        [[methods]]
        preset = "fast"
        no_images = true
        stage_psnr = false
        set = ["rays_per_step=99"]
        [[methods]]
        name = "hull"
        command = "carve"
        downscale = 8
        photo_consistency = 0.2
        background = [0, 0.5, 1]
        [[published]]
        name = "Others"
        source = "their table"
        psnr = { small = 30 }
        "#,
    )
    .unwrap();
    assert_eq!((plan.scenes, plan.methods), (vec!["my-lego".to_owned(), "small".to_owned()], vec!["fast".to_owned(), "hull".to_owned()]));
    assert_eq!(plan.published[0].psnr["small"], 30.0);
    let folders: Vec<&Path> = plan.jobs.iter().map(|job| job.folder.as_path()).collect();
    assert_eq!(folders, ["out/my-lego/fast", "out/my-lego/hull", "out/small/fast"].map(Path::new));
    let line = |job: &Job| -> Vec<String> {
        let arguments: Vec<OsString> = job.call.arguments(&["--out".into()]);
        arguments.into_iter().map(|a| a.into_string().unwrap()).collect()
    };
    // Specific settings follow general ones, and override them.
    let data = std::env::temp_dir().join("data/my.lego").to_string_lossy().into_owned();
    let sets = ["--set=seed=1", "--set=rays_per_step=77"];
    let fast = ["--downscale=4", "--no-images", "--preset=fast", "--set=rays_per_step=99", "--set=seed=5", "--out", "--", &data];
    assert_eq!(line(&plan.jobs[0]), [&["train"][..], &sets, &fast].concat());
    let config = &plan.jobs[0].asked.config;
    assert_eq!((config.seed, config.rays_per_step, config.downscale), (5, 99, 4));
    let config = &plan.jobs[1].asked.config;
    assert_eq!((config.downscale, config.background, config.stages.len()), (8, [0.0, 0.5, 1.0], 0));
    assert_eq!(plan.jobs[2].asked.source.to_string(), "built in, 32 x 24, 6 train, 0 val, 2 test views");
}

#[test]
fn mistakes_are_named_with_their_place_and_what_would_do() {
    let good = "[[scenes]]\n[[methods]]\npreset = \"fast\"\n";
    for (name, text, code, parts) in [
        ("toml", "scenes = = 1", 3, &["line 1 is not valid TOML"][..]),
        ("top", &format!("scnes = 1\n{good}"), 2, &["line 1: unknown key `scnes`", "did you mean `scenes`?"]),
        ("none", "scenes = []\nmethods = []", 2, &["there are no scenes", "[[scenes]]"]),
        ("lists", "scenes = 3\nmethods = []", 3, &["line 1", "expected a sequence"]),
        ("scene", "[[scenes]]\ndownscal = 4\n[[methods]]\n", 2, &["line 2", "unknown key `downscal`", "`downscale`"]),
        ("method", &format!("{good}prezet = \"fast\""), 2, &["line 4", "unknown key `prezet`", "`preset`"]),
        ("out", &format!("{good}resume = \"x\""), 2, &["line 4", "unknown key `resume`"]),
        (
            "preset",
            "[[scenes]]\n[[methods]]\npreset = \"fats\"",
            2,
            &["line 2, `procedural` with `fats`", "`fats` for --preset", "fast, quality"],
        ),
        ("value", &format!("{good}downscale = \"half\""), 2, &["`half` for --downscale", "a whole number from 1 to 64"]),
        ("key", &format!("{good}set = [\"half_widht=1\"]"), 2, &["line 2", "--set half_widht: unknown key", "`half_width`"]),
        ("range", &format!("{good}set = [\"half_width=-1\"]"), 2, &["`procedural` with `fast`: --set half_width: invalid value -1"]),
        ("table", &format!("{good}downscale = {{ x = 1 }}"), 2, &["line 4", "invalid value { x = 1 }; expected a value of --downscale"]),
        ("flag", "[[scenes]]\ntime = \"9s\"\n[[methods]]\ncommand = \"carve\"", 2, &["line 2", "which is of `carve`", "`time`"]),
        ("both", "[[scenes]]\ndata = \"a\"\nscene_size = 32\n[[methods]]", 2, &["--scene-size <SIZE> conflicts with [DATA]"]),
        ("data", "[[scenes]]\ndata = 3\n[[methods]]", 2, &["line 2", "invalid value 3", "a folder in quotes"]),
        ("command", "[[scenes]]\n[[methods]]\ncommand = \"render\"", 2, &["line 3", "\"train\" or \"carve\""]),
        ("names", "[[scenes]]\nname = \"a/b\"\n[[methods]]", 2, &["line 2", "\"a/b\"", "letters, digits"]),
        ("twice", "[[scenes]]\n[[scenes]]\n[[methods]]", 2, &["line 2", "the name `procedural` is used twice"]),
        ("chosen", "[[scenes]]\nmethods = [\"fat\"]\n[[methods]]\npreset = \"fast\"", 2, &["line 2", "unknown method `fat`", "`fast`"]),
        (
            "published",
            &format!("{good}[[published]]\nname = \"x\"\nsource = \"y\"\npsnr = {{ }}"),
            2,
            &["line 4", "`x` has no results", "psnr = { procedural"],
        ),
        ("reduction", &format!("{good}evaluate_downscale = 0"), 2, &["line 4", "invalid value 0", "a whole number from 1 to 64"]),
        ("source", &format!("{good}[[published]]\nname = \"x\""), 3, &["line 4", "the key `source` is missing"]),
        ("figure", &format!("{good}[[published]]\npsn = 1"), 2, &["line 5", "unknown key `psn`", "`psnr`"]),
    ] {
        let error = read(name, text).unwrap_err();
        let message = error.to_string();
        assert!(parts.iter().all(|part| message.contains(part)), "{name}: {parts:?} in {message}");
        assert_eq!(error.exit_code(), code, "{name}: {message}");
    }
}

#[test]
fn too_many_runs_are_refused_before_they_are_planned() {
    let entries = |list: &str, n: usize| (0..n).map(|i| format!("[[{list}]]\nname = \"{list}{i}\"\n")).collect::<String>();
    let error = read("many", &(entries("scenes", 3000) + &entries("methods", 3000))).unwrap_err();
    let message = error.to_string();
    assert!(error.exit_code() == 2 && message.contains("3000 scenes with 3000 methods make 9000000 runs"), "{message}");
    assert!(message.contains("line 1: ") && message.contains("at most 10000;"), "{message}");
    // Each scene with few of many methods.
    let few = entries("scenes", 3).replace("]]\n", "]]\nmethods = [\"methods7\"]\n") + &entries("methods", 4000);
    assert_eq!(read("few", &few).unwrap().jobs.len(), 3);
}

#[test]
fn flags_alone_make_the_same_plan() {
    let strings = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>();
    let plan =
        Plan::from_flags(&strings(&["data/lego", "procedural"]), &strings(&["fast", "paper"]), &strings(&["seed=3"]), Path::new("o"));
    let plan = plan.unwrap();
    assert_eq!(plan.jobs.len(), 4);
    assert_eq!(plan.jobs[1].folder, PathBuf::from("o/lego/paper"));
    assert_eq!((&plan.jobs[1].call.data, &plan.jobs[2].call.data), (&Some("data/lego".into()), &None));
    assert!(plan.jobs.iter().all(|job| job.asked.config.seed == 3));
    let twice = Plan::from_flags(&strings(&["a/lego", "b/lego"]), &strings(&["fast"]), &[], Path::new("o")).unwrap_err();
    assert!(twice.to_string().starts_with("--scene: the name `lego` is used twice"), "{twice}");
}

#[test]
fn the_example_of_the_help_is_a_plan() {
    let example = super::super::EXAMPLES.lines().skip_while(|line| *line != "relative to the file. Example:").skip(1);
    let text: Vec<&str> = example.take_while(|line| !line.starts_with("Run folders are")).collect();
    let plan = read("example", &text.join("\n")).unwrap();
    assert_eq!(plan.methods, ["fast", "paper-tv", "hull"]);
    assert_eq!(plan.jobs.len(), 4);
    assert_eq!((plan.jobs[2].asked.config.downscale, plan.jobs[2].evaluate_downscale), (4, Some(8)));
}

#[test]
fn a_run_may_be_compared_at_another_size_than_it_was_made_at() {
    let plan = read(
        "size",
        "[[scenes]]\n[[methods]]\npreset = \"fast\"\ndownscale = 2\nevaluate_downscale = 1\n\
         [[methods]]\nname = \"hull\"\ncommand = \"carve\"\ndownscale = 4\nevaluate_downscale = 4\n\
         [[methods]]\nname = \"other\"\ncommand = \"carve\"\nevaluate_downscale = 8",
    )
    .unwrap();
    let found: Vec<_> = plan.jobs.iter().map(|job| (job.asked.config.downscale, job.evaluate_downscale)).collect();
    assert_eq!(found, [(2, Some(1)), (4, None), (1, Some(8))]);
    let both =
        "[[scenes]]\n[[methods]]\npreset = \"fast\"\ndownscale = 2\nevaluate_downscale = 1\ntime = \"1m\"\nincluding_evaluation = true";
    let error = read("both", both).unwrap_err().to_string();
    assert!(error.contains("evaluate_downscale") && error.contains("including_evaluation"), "{error}");
    // Training skips the evaluation, which a second command makes.
    let leaves = |job: &Job| job.call.flags.iter().any(|flag| flag.text == "--no-evaluate");
    assert_eq!(plan.jobs.iter().map(leaves).collect::<Vec<_>>(), [true, false, false]);
    assert_eq!(plan.jobs[2].evaluation()[2..], ["--json", "--downscale=8", "--keep"]);
    assert_eq!(plan.jobs[1].evaluation().len(), 3);
}

/// Plans a sweep of `benches`; `scenes`, if not empty, replace those of its file.
fn shipped(name: &str, scenes: &[&str]) -> Result<Plan> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../benches").join(name);
    let scenes: Vec<String> = scenes.iter().map(|scene| (*scene).to_owned()).collect();
    Plan::from_file(&path, &scenes, &[], Path::new("out"))
}

#[test]
fn other_scenes_take_the_place_of_those_of_a_file() {
    let plan = shipped("table1.toml", &["data/lego", "procedural"]).unwrap();
    assert_eq!((plan.scenes, plan.jobs.len()), (vec!["lego".to_owned(), "procedural".to_owned()], 8));
    // A folder is relative to the current directory, and a scene of the file keeps its keys.
    let here = std::env::current_dir().unwrap();
    assert_eq!(plan.jobs[0].call.data, Some(here.join("data/lego")));
    assert!(plan.jobs[4].asked.source.to_string().starts_with("built in, 800 x 800"), "{}", plan.jobs[4].asked.source);
    // `procedural` is the built-in scene, although the file does not have it.
    let plan = shipped("ablation.toml", &["procedural"]).unwrap();
    assert_eq!((plan.jobs.len(), &plan.jobs[0].call.data), (4, &None));
    let twice = shipped("table1.toml", &["a/lego", "b/lego"]).unwrap_err().to_string();
    assert!(twice.starts_with("--scene: ") && twice.contains("`lego`"), "{twice}");
}

#[test]
fn the_sweeps_that_are_shipped_are_plans() {
    assert_eq!(shipped("ablation.toml", &[]).unwrap().methods.len(), 4);
    // The images have 800 x 800 pixels. Carving uses 200 x 200; training and evaluation use 100 x 100.
    let sizes = |plan: &Plan| plan.jobs.iter().map(|job| (job.asked.config.downscale, job.evaluate_downscale)).collect::<Vec<_>>();
    let (trained, carved) = ((8, None), (4, Some(8)));
    let table = shipped("table1.toml", &[]).unwrap();
    assert_eq!(
        (table.methods.join(" "), sizes(&table)),
        ("plain-tv plain carve-color carve-sh".to_owned(), vec![trained, trained, carved, carved])
    );
    let figure = shipped("figure8.toml", &[]).unwrap();
    assert_eq!((figure.methods.join(" "), sizes(&figure)), ("grid carved carved-sh".to_owned(), vec![trained, carved, carved]));
    for job in table.jobs.iter().chain(&figure.jobs) {
        assert!(job.asked.source.to_string().starts_with("built in, 800 x 800"), "{}", job.asked.source);
    }
    // The published figures have the published means and deviations.
    let summaries = [(22.10, 1.41), (22.10, 1.41), (21.28, 1.65), (22.90, 2.24)];
    assert_eq!(table.published.len(), summaries.len());
    for (published, (mean, deviation)) in table.published.iter().zip(summaries) {
        let psnr: Vec<f64> = published.psnr.values().copied().collect();
        let found = (figures::mean(&psnr), figures::deviation(&psnr));
        assert!(psnr.len() == 8 && (found.0 - mean).abs() < 0.006 && (found.1 - deviation).abs() < 0.016, "{}: {found:?}", published.name);
    }
}

#[test]
fn a_plan_by_time_is_compared_by_its_settings_before() {
    let text = "[[scenes]]\nscene_size = 32\n[[methods]]\npreset = \"quality\"\ntime = \"9s\"\n";
    let mut job = read("planned", text).unwrap().jobs.remove(0);
    job.folder = std::env::temp_dir().join(format!("plenoxel-sweep-{}-planned", std::process::id()));
    let mut planned = job.asked.config.clone();
    planned.tensorf.as_mut().expect("a factored field").stages.iter_mut().for_each(|stage| stage.steps += 17);
    let mut record = RunRecord {
        model: "tensorf".to_owned(),
        seconds_planned: Some(9.0),
        asked: Some(values(&job.asked.config)),
        ..RunRecord::of_scene(RunKind::Trained, "procedural", "built in", &job.asked.source)
    };
    let state = |record: &RunRecord| {
        std::fs::create_dir_all(&job.folder).unwrap();
        RunFolder::at(&job.folder).describe(&planned, record).unwrap();
        let state = job.state();
        std::fs::remove_dir_all(&job.folder).unwrap();
        state
    };
    assert_eq!(state(&record), State::CutShort);
    record.asked.as_mut().unwrap().insert("seed".to_owned(), "43".to_owned());
    assert!(matches!(state(&record), State::Different(found) if found.contains("seed")));
    record.with_evaluation = true;
    assert!(matches!(state(&record), State::Different(found) if found.contains("its time includes evaluation")));
    record.with_evaluation = false;
    record.asked = None;
    assert!(matches!(state(&record), State::Different(found) if found.contains("earlier version")));
    for (seconds, part) in [(Some(10.0), "10 s, not 9 s"), (None, "not planned by time")] {
        record.seconds_planned = seconds;
        assert!(matches!(state(&record), State::Different(found) if found.contains(part)));
    }
}
