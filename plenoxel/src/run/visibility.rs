//! Visibility of the voxels of a trained grid in the training views of its run, for point clouds.

use crate::dataset::View;
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::{Seen, seen};
use crate::model::plenoxels::config::Config;
use crate::rays::RaySource;
use crate::render::RenderOptions;
use crate::sampling::Jitter;

/// Rays per batch.
const RAYS_PER_BATCH: usize = 1 << 15;

/// Renders all pixels of the training views and returns visibility and mean color of each row of the tables, with the sampling and the background of `config`.
/// `progress(done, total)` is called before each batch of rays.
pub fn visibility(grid: &VoxelGrid<f32>, views: Vec<View>, config: &Config, progress: &dyn Fn(usize, usize)) -> Seen {
    let rays = RaySource::new(views, config.background, config.seed);
    let occupancy = grid.matter();
    let options = RenderOptions {
        aabb: grid.aabb(),
        spacing: config.evaluation.spacing(grid.shape()),
        jitter: Jitter::None,
        background: config.background,
        occupancy: Some(&occupancy),
        engine: config.engine,
        stop_below: 0.0,
    };
    let total = rays.len().div_ceil(RAYS_PER_BATCH as u64) as usize;
    let batches = rays.in_order_with_alpha(RAYS_PER_BATCH).enumerate().map(|(done, batch)| {
        progress(done, total);
        batch
    });
    seen(grid, batches, &options)
}
