//! NeRF: its gradients, training, resuming and files.

use autograd::{Module, Param, Precision, Tensor, gradcheck, random::Stream};
use glam::DVec3;
use plenoxel::camera::Ray;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::evaluate::{constant_psnr, evaluate, mean_image};
use plenoxel::field::nerf::Density;
use plenoxel::geometry::Aabb;
use plenoxel::model::nerf::{Config, KIND, Nerf, objective};
use plenoxel::render::Rendered;
use plenoxel::sampling::Jitter;
use plenoxel::train::{Model, Pass, TrainOptions, Trainer, ViewOptions};

const BOX: Aabb = Aabb { min: DVec3::splat(-1.4), max: DVec3::splat(1.4) };

const PASS: Pass = Pass { background: [1.0; 3], jitter: Jitter::PerRay { seed: 3, step: 7 }, keep_samples: false, stage: None };

fn tiny() -> Config {
    Config {
        depth: 3,
        width: 4,
        skip: 2,
        color_width: 3,
        position_octaves: 1,
        direction_octaves: 1,
        coarse_samples: 3,
        fine_samples: 2,
        rays: 128,
        ..Config::default()
    }
}

/// Settings that learn the built-in scene in a few seconds.
fn small() -> Config {
    Config {
        depth: 4,
        width: 32,
        skip: 2,
        color_width: 16,
        position_octaves: 5,
        direction_octaves: 2,
        coarse_samples: 16,
        fine_samples: 16,
        rays: 128,
        rate: 4e-3,
        steps: 1000,
        decay_steps: 1000,
        ..Config::default()
    }
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

/// Checks a color against finite differences with respect to the parameters of the network whose names start with `of`. The other network is constant: the
/// places of the second pass depend on the coarse network, but no gradient flows through them.
fn check(of: &str, config: Config, color: impl Fn(Rendered<f64>) -> Tensor<f64>) {
    let model = Nerf::<f64>::new(config.clone(), BOX, 42).expect("valid settings");
    let rays = rays(1);
    let mut inputs = Vec::new();
    model.visit(&mut |param| inputs.extend(param.name().starts_with(of).then(|| param.tensor().to_array())));
    let pixels = |x: &[Tensor<f64>]| {
        let mut model = Nerf::<f64>::new(config.clone(), BOX, 42).expect("valid settings");
        let mut given = x.iter();
        model.visit_mut(&mut |param: &mut Param<f64>| {
            if param.name().starts_with(of) {
                let tensor = given.next().expect("a tensor for each parameter").clone();
                if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
            }
        });
        color(model.render(&rays, &PASS))
    };
    gradcheck(pixels, inputs);
}

#[test]
fn gradients_of_both_passes_with_respect_to_every_parameter_are_right_in_both_orders() {
    // Noise keeps some raw densities above 0 for the ReLU; no density and no hidden unit is at its kink.
    for (density, noise) in [(Density::Softplus, 0.0), (Density::Relu, 1.0)] {
        let config = Config { density, noise, ..tiny() };
        check("fine", config.clone(), |rendered| rendered.rgb);
        check("coarse", config, |rendered| rendered.coarse.expect("a color of the first pass"));
    }
}

#[test]
fn both_networks_learn_from_their_own_pass_only() {
    let model = Nerf::<f64>::new(tiny(), BOX, 42).expect("valid settings");
    let slopes = |of: fn(&Rendered<f64>) -> Tensor<f64>| {
        let (_, gradients) = autograd::value_and_grad(|| of(&model.render(&rays(9), &PASS)).sum());
        let mut found = Vec::new();
        model.visit(&mut |param| found.push((param.name().to_owned(), gradients.get(param.tensor()).is_some())));
        found
    };
    assert!(slopes(|rendered| rendered.rgb.clone()).iter().all(|(name, some)| *some == name.starts_with("fine")));
    let coarse = slopes(|rendered| rendered.coarse.clone().expect("a color of the first pass"));
    assert!(coarse.iter().all(|(name, some)| *some == name.starts_with("coarse")));
}

fn views() -> (Vec<View>, Vec<View>) {
    let options = ProceduralOptions { width: 32, height: 32, train: 24, val: 0, test: 4, supersample: 2 };
    let scene = Dataset::procedural(options).expect("the built-in scene");
    let load = |split| scene.load(split, &|_, _| {}).expect("its views");
    (load(Split::Train), load(Split::Test))
}

fn trainer(config: Config, views: &[View]) -> Trainer<f32, Nerf<f32>> {
    let model = Nerf::new(config, BOX, 42).expect("valid settings");
    Trainer::with_model(model, views, objective(), TrainOptions::default()).expect("a trainer")
}

fn bits(model: &Nerf<f32>) -> Vec<u32> {
    let mut bits = Vec::new();
    model.visit(&mut |param| bits.extend(param.tensor().data().iter().map(|x| x.to_bits())));
    bits
}

#[test]
fn training_has_the_same_bits_for_any_number_of_threads() {
    let (train, _) = views();
    let trained = |threads: usize, mixed_precision: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let mut trainer = trainer(Config { steps: 12, noise: 0.5, mixed_precision, ..small() }, &train);
            while trainer.step().expect("a step").is_some() {}
            bits(trainer.model())
        })
    };
    let want = [false, true].map(|mixed_precision| trained(1, mixed_precision));
    assert!([2, 3].into_iter().all(|threads| [false, true].map(|mixed_precision| trained(threads, mixed_precision)) == want));
    assert!(want[0] != want[1] || !Precision::Mixed.is_available());
}

#[test]
fn a_resumed_run_has_the_same_bits_and_a_file_the_same_pictures() {
    let (train, test) = views();
    let folder = std::env::temp_dir();
    for stop in [3, 9] {
        // One stop in the cropped steps at the beginning, one after them.
        let begin = || trainer(Config { steps: 14, crop_steps: 6, noise: 0.5, mixed_precision: true, ..small() }, &train);
        let file = folder.join(format!("nerf-{}-{stop}.safetensors", std::process::id()));
        let mut whole = begin();
        (0..stop).for_each(|_| drop(whole.step().expect("a step")));
        whole.save(&file, "scene").expect("saved");
        let mut resumed = begin().resumed(&file).expect("resumed");
        while let Some(report) = whole.step().expect("a step") {
            assert_eq!(resumed.step().expect("a step").as_ref(), Some(&report));
        }
        assert_eq!(bits(whole.model()), bits(resumed.model()));
        whole.model().save(&file, &whole.about("scene")).expect("saved");
        let (read, about) = Nerf::<f32>::open(&file).expect("a model");
        assert_eq!((about.step, read.config(), read.aabb()), (14, whole.model().config(), BOX));
        let config = plenoxel::model::plenoxels::config::Config::default();
        let (any, _) = plenoxel::model::open(&file, &config).expect("a model of a known kind");
        assert_eq!(any.kind(), KIND);
        let psnr = |model: &dyn Model<f32>| evaluate(model, &test[..1], &ViewOptions::over([1.0; 3])).psnr();
        assert_eq!(psnr(&*any), psnr(whole.model()));
        std::fs::remove_file(file).expect("removed");
    }
}

#[test]
fn a_run_that_was_saved_without_a_setting_continues_with_its_default() {
    let model = |mixed_precision: bool| Nerf::<f32>::new(Config { mixed_precision, ..tiny() }, BOX, 42).expect("valid settings");
    let mut saved = model(false).settings();
    saved.as_object_mut().expect("settings").remove("mixed_precision").expect("a setting");
    assert!(model(false).continues(&saved, 1) && !model(true).continues(&saved, 1));
}

#[test]
fn a_scene_is_learned() {
    let (train, test) = views();
    let mut trainer = trainer(small(), &train);
    while trainer.step().expect("a step").is_some() {}
    let psnr = evaluate(trainer.model(), &test, &ViewOptions::over([1.0; 3])).psnr().expect("a figure");
    let mean = mean_image(&train, [1.0; 3]).and_then(|mean| constant_psnr(&test, &mean, [1.0; 3])).expect("a figure");
    println!("{psnr:.2} dB, {mean:.2} dB of the mean image");
    assert!(psnr > LEARNED, "{psnr}, {mean} of the mean image");
}

/// PSNR in dB that the seed reaches, less one.
const LEARNED: f64 = 18.4;

#[test]
fn a_picture_in_parts_is_the_picture_of_all_rays() {
    let model = Nerf::<f32>::new(Config { coarse_samples: 2000, fine_samples: 2000, ..tiny() }, BOX, 42).expect("valid settings");
    // 32 rays of 4000 samples are evaluated at a time.
    let rays = rays(40);
    let joined = model.viewer(&ViewOptions::over([1.0; 3]))(&rays);
    let whole = model.render(&rays, &Pass { jitter: Jitter::None, ..PASS });
    assert_eq!(joined.sample_count, whole.sample_count);
    for (a, b) in [(joined.depth(), whole.depth()), (joined.distortion(), whole.distortion()), (joined.rgb, whole.rgb)] {
        assert!(a.shape() == b.shape() && a.data().iter().zip(b.data()).all(|(a, b)| (a - b).abs() < 1e-4));
    }
}

#[test]
fn settings_without_meaning_are_refused_by_their_key() {
    type Change = fn(&mut Config);
    let wrong: [(&str, Change); 6] = [
        ("depth", |config| config.depth = 0),
        ("skip", |config| config.skip = config.depth),
        ("coarse_samples", |config| config.coarse_samples = 0),
        ("near_far[1]", |config| config.near_far = Some([2.0, 2.0])),
        ("crop_steps", |config| config.crop_steps = config.steps),
        ("rate", |config| config.rate = 0.0),
    ];
    for (key, change) in wrong {
        let mut config = tiny();
        change(&mut config);
        let error = Nerf::<f32>::new(config, BOX, 42).expect_err(key);
        assert!(error.exit_code() == 2 && error.to_string().starts_with(key), "{error}");
    }
}
