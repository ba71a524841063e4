//! `plenoxel render`: pictures of a trained run from the cameras of its views.

use super::trained_run::{Opened, TrainedRun};
use crate::evaluation::Viewer;
use crate::images::{self, DepthRange};
use crate::progress::Console;
use clap::Args;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::{Error, Result};

const EXAMPLES: &str = "\
Examples:
  plenoxel render runs/lego                        all test views
  plenoxel render runs/lego --view 0 --view r_17   two of them, by number and by name
  plenoxel render runs/lego --split train --downscale 4

Writes RUN/renders/<split>_<number>_<name>.png with the colors over the run's background, and the same with _depth \
(red near, blue far, white empty) and _opacity.";

/// Render the views of a trained run to PNG files
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct RenderArgs {
    #[command(flatten)]
    run: TrainedRun,

    /// Render this view only, by number from 0 or by name; may be repeated
    #[arg(long, value_name = "N|NAME", help_heading = "Scene")]
    view: Vec<String>,
}

/// Renders views of a run.
pub fn run(args: &RenderArgs, console: &Console<'_>) -> Result<()> {
    let Opened { folder, config, dataset, sampling, grid, .. } = args.run.open(console, false)?;
    let split = args.run.split;
    let chosen = choose(&dataset, split, &args.view)?;
    let renders = folder.create_renders()?;
    let viewer = Viewer::new(&grid, sampling, &config);
    let (cameras, names) = (dataset.cameras(split), dataset.view_names(split));
    let count = console.count("rendering", chosen.len());
    for (done, &number) in chosen.iter().enumerate() {
        let picture = viewer.see(&cameras[number]);
        let range = DepthRange::of(&cameras[number], grid.shape().half_width);
        let file = |kind: &str| folder.render(&format!("{}_{number:03}_{}{kind}.png", split, names[number]));
        images::write(&file(""), &picture.rgb)?;
        images::write(&file("_depth"), &images::depth_map(&picture, range))?;
        images::write(&file("_opacity"), &images::opacity_map(&picture))?;
        count.at(done + 1, chosen.len());
    }
    drop(count);
    let views = if chosen.len() == 1 { "view" } else { "views" };
    console.result(&format!("rendered {} {split} {views} to {}", chosen.len(), renders.display()))
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
