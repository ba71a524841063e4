//! `plenoxel train`: trains a scene and writes a run folder.

mod flags;
mod pictures;
mod screen;

use super::report;
use crate::interrupt::{self, Watch};
use crate::live::{Door, LiveTraining, MOST_PIXELS, Training};
use crate::progress::Console;
pub use flags::{BuiltInScene, NOT_WHEN_RESUMED, TrainArgs, size};
use plenoxel::error::Result;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::training::{self, Event, Outcome, RunOptions, RunSettings, Summary};
use plenoxel::text::clock;
pub use screen::Screen;
use std::path::Path;
use std::sync::Arc;

/// Trains a scene and writes a run folder. Returns the exit code: 0, or 130 if it was interrupted.
pub fn run(args: &TrainArgs, console: &Console<'_>) -> Result<u8> {
    let mut screen = Screen::new(console, !args.no_images, !args.no_report);
    let door = args.view.then(|| Door::open(args.port)).transpose()?;
    let mut live = door.map(|door| LiveTraining::new(door, console));
    let shared = live.as_ref().map(LiveTraining::shared);
    let options = |stage_psnr: bool| options(args, stage_psnr, shared);
    let mut interruption = Interruption::default();
    let mut hear = |event: Event<'_>| {
        interruption.hear(&event);
        live.iter_mut().for_each(|live| live.hear(&event));
        screen.show(event);
    };
    let outcome = match &args.resume {
        Some(path) if lacks_page(path) && !args.no_report => {
            console.note("this run is finished; writing its missing report.html");
            return report::write(path, args.moved_to(), console).map(|()| 0);
        }
        Some(path) => {
            let data = args.moved_to();
            training::resume(path, data, &options(false), &mut hear)
        }
        None => {
            let (config, preset) = args.config()?;
            let data = args.source();
            let options = options(args.keeps_stages(&data));
            let preset = preset.map(str::to_owned);
            let settings = RunSettings {
                preset,
                out: args.out.clone(),
                force: args.force,
                time: args.time,
                with_evaluation: args.including_evaluation,
                options,
                ..RunSettings::new(config, data)
            };
            training::train(&settings, &mut hear)
        }
    };
    let shown = screen.finish().and(live.map_or(Ok(()), LiveTraining::finish));
    match outcome? {
        Outcome::Done(_) => shown.map(|()| 0),
        Outcome::Stopped { steps, total, folder } => {
            let again = format!("plenoxel train --resume {}", folder.path().display());
            let text = match steps < total {
                true => format!("interrupted after step {steps} of {total}; the training is saved; resume with: {again}"),
                false => format!("interrupted after the last step; compute the final figures with: {again}"),
            };
            console.error(&text, interrupt::EXIT_CODE);
            Ok(interrupt::EXIT_CODE)
        }
    }
}

/// Lets an interruption of the training save it and stop.
#[derive(Default)]
struct Interruption {
    /// Active during training.
    watch: Option<Watch>,
    folder: Option<RunFolder>,
}

impl Interruption {
    fn hear(&mut self, event: &Event<'_>) {
        match event {
            Event::Started { run, .. } => {
                self.folder = Some(run.folder.clone());
                self.watch = Some(Watch::begin());
            }
            Event::Trained => {
                self.watch = None;
                if let Some(folder) = &self.folder {
                    let again = format!("plenoxel train --resume {}", folder.path().display());
                    interrupt::on_exit(format!(
                        "interrupted; the trained model is saved; write its final figures and report with: {again}"
                    ));
                }
            }
            _ => {}
        }
    }
}

/// True for a run that was killed after its final figures and before its report. A run without views has none.
fn lacks_page(path: &Path) -> bool {
    let Ok((folder, _, record)) = RunFolder::open(path) else { return false };
    folder.result().is_ok_and(|result| result.is_some())
        && folder.checkpoint().exists()
        && !folder.state().exists()
        && !folder.report().exists()
        && record.data != DataSource::None
}

fn options(args: &TrainArgs, stage_psnr: bool, live: Option<Arc<Training>>) -> RunOptions {
    RunOptions {
        checkpoint_every: args.checkpoint_every,
        preview_every: args.preview_every,
        pictures: !args.no_images,
        stage_psnr,
        test_views: if args.no_evaluate { 0 } else { args.test_views.unwrap_or(usize::MAX) },
        report: !args.no_report,
        shown_pixels: if live.is_some() { MOST_PIXELS } else { 0 },
        stop: Box::new(interrupt::requested),
        save: Box::new(move || live.as_ref().is_some_and(|live| live.wants_checkpoint())),
    }
}

/// Prints the final figures of a run.
fn say(console: &Console<'_>, summary: &Summary, note: Option<&str>) -> Result<()> {
    if let Some(note) = note {
        console.note(note);
    }
    let decibels = |x: Option<f64>| x.map_or("none".to_owned(), |x| format!("{x:.2} dB"));
    console.note(&format!(
        "trained {} steps in {}; baselines: background {}, mean training image {}",
        summary.steps,
        clock(summary.seconds),
        decibels(summary.baseline_background_psnr),
        decibels(summary.baseline_mean_image_psnr),
    ));
    console.result(&summary.figures.sentence())?;
    console.result(&format!("run folder: {}", summary.run))?;
    console.record(summary)
}
