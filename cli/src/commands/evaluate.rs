//! `plenoxel evaluate`: figures of a trained run on the views of a split.

use super::new_run::load;
use super::trained_run::{Opened, TrainedRun};
use crate::evaluation::{Scores, ViewScore, Viewer};
use crate::memory;
use crate::progress::Console;
use clap::Args;
use plenoxel::dataset::Split;
use plenoxel::error::Result;
use serde::Serialize;
use serde_json::{Value, json};
use std::time::Instant;

const EXAMPLES: &str = "\
Examples:
  plenoxel evaluate runs/lego                      at the resolution it was trained at
  plenoxel evaluate runs/lego --downscale 1        at full resolution
  plenoxel evaluate runs/lego --split val --json

--samples N places N samples on the longest line through the box, and as densely on shorter ones. Runs of the paper preset
count samples from the camera to its far limit instead.

PSNR and SSIM are means over views; predictions are clamped to [0, 1] and not rounded to 8 bits. ssim counts windows that
lie inside the image, ssim_same pads with zeros as svox2 does. The last line on stdout is one JSON object.";

/// Compute PSNR and SSIM of a trained run on the views of a split
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct EvaluateArgs {
    #[command(flatten)]
    run: TrainedRun,

    /// Print the JSON object alone
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Evaluates a run.
pub fn run(args: &EvaluateArgs, console: &Console<'_>) -> Result<()> {
    let start = Instant::now();
    let Opened { folder, config, preset, source, dataset, sampling, grid, header } = args.run.open(console, true)?;
    let views = load(console, &dataset, args.run.split, &source)?;
    let seconds_load = start.elapsed().as_secs_f64();
    // A folder may have another name by now: no error.
    if header.scene != dataset.name() {
        console.note(&format!("the grid is of another scene: {}, not {}", header.scene, dataset.name()));
    }

    let start = Instant::now();
    let viewer = Viewer::new(&grid, sampling, &config);
    let count = console.count("evaluating", views.len());
    let scores = viewer.compare(&views, |i, _, _, _| {
        count.at(i + 1, views.len());
        Ok(())
    })?;
    drop(count);

    let (width, height) = dataset.size();
    if !args.json {
        for view in &scores.per_view {
            let ssim = view.ssim.map_or("-".to_owned(), |ssim| format!("{ssim:.4}"));
            console.result(&format!("{:24} {:7.2} dB  ssim {ssim}", view.name, view.psnr))?;
        }
        console.result(&sentence(&scores, args.run.split, width, height))?;
    }
    let trained = folder.result().unwrap_or(Value::Null);
    let figures = Figures {
        psnr: scores.psnr(),
        ssim: scores.ssim(),
        ssim_same: scores.ssim_same(),
        split: args.run.split.to_string(),
        views: views.len(),
        width,
        height,
        background: config.background,
        sampling: json!(sampling),
        seconds: trained["seconds"].as_f64(),
        seconds_load,
        seconds_evaluate: start.elapsed().as_secs_f64(),
        peak_memory_bytes: memory::peak(),
        steps: header.step,
        rays: trained["rays"].as_u64(),
        resolution: header.resolution,
        scene: header.scene,
        preset,
        run: folder.path().display().to_string(),
        per_view: scores.per_view,
    };
    console.result(&crate::json_line(&figures)?)
}

/// The figures as people say them.
pub fn sentence(scores: &Scores, split: Split, width: usize, height: usize) -> String {
    let Some(psnr) = scores.psnr() else {
        return format!("no {split} views to evaluate on");
    };
    let ssim = match scores.ssim() {
        Some(ssim) => format!(", SSIM {ssim:.4}"),
        None => String::new(),
    };
    let views = scores.per_view.len();
    format!("PSNR {psnr:.2} dB{ssim}: means over {views} {split} views of {width} x {height}")
}

/// What `evaluate` prints last. `seconds` is the training time that the run remembers.
#[derive(Debug, Serialize)]
struct Figures {
    psnr: Option<f64>,
    ssim: Option<f64>,
    ssim_same: Option<f64>,
    split: String,
    views: usize,
    width: usize,
    height: usize,
    background: [f32; 3],
    sampling: Value,
    seconds: Option<f64>,
    seconds_load: f64,
    seconds_evaluate: f64,
    peak_memory_bytes: Option<u64>,
    steps: u64,
    rays: Option<u64>,
    resolution: usize,
    scene: String,
    preset: Option<String>,
    run: String,
    per_view: Vec<ViewScore>,
}
