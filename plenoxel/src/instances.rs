//! Instances of this crate's generic code for both precisions.
//!
//! In builds with little optimisation, crates can share generic code that a dependency has already compiled. The tests' builds therefore
//! link these instances instead of compiling a renderer and a trainer per test. Nothing calls them.

use crate::checkpoint::{self, Header};
use crate::dataset::View;
use crate::error::Result;
use crate::field::Field;
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::seen;
use crate::model::plenoxels::{Trainer, config::Config};
use crate::point_cloud::from_grid::{ColorFrom, Coordinates, VoxelOptions, points};
use crate::rays::RaySource;
use crate::render::picture::picture;
use crate::render::{RenderOptions, render};
use autograd::optim::{Optimizer, Rates, Sgd};
use autograd::{Real, grad, value_and_grad};
use std::path::Path;

/// Instances for `f32`.
pub fn single(config: Config, views: &[View], options: &RenderOptions<'_>, path: &Path) -> Result<()> {
    all::<f32>(config, views, options, path)
}

/// Instances for `f64`.
pub fn double(config: Config, views: &[View], options: &RenderOptions<'_>, path: &Path) -> Result<()> {
    all::<f64>(config, views, options, path)
}

fn all<T: Real>(config: Config, views: &[View], options: &RenderOptions<'_>, path: &Path) -> Result<()> {
    let shape = config.grid_shape(4);
    let mut grid = VoxelGrid::<T>::uniform(shape, 1.0, 0.0).resample(3);
    grid = VoxelGrid::from_row_major(shape, &grid.to_row_major()[0], grid.color.tensor());
    grid = grid.with_reduction(2).pruned(&grid.occupancy(0.0));
    let batch = RaySource::new(views, options.background, 0).batch::<T>(0, 1);
    let rendered = render(&grid, &batch.rays, options);
    let density = grid.density(&batch.target);
    let _ = grad(&(&rendered.rgb - &batch.target).square().mean(), &[&density]);
    let (_, gradients) = value_and_grad(|| rendered.depth().sum() + rendered.distortion().sum() + rendered.sparsity().sum());
    let _ = (gradients.array(grid.density.tensor()), grid.density.tensor().to_array());
    Sgd::new(Rates::new(0.1)).step(&mut grid, &gradients, 0);
    let _ = picture(&grid, &views[0].camera, options);
    let seen = seen(&grid, RaySource::new(views, options.background, 0).in_order_with_alpha(1), options);
    let _ = points(&grid, &VoxelOptions { coordinates: Coordinates::World, color: ColorFrom::Seen(&seen), min_alpha: 0.0, visible: None });
    checkpoint::save(path, &grid, &Header::new(&grid, "", options.background, 0, 0))?;
    let _ = checkpoint::load::<T>(path)?;
    Trainer::<T>::new(config, views)?.step()?;
    Ok(())
}
