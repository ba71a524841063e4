//! Whole renders and every loss against finite differences, in f64, first and second derivatives.
//!
//! Kinks are avoided: densities are positive and harmonics small, so that no activation is at its corner, and targets keep off the
//! rendered colors. Prints the table with `cargo test --test kernels gradients -- --nocapture`.

use crate::support::{batch, grid_of, numbers, rays, shape};
use autograd::{Gradcheck, Lattice, Tensor, check_kernel, grad};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::field::{Field, sh};
use plenoxel::geometry::Aabb;
use plenoxel::loss::{self, Objective, Step};
use plenoxel::model::plenoxels;
use plenoxel::render::{Engine, RenderOptions, Rendered, render};
use plenoxel::sampling::{Jitter, Spacing};

fn options() -> RenderOptions<'static> {
    RenderOptions {
        aabb: Aabb::cube(1.0),
        spacing: Spacing::Step(0.23),
        jitter: Jitter::PerRay { seed: 1, step: 2 },
        background: [1.0, 0.9, 0.8],
        occupancy: None,
        engine: Engine::default(),
        stop_below: 0.0,
    }
}

fn shapes() -> Vec<(String, GridShape)> {
    let mut shapes = Vec::new();
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        shapes.push((format!("{interpolation:?} RGB"), shape(interpolation, Color::Rgb)));
        for degree in 0..=sh::MAX_DEGREE {
            shapes.push((format!("{interpolation:?} SH {degree}"), shape(interpolation, Color::Sh { degree, offset: 0.5 })));
        }
        for (degree, sh_reduction) in [(2, 2), (1, 3)] {
            let whole = shape(interpolation, Color::Sh { degree, offset: 0.5 });
            shapes.push((format!("{interpolation:?} SH {degree} for every {sh_reduction}"), GridShape { sh_reduction, ..whole }));
        }
    }
    shapes
}

/// Tables off every kink.
fn tables(shape: &GridShape) -> Vec<ndarray::ArrayD<f64>> {
    let color = match shape.color {
        Color::Rgb => numbers(&[64, 3], 0.1, 0.9, 22),
        Color::Sh { .. } => numbers(&[64, shape.color_width()], -0.06, 0.06, 22),
    };
    let harmonics = shape.harmonics_lattice(&shape.full());
    let harmonics = harmonics.map(|lattice| numbers(&[lattice.rows(), shape.harmonics_width()], -0.06, 0.06, 23));
    [numbers(&[64, 1], 0.2, 2.0, 21), color].into_iter().chain(harmonics).collect()
}

type Column = fn(&Rendered<f64>) -> Tensor<f64>;

#[test]
fn every_column_of_a_whole_render_agrees_with_finite_differences() {
    let columns: [(&str, Column); 6] = [
        ("rgb", |r| r.rgb.clone()),
        ("depth", Rendered::depth),
        ("opacity", |r| r.opacity.clone()),
        ("log transmittance", |r| r.log_transmittance.clone()),
        ("sparsity", Rendered::sparsity),
        ("distortion", Rendered::distortion),
    ];
    println!("| render | engine | column | orders | worst relative error |\n| --- | --- | --- | --- | --- |");
    for (name, shape) in shapes() {
        for ((column, get), engine) in columns.into_iter().flat_map(|c| [(c, Engine::Graph), (c, Engine::Fused)]) {
            let options = RenderOptions { engine, ..options() };
            let f = |x: &[Tensor<f64>]| get(&render(&grid_of(shape, x), &rays(), &options));
            let report =
                Gradcheck::new(f, tables(&shape)).named(format!("{name}, {column}")).order(2).run().unwrap_or_else(|e| panic!("{e}"));
            println!("| {name} | {engine:?} | {column} | 1, 2 | {:.1e} |", report.worst_relative_error);
        }
    }
}

#[test]
fn every_loss_agrees_with_finite_differences() {
    println!("| loss | render | orders | worst relative error |\n| --- | --- | --- | --- |");
    for (render_name, shape) in [
        ("Nearest RGB", shape(Interpolation::Nearest, Color::Rgb)),
        ("Trilinear SH 2", shape(Interpolation::Trilinear, Color::Sh { degree: 2, offset: 0.5 })),
        (
            "Trilinear SH 2 for every 2",
            GridShape { sh_reduction: 2, ..shape(Interpolation::Trilinear, Color::Sh { degree: 2, offset: 0.5 }) },
        ),
    ] {
        for name in plenoxels::LOSSES {
            // A closure over what a step needs, with sampled cells at a fixed place.
            let objective = plenoxels::with_loss(Objective::<f64, VoxelGrid<f64>>::new(), name, 1.0, 2).expect("a loss of that name");
            let f = |x: &[Tensor<f64>]| {
                let (grid, batch) = (grid_of(shape, x), batch());
                let rendered = render(&grid, &batch.rays, &options());
                objective.evaluate(Step::new((3, 4), &batch, &rendered, &grid, (2.0, [1.0, 0.9, 0.8]))).total
            };
            let report =
                Gradcheck::new(f, tables(&shape)).named(format!("{name}, {render_name}")).order(2).run().unwrap_or_else(|e| panic!("{e}"));
            println!("| {name} | {render_name} | 1, 2 | {:.1e} |", report.worst_relative_error);
        }
    }
}

/// Whole bricks, some cut by the border, one without cells, one with holes, and one with bricks missing inside.
fn lattices() -> Vec<Lattice> {
    let mut all: Vec<Lattice> = [[8, 4, 4], [5, 4, 6], [2, 5, 3], [1, 4, 4]].map(Lattice::bricks).into();
    all.push(Lattice::bricks_where([9, 6, 7], |[i, j, k]| (i * 7 + j * 5 + k * 3) % 11 > 1));
    all.push(Lattice::bricks_where([12, 9, 10], |[i, j, k]| (i * 7 + j * 5 + k * 3) % 11 > 1 && (i / 4 * 2 + j / 4 + k / 4) % 3 > 0));
    all
}

#[test]
fn total_variation_over_all_cells_is_the_sampled_one_over_a_run_of_all() {
    // Width 3 has a kernel, width 2 has none.
    for (lattice, width) in lattices().into_iter().flat_map(|lattice| [2, 3].map(|width| (lattice.clone(), width))) {
        let rows = lattice.rows();
        let table = numbers(&[rows, width], -1.0, 1.0, 31);
        let whole = |x: &[Tensor<f64>]| loss::total_variation(&x[0], &lattice);
        Gradcheck::new(whole, vec![table.clone()]).named("total variation").order(2).run().unwrap_or_else(|e| panic!("{e}"));
        let x = Tensor::variable(table);
        let (a, b) = (loss::total_variation(&x, &lattice), loss::sampled_total_variation(&x, &lattice, rows - 1, rows));
        approx::assert_relative_eq!(a.item(), b.item(), epsilon = 1e-12);
        let (ga, gb) = (a.backward().array(&x), b.backward().array(&x));
        assert!(ga.iter().zip(&gb).all(|(a, b)| (a - b).abs() < 1e-12));
    }
}

#[test]
fn the_kernel_of_total_variation_agrees_with_its_reference_in_both_precisions() {
    for width in [1, 3, 4, 9, 12, 24, 27, 45, 48] {
        for lattice in lattices() {
            let table = numbers(&[lattice.rows(), width], -1.0, 1.0, 33);
            check_kernel::<f64>(|x| loss::total_variation(&x[0], &lattice), [table.clone()], 1e-12).unwrap_or_else(|e| panic!("{e}"));
            check_kernel::<f32>(|x| loss::total_variation(&x[0], &lattice), [table.mapv(|x| x as f32)], 1e-5)
                .unwrap_or_else(|e| panic!("{e}"));
            let bricks = lattice.rows() / 64;
            let wrapped = (bricks - bricks.min(2), bricks.min(4));
            for (first, count) in [(0, 1), (bricks / 2, bricks / 2), (bricks - 1, bricks), (bricks - 1, 1), wrapped] {
                let part = |x: &[Tensor<f64>]| loss::total_variation_of_bricks(&x[0], &lattice, first, count);
                check_kernel::<f64>(part, [table.clone()], 1e-12).unwrap_or_else(|e| panic!("{first}, {count}: {e}"));
                // Of the same rows, whether their gradient is zero or not.
                let x = Tensor::variable(table.clone());
                let reference = loss::sampled_total_variation(&x, &lattice, first * 64, count * 64);
                let gradient = |value: Tensor<f64>| value.backward();
                let (a, b) = (gradient(part(std::slice::from_ref(&x))), gradient(reference));
                let rows = |g: &autograd::Gradients<f64>| g.get(&x).and_then(|g| Some(g.as_rows()?.rows().to_vec())).unwrap_or_default();
                assert_eq!(rows(&a), rows(&b), "width {width}, {first}, {count}");
            }
        }
    }
}

#[test]
fn total_variation_of_several_tasks_agrees_with_its_reference() {
    // With 343 bricks, a brick behind is in the same task or in the one before. The grid with holes has 792 places for bricks, of which some are missing; runs of it
    // wrap around, so bricks behind are outside of the run, too.
    let whole = Lattice::bricks([28; 3]);
    let holes = |[i, j, k]: [usize; 3]| (i * 7 + j * 5 + k * 3) % 11 > 0 && (i / 4 * 2 + j / 4 * 3 + k / 4) % 17 > 0;
    let lattices = [whole, Lattice::bricks_where([44, 36, 32], holes)];
    for (lattice, width) in lattices.iter().flat_map(|lattice| [1, 3, 4].map(|width| (lattice, width))) {
        let (table, bricks) = (numbers(&[lattice.rows(), width], -1.0, 1.0, 35), lattice.rows() / 64);
        for (first, count) in [(0, bricks), (bricks - 13, 40), (100, 200), (bricks - 100, bricks - 150)] {
            let part = |x: &[Tensor<f64>]| loss::total_variation_of_bricks(&x[0], lattice, first, count);
            check_kernel::<f64>(part, [table.clone()], 1e-12).unwrap_or_else(|e| panic!("width {width}, {first}, {count}: {e}"));
        }
        check_kernel::<f32>(|x| loss::total_variation(&x[0], lattice), [table.mapv(|x| x as f32)], 1e-5).unwrap_or_else(|e| panic!("{e}"));
        check_kernel::<f64>(|x| loss::total_variation(&x[0], lattice), [table], 1e-12).unwrap_or_else(|e| panic!("{e}"));
    }
}

#[test]
fn the_gradient_of_total_variation_can_be_taken_more_than_once() {
    let lattice = Lattice::bricks([9, 6, 7]);
    let x = Tensor::variable(numbers(&[lattice.rows(), 3], -1.0, 1.0, 37));
    for value in [loss::total_variation(&x, &lattice), loss::total_variation_of_bricks(&x, &lattice, 2, 7)] {
        let weighted: Tensor<f64> = 3.0 * &value;
        let [first, again, three_times] = [value.backward().array(&x), value.backward().array(&x), weighted.backward().array(&x)];
        assert_eq!(first, again);
        assert!(first.iter().zip(&three_times).all(|(a, b)| (3.0 * a - b).abs() < 1e-15));
    }
    let bricks = lattice.rows() / 64;
    let values =
        || [loss::total_variation(&x, &lattice), loss::total_variation_of_bricks(&x, &lattice, bricks - 1, 3)].map(|value| value.item());
    assert_eq!(values(), autograd::no_grad(values));
}

#[test]
fn an_eikonal_penalty_is_differentiable_through_the_slope_of_the_density() {
    let shape = shape(Interpolation::Trilinear, Color::Rgb);
    // Points off the planes through voxel centres, where the slope jumps.
    let points = numbers(&[40, 3], -0.72, 0.72, 41).mapv(|x| if ((x + 1.0) * 2.0 - 0.5).fract().abs() < 0.02 { x + 0.03 } else { x });
    let f = |x: &[Tensor<f64>]| {
        let grid = grid_of(shape, &[x[0].clone(), Tensor::zeros(&[64, 3])]);
        let at = Tensor::variable(points.clone());
        let normal = &grad(&grid.density(&at).sum(), &[&at])[0];
        (normal.square().sum_axis(1).sqrt() - 1.0).square().mean()
    };
    let report = Gradcheck::new(f, vec![numbers(&[64, 1], 0.2, 2.0, 42)]).named("eikonal").order(1).run().unwrap_or_else(|e| panic!("{e}"));
    println!("| eikonal penalty | Trilinear density | 1 | {:.1e} |", report.worst_relative_error);
}

#[test]
fn the_basis_is_differentiable_in_the_directions() {
    let directions = numbers(&[7, 3], -1.0, 1.0, 51);
    Gradcheck::new(|x: &[Tensor<f64>]| sh::basis(&x[0], 3), vec![directions])
        .named("sh basis")
        .order(2)
        .run()
        .unwrap_or_else(|e| panic!("{e}"));
}
