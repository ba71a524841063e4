//! Built-in scene as a dataset: a still life with exact depth, rendered on demand, without files.
//!
//! Cameras are like those of the NeRF-synthetic scenes: same field of view, same distance, on the upper hemisphere. Training and validation
//! views are evenly spread over the hemisphere, on different golden-angle spirals. Test views follow a smooth path around the scene, so
//! that they form a film.

mod bounds;
mod convex;
mod paint;
mod scene;
mod solid;
mod still_life;

use super::normalize::Normalization;
use super::{Dataset, Frame, Source, Split, image};
use crate::camera::{Camera, Intrinsics};
use crate::error::{Error, Result};
use glam::DVec3;
use std::f64::consts::TAU;
use std::path::PathBuf;
use std::sync::Arc;

pub use scene::Scene;

/// Horizontal field of view in radians, as in the NeRF-synthetic scenes.
pub const FOV_X: f64 = 0.6911112070083618;
/// Distance of every camera from the origin, as in the NeRF-synthetic scenes.
pub const CAMERA_DISTANCE: f64 = 4.031128874;

/// Size and number of the images of the built-in scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProceduralOptions {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Number of training views.
    pub train: usize,
    /// Number of validation views.
    pub val: usize,
    /// Number of test views.
    pub test: usize,
    /// Rays per pixel along each axis.
    pub supersample: usize,
}

impl Default for ProceduralOptions {
    /// 200 x 200 pixels of 3 x 3 rays; 100 training, 10 validation and 25 test views.
    fn default() -> Self {
        ProceduralOptions { width: 200, height: 200, train: 100, val: 10, test: 25, supersample: 3 }
    }
}

pub(super) fn dataset(options: ProceduralOptions) -> Result<Dataset> {
    let max = image::MAX_SIDE as usize;
    for (key, value, least, most) in [
        ("width", options.width, 1, max),
        ("height", options.height, 1, max),
        ("train", options.train, 1, 100_000),
        ("val", options.val, 0, 100_000),
        ("test", options.test, 0, 100_000),
        ("supersample", options.supersample, 1, 16),
    ] {
        if value < least || value > most {
            return Err(Error::config(key, value, format!("{least} to {most}")));
        }
    }
    let intrinsics = Intrinsics::from_fov_x(options.width, options.height, FOV_X);
    let frames = Split::ALL.map(|split| {
        let (count, direction): (usize, fn(usize, usize) -> DVec3) = match split {
            Split::Train => (options.train, |k, n| hemisphere(k, n, 0.0)),
            Split::Val => (options.val, |k, n| hemisphere(k, n, 1.0)),
            Split::Test => (options.test, path),
        };
        let frame = |k: usize| {
            let eye = CAMERA_DISTANCE * direction(k, count);
            let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, intrinsics);
            Frame {
                name: format!("r_{k}"),
                camera,
                path: PathBuf::new(),
                mask: None,
                orientation: image::Orientation::Stored,
                full: (options.width, options.height),
            }
        };
        (0..count).map(frame).collect()
    });
    Ok(Dataset {
        name: "procedural".into(),
        format: "built-in still life",
        size: (options.width, options.height),
        frames,
        source: Source::Procedural { scene: Arc::new(Scene::still_life()), supersample: options.supersample },
        normalization: Normalization::default(),
        points: Arc::default(),
        notes: Vec::new(),
    })
}

/// Returns direction `k` of `n` on the upper hemisphere, by equal steps in height and golden angles in azimuth (spherical Fibonacci
/// lattice). The directions are nearly uniform, from just above the horizon to nearly overhead. `turn` radians are added to every azimuth.
fn hemisphere(k: usize, n: usize, turn: f64) -> DVec3 {
    const GOLDEN_ANGLE: f64 = 2.399963229728653; // pi (3 - sqrt 5)
    toward(0.02 + 0.97 * (k as f64 + 0.5) / n as f64, GOLDEN_ANGLE * k as f64 + turn)
}

/// Returns direction `k` of `n` on the test path: two turns around the scene while the height changes slowly between low and high.
fn path(k: usize, n: usize) -> DVec3 {
    let s = (k as f64 + 0.5) / n as f64;
    toward(0.5 - 0.36 * (TAU * s).cos(), 2.0 * TAU * s + 0.3)
}

/// Returns the unit vector with the given z and azimuth.
fn toward(z: f64, azimuth: f64) -> DVec3 {
    let flat = (1.0 - z * z).sqrt();
    DVec3::new(flat * azimuth.cos(), flat * azimuth.sin(), z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small() -> ProceduralOptions {
        ProceduralOptions { width: 24, height: 16, train: 3, val: 1, test: 2, supersample: 2 }
    }

    #[test]
    fn cameras_stand_on_the_upper_hemisphere_and_no_two_splits_share_one() {
        let dataset = Dataset::procedural(ProceduralOptions::default()).unwrap();
        let mut eyes: Vec<DVec3> = Vec::new();
        for split in Split::ALL {
            for camera in dataset.cameras(split) {
                assert!((camera.position().length() - CAMERA_DISTANCE).abs() < 1e-12 && camera.position().z > 0.0);
                assert!(eyes.iter().all(|eye| eye.distance(camera.position()) > 0.01));
                eyes.push(camera.position());
            }
        }
        assert_eq!(eyes.len(), 135);
    }

    #[test]
    fn loading_reports_progress_and_repeats_itself_to_the_bit() {
        let dataset = Dataset::procedural(small()).unwrap();
        let highest = std::sync::atomic::AtomicUsize::new(0);
        let views = dataset.load(Split::Train, &|done, total| {
            assert_eq!(total, 3);
            highest.fetch_max(done, std::sync::atomic::Ordering::Relaxed);
        });
        let (views, again) = (views.unwrap(), dataset.load(Split::Train, &|_, _| ()).unwrap());
        assert_eq!(highest.into_inner(), 3);
        for (a, b) in views.iter().zip(&again) {
            assert!(a.image == b.image && a.depth == b.depth && a.name == b.name);
            assert_eq!(a.depth.as_ref().unwrap().dim(), (16, 24));
        }
    }

    #[test]
    fn impossible_options_are_named() {
        for (options, key) in [
            (ProceduralOptions { width: 0, ..small() }, "width"),
            (ProceduralOptions { height: 20_000, ..small() }, "height"),
            (ProceduralOptions { train: 0, ..small() }, "train"),
            (ProceduralOptions { supersample: 17, ..small() }, "supersample"),
        ] {
            let error = Dataset::procedural(options).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().starts_with(key), "{error}");
        }
    }

    #[test]
    fn one_view_of_each_picture_covers_a_third_to_a_half_of_the_frame() {
        let dataset = Dataset::procedural(ProceduralOptions { width: 50, height: 50, ..ProceduralOptions::default() }).unwrap();
        let views = dataset.load(Split::Train, &|_, _| ()).unwrap();
        let covered = |view: &super::super::View| view.image.pixels().map(|pixel| f64::from(pixel.0[3]) / 255.0).sum::<f64>() / 2500.0;
        let mean = views.iter().map(covered).sum::<f64>() / views.len() as f64;
        assert!((0.33..0.5).contains(&mean), "mean coverage {mean}");
    }
}
