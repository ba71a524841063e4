//! Radiance fields with their training recipes. [`Model`] is the trait that they implement.
//!
#![doc = include_str!("../docs/own_field.md")]

mod cells;
pub mod dvgo;
pub mod nerf;
pub mod ngp;
pub mod plenoxels;
pub mod recipe;
mod stage;
pub mod tensorf;

pub use crate::train::Model;

use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::tensor_file::TensorFile;
use crate::train::About;
use dvgo::Dvgo;
use nerf::Nerf;
use ngp::Ngp;
use plenoxels::config::Config;
use std::path::Path;
use tensorf::Tensorf;

/// Kinds of models that [`open`] can read.
pub const KINDS: [&str; 5] = [plenoxels::KIND, tensorf::KIND, dvgo::KIND, nerf::KIND, ngp::KIND];

/// Returns the kind of model that a checkpoint holds.
///
/// Errors if the file cannot be read; the error names the file and the problem.
pub fn kind(path: &Path) -> Result<String> {
    let facts = TensorFile::open(path)?.facts()?;
    // Early checkpoints of voxel grids have no kind.
    Ok(facts["kind"].as_str().unwrap_or(plenoxels::KIND).to_owned())
}

fn boxed<M: Model<f32> + 'static>((model, about): (M, About)) -> (Box<dyn Model<f32>>, About) {
    (Box::new(model), about)
}

/// Opens the model of a checkpoint for rendering, with the config of its run.
///
/// Errors if the file cannot be read, or if its kind is not one of [`KINDS`].
pub fn open(path: &Path, config: &Config) -> Result<(Box<dyn Model<f32>>, About)> {
    match &kind(path)?[..] {
        plenoxels::KIND => plenoxels::open(path, config).map(boxed),
        tensorf::KIND => Tensorf::open(path).map(boxed),
        dvgo::KIND => Dvgo::open(path).map(boxed),
        nerf::KIND => Nerf::open(path).map(boxed),
        ngp::KIND => Ngp::open(path).map(boxed),
        other => Err(recipe::unknown(other, &TensorFile::open(path)?)),
    }
}

/// Returns the voxel grid of a model. `what` names the purpose in the error message, for example "a mesh".
///
/// Errors if the model has no voxel grid.
pub fn voxel_grid<'m>(model: &'m dyn Model<f32>, path: &Path, what: &str) -> Result<&'m VoxelGrid<f32>> {
    let grid = model.content().and_then(|content| content.downcast_ref());
    grid.ok_or_else(|| {
        let found = format!("a model of kind `{}` has no voxels", model.kind());
        let remedy = match model.shaded() {
            Some(_) => "run `plenoxel bake RUN` first".to_owned(),
            None => format!("use a run of kind `{}`", plenoxels::KIND),
        };
        Error::input(path, found, format!("{what} needs a voxel grid: {remedy}"))
    })
}
