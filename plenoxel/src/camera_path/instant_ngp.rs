//! instant-ngp's `base_cam.json`: keyframes in instant-ngp's world frame, interpolated by splines.

use super::{CameraPath, Entries, Entry, Format, Fov, Shot};
use crate::camera::Camera;
use crate::error::Result;
use glam::{DAffine3, DMat3, DQuat, DVec3, DVec4};

/// Scale from the dataset's to instant-ngp's coordinates, and the offset added then (`NERF_SCALE` in its `nerf_loader.h`).
const SCALE: f64 = 0.33;
const OFFSET: f64 = 0.5;

/// Keyframe in the dataset's world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Keyframe {
    rotation: DQuat,
    position: DVec3,
    /// Vertical field of view in radians.
    fov: f64,
}

/// Keyframes of a path.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Keyframes {
    keys: Vec<Keyframe>,
    /// End time of each keyframe's segment, positive and increasing.
    times: Vec<f64>,
    /// True if the first keyframe follows the last.
    looped: bool,
    /// Degree of the spline, 0 to 3.
    order: u8,
}

pub(super) fn read(file: &Entry<'_>) -> Result<CameraPath> {
    let (mut keys, mut times) = (Vec::new(), Vec::new());
    for entry in file.list("path", "keyframe")? {
        keys.push(keyframe(&entry)?);
        times.push(entry.optional("timestamp", f64::is_finite, "a number")?.unwrap_or(0.0));
    }
    // As in instant-ngp, also for its older files.
    if !(times[0] > 0.0 && times.is_sorted_by(|a, b| a < b)) {
        times = (1..=keys.len()).map(|k| k as f64).collect();
    }
    let looped = match file.value.get("loop") {
        None => false,
        Some(value) => value.as_bool().ok_or_else(|| file.wrong("loop", "true or false"))?,
    };
    let order = match file.value.get("spline_order") {
        None => 3,
        Some(value) => value.as_u64().filter(|order| *order <= 3).ok_or_else(|| file.wrong("spline_order", "0, 1, 2 or 3"))?,
    };
    let keyframes = Keyframes { keys, times, looped, order: order as u8 };
    Ok(CameraPath { format: Format::InstantNgp, size: None, fps: None, entries: Entries::Keyframes(keyframes) })
}

fn keyframe(entry: &Entry<'_>) -> Result<Keyframe> {
    const QUATERNION: &str = "a quaternion x, y, z, w of 4 finite numbers, not all of them 0";
    let rotation = DVec4::from(entry.numbers::<4>("R", QUATERNION)?).try_normalize().ok_or_else(|| entry.wrong("R", QUATERNION))?;
    let position = DVec3::from(entry.numbers::<3>("T", "a position of 3 finite numbers")?);
    let camera_to_world = entry.near_enough("T", to_dataset(DMat3::from_quat(DQuat::from_vec4(rotation)), position))?;
    Ok(Keyframe {
        rotation: DQuat::from_mat3(&camera_to_world.matrix3).normalize(),
        position: camera_to_world.translation,
        fov: entry.fov()?,
    })
}

/// Converts a pose from instant-ngp's to the dataset's world frame: the axes are cycled back, y and z of the camera change sign, and the
/// position is (T − ½) / 0.33.
fn to_dataset(rotation: DMat3, position: DVec3) -> DAffine3 {
    // (x, y, z)ngp to (z, x, y).
    let cycle = DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    DAffine3::from_mat3_translation(cycle * rotation * flip, cycle * ((position - OFFSET) / SCALE))
}

impl Keyframes {
    /// Returns a cubic spline over cameras, of which there must be at least one, at equal times.
    pub fn over(cameras: &[Camera]) -> Self {
        let key = |camera: &Camera| Keyframe {
            rotation: DQuat::from_mat3(&camera.camera_to_world.matrix3).normalize(),
            position: camera.position(),
            fov: 2.0 * (0.5 * camera.intrinsics.height as f64 / camera.intrinsics.fy).atan(),
        };
        let times = (1..=cameras.len()).map(|k| k as f64).collect();
        Keyframes { keys: cameras.iter().map(key).collect(), times, looped: false, order: 3 }
    }

    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Returns frames evenly spaced in time. A loop ends one frame before its start, any other path at its last keyframe.
    pub fn shots(&self, frames: usize) -> Vec<Shot> {
        let intervals = if self.looped { frames } else { frames.saturating_sub(1).max(1) };
        (0..frames).map(|i| self.at(i as f64 / intervals as f64)).collect()
    }

    /// Returns the shot at a time in [0, 1]: a uniform B-spline of the keyframes around it, which is smooth and passes near the keyframes
    /// (`CameraPath::eval_camera_path` in `camera_path.h`). Quaternions are summed, each with the sign that is closer to the sum of those
    /// before it.
    fn at(&self, time: f64) -> Shot {
        let (first, t) = self.segment(time);
        let weights = weights(self.order, t);
        let (mut sum, mut position, mut fov) = (DVec4::ZERO, DVec3::ZERO, 0.0);
        for (step, weight) in (-1..).zip(weights) {
            let key = self.key(first as isize + step);
            let rotation = DVec4::from(key.rotation);
            sum += rotation * if sum.dot(rotation) < 0.0 { -weight } else { weight };
            position += weight * key.position;
            fov += weight * key.fov;
        }
        let rotation = sum.try_normalize().map_or(self.key(first as isize).rotation, DQuat::from_vec4);
        Shot { camera_to_world: DAffine3::from_rotation_translation(rotation, position), fov: Fov::Vertical(fov) }
    }

    /// Returns the keyframe before a time in [0, 1], and the fraction of the way to the next one.
    fn segment(&self, time: f64) -> (usize, f64) {
        let segments = if self.looped { self.len() } else { self.len() - 1 };
        if segments == 0 {
            return (0, 0.0);
        }
        let time = time * self.times[segments - 1];
        let segment = self.times[..segments].partition_point(|end| *end <= time).min(segments - 1);
        let start = if segment == 0 { 0.0 } else { self.times[segment - 1] };
        (segment, ((time - start) / (self.times[segment] - start)).clamp(0.0, 1.0))
    }

    /// Returns a keyframe by number. Numbers beyond the ends are wrapped or clamped.
    fn key(&self, number: isize) -> &Keyframe {
        let n = self.len() as isize;
        let number = if self.looped { number.rem_euclid(n) } else { number.clamp(0, n - 1) };
        &self.keys[number as usize]
    }
}

/// Returns the weights of the keyframes before, at, after and next after a position: B-splines of degree 3, 2 and 1, or the nearest
/// keyframe. They sum to 1.
fn weights(order: u8, t: f64) -> [f64; 4] {
    let u = 1.0 - t;
    match order {
        0 => {
            if t < 0.5 {
                [0.0, 1.0, 0.0, 0.0]
            } else {
                [0.0, 0.0, 1.0, 0.0]
            }
        }
        1 => [0.0, u, t, 0.0],
        2 => [u * u / 2.0, 0.5 + t * u, t * t / 2.0, 0.0],
        _ => [u * u * u, 4.0 - 3.0 * t * t * (2.0 - t), 4.0 - 3.0 * u * u * (2.0 - u), t * t * t].map(|w| w / 6.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn path(text: &str) -> CameraPath {
        CameraPath::parse(Path::new("base_cam.json"), text.as_bytes()).unwrap()
    }

    #[test]
    fn a_camera_of_instant_ngp_looks_at_the_middle_of_the_scene_with_z_up() {
        // The initial pose of instant-ngp: 1.5 from the middle of its unit cube, on its +z, which is the dataset's +x. A half turn around x
        // has y down and looks along -z.
        let path = path(r#"{"path": [{"R": [1, 0, 0, 0], "T": [0.5, 0.5, 2.0], "fov": 50.625}]}"#);
        assert_eq!((path.format, path.entries()), (Format::InstantNgp, 1));
        let camera = path.shots(3)[2].camera((200, 100));
        assert!((camera.position() - DVec3::X * 1.5 / 0.33).length() < 1e-12);
        assert!((camera.ray(100.0, 50.0).direction + DVec3::X).length() < 1e-12);
        // A point above the middle is above it in the image, and a point to the viewer's right, +y, is to the right of it.
        let (x, y, _) = camera.project(DVec3::new(0.0, 0.3, 0.2)).unwrap();
        assert!(x > 100.0 && y < 50.0);
        assert!((camera.intrinsics.fy - 50.0 / (50.625_f64.to_radians() / 2.0).tan()).abs() < 1e-9);
    }

    #[test]
    fn a_camera_that_was_saved_by_hand_looks_at_what_it_was_turned_around() {
        // From a published path: T plus `scale` along the line of sight is the point around which the mouse rotated the camera.
        let path = path(
            r#"{"path": [{"R": [0.9752712845802307, 0.02367633581161499, -0.13074590265750885, 0.17660845816135406],
                "T": [0.8360474109649658, 1.0097604990005493, 1.586057424545288], "fov": 50.625, "scale": 1.2396693229675293}]}"#,
        );
        let camera = path.shots(1)[0].camera((100, 100));
        let pivot = camera.position() + 1.2396693229675293 / 0.33 * camera.ray(50.0, 50.0).direction;
        assert!(pivot.length() < 0.3, "{pivot} is not near the middle");
        assert!(camera.camera_to_world.matrix3.y_axis.z > 0.8, "up is up");
    }

    fn line(looped: bool, order: u8) -> CameraPath {
        // T from 0.5 in steps of 0.33 along ngp's z: 0, 1, 2, 3 along the dataset's x.
        let keys: Vec<String> =
            (0..4).map(|k| format!(r#"{{"R": [0, 0, 0, 1], "T": [0.5, 0.5, {}], "fov": 60}}"#, 0.5 + 0.33 * f64::from(k))).collect();
        path(&format!(r#"{{"loop": {looped}, "spline_order": {order}, "path": [{}]}}"#, keys.join(",")))
    }

    fn x(shots: &[Shot]) -> Vec<f64> {
        shots.iter().map(|shot| (shot.camera_to_world.translation.x * 1e6).round() / 1e6).collect()
    }

    #[test]
    fn frames_are_even_in_time_and_a_loop_comes_back_to_its_first_frame() {
        assert_eq!(x(&line(false, 1).shots(7)), [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]);
        assert_eq!(x(&line(true, 1).shots(8)), [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 1.5]);
        assert_eq!(x(&line(false, 0).shots(7)), [0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0]);
        // In the middle of a straight line with even steps, splines of any degree are the line. At its end, keyframes repeat: (2 + 4·3 +
        // 3)/6.
        let cubic = x(&line(false, 3).shots(4));
        assert_eq!(&cubic[1..3], [1.0, 2.0]);
        assert!((cubic[3] - 17.0 / 6.0).abs() < 1e-6);
        let [a, b] = [line(true, 3).shots(8), line(true, 3).shots(4)].map(|shots| x(&shots));
        assert_eq!([a[0], a[2]], [b[0], b[1]]);
    }

    #[test]
    fn weights_add_up_to_one_and_are_continuous_from_keyframe_to_keyframe() {
        for order in 0..=3 {
            for t in [0.0, 0.3, 0.5, 0.9, 1.0] {
                assert!((weights(order, t).iter().sum::<f64>() - 1.0).abs() < 1e-15);
            }
            let (end, start) = (weights(order, 1.0), weights(order, 0.0));
            assert!(end[0] == 0.0 && start[3] == 0.0 && (0..3).all(|k| (end[k + 1] - start[k]).abs() < 1e-15), "order {order}");
        }
    }

    #[test]
    fn timestamps_count_where_they_increase() {
        let at = |times: [f64; 3]| {
            let key = |k: usize| {
                format!(r#"{{"R": [0, 0, 0, 1], "T": [0.5, 0.5, {}], "fov": 60, "timestamp": {}}}"#, 0.5 + 0.33 * k as f64, times[k])
            };
            x(&path(&format!(r#"{{"spline_order": 1, "path": [{}, {}, {}]}}"#, key(0), key(1), key(2))).shots(5))
        };
        // The first segment lasts 1, the second 3.
        assert_eq!(at([1.0, 4.0, 5.0]), [0.0, 1.0, 4.0 / 3.0, 5.0 / 3.0, 2.0].map(|x: f64| (x * 1e6).round() / 1e6));
        assert_eq!(at([0.0, 0.0, 0.0]), [0.0, 0.5, 1.0, 1.5, 2.0]);
    }

    #[test]
    fn rotations_that_cancel_leave_the_nearest_keyframes() {
        let key = |z: f64, w: f64| format!(r#"{{"R": [0, 0, {z}, {w}], "T": [0, 0, 0], "fov": 60}}"#);
        let opposed = path(&format!(r#"{{"path": [{}, {}]}}"#, key(1.0, 0.0), key(-1.0, 0.0)));
        assert!(opposed.shots(9).iter().all(|shot| (shot.camera_to_world.matrix3.determinant() - 1.0).abs() < 1e-9));
    }
}
