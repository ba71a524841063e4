//! A training run with a run folder. A closure handles its events.
//!
//!     cargo run --release -p plenoxel --example run_events
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::training::{Event, Outcome, RunSettings, train};

fn main() -> Result<()> {
    run("runs/events".into())
}

pub fn run(folder: std::path::PathBuf) -> Result<()> {
    let scene = ProceduralOptions { width: 64, height: 64, train: 40, val: 4, test: 8, ..ProceduralOptions::default() };
    let mut config = Config::preset("demo")?;
    config.stages.truncate(2);
    let settings = RunSettings { out: Some(folder), force: true, ..RunSettings::new(config, DataSource::built_in(&scene)) };
    let outcome = train(&settings, &mut |event| match event {
        Event::Note(text) => println!("{text}"),
        Event::Step { report, .. } if report.ends_stage => println!("step {}: {:.2} dB on training rays", report.step, report.psnr),
        Event::Evaluated { summary, .. } => println!("{}", summary.figures.sentence()),
        _ => {}
    })?;
    if let Outcome::Done(summary) = outcome {
        println!("run folder: {}", summary.run);
    }
    Ok(())
}
