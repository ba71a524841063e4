//! Measures the workloads that other systems are timed on: rays of a NeRF-synthetic scene reduced to 100 × 100, 5000 a step, 200 points on a ray,
//! the cube ±1.4. Times are of a whole step: batch, render, loss, backward, optimizer, projection of the rows it touched.
//!
//!     cargo bench --bench workloads -- --data nerf_synthetic/lego W1
//!
//! W4 is the path of pictures, with tables that are computed anew for each picture; `exact:W4` is the renderer of training, and the largest difference between both
//! is printed. `graph:W1` and so on are the same through the graph of small ops; `scaling:W1` and `scaling:W2` double one size after the other. `scale:RUN` measures what
//! several machines that train one scene would send (`support/scale.rs`). `pictures:RUN` renders test views of the data with the model of a run, one picture a
//! repetition, at most eight different ones. Without `--data` the rays are of the built-in scene. Peak memory is the process's, so
//! give one workload at a time to compare it.

#[path = "support/scale.rs"]
mod scale;
mod support;

use autograd::Lattice;
use autograd::optim::{Optimizer, Rates, Sgd};
use autograd::{Module, Param, value_and_grad};
use plenoxel::dataset::{self, Dataset, OpenOptions, Split};
use plenoxel::evaluate::Viewer;
use plenoxel::field::voxel_grid::fused::{PictureTables, render_picture};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::geometry::Aabb;
use plenoxel::loss::total_variation;
use plenoxel::rays::RaySource;
use plenoxel::render::picture::{picture, picture_unless};
use plenoxel::render::{Engine, RenderOptions, render};
use plenoxel::run::folder::RunFolder;
use plenoxel::sampling::{Jitter, Spacing};
use plenoxel::train::ViewOptions;
use std::hint::black_box;
use std::path::Path;
use support::{Arguments, arguments, median, peak_memory_mb, repeat};

const HALF_WIDTH: f64 = 1.4;

/// A step of training.
#[derive(Clone, Copy)]
struct Work {
    rays: usize,
    /// Points on a ray, about a third of which lie in the cube.
    points: usize,
    resolution: usize,
    /// Share of the voxels that are present: those with the smallest x.
    occupied: f64,
    interpolation: Interpolation,
    color: Color,
    rate: f64,
}

const W1: Work =
    Work { rays: 5000, points: 200, resolution: 128, occupied: 1.0, interpolation: Interpolation::Nearest, color: Color::Rgb, rate: 500.0 };
const W2: Work = Work { interpolation: Interpolation::Trilinear, color: Color::Sh { degree: 2, offset: 0.0 }, rate: 1.0, ..W1 };

fn options(points: usize, jitter: Jitter, engine: Engine) -> RenderOptions<'static> {
    let (aabb, spacing) = (Aabb::cube(HALF_WIDTH), Spacing::Points { samples: points, far: 10.0 / 1.2 });
    RenderOptions { aabb, spacing, jitter, background: [1.0; 3], occupancy: None, engine, stop_below: 0.0 }
}

/// Both engines, with what a row of theirs is called.
const ENGINES: [(Engine, &str); 2] = [(Engine::Fused, ""), (Engine::Graph, "graph:")];

fn grid(work: &Work) -> VoxelGrid<f32> {
    let Work { resolution, interpolation, color, .. } = *work;
    let grid = VoxelGrid::random(GridShape::new(resolution, HALF_WIDTH, interpolation, color), 1.0, 1.0, 0);
    if work.occupied == 1.0 {
        return grid;
    }
    let present = (work.occupied * resolution as f64) as usize;
    let kept = grid.voxels_where(|row| grid.lattice().node(row as u32).is_some_and(|[x, ..]| x < present));
    grid.pruned(&kept)
}

fn open(args: &Arguments, downscale: usize) -> Dataset {
    match &args.data {
        Some(folder) => dataset::open(Path::new(folder), &OpenOptions { downscale, ..OpenOptions::default() }).expect("the dataset opens"),
        None => Dataset::procedural(Default::default()).expect("the built-in scene opens"),
    }
}

/// W1 and W2: a step of training.
fn step(args: &Arguments, name: &str, engine: Engine, work: &Work) {
    let views = open(args, 8).load(Split::Train, &|_, _| {}).expect("the images load");
    let source = RaySource::new(views, [1.0; 3], 42);
    let mut grid = grid(work);
    let mut optimizer = Sgd::new(Rates::new(work.rate));
    grid.project();
    let (mut number, mut samples) = (0, 0);
    let times = repeat(args.repeats, || {
        let batch = source.batch::<f32>(number * work.rays as u64, work.rays);
        let (loss, gradients) = value_and_grad(|| {
            let options = options(work.points, Jitter::PerRay { seed: 42, step: number }, engine);
            let rendered = render(&grid, &batch.rays, &options);
            samples = rendered.sample_count;
            (&rendered.rgb - &batch.target).square().sum() / work.rays as f64
        });
        assert!(loss.is_finite());
        optimizer.step(&mut grid as &mut dyn Module<f32>, &gradients, number);
        number += 1;
    });
    print(name, &times, Some(work.rays), samples);
}

/// Each size of a workload from an eighth of it to the whole, rays and points from a quarter to twice.
fn scaling(args: &Arguments, name: &str, work: &Work) {
    let row = |what: &str, size: usize, work: Work| step(args, &format!("{name}:{what}={size}"), Engine::Fused, &work);
    for k in 0..4 {
        row("rays", 1250 << k, Work { rays: 1250 << k, ..*work });
        row("points", 50 << k, Work { points: 50 << k, ..*work });
        row("side", 16 << k, Work { resolution: 16 << k, ..*work });
        row("eighths_occupied", 1 << k, Work { occupied: f64::from(1 << k) / 8.0, ..*work });
    }
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
            step(&args, &name, engine, &W1);
        }
        if let Some(name) = row("W2") {
            step(&args, &name, engine, &W2);
        }
        if let Some(name) = row("W4") {
            image(&args, &name, engine, engine == Engine::Fused);
        }
    }
    if args.wants("exact:W4") {
        image(&args, "exact:W4", Engine::Fused, false);
    }
    for (name, work) in [("scaling:W1", W1), ("scaling:W2", W2)] {
        if args.wants(name) {
            scaling(&args, name, &work);
        }
    }
    for folder in args.names.iter().filter_map(|name| name.strip_prefix("scale:")) {
        scale::run(folder, &open(&args, 1));
    }
    for folder in args.names.iter().filter_map(|name| name.strip_prefix("pictures:")) {
        pictures(&args, folder);
    }
    if args.wants("W3") {
        let lattice = Lattice::bricks([128; 3]);
        let table = Param::from_tensor("grid", support::tensor(&[128 * 128 * 128, 4], 0));
        let times = repeat(args.repeats, || drop(black_box(value_and_grad(|| total_variation(table.tensor(), &lattice)))));
        print("W3", &times, None, 0);
    }
}

/// Pictures of the model of a run, from cameras of test views that are evenly spaced among all.
fn pictures(args: &Arguments, folder: &str) {
    let cameras = open(args, 1).cameras(Split::Test);
    let (run, config, _) = RunFolder::open(Path::new(folder)).expect("a run folder");
    let (model, about) = plenoxel::model::open(&run.existing_checkpoint().expect("a checkpoint"), &config).expect("a model");
    let viewer = Viewer::of(&*model, &ViewOptions::over(about.background));
    let step = cameras.len().div_ceil(8);
    let mut shown = cameras.iter().step_by(step).cycle();
    let times = repeat(args.repeats, || drop(black_box(viewer.see(shown.next().expect("there is a test view")))));
    let pixels = cameras[0].intrinsics.width * cameras[0].intrinsics.height;
    print(&format!("pictures:{folder}"), &times, Some(pixels), 0);
}

/// W4: a picture, from tables of the grid or through [`render`].
fn image(args: &Arguments, name: &str, engine: Engine, from_tables: bool) {
    let dataset = open(args, 1);
    let mut camera = dataset.cameras(Split::Test)[0];
    if args.data.is_none() {
        camera.intrinsics = plenoxel::camera::Intrinsics::from_fov_x(800, 800, camera.intrinsics.fov_x());
    }
    let grid = grid(&W2);
    let pixels = camera.intrinsics.width * camera.intrinsics.height;
    let options = options(W2.points, Jitter::None, engine);
    let exact = || picture(&grid, &camera, &options);
    let show = || {
        let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
        picture_unless(|rays| render_picture(&grid, &tables, rays, &options), &camera, PictureTables::<f32>::TILE, || false)
            .expect("nothing stops it")
    };
    let times = repeat(args.repeats.min(3), || drop(black_box(if from_tables { show() } else { exact() })));
    print(name, &times, Some(pixels), 0);
    if from_tables {
        let largest = (show().rgb - exact().rgb).iter().fold(0.0, |largest: f32, difference| largest.max(difference.abs()));
        eprintln!("{name}: largest difference to exact:{name}: {:.2} 8-bit steps", 255.0 * largest);
    }
}
