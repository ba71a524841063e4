//! `plenoxel render` along paths and to all file formats: what a user types, and what other programs find in the files.

use crate::command::{Folder, plenoxel};
use exr::prelude::{ReadChannels, ReadLayers, read};
use plenoxel::dataset::image;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// A short run of the built-in scene with views of 24 x 16 pixels, written to files in `scene` so that they can go away.
fn train(folder: &Folder) -> (String, String) {
    let (data, run) = (folder.path("scene"), folder.path("run"));
    plenoxel(&["scene", &data, "--width", "24", "--height", "16", "--train", "6", "--val", "0", "--test", "2"]).done();
    let stages = "stages=[{resolution=16, steps=30, sampling={step=1.0}, density_rate=2.0, color_rate=0.05}]";
    plenoxel(&["train", &data, "--set", stages, "--set", "rays_per_step=256", "--no-images", "--quiet", "--out", &run]).done();
    (data, run)
}

fn names(folder: &str) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// The shape and the numbers of a NumPy file.
fn npy(path: &str) -> (String, Vec<f32>) {
    let bytes = fs::read(path).unwrap();
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = String::from_utf8_lossy(&bytes[10..start]);
    let shape = header.split("'shape': ").nth(1).unwrap().split(", }").next().unwrap().to_owned();
    (shape, bytes[start..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
}

/// The channels of an EXR file and their numbers.
fn exr(path: &str) -> Vec<(String, Vec<f32>)> {
    let image =
        read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer().all_attributes().from_file(path).unwrap();
    let channels = image.layer_data.channel_data.list;
    channels.into_iter().map(|channel| (channel.name.to_string(), channel.sample_data.values_as_f32().collect())).collect()
}

#[test]
fn a_path_becomes_frames_in_every_format_and_a_film() {
    let folder = Folder::new("films");
    let (data, run) = train(&folder);
    let orbit = ["render", &run, "--path", "orbit", "--frames", "3", "--channels", "color,depth,normal,opacity", "--format", "png,exr,npy"];
    let answer = plenoxel(&orbit);
    assert!(
        answer.code == 0 && answer.out.contains("rendered 3 frames") && answer.out.contains("orbit.gif"),
        "{} {}",
        answer.out,
        answer.err
    );
    let renders = format!("{run}/renders");
    let frames = names(&format!("{renders}/orbit"));
    assert_eq!(frames.len(), 3 * 4 * 3);
    assert_eq!(
        frames[..6],
        ["frame_0000.exr", "frame_0000.npy", "frame_0000.png", "frame_0000_depth.exr", "frame_0000_depth.npy", "frame_0000_depth.png"]
    );
    // As large as the views.
    let frame = |name: &str| format!("{renders}/orbit/frame_0001{name}");
    assert_eq!(image::size(Path::new(&frame(".png"))).unwrap(), (24, 16));

    // The formats tell the same, and what is told is true.
    let [(shape, color), (flat, depth), (_, normal), (_, opacity)] =
        [".npy", "_depth.npy", "_normal.npy", "_opacity.npy"].map(|name| npy(&frame(name)));
    assert_eq!((shape.as_str(), flat.as_str(), color.len(), depth.len()), ("(16, 24, 3)", "(16, 24)", 3 * 384, 384));
    let png = image::read(Path::new(&frame(".png"))).unwrap();
    for (pixel, color) in png.pixels().zip(color.as_chunks::<3>().0) {
        assert!((0..3).all(|c| (f32::from(pixel.0[c]) - 255.0 * color[c].clamp(0.0, 1.0)).abs() <= 0.501));
    }
    let seen: Vec<bool> = opacity.iter().map(|o| *o > 0.0).collect();
    assert!(seen.contains(&true) && seen.contains(&false));
    for (i, seen) in seen.iter().enumerate() {
        let n = &normal[3 * i..3 * i + 3];
        let length = n.iter().map(|x| x * x).sum::<f32>();
        // Cameras stand 4 away from the middle of a box of ±1.5 at most, whose corners are 2.6 away from it.
        assert!(if *seen { (1.0..7.0).contains(&depth[i]) } else { depth[i].is_nan() && length == 0.0 }, "{i}: {} {length}", depth[i]);
        assert!(length == 0.0 || (length - 1.0).abs() < 1e-5);
    }
    let same = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan());
    let single = exr(&frame("_depth.exr"));
    assert!(single.len() == 1 && single[0].0 == "Y" && same(&single[0].1, &depth));
    let normals = exr(&frame("_normal.exr"));
    assert_eq!(normals.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["B", "G", "R"]);
    assert!(same(&normals[2].1, &normal.iter().step_by(3).copied().collect::<Vec<_>>()));
    let light = exr(&frame(".exr"));
    let red = color.iter().step_by(3).map(|&c| if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) });
    assert!(red.zip(&light[2].1).all(|(expected, found)| (expected - found).abs() < 1e-5));

    // The film shows the frames again and again, each for 1/30 s.
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut film = options.read_info(fs::File::open(format!("{renders}/orbit.gif")).unwrap()).unwrap();
    assert_eq!((film.width(), film.height()), (24, 16));
    let mut delays = Vec::new();
    while let Some(shown) = film.read_next_frame().unwrap() {
        if delays.len() == 1 {
            let error: f64 = shown.buffer.iter().zip(png.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum::<f64>()
                / png.as_raw().len() as f64;
            assert!(error < 3.0, "{error} of 255");
        }
        delays.push(shown.delay);
    }
    assert_eq!((delays, film.repeat()), (vec![3, 4, 3], gif::Repeat::Infinite));
    assert!(["orbit_depth.gif", "orbit_normal.gif", "orbit_opacity.gif"].iter().all(|name| Path::new(&renders).join(name).exists()));

    // Without its views a run is still turned around, and an earlier film of the name is gone.
    fs::remove_dir_all(&data).unwrap();
    let answer = plenoxel(&["render", &run, "--path", "orbit", "--frames", "2", "--size", "9x8"]);
    assert!(answer.code == 0 && answer.err.contains("computed from the box"), "{}", answer.err);
    assert_eq!(names(&format!("{renders}/orbit")), ["frame_0000.png", "frame_0001.png"]);
    assert!(names(&renders).iter().all(|name| ["orbit", "orbit.gif", "orbit.mp4"].contains(&name.as_str())), "{:?}", names(&renders));
    assert_eq!(image::size(Path::new(&format!("{renders}/orbit/frame_0001.png"))).unwrap(), (9, 8));
    plenoxel(&["render", &run, "--path", "spiral", "--data", &data]).refused(3, &["no longer exists"]);
    plenoxel(&["render", &run]).refused(3, &["--data"]);
}

#[test]
fn cameras_of_other_programs_are_recognised_and_damaged_ones_refused() {
    let folder = Folder::new("camera-files");
    let (data, run) = train(&folder);
    let write = |name: &str, value: &Value| {
        let path = folder.path(name);
        fs::write(&path, value.to_string()).unwrap();
        path
    };
    let rendered = |path: &str, more: &[&str], parts: &[&str]| {
        let answer = plenoxel(&[&["render", &run, "--path", path], more].concat());
        assert_eq!(answer.code, 0, "{}", answer.err);
        assert!(parts.iter().all(|part| answer.err.contains(part)), "{parts:?} in {}", answer.err);
    };
    let frame = |path: &str| image::size(Path::new(&format!("{run}/renders/{path}"))).unwrap();

    // A test view of the dataset along the dataset's own file: the same picture.
    plenoxel(&["render", &run, "--view", "1", "--quiet"]).done();
    rendered(&format!("{data}/transforms_test.json"), &[], &["cameras of a transforms.json of 2 frames", "frames: 2 of 24 x 16"]);
    let [view, shot] =
        ["test_001_r_1.png", "transforms_test/frame_0001.png"].map(|name| fs::read(format!("{run}/renders/{name}")).unwrap());
    assert!(view == shot, "the camera of a view is the camera of its frame");

    // The camera of frame 1 in nerfstudio's form and in instant-ngp's: again the same.
    let transforms: Value = serde_json::from_str(&fs::read_to_string(format!("{data}/transforms_test.json")).unwrap()).unwrap();
    let matrix = &transforms["frames"][1]["transform_matrix"];
    let number = |row: usize, column: usize| matrix[row][column].as_f64().unwrap();
    let fov = 2.0 * (16.0 / 24.0 * (transforms["camera_angle_x"].as_f64().unwrap() / 2.0).tan()).atan().to_degrees();
    let rows: Vec<f64> = (0..16).map(|k| number(k / 4, k % 4)).collect();
    let camera = json!({"camera_to_world": rows, "fov": fov, "aspect": 1.5});
    let path = write("studio.json", &json!({"render_width": 24, "render_height": 16, "fps": 12, "camera_path": [camera]}));
    rendered(&path, &[], &["a nerfstudio camera path of 1 frame", "frames: 1 of 24 x 16"]);
    let studio = fs::read(format!("{run}/renders/studio/frame_0000.png")).unwrap();
    assert!(studio == view, "nerfstudio");
    // Rows y, z, x of the matrix, its second and third column negated, and 0.33 p + 0.5.
    let turned =
        |column: usize| glam::DVec3::from([1, 2, 0].map(|row| if column == 0 { number(row, column) } else { -number(row, column) }));
    let rotation = glam::DQuat::from_mat3(&glam::DMat3::from_cols(turned(0), turned(1), turned(2)));
    let position = [1, 2, 0].map(|row| 0.33 * number(row, 3) + 0.5);
    let key = json!({"R": rotation.to_array(), "T": position, "slice": 0, "scale": 1, "fov": fov, "aperture_size": 0, "timestamp": 0});
    let path = write("base_cam.json", &json!({"loop": false, "path": [key, key], "time": 0}));
    rendered(&path, &["--frames", "2"], &["an instant-ngp camera path of 2 keyframes", "frames: 2"]);
    let ngp = image::read(Path::new(&format!("{run}/renders/base_cam/frame_0001.png"))).unwrap();
    let target = image::read(Path::new(&format!("{run}/renders/test_001_r_1.png"))).unwrap();
    assert!(ngp.as_raw().iter().zip(target.as_raw()).all(|(a, b)| a.abs_diff(*b) <= 1), "instant-ngp");
    rendered(&path, &["--frames", "1", "--size", "10"], &["frames: 1 of 10 x 10"]);
    assert_eq!(frame("base_cam/frame_0000.png"), (10, 10));

    let refused = |path: &str, code: u8, parts: &[&str]| plenoxel(&["render", &run, "--path", path]).refused(code, parts);
    refused("orbti", 2, &["--path", "orbti", "does not exist", "orbit, spiral"]);
    refused(&data, 3, &["scene", "this is a folder", "expected a JSON file of cameras"]);
    refused(&write("empty.json", &json!({})), 3, &["empty.json", "none of the keys"]);
    refused(
        &write("broken.json", &json!({"path": [{"R": [0, 0, 0, 0], "T": [0, 0, 0], "fov": 9}]})),
        3,
        &["broken.json", "`R` of keyframe 0"],
    );
    for (flag, value, accepted) in [
        ("--frames", "0", "1 to 100000"),
        ("--frames", "100001", "1 to 100000"),
        ("--size", "99999", "at most 16384"),
        ("--size", "0", "320x240"),
        ("--fps", "0", "0.1 to 1000"),
        ("--channels", "heat", "normal"),
        ("--format", "gif", "npy"),
        ("--view", "0", "--path"),
    ] {
        plenoxel(&["render", &run, "--path", "orbit", flag, value]).refused(2, &[flag, accepted]);
    }
    plenoxel(&["render", &run, "--frames", "3"]).refused(2, &["--path"]);
    plenoxel(&["render", &run, "--path", "orbit", "--size", "16384", "--max-memory", "1GB"]).refused(2, &["--size", "fewer pixels"]);
}
