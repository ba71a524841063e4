//! `plenoxel view`: shows a run on a page that the program renders.

use super::trained_run::{Loaded, TrainedModel};
use super::whole;
use crate::interrupt::Watch;
use crate::live::{self, Door, MOST_PIXELS, Scene, Site};
use crate::progress::Console;
use clap::Args;
use plenoxel::error::Result;
use plenoxel::evaluate::Viewer;
use plenoxel::run::memory::Estimate;
use std::time::Duration;

const EXAMPLES: &str = "\
Examples:
  plenoxel view runs/lego                  print the address of a page; open it in a browser
  plenoxel view runs/lego --best
  plenoxel view runs/room --port 8080      on a remote machine, with ssh -L 8080:127.0.0.1:8080 HOST

The program renders the model itself, whatever its kind and space; nothing is baked or compressed, unlike in report.html. Pictures are coarse while \
the camera moves, and sharp at rest. The page begins at the first training camera.

Only this machine reaches the page, and only with the random address that is printed. Visitors can write nothing. Ctrl-C ends the program.";

/// Interval at which the program checks for Ctrl-C.
const CHECK: Duration = Duration::from_millis(100);

/// Look at a run in a browser, rendered by the program
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct ViewArgs {
    #[command(flatten)]
    run: TrainedModel,

    /// Port of the page on 127.0.0.1; 0 for any free port
    #[arg(long, value_name = "PORT", help_heading = "Output", value_parser = whole::<u16>(0, u16::MAX.into()), default_value = "0", allow_negative_numbers = true)]
    port: u16,
}

/// Shows a run until it is interrupted.
pub fn run(args: &ViewArgs, console: &Console<'_>) -> Result<()> {
    let found = args.run.find()?;
    let door = Door::open(args.port)?;
    let dataset = args.run.views_if_any(&found, console, "the page begins outside of the box")?;
    let Loaded { model, view, .. } =
        args.run.load(&found, console, |sampling, stored| Estimate::of_pictures(&found.config, sampling, stored, MOST_PIXELS, false))?;
    let aabb = model.aabb();
    let half_width = 0.5 * (aabb.max - aabb.min).max_element();
    let title = found.folder.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
    let scene = match &dataset {
        Some(dataset) => Scene::of(title, dataset),
        None => Scene::around_box(title, half_width, model.space()),
    };
    let (desk, studio) = live::studio();
    let interrupt = Watch::begin();
    let address = door.address();
    let server = door.serve(Site::new(&scene, desk, None))?;
    console.result(&format!("view: {address}"))?;
    console.note("open the address in a browser; Ctrl-C ends the program");
    let viewer = Viewer::of(&*model, &view);
    while !interrupt.requested() {
        if let Some(order) = studio.next(CHECK) {
            order.fill_with(half_width, &viewer);
        }
    }
    drop(server);
    Ok(())
}
