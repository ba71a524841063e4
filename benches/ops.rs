//! Single ops at the sizes of the scripts they are compared with: `fwd_ms` forward, `ms` forward and backward from a given cotangent. `gflop_per_s` of a network
//! counts its matrix products; compare it with `gemm_…` of the bench `roofline`.
//!
//!     cargo bench --bench ops
//!     cargo bench --bench ops -- exp gather4 --repeats 21
//!
//! `hash_step` and `planes_step` are training steps; names with `_mixed` have products in mixed precision. `benches/peers` has the steps in PyTorch; there, Adam updates all rows of the tables, here those that were read.

mod support;

use autograd::nn::{Activation, Mlp};
use autograd::optim::{Adam, AdamMode, Optimizer};
use autograd::random::Stream;
use autograd::{Buffer, Indices, Module, Param, Precision, Real, Tensor, add_rows, impl_module};
use glam::DVec3;
use plenoxel::camera::Ray;
use plenoxel::field::encoding::Directions;
use plenoxel::field::factored::{self, Factored};
use plenoxel::field::hash_grid::{HashGrid, Shape};
use plenoxel::geometry::Aabb;
use plenoxel::render::{Engine, RenderOptions, render};
use plenoxel::sampling::{Jitter, Spacing};
use std::hint::black_box;
use support::{Arguments, arguments, median, numbers, peak_memory_mb, repeat, suffix, tensor};

const PICKS: usize = 1_000_000;
const SIDE: usize = 128;
const ROWS: usize = SIDE * SIDE * SIDE;

fn row(args: &Arguments, name: &str, inputs: &[&[usize]], f: impl Fn(&[Tensor<f32>]) -> Tensor<f32>) {
    if !args.wants(name) {
        return;
    }
    let constants: Vec<_> = inputs.iter().enumerate().map(|(i, shape)| tensor(shape, i as u64)).collect();
    let forward = repeat(args.repeats, || drop(black_box(f(&constants))));
    let cotangent = tensor(f(&constants).shape(), 99);
    let variables: Vec<_> = constants.into_iter().map(Tensor::into_variable).collect();
    let mut form = "";
    let both = repeat(args.repeats, || {
        let gradients = f(&variables).backward_from(&cotangent);
        form = if variables.iter().any(|v| gradients.get(v).is_some_and(|g| g.as_rows().is_some())) { "rows" } else { "dense" };
        drop(black_box(gradients));
    });
    print(name, Some(median(&forward)), &both, form, None);
}

/// Eight layers of one width for 65 536 rows of a constant input: forward, and the adjoint of the parameters.
fn network(args: &Arguments, width: usize, precision: Precision) {
    let (name, layers, rows) = (format!("mlp_8x{width}{}", suffix(precision)), 8, 65_536);
    if !args.wants(&name) {
        return;
    }
    let mut net = Mlp::<f32>::new("net", &vec![width; layers + 1], Activation::Relu, &Stream::new(1));
    net.precision = precision;
    let (x, cotangent) = (tensor(&[rows, width], 2), tensor(&[rows, width], 3));
    let forward = repeat(args.repeats, || drop(black_box(autograd::no_grad(|| net.forward(&x)))));
    let both = repeat(args.repeats, || drop(black_box(net.forward(&x).backward_from(&cotangent))));
    // Forward, weights, and activations of all layers but the first.
    let products = (3 * layers - 1) as f64 * 2.0 * (rows * width * width) as f64;
    print(&name, Some(median(&forward)), &both, "dense", Some(products * 1e-6 / median(&both)));
}

/// A hash grid and a network, the density part of Instant-NGP.
struct Encoded<T: Real> {
    table: Param<T>,
    network: Mlp<T>,
}

impl_module!(Encoded { table, network });

/// Measures a forward pass, and a training step: forward pass, adjoint of the mean square, Adam of the rows that were read.
fn training_step<M: Module<f32>>(args: &Arguments, name: &str, model: &mut M, forward: impl Fn(&M) -> Tensor<f32>) {
    let values = repeat(args.repeats, || drop(black_box(autograd::no_grad(|| forward(model)))));
    let (mut adam, mut steps) = (Adam::new(1e-3, AdamMode::Lazy), 0);
    let times = repeat(args.repeats, || {
        let gradients = forward(model).square().mean().backward();
        adam.step(model, &gradients, steps);
        steps += 1;
    });
    print(name, Some(median(&values)), &times, "rows", None);
}

/// A training step of a hash grid (16 levels of two features, 16 to 2048 nodes a side, 2¹⁹ rows a level) with the layers 32, 64, 16 at 262 144 positions.
fn hash_step(args: &Arguments) {
    const NAME: &str = "hash_step";
    if !args.wants(NAME) {
        return;
    }
    let growth = 128f64.powf(1.0 / 15.0);
    let grid = HashGrid::new(Shape { levels: 16, features: 2, log2_rows: 19, base: 16, growth });
    let table = Param::from_tensor("table", tensor(&[grid.rows(), 2], 1) * 1e-4);
    let mut model = Encoded { table, network: Mlp::new("net", &[32, 64, 16], Activation::Relu, &Stream::new(1)) };
    let positions = tensor(&[1 << 18, 3], 2);
    training_step(args, NAME, &mut model, |model| model.network.forward(&grid.encode(model.table.tensor(), &positions)));
}

/// A training step of a factored field of the sizes of the preset `quality`, with 300 nodes a side, in thin fog: 4096 rays of 64 samples, each with a color.
fn planes_step(args: &Arguments, precision: Precision) {
    let name = format!("planes_step{}", suffix(precision));
    if !args.wants(&name) {
        return;
    }
    let (directions, aabb) = (Directions::Harmonics(3), Aabb { min: DVec3::NEG_ONE, max: DVec3::ONE });
    let shape =
        factored::Shape { density_components: 16, appearance_components: 48, features: 32, hidden: 128, feature_octaves: 0, directions };
    let mut model = Factored::<f32>::new(shape, aabb, [300; 3], &Stream::new(1));
    model.set_precision(precision);
    let starts = numbers(2 * 4096, 2);
    let origins = starts.as_chunks::<2>().0.iter().map(|&[x, y]| DVec3::new(2.0 * f64::from(x) - 1.0, 2.0 * f64::from(y) - 1.0, 2.0));
    let rays: Vec<Ray> = origins.map(|origin| Ray { origin, direction: DVec3::NEG_Z, stretch: 1.0 }).collect();
    let options = RenderOptions {
        aabb,
        spacing: Spacing::Step(2.0 / 64.0),
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::Fused,
        stop_below: 0.0,
    };
    assert_eq!(render(&model, &rays, &options).sample_count, 4096 * 64, "samples of the script it is compared with");
    training_step(args, &name, &mut model, |model| render(model, &rays, &options).rgb);
}

fn print(name: &str, forward: Option<f64>, both: &[f64], form: &str, gflop_per_s: Option<f64>) {
    let row = serde_json::json!({
        "workload": format!("op:{name}"), "fwd_ms": forward, "ms": median(both), "ms_min": both[0], "ms_max": both[both.len() - 1],
        "n": both.len(), "gradient": form, "gflop_per_s": gflop_per_s, "peak_rss_mb": peak_memory_mb(),
    });
    println!("{row}");
}

fn main() {
    support::on_the_pool(run);
}

fn run() {
    let args = arguments();
    let picks: Indices = numbers(PICKS, 7).iter().map(|x| ((x * ROWS as f32) as u32).min(ROWS as u32 - 1)).collect::<Vec<_>>().into();
    for width in [4, 28] {
        row(&args, &format!("gather{width}"), &[&[ROWS, width]], |x| x[0].gather_rows(&picks));
    }
    let points = Tensor::from_vec(numbers(3 * PICKS, 8).iter().map(|x| x * (SIDE - 1) as f32).collect(), &[PICKS, 3]);
    row(&args, "trilinear28", &[&[ROWS, 28]], |x| x[0].trilinear(&points, [SIDE; 3]));
    row(&args, "excumsum_5000x200", &[&[5000, 200]], |x| x[0].exclusive_cumsum(1));
    row(&args, "exp_5000x200", &[&[5000, 200]], |x| x[0].exp());
    row(&args, "exp_16M", &[&[16_000_000]], |x| x[0].exp());
    row(&args, "mulsum_5000x200x3", &[&[5000, 200], &[5000, 200, 3]], |x| (x[0].unsqueeze(2) * &x[1]).sum_axis(1));
    row(&args, "matmul_1024", &[&[1024, 1024], &[1024, 1024]], |x| x[0].matmul(&x[1]));
    row(&args, "matmul_65536x32x64", &[&[65536, 32], &[32, 64]], |x| x[0].matmul(&x[1]));
    for width in [16, 64, 128, 256] {
        network(&args, width, Precision::Full);
        network(&args, width, Precision::Mixed);
    }
    hash_step(&args);
    planes_step(&args, Precision::Full);
    planes_step(&args, Precision::Mixed);
    row(&args, "sum_16M", &[&[16_000_000]], |x| x[0].sum());
    for width in [4, 28] {
        let name = format!("scatter_add{width}");
        if args.wants(&name) {
            let (mut table, values) = (Buffer::zeros(ROWS * width), numbers(PICKS * width, 9));
            let times = repeat(args.repeats, || add_rows(&mut table, width, &picks, &values));
            print(&name, None, &times, "in place", None);
        }
    }
}
