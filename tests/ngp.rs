//! The hash grid and the model on it: gradients, training, resuming and checkpoints.

use crate::own_losses;
use autograd::{Module, Param, Precision, Real, Tensor, check_kernel, gradcheck, random::Stream};
use glam::DVec3;
use ndarray::ArrayD;
use plenoxel::camera::Ray;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::evaluate::{constant_psnr, evaluate, mean_image};
use plenoxel::field::hash_grid::{HashGrid, Shape};
use plenoxel::geometry::Aabb;
use plenoxel::loss::{Objective, mse};
use plenoxel::model;
use plenoxel::model::ngp::{Config, Ngp, Stage, network_l2};
use plenoxel::model::plenoxels::config::Hull;
use plenoxel::render::Engine;
use plenoxel::sampling::Jitter;
use plenoxel::train::{About, Model, Pass, TrainOptions, Trainer, ViewOptions};

const BOX: Aabb = Aabb { min: DVec3::splat(-1.4), max: DVec3::splat(1.4) };

const PASS: Pass = Pass { background: [1.0; 3], jitter: Jitter::None, keep_samples: false, stage: None };

/// A grid with levels of both kinds: 4³ nodes in 64 rows, and 10³ and 25³ nodes that share 64 rows.
fn small(features: usize) -> HashGrid {
    HashGrid::new(Shape { levels: 3, features, log2_rows: 6, base: 4, growth: 2.5 })
}

fn table<T: Real>(grid: &HashGrid) -> ArrayD<T> {
    Stream::new(2).named("table").uniform_tensor(&[grid.rows(), grid.shape().features], -1.0, 1.0).to_array()
}

fn positions<T: Real>(count: usize) -> ArrayD<T> {
    Stream::new(2).named("positions").uniform_tensor(&[count, 3], 0.02, 0.98).to_array()
}

#[test]
fn levels_have_the_rows_of_tiny_cuda_nn() {
    let grid = HashGrid::new(Shape { levels: 8, features: 4, log2_rows: 19, base: 16, growth: 2.0 });
    let found: Vec<_> = grid.levels().iter().map(|level| (level.scale, level.resolution, level.rows, level.hashed)).collect();
    // 16³, 32³ and 64³ nodes fit in 2¹⁹ rows.
    assert_eq!(found[..4], [(15.0, 16, 4096, false), (31.0, 32, 32_768, false), (63.0, 64, 262_144, false), (127.0, 128, 1 << 19, true)]);
    assert!(found[4..].iter().all(|level| level.2 == 1 << 19 && level.3));
    // 5³ = 125 nodes have 128 rows.
    let odd = HashGrid::new(Shape { levels: 1, features: 2, log2_rows: 10, base: 5, growth: 1.0 });
    assert_eq!((odd.levels()[0].resolution, odd.rows()), (5, 128));
}

#[test]
fn a_position_has_the_features_of_its_corners() {
    let grid = small(2);
    let (row, width) = (|r: usize| (0..2).map(move |f| (10 * r + f) as f64), grid.width());
    let values: Vec<f64> = (0..grid.rows()).flat_map(row).collect();
    // At x = 0.5 / 3 the first level, of scale 3, has u = 1: node (1, 1, 1), which is row 1 + 4 + 16 after the 128 rows of the other levels.
    let at = Tensor::from_vec(vec![0.5 / 3.0; 3], &[1, 3]);
    let encoded = grid.encode(&Tensor::from_vec(values, &[grid.rows(), 2]), &at);
    assert_eq!(encoded.shape(), [1, width]);
    assert!((encoded.data()[0] - 1490.0).abs() < 1e-9 && (encoded.data()[1] - 1491.0).abs() < 1e-9, "{:?}", encoded.data());
    // The second level has scale 9: u = 2 at x = 1/6. Node (2, 2, 2) has a row of the hash.
    let hash = (2u32 ^ 2u32.wrapping_mul(2_654_435_761) ^ 2u32.wrapping_mul(805_459_861)) % 64;
    assert!((encoded.data()[2] - f64::from(10 * hash)).abs() < 1e-9, "{:?}", encoded.data());
}

#[test]
fn the_kernel_agrees_with_its_reference_in_value_and_gradients() {
    // The levels of 4³, 6³ and 7³ nodes have 624 rows, and a bucket has 512: the third level is in two buckets.
    let straddling = HashGrid::new(Shape { levels: 5, features: 2, log2_rows: 9, base: 4, growth: 1.3 });
    check_kernel(|x: &[Tensor<f64>]| straddling.encode(&x[0], &x[1]), [table(&straddling), positions(3000)], 1e-12).expect("agreement");
    // Nodes share the rows of the level, which is in two buckets.
    let large = HashGrid::new(Shape { levels: 1, features: 8, log2_rows: 19, base: 100, growth: 1.0 });
    check_kernel(|x: &[Tensor<f64>]| large.encode(&x[0], &x[1]), [table(&large), positions(300)], 1e-12).expect("agreement");
    for features in [1, 2, 4, 8] {
        let grid = small(features);
        // 3000 positions: several chunks, and every row is shared by many of them.
        for count in [1, 37, 3000] {
            let encode = |x: &[Tensor<f64>]| grid.encode(&x[0], &x[1]);
            check_kernel(encode, [table(&grid), positions(count)], 1e-12).unwrap_or_else(|e| panic!("{features} features: {e}"));
        }
        // A fused multiply-add may put a position on the other side of a face, where the slope differs: the table alone.
        let at = Tensor::constant(positions::<f32>(3000));
        check_kernel(|x: &[Tensor<f32>]| grid.encode(&x[0], &at), [table(&grid)], 1e-5)
            .unwrap_or_else(|e| panic!("{features} features: {e}"));
    }
}

/// Compares the gradient of the table with the sum of those of single positions.
fn check_against_single_positions<T: Real>(features: usize, tolerance: f64) {
    let grid = HashGrid::new(Shape { levels: 5, features, log2_rows: 9, base: 4, growth: 1.3 });
    let (count, width) = (200, grid.width());
    // Along a line through cells with even and with odd x. Every third cotangent is 0, and those of a whole group.
    let at = |i: usize| [0.1 + 0.004 * i as f64, 0.3, 0.9 - 0.002 * i as f64].map(T::lit);
    let contributes = |i: usize| !i.is_multiple_of(3) && !(64..128).contains(&i);
    let g = |i: usize| (0..width).map(move |k| T::lit(if contributes(i) { ((i + k) % 7) as f64 - 2.5 } else { 0.0 }));
    let table = Tensor::variable(table::<T>(&grid));
    let gradients = |range: std::ops::Range<usize>| {
        let encoded = grid.encode(&table, &Tensor::from_vec(range.clone().flat_map(at).collect(), &[range.len(), 3]));
        encoded.backward_from(&Tensor::from_vec(range.clone().flat_map(g).collect(), &[range.len(), width]))
    };
    let all = gradients(0..count);
    let singly = (0..count).map(|i| gradients(i..i + 1).array(&table)).reduce(|sum, one| sum + one).expect("positions");
    let found = all.array(&table);
    let largest = singly.iter().fold(0.0, |largest: f64, x| largest.max(x.as_f64().abs()));
    for (found, want) in found.iter().zip(&singly) {
        assert!((*found - *want).as_f64().abs() <= tolerance * largest, "{features} features: {found}, not {want}");
    }
    let with_values: Vec<u32> =
        (0..).zip(found.rows()).filter(|(_, row)| row.iter().any(|&x| x != T::zero())).map(|(row, _)| row).collect();
    assert_eq!(all.get(&table).and_then(|gradient| gradient.as_rows()).expect("rows").rows(), with_values);
}

#[test]
fn contributions_are_those_of_single_positions_and_those_of_zero_cotangents_are_left_out() {
    for features in [1, 2, 4, 8] {
        check_against_single_positions::<f64>(features, 1e-13);
        check_against_single_positions::<f32>(features, 1e-5);
    }
}

#[test]
fn derivatives_of_both_orders_are_right() {
    let grid = HashGrid::new(Shape { levels: 2, features: 2, log2_rows: 4, base: 2, growth: 2.5 });
    gradcheck(|x| grid.encode(&x[0], &x[1]).square(), [table(&grid), positions(3)]);
}

#[test]
fn positions_outside_are_clamped_and_have_no_slope() {
    let grid = small(2);
    let table = Tensor::constant(table::<f64>(&grid));
    let encoded = |at: [f64; 3]| grid.encode(&table, &Tensor::from_vec(at.to_vec(), &[1, 3])).data().to_vec();
    assert_eq!(encoded([-0.5, 0.4, 1.5]), encoded([0.0, 0.4, 1.0]));
    let at = Tensor::variable(ndarray::arr2(&[[-0.5, 0.4, 1.5]]));
    let slope = grid.encode(&table, &at).sum().backward().array(&at);
    assert!(slope[[0, 0]] == 0.0 && slope[[0, 1]] != 0.0 && slope[[0, 2]] == 0.0);
}

#[test]
fn gradients_of_the_table_have_the_same_bits_for_any_number_of_threads() {
    let grid = HashGrid::new(Shape { levels: 4, features: 4, log2_rows: 14, base: 8, growth: 2.0 });
    let table = Tensor::variable(table::<f32>(&grid));
    let at = Tensor::constant(positions::<f32>(20_000));
    let gradient = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| grid.encode(&table, &at).square().sum().backward().array(&table))
    };
    let want = gradient(1);
    assert!(want.iter().any(|&g| g != 0.0) && [2, 3].into_iter().all(|threads| gradient(threads) == want));
}

fn tiny(stages: &[(u64, usize)]) -> Config {
    Config {
        levels: 4,
        features: 2,
        log2_rows: 12,
        base_resolution: 8,
        finest_resolution: 64,
        hidden: 16,
        color_layers: 1,
        samples: 64.0,
        color_above: 0.0,
        stop_below: 0.0,
        stop_below_in_pictures: 0.0,
        cells: 32,
        refresh_all_until: 32,
        decay_from: 300,
        decay_every: 50,
        stages: stages.iter().map(|&(steps, rays)| Stage { steps, rays }).collect(),
        ..Config::default()
    }
}

/// A model whose table is not close to 0, so that density and color vary.
fn varied<T: Real>(config: Config) -> Ngp<T> {
    let mut model = Ngp::<T>::new(config, BOX, 42).expect("valid settings");
    model.visit_mut(&mut |param: &mut Param<T>| {
        if param.name() == plenoxel::field::ngp::TABLE {
            let values = Stream::new(3).uniform_tensor(param.shape(), -2.0, 2.0);
            *param = Param::from_tensor(param.name(), values);
        }
    });
    model
}

fn rays(count: usize) -> Vec<Ray> {
    let random = Stream::new(5);
    let at = |name: &str| random.named(name).uniform_tensor::<f64>(&[count, 3], -0.8, 0.8);
    let (from, to) = (at("from"), at("to"));
    let point = |tensor: &Tensor<f64>, i: usize| DVec3::from_slice(&tensor.data()[3 * i..][..3]);
    (0..count)
        .map(|i| {
            let origin = point(&from, i) + DVec3::new(0.0, 0.0, 4.0);
            Ray { origin, direction: (point(&to, i) - origin).normalize(), stretch: 1.0 }
        })
        .collect()
}

/// Replaces the parameters of a model by tensors.
fn bind(model: &mut Ngp<f64>, tensors: &[Tensor<f64>]) {
    let mut next = tensors.iter();
    model.visit_mut(&mut |param: &mut Param<f64>| {
        let tensor = next.next().expect("a tensor for each parameter").clone();
        if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
    });
}

#[test]
fn gradients_of_pixels_with_respect_to_every_parameter_are_right_in_both_orders() {
    let config =
        || Config { levels: 2, log2_rows: 5, base_resolution: 3, finest_resolution: 6, hidden: 6, samples: 6.0, ..tiny(&[(1, 1)]) };
    let model = varied::<f64>(config());
    // Few rays, samples and hidden units, none of which is at the kink of its ReLU.
    let rays = rays(2);
    let mut inputs = Vec::new();
    model.visit(&mut |param| inputs.push(param.tensor().to_array()));
    let pixels = |x: &[Tensor<f64>]| {
        let mut model = varied::<f64>(config());
        bind(&mut model, x);
        model.render(&rays, &PASS).rgb
    };
    gradcheck(pixels, inputs);
}

#[test]
fn both_engines_render_the_same_pixels_and_opaque_matter_ends_a_ray() {
    let mut model = varied::<f64>(tiny(&[(1, 1)]));
    let rays = rays(40);
    let pixels = |model: &Ngp<f64>| model.render(&rays, &PASS);
    let fused = pixels(&model);
    model.engine = Engine::Graph;
    let graph = pixels(&model);
    assert_eq!((fused.rgb.data(), fused.sample_count), (graph.rgb.data(), graph.sample_count));
    let jittered = Pass { jitter: Jitter::PerRay { seed: 1, step: 2 }, ..PASS };
    let stopping = varied::<f64>(Config { stop_below: 0.5, color_above: 1e-3, ..tiny(&[(1, 1)]) });
    let (some, all) = (stopping.render(&rays, &jittered), model.render(&rays, &jittered));
    assert!(some.sample_count < all.sample_count, "{} of {}", some.sample_count, all.sample_count);
    let off = some.rgb.data().iter().zip(all.rgb.data()).fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
    assert!(off > 0.0 && off <= 0.6, "{off}");
}

fn views() -> (Vec<View>, Vec<View>) {
    let options = ProceduralOptions { width: 32, height: 32, train: 24, val: 0, test: 4, supersample: 2 };
    let scene = Dataset::procedural(options).expect("the built-in scene");
    let load = |split| scene.load(split, &|_, _| {}).expect("its views");
    (load(Split::Train), load(Split::Test))
}

fn trainer(views: &[View], model: Ngp<f32>) -> Trainer<f32, Ngp<f32>> {
    let objective = Objective::new().with("mse", 1.0, mse).with("network_l2", 1e-6, network_l2);
    Trainer::with_model(model, views, objective, TrainOptions::default()).expect("a trainer")
}

fn new(stages: &[(u64, usize)]) -> Ngp<f32> {
    Ngp::new(settings(stages), BOX, 42).expect("valid settings")
}

fn settings(stages: &[(u64, usize)]) -> Config {
    Config { stop_below: 1e-3, stop_below_in_pictures: 1e-3, color_above: 1e-4, ..tiny(stages) }
}

fn psnr(model: &Ngp<f32>, views: &[View]) -> f64 {
    evaluate(model, views, &ViewOptions::over([1.0; 3])).psnr().expect("a figure")
}

#[test]
fn training_has_the_same_bits_for_any_number_of_threads() {
    let (train, _) = views();
    let trained = |threads: usize, mixed_precision: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let config = Config { mixed_precision, ..settings(&[(50, 512)]) };
            let mut trainer = trainer(&train, Ngp::new(config, BOX, 42).expect("valid settings"));
            while trainer.step().expect("a step").is_some() {}
            let mut bits = Vec::new();
            trainer.model().visit(&mut |param| bits.extend(param.tensor().data().iter().map(|x| x.to_bits())));
            bits
        })
    };
    let want = [false, true].map(|mixed_precision| trained(1, mixed_precision));
    assert!([2, 3].into_iter().all(|threads| [false, true].map(|mixed_precision| trained(threads, mixed_precision)) == want));
    assert!(want[0] != want[1] || !Precision::Mixed.is_available());
}

#[test]
fn a_scene_is_learned_and_a_resumed_run_has_the_same_bits() {
    let (train, test) = views();
    let mut whole = trainer(&train, new(&[(250, 512), (150, 512)]));
    (0..300).for_each(|_| drop(whole.step().expect("a step")));
    let file = std::env::temp_dir().join(format!("ngp-{}.safetensors", std::process::id()));
    whole.save(&file, "scene").expect("saved");
    let mut resumed = trainer(&train, new(&[(250, 512), (150, 512)])).resumed(&file).expect("resumed");
    while let Some(report) = whole.step().expect("a step") {
        assert_eq!(resumed.step().expect("a step").as_ref(), Some(&report));
    }
    // Biases stay zeros.
    whole.model().visit(&mut |param| assert!(!param.name().ends_with("bias") || param.tensor().data().iter().all(|&x| x == 0.0)));
    // With the seed 42.
    let trained = psnr(whole.model(), &test);
    assert!(trained > 20.0, "{trained}");

    let about = About { scene: "scene".to_owned(), background: [1.0; 3], seed: 42, step: 400 };
    Model::<f32>::save(whole.model(), &file, &about).expect("saved");
    let (opened, found) = Ngp::<f32>::open(&file).expect("opened");
    assert_eq!((found, psnr(&opened, &test)), (about, trained));
    assert_eq!(model::kind(&file).expect("a kind"), model::ngp::KIND);
    std::fs::remove_file(file).expect("removed");
}

#[test]
fn a_scene_is_learned_without_silhouettes_and_with_parameters_of_losses() {
    let (train, test) = views();
    let model = new(&[(400, 512)]).with_hull(Hull::Off);
    let objective =
        Objective::new().with("mse", 1.0, mse).with("opacity", 1e-3, |step| step.rendered.opacity.mean()).with_exposure(1e-3, train.len());
    let mut trainer = Trainer::with_model(model, &train[..], objective, TrainOptions::default()).expect("a trainer");
    while trainer.step().expect("a step").is_some() {}
    let psnr = psnr(trainer.model(), &test);
    let mean = mean_image(&train, [1.0; 3]).and_then(|mean| constant_psnr(&test, &mean, [1.0; 3])).expect("a figure");
    assert!(psnr > mean + 2.0, "{psnr}, {mean} of the mean image");
}

#[test]
fn the_occupancy_follows_the_field() {
    let (train, _) = views();
    let mut trainer = trainer(&train, new(&[(200, 512)]));
    while trainer.step().expect("a step").is_some() {}
    let occupied = trainer.model().field().occupied.as_ref().expect("cells").fraction();
    assert!(occupied > 0.0 && occupied < 0.5, "{occupied}");
}

#[test]
fn exposure_and_other_losses_and_parameters_train_without_change() {
    let (train, _) = views();
    let names = own_losses::train(new(&[(20, 128)]), Objective::new().with("mse", 1.0, mse), &train);
    assert_eq!(names, ["mse", "exposure", "distortion", "thin"]);
}

#[test]
fn settings_without_meaning_are_refused_by_their_key() {
    type Change = fn(&mut Config);
    let wrong: [(&str, Change); 6] = [
        ("features", |config| config.features = 3),
        ("log2_rows", |config| config.log2_rows = 25),
        ("finest_resolution", |config| config.finest_resolution = 4),
        ("samples", |config| config.samples = 0.0),
        ("stages", |config| config.stages.clear()),
        ("stages[0].steps", |config| config.stages[0].steps = 0),
    ];
    for (key, change) in wrong {
        let mut config = tiny(&[(4, 1)]);
        change(&mut config);
        let error = Ngp::<f32>::new(config, BOX, 42).expect_err(key);
        assert!(error.exit_code() == 2 && error.to_string().starts_with(key), "{error}");
    }
    Config::authors().validate().expect("the authors' settings are valid");
}
