//! The start of a new run, for `train` and `carve`.

use super::background_name;
use crate::progress::Console;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::evenly_spaced;
use plenoxel::run::machine;
use plenoxel::space::Space;

/// Describes the loading of a split.
pub fn loading(split: Split, source: &DataSource) -> String {
    match source {
        DataSource::Folder { .. } | DataSource::Memory { .. } | DataSource::None => format!("reading {split} images"),
        DataSource::BuiltIn { .. } => format!("rendering {split} images of the built-in scene"),
    }
}

/// Loads at most `most` evenly spaced views of a split, with progress.
pub fn load(console: &Console<'_>, dataset: &Dataset, split: Split, most: usize, source: &DataSource) -> Result<Vec<View>> {
    let numbers = evenly_spaced(dataset.count(split), most);
    let count = console.count(&loading(split, source), numbers.len());
    dataset.load_views(split, &numbers, &|done, total| count.at(done, total))
}

/// Prints the scene and the machine.
pub fn announce(console: &Console<'_>, dataset: &Dataset, config: &Config) {
    let (width, height) = dataset.size();
    let [train, val, test] = Split::ALL.map(|split| dataset.count(split));
    // Other spaces are as large as what the cameras see.
    let half_width = if dataset.space() == Space::Box { format!(", half width {}", config.half_width) } else { String::new() };
    console.note(&format!(
        "scene: {}, {}, {train} train, {val} val, {test} test views of {width} x {height}, background {}{half_width}",
        dataset.name(),
        dataset.format(),
        background_name(config.background),
    ));
    for note in dataset.notes() {
        console.note(&format!("note: {note}"));
    }
    for (what, choice) in dataset.normalization().describe() {
        console.note(&format!("{what}: {choice}"));
    }
    let threads = machine::threads();
    console.note(&format!("machine: {}, {threads} thread{}", machine::instruction_set(), if threads == 1 { "" } else { "s" }));
}
