//! The viewer of `report.html` against the library: what its JavaScript makes of the bytes of a grid, look-ups, harmonics and pixels. The shader
//! itself needs a browser; `support/viewer.js` does the same in numbers, on what `viewer.js` gives the shader.
//!
//! Nothing is tested where there is no `node`.

use autograd::Tensor;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use glam::DVec3;
use plenoxel::camera::lens::Lens;
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::evaluate::Viewer;
use plenoxel::export::web::WebGrid;
use plenoxel::field::sh;
use plenoxel::field::voxel_grid::{Color, GridShape, GridSpace, Interpolation, VoxelGrid};
use plenoxel::model::plenoxels::config::Sampling;
use plenoxel::model::plenoxels::grid_viewer;
use plenoxel::render::{Engine, Field};
use plenoxel::space::Space;
use serde_json::{Value, json};
use std::io::Write;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};

const SCRIPT: &str = concat!(
    include_str!("../cli/src/html/camera.js"),
    include_str!("../cli/src/report/viewer.js"),
    "\n",
    include_str!("support/viewer.js")
);
/// Directions in which harmonics are compared, and points where densities are.
const POINTS: usize = 1000;

/// Has node run the script on what is asked; `None` where there is no node.
fn asked_of_node(asked: &Value) -> Option<Value> {
    static COUNT: AtomicUsize = AtomicUsize::new(0);
    let number = COUNT.fetch_add(1, Ordering::Relaxed);
    let script = std::env::temp_dir().join(format!("plenoxel-viewer-{}-{number}.js", std::process::id()));
    std::fs::write(&script, SCRIPT).unwrap();
    let started = Command::new("node").arg(&script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
    let Ok(mut node) = started else {
        println!("skipped: there is no node");
        return None;
    };
    node.stdin.take().unwrap().write_all(asked.to_string().as_bytes()).unwrap();
    let answer = node.wait_with_output().unwrap();
    std::fs::remove_file(&script).unwrap();
    assert!(answer.status.success());
    Some(serde_json::from_slice(&answer.stdout).unwrap())
}

/// A small ball beside the middle of an empty box, and a speck far from it, in random colors.
fn matter(shape: GridShape) -> VoxelGrid<f32> {
    let grid = VoxelGrid::random(shape, 1.0, 1.0, 7);
    let density = (0..grid.lattice().rows()).map(|row| {
        let Some(node) = grid.lattice().node(row as u32) else { return 0.0 };
        let far = |center: [f64; 3]| DVec3::from(node.map(|k| k as f64)).distance(DVec3::from(center));
        ((6.0 - far([12.5, 9.0, 14.2])).max(1.2 - far([30.0, 29.0, 3.0])) / shape.half_width) as f32
    });
    grid.with_density(Tensor::from_vec(density.collect(), &[grid.lattice().rows(), 1]))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

#[test]
fn the_page_reads_a_grid_as_the_library_does() {
    let sh = |degree| Color::Sh { degree, offset: 0.5 };
    let step = Sampling::Step { step: 0.5 };
    for (color, sh_reduction, interpolation, sampling) in [
        (Color::Rgb, 1, Interpolation::Nearest, step),
        (Color::Rgb, 1, Interpolation::Trilinear, Sampling::Points { samples: 200, far: 6.0 }),
        (sh(1), 1, Interpolation::Nearest, step),
        (sh(2), 3, Interpolation::Trilinear, step),
        (sh(3), 1, Interpolation::Trilinear, step),
    ] {
        let shape = GridShape { sh_reduction, ..GridShape::new(33, 1.3, interpolation, color) };
        let (small, bytes) = WebGrid::within(&matter(shape), usize::MAX).unwrap();
        let grid = small.to_grid();
        let points: Vec<f32> = (0..3 * POINTS).map(|i| (0.6 * f64::sin(1.7 * (i * i) as f64) * shape.half_width) as f32).collect();
        let directions: Vec<[f64; 3]> =
            points.as_chunks::<3>().0.iter().map(|p| DVec3::from(p.map(f64::from)).normalize().into()).collect();
        let intrinsics = Intrinsics { width: 12, height: 9, fx: 15.0, fy: 14.0, cx: 5.5, cy: 4.8, lens: Lens::Pinhole };
        // From outside, and from within the box.
        let cameras =
            [DVec3::new(2.5, -1.9, 1.3), DVec3::new(-0.9, 0.8, -0.7)].map(|eye| Camera::look_at(eye, DVec3::ZERO, DVec3::Z, intrinsics));
        let background = [0.2, 0.9, 0.4];
        let coordinates = GridSpace::default();
        let answer = asked_of_node(&json!({
            "scene": { "grid": small.header(), "coordinates": coordinates, "sampling": sampling, "background": background, "views": cameras.each_ref().map(view) },
            "bytes": STANDARD.encode(bytes),
            "points": points.as_chunks::<3>().0,
            "directions": directions,
            "halves": [1.0, -2.5, 65504.0, 1e9, 0.0, 6e-8],
        }));
        let Some(answer) = answer else { return };
        let what = format!("{color:?}, {interpolation:?}, harmonics for each {sh_reduction}³");

        let known = grid.density(&Tensor::from_vec(points, &[POINTS, 3]));
        let densities = numbers(&answer["densities"]);
        assert!(densities.iter().filter(|density| **density > 0.0).count() > 20, "{what}");
        for (seen, known) in densities.iter().zip(known.data()) {
            assert!((seen - f64::from(*known)).abs() < 1e-4 * (1.0 + seen), "{what}: density {seen}, in the library {known}");
        }
        let basis = sh::basis(&Tensor::from_vec(directions.concat(), &[POINTS, 3]), 3);
        for (seen, known) in answer["bases"].as_array().unwrap().iter().zip(basis.data().chunks(16)) {
            assert!(numbers(seen).iter().zip(&known[1..]).all(|(a, b)| (a - b).abs() < 1e-8), "{seen} {known:?}");
        }
        assert_eq!(answer["halves"], json!([0x3c00, 0xc100, 0x7bff, 0x7bff, 0, 1]));

        let viewer = grid_viewer(&grid, sampling, Engine::Fused, background.map(|c| c as f32));
        assert_same_pictures(&viewer, &cameras, &answer, &what);
    }
}

/// The pictures of the page are those of the library.
fn assert_same_pictures(viewer: &Viewer<'_, f32>, cameras: &[Camera], answer: &Value, what: &str) {
    assert!(answer["skipped"].as_u64().unwrap() > 100, "empty space is skipped");
    for (camera, picture) in cameras.iter().zip(answer["pictures"].as_array().unwrap()) {
        let known = viewer.see(camera).rgb;
        let seen: Vec<f64> = picture.as_array().unwrap().iter().flat_map(numbers).collect();
        let worst = seen.iter().zip(known.iter()).map(|(a, b)| (a - f64::from(*b)).abs()).fold(0.0, f64::max);
        // Colors are half floats in the page; a ray that ends may lose a thousandth of the light.
        assert!(seen.len() == known.len() && worst < 4e-3, "{what}: a pixel is {worst} from the library's");
        let least = known.iter().copied().fold(f32::INFINITY, f32::min);
        assert!(known.iter().any(|c| c - least > 0.2), "{what}: there is something to see");
    }
}

/// A camera as the page has it.
fn view(camera: &Camera) -> Value {
    let Intrinsics { width, height, fx, fy, cx, cy, .. } = camera.intrinsics;
    json!({ "pose": camera.camera_to_world.to_cols_array(), "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy })
}

#[test]
fn the_page_marches_the_rays_of_captures_as_the_library_does() {
    let color = Color::Sh { degree: 2, offset: 0.5 };
    let intrinsics = Intrinsics { width: 12, height: 9, fx: 11.0, fy: 10.0, cx: 5.5, cy: 4.8, lens: Lens::Pinhole };
    let camera = |eye: [f64; 3], target: [f64; 3]| Camera::look_at(eye.into(), target.into(), DVec3::new(0.1, 1.0, 0.2), intrinsics);
    // Inside the part of space that is not contracted, at its border, and in the contracted part; in each, looking at matter.
    let around = [
        camera([0.3, -0.2, 0.1], [-0.6, -0.7, 0.4]),
        camera([1.0, 0.4, -0.9], [-0.5, -0.7, 0.2]),
        camera([3.0, -1.2, 0.7], [-0.5, -0.7, 0.2]),
    ];
    let forward = [camera([0.1, -0.2, 0.05], [-0.3, -0.2, -2.0]), camera([-0.2, 0.1, -0.1], [0.0, -0.2, -1.6])];
    let spaces: [(GridSpace, f64, &[Camera]); 2] = [
        (GridSpace { space: Space::Contracted, stretch: DVec3::ONE }, Space::CONTRACTED, &around),
        (GridSpace { space: Space::Ndc { a: 1.6, b: 2.1 }, stretch: DVec3::new(1.0, 1.0, 0.3) }, 1.3, &forward),
    ];
    for (coordinates, half_width, cameras) in spaces {
        let shape = GridShape { coordinates, ..GridShape::new(33, half_width, Interpolation::Trilinear, color) };
        let (small, bytes) = WebGrid::within(&matter(shape), usize::MAX).unwrap();
        let grid = small.to_grid();
        let background = [0.2, 0.9, 0.4];
        let answer = asked_of_node(&json!({
            "scene": {
                "grid": small.header(),
                "coordinates": coordinates,
                "sampling": { "step": 0.5 },
                "background": background,
                "views": cameras.iter().map(view).collect::<Vec<_>>(),
            },
            "bytes": STANDARD.encode(bytes),
            "points": [],
            "directions": [],
            "halves": [],
        }));
        let Some(answer) = answer else { return };
        let background = background.map(|c| c as f32);
        let viewer = grid_viewer(&grid, Sampling::Step { step: 0.5 }, Engine::Fused, background);
        assert_same_pictures(&viewer, cameras, &answer, &coordinates.space.to_string());
    }
}
