use super::*;
use crate::camera::Intrinsics;
use crate::dataset::image::RgbaImage;
use autograd::{gradcheck, random::Stream};
use glam::{DAffine3, DQuat};

fn numbers(name: &str, shape: &[usize], size: f64) -> Tensor<f64> {
    Stream::new(7).named(name).uniform_tensor(shape, -size, size)
}

fn views(count: usize) -> Vec<View> {
    let eyes = numbers("eyes", &[count, 3], 3.0);
    let view = |(v, eye): (usize, &[f64])| View {
        name: v.to_string(),
        camera: Camera::look_at(DVec3::from_slice(eye), DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(4, 4, 0.7)),
        image: RgbaImage::new(4, 4),
        depth: None,
        mask: None,
    };
    eyes.data().chunks(3).enumerate().map(view).collect()
}

fn batch(views: &[View]) -> RayBatch<f64> {
    crate::rays::RaySource::new(views, [0.0; 3], 3).batch(0, 24)
}

#[test]
fn rays_of_a_batch_are_those_of_the_corrected_cameras() {
    let views = views(5);
    let (poses, learned) = (PoseCorrections::of(&views), numbers("learned", &[5, 6], 0.3));
    let batch = batch(&views);
    let (tracked, cameras) = (poses.rays(&learned, &batch), poses.cameras(&learned, &views));
    for ((ray, &v), &[x, y]) in tracked.rays.iter().zip(&batch.view).zip(&batch.pixel) {
        let expected = cameras[v as usize].ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
        assert!(ray.origin.abs_diff_eq(expected.origin, 1e-12) && ray.direction.abs_diff_eq(expected.direction, 1e-12));
    }
    let figures = poses.figures(&learned, &views);
    for ((corrected, view), figures) in cameras.iter().zip(&views).zip(&figures.views) {
        let [a, b] = [corrected, &view.camera].map(|camera| DQuat::from_mat3(&camera.camera_to_world.matrix3));
        assert!((a.angle_between(b).to_degrees() - figures.degrees).abs() < 1e-6);
        assert!((corrected.position().distance(view.camera.position()) - figures.translation).abs() < 1e-12);
    }
}

#[test]
fn without_corrections_rays_do_not_move() {
    let views = views(3);
    let (poses, batch) = (PoseCorrections::of(&views), batch(&views));
    assert_eq!(poses.rays(&Tensor::zeros(&[3, 6]), &batch).rays, batch.rays);
    assert_eq!(poses.figures(&Tensor::zeros(&[3, 6]), &views).mean_degrees, 0.0);
}

#[test]
fn a_common_motion_of_all_cameras_is_no_correction() {
    let views = views(6);
    let poses = PoseCorrections::<f64>::of(&views);
    let (turn, shift, growth) = (DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.5, 0.1, -0.4), 0.2);
    let motion = views.iter().flat_map(|view| {
        let position = view.camera.position();
        let translation = (turn.cross(position) + shift + growth * position) / poses.spread;
        [turn, translation].map(|v| v.to_array())
    });
    let motion = Tensor::from_vec(motion.flatten().collect(), &[6, 6]);
    assert!(poses.corrections(&motion).data().iter().all(|x| x.abs() < 1e-12));
    // What is left of any numbers has no such component: removing it again changes nothing.
    let once = poses.corrections(&numbers("any", &[6, 6], 1.0));
    let twice = poses.corrections(&once);
    assert!(once.data().iter().zip(twice.data()).all(|(a, b)| (a - b).abs() < 1e-12));
    assert!(once.data().iter().any(|x| x.abs() > 0.1));
}

#[test]
fn cameras_at_one_place_or_a_single_camera_have_corrections() {
    let one = views(1);
    let figures = PoseCorrections::<f64>::of(&one).figures(&numbers("one", &[1, 6], 0.1), &one);
    // All motions of a single camera are common motions.
    assert!(figures.mean_degrees < 1e-9 && figures.mean_translation < 1e-9);
    let mut together = views(4);
    together.iter_mut().for_each(|view| view.camera.camera_to_world = DAffine3::from_mat3(view.camera.camera_to_world.matrix3));
    let figures = PoseCorrections::<f64>::of(&together).figures(&numbers("together", &[4, 6], 0.1), &together);
    assert!(figures.mean_degrees > 1.0 && figures.mean_translation.is_finite());
}

#[test]
fn rays_have_the_derivatives_of_the_corrections() {
    let views = views(3);
    let (poses, batch) = (PoseCorrections::of(&views), batch(&views));
    for part in [|rays: TrackedRays<f64>| rays.origins, |rays: TrackedRays<f64>| rays.directions] {
        gradcheck(|x| part(poses.rays(&x[0], &batch)), [numbers("learned", &[3, 6], 0.4).to_array()]);
    }
}
