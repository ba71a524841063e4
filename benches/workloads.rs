//! The work that other systems are timed on: real rays of a NeRF-synthetic scene reduced to 100 × 100, 5000 a step, 200 points on a ray, the
//! cube ±1.4. Times are of a whole step: batch, render, loss, backward, optimizer, projection of the rows it touched.
//!
//!     cargo bench --bench workloads -- --data nerf_synthetic/lego W1
//!
//! `graph:W1` and so on are the same through the graph of small ops. Without `--data` the rays are of the built-in scene. Peak memory is the process's, so give one workload at a time to compare it.

mod support;

use autograd::Lattice;
use autograd::optim::{Optimizer, Rates, Sgd};
use autograd::{Module, Param, Tensor, value_and_grad};
use plenoxel::dataset::{self, Dataset, OpenOptions, Split};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::geometry::Aabb;
use plenoxel::loss::total_variation;
use plenoxel::rays::RaySource;
use plenoxel::render::picture::picture;
use plenoxel::render::{Engine, RenderOptions, render};
use plenoxel::sampling::{Jitter, Spacing};
use std::hint::black_box;
use std::path::Path;
use support::{Arguments, arguments, median, peak_memory_mb, repeat};

const RAYS: usize = 5000;
const HALF_WIDTH: f64 = 1.4;
const SPACING: Spacing = Spacing::Points { samples: 200, far: 10.0 / 1.2 };

fn options(jitter: Jitter, engine: Engine) -> RenderOptions<'static> {
    let aabb = Aabb::cube(HALF_WIDTH);
    RenderOptions { aabb, spacing: SPACING, jitter, background: [1.0; 3], occupancy: None, engine, stop_below: 0.0 }
}

/// Both engines, with what a row of theirs is called.
const ENGINES: [(Engine, &str); 2] = [(Engine::Fused, ""), (Engine::Graph, "graph:")];

fn grid(interpolation: Interpolation, color: Color) -> VoxelGrid<f32> {
    VoxelGrid::random(GridShape { resolution: 128, half_width: HALF_WIDTH, interpolation, color }, 1.0, 1.0, 0)
}

const HARMONICS: Color = Color::Sh { degree: 2, offset: 0.0 };

fn open(args: &Arguments, downscale: usize) -> Dataset {
    match &args.data {
        Some(folder) => dataset::open(Path::new(folder), &OpenOptions { downscale, validation_every: None }).expect("the dataset opens"),
        None => Dataset::procedural(Default::default()).expect("the built-in scene opens"),
    }
}

/// W1 and W2: a step of training.
fn step(args: &Arguments, name: &str, engine: Engine, mut grid: VoxelGrid<f32>, rate: f64) {
    let views = open(args, 8).load(Split::Train, &|_, _| {}).expect("the images load");
    let source = RaySource::new(&views, [1.0; 3], 42);
    let mut optimizer = Sgd::new(Rates::new(rate));
    grid.project();
    let (mut number, mut samples) = (0, 0);
    let times = repeat(args.repeats, || {
        let batch = source.batch::<f32>(number * RAYS as u64, RAYS);
        let (loss, gradients) = value_and_grad(|| {
            let rendered = render(&grid, &batch.rays, &options(Jitter::PerRay { seed: 42, step: number }, engine));
            samples = rendered.sample_count;
            (&rendered.rgb - &batch.target).square().sum() / RAYS as f64
        });
        assert!(loss.is_finite());
        optimizer.step(&mut grid as &mut dyn Module<f32>, &gradients, number);
        number += 1;
    });
    print(name, &times, Some(RAYS), samples);
}

fn print(name: &str, times: &[f64], rays: Option<usize>, samples: usize) {
    let ms = median(times);
    let row = serde_json::json!({
        "workload": name, "ms": ms, "ms_min": times[0], "ms_max": times[times.len() - 1], "n": times.len(), "steps_per_s": 1e3 / ms,
        "rays_per_s": rays.map(|r| r as f64 * 1e3 / ms), "samples": samples, "peak_rss_mb": peak_memory_mb(),
    });
    println!("{row}");
}

fn main() {
    support::on_the_pool(run);
}

fn run() {
    let args = arguments();
    for (engine, prefix) in ENGINES {
        let row = |name: &str| Some(format!("{prefix}{name}")).filter(|name| args.wants(name));
        if let Some(name) = row("W1") {
            step(&args, &name, engine, grid(Interpolation::Nearest, Color::Rgb), 500.0);
        }
        if let Some(name) = row("W2") {
            step(&args, &name, engine, grid(Interpolation::Trilinear, HARMONICS), 1.0);
        }
        if let Some(name) = row("W4") {
            image(&args, &name, engine);
        }
    }
    if args.wants("W3") {
        let lattice = Lattice::bricks([128; 3]);
        let table = Param::from_tensor("grid", Tensor::from_vec(support::numbers(128 * 128 * 128 * 4, 0), &[128 * 128 * 128, 4]));
        let times = repeat(args.repeats, || drop(black_box(value_and_grad(|| total_variation(table.tensor(), &lattice)))));
        print("W3", &times, None, 0);
    }
}

/// W4: a picture.
fn image(args: &Arguments, name: &str, engine: Engine) {
    let dataset = open(args, 1);
    let mut camera = dataset.cameras(Split::Test)[0];
    if args.data.is_none() {
        camera.intrinsics = plenoxel::camera::Intrinsics::from_fov_x(800, 800, camera.intrinsics.fov_x());
    }
    let grid = grid(Interpolation::Trilinear, HARMONICS);
    let pixels = camera.intrinsics.width * camera.intrinsics.height;
    let options = options(Jitter::None, engine);
    let times = repeat(args.repeats.min(3), || drop(black_box(picture(&grid, &camera, &options))));
    print(name, &times, Some(pixels), 0);
}
