use super::colmap::{MODELS, Model};
use super::*;
use glam::{DMat2, dvec3};
use serde::Deserialize;

/// Values of OpenCV and COLMAP, made by reference.py.
const REFERENCE: &str = include_str!("reference.json");

#[derive(Deserialize)]
struct Case {
    source: String,
    model: String,
    parameters: Vec<f64>,
    size: [usize; 2],
    /// x and y of a direction with z = 1, then its image in pixels.
    distorted: Vec<[f64; 4]>,
    /// A point in pixels, then x and y of its direction with z = 1.
    undistorted: Vec<[f64; 4]>,
}

impl Case {
    fn intrinsics(&self) -> Intrinsics {
        let model = Model::named(&self.model).expect("a model of COLMAP");
        Intrinsics::from_colmap(model, self.size.into(), &self.parameters).expect("a lens for the whole image")
    }
}

fn cases() -> Vec<Case> {
    serde_json::from_str(REFERENCE).expect("reference.json")
}

/// Lenses that COLMAP and OpenCV do not have: the fourth radial coefficient of nerfstudio, and fisheyes that see behind the camera.
fn further() -> [Intrinsics; 3] {
    let around = |lens| Intrinsics { lens, ..Intrinsics::centred(640, 480, 190.0) };
    let polynomial = Lens::perspective([-0.2, 0.05, -0.01, 0.002], [0.0; 3], [0.001, -0.002]);
    [
        Intrinsics { lens: polynomial, ..Intrinsics::centred(640, 480, 500.0) },
        around(Lens::fisheye([0.02, -0.003, 0.0005, 0.0], [0.0; 2], [0.0; 2])),
        around(Lens::fisheye([0.02, -0.003, 0.0005, 0.0], [0.001, -0.001], [0.0005, 0.0])),
    ]
}

fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, |a, b| if b.is_nan() { f64::INFINITY } else { a.max(b) })
}

#[test]
fn images_and_directions_are_those_of_opencv_and_colmap() {
    for case in cases() {
        let k = case.intrinsics();
        let project = |[x, y]: [f64; 2]| k.project(dvec3(x, -y, -1.0)).map_or([f64::NAN; 2], |(x, y, _)| [x, y]);
        let far = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        let there = largest(case.distorted.iter().map(|&[x, y, u, v]| far(project([x, y]), [u, v])));
        // The angle between two directions, times the focal length: pixels in the middle of the image.
        let back = largest(case.undistorted.iter().map(|&[u, v, x, y]| {
            let (own, other) = (k.direction(u, v).normalize(), dvec3(x, -y, -1.0).normalize());
            k.fx.max(k.fy) * own.cross(other).length()
        }));
        println!("{:12} {:22} distortion {there:.1e} pixels, undistortion {back:.1e} pixels", case.source, case.model);
        assert!(there < 1e-9 && back < 1e-7, "{} {}: {there:e}, {back:e}", case.source, case.model);
    }
}

#[test]
fn every_pixel_comes_back_from_its_direction() {
    for k in cases().iter().map(Case::intrinsics).chain(further()) {
        assert_eq!(k.check_lens(), Ok(()), "{:?}", k.lens);
        let pixels = (0..k.height).step_by(7).flat_map(|j| (0..k.width).step_by(7).map(move |i| (i as f64 + 0.5, j as f64 + 0.5)));
        let error = largest(pixels.map(|(x, y)| {
            let (u, v, depth) = k.project(2.5 * k.direction(x, y)).unwrap_or((f64::NAN, f64::NAN, f64::NAN));
            (u - x).hypot(v - y).max((depth - 2.5).abs())
        }));
        assert!(error < 1e-10, "{:?}: {error:e}", k.lens);
    }
}

#[test]
fn fisheyes_see_behind_the_camera_and_perspective_lenses_do_not() {
    let [perspective, fisheye, _] = further();
    // The corner is 400/190 = 2.1 focal lengths from the centre; without distortion that is the angle to the axis, 120 degrees.
    assert!(fisheye.direction(0.5, 0.5).z > 0.2);
    assert!(fisheye.project(dvec3(1.0, 0.2, 0.3)).is_some() && perspective.project(dvec3(1.0, 0.2, 0.3)).is_none());
    assert_eq!(fisheye.project(dvec3(0.0, 0.0, -4.0)), Some((320.0, 240.0, 4.0)));
    assert_eq!(fisheye.project(dvec3(0.0, 0.0, 4.0)), None);
}

#[test]
fn the_jacobian_is_that_of_differences() {
    let all = [
        Distortion::of_perspective([0.31, -0.12, 0.023, 0.004], [0.52, -0.07, 0.011], [0.0015, -0.0021]),
        Distortion::of_fisheye([0.032, -0.011, 0.0042, -0.0007], [0.013, -0.017], [0.011, -0.008]),
    ];
    for distortion in all {
        for p in [dvec2(0.0, 0.0), dvec2(0.3, -0.8), dvec2(-0.7, 0.2), dvec2(0.5, 0.6)] {
            const H: f64 = 1e-5;
            let at = |dx, dy| distortion.value_and_jacobian(p + dvec2(dx, dy)).0;
            let by = |dx, dy| (at(dx, dy) - at(-dx, -dy)) / (2.0 * H);
            let (jacobian, differences) = (distortion.value_and_jacobian(p).1, DMat2::from_cols(by(H, 0.0), by(0.0, H)));
            assert!(jacobian.abs_diff_eq(differences, 1e-9), "{p}: {jacobian} {differences}");
        }
    }
}

#[test]
fn beyond_the_fold_there_is_nothing() {
    // x - 0.3 x^3 is largest at x = 1/sqrt(0.9) = 1.0541, with 2/3 of it: 0.7027.
    let lens = Lens::perspective([-0.3, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]);
    let (fold, image) = (0.9_f64.sqrt().recip(), 0.9_f64.sqrt().recip() * 2.0 / 3.0);
    assert!(lens.distort(dvec3(fold - 1e-9, 0.0, 1.0)).is_some() && lens.distort(dvec3(fold + 1e-9, 0.0, 1.0)).is_none());
    assert!(lens.undistort(dvec2(0.0, image + 1e-9)).is_none() && lens.undistort(dvec2(f64::NAN, 0.0)).is_none());
    let near = lens.undistort(dvec2(0.0, -image + 1e-9)).expect("before the fold");
    assert!((near.y + fold).abs() < 1e-4 && (lens.distort(near).expect("its image").y + image - 1e-9).abs() < 1e-15);
    // A polynomial that rises again behind the fold: its outer branch is no lens.
    let twice = Lens::perspective([-0.5, 0.08, 0.0, 0.0], [0.0; 3], [0.0; 2]);
    assert_eq!(twice.distort(dvec3(3.0, 0.0, 1.0)), None);
    assert!(twice.undistort(dvec2(0.3, 0.2)).is_some_and(|d| d.truncate().length() < 0.5));
    // A pole of the rational model.
    let pole = Lens::perspective([0.0; 4], [-1.0, 0.0, 0.0], [0.0; 2]);
    assert!(pole.distort(dvec3(0.99, 0.0, 1.0)).is_some() && pole.distort(dvec3(1.01, 0.0, 1.0)).is_none());
    // The image of the field-of-view model ends at pi / (2 omega).
    let fov = Lens::Fov { omega: 0.9 };
    assert!(fov.undistort(dvec2(1.74, 0.0)).is_some() && fov.undistort(dvec2(1.75, 0.0)).is_none());
}

#[test]
fn an_image_larger_than_the_lens_is_refused_with_the_radius_of_the_fold() {
    let lens = Lens::perspective([-0.3, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]);
    let intrinsics = Intrinsics { lens, ..Intrinsics::centred(1001, 601, 600.0) };
    // The corner pixel is (500, 300) from the centre; the fold is at 0.7027 * 600 pixels.
    let refusal = intrinsics.check_lens().expect_err("the corners are beyond the fold");
    assert_eq!(
        refusal.clone().at(Path::new("cameras.txt"), "camera 3").to_string(),
        "cameras.txt: camera 3: the lens folds over at 421.6 pixels from the principal point, and the image has pixels up to 583.1 pixels \
         away; undistort or crop the images, or correct the distortion parameters or the image size"
    );
    assert_eq!(Intrinsics { lens, ..Intrinsics::centred(601, 401, 600.0) }.check_lens(), Ok(()));
    assert_eq!(intrinsics.downscaled(2).check_lens().is_err(), intrinsics.check_lens().is_err());
}

#[test]
fn what_colmap_and_transforms_cannot_mean_is_refused() {
    let model = |name| Model::named(name).expect("a model");
    let refused = |name, parameters: &[f64]| Intrinsics::from_colmap(model(name), (64, 48), parameters).expect_err(name).found;
    assert_eq!(refused("DIVISION", &[60.0, 60.0, 32.0, 24.0, 0.1]), "the camera model DIVISION is not supported");
    assert_eq!(refused("EQUIRECTANGULAR", &[64.0, 48.0]), "the camera model EQUIRECTANGULAR is not supported");
    assert_eq!(refused("RADIAL", &[60.0, 32.0, 24.0, 0.1]), "the camera has 4 parameters");
    assert_eq!(refused("RADIAL", &[60.0, 32.0, 24.0, 0.1, f64::NAN]), "parameter 5 of the model RADIAL is NaN");
    assert_eq!(refused("PINHOLE", &[60.0, 0.0, 32.0, 24.0]), "the focal length is 0");
    assert_eq!(refused("FOV", &[60.0, 60.0, 32.0, 24.0, 4.0]), "omega of the model FOV is 4");
    for model in MODELS {
        assert_eq!((Model::with_id(model.id), Model::named(model.name)), (Some(model), Some(model)));
        assert!(Lens::from_colmap(model, &vec![f64::INFINITY; model.parameters]).is_err());
        assert!(Lens::from_colmap(model, &[]).is_err());
    }
    assert_eq!((Model::with_id(18), Model::named("opencv")), (None, None));
    let zeros = ([0.0; 4], [0.0; 2]);
    assert_eq!(Lens::from_transforms("OPENCV", zeros.0, zeros.1), Ok(Lens::Pinhole));
    assert_eq!(Lens::from_transforms("OPENCV_FISHEYE", zeros.0, zeros.1), Ok(Lens::fisheye([0.0; 4], [0.0; 2], [0.0; 2])));
    assert!(Lens::from_transforms("EQUIRECTANGULAR", zeros.0, zeros.1).is_err_and(|e| e.found.contains("\"EQUIRECTANGULAR\"")));
    assert!(Lens::from_transforms("OPENCV", [0.0, f64::NAN, 0.0, 0.0], zeros.1).is_err_and(|e| e.found == "k2 is NaN"));
}
