//! The fused engine against the graph: values and gradients of every column, on chosen rays and on a thousand random scenes.
//!
//! The graph itself is held to finite differences in `gradients.rs` and to closed forms in `analytic_scenes.rs`. To see that this suite can
//! fail, change any one term of `sigma_of_ray` in `render/fused/adjoint.rs`: most of it does.

use crate::support;
use autograd::{Lattice, Real, Tensor, no_grad};
use plenoxel::camera::Ray;
use plenoxel::field::sh;
use plenoxel::field::voxel_grid::{Color, GridShape, GridSpace, Interpolation, VoxelGrid};
use plenoxel::geometry::Aabb;
use plenoxel::random::{Purpose, bits, uniform};
use plenoxel::render::{Engine, RenderOptions, Rendered, render};
use plenoxel::sampling::{Jitter, Spacing};
use plenoxel::space::Space;
use support::ray;

const COLUMNS: [(&str, usize); 6] =
    [("rgb", 3), ("depth", 1), ("opacity", 1), ("log transmittance", 1), ("sparsity", 1), ("distortion", 1)];

fn column<T: Real>(rendered: &Rendered<T>, name: &str) -> Tensor<T> {
    match name {
        "rgb" => rendered.rgb.clone(),
        "depth" => rendered.depth(),
        "opacity" => rendered.opacity.clone(),
        "log transmittance" => rendered.log_transmittance.clone(),
        "sparsity" => rendered.sparsity(),
        "distortion" => rendered.distortion(),
        _ => unreachable!(),
    }
}

/// ‖a − b‖ / ‖b‖, where ‖b‖ counts as 10⁻² at least: in thick matter of one color a gradient is what is left of terms of size 1.
fn distance<T: Real>(a: &[T], b: &[T]) -> f64 {
    assert_eq!(a.len(), b.len());
    let norm = |x: &mut dyn Iterator<Item = f64>| x.map(|v| v * v).sum::<f64>().sqrt();
    let size = norm(&mut b.iter().map(|v| v.as_f64()));
    let off = norm(&mut a.iter().zip(b).map(|(a, b)| a.as_f64() - b.as_f64()));
    assert!(off.is_finite() && size.is_finite());
    off / size.max(1e-2)
}

/// The worst distance between the engines over all columns and their gradients by all tables, with the name of where it is.
fn worst<T: Real>(grid: &VoxelGrid<T>, rays: &[Ray], options: &RenderOptions<'_>) -> (f64, String) {
    let mut worst = (0.0, String::new());
    for (name, width) in COLUMNS {
        let [fused, graph] = [Engine::Fused, Engine::Graph].map(|engine| {
            let rendered = render(grid, rays, &RenderOptions { engine, ..options.clone() });
            let value = column(&rendered, name);
            // A cotangent of its own for every number.
            let cotangent: Vec<T> = (0..rays.len() * width).map(|i| T::lit(uniform(5, Purpose::Initial, 9, i as u64) - 0.3)).collect();
            let loss = (&value * Tensor::from_vec(cotangent, value.shape())).sum();
            let gradients = loss.backward();
            let by: Vec<(String, Vec<T>)> =
                grid.params().map(|p| (format!("by {}", p.name()), gradients.array(p.tensor()).into_iter().collect())).collect();
            (value.data().to_vec(), by, rendered.sample_count)
        });
        assert_eq!(fused.2, graph.2, "{name}: numbers of samples");
        let by = fused.1.iter().zip(&graph.1).map(|((what, fused), (_, graph))| (&what[..], distance(fused, graph)));
        for (what, d) in [("value", distance(&fused.0, &graph.0))].into_iter().chain(by) {
            if d >= worst.0 {
                worst = (d, format!("{name}, {what}"));
            }
        }
    }
    worst
}

/// How a box is rendered.
fn options(aabb: Aabb, spacing: Spacing, jitter: Jitter, background: [f32; 3]) -> RenderOptions<'static> {
    RenderOptions { aabb, spacing, jitter, background, occupancy: None, engine: Engine::Fused, stop_below: 0.0 }
}

/// Rays from one side, into general directions.
fn rays_from_above(seed: u64, n: u64) -> Vec<Ray> {
    (0..n)
        .map(|r| {
            let coordinate = |k: u64| 2.0 * uniform(seed, Purpose::Initial, r, k) - 1.0;
            ray([3.0 * coordinate(0), 3.0 * coordinate(1), 3.0], [coordinate(2), coordinate(3), coordinate(4)])
        })
        .collect()
}

/// A scene in which everything is drawn: resolution, look-up, colors, how far harmonics are reduced, which voxels are there, spacing, jitter, rays.
struct Scene<T: Real> {
    grid: VoxelGrid<T>,
    rays: Vec<Ray>,
    spacing: Spacing,
    jitter: Jitter,
    background: [f32; 3],
}

impl<T: Real> Scene<T> {
    fn random(seed: u64) -> Self {
        let draw = |k: u64| uniform(seed, Purpose::Initial, 1, k);
        let pick = |k: u64, n: u64| bits(seed, Purpose::Initial, 2, k) % n;
        let resolution = 1 + pick(0, 11) as usize;
        let interpolation = [Interpolation::Nearest, Interpolation::Trilinear][pick(1, 2) as usize];
        let color = match pick(2, 5) {
            0 => Color::Rgb,
            d => Color::Sh { degree: d as usize - 1, offset: [0.0, 0.5][pick(3, 2) as usize] },
        };
        let contracted = pick(7, 3) == 2;
        let (half_width, space) = if contracted { (Space::CONTRACTED, Space::Contracted) } else { (0.7 + draw(4), Space::Box) };
        let shape = GridShape {
            sh_reduction: 1 + pick(13, 4) as usize,
            coordinates: GridSpace { space, ..GridSpace::WORLD },
            ..GridShape::new(resolution, half_width, interpolation, color)
        };
        let present = [1.0, 0.7, 0.15][pick(5, 3) as usize];
        let lattice = Lattice::bricks_where([resolution; 3], |[i, j, k]| {
            (i, j, k) == (0, 0, 0) || uniform(seed, Purpose::Initial, 3, ((i * 64 + j) * 64 + k) as u64) < present
        });
        let table = |lattice: &Lattice, width: usize, stream: u64, low: f64, high: f64| {
            let n = lattice.rows() * width;
            let values = (0..n as u64).map(|i| T::lit(low + (high - low) * uniform(seed, Purpose::Initial, stream, i))).collect();
            Tensor::from_vec(values, &[lattice.rows(), width])
        };
        // A third of the densities is below zero, and some matter is thick.
        let thick = [3.0, 60.0][pick(6, 2) as usize];
        let mut tables = vec![table(&lattice, 1, 4, -0.5 * thick, thick), table(&lattice, shape.color_width(), 5, -0.4, 0.9)];
        tables.extend(shape.harmonics_lattice(&lattice).map(|lattice| table(&lattice, shape.harmonics_width(), 6, -0.4, 0.9)));
        let grid = VoxelGrid::with_tables(shape, lattice, tables);
        let coordinate = |k: u64| 4.0 * draw(100 + k) - 2.0;
        let rays = (0..7)
            .map(|r| {
                let from = [0, 1, 2].map(|a| 2.0 * coordinate(6 * r + a));
                ray(from, [3, 4, 5].map(|a| 0.4 * coordinate(6 * r + a)))
            })
            .collect();
        let spacing = match pick(7, 3) {
            1 => Spacing::Points { samples: 5 + pick(9, 60) as usize, far: 8.0 },
            _ => shape.coordinates.spacing(shape.voxel_side() * (0.2 + 1.5 * draw(8))),
        };
        let jitter = [Jitter::None, Jitter::PerRay { seed, step: 3 }][pick(10, 2) as usize];
        Scene { grid, rays, spacing, jitter, background: [draw(11) as f32, draw(12) as f32, 1.0] }
    }

    fn options(&self) -> RenderOptions<'static> {
        options(self.grid.aabb(), self.spacing, self.jitter, self.background)
    }
}

/// Voxels a side with which the color table, in `f64`, is large enough for its rows to be read in their own order: degree 0 to 3.
const BEYOND_THE_CACHES: [usize; 4] = [144, 92, 72, 60];

#[test]
fn rows_read_in_their_own_order_agree() {
    let color = Color::Sh { degree: 2, offset: 0.5 };
    let shape = GridShape::new(BEYOND_THE_CACHES[2], 1.0, Interpolation::Trilinear, color);
    let full = VoxelGrid::<f64>::random(shape, 3.0, 0.3, 7);
    // A third of the voxels is missing, in every brick.
    let grid = full.pruned(&full.voxels_where(|row| row % 3 != 0));
    let rays = rays_from_above(5, 300);
    let options = options(grid.aabb(), Spacing::Step(0.04), Jitter::PerRay { seed: 1, step: 2 }, [1.0, 0.9, 0.2]);
    let (d, what) = worst(&grid, &rays, &options);
    assert!(d < 1e-10, "{what} is off by {d:e}");
}

#[test]
fn the_number_of_threads_changes_no_bit_if_rows_are_read_in_their_own_order() {
    let color = Color::Sh { degree: 2, offset: 0.5 };
    let shape = GridShape::new(BEYOND_THE_CACHES[2], 1.0, Interpolation::Trilinear, color);
    let grid = VoxelGrid::<f64>::random(shape, 3.0, 0.3, 7);
    // So many that the blocks of one thread are larger than those of three.
    let rays = rays_from_above(5, 2100);
    let options = options(grid.aabb(), Spacing::Step(0.04), Jitter::PerRay { seed: 1, step: 2 }, [1.0, 0.9, 0.2]);
    let step = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let rgb = render(&grid, &rays, &options).rgb;
            let gradients = rgb.square().sum().backward();
            (rgb.data().to_vec(), grid.params().map(|table| gradients.array(table.tensor())).collect::<Vec<_>>())
        })
    };
    let want = step(1);
    assert!(want.1.iter().all(|gradient| gradient.iter().any(|&g| g != 0.0)) && step(3) == want);
}

#[test]
fn rays_of_many_samples_agree_with_nearest_look_up() {
    // More samples than the smallest block has room for, in several runs of a ray. A full grid has no occupancy: its samples are counted before. With missing
    // voxels, the block grows.
    let shape = GridShape::new(30, 1.0, Interpolation::Nearest, Color::Rgb);
    let full = VoxelGrid::<f64>::random(shape, 1.0, 0.3, 7);
    let pruned = full.pruned(&full.voxels_where(|row| row % 3 != 0));
    let rays = rays_from_above(5, 150);
    for (grid, stop_below) in [(&full, 0.0), (&pruned, 0.0), (&pruned, 0.1)] {
        let spacing = Spacing::Step(0.015);
        let options = RenderOptions { stop_below, ..options(grid.aabb(), spacing, Jitter::PerRay { seed: 1, step: 2 }, [1.0, 0.9, 0.2]) };
        let (d, what) = worst(grid, &rays, &options);
        assert!(d < 1e-10, "{what} is off by {d:e} with a stop below {stop_below}");
    }
}

#[test]
fn a_picture_shows_what_a_training_batch_shows() {
    // Training reads the colors of harmonics in the order of the table, pictures ray by ray.
    for (degree, resolution) in BEYOND_THE_CACHES.into_iter().enumerate() {
        let color = Color::Sh { degree, offset: 0.5 };
        let shape = GridShape::new(resolution, 1.0, Interpolation::Trilinear, color);
        let grid = VoxelGrid::<f64>::random(shape, 2.0, 0.3, 7);
        let rays = rays_from_above(4, 600);
        let options = options(grid.aabb(), Spacing::Step(0.03), Jitter::None, [1.0; 3]);
        let (training, picture) = (render(&grid, &rays, &options), no_grad(|| render(&grid, &rays, &options)));
        assert!(training.rgb.is_tracked() && !picture.rgb.is_tracked());
        assert_eq!(training.rgb.data(), picture.rgb.data(), "degree {degree}");
    }
}

#[test]
fn a_batch_too_large_to_be_kept_is_marched_again_chunk_by_chunk() {
    // Three chunks, the last one not full.
    let n = 70_000;
    let rays = rays_from_above(3, n);
    let harmonics = Color::Sh { degree: 1, offset: 0.5 };
    for (interpolation, color, sh_reduction) in
        [(Interpolation::Nearest, Color::Rgb, 1), (Interpolation::Trilinear, harmonics, 1), (Interpolation::Trilinear, harmonics, 4)]
    {
        let shape = GridShape { sh_reduction, ..GridShape::new(9, 1.0, interpolation, color) };
        let full = VoxelGrid::<f64>::random(shape, 2.0, 1.0, 7);
        let grid = full.pruned(&full.voxels_where(|row| row % 3 != 0));
        let options = options(grid.aabb(), Spacing::Step(0.9), Jitter::PerRay { seed: 1, step: 2 }, [0.2, 0.5, 0.9]);
        let (d, what) = worst(&grid, &rays, &options);
        assert!(d < 1e-10, "{shape:?}: {what} is off by {d:e}");
    }
}

#[test]
fn a_thousand_random_scenes_agree_in_f64() {
    let (mut largest, mut place) = (0.0, String::new());
    for seed in 0..1000 {
        let scene = Scene::<f64>::random(seed);
        let (d, name) = worst(&scene.grid, &scene.rays, &scene.options());
        assert!(d < 1e-10, "seed {seed}, {:?}: {name} is off by {d:e}", scene.grid.shape());
        if d > largest {
            (largest, place) = (d, format!("seed {seed}, {name}"));
        }
    }
    println!("1000 random scenes in f64, 6 columns, values and gradients by all tables: worst relative error {largest:.1e} ({place})");
}

#[test]
fn random_scenes_agree_in_f32() {
    let mut largest = 0.0;
    for seed in 2000..2200 {
        let scene = Scene::<f32>::random(seed);
        let (d, name) = worst(&scene.grid, &scene.rays, &scene.options());
        assert!(d < 2e-4, "seed {seed}, {:?}: {name} is off by {d:e}", scene.grid.shape());
        largest = f64::max(largest, d);
    }
    println!("200 random scenes in f32: worst relative error {largest:.1e}");
}

#[test]
fn rays_of_every_kind_agree() {
    let rays = vec![
        ray([-3.0, 0.1, 0.2], [3.0, 0.1, 0.2]),
        ray([0.3, -3.0, 0.0], [0.3, 3.0, 0.0]),
        ray([0.1, 0.2, 0.3], [1.0, 0.9, -0.8]),
        ray([-3.0, 2.0, 0.0], [3.0, 2.5, 0.0]),
        ray([-3.0, 1.0, -1.0], [3.0, 1.0, -1.0]),
        ray([-3.0, -3.0, -3.0], [3.0, 3.0, 3.0]),
        ray([0.0, 0.0, 1.0], [0.5, 0.5, 3.0]),
    ];
    let with = |spacing| options(Aabb::cube(1.0), spacing, Jitter::None, [0.3, 0.6, 0.9]);
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        for color in [Color::Rgb, Color::Sh { degree: 2, offset: 0.5 }] {
            let shape = GridShape::new(6, 1.0, interpolation, color);
            let rows = shape.full().rows();
            let opaque = |row: usize| if row == 21 { 1e4 } else { 0.0 };
            let cases: [(&str, VoxelGrid<f64>); 4] = [
                ("random", VoxelGrid::random(shape, 2.0, 1.0, 7)),
                ("empty", VoxelGrid::uniform(shape, 0.0, 0.5)),
                ("opaque everywhere", VoxelGrid::uniform(shape, 1e4, 0.5)),
                (
                    "one opaque voxel",
                    VoxelGrid::from_tables(
                        shape,
                        Tensor::from_vec((0..rows).map(opaque).collect(), &[rows, 1]),
                        Tensor::full(&[rows, color.channels()], 0.2),
                    ),
                ),
            ];
            for (name, grid) in cases {
                for spacing in [Spacing::Step(0.07), Spacing::Step(5.0), Spacing::Points { samples: 60, far: 8.0 }] {
                    let (d, what) = worst(&grid, &rays, &with(spacing));
                    assert!(d < 1e-10, "{name}, {interpolation:?}, {color:?}, {spacing:?}: {what} is off by {d:e}");
                }
            }
        }
    }
}

#[test]
fn second_derivatives_go_through_the_graph() {
    let shape = support::shape(Interpolation::Trilinear, Color::Sh { degree: 1, offset: 0.5 });
    let tables = vec![support::numbers(&[64, 1], 0.2, 2.0, 21), support::numbers(&[64, 3 * sh::count(1)], -0.06, 0.06, 22)];
    let f = |x: &[Tensor<f64>]| {
        let options = options(Aabb::cube(1.0), Spacing::Step(0.23), Jitter::None, [1.0, 0.9, 0.8]);
        let rendered = render(&support::grid_of(shape, x), &support::rays(), &options);
        rendered.rgb.square().sum() + rendered.depth().square().sum() + rendered.distortion().sum()
    };
    autograd::Gradcheck::new(f, tables).named("fused").order(2).run().unwrap_or_else(|e| panic!("{e}"));
}

#[test]
fn gradients_of_rays_that_stop_are_those_of_what_they_render() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        let shape = support::shape(interpolation, Color::Sh { degree: 1, offset: 0.5 });
        let tables = vec![support::numbers(&[64, 1], 2.0, 6.0, 21), support::numbers(&[64, 3 * sh::count(1)], -0.06, 0.06, 22)];
        let with = |stop_below: f64| {
            move |x: &[Tensor<f64>]| {
                let options = options(Aabb::cube(1.0), Spacing::Step(0.23), Jitter::None, [1.0, 0.9, 0.8]);
                let options = RenderOptions { stop_below, ..options };
                let rendered = render(&support::grid_of(shape, x), &support::rays(), &options);
                rendered.rgb.square().sum() + rendered.depth().square().sum() + rendered.distortion().sum()
            }
        };
        let constants: Vec<Tensor<f64>> = tables.iter().cloned().map(Tensor::from).collect();
        let value = |stop_below: f64| with(stop_below)(&constants).item();
        assert!((value(0.3) - value(0.0)).abs() > 1e-3, "nothing is hidden");
        autograd::Gradcheck::new(with(0.3), tables.clone()).named("stopped").run().unwrap_or_else(|e| panic!("{e}"));
    }
}

#[test]
fn stopping_early_is_off_by_no_more_than_it_says() {
    for seed in 0..40 {
        let scene = Scene::<f64>::random(seed);
        let exact = render(&scene.grid, &scene.rays, &scene.options());
        for stop_below in [1e-1, 1e-2, 1e-4] {
            let stopped = render(&scene.grid, &scene.rays, &RenderOptions { stop_below, ..scene.options() });
            // Colors here are the rendered ones of any direction: bounded by the largest sum of coefficients.
            let brightest = 12.0;
            for (a, b) in stopped.rgb.data().iter().zip(exact.rgb.data()) {
                assert!((a - b).abs() <= stop_below * brightest, "seed {seed}, {stop_below}: {a} and {b}");
            }
        }
    }
}
