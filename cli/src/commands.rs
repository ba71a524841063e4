//! One file for each command: its arguments, and what it does.

pub mod evaluate;
pub mod export;
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

/// A whole number within bounds, as the command line takes it.
pub fn whole<N: TryFrom<u64>>(least: u64, most: u64) -> impl Fn(&str) -> Result<N, String> + Clone {
    move |text| {
        let number = text.parse().ok().filter(|n| (least..=most).contains(n));
        number.and_then(|n| N::try_from(n).ok()).ok_or_else(|| format!("a whole number from {least} to {most}"))
    }
}

/// By how much images may be reduced.
const MOST_REDUCTION: u64 = 64;
