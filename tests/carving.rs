//! Carving against exact geometry: hulls that keep what they must, colors that explain the pixels.

use glam::{DVec3, dvec3};
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::carve::photo_hull::{self, PhotoConfig};
use plenoxel::carve::{CarveConfig, Carving, Fit, Rule, visual_hull};
use plenoxel::dataset::image::RgbaImage;
use plenoxel::dataset::procedural::{ProceduralOptions, Scene};
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::field::sh;
use plenoxel::geometry::Aabb;
use plenoxel::model::plenoxels::config::{ColorKind, Config, Hull};
use plenoxel::sampling::Occupancy;
use rayon::prelude::*;
use std::ops::ControlFlow;

const HALF_WIDTH: f64 = 1.4;

fn still_life() -> (Dataset, Vec<View>) {
    let dataset = Dataset::procedural(ProceduralOptions::default()).unwrap();
    let views = dataset.load(Split::Train, &|_, _| {}).unwrap();
    (dataset, views)
}

fn voxels(n: usize) -> impl ParallelIterator<Item = [usize; 3]> {
    (0..n * n * n).into_par_iter().map(move |v| [v / (n * n), v / n % n, v % n])
}

/// The point of a voxel at fractions of its side.
fn point(voxel: [usize; 3], n: usize, at: [f64; 3]) -> DVec3 {
    let side = 2.0 * HALF_WIDTH / n as f64;
    DVec3::from_array([0, 1, 2].map(|a| (voxel[a] as f64 + at[a]) * side - HALF_WIDTH))
}

/// True if a cube holds solid matter, as far as its points down to 1/32 of a voxel's side can tell.
fn holds_matter(scene: &Scene, center: DVec3, side: f64, depth: u32) -> bool {
    let distance = scene.distance(center);
    // Outside, the distance is never overestimated.
    if distance > 0.5 * 3f64.sqrt() * side {
        return false;
    }
    distance < 0.0
        || depth > 0
            && (0..8).any(|k| {
                let step = |bit: i32| if k >> bit & 1 == 1 { 0.25 } else { -0.25 } * side;
                holds_matter(scene, center + dvec3(step(0), step(1), step(2)), 0.5 * side, depth - 1)
            })
}

fn carved_wrongly(scene: &Scene, hull: &Occupancy, n: usize) -> usize {
    let side = 2.0 * HALF_WIDTH / n as f64;
    voxels(n).filter(|&voxel| !hull.contains(voxel) && holds_matter(scene, point(voxel, n, [0.5; 3]), side, 5)).count()
}

#[test]
fn the_footprint_rule_carves_no_voxel_that_holds_matter() {
    let (dataset, views) = still_life();
    let scene = dataset.scene().unwrap();
    let margin = CarveConfig::default().margin;
    for n in [64, 128] {
        let hull = visual_hull::by_footprint(&views, Aabb::cube(HALF_WIDTH), [n; 3], margin, &|_| ());
        let wrong = carved_wrongly(scene, &hull, n);
        println!("{n}³, footprint: {} left, {wrong} carved that hold matter", (hull.fraction() * (n * n * n) as f64).round());
        assert_eq!(wrong, 0, "{n}³");
        assert!(hull.fraction() < 0.2, "{n}³: {}", hull.fraction());
    }
}

/// `cargo test --release --test models carving -- --ignored --nocapture`: half a minute for figures that no assertion needs.
#[test]
#[ignore = "figures"]
fn needless_voxels_of_the_rules_against_the_ideal_hull() {
    let (dataset, views) = still_life();
    let scene = dataset.scene().unwrap();
    let cameras = dataset.cameras(Split::Train);
    // A point is in the ideal hull if every camera that sees its pixel sees an object there.
    let in_ideal_hull = |point: DVec3| {
        cameras.iter().all(|camera| {
            let Some((x, y, _)) = camera.project(point) else { return true };
            scene.depth(&camera.ray(x, y)).is_finite()
        })
    };
    let thirds = [1.0 / 6.0, 0.5, 5.0 / 6.0];
    for n in [64, 128, 256] {
        let ideal: Vec<bool> = voxels(n)
            .map(|voxel| {
                scene.distance(point(voxel, n, [0.5; 3])) < -2.0 * HALF_WIDTH / n as f64
                    || (0..27).any(|k| in_ideal_hull(point(voxel, n, [thirds[k / 9], thirds[k / 3 % 3], thirds[k % 3]])))
            })
            .collect();
        let aabb = Aabb::cube(HALF_WIDTH);
        println!("{n}³: {} voxels in the ideal hull", ideal.iter().filter(|i| **i).count());
        for (name, hull) in [
            ("footprint, margin 0.5", visual_hull::by_footprint(&views, aabb, [n; 3], 0.5, &|_| ())),
            ("footprint, margin 0", visual_hull::by_footprint(&views, aabb, [n; 3], 0.0, &|_| ())),
            ("rays", visual_hull::by_rays(&views, aabb, [n; 3], &|_| ())),
        ] {
            let left = voxels(n).filter(|&voxel| hull.contains(voxel)).count();
            let needless = voxels(n).filter(|&[x, y, z]| hull.contains([x, y, z]) && !ideal[(x * n + y) * n + z]).count();
            println!("  {name}: {left} left, {needless} needless, {} carved that hold matter", carved_wrongly(scene, &hull, n));
        }
    }
}

/// A texture that changes over about ten degrees, far behind the still life.
fn surroundings(direction: DVec3) -> [f64; 3] {
    let wave = |axis: DVec3, phase: f64| (18.0 * axis.dot(direction) + phase).sin();
    let channel = |k: f64| wave(dvec3(0.9, -0.3, 0.5), k) + wave(dvec3(-0.4, 0.8, 0.7), 2.0 * k) + wave(dvec3(0.2, 0.6, -0.9), 3.0 * k);
    [1.0, 2.5, 4.0].map(|k| 0.5 + 0.5 * channel(k).sin())
}

/// The same views as photographs without alpha.
fn over_surroundings(mut views: Vec<View>) -> Vec<View> {
    for View { camera, image, .. } in &mut views {
        for (x, y, pixel) in image.enumerate_pixels_mut() {
            let behind = surroundings(camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5).direction);
            let alpha = f64::from(pixel.0[3]) / 255.0;
            for (value, behind) in pixel.0.iter_mut().zip(behind) {
                *value = (alpha * f64::from(*value) + (1.0 - alpha) * 255.0 * behind).round() as u8;
            }
            pixel.0[3] = 255;
        }
    }
    views
}

/// `cargo test --release --test models carving -- --ignored --nocapture`: what the photo hull carves of the hollows that no silhouette shows, and what
/// of matter. A voxel is full by as many of 64 points as lie in matter.
#[test]
#[ignore = "figures"]
fn hollows_in_the_visual_and_in_the_photo_hull() {
    let (dataset, views) = still_life();
    let scene = dataset.scene().unwrap();
    let opaque = over_surroundings(views.clone());
    let report = |name: &str, n: usize, start: &Occupancy, noises: &[f64], views: &[View]| {
        let corners = [0.125, 0.375, 0.625, 0.875];
        let full: Vec<usize> = voxels(n)
            .map(|voxel| (0..64).filter(|k| scene.distance(point(voxel, n, [k / 16, k / 4 % 4, k % 4].map(|c| corners[c]))) < 0.0).count())
            .collect();
        let of = |[x, y, z]: [usize; 3]| full[(x * n + y) * n + z];
        let count = |is: &(dyn Fn([usize; 3]) -> bool + Sync)| voxels(n).filter(|&voxel| is(voxel)).count();
        let tell = |name: &str, hull: &Occupancy| {
            let empty = count(&|v| hull.contains(v) && of(v) == 0);
            // The bowl stands where x < 0, the block with the dimples where x > 0.
            let hollow = |v: [usize; 3], side: f64| {
                let middle = point(v, n, [0.5; 3]);
                hull.contains(v) && of(v) == 0 && side * middle.x > 0.0 && scene.in_hollow(middle)
            };
            let (bowl, dimples) = (count(&|v| hollow(v, -1.0)), count(&|v| hollow(v, 1.0)));
            let lost = |least: usize| count(&|v| start.contains(v) && !hull.contains(v) && of(v) >= least);
            let lost = (lost(32), lost(64));
            println!(
                "  {name}: {empty} empty, {bowl} in the bowl, {dimples} in dimples; carved: {} at least half full, {} full",
                lost.0, lost.1
            );
        };
        println!("{name}, {n}³: {} voxels at least half full", full.iter().filter(|n| **n >= 32).count());
        tell("before", start);
        for &noise in noises {
            let hull = photo_hull::photo_hull(views, start, &PhotoConfig { noise }, &|_, _, _| ()).unwrap();
            tell(&format!("noise {noise}"), &hull);
        }
    };
    let noise = PhotoConfig::default().noise;
    for n in [64, 128] {
        let hull = visual_hull::by_footprint(&views, Aabb::cube(HALF_WIDTH), [n; 3], CarveConfig::default().margin, &|_| ());
        report("from the visual hull", n, &hull, &[noise, 0.8 * noise], &views);
    }
    let n = 64;
    let all = Occupancy::new(Aabb::cube(HALF_WIDTH), [n; 3], &vec![true; n.pow(3)]);
    report("no alpha, from the whole box", n, &all, &[noise], &opaque);
}

/// A few small views of the still life.
fn small() -> Vec<View> {
    let options = ProceduralOptions { width: 48, height: 40, train: 14, val: 0, test: 0, supersample: 2 };
    Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap()
}

#[test]
fn the_rule_by_rays_is_the_same_whether_rays_look_for_voxels_or_voxels_for_rays() {
    let views = small();
    let n = 24;
    let hull = visual_hull::by_rays(&views, Aabb::cube(HALF_WIDTH), [n; 3], &|_| ());
    // A ray meets a voxel exactly if the slab test says so; chords of rounding size may go either way.
    let carved = |voxel: [usize; 3], least: f64| {
        let aabb = Aabb { min: point(voxel, n, [0.0; 3]), max: point(voxel, n, [1.0; 3]) };
        views.iter().any(|view| {
            let (w, h) = view.image.dimensions();
            (0..w * h).filter(|p| view.image.get_pixel(p % w, p / w).0[3] == 0).any(|p| {
                let ray = view.camera.ray(f64::from(p % w) + 0.5, f64::from(p / w) + 0.5);
                aabb.intersect(ray.origin, ray.direction).is_some_and(|(enter, leave)| leave - enter > least)
            })
        })
    };
    let wrong = voxels(n).filter(|&v| if hull.contains(v) { carved(v, 1e-9) } else { !carved(v, 0.0) }).count();
    assert_eq!(wrong, 0);
}

/// A sphere of radius 0.6 whose color is a function of the direction of view, seen from all sides.
fn sphere(color: impl Fn(DVec3) -> [f64; 3]) -> Vec<View> {
    let views = (0..40).map(|k| {
        let (z, angle) = (0.95 - 1.9 * (f64::from(k) + 0.5) / 40.0, 2.4 * f64::from(k));
        let eye = 4.0 * dvec3((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z);
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(64, 64, 0.6));
        let image = RgbaImage::from_fn(64, 64, |x, y| {
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let nearest = ray.origin - ray.origin.dot(ray.direction) * ray.direction;
            if nearest.length() > 0.6 {
                return [0; 4].into();
            }
            let [r, g, b] = color(ray.direction).map(|c| (255.0 * c).round() as u8);
            [r, g, b, 255].into()
        });
        View { name: format!("r_{k}"), camera, image, depth: None, mask: None }
    });
    views.collect()
}

fn config(resolution: usize, sh_degree: Option<usize>) -> Config {
    let carve = CarveConfig { resolution, ..CarveConfig::default() };
    let color = if sh_degree.is_some() { ColorKind::Sh } else { ColorKind::Rgb };
    Config { half_width: 0.8, color, sh_degree: sh_degree.unwrap_or(0), carve, ..Config::default() }
}

/// Mean squared error of the pixels that show voxels, composited by the walk itself.
fn error_of(views: &[View], config: &Config) -> f64 {
    let grid = Carving::new(views, &config.carve_options(), &|_| {}).unwrap().color(&|_| {}).grid;
    let shape = *grid.shape();
    let count = if config.color == ColorKind::Rgb { 1 } else { sh::count(config.sh_degree) };
    let walk = plenoxel::sampling::walk::Walk::new(grid.aabb(), grid.lattice().nodes());
    let (mut sum, mut n) = (0.0, 0);
    for view in views {
        for (x, y, _) in view.image.enumerate_pixels().filter(|(.., p)| p.0[3] > 0) {
            let ray = view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let d = autograd::Tensor::<f64>::from_vec(ray.direction.to_array().to_vec(), &[1, 3]);
            let basis = sh::basis(&d, config.sh_degree);
            let (mut light, mut color) = (1.0, [0.0; 3]);
            let visit = |c: plenoxel::sampling::walk::Crossing| {
                if let Some(row) = grid.lattice().row(c.voxel) {
                    let pass = (-config.carve.depth / shape.voxel_side() * (c.leave - c.enter)).exp();
                    let row = &grid.color.tensor().data()[row as usize * 3 * count..][..3 * count];
                    for (out, x) in color.iter_mut().zip(row.chunks(count)) {
                        let seen = match config.color {
                            ColorKind::Rgb => f64::from(x[0]),
                            ColorKind::Sh => {
                                let sum: f64 = x.iter().zip(basis.data()).map(|(x, y)| f64::from(*x) * y).sum();
                                (config.sh_offset + sum).max(0.0)
                            }
                        };
                        *out += light * (1.0 - pass) * seen;
                    }
                    light *= pass;
                }
                ControlFlow::Continue(())
            };
            walk.along(&ray, |_| 0, visit);
            for (c, target) in color.iter().zip(view.color(x as usize, y as usize, config.background)) {
                sum += (c + light - f64::from(target)).powi(2);
            }
            n += 3;
        }
    }
    sum / f64::from(n)
}

#[test]
fn harmonics_find_a_color_that_depends_on_the_direction_and_means_cannot() {
    // Of degree 2, within [0, 1].
    let views = sphere(|d| [0.5 + 0.3 * d.x, 0.5 + 0.4 * d.y * d.z, 0.3]);
    let rms = |config: &Config| error_of(&views, config).sqrt();
    let mean = rms(&config(20, None));
    let exact = rms(&config(20, Some(2)));
    let mut descent = config(20, Some(2));
    descent.carve.fit = Fit::Sgd;
    let descent = rms(&descent);
    println!("mean {mean:.4}, exact {exact:.4}, descent {descent:.4}");
    // The spread of the color itself is 0.3 / √3 and 0.4 / √15 in two of three channels: 0.116.
    assert!(mean > 0.03 && exact < 0.012 && descent < mean, "mean {mean:.4}, exact {exact:.4}, descent {descent:.4}");
}

#[test]
fn every_sweep_lowers_the_error_that_a_viewer_sees() {
    let views = small();
    let error = |sweeps: usize, degree: Option<usize>| {
        let mut config = config(24, degree);
        (config.half_width, config.carve.sweeps, config.carve.ridge) = (HALF_WIDTH, sweeps, 0.0);
        error_of(&views, &config)
    };
    for degree in [None, Some(0), Some(1)] {
        let errors: Vec<f64> = (0..4).map(|sweeps| error(sweeps, degree)).collect();
        assert!(errors.windows(2).all(|pair| pair[1] < pair[0]), "degree {degree:?}: {errors:?}");
    }
}

#[test]
fn without_sweeps_a_color_is_the_mean_of_the_pixels_that_show_the_voxel() {
    // One color all over: whatever the weights, the mean is that color.
    let views = sphere(|_| [0.2, 0.6, 1.0]);
    let mut config = config(20, None);
    config.carve.sweeps = 0;
    let grid = Carving::new(&views, &config.carve_options(), &|_| {}).unwrap().color(&|_| {}).grid;
    for color in grid.color.tensor().data().chunks(3).filter(|color| color.iter().any(|c| *c > 0.0)) {
        for (c, want) in color.iter().zip([0.2, 0.6, 1.0]) {
            assert!((c - want).abs() < 1e-3, "{color:?}");
        }
    }
}

/// How far the colors that are found without sweeps are from the least squares of each voxel by itself, over the pixels that show it, each with
/// `weight(w)` for its share w of the pixel: the largest of |Σ weight S (p − S x)| / Σ weight over harmonics and channels, in the mean over voxels and at most.
fn off_the_least_squares(views: &[View], degree: Option<usize>, weight: impl Fn(f64) -> f64) -> [f64; 2] {
    let mut config = config(24, degree);
    (config.half_width, config.carve.sweeps, config.carve.ridge) = (HALF_WIDTH, 0, 0.0);
    let grid = Carving::new(views, &config.carve_options(), &|_| {}).unwrap().color(&|_| {}).grid;
    let (count, offset) = degree.map_or((1, 0.0), |degree| (sh::count(degree), config.sh_offset));
    let walk = plenoxel::sampling::walk::Walk::new(grid.aabb(), grid.lattice().nodes());
    let density = config.carve.depth / grid.shape().voxel_side();
    // Of each voxel 3 · count sums, then that of the weights.
    let width = 3 * count + 1;
    let mut sums = vec![0.0; grid.lattice().rows() * width];
    for view in views {
        for (x, y, _) in view.image.enumerate_pixels().filter(|(.., p)| p.0[3] > 0) {
            let ray = view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let target = view.color(x as usize, y as usize, config.background);
            let d = autograd::Tensor::<f64>::from_vec(ray.direction.to_array().to_vec(), &[1, 3]);
            let basis = degree.map_or(vec![1.0], |degree| sh::basis(&d, degree).data().to_vec());
            let mut light = 1.0;
            let visit = |crossing: plenoxel::sampling::walk::Crossing| {
                if let Some(row) = grid.lattice().row(crossing.voxel) {
                    // The voxel behind which hardly any light is left takes all of it.
                    let behind = light * (-density * (crossing.leave - crossing.enter)).exp();
                    let behind = if behind < 1.0 / 128.0 { 0.0 } else { behind };
                    let w = weight(light - behind);
                    light = behind;
                    let color = &grid.color.tensor().data()[row as usize * 3 * count..][..3 * count];
                    let sums = &mut sums[row as usize * width..][..width];
                    for (c, color) in color.chunks(count).enumerate() {
                        let seen: f64 = color.iter().zip(&basis).map(|(x, s)| f64::from(*x) * s).sum();
                        for (k, s) in basis.iter().enumerate() {
                            sums[c * count + k] += w * s * (f64::from(target[c]) - offset - seen);
                        }
                    }
                    sums[width - 1] += w;
                }
                if light == 0.0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            walk.along(&ray, |_| 0, visit);
        }
    }
    let shown = sums.chunks(width).filter(|sums| sums[width - 1] > 0.1);
    let off: Vec<f64> =
        shown.map(|sums| sums[..width - 1].iter().fold(0.0, |worst: f64, sum| worst.max(sum.abs())) / sums[width - 1]).collect();
    assert!(off.len() > 1000);
    [off.iter().sum::<f64>() / off.len() as f64, off.iter().copied().fold(0.0, f64::max)]
}

#[test]
fn without_sweeps_colors_are_least_squares_weighted_by_the_light_that_voxels_give_to_pixels() {
    let views = small();
    for degree in [None, Some(1)] {
        let [mean, worst] = off_the_least_squares(&views, degree, |share| share);
        let [unweighted, _] = off_the_least_squares(&views, degree, |_| 1.0);
        println!("degree {degree:?}: {mean:.6} in the mean, at most {worst:.6}; with equal weights {unweighted:.4}");
        assert!(mean < 1e-4 && worst < 0.01, "degree {degree:?}: {mean}, at most {worst}");
        // The scene has colors enough: a voxel behind others sees what they show.
        assert!(unweighted > 0.01 && unweighted > 100.0 * mean, "degree {degree:?}: {unweighted}");
    }
}

#[test]
fn any_number_of_threads_carves_and_colors_to_the_same_bits() {
    let views = small();
    for (rule, fit) in [(Rule::Footprint, Fit::Exact), (Rule::Rays, Fit::Sgd)] {
        let mut config = config(24, Some(1));
        (config.half_width, config.carve.rule, config.carve.fit) = (HALF_WIDTH, rule, fit);
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let grid = Carving::new(&views, &config.carve_options(), &|_| {}).unwrap().color(&|_| {}).grid;
                let bits: Vec<u32> = grid.color.tensor().data().iter().map(|x| x.to_bits()).collect();
                (grid.lattice().masks().to_vec(), bits)
            })
        };
        let one = on(1);
        assert!(one == on(2) && one == on(3));
    }
}

#[test]
fn images_and_boxes_that_cannot_be_carved_are_refused_with_the_reason() {
    let refused = |views: &[View], config: &Config| Carving::new(views, &config.carve_options(), &|_| {}).unwrap_err().to_string();
    let views = sphere(|_| [0.5; 3]);
    let with_alpha = |alpha: u8| {
        let mut views = views.clone();
        views.iter_mut().for_each(|view| view.image.pixels_mut().for_each(|p| p.0[3] = alpha));
        views
    };
    assert!(refused(&with_alpha(255), &config(8, None)).contains("no transparent pixel"));
    assert!(refused(&with_alpha(0), &config(8, None)).contains("transparent all over"));
    let mut far = config(8, None);
    far.half_width = 1000.0;
    assert!(refused(&views, &far).contains("the camera of r_0 is inside the box"), "{}", refused(&views, &far));
    assert_eq!(Carving::new(&with_alpha(0), &far.carve_options(), &|_| {}).unwrap_err().exit_code(), 3);
    let mut wide = config(8, None);
    wide.carve.margin = 100.0;
    assert!(refused(&views, &wide).contains("no image shows"), "{}", refused(&views, &wide));
    let mut beside = views.clone();
    beside.iter_mut().for_each(|view| view.camera.camera_to_world.translation += dvec3(0.0, 0.0, 3.0));
    let mut small = config(8, None);
    small.half_width = 0.2;
    assert!(refused(&beside, &small).contains("leave no voxel"), "{}", refused(&beside, &small));
}

#[test]
fn silhouettes_give_training_its_box_and_its_voxels() {
    let views = sphere(|_| [0.3, 0.2, 0.1]);
    let mut config = Config { hull: Hull::Auto, half_width: 1.5, rays_per_step: 64, ..Config::default() };
    config.stages.truncate(1);
    config.stages[0].steps = Some(1);
    let trained = |config: &Config| {
        let mut trainer = plenoxel::model::plenoxels::Trainer::<f32>::new(config.clone(), &views[..]).unwrap();
        trainer.step().unwrap();
        trainer.into_grid()
    };
    let grid = trained(&config);
    // A sphere of radius 0.6, found with voxels of side 3 / 64 and pixels of 0.04.
    assert!((0.6..0.75).contains(&grid.shape().half_width), "{}", grid.shape().half_width);
    assert!(!grid.lattice().is_full());
    config.hull = Hull::Off;
    let grid = trained(&config);
    assert!(grid.shape().half_width == 1.5 && grid.lattice().is_full());
}

#[test]
fn training_that_starts_from_a_carved_grid_sees_what_was_carved() {
    let views = sphere(|d| [0.5 + 0.3 * d.x, 0.4, 0.3]);
    let carved = Carving::new(&views, &config(16, None).carve_options(), &|_| {}).unwrap().color(&|_| {}).grid;
    let mut config = Config { half_width: 0.8, rays_per_step: 512, jitter: false, ..Config::default() };
    let psnr = |config: &Config, carved: Option<_>| {
        let trainer = plenoxel::model::plenoxels::Trainer::<f32>::new(config.clone(), &views[..]).unwrap();
        let mut trainer = carved.into_iter().fold(trainer, plenoxel::model::plenoxels::Trainer::starting_from);
        let plan: Vec<usize> = trainer.plan().iter().map(|p| p.resolution.unwrap()).collect();
        (trainer.step().unwrap().unwrap().psnr, plan)
    };
    let (cold, plan) = psnr(&config, None);
    assert_eq!(plan, [16, 32, 64, 128]);
    let (warm, plan) = psnr(&config, Some(&carved));
    assert_eq!(plan, [16, 32, 64, 128]);
    assert!(warm > cold + 2.0, "{warm} against {cold}");
    // Coarser stages are left out, but never all of them.
    config.stages.truncate(1);
    config.stages.insert(0, plenoxel::model::plenoxels::config::Stage { resolution: 4, ..config.stages[0] });
    assert_eq!(psnr(&config, Some(&carved)).1, [16]);
    config.stages.truncate(1);
    assert_eq!(psnr(&config, Some(&carved)).1, [4]);
}
