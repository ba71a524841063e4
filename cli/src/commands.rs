//! One file for each command: its arguments, and what it does.

pub mod evaluate;
pub mod info;
pub mod render;
pub mod scene;
pub mod train;
mod trained_run;

use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Error;
use plenoxel::field::voxel_grid::GridShape;
use plenoxel::train::config::Config;

/// The grid that a configuration ends with.
fn final_shape(config: &Config) -> GridShape {
    config.grid_shape(config.stages.last().map_or(0, |stage| stage.resolution))
}

/// Refuses a split without views.
fn check_split(dataset: &Dataset, split: Split) -> Result<(), Error> {
    if dataset.count(split) > 0 {
        return Ok(());
    }
    let found = format!("{split}, which has no views in {},", dataset.name());
    let others = Split::ALL.into_iter().filter(|split| dataset.count(*split) > 0);
    let others: Vec<String> = others.map(|split| split.to_string()).collect();
    Err(Error::config("--split", found, others.join(", ")))
}

/// A split as the command line takes it.
fn split(text: &str) -> Result<Split, String> {
    text.parse().map_err(|_| "train, val or test".to_owned())
}

/// A reduction of images as the command line takes it.
fn factor(text: &str) -> Result<usize, String> {
    let factor = text.parse().ok().filter(|k| (1..=64).contains(k));
    factor.ok_or_else(|| "a whole number from 1 to 64".to_owned())
}
