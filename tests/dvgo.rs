//! DirectVoxGO: its gradients, the samples that it leaves out, training and resuming.

use crate::own_losses;
use autograd::{Module, Param, Precision, Real, Tensor, gradcheck, no_grad, random::Stream};
use glam::DVec3;
use plenoxel::camera::Ray;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::evaluate::evaluate;
use plenoxel::field::dvgo::{ColorNetwork, DenseGrid, shift_of};
use plenoxel::field::encoding::Directions;
use plenoxel::field::grouping::Grouping;
use plenoxel::geometry::Aabb;
use plenoxel::model;
use plenoxel::model::dvgo::{Config, Dvgo, Stage, objective};
use plenoxel::render::{Engine, Field, RenderOptions, Rendered, render};
use plenoxel::sampling::{Jitter, Spacing};
use plenoxel::train::{Model, Pass, TrainOptions, Trainer, ViewOptions};

const BOX: Aabb = Aabb { min: DVec3::splat(-1.4), max: DVec3::splat(1.4) };

/// A grid of random numbers whose density is neither fog nor nothing.
fn grid<T: Real>(nodes: [usize; 3], network: bool) -> DenseGrid<T> {
    let random = Stream::new(7);
    let network = network.then(|| ColorNetwork::new(4, Directions::Frequency(1), 6, 3, &random));
    let features = if network.is_some() { 4 } else { 3 };
    let mut grid = DenseGrid::new(BOX, nodes, features, network, shift_of(0.1), 0.5);
    grid.visit_mut(&mut |param: &mut Param<T>| {
        if ["density", "features"].contains(&param.name()) {
            let values = random.named(param.name()).uniform_tensor(param.shape(), -2.0, 2.0);
            *param = Param::from_tensor(param.name(), values);
        }
    });
    grid
}

fn rays(count: usize) -> Vec<Ray> {
    let random = Stream::new(5);
    let at = |name: &str| random.named(name).uniform_tensor::<f64>(&[count, 3], -0.8, 0.8);
    let (from, to) = (at("from"), at("to"));
    let point = |tensor: &Tensor<f64>, i: usize| DVec3::from_slice(&tensor.data()[3 * i..][..3]);
    let ray = |i: usize| {
        let origin = point(&from, i) + DVec3::new(0.0, 0.0, 4.0);
        Ray { origin, direction: (point(&to, i) - origin).normalize(), stretch: 1.0 }
    };
    (0..count).map(ray).collect()
}

fn rendered<T: Real>(grid: &DenseGrid<T>, rays: &[Ray], engine: Engine, stop_below: f64) -> Rendered<T> {
    let options = RenderOptions {
        aabb: grid.aabb(),
        spacing: Spacing::Step(0.31),
        jitter: Jitter::None,
        background: [1.0, 0.5, 0.25],
        occupancy: None,
        engine,
        stop_below,
    };
    render(grid, rays, &options)
}

#[test]
fn gradients_of_pixels_with_respect_to_every_parameter_are_right_in_both_orders() {
    for network in [false, true] {
        // Few rays and hidden units, none of which is at the kink of its ReLU.
        let rays = rays(2);
        let mut inputs = Vec::new();
        grid::<f64>([3, 4, 3], network).visit(&mut |param| inputs.push(param.tensor().to_array()));
        let pixels = |x: &[Tensor<f64>]| {
            let mut grid = grid::<f64>([3, 4, 3], network);
            let mut next = x.iter();
            grid.visit_mut(&mut |param: &mut Param<f64>| {
                let tensor = next.next().expect("a tensor for each parameter").clone();
                if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
            });
            rendered(&grid, &rays, Engine::Fused, 0.0).rgb
        };
        gradcheck(pixels, inputs);
    }
}

#[test]
fn what_is_left_out_changes_a_color_by_no_more_than_its_opacity() {
    let rays = rays(60);
    let colors = |engine: Engine, opacity_above: f64, above: f64, stop_below: f64| {
        let mut grid = grid::<f64>([9; 3], true);
        (grid.opacity_above, grid.grouping_in_pictures.above) = (opacity_above, above);
        let rendered = no_grad(|| rendered(&grid, &rays, engine, stop_below));
        (rendered.rgb.data().to_vec(), rendered.sample_count)
    };
    let (want, all) = colors(Engine::Graph, 0.0, 0.0, 0.0);
    let (same, count) = colors(Engine::Fused, 0.0, 0.0, 0.0);
    assert_eq!((&same, count), (&want, all));
    let (opacity_above, weight_above, stop_below) = (0.02, 0.01, 0.05);
    let (near, fewer) = colors(Engine::Fused, opacity_above, weight_above, stop_below);
    assert!(fewer < all);
    // On a ray of n samples, n (α + w) + T bounds the error: colors and backgrounds are in [0, 1].
    let longest = (BOX.max - BOX.min).length() / 0.31 + 1.0;
    let most = near.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(most > 0.0 && most < longest * (opacity_above + weight_above) + stop_below, "{most}");
}

#[test]
fn colors_between_the_drawn_members_of_groups_are_interpolated_and_have_gradients() {
    let mut grid = grid::<f64>([5; 3], true);
    grid.grouping_in_pictures = Grouping { weight: 0.3, ..Grouping::NONE };
    let rendered = rendered(&grid, &rays(4), Engine::Fused, 0.0);
    let samples = rendered.samples().expect("samples");
    let own = |r: usize| samples.samples.offsets[r] as usize..samples.samples.offsets[r + 1] as usize;
    let (t, red) = (samples.samples.t.data(), samples.radiance.rgb.index_axis(1, 0));
    for r in 0..4 {
        let slopes: Vec<f64> = own(r).skip(1).map(|i| (red.data()[i] - red.data()[i - 1]) / (t[i] - t[i - 1])).collect();
        let bends = slopes.windows(2).filter(|pair| (pair[0] - pair[1]).abs() > 1e-9).count();
        // Each group but the last has a weight of at least 0.3, of at most 1. A color bends at their members only.
        assert!(bends <= 4 && slopes.len() > 5, "{bends} of {}", slopes.len());
        assert!(slopes.iter().any(|&slope| slope != 0.0));
    }
    let gradients = rendered.rgb.sum().backward();
    grid.visit(&mut |param| assert!(gradients.of(param).is_some(), "{}", param.name()));
}

#[test]
fn a_finer_grid_of_the_same_nodes_is_the_same_field() {
    let mut field = grid::<f64>([4; 3], false);
    let positions = Stream::new(9).named("positions").uniform_tensor(&[40, 3], -1.4, 1.4);
    let before = field.density(&positions);
    // Three cells become six: a node on each old one, and one in the middle.
    field.resample(BOX, [7; 3]);
    for (a, b) in before.data().iter().zip(field.density(&positions).data()) {
        assert!((a - b).abs() < 1e-9 * a.max(1.0), "{a} {b}");
    }
}

#[test]
fn the_opacity_of_a_voxel_is_its_initial_one_where_the_raw_density_is_zero() {
    let field = DenseGrid::<f64>::new(BOX, [3; 3], 3, None, shift_of(1e-2), 0.25);
    let sigma = field.density(&Tensor::zeros(&[1, 3])).item();
    assert!((1.0 - (-sigma * 0.25).exp() - 1e-2).abs() < 1e-12);
}

fn views() -> (Vec<View>, Vec<View>) {
    let options = ProceduralOptions { width: 32, height: 32, train: 24, val: 0, test: 4, supersample: 2 };
    let scene = Dataset::procedural(options).expect("the built-in scene");
    let load = |split| scene.load(split, &|_, _| {}).expect("its views");
    (load(Split::Train), load(Split::Test))
}

/// A coarse stage and two fine stages; within the second, occupied cells are searched.
fn config(coarse: u64, fine: [u64; 2]) -> Config {
    let stage = |resolution: usize, steps: u64| Stage { resolution, steps, rays: 256 };
    Config {
        features: 6,
        hidden: 16,
        directions: Directions::Frequency(2),
        coarse: stage(16, coarse),
        fine: vec![stage(16, fine[0]), stage(24, fine[1])],
        // The authors' coarse stage is invisible for a thousand steps.
        coarse_opacity: 1e-3,
        coarse_above: 1e-5,
        occupied_above: 5e-3,
        shift_fall: 0.5,
        prune_every: fine[0] + fine[1],
        network_rate: 5e-3,
        tenth_every: 500,
        ..Config::default()
    }
}

fn trainer(views: &[View], config: Config) -> Trainer<f32, Dvgo<f32>> {
    let objective = objective(&config);
    Trainer::with_model(Dvgo::new(config, BOX, 42).expect("valid settings"), views, objective, TrainOptions::default()).expect("a trainer")
}

fn bits(model: &Dvgo<f32>) -> Vec<u32> {
    let mut bits = Vec::new();
    model.visit(&mut |param| bits.extend(param.tensor().data().iter().map(|x| x.to_bits())));
    bits
}

fn file(name: &str) -> std::path::PathBuf {
    std::env::temp_dir().join(format!("dvgo-{name}-{}.safetensors", std::process::id()))
}

#[test]
fn training_has_the_same_bits_for_any_number_of_threads() {
    let (train, _) = views();
    let trained = |threads: usize, mixed_precision: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let mut trainer = trainer(&train, Config { mixed_precision, ..config(40, [15, 15]) });
            while trainer.step().expect("a step").is_some() {}
            bits(trainer.model())
        })
    };
    let want = [false, true].map(|mixed_precision| trained(1, mixed_precision));
    assert!([2, 3].into_iter().all(|threads| [false, true].map(|mixed_precision| trained(threads, mixed_precision)) == want));
    assert!(want[0] != want[1] || !Precision::Mixed.is_available());
}

#[test]
fn a_resumed_run_has_the_same_bits_within_stages_and_between_them() {
    let (train, _) = views();
    let config = config(40, [15, 15]);
    let mut whole = trainer(&train, config.clone());
    let mut saved = Vec::new();
    let mut reports = Vec::new();
    // Within the coarse stage, after it, after the first fine stage and after a search for occupied cells within the second.
    while let Some(report) = whole.step().expect("a step") {
        reports.push(report);
        let steps = whole.steps_taken();
        if [20, 40, 55, 65].contains(&steps) {
            let file = file(&format!("{steps}"));
            whole.save(&file, "scene").expect("saved");
            saved.push((steps, file));
        }
    }
    for (steps, file) in saved {
        let mut resumed = trainer(&train, config.clone()).resumed(&file).expect("resumed");
        for report in &reports[steps as usize..] {
            assert_eq!(resumed.step().expect("a step").as_ref(), Some(report), "resumed after {steps} steps");
        }
        assert!(bits(resumed.model()) == bits(whole.model()));
        std::fs::remove_file(file).expect("removed");
    }
}

#[test]
fn a_scene_is_learned_and_a_model_that_was_read_shows_the_same_images() {
    let (train, test) = views();
    let mut trainer = trainer(&train, Config { mixed_precision: true, ..config(150, [100, 250]) });
    let psnr = |model: &dyn Model<f32>| evaluate(model, &test, &ViewOptions::over([1.0; 3])).psnr().expect("a figure");
    let untrained = psnr(trainer.model());
    while trainer.step().expect("a step").is_some() {}
    let trained = psnr(trainer.model());
    assert!(trained > untrained + 8.0, "{untrained} to {trained}");
    let file = file("model");
    trainer.model().save(&file, &trainer.about("scene")).expect("saved");
    assert_eq!(model::kind(&file).expect("a kind"), "dvgo");
    let (read, about) = Dvgo::<f32>::open(&file).expect("a model");
    std::fs::remove_file(file).expect("removed");
    assert_eq!((about.step, psnr(&read)), (500, trained));
    assert_eq!(bits(&read), bits(trainer.model()));
}

#[test]
fn exposure_and_other_losses_and_parameters_train_without_change() {
    let (train, _) = views();
    let config = config(30, [10, 10]);
    let objective = objective(&config);
    let model = Dvgo::new(config, BOX, 42).expect("valid settings");
    let names = own_losses::train(model, objective, &train);
    assert_eq!(names, ["mse", "dvgo_entropy", "sample_color", "exposure", "distortion", "thin"]);
}

#[test]
fn losses_of_samples_and_the_graph_see_the_same_pixels() {
    let (train, _) = views();
    let mut trainer = trainer(&train, config(60, [20, 20]));
    while trainer.step().expect("a step").is_some() {}
    let mut model = trainer.into_model();
    let pass = Pass { background: [1.0; 3], jitter: Jitter::None, keep_samples: true, stage: None };
    let pixels = |model: &Dvgo<f32>| no_grad(|| model.render(&rays(50), &pass));
    let fused = pixels(&model);
    assert!(fused.samples().is_some());
    model.engine = Engine::Graph;
    let off = fused.rgb.data().iter().zip(pixels(&model).rgb.data()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // A hundred samples of an opacity of 1e-4, and a transmittance of 1e-3.
    assert!(off < 0.02, "{off}");
}

#[test]
fn settings_without_meaning_are_refused_by_their_key() {
    type Change = fn(&mut Config);
    let wrong: [(&str, Change); 7] = [
        ("features", |config| config.features = 0),
        ("step", |config| config.step = 0.0),
        ("directions", |config| config.directions = Directions::Harmonics(4)),
        ("fine_opacity", |config| config.fine_opacity = 1.0),
        ("coarse.resolution", |config| config.coarse.resolution = 1),
        ("fine", |config| config.fine.clear()),
        ("fine[1].rays", |config| config.fine[1].rays = 0),
    ];
    for (key, change) in wrong {
        let mut config = config(1, [1, 1]);
        change(&mut config);
        let error = Dvgo::<f32>::new(config, BOX, 42).expect_err(key);
        assert!(error.exit_code() == 2 && error.to_string().starts_with(key), "{error}");
    }
    for config in [Config::default(), Config::authors()] {
        config.validate().expect("valid settings");
    }
}
