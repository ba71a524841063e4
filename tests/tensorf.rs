//! The factored field: its gradients, its upsampling, training and resuming.

use crate::factored::{CONTRACTED, NDC, agree, all_columns, rays_of_a_capture, wide};
use crate::own_losses;
use autograd::{Module, Param, Precision, Real, Tensor, gradcheck, no_grad, random::Stream};
use glam::DVec3;
use ndarray::{Array2, ArrayD};
use plenoxel::camera::{Ray, TrackedRays};
use plenoxel::dataset::procedural::{CAMERA_DISTANCE, ProceduralOptions};
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::evaluate::{constant_psnr, evaluate, mean_image};
use plenoxel::field::encoding::Directions;
use plenoxel::geometry::Aabb;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::plenoxels::config::Hull;
use plenoxel::model::tensorf::{Config, Stage, Tensorf, density_l1};
use plenoxel::render::{Field, Rendered};
use plenoxel::sampling::{Jitter, Occupancy, Spacing, sample};
use plenoxel::space::{Region, Space};
use plenoxel::train::{Model, Pass, PlannedStage, TrainOptions, Trainer, ViewOptions};
use std::ops::Range;

const BOX: Aabb = Aabb { min: DVec3::splat(-1.4), max: DVec3::splat(1.4) };
const IN_BOX: Region = Region { space: Space::Box, aabb: BOX };

const PASS: Pass = Pass { background: [1.0; 3], jitter: Jitter::None, keep_samples: false, stage: None };

fn tiny(stages: &[(usize, u64)]) -> Config {
    Config {
        density_components: 4,
        appearance_components: 6,
        features: 8,
        hidden: 8,
        step: 1.0,
        step_in_pictures: 1.0,
        feature_octaves: 1,
        group: 0.0,
        group_in_pictures: 0.0,
        stop_below: 0.0,
        stop_below_in_pictures: 0.0,
        stages: stages.iter().map(|&(resolution, steps)| Stage { resolution, steps, rays: 256 }).collect(),
        ..Config::default()
    }
}

/// A model whose density is neither fog nor nothing, so that all numbers matter.
fn dense<T: Real>(stages: &[(usize, u64)]) -> Tensorf<T> {
    let mut model = Tensorf::<T>::new(tiny(stages), BOX, 42).expect("valid settings");
    fill_density(&mut model, 0.5..2.2);
    model
}

/// Gives the planes and lines of the density uniform random numbers.
fn fill_density<T: Real>(model: &mut Tensorf<T>, range: Range<f64>) {
    let random = Stream::new(3);
    model.visit_mut(&mut |param: &mut Param<T>| {
        if param.name().starts_with("density") {
            let values = random.named(param.name()).uniform_tensor(param.shape(), range.start, range.end);
            *param = Param::from_tensor(param.name(), values);
        }
    });
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

#[test]
fn pictures_have_the_pixels_of_renderings() {
    for (region, compact_groups) in [IN_BOX, NDC, CONTRACTED].into_iter().flat_map(|region| [(region, false), (region, true)]) {
        let config =
            Config { group_in_pictures: 0.02, compact_groups, color_above: 1e-3, stop_below_in_pictures: 1e-3, ..tiny(&[(30, 1)]) };
        let model = wide(config, region);
        let rays = if region == IN_BOX { rays(200) } else { rays_of_a_capture(200) };
        let viewer = model.viewer(&ViewOptions::over([1.0; 3]));
        // The first rays are rendered without a table.
        (0..8).for_each(|_| drop(viewer(&vec![Ray { origin: DVec3::splat(99.0), direction: DVec3::X, stretch: 1.0 }; 1 << 14])));
        let picture = viewer(&rays);
        let rendered = no_grad(|| model.render(&rays, &PASS));
        let columns = |of: &Rendered<f64>| [of.rgb.clone(), of.depth(), of.opacity.clone()];
        for (picture, rendered) in columns(&picture).iter().zip(columns(&rendered)) {
            let off = picture.data().iter().zip(rendered.data()).fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
            // A table rounds differently.
            assert!(off > 0.0 && off < 1e-6, "{region:?}: {off}");
        }
        let (fewer, all) = (picture.sample_count, rendered.sample_count);
        assert!(fewer <= all && fewer > 400, "{region:?}: {fewer} of {all}");
    }
}

#[test]
fn gradients_of_pixels_with_respect_to_every_parameter_are_right_in_both_orders() {
    let model = dense::<f64>(&[(4, 1)]);
    // Few rays and hidden units, none of which is at the kink of its ReLU.
    let rays = rays(2);
    let mut inputs = Vec::new();
    model.visit(&mut |param| inputs.push(param.tensor().to_array()));
    let pixels = |x: &[Tensor<f64>]| {
        let mut model = dense::<f64>(&[(4, 1)]);
        bind(&mut model, x);
        model.render(&rays, &PASS).rgb
    };
    gradcheck(pixels, inputs);
}

#[test]
fn the_kernel_agrees_with_the_graph_in_the_spaces_of_captures() {
    let (rays, pass) = (rays_of_a_capture(24), Pass { jitter: Jitter::PerRay { seed: 3, step: 7 }, ..PASS });
    for (region, gradient_scaling) in [(NDC, 0.0), (CONTRACTED, 0.0), (CONTRACTED, 2.0)] {
        let mut model = wide(Config { cell_depth: 2.0, gradient_scaling, ..tiny(&[(9, 1)]) }, region);
        agree(&mut model, &[], |model| model.render(&rays, &pass));
    }
}

#[test]
fn gradients_are_scaled_near_cameras_but_not_in_normalized_device_coordinates() {
    let rays = rays_of_a_capture(24);
    let rendered = |region: Region, gradient_scaling: f64| {
        let model = wide(Config { gradient_scaling, ..tiny(&[(9, 1)]) }, region);
        let (pixels, adjoint) = autograd::value_and_grad(|| model.render(&rays, &PASS).rgb.sum());
        let mut gradient = Vec::new();
        model.visit(&mut |param| gradient.extend(adjoint.array(param.tensor())));
        (pixels, gradient)
    };
    let norm = |(_, gradient): &(f64, Vec<f64>)| gradient.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [exact, near, far] = [0.0, 1e-3, 100.0].map(|scaling| rendered(CONTRACTED, scaling));
    // Samples begin at a distance of 0.05.
    assert!(near == exact && far.0 == exact.0 && norm(&far) < 0.1 * norm(&exact), "{} of {}", norm(&far), norm(&exact));
    assert!(rendered(NDC, 100.0) == rendered(NDC, 0.0));
}

#[test]
fn leaving_out_empty_cells_changes_no_other_sample_in_the_contracted_space() {
    let (cube, cells) = (Aabb::cube(Space::CONTRACTED), [24; 3]);
    let full = Stream::new(4).uniform_tensor::<f64>(&[24 * 24 * 24], 0.0, 1.0);
    let occupancy = Occupancy::new(cube, cells, &full.data().iter().map(|x| *x < 0.05).collect::<Vec<_>>());
    for jitter in [Jitter::None, Jitter::PerRay { seed: 1, step: 2 }] {
        let rays = rays_of_a_capture(40);
        let all = sample::<f64>(&rays, &cube, Spacing::Contracted(0.03), jitter, None);
        let some = sample::<f64>(&rays, &cube, Spacing::Contracted(0.03), jitter, Some(&occupancy));
        let kept = all.positions.data().chunks(3).zip(all.t.data()).filter(|(p, _)| occupancy.contains_point(DVec3::from_slice(p)));
        assert_eq!(some.t.data(), kept.map(|(_, t)| *t).collect::<Vec<_>>());
        assert!(!some.is_empty() && some.len() < all.len() / 4);
    }
}

#[test]
fn the_kernel_agrees_with_the_graph_in_values_and_gradients() {
    for (octaves, directions) in [(0, Directions::Harmonics(3)), (2, Directions::Frequency(2))] {
        let mut model = wide(Config { feature_octaves: octaves, directions, ..tiny(&[(9, 1)]) }, IN_BOX);
        let rays = rays(70);
        agree(&mut model, &[], |model| model.render(&rays, &PASS));
    }
}

/// A factor of eight binary digits has an error of at most 0.4 %.
#[test]
fn mixed_precision_is_near_full_precision_in_values_and_gradients() {
    let rays = rays(70);
    let computed = |mixed_precision: bool| {
        let config = Config { density_components: 16, appearance_components: 32, mixed_precision, ..tiny(&[(9, 1)]) };
        let mut model = Tensorf::<f32>::new(config, BOX, 42).expect("valid settings");
        fill_density(&mut model, 0.2..0.75);
        let rgb = model.render(&rays, &PASS).rgb;
        let gradients = rgb.square().sum().backward();
        let mut all = vec![("rgb".to_owned(), rgb.to_array())];
        model.visit(&mut |param| all.push((param.name().to_owned(), gradients.array(param.tensor()))));
        all
    };
    for ((name, mixed), (_, full)) in computed(true).iter().zip(computed(false)) {
        let norm = |x: &ndarray::ArrayD<f32>| x.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
        let (distance, size) = (norm(&(mixed - &full)), norm(&full));
        let has_rounding = distance > 0.0 || !Precision::Mixed.is_available();
        assert!(size > 0.0 && distance <= 0.01 * size && has_rounding, "{name}: {distance} of {size}");
    }
}

fn bind(model: &mut Tensorf<f64>, tensors: &[Tensor<f64>]) {
    let mut next = tensors.iter();
    model.visit_mut(&mut |param: &mut Param<f64>| {
        let tensor = next.next().expect("a tensor for each parameter").clone();
        if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
    });
}

/// A field in which samples have opacities of about a quarter, so that groups have several members.
fn thin(config: Config) -> Tensorf<f64> {
    let mut model = wide(config, IN_BOX);
    model.visit_mut(&mut |param: &mut Param<f64>| {
        if param.name().starts_with("density.line") {
            *param = Param::from_tensor(param.name(), param.tensor().detach() * 0.64);
        }
    });
    model
}

#[test]
fn groups_of_samples_have_the_same_colors_in_the_kernel_and_in_its_reference() {
    for (group, compact_groups) in [(0.9, false), (0.9, true), (0.5, false), (0.5, true)] {
        let config = Config { group, compact_groups, color_above: 0.01, stop_below: 0.01, ..tiny(&[(9, 1)]) };
        let rays = rays(40);
        let pass = Pass { jitter: Jitter::PerRay { seed: 3, step: 7 }, ..PASS };
        let model = thin(config.clone());
        let (_, adjoint) = autograd::value_and_grad(|| all_columns(&model.render(&rays, &pass)));
        // Gradients that can be differentiated again are computed through the reference.
        let mut tables = Vec::new();
        model.visit(&mut |param| tables.push(param.tensor().clone()));
        let reference = autograd::grad(&all_columns(&model.render(&rays, &pass)), &tables.iter().collect::<Vec<_>>());
        for (table, want) in tables.iter().zip(reference) {
            let (want, got) = (want.to_array(), adjoint.array(table));
            let scale = want.iter().fold(1e-12f64, |most, x| most.max(x.abs()));
            assert!(want.iter().zip(&got).all(|(a, b)| (a - b).abs() < 1e-9 * scale));
        }
        // Groups are formed by weight: with a larger weight there are fewer colors, and other pixels.
        let color = |config: Config| thin(config).render(&rays, &pass).rgb.data().to_vec();
        assert_ne!(color(config.clone()), color(Config { group: 0.0, ..config.clone() }));
        assert_ne!(color(config.clone()), color(Config { compact_groups: !compact_groups, ..config }));
    }
}

#[test]
fn pruned_gradients_have_the_expectation_of_exact_ones() {
    const DRAWS: u64 = 60;
    let rays = rays(40);
    let directions: Vec<f64> = rays.iter().flat_map(|ray| ray.direction.to_array()).collect();
    let origins: Vec<f64> = rays.iter().flat_map(|ray| ray.origin.to_array()).collect();
    let [origins, directions] = [origins, directions]
        .map(|of_rays| Tensor::variable(Array2::from_shape_vec((rays.len(), 3), of_rays).expect("three numbers for each ray")));
    // Gradients of all parameters and of the rays.
    let gradients = |gradient_above: f64, step: u64| {
        let model = thin(Config { gradient_above, group: 0.2, ..tiny(&[(9, 1)]) });
        let pass = Pass { jitter: Jitter::PerRay { seed: 3, step }, ..PASS };
        let tracked = TrackedRays::new(origins.clone(), directions.clone(), &rays);
        let (_, adjoint) = autograd::value_and_grad(|| all_columns(&model.render_tracked(&tracked, &pass)));
        let mut all = vec![("origins".to_owned(), adjoint.array(&origins)), ("directions".to_owned(), adjoint.array(&directions))];
        model.visit(&mut |param| all.push((param.name().to_owned(), adjoint.array(param.tensor()))));
        all
    };
    let exact: Vec<_> = (0..DRAWS).map(|step| gradients(0.0, step)).collect();
    // Without jitter, nothing is drawn.
    let picture = |gradient_above: f64| {
        let model = thin(Config { gradient_above, ..tiny(&[(9, 1)]) });
        let (_, adjoint) = autograd::value_and_grad(|| all_columns(&model.render(&rays, &PASS)));
        let mut all = Vec::new();
        model.visit(&mut |param| all.push(adjoint.array(param.tensor())));
        all
    };
    assert_eq!(picture(0.0), picture(1.0));
    // Two numbers for each input: the squared norm of the errors, relative to that of the gradients; and the squared norm of the sum of all errors, relative to
    // its expectation for independent errors with mean 0.
    let errors = |gradient_above: f64| {
        let pruned: Vec<_> = (0..DRAWS).map(|step| gradients(gradient_above, step)).collect();
        let of_input = |k: usize| {
            let square = |x: &ArrayD<f64>| x.iter().map(|x| x * x).sum::<f64>();
            let off: Vec<_> = exact.iter().zip(&pruned).map(|(exact, pruned)| &pruned[k].1 - &exact[k].1).collect();
            let noise = off.iter().map(square).sum::<f64>();
            let norm = exact.iter().map(|exact| square(&exact[k].1)).sum::<f64>();
            let sum = off.iter().fold(ArrayD::zeros(off[0].shape()), |sum, off| sum + off);
            (exact[0][k].0.clone(), noise / norm, square(&sum) / noise)
        };
        (0..exact[0].len()).map(of_input).collect::<Vec<_>>()
    };
    let [few, many] = [0.3, 1.0].map(errors);
    for ((name, few, of_few), (_, many, of_many)) in few.into_iter().zip(many) {
        assert!(0.0 < few && few < many && many < 0.5, "{name}: {few} and {many}");
        // About three standard deviations if all numbers of an input have the same error. If a share b of the squared error were the same in all draws, it
        // would add b · DRAWS.
        assert!(of_few < 10.0 && of_many < 10.0, "{name}: {of_few} and {of_many}");
    }
}

#[test]
fn drawn_members_hardly_change_the_expected_color() {
    let rays = rays(1);
    let color = |group: f64, step: u64| {
        let model = thin(Config { group, color_above: 0.0, ..tiny(&[(9, 1)]) });
        let pass = Pass { jitter: Jitter::PerRay { seed: 3, step }, ..PASS };
        model.render(&rays, &pass).rgb.data()[0]
    };
    const DRAWS: u64 = 4000;
    let mean = |group: f64| (0..DRAWS).map(|step| color(group, step)).sum::<f64>() / DRAWS as f64;
    let exact = mean(0.0);
    let of_group = |group: f64| {
        let spread = (0..100).map(|step| (color(group, step) - color(0.0, step)).powi(2)).sum::<f64>().sqrt() / 10.0;
        (spread, (mean(group) - exact).abs())
    };
    let [(small, off_small), (large, off_large)] = [0.2, 0.5].map(of_group);
    assert!(0.0 < small && small < large, "spreads {small} and {large}");
    // Interpolated colors are not exactly those of the network.
    assert!(off_small < small / 4.0 && off_large < large / 4.0, "{off_small} and {off_large} with spreads of {small} and {large}");
}

#[test]
fn pictures_have_a_distance_of_samples_of_their_own() {
    let rays = rays(40);
    let samples = |step_in_pictures, jitter| {
        let model = Tensorf::<f64>::new(Config { step_in_pictures, ..tiny(&[(16, 1)]) }, BOX, 42).expect("valid settings");
        model.render(&rays, &Pass { jitter, ..PASS }).sample_count as f64
    };
    let training = Jitter::PerRay { seed: 3, step: 7 };
    assert_eq!(samples(1.0, training), samples(0.5, training));
    let ratio = samples(0.5, Jitter::None) / samples(1.0, Jitter::None);
    assert!((1.9..2.1).contains(&ratio), "{ratio}");
}

#[test]
fn training_has_the_same_bits_for_any_number_of_threads() {
    let (train, _) = views();
    let trained = |threads: usize, compact_groups: bool, mixed_precision: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let config = tiny(&[(16, 30), (24, 30)]);
            let config = Config {
                density_components: 16,
                appearance_components: 16,
                group: 0.1,
                compact_groups,
                mixed_precision,
                stop_below: 1e-3,
                gradient_above: 1.0,
                ..config
            };
            let objective = Objective::new().with("mse", 1.0, mse);
            let model = Tensorf::<f32>::new(config, BOX, 42).expect("valid settings");
            let mut trainer = Trainer::with_model(model, &train[..], objective, TrainOptions::default()).expect("a trainer");
            while trainer.step().expect("a step").is_some() {}
            let mut bits = Vec::new();
            trainer.model().visit(&mut |param| bits.extend(param.tensor().data().iter().map(|x| x.to_bits())));
            bits
        })
    };
    for (compact_groups, mixed_precision) in [(false, false), (true, false), (true, true)] {
        let want = trained(1, compact_groups, mixed_precision);
        assert!([2, 3].into_iter().all(|threads| trained(threads, compact_groups, mixed_precision) == want));
    }
}

#[test]
fn a_finer_grid_of_the_same_nodes_is_the_same_field() {
    let mut model = dense::<f64>(&[(4, 1), (7, 1)]);
    let random = Stream::new(9);
    let positions = random.named("positions").uniform_tensor(&[40, 3], -1.4, 1.4);
    let before = model.field().density(&positions);
    // Three cells become six: a node on each old one, and one in the middle, where linear functions are what they were.
    let mut source = plenoxel::rays::RaySource::new(views().0, [1.0; 3], 1);
    let stage = PlannedStage { index: 1, resolution: Some(7), steps: 1, first: 1, first_ray: 256, rays_per_step: 256, ray_cost: 1.0 };
    model.begin_stage(&stage, &mut source).expect("a stage");
    let after = model.field().density(&positions);
    for (a, b) in before.data().iter().zip(after.data()) {
        assert!((a - b).abs() < 1e-9 * a.max(1.0), "{a} {b}");
    }
    assert!(no_grad(|| model.render(&rays(3), &PASS)).sample_count > 0);
}

fn views() -> (Vec<View>, Vec<View>) {
    let options = ProceduralOptions { width: 32, height: 32, train: 24, val: 0, test: 4, supersample: 2 };
    let scene = Dataset::procedural(options).expect("the built-in scene");
    let load = |split| scene.load(split, &|_, _| {}).expect("its views");
    (load(Split::Train), load(Split::Test))
}

fn trainer(views: &[View]) -> Trainer<f32, Tensorf<f32>> {
    let config = Config { factor_rate: 0.05, network_rate: 5e-3, ..tiny(&[(16, 150), (24, 150)]) };
    let options = TrainOptions { rays_per_step: 256, ..TrainOptions::default() };
    let objective = Objective::new().with("mse", 1.0, mse).with("density_l1", 8e-5, density_l1);
    Trainer::with_model(Tensorf::new(config, BOX, 42).expect("valid settings"), views, objective, options).expect("a trainer")
}

#[test]
fn a_scene_is_learned_and_a_resumed_run_has_the_same_bits() {
    let (train, test) = views();
    let mut whole = trainer(&train);
    (0..200).for_each(|_| drop(whole.step().expect("a step")));
    let file = std::env::temp_dir().join(format!("tensorf-{}.safetensors", std::process::id()));
    whole.save(&file, "scene").expect("saved");
    let mut resumed = trainer(&train).resumed(&file).expect("resumed");
    while let Some(report) = whole.step().expect("a step") {
        assert_eq!(resumed.step().expect("a step").as_ref(), Some(&report));
    }
    std::fs::remove_file(file).expect("removed");
    let psnr = |model: &Tensorf<f32>| evaluate(model, &test, &ViewOptions::over([1.0; 3])).psnr().expect("a figure");
    let untrained = psnr(trainer(&train).model());
    let trained = psnr(whole.model());
    assert!(trained > untrained + 8.0, "{untrained} to {trained}");
}

#[test]
fn cells_are_not_smaller_than_pixels() {
    let (train, _) = views();
    let nodes = |pixels_per_cell| {
        let config = Config { pixels_per_cell, ..tiny(&[(41, 1)]) };
        let model = Tensorf::<f32>::new(config, BOX, 42).expect("valid settings").with_hull(Hull::Off);
        let mut trainer =
            Trainer::with_model(model, &train[..], Objective::new().with("mse", 1.0, mse), TrainOptions::default()).expect("a trainer");
        trainer.step().expect("a step");
        trainer.model().field().nodes()
    };
    assert_eq!(nodes(0.0), [41; 3]);
    // The cameras look at the middle of the box.
    let pixel = CAMERA_DISTANCE / train[0].camera.intrinsics.fx;
    let expected = (2.8 / (2.0 * pixel)) as usize + 1;
    assert!(expected < 41 && nodes(2.0) == [expected; 3], "{expected}, {:?}", nodes(2.0));
}

#[test]
fn a_scene_is_learned_without_silhouettes_too() {
    let (train, test) = views();
    let stages = [Stage { resolution: 24, steps: 400, rays: 256 }];
    let config = Config { density_components: 16, appearance_components: 16, stages: stages.to_vec(), ..Config::default() };
    let model = Tensorf::<f32>::new(config, BOX, 42).expect("valid settings").with_hull(Hull::Off);
    let objective = Objective::new().with("mse", 1.0, mse);
    let mut trainer = Trainer::with_model(model, &train[..], objective, TrainOptions::default()).expect("a trainer");
    while trainer.step().expect("a step").is_some() {}
    let psnr = evaluate(trainer.model(), &test, &ViewOptions::over([1.0; 3])).psnr().expect("a figure");
    // An opaque start would stay below.
    let mean = mean_image(&train, [1.0; 3]).and_then(|mean| constant_psnr(&test, &mean, [1.0; 3])).expect("a figure");
    assert!(psnr > mean + 1.0, "{psnr}, {mean} of the mean image");
}

#[test]
fn without_a_hull_the_field_begins_as_a_fog_whose_density_is_constant_at_first() {
    let (train, _) = views();
    let (frozen_steps, density) = (2, 0.5);
    let config = Config { initial_density: density, frozen_steps, ..tiny(&[(9, 4)]) };
    let model = Tensorf::<f32>::new(config, BOX, 42).expect("valid settings").with_hull(Hull::Off);
    let objective = Objective::new().with("mse", 1.0, mse);
    let mut trainer = Trainer::with_model(model, &train[..], objective, TrainOptions::default()).expect("a trainer");
    let positions = Stream::new(9).uniform_tensor(&[20, 3], -1.3, 1.3);
    let mut densities = (0..4).map(|_| {
        trainer.step().expect("a step");
        no_grad(|| trainer.model().field().density(&positions)).to_array()
    });
    let first = densities.next().expect("a step");
    // The other components are random.
    assert!(first.iter().all(|sigma| (0.5..2.0).contains(&(f64::from(*sigma) / density))), "{first}");
    let later: Vec<bool> = densities.map(|densities| densities == first).collect();
    assert_eq!(later, [true, false, false]);
}

#[test]
fn exposure_and_other_losses_and_parameters_train_without_change() {
    let (train, _) = views();
    let model = Tensorf::new(tiny(&[(12, 10), (16, 10)]), BOX, 42).expect("valid settings");
    let names = own_losses::train(model, Objective::new().with("mse", 1.0, mse), &train);
    assert_eq!(names, ["mse", "exposure", "distortion", "thin"]);
}

#[test]
fn settings_without_meaning_are_refused_by_their_key() {
    type Change = fn(&mut Config);
    let wrong: [(&str, Change); 4] = [
        ("density_components", |config| config.density_components = 0),
        ("step", |config| config.step = 0.0),
        ("stages", |config| config.stages.clear()),
        ("stages[0].resolution", |config| config.stages[0].resolution = 1),
    ];
    for (key, change) in wrong {
        let mut config = tiny(&[(4, 1)]);
        change(&mut config);
        let error = Tensorf::<f32>::new(config, BOX, 42).expect_err(key);
        assert!(error.exit_code() == 2 && error.to_string().starts_with(key), "{error}");
    }
}
