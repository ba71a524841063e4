//! The run whose grid another run starts from (`init_from`).

use crate::checkpoint::{self, Header};
use crate::dataset::Dataset;
use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::geometry::Similarity;
use crate::model::plenoxels::{KIND, Trainer};
use crate::run::folder::RunFolder;
use crate::run::memory::Stored;
use crate::space::Space;
use glam::DVec3;
use std::path::{Path, PathBuf};

/// A run with a grid that has not been read.
pub struct InitialRun {
    checkpoint: PathBuf,
    pub header: Header,
    voxels: usize,
    carved: bool,
    to_world: Option<Similarity>,
}

/// The initial grid of a run.
pub struct InitialGrid {
    pub grid: VoxelGrid<f32>,
    /// True if its voxels are carved and their densities are not learned.
    pub carved: bool,
}

impl InitialRun {
    /// Opens the folder of a run and reads the header of its grid.
    pub fn open(path: &Path) -> Result<Self> {
        let (folder, _, record) = RunFolder::open(path)?;
        let checkpoint = folder.existing_checkpoint()?;
        let (header, voxels) = checkpoint::header(&checkpoint)?;
        Ok(InitialRun { checkpoint, header, voxels, carved: record.is_carved(), to_world: record.to_world })
    }

    /// Returns the size of the grid.
    pub fn stored(&self) -> Stored {
        Stored::Grid { shape: self.header.shape(), voxels: self.voxels }
    }

    /// Checks that a dataset has the space of the initial grid, or else is in a box of the world. A capture in another space needs an initial grid.
    pub fn check_space(from: Option<&Self>, dataset: &Dataset) -> Result<()> {
        let space = dataset.space();
        let Some(InitialRun { checkpoint, header, to_world, .. }) = from else {
            if space == Space::Box {
                return Ok(());
            }
            let found = format!("`{KIND}` needs a box of the world or an initial grid, and the space of this capture is {space}");
            let remedy = "use the preset photos, start from a grid that `bake` made of such a run with --init-from, or set space to box, and half_width to the size of the object";
            return Err(Error::usage("space", found, remedy));
        };
        let of_grid = header.coordinates.space;
        let remedy = "start from a grid of this dataset with the same settings `capture.*`";
        if !same_space(of_grid, space) {
            return Err(Error::input(
                checkpoint,
                format!("the initial grid is in the space {of_grid}, and the dataset in {space}"),
                remedy,
            ));
        }
        let normalized = dataset.normalization().to_world;
        if space != Space::Box && to_world.is_some_and(|to_world| !same_map(&to_world, &normalized)) {
            return Err(Error::input(checkpoint, "the cameras of the initial grid were normalized in another way", remedy));
        }
        Ok(())
    }

    /// Reads the grid.
    pub fn load(&self) -> Result<InitialGrid> {
        Ok(InitialGrid { grid: checkpoint::load(&self.checkpoint)?.0, carved: self.carved })
    }
}

impl InitialGrid {
    /// Returns the trainer, starting from the grid.
    pub fn begin(&self, trainer: Trainer<f32>) -> Trainer<f32> {
        if self.carved { trainer.starting_from_carved(&self.grid) } else { trainer.starting_from(&self.grid) }
    }
}

/// Largest difference between coordinates that were read from text, and others.
const ROUNDING: f64 = 1e-6;

fn same_space(left: Space, right: Space) -> bool {
    match (left, right) {
        (Space::Ndc { a, b }, Space::Ndc { a: c, b: d }) => (a - c).abs().max((b - d).abs()) < ROUNDING,
        _ => left == right,
    }
}

fn same_map(left: &Similarity, right: &Similarity) -> bool {
    let points = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
    points.into_iter().all(|p| left.point(p).abs_diff_eq(right.point(p), ROUNDING))
}
