//! Camera paths around the scene, which need no other knowledge than the box.

use super::{Fov, Shot};
use crate::camera::{Camera, Intrinsics};
use glam::{DQuat, DVec3};
use std::f64::consts::{FRAC_PI_2, TAU};

/// Camera path around a vertical axis, looking at a point of it: around +z and the origin, which is the centre of every grid, or around what the cameras of a
/// capture look at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turntable {
    /// Distance from the origin, world length, above 0.
    pub distance: f64,
    /// Elevation above the horizon in radians, within ± 80 degrees. Seen from straight above, an image has no upward direction.
    pub elevation: f64,
    /// Field of view across the shorter side of the image, in radians.
    pub fov: f64,
    /// Point that the camera looks at.
    pub center: DVec3,
    /// Unit direction of the axis, upwards.
    pub up: DVec3,
    /// Azimuths between which the camera swings, radians; `None` for whole turns.
    pub arc: Option<[f64; 2]>,
}

/// Largest gap between the azimuths of cameras beyond which they are on one side of the scene.
const LARGEST_GAP: f64 = 100.0 / 180.0 * std::f64::consts::PI;

/// Largest elevation.
const HIGHEST: f64 = 80.0 / 180.0 * std::f64::consts::PI;
/// Amplitude of a spiral's elevation.
const SWING: f64 = 25.0 / 180.0 * std::f64::consts::PI;
/// Number of turns of a spiral while its elevation oscillates once.
const TURNS: f64 = 2.0;

impl Turntable {
    /// Returns a turntable around +z and the origin with the mean distance, elevation and field of view of some cameras; `None` if all of them are at
    /// the origin.
    pub fn like(cameras: &[Camera]) -> Option<Self> {
        Turntable::around(cameras, DVec3::ZERO, DVec3::Z).map(|table| Turntable { arc: None, ..table })
    }

    /// Returns a turntable around a point and a unit axis with the mean distance, elevation and field of view of some cameras; `None` if all of them are
    /// at the point. It swings if the cameras are on one side: if a gap of more than 100 degrees is between two of them, seen along the axis.
    pub fn around(cameras: &[Camera], center: DVec3, up: DVec3) -> Option<Self> {
        let offset = |camera: &Camera| camera.position() - center;
        let away: Vec<&Camera> = cameras.iter().filter(|camera| offset(camera).length() > 0.0).collect();
        let mean = |of: &dyn Fn(&Camera) -> f64| away.iter().map(|camera| of(camera)).sum::<f64>() / away.len() as f64;
        let half_side = |k: &Intrinsics| (0.5 * k.width as f64 / k.fx).min(0.5 * k.height as f64 / k.fy);
        (!away.is_empty()).then(|| Turntable {
            distance: mean(&|camera| offset(camera).length()),
            elevation: mean(&|camera| offset(camera).normalize().dot(up).clamp(-1.0, 1.0).asin()).clamp(-HIGHEST, HIGHEST),
            fov: 2.0 * mean(&|camera| half_side(&camera.intrinsics)).atan(),
            center,
            up,
            arc: arc(away.iter().map(|camera| {
                let flat = upright(up).inverse() * offset(camera);
                flat.y.atan2(flat.x)
            })),
        })
    }

    /// Returns a turntable at 30 degrees elevation with the lens of the NeRF-synthetic scenes (50 mm on 36 mm). Its distance is half_width
    /// / sin(fov / 2): the ball inside the cube from −`half_width` to `half_width` that touches its faces fills the image.
    pub fn around_box(half_width: f64) -> Self {
        let fov = 2.0 * (0.5 * 36.0 / 50.0_f64).atan();
        Turntable {
            distance: half_width / (0.5 * fov).sin(),
            elevation: 30.0_f64.to_radians(),
            fov,
            center: DVec3::ZERO,
            up: DVec3::Z,
            arc: None,
        }
    }

    /// Returns a full turn, counterclockwise seen from above, starting at −y, or a swing there and back from the middle of the arc. It ends one frame
    /// before its start, so that it can be played in a loop.
    pub fn orbit(&self, frames: usize) -> Vec<Shot> {
        self.turn(frames, 1.0, |_| self.elevation)
    }

    /// Returns two turns or swings, during which the camera rises by 25 degrees, falls as far below its elevation, and comes back. It ends one frame
    /// before its start.
    pub fn spiral(&self, frames: usize) -> Vec<Shot> {
        self.turn(frames, TURNS, |share| (self.elevation + SWING * (TAU * share).sin()).clamp(-HIGHEST, HIGHEST))
    }

    fn turn(&self, frames: usize, turns: f64, elevation: impl Fn(f64) -> f64) -> Vec<Shot> {
        // The shot has its own field of view, so these intrinsics are not used.
        let any = Intrinsics::from_fov_x(1, 1, self.fov);
        let upright = upright(self.up);
        let shot = |i: usize| {
            let share = i as f64 / frames as f64;
            let azimuth = match self.arc {
                None => TAU * turns * share - FRAC_PI_2,
                Some([low, high]) => 0.5 * (low + high) + 0.5 * (high - low) * (TAU * turns * share).sin(),
            };
            let elevation = elevation(share);
            let direction = DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
            let camera = Camera::look_at(self.center + self.distance * (upright * direction), self.center, self.up, any);
            Shot { camera_to_world: camera.camera_to_world, fov: Fov::Shorter(self.fov) }
        };
        (0..frames).map(shot).collect()
    }
}

/// Returns the rotation of +z to an axis.
fn upright(up: DVec3) -> DQuat {
    DQuat::from_rotation_arc(DVec3::Z, up)
}

/// Returns the arc of azimuths, beyond the largest gap between two of them; `None` if no gap is larger than [`LARGEST_GAP`].
fn arc(azimuths: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    let mut azimuths: Vec<f64> = azimuths.collect();
    azimuths.sort_by(f64::total_cmp);
    let n = azimuths.len();
    let gap = |i: usize| if i + 1 < n { azimuths[i + 1] - azimuths[i] } else { azimuths[0] + TAU - azimuths[i] };
    let widest = (0..n).max_by(|&a, &b| gap(a).total_cmp(&gap(b))).filter(|&i| gap(i) > LARGEST_GAP)?;
    let first = azimuths[(widest + 1) % n];
    Some([first, first + TAU - gap(widest)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Dataset;
    use crate::dataset::Split;
    use crate::dataset::procedural::ProceduralOptions;

    const TABLE: Turntable = Turntable { distance: 3.0, elevation: 0.5, fov: 0.7, center: DVec3::ZERO, up: DVec3::Z, arc: None };

    #[test]
    fn an_orbit_keeps_its_distance_and_height_looks_at_the_centre_and_closes() {
        let shots = TABLE.orbit(12);
        for (i, shot) in shots.iter().enumerate() {
            let camera = shot.camera((40, 30));
            assert!((camera.position().length() - 3.0).abs() < 1e-12 && (camera.position().z - 3.0 * 0.5_f64.sin()).abs() < 1e-12);
            let (x, y, _) = camera.project(DVec3::ZERO).unwrap();
            assert!((x - 20.0).abs() < 1e-9 && (y - 15.0).abs() < 1e-9);
            assert!(camera.project(DVec3::Z * 0.1).unwrap().1 < 15.0, "up is up");
            // The angle to the next frame is constant, also from the last to the first.
            let flat = |shot: &Shot| shot.camera_to_world.translation.truncate();
            let step = flat(shot).angle_to(flat(&shots[(i + 1) % 12]));
            assert!((step - TAU / 12.0).abs() < 1e-9, "frame {i}: {step}");
        }
        assert!(shots[0].camera_to_world.translation.y < 0.0 && shots[0].camera_to_world.translation.x.abs() < 1e-12);
        assert_eq!(TABLE.orbit(1).len(), 1);
    }

    #[test]
    fn an_orbit_around_another_point_and_axis_is_the_same_moved_and_turned() {
        let (center, up) = (DVec3::new(0.4, -2.0, 1.0), DVec3::new(0.6, 0.0, 0.8));
        let moved = Turntable { center, up, ..TABLE };
        for (shot, own) in moved.orbit(7).iter().zip(TABLE.orbit(7)) {
            let (camera, own) = (shot.camera((40, 30)), own.camera((40, 30)));
            let offset = camera.position() - center;
            assert!((offset.length() - 3.0).abs() < 1e-12 && (offset.dot(up) - own.position().z).abs() < 1e-12);
            let (x, y, _) = camera.project(center).unwrap();
            assert!((x - 20.0).abs() < 1e-9 && (y - 15.0).abs() < 1e-9 && camera.project(center + 0.1 * up).unwrap().1 < 15.0);
        }
        let cameras: Vec<Camera> = moved.orbit(12).iter().map(|shot| shot.camera((40, 30))).collect();
        let again = Turntable::around(&cameras, center, up).unwrap();
        assert!((again.distance - 3.0).abs() < 1e-9 && (again.elevation - 0.5).abs() < 1e-9 && (again.fov - 0.7).abs() < 1e-9);
    }

    #[test]
    fn cameras_on_one_side_are_swung_between() {
        let side = Turntable { arc: Some([2.0, 4.0]), ..TABLE };
        // The arc crosses π, where azimuths of two arguments jump.
        let cameras: Vec<Camera> = side.orbit(40).iter().map(|shot| shot.camera((40, 30))).collect();
        let [low, high] = Turntable::around(&cameras, DVec3::ZERO, DVec3::Z).unwrap().arc.unwrap();
        assert!((low - 2.0).abs() < 0.02 && (high - 4.0).abs() < 0.02, "{low} to {high}");
        assert_eq!(Turntable::like(&cameras).unwrap().arc, None);
        let all: Vec<Camera> = TABLE.orbit(5).iter().map(|shot| shot.camera((40, 30))).collect();
        assert_eq!(Turntable::around(&all, DVec3::ZERO, DVec3::Z).unwrap().arc, None);
    }

    #[test]
    fn a_spiral_rises_and_falls_at_one_distance_and_closes() {
        let heights: Vec<f64> = TABLE.spiral(80).iter().map(|shot| shot.camera_to_world.translation.z / 3.0).collect();
        let highest = heights.iter().copied().fold(f64::MIN, f64::max);
        assert!((highest - (0.5 + SWING).sin()).abs() < 1e-9 && (heights[60] - (0.5 - SWING).sin()).abs() < 1e-9);
        assert!((heights[0] - 0.5_f64.sin()).abs() < 1e-12 && (heights[79] - heights[0]).abs() < 0.05);
        let steep = Turntable { elevation: HIGHEST, ..TABLE };
        assert!(steep.spiral(40).iter().all(|shot| shot.camera_to_world.is_finite()));
    }

    #[test]
    fn the_shorter_side_sees_the_same_whatever_the_shape() {
        let focal = |size| TABLE.orbit(1)[0].camera(size).intrinsics.fx;
        assert!((focal((80, 80)) - focal((160, 80))).abs() < 1e-12 && (focal((80, 80)) - focal((80, 200))).abs() < 1e-12);
    }

    #[test]
    fn it_is_like_the_cameras_of_a_dataset_or_fits_the_box() {
        let dataset = Dataset::procedural(ProceduralOptions { width: 40, height: 20, train: 50, val: 0, test: 0, supersample: 1 }).unwrap();
        let cameras = dataset.cameras(Split::Train);
        let table = Turntable::like(&cameras).unwrap();
        assert!((table.distance - cameras[0].position().length()).abs() < 1e-9);
        let camera = table.orbit(1)[0].camera((40, 20));
        assert!((camera.intrinsics.fx - cameras[0].intrinsics.fx).abs() < 1e-9);
        assert!(table.elevation > 0.3 && table.elevation < 0.8);
        assert_eq!(Turntable::like(&[]), None);
        let table = Turntable::around_box(1.5);
        assert!(((1.5 / table.distance).asin() - table.fov / 2.0).abs() < 1e-12 && (4.0..5.0).contains(&table.distance));
    }
}
