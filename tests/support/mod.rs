//! Small scenes that several tests share.
#![allow(dead_code)]

use autograd::{Real, Tensor};
use glam::DVec3;
use ndarray::{ArrayD, IxDyn};
use plenoxel::camera::Ray;
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::random::{Purpose, uniform};
use plenoxel::rays::RayBatch;

/// A ray through two points.
pub fn ray(from: [f64; 3], to: [f64; 3]) -> Ray {
    let d = DVec3::from(to) - DVec3::from(from);
    Ray { origin: from.into(), direction: d.normalize(), stretch: 1.0 }
}

/// Numbers in [low, high), a function of the seed.
pub fn numbers(shape: &[usize], low: f64, high: f64, seed: u64) -> ArrayD<f64> {
    let n = shape.iter().product::<usize>() as u64;
    let values = (0..n).map(|i| low + (high - low) * uniform(seed, Purpose::Initial, 0, i)).collect();
    ArrayD::from_shape_vec(IxDyn(shape), values).expect("as many numbers as the shape has")
}

pub fn tensor(shape: &[usize], low: f64, high: f64, seed: u64) -> Tensor<f64> {
    Tensor::constant(numbers(shape, low, high, seed))
}

/// A grid of 4³ voxels in the cube ±1.
pub fn shape(interpolation: Interpolation, color: Color) -> GridShape {
    GridShape::new(4, 1.0, interpolation, color)
}

/// A grid with all voxels whose tables are given tensors, tracked or not, so that whole renders can be differentiated by their tables.
pub fn grid_of<T: Real>(shape: GridShape, tables: &[Tensor<T>]) -> VoxelGrid<T> {
    let mut grid = VoxelGrid::with_tables(shape, shape.full(), tables.iter().map(Tensor::detach).collect());
    let params = [&mut grid.density, &mut grid.color].into_iter().chain(&mut grid.harmonics);
    for (param, table) in params.zip(tables) {
        if table.is_tracked() {
            param.bind(table.clone());
        }
    }
    grid
}

/// Rays that cross the cube ±1 in general directions, one that starts inside, one that misses it.
pub fn rays() -> Vec<Ray> {
    vec![
        ray([-2.3, 0.31, 0.17], [1.0, -0.22, 0.41]),
        ray([1.9, 2.1, -1.7], [-0.6, -0.5, 0.45]),
        ray([0.11, -0.23, 0.37], [0.9, 0.8, -1.0]),
        ray([0.3, 0.2, 3.0], [-0.35, 0.12, -1.0]),
        ray([-3.0, 2.5, 0.0], [3.0, 2.6, 0.1]),
    ]
}

/// Those rays with targets and alphas off every kink.
pub fn batch() -> RayBatch<f64> {
    let rays = rays();
    let n = rays.len();
    RayBatch {
        rays,
        target: tensor(&[n, 3], 0.05, 0.95, 11),
        alpha: tensor(&[n], 0.1, 0.9, 12),
        weight: None,
        view: vec![0; n],
        pixel: (0..n as u32).map(|x| [x, 0]).collect(),
        depth: None,
        channels: Vec::new(),
    }
}
