use super::*;
use crate::camera::{Camera, Intrinsics, Ray};
use crate::carve::visual_hull::by_footprint;
use crate::dataset::image::RgbaImage;
use crate::geometry::Aabb;
use glam::{DVec3, dvec3};

/// Half the side of the cube in all tests, in a box of half width 1.
const HALF: f64 = 0.75;
/// Half the side, and the depth, of the pit in the top of the cube. The walls of pit and cube lie between voxels of a box of 24³: no voxel
/// is half full.
const PIT: [f64; 2] = [1.0 / 3.0, 0.75];

/// Returns the first point of the cube on a ray, with or without a pit.
fn meets(ray: &Ray, pit: bool) -> Option<DVec3> {
    let in_cube = |p: DVec3| p.abs().max_element() <= HALF;
    let in_pit = |p: DVec3| pit && p.truncate().abs().max_element() < PIT[0] && p.z > HALF - PIT[1];
    let (near, far) = Aabb::cube(HALF).intersect(ray.origin, ray.direction)?;
    const STEPS: usize = 300;
    let along = (0..STEPS).map(|k| near + (far - near) * (k as f64 + 0.5) / STEPS as f64);
    along.map(|t| ray.origin + t * ray.direction).find(|p| in_cube(*p) && !in_pit(*p))
}

/// Returns a color for each position that changes over half a unit, so that only the correct shape explains it.
fn paint(p: DVec3) -> [f64; 3] {
    let wave = |w: DVec3| 0.5 + 0.5 * (8.0 * w.dot(p)).sin();
    [wave(dvec3(1.0, 0.3, 0.6)), wave(dvec3(-0.4, 1.0, 0.5)), wave(dvec3(0.3, -0.6, 1.0))]
}

/// Returns the color of distant surroundings in a direction.
fn surroundings(d: DVec3) -> [f64; 3] {
    paint(3.0 * d)
}

/// Returns views from all directions: of the cube alone, or, if `opaque`, in front of surroundings and without transparency.
fn views(count: usize, pit: bool, opaque: bool) -> Vec<View> {
    let intrinsics = Intrinsics::from_fov_x(56, 56, 0.7);
    let view = |k: usize| {
        let z = 1.0 - 2.0 * (k as f64 + 0.5) / count as f64;
        let (sin, cos) = (2.4 * k as f64).sin_cos();
        let eye = 4.5 * dvec3((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z);
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, intrinsics);
        let image = RgbaImage::from_fn(56, 56, |x, y| {
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let color = meets(&ray, pit).map(paint).or_else(|| opaque.then(|| surroundings(ray.direction)));
            color.map_or([0; 4], |[r, g, b]| [r, g, b, 1.0].map(|value| (255.0 * value).round() as u8)).into()
        });
        View { name: k.to_string(), camera, image, depth: None, mask: None }
    };
    (0..count).map(view).collect()
}

fn box_of(voxels: usize) -> Occupancy {
    Occupancy::new(Aabb::cube(1.0), [voxels; 3], &vec![true; voxels.pow(3)])
}

fn hull(views: &[View], start: &Occupancy, noise: f64) -> Occupancy {
    photo_hull(views, start, &PhotoConfig { noise }, &|_, _, _| ()).unwrap()
}

/// Counts the voxels of a region, selected by their centres: those in a hull, and all.
fn count(hull: &Occupancy, region: impl Fn(DVec3) -> bool) -> (usize, usize) {
    let n = hull.cells()[0];
    let voxels = (0..n.pow(3)).map(|v| [v / (n * n), v / n % n, v % n]);
    let of_region = voxels.filter(|voxel| region(DVec3::from_array(voxel.map(|c| (2.0 * c as f64 + 1.0) / n as f64 - 1.0))));
    of_region.fold((0, 0), |(left, all), voxel| (left + usize::from(hull.contains(voxel)), all + 1))
}

/// Returns true for voxels of the pit, except the layer at its walls.
fn pit(p: DVec3) -> bool {
    p.truncate().abs().max_element() < PIT[0] - 0.1 && p.z > HALF - PIT[1] + 0.1 && p.z < HALF
}

/// Returns true for voxels of the cube with its pit.
fn matter(p: DVec3) -> bool {
    p.abs().max_element() < HALF && !(p.truncate().abs().max_element() < PIT[0] && p.z > HALF - PIT[1])
}

#[test]
fn the_photo_hull_opens_a_pit_that_the_visual_hull_fills() {
    let views = views(40, true, false);
    let visual = by_footprint(&views, Aabb::cube(1.0), [24; 3], 0.5, &|_| ());
    assert_eq!(count(&visual, pit).0, count(&visual, pit).1);
    let photo = hull(&views, &visual, 0.12);
    let (left, all) = count(&photo, pit);
    assert!(left * 10 < all, "{left} of {all} voxels of the pit are left");
    let (left, all) = count(&photo, matter);
    assert!(all - left <= all / 500, "{left} of {all} voxels of the cube are left");
}

#[test]
fn without_alpha_the_surroundings_do_not_agree_on_anything_in_the_box() {
    let photo = hull(&views(40, true, true), &box_of(24), 0.12);
    let (left, all) = count(&photo, |p| p.abs().max_element() > HALF + 0.1 || pit(p));
    assert!(left * 20 < all, "{left} of {all} voxels of empty space are left");
    let (left, all) = count(&photo, matter);
    assert!(all - left <= all / 500, "{left} of {all} voxels of the cube are left");
}

#[test]
fn a_consistent_convex_body_loses_nothing() {
    let views = views(30, false, false);
    let visual = by_footprint(&views, Aabb::cube(1.0), [24; 3], 0.5, &|_| ());
    let photo = hull(&views, &visual, 0.15);
    let (left, all) = count(&photo, |p| p.abs().max_element() < HALF);
    assert_eq!(left, all);
}

#[test]
fn less_noise_carves_more() {
    let views = views(24, true, false);
    let left: Vec<f64> = [0.08, 0.12, 0.16, 0.3, 1.0].map(|noise| hull(&views, &box_of(16), noise).fraction()).to_vec();
    assert!(left.windows(2).all(|pair| pair[0] <= pair[1]), "{left:?}");
    assert!(left[0] < left[4]);
}

#[test]
fn any_number_of_threads_carves_the_same() {
    let views = views(16, true, true);
    let with = |views: &[View], threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| hull(views, &box_of(16), 0.12).masks().to_vec())
    };
    let one = with(&views, 1);
    assert!(with(&views, 2) == one && with(&views, 3) == one);
}

#[test]
fn one_view_contradicts_nothing_and_a_noise_of_0_is_refused() {
    let one = &views(1, true, true);
    assert_eq!(hull(one, &box_of(12), 0.01).fraction(), 1.0);
    let error = photo_hull(one, &box_of(12), &PhotoConfig { noise: 0.0 }, &|_, _, _| ()).unwrap_err();
    assert!(error.to_string().starts_with("noise"), "{error}");
}
