//! Gradients of look-ups are rows all the way into the optimizer.

use crate::support::{batch, rays, shape};
use autograd::optim::{Optimizer, Sgd};
use autograd::{Grad, Tensor, value_and_grad};
use plenoxel::field::voxel_grid::{Color, Interpolation, VoxelGrid};
use plenoxel::geometry::Aabb;
use plenoxel::loss::{sampled_total_variation, total_variation};
use plenoxel::render::{Engine, RenderOptions, render};
use plenoxel::sampling::{Jitter, Spacing};

fn options() -> RenderOptions<'static> {
    RenderOptions {
        aabb: Aabb::cube(1.0),
        spacing: Spacing::Step(0.2),
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::Graph,
        stop_below: 0.0,
    }
}

fn grid(interpolation: Interpolation) -> VoxelGrid<f64> {
    VoxelGrid::random(shape(interpolation, Color::Rgb), 1.0, 1.0, 2)
}

fn loss(grid: &VoxelGrid<f64>) -> Tensor<f64> {
    (&render(grid, &rays(), &options()).rgb - &batch().target).square().mean()
}

#[test]
fn a_render_touches_rows_and_they_equal_the_dense_gradient() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        let grid = grid(interpolation);
        let (_, gradients) = value_and_grad(|| loss(&grid));
        for param in [&grid.density, &grid.color] {
            let Some(Grad::Rows(rows)) = gradients.of(param) else { panic!("the gradient of `{}` is rows", param.name()) };
            assert!(rows.rows().len() < 64 && rows.rows().is_sorted_by(|a, b| a < b));
            // The differentiable pass has no rows: an independent way to the same numbers.
            let dense = &autograd::grad(&loss(&grid), &[param.tensor()])[0];
            for (a, b) in rows.to_dense().data().iter().zip(dense.data()) {
                approx::assert_relative_eq!(a, b, epsilon = 1e-14);
            }
        }
    }
}

#[test]
fn a_loss_on_sampled_cells_stays_rows_and_one_on_all_cells_is_dense() {
    let grid = grid(Interpolation::Trilinear);
    let sampled = value_and_grad(|| loss(&grid) + sampled_total_variation(grid.density.tensor(), grid.lattice(), 20, 5)).1;
    assert!(matches!(sampled.of(&grid.density), Some(Grad::Rows(_))));
    let whole = value_and_grad(|| loss(&grid) + total_variation(grid.density.tensor(), grid.lattice())).1;
    assert!(matches!(whole.of(&grid.density), Some(Grad::Dense(_))));
    // The same sum either way.
    let parts = [value_and_grad(|| loss(&grid)).1, value_and_grad(|| total_variation(grid.density.tensor(), grid.lattice())).1];
    let leaf = grid.density.tensor();
    let sum = parts[0].array(leaf) + parts[1].array(leaf);
    assert!(whole.array(leaf).iter().zip(&sum).all(|(a, b)| (a - b).abs() < 1e-14));
}

#[test]
fn a_step_leaves_untouched_rows_alone_and_projection_equals_the_clamp_of_the_whole_grid() {
    let (mut grid, mut projected) = (grid(Interpolation::Nearest), grid(Interpolation::Nearest));
    projected.project();
    let before = grid.density.tensor().to_array();
    let (_, gradients) = value_and_grad(|| loss(&grid));
    let Some(Grad::Rows(rows)) = gradients.of(&grid.density) else { panic!("rows") };
    let touched: Vec<usize> = rows.rows().iter().map(|&r| r as usize).collect();
    Sgd::new(200.0).step(&mut grid, &gradients, 0);
    let moved = grid.density.tensor().to_array();
    assert!((0..64).filter(|r| !touched.contains(r)).all(|r| moved[[r, 0]] == before[[r, 0]]));
    assert!(moved.iter().any(|&d| d < 0.0), "the rate is high enough for the projection to matter");
    let (_, gradients) = value_and_grad(|| loss(&projected));
    Sgd::new(200.0).step(&mut projected, &gradients, 0);
    assert_eq!(projected.density.tensor().to_array(), moved.mapv(|d| d.max(0.0)));
    assert_eq!(projected.color.tensor().to_array(), grid.color.tensor().to_array().mapv(|c| c.clamp(0.0, 1.0)));
}
