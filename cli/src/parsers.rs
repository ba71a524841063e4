//! Parsers of files and command lines as separate functions, for property tests and fuzzing only; not a stable interface.

use crate::Cli;
use clap::Parser;
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
pub use plenoxel::run::data::DataSource;
pub use plenoxel::run::folder::RunRecord;
use plenoxel::run::metrics::History;
use plenoxel::run::settings::{ConfigFile, Layers};
use std::path::Path;

/// Parses a file of settings over a preset.
pub fn layer(path: &Path, bytes: &[u8]) -> Result<Config> {
    let mut layers = Layers::defaults()?.with_preset("fast")?;
    layers.file(&ConfigFile::parse(path, bytes)?)?;
    layers.resolve()
}

/// Parses the `config.toml` of a run.
pub fn config(path: &Path, bytes: &[u8]) -> Result<Config> {
    ConfigFile::parse(path, bytes)?.complete()
}

/// Parses assignments of `--set` over a preset.
pub fn assignments<'a>(assignments: impl IntoIterator<Item = &'a str>) -> Result<Config> {
    let mut layers = Layers::defaults()?.with_preset("fast")?;
    assignments.into_iter().try_for_each(|assignment| layers.assign(assignment))?;
    layers.resolve()
}

/// Parses a command line, which begins with the program name, without running it.
pub fn arguments(arguments: &[&str]) -> std::result::Result<(), String> {
    Cli::try_parse_from(arguments).map(drop).map_err(|e| e.to_string())
}

/// Parses the lines of the first steps in the `metrics.jsonl` of a run, and returns their losses.
pub fn losses(bytes: &[u8], taken: u64) -> (String, Vec<f64>) {
    let (kept, past) = History::of(&String::from_utf8_lossy(bytes), taken);
    (kept, past.losses)
}
