//! What a user sees when opening datasets: views, cameras, and the message for everything that can be wrong with a folder.

use plenoxel::camera::lens::Lens;
use plenoxel::dataset::image::{RgbaImage, write_rgba};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{self, Dataset, OpenOptions, Split};
use plenoxel::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// A folder that is removed when the test ends, also when it fails.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let unique = format!("plenoxel-datasets-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(unique);
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    /// A complete tiny scene: 4 training, 1 validation and 2 test images of 4 x 4 pixels; image k has red = 10 k.
    fn scene() -> Self {
        let folder = Folder::new();
        for (split, count) in [("train", 4), ("val", 1), ("test", 2)] {
            for k in 0..count {
                folder.image(&format!("{split}/r_{k}.png"), 4, 4, [10 * k, 20, 30, 255]);
            }
            folder.write(&format!("transforms_{split}.json"), &transforms(split, count));
        }
        folder
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    fn image(&self, name: &str, width: u32, height: u32, pixel: [u8; 4]) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let pixels = pixel.repeat((width * height) as usize);
        write_rgba(&path, &RgbaImage::from_raw(width, height, pixels).unwrap()).unwrap();
    }

    /// Replaces text in the training file.
    fn edit(&self, from: &str, to: &str) {
        let text = fs::read_to_string(self.path("transforms_train.json")).unwrap();
        assert!(text.contains(from), "the fixture has no {from}");
        self.write("transforms_train.json", &text.replacen(from, to, 1));
    }

    fn open(&self) -> Result<Dataset, Error> {
        dataset::open(&self.0, &OpenOptions::default())
    }

    /// Opening fails with this exit code and a message that contains all of the words.
    fn refused(&self, code: u8, words: &[&str]) {
        refused(self.open(), code, words);
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn refused<T>(result: Result<T, Error>, code: u8, words: &[&str]) {
    let error = result.err().expect("this should have been refused");
    let message = error.to_string();
    assert_eq!(error.exit_code(), code, "{message}");
    for word in words {
        assert!(message.contains(word), "\"{word}\" is missing in: {message}");
    }
}

/// Cameras at (0, 0, 4 + k) that look down.
fn transforms(split: &str, count: u8) -> String {
    let frame = |k: u8| {
        let pose = format!("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, {}], [0, 0, 0, 1]]", 4 + k);
        format!("{{ \"file_path\": \"./{split}/r_{k}\", \"rotation\": 0.1, \"transform_matrix\": {pose} }}")
    };
    let frames: Vec<String> = (0..count).map(frame).collect();
    format!("{{\n \"camera_angle_x\": 0.6911112070083618,\n \"frames\": [\n{}\n]}}", frames.join(",\n"))
}

#[test]
fn a_complete_scene_has_its_views_in_the_order_of_the_files() {
    let folder = Folder::scene();
    let dataset = folder.open().unwrap();
    assert_eq!(Split::ALL.map(|split| dataset.count(split)), [4, 1, 2]);
    assert_eq!(dataset.size(), (4, 4));
    assert_eq!(dataset.name(), folder.0.file_name().unwrap().to_str().unwrap());
    assert_eq!(dataset.view_names(Split::Train), ["r_0", "r_1", "r_2", "r_3"]);
    let views = dataset.load(Split::Train, &|_, _| ()).unwrap();
    for (k, view) in views.iter().enumerate() {
        assert_eq!(view.image.get_pixel(0, 0).0[0], 10 * k as u8);
        assert_eq!(view.camera, dataset.cameras(Split::Train)[k]);
        assert_eq!(view.camera.position().z, 4.0 + k as f64);
        assert!(view.depth.is_none());
    }
    // f = 0.5 W / tan(0.5 angle): 800 pixels have 1111.111, so 4 have 5.5556.
    let intrinsics = views[0].camera.intrinsics;
    assert!((intrinsics.fx - 1111.1111 / 200.0).abs() < 1e-6 && intrinsics.cx == 2.0);
}

#[test]
fn color_is_composited_over_the_background_that_is_asked_for() {
    let folder = Folder::scene();
    folder.image("train/r_0.png", 4, 4, [255, 0, 0, 51]); // alpha 0.2
    let view = folder.open().unwrap().load(Split::Train, &|_, _| ()).unwrap().remove(0);
    let close = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!((view.alpha(0, 0) - 0.2).abs() < 1e-6);
    assert!(close(view.color(1, 1, [1.0; 3]), [1.0, 0.8, 0.8]));
    assert!(close(view.color(1, 1, [0.0, 0.5, 0.0]), [0.2, 0.4, 0.0]));
    assert_eq!(view.composite([1.0; 3]).dim(), (4, 4, 3));
}

#[test]
fn file_paths_with_extension_or_relative_to_the_split_are_found_too() {
    let folder = Folder::scene();
    folder.edit("./train/r_0", "./train/r_0.png");
    folder.edit("./train/r_1", "elsewhere/r_1");
    folder.edit("./train/r_2", "train\\\\r_2");
    assert_eq!(folder.open().unwrap().view_names(Split::Train), ["r_0", "r_1", "r_2", "r_3"]);
}

#[test]
fn depth_and_normal_pictures_beside_the_test_images_are_not_views() {
    let folder = Folder::scene();
    folder.image("test/r_0_depth_0000.png", 9, 9, [1; 4]);
    folder.image("test/r_0_normal_0000.png", 9, 9, [1; 4]);
    let dataset = folder.open().unwrap();
    assert_eq!(dataset.view_names(Split::Test), ["r_0", "r_1"]);
}

#[test]
fn a_missing_validation_or_test_split_is_empty_and_views_can_be_held_out() {
    let folder = Folder::scene();
    fs::remove_file(folder.path("transforms_val.json")).unwrap();
    fs::remove_file(folder.path("transforms_test.json")).unwrap();
    assert_eq!(Split::ALL.map(|split| folder.open().unwrap().count(split)), [4, 0, 0]);
    assert!(folder.open().unwrap().load(Split::Test, &|_, _| ()).unwrap().is_empty());

    let options = OpenOptions { validation_every: Some(2), ..OpenOptions::default() };
    let dataset = dataset::open(&folder.0, &options).unwrap();
    assert_eq!(dataset.view_names(Split::Train), ["r_0", "r_2"]);
    assert_eq!(dataset.view_names(Split::Val), ["r_1", "r_3"]);
    let options = OpenOptions { validation_every: Some(1), ..OpenOptions::default() };
    refused(dataset::open(&folder.0, &options), 2, &["validation_every", "2 or more"]);

    // A validation file of the scene's own is left alone.
    folder.write("transforms_val.json", &transforms("val", 1));
    let options = OpenOptions { validation_every: Some(2), ..OpenOptions::default() };
    let dataset = dataset::open(&folder.0, &options).unwrap();
    assert_eq!((dataset.count(Split::Train), dataset.count(Split::Val)), (4, 1));
}

#[test]
fn downscaling_reduces_images_and_intrinsics_alike() {
    let folder = Folder::scene();
    let small = dataset::open(&folder.0, &OpenOptions { downscale: 2, ..OpenOptions::default() }).unwrap();
    let (full, half) = (folder.open().unwrap().cameras(Split::Train)[0].intrinsics, small.cameras(Split::Train)[0].intrinsics);
    assert_eq!((small.size(), half.fx, half.cx), ((2, 2), full.fx / 2.0, 1.0));
    assert_eq!(small.load(Split::Train, &|_, _| ()).unwrap()[1].image.dimensions(), (2, 2));
    for (downscale, expected) in [(0, "expected 1 or more"), (3, "expected 1, 2, 4")] {
        let options = OpenOptions { downscale, ..OpenOptions::default() };
        refused(dataset::open(&folder.0, &options), 2, &["downscale", &downscale.to_string(), expected]);
    }
}

#[test]
fn paths_that_are_no_scene_say_what_they_are() {
    let folder = Folder::scene();
    let open = |path: &Path| dataset::open(path, &OpenOptions::default());
    refused(open(&folder.path("nowhere")), 3, &["nowhere", "no such folder"]);
    refused(open(&folder.path("transforms_train.json")), 3, &["this is a file", "folder"]);
    let scene = folder.0.to_string_lossy().into_owned();
    refused(open(&folder.path("train")), 3, &["no format is recognized", "r_0.png, r_1.png", "give the folder of the scene", &scene]);
    let photographs = Folder::new();
    photographs.image("a.png", 4, 4, [255; 4]);
    refused(open(&photographs.0), 3, &["photographs need cameras", "plenoxel cameras"]);
    let parent = Folder::new();
    refused(open(&parent.0), 3, &["no format is recognized", "it is empty"]);
    fs::create_dir(parent.path("lego")).unwrap();
    parent.write("lego/transforms_train.json", "{}");
    refused(open(&parent.0), 3, &["it contains lego", "give one scene", "lego"]);
    let other = Folder::new();
    other.write("transforms.json", "{}");
    refused(open(&other.0), 3, &["transforms.json", "there is no list \"frames\""]);
}

#[test]
fn cameras_that_are_there_and_cannot_be_read_are_never_said_to_be_missing() {
    for split in ["train", "val", "test"] {
        let folder = Folder::scene();
        let name = format!("transforms_{split}.json");
        fs::remove_file(folder.path(&name)).unwrap();
        fs::create_dir(folder.path(&name)).unwrap();
        folder.refused(3, &[&name, "this is a folder"]);
    }
}

#[cfg(unix)]
#[test]
fn what_may_never_end_is_refused_wherever_a_file_is_expected() {
    use std::os::unix::fs::symlink;
    for name in ["transforms_train.json", "transforms_val.json", "transforms_test.json", "train/r_1.png", "test/r_0.png"] {
        let folder = Folder::scene();
        let path = folder.path(name);
        fs::remove_file(&path).unwrap();
        symlink("/dev/zero", &path).unwrap();
        folder.refused(3, &[name, "this is a device, not a plain file"]);
        fs::remove_file(&path).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        folder.refused(3, &[name, "this is a pipe, not a plain file"]);
        fs::remove_file(&path).unwrap();
        symlink("nowhere", &path).unwrap();
        folder.refused(3, &[name, "link is broken"]);
    }
}

#[test]
fn intrinsics_lenses_and_masks_are_those_of_a_transforms_json() {
    let angle = "\"camera_angle_x\": 0.6911112070083618";
    let with = |more: &str| {
        let folder = Folder::scene();
        folder.edit(angle, more);
        folder
    };
    let camera = |folder: &Folder, k: usize| folder.open().unwrap().cameras(Split::Train)[k].intrinsics;
    // Focal lengths in pixels, for images of twice the size.
    let stated = camera(&with(r#""fl_x": 11, "fl_y": 12, "cx": 4.5, "cy": 3.5, "w": 8, "h": 8, "k1": 0.01, "camera_model": "OPENCV""#), 0);
    assert_eq!((stated.fx, stated.fy, stated.cx, stated.cy, stated.width), (5.5, 6.0, 2.25, 1.75, 4));
    assert!(stated.lens != Lens::Pinhole);
    // A frame precedes the file.
    let folder = Folder::scene();
    folder.image("train/mask.png", 4, 4, [255; 4]);
    folder.edit(
        "\"rotation\": 0.1, \"transform_matrix\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]",
        "\"cy\": 3, \"mask_path\": \"train/mask.png\", \"transform_matrix\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]",
    );
    assert_eq!([0, 1].map(|k| camera(&folder, k).cy), [2.0, 3.0]);
    let views = folder.open().unwrap().load(Split::Train, &|_, _| ()).unwrap();
    assert_eq!([0, 1].map(|k| views[k].mask.is_some()), [false, true]);
    // Images of several sizes have one angle.
    let folder = Folder::scene();
    folder.image("train/r_1.png", 8, 6, [9; 4]);
    let (dataset, [first, second]) = (folder.open().unwrap(), [0, 1].map(|k| camera(&folder, k)));
    assert_eq!((dataset.size(), (second.width, second.height), second.cy), ((8, 6), (8, 6), 3.0));
    assert!((second.fx - 2.0 * first.fx).abs() < 1e-12);

    for (more, words) in [
        (r#""fl_x": -5"#, ["fl_x is -5", "positive"]),
        (r#""camera_angle_x": 0.6911112070083618, "fl_x": 11.1"#, ["fl_x is 11.1, but camera_angle_x", "give w and h"]),
        (r#""camera_angle_x": 0.69, "w": 8, "h": 16"#, ["the image has 4 x 4 pixels", "its camera 8 x 16"]),
        (r#""camera_angle_x": 0.69, "camera_model": "EQUIRECTANGULAR""#, ["EQUIRECTANGULAR", "frame 0"]),
        (r#""camera_angle_x": 0.69, "rolling_shutter": [0, 1, 0, 0]"#, ["rolling_shutter is", "not supported"]),
    ] {
        with(more).refused(3, &words);
    }
    let folder = Folder::scene();
    folder.image("train/mask.png", 4, 5, [255; 4]);
    folder.edit("\"rotation\": 0.1", "\"mask_path\": \"train/mask.png\"");
    folder.refused(3, &["mask.png", "the mask has 4 x 5 pixels, but its image has 4 x 4"]);
    folder.edit("\"mask_path\": \"train/mask.png\"", "\"mask_path\": \"gone.png\"");
    folder.refused(3, &["the mask \"gone.png\" of frame 0 does not exist", "looked for"]);
}

#[test]
fn cameras_are_read_from_every_unicode_encoding_that_marks_itself() {
    let folder = Folder::scene();
    let name = "transforms_train.json";
    let text = fs::read_to_string(folder.path(name)).unwrap();
    folder.write(name, &format!("\u{feff}{text}"));
    assert_eq!(folder.open().unwrap().count(Split::Train), 4);
    let utf16: Vec<u8> = format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    fs::write(folder.path(name), &utf16).unwrap();
    assert_eq!(folder.open().unwrap().count(Split::Train), 4);
    fs::write(folder.path(name), &utf16[..utf16.len() - 1]).unwrap();
    folder.refused(3, &[name, "UTF-16", "save the file as UTF-8"]);
    fs::write(folder.path(name), text.replace("train/r_0", "train/r\u{e9}").chars().map(|c| c as u8).collect::<Vec<_>>()).unwrap();
    folder.refused(3, &[name, "line 4 is not valid UTF-8"]);
}

#[test]
fn what_files_say_moves_nothing_on_a_screen() {
    let folder = Folder::scene();
    folder.edit("./train/r_0", "a\\u001b[2J\\nb");
    let message = folder.open().unwrap_err().to_string();
    assert!(message.contains("\"a\\u{1b}[2J\\nb\" of frame 0") && !message.contains(['\n', '\x1b']), "{message}");
}

#[test]
fn json_cut_short_or_malformed_names_line_and_column() {
    let folder = Folder::scene();
    let text = fs::read_to_string(folder.path("transforms_train.json")).unwrap();
    folder.write("transforms_train.json", &text[..text.len() / 2]);
    folder.refused(3, &["transforms_train.json", "ends early", "line 5, column"]);
    folder.write("transforms_train.json", "");
    folder.refused(3, &["transforms_train.json", "ends early"]);
    folder.write("transforms_train.json", "{\n \"camera_angle_x\": 0.7,\n oops }");
    folder.refused(3, &["not valid JSON", "line 3"]);
    folder.write("transforms_train.json", "[]");
    folder.refused(3, &["no list \"frames\""]);
}

#[test]
fn missing_or_wrong_keys_are_named_with_their_frame() {
    for (from, to, words) in [
        ("camera_angle_x", "camera_angle", ["frame 0 has no focal length", "camera_angle_x in radians"]),
        ("\"frames\"", "\"pictures\"", ["no list \"frames\"", "transform_matrix"]),
        ("file_path", "file", ["frame 0 has no key \"file_path\"", "name the image"]),
        ("\"./train/r_0\"", "7", ["file_path of frame 0 is 7", "name a file"]),
        ("transform_matrix", "matrix", ["frame 0 has no key \"transform_matrix\"", "4 x 4"]),
        ("0.6911112070083618", "0", ["camera_angle_x is 0", "above 0 and below 180"]),
        ("0.6911112070083618", "3.2", ["camera_angle_x is 3.2", "above 0 and below 180"]),
        ("0.6911112070083618", "null", ["frame 0 has no focal length", "fl_x in pixels"]),
        ("0.6911112070083618", "1e-320", ["camera_angle_x is 1e-320", "above 0 and below 180"]),
        ("0.6911112070083618", "1e999", ["not valid JSON", "line 2"]),
        (", [0, 0, 0, 1]]", "]", ["transform_matrix of frame 0 has 3 rows", "4 rows of 4"]),
        ("[0, 1, 0, 0]", "[0, 1, 0]", ["transform_matrix of frame 0 has 3 numbers in row 1", "4 rows of 4"]),
        ("[0, 1, 0, 0]", "[0, 1, 0, null]", ["transform_matrix of frame 0 has null in row 1, column 3", "finite"]),
        ("[0, 1, 0, 0]", "[0, 1, 0, 1e999]", ["not valid JSON", "out of range"]),
        ("[0, 1, 0, 0]", "[0, 1, 0, NaN]", ["not valid JSON", "finite"]),
        ("[0, 1, 0, 0]", "[0, 2, 0, 0]", ["transform_matrix of frame 0 is not a rotation", "scale"]),
        ("[0, 0, 1, 4]", "[0, 0, 1, 1e300]", ["transform_matrix of frame 0 puts the camera at [0.0, 0.0, 1e300]", "up to 1e12"]),
        ("[0, 0, 0, 1]", "[0, 0, 1, 1]", ["transform_matrix of frame 0 has the last row", "0 0 0 1"]),
    ] {
        let folder = Folder::scene();
        folder.edit(from, to);
        folder.refused(3, &["transforms_train.json", words[0], words[1]]);
    }
}

#[test]
fn a_training_split_without_frames_is_refused() {
    let folder = Folder::scene();
    folder.write("transforms_train.json", "{ \"camera_angle_x\": 0.7, \"frames\": [] }");
    folder.refused(3, &["frames is empty", "at least one training view"]);
}

#[test]
fn a_missing_image_is_named_with_its_frame_and_the_places_searched() {
    let folder = Folder::scene();
    fs::remove_file(folder.path("train/r_2.png")).unwrap();
    folder.refused(3, &["transforms_train.json", "\"train/r_2\" of frame 2 does not exist", "looked for", "r_2.png"]);
}

#[test]
fn broken_images_are_found_on_opening_and_named() {
    let folder = Folder::scene();
    let path = folder.path("test/r_1.png");
    let png = fs::read(&path).unwrap();
    // The last 12 bytes only say that the file ends; without them every pixel is still there.
    for length in [20, 40, png.len() - 13] {
        fs::write(&path, &png[..length]).unwrap();
        folder.refused(3, &["r_1.png", "truncated"]);
    }
    fs::write(&path, b"\xff\xd8\xff\xe0 JFIF and so on, long enough").unwrap();
    folder.refused(3, &["r_1.png", "the JPEG is truncated"]);
    fs::write(&path, "These are not the pixels you are looking for.").unwrap();
    folder.refused(3, &["r_1.png", "not a PNG, JPEG or WebP image", "convert it to PNG or JPEG"]);
    fs::write(&path, "").unwrap();
    folder.refused(3, &["r_1.png", "empty"]);
    let mut absurd = png.clone();
    absurd[16..24].copy_from_slice(&[0, 0, 0xea, 0x60, 0, 0, 0xea, 0x60]); // 60000 x 60000
    fs::write(&path, absurd).unwrap();
    folder.refused(3, &["r_1.png", "60000 x 60000", "16384"]);
}

#[test]
fn damage_inside_an_image_is_reported_when_it_is_decoded() {
    let folder = Folder::scene();
    let path = folder.path("train/r_1.png");
    let mut png = fs::read(&path).unwrap();
    let data = png.windows(4).position(|name| name == b"IDAT").unwrap();
    png[data + 6] ^= 0xff;
    fs::write(&path, png).unwrap();
    let dataset = folder.open().unwrap();
    refused(dataset.load(Split::Train, &|_, _| ()), 3, &["r_1.png", "cannot be decoded"]);
}

#[test]
fn the_built_in_scene_written_to_disk_reads_back_the_same() {
    let options = ProceduralOptions { width: 20, height: 20, train: 3, val: 2, test: 2, supersample: 2 };
    let built_in = Dataset::procedural(options).unwrap();
    let folder = Folder::new();
    built_in.write_blender(&folder.0, false).unwrap();
    let read = folder.open().unwrap();
    assert_eq!(read.size(), built_in.size());
    for split in Split::ALL {
        assert_eq!(read.view_names(split), built_in.view_names(split));
        let (read, made) = (read.load(split, &|_, _| ()).unwrap(), built_in.load(split, &|_, _| ()).unwrap());
        for (a, b) in read.iter().zip(&made) {
            assert!(a.image == b.image, "{split} {}", a.name);
            assert!(a.camera.camera_to_world.abs_diff_eq(b.camera.camera_to_world, 1e-9));
            assert!((a.camera.intrinsics.fx - b.camera.intrinsics.fx).abs() < 1e-9);
        }
    }
    assert!(folder.path("test/r_0_depth_0000.png").exists() && !folder.path("train/r_0_depth_0000.png").exists());

    refused(built_in.write_blender(&folder.0, false), 3, &["the folder is not empty"]);
    built_in.write_blender(&folder.0, true).unwrap();
}
