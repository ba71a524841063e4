//! `plenoxel render`: pictures of a trained run from the cameras of its views.

use crate::data::DataSource;
use crate::evaluation::{Viewer, with_samples};
use crate::images::{self, DepthRange};
use crate::memory::Estimate;
use crate::progress::Console;
use crate::run_folder::RunFolder;
use clap::{Args, ValueHint};
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::{Error, Result};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  plenoxel render runs/lego                        all test views
  plenoxel render runs/lego --view 0 --view r_17   two of them, by number and by name
  plenoxel render runs/lego --split train --downscale 4

Writes RUN/renders/<split>_<number>_<name>.png with the colors over the run's background, and the same with _depth
(red near, blue far, white empty) and _opacity.";

/// Render the views of a trained run to PNG files
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct RenderArgs {
    /// Run folder that `plenoxel train` wrote
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// Where the dataset is now [default: where it was when training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Views whose cameras are used
    #[arg(long, help_heading = "Scene", default_value_t = Split::Test, value_parser = super::split)]
    split: Split,

    /// Render this view only, by number from 0 or by name; may be repeated
    #[arg(long, value_name = "N|NAME", help_heading = "Scene")]
    view: Vec<String>,

    /// Reduce the pictures by this factor [default: as in training]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = super::factor)]
    downscale: Option<usize>,

    /// Samples on the longest ray, as for evaluate [default: as the run's `evaluation` setting says]
    #[arg(long, value_name = "N", help_heading = "Rendering", value_parser = clap::value_parser!(u32).range(2..=100_000))]
    samples: Option<u32>,
}

/// Renders views of a run.
pub fn run(args: &RenderArgs, console: &Console<'_>) -> Result<()> {
    let (folder, mut config, record) = RunFolder::open(&args.run)?;
    config.downscale = args.downscale.unwrap_or(config.downscale);
    let source = args.data.as_deref().map_or(record.data, DataSource::folder);
    let dataset = source.reopen(&config)?;
    super::check_split(&dataset, args.split)?;
    let chosen = choose(&dataset, args.split, &args.view)?;
    let shape = super::final_shape(&config);
    let sampling = args.samples.map_or(config.evaluation, |samples| with_samples(config.evaluation, samples, &shape));
    let estimate = Estimate::of_evaluation(&config, sampling, &shape, &dataset, None);
    console.note(&estimate.describe());
    estimate.check()?;
    let (grid, _) = folder.load()?;

    let renders = folder.create_renders()?;
    let viewer = Viewer::new(&grid, sampling, config.background);
    let (cameras, names) = (dataset.cameras(args.split), dataset.view_names(args.split));
    let count = console.count("rendering", chosen.len());
    for (done, &number) in chosen.iter().enumerate() {
        let picture = viewer.see(&cameras[number]);
        let range = DepthRange::of(&cameras[number], config.half_width);
        let file = |kind: &str| folder.render(&format!("{}_{number:03}_{}{kind}.png", args.split, names[number]));
        images::write(&file(""), &picture.rgb)?;
        images::write(&file("_depth"), &images::depth_map(&picture, range))?;
        images::write(&file("_opacity"), &images::opacity_map(&picture))?;
        count.at(done + 1, chosen.len());
    }
    drop(count);
    console.result(&format!("rendered {} {} views to {}", chosen.len(), args.split, renders.display()))
}

/// Numbers of the views that were asked for: all of the split unless some are named.
fn choose(dataset: &Dataset, split: Split, asked: &[String]) -> Result<Vec<usize>> {
    let names = dataset.view_names(split);
    if asked.is_empty() {
        return Ok((0..names.len()).collect());
    }
    let find = |text: &String| {
        let number = text.parse().ok().filter(|number| *number < names.len());
        let number = number.or_else(|| names.iter().position(|name| name == text));
        number.ok_or_else(|| {
            let found = format!("`{text}`, which is no {split} view,");
            let last = names.len() - 1;
            let accepted = format!("0 to {last}, or a name from {} to {}", names[0], names[last]);
            Error::config("--view", found, accepted)
        })
    };
    asked.iter().map(find).collect()
}
