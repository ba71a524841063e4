//! Tests of valid and invalid camera paths, and of arbitrary bytes.

use super::*;
use crate::random::{Purpose, uniform};
use serde_json::json;

fn parse(value: &Value) -> Result<CameraPath> {
    CameraPath::parse(Path::new("path.json"), value.to_string().as_bytes())
}

#[track_caller]
fn refused(value: &Value, parts: &[&str]) {
    let error = parse(value).unwrap_err();
    let text = error.to_string();
    assert!(error.exit_code() == 3 && text.starts_with("path.json: "), "{text}");
    assert!(parts.iter().all(|part| text.contains(part)), "{parts:?} in {text}");
}

/// Returns a camera at height z above the origin that looks down, as a matrix row by row.
fn rows(z: f64) -> [[f64; 4]; 4] {
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]]
}

fn nerfstudio() -> Value {
    let frame = |z: f64| json!({"camera_to_world": rows(z).as_flattened(), "fov": 60.0, "aspect": 2.0});
    json!({"camera_type": "perspective", "render_height": 50, "render_width": 100.0, "fps": 24, "seconds": 2, "keyframes": [],
        "camera_path": [frame(2.0), frame(3.0), frame(5.0)]})
}

fn transforms() -> Value {
    let frame = |z: f64| json!({"file_path": "no such image", "transform_matrix": rows(z)});
    json!({"camera_angle_x": 0.8, "frames": [frame(2.0), frame(3.0), frame(5.0)]})
}

fn instant_ngp() -> Value {
    let key = |z: f64| json!({"R": [1, 0, 0, 0], "T": [0.5, 0.5, z], "slice": 0, "scale": 1.5, "fov": 50.6, "aperture_size": 0});
    json!({"loop": true, "time": 0.5, "path": [key(2.0), key(3.0)]})
}

fn heights(path: &CameraPath, frames: usize) -> Vec<f64> {
    path.shots(frames).iter().map(|shot| shot.camera_to_world.translation.z).collect()
}

#[test]
fn frames_of_nerfstudio_are_taken_as_they_are() {
    let path = parse(&nerfstudio()).unwrap();
    assert_eq!((path.format, path.size, path.fps, path.entries()), (Format::Nerfstudio, Some((100, 50)), Some(24.0), 3));
    assert!(!path.is_interpolated() && path.format.to_string().contains("nerfstudio"));
    assert_eq!(heights(&path, 3), [2.0, 3.0, 5.0]);
    let camera = path.shots(3)[0].camera((100, 50));
    assert!((camera.intrinsics.fy - 25.0 / 30.0_f64.to_radians().tan()).abs() < 1e-12 && camera.intrinsics.fx == camera.intrinsics.fy);
    assert_eq!(camera.ray(50.0, 25.0).direction, DVec3::NEG_Z);
}

#[test]
fn fewer_frames_are_chosen_and_more_are_found_between() {
    let path = parse(&nerfstudio()).unwrap();
    assert_eq!(heights(&path, 2), [2.0, 5.0]);
    assert_eq!(heights(&path, 1), [2.0]);
    assert_eq!(heights(&path, 5), [2.0, 2.5, 3.0, 4.0, 5.0]);
    assert_eq!(path.shots(0).len(), 1);
    // From looking down to looking along x; in the middle, half of a right angle.
    let mut turned = nerfstudio();
    turned["camera_path"][1]["camera_to_world"] = json!([0, 0, -1, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1]);
    turned["camera_path"].as_array_mut().unwrap().pop();
    let between = parse(&turned).unwrap().shots(3)[1].camera((10, 10));
    let [from, to] = [0, 2].map(|k| parse(&turned).unwrap().shots(3)[k].camera((10, 10)).ray(5.0, 5.0).direction);
    let middle = between.ray(5.0, 5.0).direction;
    assert!((middle.angle_between(from) - middle.angle_between(to)).abs() < 1e-6, "{middle}");
}

#[test]
fn angles_of_view_of_a_transforms_file_are_found_wherever_they_are() {
    let path = parse(&transforms()).unwrap();
    assert_eq!((path.format, path.size, path.entries()), (Format::Transforms, None, 3));
    assert_eq!(path.shots(3)[2].fov, Fov::Horizontal(0.8));
    let with = |edit: &dyn Fn(&mut Value)| {
        let mut value = transforms();
        value.as_object_mut().unwrap().remove("camera_angle_x");
        edit(&mut value);
        parse(&value).unwrap().shots(3)[0].camera((200, 100)).intrinsics.fx
    };
    let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} against {b}");
    near(with(&|v| v["x_fov"] = json!(90)), 100.0);
    near(with(&|v| v["camera_angle_y"] = json!(std::f64::consts::FRAC_PI_2)), 50.0);
    near(with(&|v| [("fl_x", 250.0), ("w", 400.0), ("h", 200.0)].into_iter().for_each(|(key, n)| v[key] = json!(n))), 125.0);
    near(with(&|v| [("fl_y", 250.0), ("w", 400.0), ("h", 200.0)].into_iter().for_each(|(key, n)| v[key] = json!(n))), 125.0);
    // Keys of a frame have priority.
    let own = with(&|v| {
        v["camera_angle_x"] = json!(0.3);
        v["frames"][0]["fl_x"] = json!(50);
        v["w"] = json!(100);
        v["h"] = json!(100);
    });
    near(own, 100.0);
}

#[test]
fn each_kind_of_damage_is_named_with_its_frame_and_field() {
    let edit = |value: Value, f: &dyn Fn(&mut Value)| {
        let mut value = value;
        f(&mut value);
        value
    };
    refused(&json!({"cameras": []}), &["none of the keys", "`path` (instant-ngp)", "`frames`"]);
    refused(&json!([1, 2]), &["none of the keys"]);
    for (value, key) in [(nerfstudio(), "camera_path"), (transforms(), "frames"), (instant_ngp(), "path")] {
        refused(&edit(value.clone(), &|v| v[key] = json!([])), &[key, "has 0 entries", "1 to 100000"]);
        refused(&edit(value.clone(), &|v| v[key] = json!(7)), &[key, "is 7", "a list"]);
        refused(&edit(value.clone(), &|v| v[key] = json!(vec![0; MOST_FRAMES + 1])), &["has more than 100000 entries", "split it"]);
        refused(&edit(value, &|v| v[key][1] = json!(null)), &["there is no", "1"]);
    }

    let broken = |f: &dyn Fn(&mut Value), parts: &[&str]| refused(&edit(nerfstudio(), f), parts);
    broken(&|v| v["camera_type"] = json!("equirectangular"), &["`camera_type` is \"equirectangular\"", "perspective"]);
    broken(&|v| v["render_width"] = json!(0), &["`render_width` is 0", "1 to 16384"]);
    broken(&|v| v["render_height"] = json!("tall"), &["`render_height` is \"tall\""]);
    broken(&|v| v["fps"] = json!(-1), &["`fps` is -1"]);
    broken(&|v| v["camera_path"][2]["fov"] = json!(180), &["`fov` of frame 2 is 180", "above 0 and below 180"]);
    broken(&|v| v["camera_path"][2] = json!({"camera_to_world": rows(1.0).as_flattened()}), &["there is no `fov` of frame 2"]);
    broken(&|v| v["camera_path"][1]["camera_to_world"][3] = json!(null), &["`camera_to_world` of frame 1 is [1.0", "16 finite numbers"]);
    broken(&|v| v["camera_path"][1]["camera_to_world"][3] = json!(1e300), &["`camera_to_world` of frame 1", "a million units"]);
    broken(&|v| v["camera_path"][1]["camera_to_world"][0] = json!(2), &["`camera_to_world` of frame 1 is not a rotation"]);
    broken(&|v| v["camera_path"][1]["camera_to_world"] = json!(vec![0; 5000]), &["is a list of 5000"]);

    let broken = |f: &dyn Fn(&mut Value), parts: &[&str]| refused(&edit(transforms(), f), parts);
    broken(&|v| v["camera_angle_x"] = json!(3.2), &["`camera_angle_x` is 3.2", "below pi"]);
    broken(&|v| drop(v.as_object_mut().unwrap().remove("camera_angle_x")), &["no `camera_angle_x` of frame 0", "angle of view"]);
    broken(&|v| v["frames"][2]["transform_matrix"][1] = json!([1, 2]), &["`transform_matrix` of frame 2", "2 numbers in row 1"]);
    let sized = |v: &mut Value| [("w", 40), ("h", 20)].into_iter().for_each(|(key, n)| v["frames"][2][key] = json!(n));
    broken(&|v| (sized(v), v["frames"][2]["fl_x"] = json!(0)).1, &["`fl_x` of frame 2 is 0", "pixels"]);

    let broken = |f: &dyn Fn(&mut Value), parts: &[&str]| refused(&edit(instant_ngp(), f), parts);
    broken(&|v| v["path"][1]["R"] = json!([0, 0, 0, 0]), &["`R` of keyframe 1 is [0,0,0,0]", "not all of them 0"]);
    broken(&|v| v["path"][1]["R"] = json!([1, 0, 0]), &["`R` of keyframe 1", "4 finite numbers"]);
    broken(&|v| v["path"][0]["T"] = json!([1e300, 0, 0]), &["`T` of keyframe 0", "a million units"]);
    broken(&|v| v["path"][0]["T"] = json!(["x", 0, 0]), &["`T` of keyframe 0", "3 finite numbers"]);
    broken(&|v| v["path"][0]["fov"] = json!(0), &["`fov` of keyframe 0 is 0"]);
    broken(&|v| v["path"][0]["timestamp"] = json!("late"), &["`timestamp` of keyframe 0"]);
    broken(&|v| v["loop"] = json!(1), &["`loop` is 1", "true or false"]);
    broken(&|v| v["spline_order"] = json!(4), &["`spline_order` is 4"]);

    let bytes = |bytes: &[u8]| CameraPath::parse(Path::new("path.json"), bytes).unwrap_err().to_string();
    assert!(bytes(b"{\"path\": [").contains("ends early, at line 1"));
    assert!(bytes(b"{\"path\": [1e999]}").contains("not valid JSON"));
    assert!(bytes(&[0xff, 0xfe]).contains("ends early"));
}

#[test]
fn damaged_bytes_are_read_or_refused_and_what_is_read_is_finite() {
    // Seed 1: each file is damaged 300 times. Some bytes are replaced, mostly by digits, so that the file often stays valid JSON.
    let seed = 1;
    for (which, value) in [nerfstudio(), transforms(), instant_ngp()].iter().enumerate() {
        let text = value.to_string().into_bytes();
        for round in 0..300 {
            let draw = |k: u64| uniform(seed, Purpose::Initial, (1000 * which + round) as u64, k);
            let mut bytes = text.clone();
            for k in 0..3 {
                let at = (draw(3 * k) * bytes.len() as f64) as usize;
                bytes[at] = if draw(3 * k + 1) < 0.8 {
                    b"0123456789.e-"[(draw(3 * k + 2) * 13.0) as usize]
                } else {
                    (draw(3 * k + 2) * 256.0) as u8
                };
            }
            let Ok(path) = CameraPath::parse(Path::new("path.json"), &bytes) else { continue };
            for frames in [1, 2, 7] {
                let shots = path.shots(frames);
                assert_eq!(shots.len(), frames);
                for camera in shots.iter().map(|shot| shot.camera((32, 16))) {
                    assert!(camera.camera_to_world.is_finite() && camera.intrinsics.fx > 0.0, "round {round}: {camera:?}");
                    assert!((camera.camera_to_world.matrix3.determinant() - 1.0).abs() < 0.01, "round {round}: {camera:?}");
                }
            }
        }
    }
}

#[test]
fn a_path_along_cameras_begins_and_ends_near_the_first_and_last_and_stays_among_them() {
    let intrinsics = Intrinsics::from_fov_x(40, 30, 0.9);
    let around = |k: u32| {
        let angle = f64::from(k) * 0.02;
        Camera::look_at(DVec3::new(2.0 * angle.cos(), 2.0 * angle.sin(), 0.3), DVec3::ZERO, DVec3::Z, intrinsics)
    };
    let cameras: Vec<Camera> = (0..100).map(around).collect();
    let shots = along_cameras(&cameras, 50);
    assert_eq!(shots.len(), 50);
    let camera = |i: usize| shots[i].camera((40, 30));
    assert!(
        (camera(0).position() - cameras[0].position()).length() < 0.2 && (camera(49).position() - cameras[99].position()).length() < 0.3
    );
    for i in 0..50 {
        assert!((camera(i).position().truncate().length() - 2.0).abs() < 0.02 && (camera(i).position().z - 0.3).abs() < 1e-9);
        assert!((camera(i).intrinsics.fx - intrinsics.fx).abs() < 1e-9);
        let (x, y, _) = camera(i).project(DVec3::ZERO).expect("the origin is in front");
        assert!((x - 20.0).abs() < 0.5 && (y - 15.0).abs() < 0.5, "frame {i} looks elsewhere: {x} {y}");
    }
    assert!(along_cameras(&[], 10).is_empty() && along_cameras(&cameras[..1], 3).len() == 3);
}
