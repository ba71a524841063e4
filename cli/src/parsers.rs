//! What reads files and command lines, each by itself, for property tests and fuzzing: no promise to anybody else.

use crate::Cli;
use clap::Parser;
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
pub use plenoxel::run::data::DataSource;
pub use plenoxel::run::folder::RunRecord;
use plenoxel::run::metrics::History;
use plenoxel::run::settings::{ConfigFile, Layers};
use std::path::Path;

/// A file that changes a preset.
pub fn layer(path: &Path, bytes: &[u8]) -> Result<Config> {
    let mut layers = Layers::defaults()?.with_preset("fast")?;
    layers.file(&ConfigFile::parse(path, bytes)?)?;
    layers.resolve()
}

/// The `config.toml` of a run.
pub fn config(path: &Path, bytes: &[u8]) -> Result<Config> {
    ConfigFile::parse(path, bytes)?.complete()
}

/// Assignments as `--set` takes them, over a preset.
pub fn assignments<'a>(assignments: impl IntoIterator<Item = &'a str>) -> Result<Config> {
    let mut layers = Layers::defaults()?.with_preset("fast")?;
    assignments.into_iter().try_for_each(|assignment| layers.assign(assignment))?;
    layers.resolve()
}

/// A command line, the program's name first; it is not carried out.
pub fn arguments(arguments: &[&str]) -> std::result::Result<(), String> {
    Cli::try_parse_from(arguments).map(drop).map_err(|e| e.to_string())
}

/// Of the `metrics.jsonl` of a run the lines about its first steps, and their losses.
pub fn losses(bytes: &[u8], taken: u64) -> (String, Vec<f64>) {
    let (kept, past) = History::of(&String::from_utf8_lossy(bytes), taken);
    (kept, past.losses)
}
