//! Camera path before a forward-facing capture: the spiral of LLFF.

use super::{Fov, Shot};
use crate::camera::{Camera, Intrinsics};
use glam::DVec3;
use std::f64::consts::TAU;

/// Quantile of the cameras' distances from the middle along each axis that is the radius of a spiral.
const RADIUS: f64 = 0.9;
/// Number of turns, and of oscillations along the depth in a turn.
const TURNS: f64 = 2.0;
const DEPTH_RATE: f64 = 0.5;
/// Depth that the cameras look at, in units of the nearest depth: that of LLFF for far surfaces at infinity, 0.9 / (1 − 0.75).
const FOCUS: f64 = 3.6;

/// Returns the spiral of LLFF (Mildenhall et al. 2019, `render_path_spiral` of NeRF) for cameras whose mean is at the origin and looks along −z: with θ from 0
/// to 4π, the camera is at (r_x cos θ, −r_y sin θ, −r_z sin θ/2), and looks at the point of the axis at 3.6 times the depth `near` of the nearest surface. r is
/// the 90 % quantile of the cameras' |x|, |y| and |z|. It ends one frame before its start. Empty if there are no cameras.
pub fn spiral(cameras: &[Camera], near: f64, frames: usize) -> Vec<Shot> {
    let n = cameras.len();
    if n == 0 {
        return Vec::new();
    }
    let radius = |axis: usize| {
        let mut distances: Vec<f64> = cameras.iter().map(|camera| camera.position()[axis].abs()).collect();
        distances.sort_by(f64::total_cmp);
        distances[((n - 1) as f64 * RADIUS).round() as usize]
    };
    let radii = DVec3::new(radius(0), radius(1), radius(2));
    let half_side = |k: &Intrinsics| (0.5 * k.width as f64 / k.fx).min(0.5 * k.height as f64 / k.fy);
    let fov = 2.0 * (cameras.iter().map(|camera| half_side(&camera.intrinsics)).sum::<f64>() / n as f64).atan();
    // The shot has its own field of view, so these intrinsics are not used.
    let any = Intrinsics::from_fov_x(1, 1, fov);
    let shot = |i: usize| {
        let angle = TAU * TURNS * i as f64 / frames as f64;
        let eye = radii * DVec3::new(angle.cos(), -angle.sin(), -(DEPTH_RATE * angle).sin());
        let camera = Camera::look_at(eye, -FOCUS * near * DVec3::Z, DVec3::Y, any);
        Shot { camera_to_world: camera.camera_to_world, fov: Fov::Shorter(fov) }
    };
    (0..frames).map(shot).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spiral_stays_among_the_cameras_looks_at_the_focus_and_closes() {
        let place = |i: i32| DVec3::new(0.1 * f64::from(i % 5 - 2), 0.05 * f64::from(i / 5 - 2), 0.01 * f64::from(i % 3 - 1));
        let intrinsics = Intrinsics::from_fov_x(40, 30, 0.9);
        let cameras: Vec<Camera> = (0..25).map(|i| Camera::look_at(place(i), place(i) - DVec3::Z, DVec3::Y, intrinsics)).collect();
        let shots = spiral(&cameras, 4.0 / 3.0, 40);
        for (i, shot) in shots.iter().enumerate() {
            let camera = shot.camera((40, 30));
            assert!(camera.position().abs().cmple(DVec3::new(0.2, 0.1, 0.01) + 1e-12).all(), "frame {i}");
            let (x, y, _) = camera.project(DVec3::new(0.0, 0.0, -4.8)).unwrap();
            assert!((x - 20.0).abs() < 1e-9 && (y - 15.0).abs() < 1e-9);
            assert!((camera.intrinsics.fx - intrinsics.fx).abs() < 1e-9);
            let next = shots[(i + 1) % 40].camera_to_world.translation;
            assert!(camera.position().distance(next) < 0.2 * TAU / 20.0 + 0.01);
        }
        assert!(spiral(&[], 1.0, 3).is_empty());
    }
}
