//! `plenoxel evaluate`: PSNR and SSIM of a run on the views of a split.

use super::new_run::load;
use super::panels::Panels;
use super::trained_run::{Found, Loaded, TrainedRun};
use super::whole;
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
  plenoxel evaluate runs/lego                      at the image size of the training
  plenoxel evaluate runs/lego --downscale 1        at the full image size
  plenoxel evaluate runs/lego --split val --json
  plenoxel evaluate runs/lego --out lego.json
  plenoxel evaluate runs/carved --downscale 8 --keep    keep the scores at another image size

The test scores of a carved run, or of a run trained with --no-evaluate, are also written to evaluation.json in its folder, with panels of up to 25 \
test views. With --downscale, this needs --keep.

--samples N places N samples on the longest ray through the box, and samples of the same spacing on shorter rays. In runs of the paper preset, \
every ray has N samples between the camera and the far limit.

PSNR and SSIM are means over views. If stdout is not a terminal, its last line is a JSON object with the scores and their definitions: clamping, \
rounding, padding, background and image size. LPIPS is not computed.";

/// Compute PSNR and SSIM of a run on the views of a split
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct EvaluateArgs {
    #[command(flatten)]
    run: TrainedRun,

    /// Evaluate N evenly spaced views of the split instead of all of them. The scores are then not written to the run folder
    #[arg(long, alias = "test-views", value_name = "N", help_heading = "Scene", value_parser = whole::<usize>(1, usize::MAX as u64), conflicts_with = "keep", allow_negative_numbers = true)]
    views: Option<usize>,

    /// Print only the JSON object
    #[arg(long, help_heading = "Output")]
    json: bool,

    /// Write the scores to the run folder, with panels of test views, although --downscale is given; tables, reports and comparisons show them.
    /// Only for carved runs and runs trained with --no-evaluate
    #[arg(long, help_heading = "Output", conflicts_with_all = ["best", "samples"])]
    keep: bool,

    /// Also write the JSON object to this file, replacing an existing file
    #[arg(long, short, value_name = "FILE", help_heading = "Output", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
}

/// Evaluates a run.
pub fn run(args: &EvaluateArgs, console: &Console<'_>) -> Result<()> {
    let start = Instant::now();
    let found = args.run.find()?;
    let trained = found.folder.result()?.unwrap_or(Value::Null);
    // A carved run and one trained with --no-evaluate have no test scores. An unfinished run has none either, but is not compared.
    let lacks_scores = trained.is_object() && !trained["psnr"].is_number();
    if args.keep {
        check_keep(args.run.split, lacks_scores)?;
    }
    let dataset = args.run.views(&found)?;
    let most = args.views.unwrap_or(usize::MAX);
    args.out.iter().try_for_each(|out| super::check_replaceable(out, &[&found.folder], found.source.path()))?;
    let Loaded { model, about, view } = args.run.of.load(&found, console, |sampling, stored| {
        Estimate::of_evaluation(&found.config, sampling, stored, Some((&dataset, args.run.split, most)))
    })?;
    let Found { folder, config, preset, source, .. } = found;
    // Another scene is an error only with --keep, because a folder may have been renamed.
    let same_scene = about.scene == dataset.name();
    if !same_scene && args.keep {
        let found = format!("the run was trained on another scene: {}, not {}", about.scene, dataset.name());
        return Err(Error::usage("--keep", found, "evaluate the views of its scene, or leave out --keep"));
    }
    let keeps = (args.keep || args.run.is_as_trained()) && args.views.is_none() && same_scene && lacks_scores;
    // The lock is held until the panels and the scores are written.
    let folder = if keeps { folder.shared("RUN")? } else { folder };
    let views = load(console, &dataset, args.run.split, most, &source)?;
    let seconds_load = start.elapsed().as_secs_f64();
    if !same_scene {
        console.note(&format!("the run was trained on another scene: {}, not {}", about.scene, dataset.name()));
    }

    let start = Instant::now();
    let viewer = Viewer::of(&*model, &view);
    let count = console.count("evaluating", views.len());
    // A run without pictures gets no panels.
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
    // The time and rays of the best grid are not known.
    let of_last = |key: &str| if args.run.of.best { None } else { trained.get(key) };
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
    // Printed first, so that the scores are not lost if the file cannot be written.
    if json { console.result(&line) } else { console.record(&evaluation) }?;
    let file = args.out.iter().filter(|file| !is_stdout(file));
    file.into_iter().try_for_each(|file| console.write_file(file, (line.clone() + "\n").as_bytes()))?;
    if keeps {
        folder.write_evaluation(&evaluation)?;
        console.note("the scores were written to evaluation.json in the run folder; `plenoxel compare` and `plenoxel report` show them");
    }
    Ok(())
}

/// Checks that --keep is given for the test views of a run without test scores.
fn check_keep(split: Split, lacks_scores: bool) -> Result<()> {
    if split != Split::Test {
        return Err(Error::usage(
            "--keep",
            format!("the scores of the {split} views cannot be kept"),
            "evaluate the test views, or use --out FILE instead of --keep",
        ));
    }
    if !lacks_scores {
        return Err(Error::usage(
            "--keep",
            "the run has test scores from its training, or has not ended",
            "use --out FILE instead, because --keep is for carved runs and runs trained with --no-evaluate",
        ));
    }
    Ok(())
}

/// The JSON object of `evaluate`. `seconds` is the training time recorded by the run.
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
