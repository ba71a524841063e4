//! One file for each command: its arguments, and what it does.

pub mod evaluate;
pub mod info;
pub mod render;
pub mod scene;
pub mod train;

use plenoxel::dataset::Split;

/// A split as the command line takes it.
fn split(text: &str) -> Result<Split, String> {
    text.parse().map_err(|_| "train, val or test".to_owned())
}

/// A reduction of images as the command line takes it.
fn factor(text: &str) -> Result<usize, String> {
    let factor = text.parse().ok().filter(|k| (1..=64).contains(k));
    factor.ok_or_else(|| "a whole number from 1 to 64".to_owned())
}
