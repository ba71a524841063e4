//! A run that was stopped and goes on is the run that was not.

use autograd::Real;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::model::plenoxels::Trainer;
use plenoxel::model::plenoxels::config::{ColorKind, Config, Hull, OptimizerConfig, Sampling, Scout, Stage, Weight};
use std::path::PathBuf;

fn views(seed_of_size: usize) -> Vec<View> {
    let (width, height) = (seed_of_size, seed_of_size);
    let scene = Dataset::procedural(ProceduralOptions { width, height, train: 12, val: 0, test: 1, supersample: 1 });
    scene.expect("the built-in scene").load(Split::Train, &|_, _| {}).expect("it renders")
}

fn file(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("plenoxel-resuming-{}", std::process::id()));
    std::fs::create_dir_all(&path).expect("a temporary folder");
    path.join(name)
}

fn stage(resolution: usize, steps: u64) -> Stage {
    Stage { sampling: Sampling::Step { step: 0.7 }, color_rate: 0.05, rate_decay: 0.3, ..Stage::new(resolution, steps) }
}

/// Everything that a run can remember: pruning, aiming, a scout, smaller images, reduced harmonics, losses that end, warm-up, projection.
fn configs() -> Vec<(&'static str, Config)> {
    let base = Config {
        rays_per_step: 256,
        jitter: true,
        aim: true,
        prune_from_stage: Some(1),
        prune_below: 0.0,
        prune_unseen_below: 1e-3,
        stages: vec![Stage { image_reduction: 2, ..stage(8, 90) }, Stage { density_warm_up: 40, ..stage(13, 100) }],
        ..Config::default()
    };
    let adam = OptimizerConfig::LazyAdam { beta1: 0.9, beta2: 0.99, epsilon: 1e-8 };
    let mut regular = base.losses.clone();
    regular.insert("tv_density_sampled".to_owned(), Weight::Until { weight: 1e-4, until: 120 });
    regular.insert("tv_color_sampled".to_owned(), Weight::Exponential { from: 1e-2, to: 1e-4, steps: 150 });
    let scout = Scout { density: 1.0, prune_unseen_below: 1e-3, stages: vec![stage(6, 25), stage(7, 15)] };
    vec![
        ("colors", Config { color: ColorKind::Rgb, project: true, optimizer: OptimizerConfig::Sgd, ..base.clone() }),
        ("silhouettes", Config { hull: Hull::Auto, optimizer: OptimizerConfig::Momentum { decay: 0.9 }, ..base.clone() }),
        ("scout", Config { scout: Some(scout), optimizer: adam, sh_reduction: 2, losses: regular, ..base.clone() }),
        (
            "learned losses",
            Config {
                losses: [("robust", 0.01), ("exposure", 1e-3), ("mse", 1.0), ("outlier_views", 1.0)]
                    .map(|(name, w)| (name.to_owned(), Weight::Constant(w)))
                    .into(),
                loss_rates: [("robust".to_owned(), 0.02)].into(),
                ..base.clone()
            },
        ),
        ("svox2", Config { optimizer: OptimizerConfig::RmsProp { beta: 0.95, epsilon: 1e-8 }, aim: false, ..base }),
    ]
}

fn finish<T: Real>(mut trainer: Trainer<T>) -> VoxelGrid<T> {
    while trainer.step().expect("finite numbers").is_some() {}
    trainer.into_grid()
}

fn assert_same<T: Real>(a: &VoxelGrid<T>, b: &VoxelGrid<T>, what: &str) {
    assert_eq!(a.shape(), b.shape(), "{what}");
    assert!(a.lattice().masks() == b.lattice().masks(), "{what}: other voxels");
    for (a, b) in a.params().zip(b.params()) {
        let differ = a.tensor().data().iter().zip(b.tensor().data()).filter(|(a, b)| a != b).count();
        assert_eq!(differ, 0, "{what}: numbers of {}", a.name());
    }
}

fn check<T: Real>(name: &str, config: &Config, views: &[View]) {
    let new = || Trainer::<T>::new(config.clone(), views).expect("a valid config");
    let straight = finish(new());
    let total = new().total_steps();
    let mut first = new();
    // Within a stage and between looks, at a look, before a stage begins, after its first step, at the last step, and when all are done.
    for stop in [1, 64, 89, 90, 91, 130, 131, total - 1, total] {
        let path = file(&format!("{name}-{stop}-{}.safetensors", size_of::<T>()));
        while first.steps_taken() < stop {
            first.step().expect("finite numbers");
        }
        first.save(&path, "still life").expect("it is written");
        // On one thread, where the run so far had several.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread pool");
        let resumed = pool.install(|| finish(new().resumed(&path).expect("it is read")));
        assert_same(&resumed, &straight, &format!("{name}, stopped after {stop} steps"));
        std::fs::remove_file(path).expect("it is removed");
    }
}

#[test]
fn a_run_goes_on_with_the_bits_it_would_have_had() {
    let views = views(32);
    for (name, config) in configs() {
        check::<f32>(name, &config, &views);
    }
}

#[test]
fn in_double_precision_too_and_from_a_grid_that_was_there() {
    let views = views(24);
    let (name, config) = configs().swap_remove(2);
    check::<f64>(name, &config, &views);
    // A run that began with a grid leaves stages out; the grid is not needed to go on.
    let (_, config) = configs().swap_remove(3);
    let grid = finish(Trainer::<f32>::new(Config { stages: vec![stage(10, 20)], ..config.clone() }, &views[..]).expect("a valid config"));
    let new = || Trainer::<f32>::new(config.clone(), &views[..]).expect("a valid config");
    let mut first = new().starting_from(&grid);
    assert_eq!(first.total_steps(), 100);
    let straight = finish(new().starting_from(&grid));
    for _ in 0..70 {
        first.step().expect("finite numbers");
    }
    let path = file("from-a-grid.safetensors");
    first.save(&path, "still life").expect("it is written");
    assert_eq!(first.steps_taken(), 70);
    let resumed = new().resumed(&path).expect("it is read");
    assert_eq!((resumed.steps_taken(), resumed.total_steps()), (70, 100));
    assert_same(&finish(resumed), &straight, "from a grid");
}

#[test]
fn a_state_that_does_not_fit_or_is_damaged_is_refused_with_the_reason() {
    let views_of_it = views(16);
    let (_, config) = configs().swap_remove(2);
    let config = Config { stages: vec![stage(5, 30)], ..config };
    let mut trainer = Trainer::<f32>::new(config.clone(), &views_of_it[..]).expect("a valid config");
    for _ in 0..50 {
        trainer.step().expect("finite numbers");
    }
    let path = file("damaged.safetensors");
    trainer.save(&path, "still life").expect("it is written");
    let refusal = |config: Config, views: &[View]| {
        let refused = Trainer::<f32>::new(config, views).expect("a valid config").resumed(&path);
        refused.err().expect("it is refused").to_string()
    };
    let text = refusal(Config { seed: 43, ..config.clone() }, &views_of_it);
    assert!(text.contains("other settings") && text.contains("damaged.safetensors"), "{text}");
    let text = refusal(config.clone(), &views(20));
    assert!(text.contains("other training views"), "{text}");
    let double = Trainer::<f64>::new(config.clone(), &views_of_it[..]).expect("a valid config").resumed(&path);
    assert!(double.err().expect("it is refused").to_string().contains("other precision"));

    let bytes = std::fs::read(&path).expect("it is there");
    let header = 8 + u64::from_le_bytes(*bytes.first_chunk().expect("a length")) as usize;
    for cut in (0..header + 64).step_by(97).chain([header, bytes.len() - 1]) {
        std::fs::write(&path, &bytes[..cut]).expect("it is written");
        let text = refusal(config.clone(), &views_of_it);
        assert!(text.contains("not a complete safetensors file"), "{cut}: {text}");
    }
    // Every byte of the header and some of the tables changed: it is refused, or a run like any other.
    for at in (8..header).chain((header..bytes.len()).step_by(1009)) {
        let mut changed = bytes.clone();
        changed[at] ^= 0x15;
        std::fs::write(&path, &changed).expect("it is written");
        if let Ok(mut trainer) = Trainer::<f32>::new(config.clone(), &views_of_it[..]).expect("a valid config").resumed(&path) {
            let _ = trainer.step();
        }
    }
    let at = bytes.windows(13).position(|w| w == br#"\"updates\":["#).expect("what the optimizer says");
    let mut changed = bytes.clone();
    changed[at + 13] = b'9';
    std::fs::write(&path, &changed).expect("it is written");
    assert!(refusal(config.clone(), &views_of_it).contains("more updates than steps"));
    let at = bytes.windows(19).position(|w| w == b"plenoxel training 2").expect("its version");
    let mut changed = bytes;
    changed[at + 18] = b'3';
    std::fs::write(&path, &changed).expect("it is written");
    assert!(refusal(config, &views_of_it).contains("use the program version that wrote the file"));
}
