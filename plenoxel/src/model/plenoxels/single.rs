//! Instances for `f32` that are compiled in this crate, so that crates with losses of their own do not compile them again
//! ([`autograd::single`]).

use super::config::{Config, Stage};
use super::objective::of_config;
use super::{Objective, Plenoxels, file, rates};
use crate::camera::Ray;
use crate::checkpoint::{self, Header};
use crate::dataset::View;
use crate::error::Result;
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::{self, PictureTables};
use crate::rays::RaySource;
use crate::render::{self, RenderOptions, Rendered};
use crate::sampling::Occupancy;
use crate::tensor_file::TensorFile;
use crate::train::{About, StageProgress};
use autograd::optim::Optimizer;
use std::path::Path;
use std::sync::Arc;

#[inline(never)]
pub fn new(config: &Config, views: &Arc<[View]>, progress: Arc<StageProgress>) -> Result<Plenoxels<f32>> {
    Plenoxels::start(config, views, progress)
}

#[inline(never)]
pub fn from(model: Plenoxels<f32>, grid: &VoxelGrid<f32>) -> Plenoxels<f32> {
    model.from(grid)
}

#[inline(never)]
pub fn objective(config: &Config, views: usize) -> Result<Objective<f32>> {
    of_config(config, views)
}

#[inline(never)]
pub fn optimizer(config: &Config, stage: &Stage, steps: u64) -> Box<dyn Optimizer<f32>> {
    rates::optimizer(config, stage, steps)
}

#[inline(never)]
pub fn begin(model: &mut Plenoxels<f32>, stage: usize, rays: &mut RaySource) -> Result<()> {
    model.begin(stage, rays)
}

#[inline(never)]
pub fn learning(grid: &VoxelGrid<f32>) -> Occupancy {
    grid.learning()
}

#[inline(never)]
pub fn render(grid: &VoxelGrid<f32>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<f32> {
    render::render(grid, rays, options)
}

#[inline(never)]
pub fn picture_tables(grid: &VoxelGrid<f32>, negligible: f64) -> Option<PictureTables<f32>> {
    PictureTables::new(grid, negligible)
}

#[inline(never)]
pub fn render_picture(grid: &VoxelGrid<f32>, tables: &PictureTables<f32>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<f32> {
    fused::render_picture(grid, tables, rays, options)
}

#[inline(never)]
pub fn read(model: &mut Plenoxels<f32>, file: &mut TensorFile<'_>, stage: usize) -> Result<()> {
    file::read(model, file, stage)
}

#[inline(never)]
pub fn save(grid: &VoxelGrid<f32>, path: &Path, about: &About) -> Result<()> {
    super::save(grid, path, about)
}

#[inline(never)]
pub fn load(path: &Path) -> Result<(VoxelGrid<f32>, Header)> {
    checkpoint::load(path)
}
