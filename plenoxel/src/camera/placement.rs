//! Plausibility checks of camera poses before training.

use super::Camera;
use crate::geometry::Aabb;
use glam::{DMat3, DVec3};

/// Number of tested rays of a view along each axis.
const TRIED: usize = 16;

/// Problems found in the cameras of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Placement {
    /// Reason why training is impossible, and the likely remedy: no ray of any camera hits the box.
    pub hopeless: Option<[String; 2]>,
    /// Reasons why training may fail, each with its likely cause.
    pub warnings: Vec<String>,
}

impl Placement {
    /// Checks the cameras of a scene inside a box.
    pub fn of(cameras: &[Camera], aabb: Aabb) -> Self {
        let mut found = Placement::default();
        if cameras.is_empty() {
            return found;
        }
        let hits = cameras.iter().filter(|camera| meets(camera, aabb)).count();
        let (center, extent) = (0.5 * (aabb.min + aabb.max), 0.5 * (aabb.max - aabb.min).max_element());
        let focus = focus(cameras);
        let seen = focus.map_or(String::new(), |focus| format!("; they look at about {}", point(focus)));
        let outside = focus.is_some_and(|focus| (focus - center).abs().max_element() > extent);
        let remedy = if outside {
            "move the scene so that its object is around the origin, or set a --half-width that reaches it"
        } else {
            "check the poses: camera to world, with x right, y up and z backwards (OpenGL)"
        };
        if hits == 0 {
            let boxed = format!("the box from {} to {}", point(aabb.min), point(aabb.max));
            let reason = format!("no ray of the {} training views hits {boxed}{seen}", cameras.len());
            found.hopeless = Some([reason, remedy.to_owned()]);
            return found;
        }
        if 2 * hits < cameras.len() {
            found.warnings.push(format!(
                "{} of {} training views do not show the box{seen}; {remedy}",
                cameras.len() - hits,
                cameras.len()
            ));
        } else if outside {
            found.warnings.push(format!("the cameras look past the box{seen}; {remedy}"));
        }
        let positions = || cameras.iter().map(Camera::position);
        let mean = positions().sum::<DVec3>() / cameras.len() as f64;
        let spread = positions().map(|p| p.distance(mean)).fold(0.0, f64::max);
        let distance = mean.distance(center).max(extent);
        if cameras.len() > 1 && spread < 1e-3 * distance {
            found.warnings.push(format!(
                "all {} cameras are at one point, {}: no depth can be learned; check the translations of the poses",
                cameras.len(),
                point(mean)
            ));
        }
        let inside = positions().filter(|p| (*p - center).abs().max_element() < extent).count();
        if 2 * inside > cameras.len() {
            found.warnings.push(format!(
                "{inside} of {} cameras are inside of the box, and may photograph objects outside of it; use a smaller --half-width, or \
                 poses of another scale, so that the cameras are around the box",
                cameras.len()
            ));
        }
        found
    }
}

/// Returns true if a camera sees the centre of a box, or if one of the tested rays hits the box.
fn meets(camera: &Camera, aabb: Aabb) -> bool {
    let at = |k: usize, n: usize| (k as f64 + 0.5) * n as f64 / TRIED as f64;
    let k = &camera.intrinsics;
    let within = |x: f64, n: usize| (0.0..=n as f64).contains(&x);
    if camera.project(0.5 * (aabb.min + aabb.max)).is_some_and(|(x, y, _)| within(x, k.width) && within(y, k.height)) {
        return true;
    }
    (0..TRIED * TRIED).any(|i| {
        let ray = camera.ray(at(i % TRIED, k.width), at(i / TRIED, k.height));
        aabb.intersect(ray.origin, ray.direction).is_some_and(|(enter, leave)| leave > enter.max(0.0))
    })
}

/// Returns the point nearest to the optical axes of cameras, by least squares; `None` if the axes are nearly parallel.
fn focus(cameras: &[Camera]) -> Option<DVec3> {
    let (mut sum, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let k = &camera.intrinsics;
        let ray = camera.ray(0.5 * k.width as f64, 0.5 * k.height as f64);
        let d = ray.direction;
        // I - d dᵀ removes the component along the axis.
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        sum += across;
        right += across * ray.origin;
    }
    let mean = sum * (1.0 / cameras.len() as f64);
    // The determinant is 0 for parallel axes.
    (mean.determinant() > 1e-4).then(|| sum.inverse() * right)
}

fn point(p: DVec3) -> String {
    // Adding 0 turns negative zero into positive zero.
    let [x, y, z] = p.to_array().map(|c| (100.0 * c).round() / 100.0 + 0.0);
    format!("({x:.2}, {y:.2}, {z:.2})")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::{DAffine3, dvec3};

    fn around(center: DVec3, distance: f64, backwards: bool) -> Vec<Camera> {
        let cameras = (0..12).map(|k| {
            let angle = f64::from(k) * 0.5;
            let from = center + distance * dvec3(angle.cos(), angle.sin(), 0.4).normalize();
            let away = if backwards { center - from } else { from - center };
            let z = away.normalize();
            let x = DVec3::Z.cross(z).normalize();
            let pose = DAffine3 { matrix3: DMat3::from_cols(x, z.cross(x), z), translation: from };
            Camera { intrinsics: Intrinsics::from_fov_x(40, 30, 0.6), camera_to_world: pose }
        });
        cameras.collect()
    }

    #[test]
    fn cameras_around_the_box_are_fine_and_each_mistake_is_named() {
        let aabb = Aabb::cube(1.0);
        assert_eq!(Placement::of(&around(DVec3::ZERO, 4.0, false), aabb), Placement::default());
        let away = Placement::of(&around(DVec3::ZERO, 4.0, true), aabb).hopeless.expect("nothing is seen");
        assert!(away[0].contains("no ray of the 12 training views") && away[1].contains("OpenGL"), "{away:?}");
        let far = Placement::of(&around(dvec3(20.0, 0.0, 0.0), 4.0, false), aabb);
        let far = far.hopeless.map(|found| found.join("; ")).or(far.warnings.first().cloned()).expect("something is wrong");
        assert!(far.contains("(20.00, 0.00, 0.00)") && far.contains("--half-width"), "{far}");
        let one = vec![around(DVec3::ZERO, 4.0, false)[0]; 5];
        assert!(Placement::of(&one, aabb).warnings[0].contains("one point"));
        let inside = Placement::of(&around(DVec3::ZERO, 0.5, false), aabb).warnings;
        assert!(inside.len() == 1 && inside[0].contains("inside of the box"), "{inside:?}");
        assert_eq!(Placement::of(&[], aabb), Placement::default());
    }
}
