//! Whole runs, small.

use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::error::Error;
use plenoxel::field::Field;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::loss::mse;
use plenoxel::metrics::psnr;
use plenoxel::model::plenoxels::config::{ColorKind, Config, OptimizerConfig, Sampling, Scout, Stage, Weight};
use plenoxel::model::plenoxels::{Objective, Trainer};
use plenoxel::render::picture::picture;
use plenoxel::render::{Engine, RenderOptions};
use plenoxel::sampling::{Jitter, Occupancy};
use plenoxel::train::{Model, Report};
use std::collections::BTreeMap;

fn scene() -> Dataset {
    Dataset::procedural(ProceduralOptions { width: 32, height: 32, train: 20, val: 0, test: 3, supersample: 2 })
        .expect("the built-in scene")
}

fn views(split: Split) -> Vec<View> {
    scene().load(split, &|_, _| {}).expect("it renders")
}

fn stage(resolution: usize, steps: u64) -> Stage {
    Stage { sampling: Sampling::Step { step: 0.7 }, color_rate: 0.05, rate_decay: 0.3, ..Stage::new(resolution, steps) }
}

fn config() -> Config {
    Config { color: ColorKind::Rgb, rays_per_step: 512, stages: vec![stage(8, 60), stage(16, 120)], ..Config::default() }
}

fn run(config: Config, views: &[View]) -> (VoxelGrid<f32>, Vec<Report>) {
    let mut trainer = Trainer::<f32>::new(config, views).expect("a valid config");
    let mut reports = Vec::new();
    while let Some(report) = trainer.step().expect("finite numbers") {
        reports.push(report);
    }
    assert_eq!(reports.len() as u64, trainer.total_steps());
    (trainer.into_grid(), reports)
}

fn test_psnr(grid: &VoxelGrid<f32>) -> f64 {
    let options = RenderOptions {
        aabb: grid.aabb(),
        spacing: config().evaluation.spacing(grid.shape()),
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::default(),
        stop_below: 0.0,
    };
    let views = views(Split::Test);
    let sum: f64 = views.iter().map(|v| psnr(picture(grid, &v.camera, &options).rgb.view(), v.composite([1.0; 3]).view())).sum();
    sum / views.len() as f64
}

#[test]
fn a_small_scene_is_learned() {
    let (grid, reports) = run(config(), &views(Split::Train));
    // White alone is below 9 dB; this reaches about 18 with seed 42.
    let psnr = test_psnr(&grid);
    assert!(psnr > 16.5, "test PSNR {psnr}");
    assert_eq!(reports.iter().filter(|r| r.ends_stage).map(|r| (r.stage, r.step)).collect::<Vec<_>>(), [(0, 59), (1, 179)]);
    assert!(reports[179].loss < 0.3 * reports[0].loss);
}

#[test]
fn the_same_seed_gives_the_same_bits_for_any_number_of_threads() {
    let train = views(Split::Train);
    // Large enough that batches, tables and losses are cut into many chunks.
    let mut short =
        Config { rays_per_step: 4096, color: ColorKind::Sh, sh_degree: 1, prune_from_stage: Some(1), prune_unseen_below: 1e-3, ..config() };
    (short.aim, short.stop_below) = (true, 1e-3);
    short.initial.random = true;
    short.stages = vec![stage(24, 3), stage(40, 3)];
    short.losses.insert("tv_density_sampled".to_owned(), Weight::Constant(1e-3));
    short.losses.insert("tv_color".to_owned(), Weight::Exponential { from: 1e-3, to: 1e-4, steps: 16 });
    // And many small steps: a difference would grow.
    let long = Config { stages: vec![stage(8, 60), stage(16, 140)], ..config() };
    let bits = |config: &Config, threads: usize, seed: u64| {
        let config = Config { seed, ..config.clone() };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        let (grid, reports) = pool.install(|| run(config, &train));
        let tables: Vec<Vec<u32>> = grid.params().map(|p| p.tensor().data().iter().map(|x| x.to_bits()).collect()).collect();
        (tables, reports)
    };
    // And steps of more rays than are kept at a time.
    let large = Config { rays_per_step: 40_000, color: ColorKind::Sh, sh_degree: 1, stages: vec![stage(24, 2)], ..config() };
    let reduced = Config { sh_reduction: 4, ..short.clone() };
    for (config, threads) in [(&short, &[2, 3, 8][..]), (&reduced, &[2, 3]), (&long, &[2, 3, 8]), (&large, &[3])] {
        let one = bits(config, 1, 42);
        for &threads in threads {
            assert!(bits(config, threads, 42) == one, "{threads} threads differ from one");
        }
        assert!(bits(config, 2, 43) != one, "another seed is another run");
    }
}

#[test]
fn a_scout_finds_where_matter_is() {
    let train = views(Split::Train);
    let scout = Scout { density: 0.5, prune_unseen_below: 0.1, stages: vec![Stage { density_rate: 2.0, ..stage(24, 200) }] };
    let stages = vec![stage(32, 1), stage(32, 60)];
    let config = Config { scout: Some(scout), prune_unseen_below: 0.03, stages, rays_per_step: 2048, ..config() };
    let mut trainer = Trainer::<f32>::new(config.clone(), &train[..]).expect("a valid config");
    assert_eq!(
        trainer.plan().iter().map(|p| (p.first, p.resolution)).collect::<Vec<_>>(),
        [(0, Some(24)), (200, Some(32)), (201, Some(32))]
    );
    assert_eq!(trainer.model().prunes_from(), None);
    while trainer.step().expect("finite numbers").is_some_and(|report| report.step < 200) {}
    let (shape, present) = (*trainer.grid().shape(), trainer.grid().lattice().present());
    assert_eq!(shape.resolution, 32);
    assert!(present > 1000 && present < 32 * 32 * 32 * 3 / 4, "{present} in {}", shape.half_width);
    while trainer.step().expect("finite numbers").is_some() {}
    let psnr = test_psnr(trainer.grid());
    assert!(psnr > 16.5, "test PSNR {psnr}");
    // A run that starts from another needs none, and pruning counts the stages of the config.
    let pruning = Config { prune_from_stage: Some(1), ..config };
    let trainer = Trainer::new(pruning, &train[..]).expect("a valid config");
    assert_eq!(trainer.model().prunes_from(), Some(2));
    let grid = VoxelGrid::<f32>::uniform(trainer.config().grid_shape(32), 0.1, 0.0);
    let trainer = trainer.starting_from(&grid);
    assert_eq!((trainer.plan().len(), trainer.model().prunes_from()), (2, Some(1)));
}

#[test]
fn a_stage_of_reduced_images_learns_from_what_reduced_views_show() {
    let train = views(Split::Train);
    let first = |image_reduction, views: &[View]| {
        let stages = vec![Stage { image_reduction, ..stage(8, 6) }, stage(16, 4)];
        let mut trainer = Trainer::<f32>::new(Config { stages, ..config() }, views).expect("a valid config");
        let losses: Vec<f64> = std::iter::from_fn(|| trainer.step().expect("finite numbers")).map(|report| report.loss).collect();
        losses
    };
    let reduced: Vec<View> = train.iter().map(|view| view.reduced(4)).collect();
    assert_eq!(reduced[0].image.dimensions(), (8, 8));
    // 32 is not divided by 6, and not by 5.
    assert_eq!(train[0].reduced(6).image, reduced[0].image);
    assert_eq!(first(4, &train)[..6], first(1, &reduced)[..6]);
    assert_eq!(first(6, &train), first(4, &train));
    assert_ne!(first(4, &train)[0], first(1, &train)[0]);
}

#[test]
fn small_images_have_large_voxels() {
    // Of 32 x 32 pixels.
    let train = views(Split::Train);
    let camera = &train[0].camera;
    let pixel = camera.position().length() / camera.intrinsics.fx;
    let stages = vec![Stage { image_reduction: 4, ..stage(8, 6) }, Stage { image_reduction: 4, ..stage(128, 4) }];
    let fitted = |pixels_per_voxel: f64, stages: &[Stage]| {
        let config = Config { pixels_per_voxel, stages: stages.to_vec(), ..config() };
        let trainer = Trainer::<f32>::new(config.clone(), &train[..]).expect("a valid config");
        let again = trainer.config().fitted_to(train.iter().map(|view| &view.camera));
        // What fits is left alone.
        assert_eq!(again, *trainer.config());
        trainer.model().stages().to_vec()
    };
    assert_eq!(fitted(0.0, &stages), stages);
    assert_eq!(fitted(1e-3, &stages), stages);
    let [coarse, fine] = fitted(1.5, &stages)[..] else { panic!("two stages") };
    let finest = 2.0 * config().half_width / (1.5 * pixel);
    assert_eq!(fine.resolution, finest as usize);
    assert!((fine.density_rate - stages[1].density_rate * fine.resolution as f64 / 128.0).abs() < 1e-12);
    assert_eq!((fine.image_reduction, coarse.image_reduction), (1, (finest / 8.0) as usize));
    assert!(coarse.resolution == 8 && (2..4).contains(&coarse.image_reduction), "{coarse:?}");
    // There are voxels at least.
    assert_eq!(fitted(1e6, &stages)[1].resolution, 2);
}

#[test]
fn voxels_that_no_training_ray_sees_much_of_go_without_harm() {
    let train = views(Split::Train);
    let stages = vec![stage(16, 40), stage(32, 140)];
    let config = Config { prune_from_stage: Some(1), prune_below: 0.0, stages, ..config() };
    let pruned = |least: f64| run(Config { prune_unseen_below: least, ..config.clone() }, &train).0;
    let (full, seen) = (pruned(0.0), pruned(0.05));
    let (before, after) = (full.lattice().present(), seen.lattice().present());
    // The scene fills what the density leaves, and most of that is surface.
    assert!(after < before - 100, "{after} of {before} voxels are seen");
    assert!(test_psnr(&seen) > test_psnr(&full) - 0.1, "{} dB after {}", test_psnr(&seen), test_psnr(&full));
    let none = Trainer::<f32>::new(Config { prune_unseen_below: 1.0, ..config.clone() }, &train[..]).and_then(|mut trainer| {
        while trainer.step()?.is_some() {}
        Ok(())
    });
    assert!(none.is_err_and(|e| e.exit_code() == 4 && e.to_string().contains("prune_unseen_below")));
}

#[test]
fn a_pruned_run_is_trained_on_all_that_evaluation_sees() {
    let train = views(Split::Train);
    let config = Config { prune_from_stage: Some(1), prune_below: 0.2, ..config() };
    let mut trainer = Trainer::<f32>::new(config.clone(), &train[..]).expect("a valid config");
    while trainer.step().expect("finite numbers").is_some() {}
    let grid = trainer.grid();
    let looked_at = grid.reach().expect("space was pruned");
    assert!(looked_at.fraction() < 0.9, "{} of the voxels are looked at", looked_at.fraction());
    let spacing = config.evaluation.spacing(grid.shape());
    let everywhere = Occupancy::new(grid.aabb(), grid.lattice().nodes(), &vec![true; grid.shape().voxels()]);
    let there = RenderOptions {
        aabb: grid.aabb(),
        spacing,
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::default(),
        stop_below: 0.0,
    };
    let everywhere = RenderOptions { occupancy: Some(&everywhere), ..there.clone() };
    for view in views(Split::Test) {
        assert_eq!(picture(grid, &view.camera, &everywhere).rgb, picture(grid, &view.camera, &there).rgb);
    }
}

#[test]
fn a_closure_of_the_user_is_a_loss_like_any_other() {
    let train = views(Split::Train);
    let mut short = config();
    short.stages = vec![stage(8, 40)];
    let objective = Objective::new()
        .with("log_cosh", 1.0, |step| {
            let r = (&step.rendered.rgb - &step.batch.target) * 5.0;
            (r.exp() + (-&r).exp()).ln().mean() - 2f64.ln()
        })
        .with("clear", 1e-3, |step| step.rendered.opacity.mean());
    let mut trainer = Trainer::<f32>::with_objective(short, &train[..], objective).expect("a valid config");
    let mut reports = Vec::new();
    while let Some(report) = trainer.step().expect("finite numbers") {
        reports.push(report);
    }
    assert_eq!(reports[0].losses.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["log_cosh", "clear"]);
    assert!(reports[39].psnr > reports[0].psnr + 3.0, "{} then {}", reports[0].psnr, reports[39].psnr);
}

#[test]
fn a_view_that_does_not_fit_the_others_counts_less() {
    let mut views = views(Split::Train);
    views[3].image = views[10].image.clone();
    let name = views[3].name.clone();
    let losses = ["mse", "outlier_views"].map(|loss| (loss.to_owned(), Weight::Constant(1.0))).into();
    let config = Config { losses, ..config() };
    let mut trainer = Trainer::<f32>::new(config.clone(), views.clone()).expect("a valid config");
    assert_eq!(trainer.outlier_views(), Some(Vec::new()));
    while let Some(report) = trainer.step().expect("finite numbers") {
        assert_eq!(report.losses[1], ("outlier_views".to_owned(), 0.0));
    }
    let outliers = trainer.outlier_views().expect("the loss is one of the config");
    assert!(outliers.len() == 1 && outliers[0].name == name && outliers[0].weight < 0.5, "{outliers:?}");

    // Errors that are learned too slowly stay the same for all views.
    let slow = Config { loss_rates: [("outlier_views".to_owned(), 1e-6)].into(), ..config };
    let mut trainer = Trainer::<f32>::new(slow, views).expect("a valid config");
    while trainer.step().expect("finite numbers").is_some() {}
    assert_eq!(trainer.outlier_views(), Some(Vec::new()));
}

#[test]
fn weights_of_views_alone_are_no_objective() {
    let losses = [("outlier_views".to_owned(), Weight::Constant(1.0))].into();
    let error = Trainer::<f32>::new(Config { losses, ..config() }, views(Split::Train)).err().expect("an error");
    assert!(error.to_string().contains("there is no loss"), "{error}");
}

#[test]
fn losses_of_a_config_beside_an_objective_are_refused() {
    let with =
        |losses: &[&str]| Config { losses: losses.iter().map(|name| (name.to_string(), Weight::Constant(1.0))).collect(), ..config() };
    let refused =
        |losses: &[&str]| Trainer::<f32>::with_objective(with(losses), views(Split::Train), Objective::new().with("m", 1.0, mse)).err();
    assert!(refused(&[]).is_none() && refused(&["mse"]).is_none());
    let text = refused(&["mse", "tv_color"]).expect("it is refused").to_string();
    assert!(text.starts_with("losses: a custom objective does not use the losses of the config: mse, tv_color"), "{text}");
}

#[test]
fn batches_of_ones_own_are_what_a_loss_sees() {
    let objective = Objective::<f32>::new().with("patches", 1.0, |step| {
        let first = step.batch.pixel[0];
        assert!(step.batch.len() == 4 * 64 && step.batch.pixel[63] == [first[0] + 7, first[1] + 7], "squares, row after row");
        mse(step)
    });
    let mut trainer = Trainer::with_objective(config(), views(Split::Train), objective).expect("a valid config");
    trainer = trainer.with_batches(|rays, step| rays.batch_of(&rays.patches(step, 4, 8)));
    assert_eq!(trainer.step().expect("finite numbers").expect("a step").rays, 256);
}

#[test]
fn a_setting_draws_patches() {
    let patches = |patch_size: u32| {
        let objective = Objective::<f32>::new().with("patches", 1.0, move |step| {
            let (count, side) = (step.batch.len() / 64, 8);
            let square = |k: usize, i: usize| step.batch.pixel[64 * k + i];
            for (k, i) in (0..count).flat_map(|k| (0..64).map(move |i| (k, i))) {
                assert_eq!(square(k, i), [square(k, 0)[0] + (i % side) as u32, square(k, 0)[1] + (i / side) as u32], "row after row");
            }
            mse(step)
        });
        let config = Config { patch_size, rays_per_step: 200, contrast_floor: 0.05, ..config() };
        Trainer::with_objective(config, views(Split::Train), objective)
    };
    let mut trainer = patches(8).expect("a valid config");
    let rays: Vec<usize> = (0..3).map(|_| trainer.step().expect("finite numbers").expect("a step").rays).collect();
    assert_eq!(rays, [192; 3], "three patches of 64 pixels");
    let text = patches(15).err().expect("it is refused").to_string();
    assert!(text.starts_with("patch_size: a patch has 225 pixels, but a step of stage 0 has 200 rays"), "{text}");
    let text = patches(63).err().expect("it is refused").to_string();
    assert!(text.starts_with("patch_size: no training view has 63 x 63 pixels"), "{text}");
}

#[test]
fn weights_and_rates_follow_their_schedules() {
    let train = views(Split::Train);
    let first = Stage { density_warm_up: 4, rate_decay: 0.5, color_decay: Some(0.25), ..stage(8, 8) };
    let mut config = Config { stages: vec![first], ..config() };
    config.losses.insert("beta".to_owned(), Weight::Until { weight: 1e-6, until: 3 });
    let (density_rate, color_rate) = (first.density_rate, first.color_rate);
    let mut trainer = Trainer::<f32>::new(config, &train[..]).expect("a valid config");
    for step in 0..8 {
        let report = trainer.step().expect("finite numbers").expect("a step");
        assert_eq!(report.losses.iter().any(|(name, _)| name == "beta"), step < 3, "step {step}");
        let t = f64::from(step) / 8.0;
        let delay = 0.01 + 0.99 * (std::f64::consts::FRAC_PI_2 * (2.0 * t).min(1.0)).sin();
        assert!((report.rate("density").unwrap() / (delay * density_rate * 0.5f64.powf(t)) - 1.0).abs() < 1e-9, "step {step}");
        assert!((report.rate("color").unwrap() / (color_rate * 0.25f64.powf(t)) - 1.0).abs() < 1e-9, "step {step}");
    }
}

#[test]
fn a_loss_that_is_not_finite_stops_the_run_with_its_step() {
    let train = views(Split::Train);
    let objective = Objective::new().with("bad", 1.0, |step| {
        let value = step.rendered.rgb.mean();
        if step.number == 3 { value / 0.0 } else { value }
    });
    let mut trainer = Trainer::<f32>::with_objective(config(), &train[..], objective).expect("a valid config");
    let error = (0..10).find_map(|_| trainer.step().err()).expect("it stops");
    assert!(matches!(error, Error::Numeric { .. }) && error.exit_code() == 4);
    assert!(error.to_string().contains("step 3") && error.to_string().contains("inf"), "{error}");
}

#[test]
fn a_config_with_an_impossible_value_names_its_key() {
    let train = views(Split::Train);
    type Break = fn(&mut Config);
    let broken: [(&str, Break); 12] = [
        ("losses.beta", |c| c.losses = BTreeMap::from([("beta".to_owned(), Weight::Until { weight: 1.0, until: 0 })])),
        ("stages[0].color_decay", |c| c.stages[0].color_decay = Some(0.0)),
        ("stages[0].rate_decay", |c| c.stages[0].rate_decay = 1e-100),
        ("stages[0].density_rate", |c| c.stages[0].density_rate = 1e-300),
        ("stages[0].epochs", |c| (c.stages[0].steps, c.stages[0].epochs) = (None, Some(1e30))),
        ("half_width", |c| c.half_width = 0.0),
        ("sh_degree", |c| c.sh_degree = 4),
        ("rays_per_step", |c| c.rays_per_step = 0),
        ("stages[1].steps", |c| c.stages[1].epochs = Some(2.0)),
        ("stages[0].resolution", |c| c.stages[0].resolution = 1),
        ("losses.tvv", |c| c.losses = BTreeMap::from([("tvv".to_owned(), Weight::Constant(1.0))])),
        ("background", |c| c.background[1] = f32::NAN),
    ];
    for (key, break_it) in broken {
        let mut config = config();
        break_it(&mut config);
        let error = Trainer::<f32>::new(config, &train[..]).err().expect("it is refused");
        assert!(error.to_string().starts_with(key) && error.exit_code() == 2, "{error}");
    }
}

#[test]
fn training_in_f64_follows_the_same_path_as_in_f32() {
    let train = views(Split::Train);
    let mut short = config();
    short.stages = vec![stage(8, 10)];
    short.optimizer = OptimizerConfig::Sgd;
    short.stages[0].density_rate = 20.0;
    short.stages[0].color_rate = 20.0;
    let single = run(short.clone(), &train).1;
    let mut trainer = Trainer::<f64>::new(short, &train[..]).expect("a valid config");
    for a in single {
        let b = trainer.step().expect("finite numbers").expect("as many steps");
        assert!((a.loss - b.loss).abs() < 1e-5, "step {}: {} and {}", a.step, a.loss, b.loss);
    }
}

#[test]
fn a_saved_run_without_a_later_setting_goes_on_if_the_setting_has_its_default() {
    let trainer = Trainer::<f32>::new(config(), &views(Split::Train)[..]).unwrap();
    let mut saved = trainer.model().settings();
    assert!(saved.as_object_mut().unwrap().remove("group_in_pictures").is_some());
    assert!(trainer.model().continues(&saved, 0));
    saved["group_in_pictures"] = 0.1.into();
    assert!(!trainer.model().continues(&saved, 0));
}
