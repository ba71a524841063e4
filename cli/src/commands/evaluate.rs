//! `plenoxel evaluate`: figures of a trained run on the views of a split.

use super::new_run::load;
use super::panels::Panels;
use super::trained_run::{Found, Loaded, TrainedRun};
use crate::progress::{Console, is_stdout};
use clap::{Args, ValueHint};
use plenoxel::dataset::Split;
use plenoxel::error::{Error, Result};
use plenoxel::evaluate::{ViewScore, Viewer};
use plenoxel::json;
use plenoxel::run::figures::Figures;
use plenoxel::run::memory::{self, Estimate};
use serde::Serialize;
use serde_json::Value;
use std::path::PathBuf;
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  plenoxel evaluate runs/lego                      at the resolution it was trained at
  plenoxel evaluate runs/lego --downscale 1        at full resolution
  plenoxel evaluate runs/lego --split val --json
  plenoxel evaluate runs/lego --out lego.json
  plenoxel evaluate runs/carved --downscale 8 --keep    carved at 200 x 200, compared at 100 x 100

The figures of a carved run on its test views are kept in its folder, as evaluation.json, with pictures of up to 25 of these views; those of a run that \
was trained with --no-evaluate are too. With another --downscale than in training or carving they are kept only if --keep says so.

--samples N places N samples on the longest line through the box, and as densely on shorter ones. Runs of the paper preset \
count samples from the camera to its far limit instead.

PSNR and SSIM are means over views. The last line on stdout, where it is no terminal, is one JSON object, which says how each figure is computed: what is \
clamped, rounded and padded, over which background, at which size. LPIPS is not computed.";

/// Compute PSNR and SSIM of a trained run on the views of a split
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct EvaluateArgs {
    #[command(flatten)]
    run: TrainedRun,

    /// Print the JSON object alone
    #[arg(long, help_heading = "Output")]
    json: bool,

    /// Keep the figures and pictures in the run's folder as those of its test views, at the size of --downscale: tables, pages and comparisons show
    /// them. For carved runs, and those trained with --no-evaluate
    #[arg(long, help_heading = "Output", conflicts_with_all = ["best", "samples"])]
    keep: bool,

    /// Write the JSON object to this file too, replacing what is there
    #[arg(long, short, value_name = "FILE", help_heading = "Output", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
}

/// Evaluates a run.
pub fn run(args: &EvaluateArgs, console: &Console<'_>) -> Result<()> {
    let start = Instant::now();
    let found = args.run.find()?;
    let trained = found.folder.result()?.unwrap_or(Value::Null);
    // A carved run has no figures of its own, nor has one that was trained with --no-evaluate. One that did not end well has none either, and is no run
    // to compare.
    let lacks_figures = trained.is_object() && !trained["psnr"].is_number();
    if args.keep {
        check_keeps(args, lacks_figures)?;
    }
    let dataset = args.run.views(&found)?;
    args.out.iter().try_for_each(|out| super::check_replaceable(out, &[&found.folder], found.source.path()))?;
    let Loaded { model, about, view } = args.run.load(&found, console, |sampling, shape, voxels| {
        Estimate::of_evaluation(&found.config, sampling, shape, voxels, Some((&dataset, args.run.split)))
    })?;
    let Found { folder, config, preset, source } = found;
    // A folder may have another name by now: no error, unless its figures are to be kept.
    let same_scene = about.scene == dataset.name();
    if !same_scene && args.keep {
        let found = format!("the views are of {}, and the run is of {}", dataset.name(), about.scene);
        return Err(Error::config("--keep", found, "the views of the run's own scene"));
    }
    let keeps = (args.keep || args.run.is_as_trained()) && same_scene && lacks_figures;
    // Nobody trains or carves into it before its pictures and figures are written.
    let folder = if keeps { folder.shared("RUN")? } else { folder };
    let views = load(console, &dataset, args.run.split, &source)?;
    let seconds_load = start.elapsed().as_secs_f64();
    if !same_scene {
        console.note(&format!("the run is of another scene: {}, not {}", about.scene, dataset.name()));
    }

    let start = Instant::now();
    let viewer = Viewer::of(&*model, &view);
    let count = console.count("evaluating", views.len());
    // A run without pictures stays without.
    let panels = Panels::new(&folder, views.len(), keeps && folder.image("").is_dir());
    let aabb = model.aabb();
    let half_width = 0.5 * (aabb.max - aabb.min).max_element();
    let scores = viewer.compare(&views, |i, view, target, picture| {
        console.drawn(panels.draw(i, view, target, picture, half_width));
        count.at(i + 1, views.len());
        Ok(())
    })?;
    drop(count);
    panels.note().into_iter().for_each(|note| console.note(&note));

    let figures = Figures::new(&scores, args.run.split, &dataset, &config, &*model, &view);
    let json = args.json || args.out.as_deref().is_some_and(is_stdout);
    if !json {
        for view in &scores.per_view {
            let ssim = view.ssim.map_or("-".to_owned(), |ssim| format!("{ssim:.4}"));
            console.result(&format!("{:24} {:7.2} dB  ssim {ssim}", view.name, view.psnr))?;
        }
        console.result(&figures.sentence())?;
    }
    // An earlier grid took less.
    let of_last = |key: &str| if args.run.best { None } else { trained.get(key) };
    let evaluation = Evaluation {
        figures,
        seconds: of_last("seconds").and_then(Value::as_f64),
        seconds_load,
        seconds_evaluate: start.elapsed().as_secs_f64(),
        peak_memory_bytes: memory::peak(),
        steps: about.step,
        rays: of_last("rays").and_then(Value::as_u64),
        scene: about.scene,
        preset,
        run: folder.path().display().to_string(),
        per_view: scores.per_view,
    };
    let line = json::line(&evaluation)?;
    // Printed first, so that a file that cannot be written takes nothing with it.
    if json { console.result(&line) } else { console.record(&evaluation) }?;
    let file = args.out.iter().filter(|file| !is_stdout(file));
    file.into_iter().try_for_each(|file| console.write_file(file, (line.clone() + "\n").as_bytes()))?;
    if keeps {
        folder.write_evaluation(&evaluation)?;
        console.note(
            "kept in the run's folder: `plenoxel compare` shows these figures, and so does `plenoxel report`, which writes the page again",
        );
    }
    Ok(())
}

/// Refuses to keep figures that are not those of a run's test views, or of a run that has such figures.
fn check_keeps(args: &EvaluateArgs, lacks_figures: bool) -> Result<()> {
    if args.run.split != Split::Test {
        return Err(Error::config("--keep", format!("figures of the {} views are not kept", args.run.split), "the test views"));
    }
    if !lacks_figures {
        let found = "the run has figures of its test views from its training, or has not ended";
        return Err(Error::config("--keep", found, "a carved run, or one that was trained with --no-evaluate; --out FILE for any other"));
    }
    Ok(())
}

/// What `evaluate` prints last. `seconds` is the training time that the run remembers.
#[derive(Debug, Serialize)]
struct Evaluation {
    #[serde(flatten)]
    figures: Figures,
    seconds: Option<f64>,
    seconds_load: f64,
    seconds_evaluate: f64,
    peak_memory_bytes: Option<u64>,
    steps: u64,
    rays: Option<u64>,
    scene: String,
    preset: Option<String>,
    run: String,
    per_view: Vec<ViewScore>,
}
