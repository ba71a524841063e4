//! Refinement of camera poses: gradients of rays, the same bits for any number of threads and after a resumption, and poses that come closer to the true ones.

use crate::factored::{CONTRACTED, NDC, agree, all_columns, rays_of_a_capture, wide};
use autograd::{Gradcheck, Module, Tensor, random::Stream};
use glam::{DQuat, DVec3, dvec3};
use ndarray::ArrayD;
use plenoxel::camera::{Camera, Ray, TrackedRays};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::evaluate::evaluate;
use plenoxel::field::encoding::Directions;
use plenoxel::geometry::Aabb;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::dvgo::{self, Dvgo};
use plenoxel::model::plenoxels::config::{Config as RunConfig, Hull};
use plenoxel::model::tensorf::{Config, Stage, Tensorf};
use plenoxel::render::Engine;
use plenoxel::run::settings::Layers;
use plenoxel::sampling::Jitter;
use plenoxel::space::{Region, Space};
use plenoxel::train::{Model, Pass, TrainOptions, Trainer, ViewOptions};

const PASS: Pass = Pass { background: [1.0; 3], jitter: Jitter::PerRay { seed: 3, step: 7 }, keep_samples: false, stage: None };

const BOX: Region = Region { space: Space::Box, aabb: Aabb { min: DVec3::splat(-1.4), max: DVec3::splat(1.4) } };

/// A field that the kernel computes.
fn model(config: Config, region: Region, resolution: usize) -> Tensorf<f64> {
    let stages = vec![Stage { resolution, steps: 1, rays: 16 }];
    wide(Config { features: 4, hidden: 6, step: 1.0, stop_below: 0.0, stages, ..config }, region)
}

/// Origins and directions, `[n, 3]`.
fn arrays(rays: &[Ray]) -> [ArrayD<f64>; 2] {
    [|ray: &Ray| ray.origin, |ray: &Ray| ray.direction].map(|of: fn(&Ray) -> DVec3| {
        let values: Vec<f64> = rays.iter().flat_map(|ray| of(ray).to_array()).collect();
        ArrayD::from_shape_vec(vec![rays.len(), 3], values).expect("three numbers per ray")
    })
}

#[test]
fn gradients_of_the_graph_with_respect_to_rays_are_right_in_every_space() {
    for region in [BOX, NDC, CONTRACTED] {
        let config = Config { group: 0.0, color_above: 0.0, directions: Directions::Harmonics(2), feature_octaves: 1, ..Config::default() };
        let mut model = model(config, region, 5);
        model.engine = Engine::Graph;
        let rays = rays_of_a_capture(3);
        // The distances of samples are those of the rays as given, so finite differences do not move them.
        let pixels = |x: &[Tensor<f64>]| {
            let tracked = TrackedRays { rays: rays.clone(), origins: x[0].clone(), directions: x[1].clone() };
            model.render_tracked(&tracked, &PASS).rgb
        };
        Gradcheck::new(pixels, arrays(&rays)).named("rays").order(1).run().unwrap_or_else(|e| panic!("{:?}: {e}", region.space));
    }
}

#[test]
fn the_kernel_agrees_with_the_graph_in_values_and_gradients_of_rays() {
    for region in [BOX, NDC, CONTRACTED] {
        for (octaves, directions) in [(0, Directions::Harmonics(3)), (2, Directions::Frequency(2))] {
            let config = Config { group: 0.0, directions, feature_octaves: octaves, cell_depth: 2.0, ..Config::default() };
            let mut model = model(config, region, 9);
            let rays = rays_of_a_capture(40);
            let [origins, directions] = arrays(&rays).map(Tensor::variable);
            let tracked = TrackedRays::new(origins.clone(), directions.clone(), &rays);
            agree(&mut model, &[("origins", &origins), ("directions", &directions)], |model| model.render_tracked(&tracked, &PASS));
            // Rays that are not tracked have the same pixels, up to the rounding of the directions in normalized device coordinates.
            let (plain, same) = (model.render(&tracked.rays, &PASS).rgb, model.render_tracked(&tracked, &PASS).rgb);
            assert!(plain.data().iter().zip(same.data()).all(|(a, b)| (a - b).abs() < 1e-12));
        }
    }
}

#[test]
fn rays_that_see_nothing_have_no_gradient_and_do_not_disturb_the_others() {
    let mut model = model(Config { group: 0.0, ..Config::default() }, BOX, 9);
    // The first blocks of the kernel have no samples at all.
    let mut rays = rays_of_a_capture(48);
    rays[..32].iter_mut().for_each(|ray| ray.origin += DVec3::splat(50.0));
    let [origins, directions] = arrays(&rays).map(Tensor::variable);
    let tracked = TrackedRays::new(origins.clone(), directions.clone(), &rays);
    agree(&mut model, &[("origins", &origins), ("directions", &directions)], |model| model.render_tracked(&tracked, &PASS));
}

#[test]
fn gradients_of_rays_are_those_of_the_reference_with_groups_of_samples_too() {
    for (region, compact_groups) in [BOX, NDC, CONTRACTED].into_iter().flat_map(|region| [(region, false), (region, true)]) {
        let model = model(Config { group: 0.5, compact_groups, color_above: 0.01, ..Config::default() }, region, 9);
        let rays = rays_of_a_capture(30);
        let inputs = arrays(&rays).map(Tensor::variable);
        let tracked = TrackedRays::new(inputs[0].clone(), inputs[1].clone(), &rays);
        let (_, adjoint) = autograd::value_and_grad(|| all_columns(&model.render_tracked(&tracked, &PASS)));
        // Gradients that can be differentiated again are computed through the reference.
        let reference = autograd::grad(&all_columns(&model.render_tracked(&tracked, &PASS)), &inputs.each_ref());
        for (input, want) in inputs.iter().zip(reference) {
            let (want, got) = (want.to_array(), adjoint.array(input));
            let scale = want.iter().fold(1e-12f64, |most, x| most.max(x.abs()));
            assert!(want.iter().zip(&got).all(|(a, b)| (a - b).abs() < 1e-9 * scale), "{:?}", region.space);
        }
    }
}

/// Standard deviations of the noise of poses: 0.5°, and 1 % of the distance of the cameras of the built-in scene.
const NOISE: [f64; 2] = [0.5, 0.01];

/// Returns views whose poses have random errors.
fn disturbed(views: &[View]) -> Vec<View> {
    let noise = Stream::new(21).normal_tensor::<f64>(&[views.len(), 6], 0.0, 1.0);
    let disturbed = |(view, noise): (&View, &[f64])| {
        let mut view = view.clone();
        let pose = &mut view.camera.camera_to_world;
        let turn = DQuat::from_scaled_axis(NOISE[0].to_radians() * DVec3::from_slice(noise));
        pose.matrix3 = glam::DMat3::from_quat(turn) * pose.matrix3;
        pose.translation += NOISE[1] * pose.translation.length() * DVec3::from_slice(&noise[3..]);
        view
    };
    views.iter().zip(noise.data().chunks(6)).map(disturbed).collect()
}

fn views() -> [Vec<View>; 2] {
    let options = ProceduralOptions { width: 48, height: 48, train: 24, val: 0, test: 6, supersample: 2 };
    let scene = Dataset::procedural(options).expect("the built-in scene");
    [Split::Train, Split::Test].map(|split| scene.load(split, &|_, _| {}).expect("its views"))
}

fn trainer(views: &[View], steps: u64, refine: bool) -> Trainer<f32, Tensorf<f32>> {
    let stages = [(24, steps / 3), (40, steps - steps / 3)].map(|(resolution, steps)| Stage { resolution, steps, rays: 512 });
    let config = Config { density_components: 16, appearance_components: 16, hidden: 32, stages: stages.to_vec(), ..Config::default() };
    let model = Tensorf::new(config, Aabb::cube(1.5), 42).expect("valid settings").with_hull(Hull::Off);
    let objective = Objective::new().with("mse", 1.0, mse);
    let objective = if refine { objective.with_poses(0.01, views.len()).with_pose_rate(5e-4, steps) } else { objective };
    Trainer::with_model(model, views, objective, TrainOptions::default()).expect("a trainer")
}

#[test]
fn refined_poses_have_the_same_bits_for_any_number_of_threads_and_after_a_resumption() {
    let [train, _] = views();
    let trained = |threads: usize, interrupted: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let mut trainer = self::trainer(&train, 30, true);
            if interrupted {
                (0..17).for_each(|_| drop(trainer.step().expect("a step")));
                let file = std::env::temp_dir().join(format!("poses-{}.safetensors", std::process::id()));
                trainer.save(&file, "scene").expect("saved");
                trainer = self::trainer(&train, 30, true).resumed(&file).expect("resumed");
                std::fs::remove_file(file).expect("removed");
            }
            while trainer.step().expect("a step").is_some() {}
            let mut bits = Vec::new();
            trainer.model().visit(&mut |param| bits.extend(param.tensor().data().iter().map(|x| x.to_bits())));
            let poses = trainer.pose_figures().expect("figures");
            assert!(poses.mean_degrees > 0.0 && poses.mean_translation > 0.0);
            (bits, poses)
        })
    };
    let want = trained(1, false);
    assert!(trained(3, false) == want && trained(2, true) == want);
}

/// Returns the root mean square distance, in pixels, between the projections of points of the scene by cameras and by the true cameras. Small images hardly
/// tell apart rotations and translations that move the scene alike, so the poses themselves are not compared.
fn error(cameras: &[Camera], truth: &[View]) -> f64 {
    let corners = (0..8).map(|k| 0.5 * (dvec3(f64::from(k >> 2), f64::from(k >> 1 & 1), f64::from(k & 1)) * 2.0 - DVec3::ONE));
    let corners: Vec<DVec3> = corners.collect();
    let squares = cameras.iter().zip(truth).flat_map(|(camera, view)| {
        corners.iter().map(move |&corner| {
            let [(x, y, _), (u, v, _)] =
                [camera, &view.camera].map(|camera| camera.project(corner).expect("the scene is in front of the cameras"));
            (x - u).powi(2) + (y - v).powi(2)
        })
    });
    (squares.sum::<f64>() / (8 * cameras.len()) as f64).sqrt()
}

/// Seeds and sizes are fixed, so the figures are too: 1.35 pixels before and 0.72 after; 16.70 dB without refinement, 17.05 dB with, and 17.62 dB with exact
/// poses.
#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimization: cargo test --profile research --test kernels poses")]
fn poses_with_errors_come_closer_to_the_true_ones_and_the_scene_is_sharper() {
    let [train, test] = views();
    let wrong = disturbed(&train);
    let trained = |refine: bool| {
        let mut trainer = self::trainer(&wrong, 900, refine);
        while trainer.step().expect("a step").is_some() {}
        let psnr = evaluate(trainer.model(), &test, &ViewOptions::over([1.0; 3])).psnr().expect("a figure");
        (psnr, error(&trainer.cameras(), &train))
    };
    let ((without, before), (refined, after)) = (trained(false), trained(true));
    assert!(after < 0.6 * before, "{before} to {after} pixels");
    assert!(refined > without + 0.2, "{without} to {refined} dB");
}

#[test]
fn models_without_gradients_of_rays_refuse_to_refine_poses() {
    let [train, _] = views();
    let config = dvgo::Config::default();
    let model = Dvgo::<f32>::new(config, Aabb::cube(1.5), 1).expect("valid settings");
    let objective = Objective::new().with("mse", 1.0, mse).with_poses(0.01, train.len());
    let error = Trainer::with_model(model, &train[..], objective, TrainOptions::default()).err().expect("an error");
    assert!(error.exit_code() == 2 && error.to_string().starts_with("losses.poses"), "{error}");
    let resolved = |preset: &str| -> Result<RunConfig, plenoxel::error::Error> {
        let mut layers = Layers::defaults()?.with_preset(preset)?;
        layers.assign("losses.poses=0.01")?;
        layers.resolve()
    };
    for preset in ["fast", "ngp"] {
        let error = resolved(preset).expect_err(preset).to_string();
        assert!(error.contains("losses.poses") && error.contains("photos"), "{error}");
    }
    assert!(resolved("photos").is_ok() && resolved("quality").is_ok());
}
