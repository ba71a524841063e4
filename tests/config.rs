//! Settings: presets, and runs that their config.toml repeats; values at the edges of what is accepted.

use crate::command;
use command::{Answer, Folder};
use plenoxel::model::plenoxels::config::{ColorKind, Config, Hull, Initial, OptimizerConfig, Sampling, Weight};
use std::fs;

/// The commands of this file run side by side in one process, where they share one limit of memory.
fn plenoxel(args: &[&str]) -> Answer {
    command::plenoxel(&[args, &["--max-memory", "400MB", "--quiet"]].concat())
}

const PRESETS: [&str; 12] =
    ["fast", "quality", "photos", "voxels", "tensorf", "dvgo", "ngp", "nerf", "plenoxels", "paper", "demo", "carve"];

/// Assignments that keep all that a preset does and make it small: grids, steps and rays.
fn shortened(preset: &str) -> Vec<String> {
    let resolved = plenoxel(&["presets", preset, "--resolved"]).done();
    let count = |start: &str| resolved.lines().filter(|line| *line == start).count();
    let of = |list: &str, count: usize, steps: usize| {
        let stage = move |i: usize| (format!("{list}[{i}]"), 6 + 4 * i);
        let each = move |i| {
            let (stage, resolution) = stage(i);
            [format!("{stage}.resolution={resolution}"), format!("{stage}.steps={steps}")]
        };
        (0..count).flat_map(each).collect::<Vec<_>>()
    };
    let mut all = of("stages", count("[[stages]]"), 12);
    all.extend(of("scout.stages", count("[[scout.stages]]"), 25));
    let of_field = count("[[tensorf.stages]]");
    all.extend(of("tensorf.stages", of_field, 12));
    all.extend((0..of_field).map(|i| format!("tensorf.stages[{i}].rays=200")));
    all.push("carve.resolution=20".to_owned());
    let of_fine = count("[[dvgo.fine]]");
    all.extend(of("dvgo.fine", of_fine, 12));
    all.extend((0..of_fine).map(|i| format!("dvgo.fine[{i}].rays=200")));
    // So few steps make little opaque.
    let others = [
        ("[dvgo]", &["dvgo.coarse={resolution=12, steps=40, rays=200}", "dvgo.coarse_opacity=1e-2", "dvgo.occupied_above=1e-4"][..]),
        ("[ngp]", &["ngp.stages=[{steps=12, rays=200}]", "ngp.log2_rows=8", "ngp.cells=16", "ngp.refresh_all_until=4"]),
        ("[nerf]", &["nerf.steps=4", "nerf.rays=50", "nerf.width=16", "nerf.decay_steps=4"]),
    ];
    let others: Vec<_> = others.into_iter().filter(|(table, _)| count(table) > 0).collect();
    if of_field == 0 && others.is_empty() {
        all.push("rays_per_step=200".to_owned());
    }
    let shorter = others.into_iter().flat_map(|(_, settings)| settings);
    all.extend(shorter.map(|setting| (*setting).to_owned()));
    all
}

/// A run that is repeated as its config.toml says: the same grid, the same settings, bit by bit.
fn is_repeated_by_its_settings(folder: &Folder, name: &str, args: &[&str], settings: &[String]) -> String {
    let [first, second] = ["first", "second"].map(|run| folder.path(&format!("{name}-{run}")));
    let settings = settings.iter().flat_map(|assignment| ["--set", assignment]);
    plenoxel(&args.iter().copied().chain(settings).chain(["--no-images", "--no-report", "--out", &first]).collect::<Vec<_>>()).done();
    let config = format!("{first}/config.toml");
    let text = fs::read_to_string(&config).unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix("# plenoxel ")).unwrap().replace("THIS_FILE", &config);
    let line: Vec<&str> = line.split_whitespace().chain(["--no-images", "--no-report", "--threads", "1", "--out", &second]).collect();
    plenoxel(&line).done();
    for file in ["checkpoint.safetensors", "config.toml"] {
        let [a, b] = [&first, &second].map(|run| fs::read(format!("{run}/{file}")).unwrap());
        assert!(a == b, "{name}: another {file}");
    }
    text
}

#[test]
fn the_settings_of_a_run_of_each_preset_repeat_it_to_the_bit() {
    let folder = Folder::new("presets");
    let scene = folder.path("scene");
    plenoxel(&["scene", &scene, "--size", "24", "--train", "6", "--val", "0", "--test", "1"]).done();
    for preset in PRESETS {
        let args = if preset == "carve" {
            vec!["carve", &scene]
        } else {
            vec!["train", "--scene-size=24", "--scene-views=6,0,1", "--preset", preset]
        };
        let settings = shortened(preset);
        let text = is_repeated_by_its_settings(&folder, preset, &args, &settings);
        let resolved = plenoxel(&["presets", preset, "--resolved"]).done();
        // What was not shortened is the preset's own.
        let own = resolved.lines().filter(|line| !line.starts_with('#'));
        let short = [
            "resolution",
            "steps",
            "epochs",
            "rays_per_step",
            "rays",
            "coarse_opacity",
            "occupied_above",
            "log2_rows",
            "cells",
            "refresh_all_until",
            "width",
            "decay_steps",
        ];
        for line in own.filter(|line| !short.iter().any(|key| line.starts_with(key))) {
            assert!(text.contains(line), "{preset}: {line}");
        }
    }
    // Without silhouettes these have a scout, and aim at what it found.
    for preset in ["fast", "voxels"] {
        let args = ["train", "--scene-size=24", "--scene-views=6,0,1", "--preset", preset, "--hull", "off"];
        let mut settings = shortened(preset);
        // So few steps at the preset's rates would leave nothing.
        settings.extend(["scout.prune_unseen_below=0.01".to_owned(), "scout.stages[*].density_rate=0.5".to_owned()]);
        is_repeated_by_its_settings(&folder, &format!("{preset}-scout"), &args, &settings);
    }
    // A loss of the defaults that a run does without, and carving by colors.
    let settings = [&shortened("fast")[..], &["losses.mse=".to_owned(), "losses.huber=1".to_owned()]].concat();
    is_repeated_by_its_settings(&folder, "huber", &["train", &scene], &settings);
    is_repeated_by_its_settings(&folder, "photo", &["carve", &scene, "--photo-consistency", "--sh-degree=1"], &shortened("carve"));
}

#[test]
fn presets_are_listed_printed_and_resolved() {
    let list = plenoxel(&["presets"]).done();
    assert_eq!(list.lines().count(), 1 + PRESETS.len(), "{list}");
    for (line, preset) in list.lines().skip(1).zip(PRESETS) {
        assert!(line.starts_with(preset) && line.len() <= 120, "{line}");
        let file = if preset == "tensorf" { "quality" } else { preset };
        let file = fs::read_to_string(format!("plenoxel/presets/{file}.toml")).unwrap();
        assert_eq!(plenoxel(&["presets", preset]).done().trim_end(), file.trim_end());
        // Its own switch says what alpha decides.
        let resolved = plenoxel(&["presets", preset, "--resolved"]).done();
        let alpha = if preset == "carve" {
            "the shape"
        } else if resolved.contains("hull = \"auto\"") {
            "box and voxels"
        } else {
            "nothing"
        };
        assert!(line.contains(alpha), "{line}");
    }
    plenoxel(&["presets", "best"]).refused(2, &["best", "demo", "paper"]);
    plenoxel(&["presets", "--resolved"]).refused(2, &["<NAME>"]);
}

#[test]
fn settings_at_the_edge_of_what_is_accepted_train_or_end_with_a_reason() {
    let folder = Folder::new("edges");
    let out = folder.path("run");
    let train = |settings: &[&str]| {
        let stage = "stages=[{resolution=4, steps=2, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]";
        let start = ["train", "--preset=demo", "--scene-size=8", "--scene-views=3,0,1", "--no-images", "--force", "--out", &out];
        let settings = [&[stage, "rays_per_step=64"], settings].concat();
        plenoxel(&start.into_iter().chain(settings.iter().flat_map(|assignment| ["--set", assignment])).collect::<Vec<_>>())
    };
    // Those that work, however little comes of them.
    for settings in [
        &["half_width=1e-9"][..],
        &["half_width=1e9"],
        &["seed=9223372036854775807", "validation_every=9223372036854775807"],
        &["initial.density=0", "initial.color=0"],
        &["stages[0].epochs=1e-300", "stages[0].density_warm_up=9223372036854775807"],
        &["stages[0].density_rate=0", "stages[0].color_rate=1e-30"],
        &["stages[0].resolution=2", "sh_reduction=64", "sh_degree=3"],
        &["stages[0].image_reduction=64", "prune_from_stage=9223372036854775807"],
        &["stages[0].sampling={samples=2, far=1e6}", "evaluation={samples=2, far=1e-6}"],
        &["stages[0].sampling.step=100", "evaluation.step=100"],
        &["losses.beta={weight=1e-30, until=9223372036854775807}", "losses.sparsity={from=1e-30, to=1e-30, steps=9223372036854775807}"],
        &["stop_below=0.999999", "losses.mse=0", "optimizer.epsilon=1e30"],
    ] {
        let answer = train(settings);
        assert_eq!(answer.code, 0, "{settings:?}: {}", answer.err);
    }
    // Those that come to nothing, or leave the numbers, or the memory.
    for (code, key, settings) in [
        (4, "prune_below", &["prune_from_stage=0", "prune_below=1e12"][..]),
        (4, "prune_unseen_below", &["prune_from_stage=0", "prune_unseen_below=1"]),
        (4, "rates", &["stages[0].color_rate=1e30", "optimizer={kind=\"sgd\"}", "losses.mse=1e12"]),
        (2, "stages[0].resolution", &["stages[0].resolution=1024"]),
        (2, "rays_per_step", &["rays_per_step=4194304"]),
        (2, "evaluation", &["evaluation.step=0.01", "stages[0].resolution=64"]),
        (2, "losses", &["losses={}", "losses.mse="]),
        (2, "stages", &["stages=[]"]),
        (2, "init_from", &["init_from=\"\""]),
        (2, "stages[0] to stages[0]", &["stages[18446744073709551615].steps=1"]),
        (2, "downscale", &["downscale=64"]),
    ] {
        train(settings).refused(code, &[key]);
    }
    // A file without end is not read to its end.
    if fs::exists("/dev/zero").unwrap() {
        plenoxel(&["train", "--config", "/dev/zero"]).refused(3, &["a TOML file may have at most 1 MB"]);
    }
}

#[test]
fn completions_and_manual_pages_come_from_the_same_definitions() {
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let script = plenoxel(&["completions", shell]).done();
        assert!(script.contains("sh-reduction") && script.contains("plenoxels"), "{shell}");
    }
    plenoxel(&["completions", "csh"]).refused(2, &["csh", "zsh"]);
    let folder = Folder::new("man");
    let (pages, file) = (folder.path("man1"), folder.path("file"));
    let page = plenoxel(&["man"]).done();
    assert!(page.contains(".SH EXAMPLES") && page.contains("plenoxel\\-train(1)"), "{page}");
    assert!(plenoxel(&["man", &pages]).done().contains("pages to "));
    let read = |name: &str| fs::read_to_string(format!("{pages}/{name}.1")).unwrap();
    assert_eq!(read("plenoxel").trim_end(), page.trim_end());
    assert!(read("plenoxel-train").contains("sh\\-reduction") && read("plenoxel-export-vox").contains("solid"));
    fs::write(&file, "x").unwrap();
    plenoxel(&["man", &file]).refused(5, &["file"]);
}

#[test]
fn figures_say_what_they_are_of_and_how_they_are_computed() {
    let folder = Folder::new("figures");
    let (run, file) = (folder.path("run"), folder.path("figures.json"));
    let settings: Vec<String> = shortened("demo").into_iter().flat_map(|assignment| ["--set".to_owned(), assignment]).collect();
    let settings: Vec<&str> = settings.iter().map(String::as_str).collect();
    let start = ["train", "--preset=demo", "--scene-size=48x24", "--scene-views=6,1,3", "--no-images", "--downscale=2", "--out", &run];
    let trained = plenoxel(&[&start, &settings[..]].concat()).json();
    let evaluated = plenoxel(&["evaluate", &run, "--out", &file, "--split", "test"]).json();
    let written: serde_json::Value = serde_json::from_str(&fs::read_to_string(&file).unwrap()).unwrap();
    assert_eq!(written, evaluated);
    for key in
        ["psnr", "psnr_of_mean_mse", "ssim", "ssim_same", "lpips", "image", "grid", "dataset", "sampling", "definitions", "split", "views"]
    {
        assert_eq!(trained[key], evaluated[key], "{key}");
        assert!(!trained[key].is_null(), "{key}");
    }
    assert_eq!(evaluated["image"], serde_json::json!({ "width": 24, "height": 12, "downscale": 2 }));
    assert_eq!(evaluated["dataset"], serde_json::json!({ "train": 6, "val": 1, "test": 3 }));
    assert!(evaluated["grid"]["voxels_per_axis"] == 18 && evaluated["grid"]["voxels_stored"].as_u64() <= Some(18 * 18 * 18));
    assert!(evaluated["lpips"]["computed"] == false && evaluated["lpips"]["why"].is_string());
    // The two ways to average, from the errors of the views.
    let per_view = evaluated["per_view"].as_array().unwrap();
    let errors: Vec<f64> = per_view.iter().map(|view| view["mse"].as_f64().unwrap()).collect();
    let decibels = |mse: f64| -10.0 * mse.log10();
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / 3.0;
    let close = |key: &str, want: f64| assert!((evaluated[key].as_f64().unwrap() - want).abs() < 1e-9, "{key}: {want}");
    close("psnr_of_mean_mse", decibels(mean(errors.clone())));
    close("psnr", mean(errors.into_iter().map(decibels).collect()));
    assert!(evaluated["psnr_of_mean_mse"].as_f64() < evaluated["psnr"].as_f64());
    // What cannot be written is on stdout all the same.
    let answer = plenoxel(&["evaluate", &run, "--json", "--out", &folder.path("none/a.json")]);
    assert!(answer.code == 5 && answer.err.contains("a.json") && answer.out.starts_with("{\"psnr\":"), "{}{}", answer.out, answer.err);
}

#[test]
fn the_preset_paper_is_the_plain_grid_of_the_source_paper() {
    let config = Config::preset("paper").unwrap();
    let far = 10.0 / 1.2;
    let stages: Vec<_> = config.stages.iter().map(|s| (s.resolution, s.epochs, s.sampling, s.density_rate, s.color_rate)).collect();
    let stage = |resolution, epochs, samples| (resolution, Some(epochs), Sampling::Points { samples, far }, 1000.0, 1000.0);
    assert_eq!(stages, [stage(16, 2.0, 50), stage(32, 4.0, 100), stage(64, 8.0, 200), stage(128, 8.0, 200)]);
    assert!(config.stages.iter().all(|s| s.steps.is_none() && s.image_reduction == 1 && s.rate_decay == 1.0 && s.density_warm_up == 0));
    // Squares summed over three channels, and no total variation, as in its program.
    assert_eq!(config.losses.iter().collect::<Vec<_>>(), [(&"mse".to_owned(), &Weight::Constant(3.0))]);
    assert_eq!((config.optimizer, config.rays_per_step), (OptimizerConfig::Sgd, 5000));
    assert_eq!(config.initial, Initial { random: true, density: 1.0, color: 1.0 });
    assert_eq!((config.downscale, config.half_width, config.color), (8, 1.4, ColorKind::Rgb));
    assert!(config.project && config.jitter && config.hull == Hull::Off && config.scout.is_none());
}

#[test]
fn the_preset_plenoxels_is_svox2_for_synthetic_scenes() {
    let config = Config::preset("plenoxels").unwrap();
    let stages: Vec<_> = config.stages.iter().map(|s| (s.resolution, s.steps, s.sampling, s.density_warm_up)).collect();
    let half_voxels = Sampling::Step { step: 0.5 };
    assert_eq!(stages, [(256, Some(38_400), half_voxels, 15_000), (512, Some(89_600), half_voxels, 0)]);
    // Ten epochs of 12 800 batches of 5000 rays.
    assert_eq!((stages.iter().filter_map(|s| s.1).sum::<u64>(), config.rays_per_step), (128_000, 5000));
    // Its scene is 2/3 as large: densities are 2/3 of its 0.1, and what acts against a gradient by a density is 3/2.
    assert!((config.initial.density * 1.5 - 0.1).abs() < 1e-4 && config.initial.color == 0.0 && !config.initial.random);
    assert_eq!((config.half_width, config.downscale, config.jitter, config.project), (1.5, 1, false, false));
    assert_eq!(config.optimizer, OptimizerConfig::RmsProp { beta: 0.95, epsilon: 1e-8 });
    let until = |weight| Weight::Until { weight, until: 38_400 };
    let losses: Vec<_> = config.losses.iter().map(|(name, weight)| (name.as_str(), *weight)).collect();
    // 1e-5 · 3/2, and 1e-3 for the sum over 27 numbers of which ours is the mean.
    assert_eq!(losses, [("mse", Weight::Constant(1.0)), ("tv_color_sampled", until(0.027)), ("tv_density_sampled", until(1.5e-5))]);
    assert_eq!((config.color, config.sh_degree, config.sh_offset, config.sh_reduction), (ColorKind::Sh, 2, 0.5, 1));
    assert_eq!(
        (config.stop_below, config.prune_from_stage, config.prune_below, config.prune_unseen_below),
        (1e-7, Some(1), 0.0, 0.256 / 512.0)
    );
    assert!(config.hull == Hull::Off && !config.aim && config.scout.is_none());
}
