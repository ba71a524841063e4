//! Radiance fields with their recipes, one assembled model in each file. [`Model`] is the trait that they have in common.
//!
#![doc = include_str!("../docs/own_field.md")]

pub mod plenoxels;

pub use crate::train::Model;

use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::tensor_file::TensorFile;
use crate::train::About;
use plenoxels::config::Config;
use std::path::Path;

/// Kinds of models that [`open`] reads.
pub const KINDS: [&str; 1] = [plenoxels::KIND];

/// Kind of the model of a checkpoint.
///
/// Errors name the file and what is wrong with it.
pub fn kind(path: &Path) -> Result<String> {
    let facts = TensorFile::open(path)?.facts()?;
    // Early checkpoints of voxel grids do not say.
    Ok(facts["kind"].as_str().unwrap_or(plenoxels::KIND).to_owned())
}

/// The model of a checkpoint, to be looked at, with the config of its run.
///
/// Errors: the file cannot be read, or its kind is not among [`KINDS`].
pub fn open(path: &Path, config: &Config) -> Result<(Box<dyn Model<f32>>, About)> {
    match &kind(path)?[..] {
        plenoxels::KIND => {
            let (model, about) = plenoxels::open(path, config)?;
            Ok((Box::new(model), about))
        }
        other => {
            let found = format!("a model of kind `{other}`, for which this program has no code");
            let remedy = format!("kinds that it knows: {}; the program that trained this one can evaluate it", KINDS.join(", "));
            Err(Error::input(path, found, remedy))
        }
    }
}

/// The voxel grid of a model, for what needs one; `what` names it in the error, such as "a mesh".
///
/// Errors: the model has none.
pub fn voxel_grid<'m>(model: &'m dyn Model<f32>, path: &Path, what: &str) -> Result<&'m VoxelGrid<f32>> {
    let grid = model.content().and_then(|content| content.downcast_ref());
    grid.ok_or_else(|| {
        let found = format!("a model of kind `{}`, which has no voxels", model.kind());
        Error::input(path, found, format!("{what} needs a voxel grid: a run of kind `{}`", plenoxels::KIND))
    })
}
