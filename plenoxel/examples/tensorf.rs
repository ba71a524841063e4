//! TensoRF on a scene, with a run folder: `cargo run --release -p plenoxel --example tensorf -- [DATA]`. Without DATA it learns the built-in scene.
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::error::Result;
use plenoxel::geometry::Aabb;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::plenoxels;
use plenoxel::model::tensorf::{Config, Stage, Tensorf};
use plenoxel::run::data::DataSource;
use plenoxel::run::training::{Event, Outcome, RunSettings, train_model};
use plenoxel::train::Trainer;

/// The recipe for two cores, with small steps for small images.
fn config() -> Config {
    let stages = [(48, 400, 512), (64, 400, 1024), (96, 700, 1024)];
    let stages = stages.map(|(resolution, steps, rays)| Stage { resolution, steps, rays }).to_vec();
    Config { stages, ..Config::default() }
}

fn main() -> Result<()> {
    let scene = ProceduralOptions { width: 100, height: 100, train: 60, val: 0, test: 10, supersample: 2 };
    let data = std::env::args_os().nth(1).map_or_else(|| DataSource::built_in(&scene), |data| DataSource::folder(data.as_ref()));
    let settings = RunSettings::new(plenoxels::config::Config::default(), data);
    let outcome = train_model(
        &settings,
        |run, _, views| {
            Trainer::with_model(
                Tensorf::new(config(), Aabb::cube(run.half_width), run.seed)?,
                views,
                Objective::new().with("mse", 1.0, mse),
                run.train_options(),
            )
        },
        &mut |event| match event {
            Event::Note(text) => eprintln!("{text}"),
            Event::Step { report, .. } if report.step % 100 == 0 => eprintln!("step {}: {:.2} dB", report.step, report.psnr),
            _ => {}
        },
    )?;
    if let Outcome::Done(summary) = outcome {
        println!("{}", summary.figures.sentence());
    }
    Ok(())
}
