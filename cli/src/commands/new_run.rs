//! What a new run begins with, whether it trains or carves.

use super::background_name;
use crate::progress::Console;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::error::Result;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunRecord;
use plenoxel::run::machine;
use plenoxel::model::plenoxels::config::Config;
use std::time::{Duration, Instant};

/// Reads or renders a split.
pub fn load(console: &Console<'_>, dataset: &Dataset, split: Split, source: &DataSource) -> Result<Vec<View>> {
    let what = match source {
        DataSource::Folder { .. } => format!("reading {split} images"),
        DataSource::BuiltIn { .. } => format!("rendering {split} images of the built-in scene"),
    };
    let count = console.count(&what, dataset.count(split));
    dataset.load(split, &|done, total| count.at(done, total))
}

/// Says what the scene and the machine are.
pub fn announce(console: &Console<'_>, dataset: &Dataset, config: &Config) {
    let (width, height) = dataset.size();
    let [train, val, test] = Split::ALL.map(|split| dataset.count(split));
    console.note(&format!(
        "scene: {}, {}, {train} train, {val} val, {test} test views of {width} x {height}, background {}, half width {}",
        dataset.name(),
        dataset.format(),
        background_name(config.background),
        config.half_width,
    ));
    let threads = machine::threads();
    console.note(&format!("machine: {}, {threads} thread{}", machine::instruction_set(), if threads == 1 { "" } else { "s" }));
}

/// What is true of the run and not of its configuration.
pub fn record(dataset: &Dataset, preset: Option<&str>, source: &DataSource) -> RunRecord {
    RunRecord {
        program: crate::PROGRAM.to_owned(),
        instruction_set: machine::instruction_set().to_owned(),
        threads: machine::threads(),
        scene: dataset.name().to_owned(),
        format: dataset.format().to_owned(),
        preset: preset.map(str::to_owned),
        data: source.clone(),
        seconds_planned: None,
    }
}

/// Adds up the time of some things.
#[derive(Debug, Default)]
pub struct Stopwatch(pub Duration);

impl Stopwatch {
    /// Runs `f` on the clock.
    pub fn time<R>(&mut self, f: impl FnOnce() -> R) -> R {
        let start = Instant::now();
        let result = f();
        self.0 += start.elapsed();
        result
    }

    /// So far.
    pub fn seconds(&self) -> f64 {
        self.0.as_secs_f64()
    }
}
