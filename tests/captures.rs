//! Opening captures: the same cameras in every format, and the message for everything that can be wrong.

use crate::capture_folders::*;
use glam::{DAffine3, DMat3, DVec3, dvec3};
use plenoxel::camera::lens::Lens;
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::dataset::normalize::{CaptureOptions, Center, FormatChoice, Orient, Scale, SpaceChoice};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{self, Dataset, OpenOptions, Split, View};
use plenoxel::error::Error;
use plenoxel::geometry::Similarity;
use plenoxel::space::Space;

/// Nine views of the built-in scene.
fn views() -> Vec<View> {
    let options = ProceduralOptions { width: 16, height: 12, train: 9, val: 0, test: 0, supersample: 1 };
    Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| ()).unwrap()
}

fn points() -> Vec<DVec3> {
    (0..50).map(|k| dvec3((0.7 * f64::from(k)).sin(), (1.3 * f64::from(k)).cos(), 0.02 * f64::from(k))).collect()
}

fn open(folder: &Folder) -> Result<Dataset, Error> {
    dataset::open(&folder.0, &OpenOptions::default())
}

fn open_with(folder: &Folder, capture: CaptureOptions) -> Result<Dataset, Error> {
    dataset::open(&folder.0, &OpenOptions { capture, ..OpenOptions::default() })
}

/// All cameras by name, in the frame of the files.
fn in_input(dataset: &Dataset) -> Vec<(String, Camera)> {
    let back = dataset.to_input();
    let mut all: Vec<(String, Camera)> = Split::ALL
        .iter()
        .flat_map(|split| dataset.view_names(*split).into_iter().map(str::to_owned).zip(dataset.cameras(*split)))
        .map(|(name, camera)| (name, Camera { camera_to_world: back.camera(camera.camera_to_world), ..camera }))
        .collect();
    all.sort_by(|a, b| a.0.cmp(&b.0));
    all
}

fn assert_close(a: &Camera, b: &Camera, within: f64) {
    let numbers = |c: &Camera| {
        let k = c.intrinsics;
        let pose = c.camera_to_world.to_cols_array();
        assert_eq!(k.lens, Default::default());
        pose.into_iter().chain([k.width as f64, k.height as f64, k.fx, k.fy, k.cx, k.cy]).collect::<Vec<_>>()
    };
    let worst = numbers(a).into_iter().zip(numbers(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst <= within, "{a:?} and {b:?} differ by {worst}");
}

/// Writers of the same views, with the words of the format.
type Writer = (&'static str, fn(&Folder, &[View]));

const WRITERS: [Writer; 5] = [
    ("transforms.json", write_transforms),
    ("COLMAP (binary)", |folder, views| write_colmap(folder, views, &points())),
    ("COLMAP (text)", |folder, views| write_colmap_text(folder, views, &points())),
    ("LLFF", write_llff),
    ("NSVF", write_nsvf),
];

#[test]
fn every_format_gives_back_the_cameras_and_images_that_were_written() {
    let views = views();
    let mut worlds: Vec<Vec<Camera>> = Vec::new();
    for (format, write) in WRITERS {
        let folder = Folder::new();
        write(&folder, &views);
        let dataset = open(&folder).unwrap();
        assert!(dataset.format().contains(format), "{} for {format}", dataset.format());
        let counts = if format == "NSVF" { [6, 0, 3] } else { [7, 0, 2] };
        assert_eq!(Split::ALL.map(|split| dataset.count(split)), counts, "{format}");
        let mut read = in_input(&dataset);
        // NSVF names begin with the split.
        read.sort_by_key(|(name, _)| name.trim_start_matches("0_").trim_start_matches("2_").to_owned());
        read.iter().zip(&views).for_each(|((_, camera), view)| assert_close(camera, &view.camera, 1e-9));
        if format != "NSVF" {
            let test = dataset.load(Split::Test, &|_, _| ()).unwrap();
            assert_eq!(test.iter().map(|view| &view.name[..]).collect::<Vec<_>>(), ["r_0", "r_8"]);
            assert!(test[0].image == views[0].image && test[1].image == views[8].image);
            worlds.push(Split::ALL.iter().flat_map(|split| dataset.cameras(*split)).collect());
        }
        assert_eq!(dataset.points().len(), if format.starts_with("COLMAP") { 50 } else { 0 });
        assert_eq!(dataset.space(), Space::Contracted);
        assert!(dataset.notes().is_empty(), "{:?}", dataset.notes());
    }
    for world in &worlds[1..] {
        world.iter().zip(&worlds[0]).for_each(|(a, b)| assert_close(a, b, 1e-9));
    }
}

#[test]
fn a_similarity_of_the_input_changes_no_camera_of_the_world() {
    let views = views();
    let folder = Folder::new();
    write_transforms(&folder, &views);
    let expected = open(&folder).unwrap();
    let moved = Similarity::about(dvec3(3.0, -20.0, 1.0), DMat3::from_axis_angle(dvec3(1.0, 0.4, -2.0).normalize(), 2.1), 0.037);
    let moved_views: Vec<View> = views
        .iter()
        .map(|view| {
            let camera = Camera { camera_to_world: moved.camera(view.camera.camera_to_world), ..view.camera };
            View { camera, ..view.clone() }
        })
        .collect();
    write_transforms(&folder, &moved_views);
    let found = open(&folder).unwrap();
    for (a, b) in found.cameras(Split::Train).iter().zip(expected.cameras(Split::Train)) {
        assert_close(a, &b, 1e-9);
    }
    // The farthest camera of those that look inwards is at 2 along an axis, up is up, and the way back leads to the input.
    let farthest = Split::ALL.iter().flat_map(|s| found.cameras(*s)).map(|c| c.position().abs().max_element()).fold(0.0, f64::max);
    assert!((farthest - 2.0).abs() < 1e-12);
    let up = Split::ALL.iter().flat_map(|s| found.cameras(*s)).map(|c| c.camera_to_world.matrix3.y_axis).sum::<DVec3>();
    assert!(up.normalize().z > 1.0 - 1e-12);
    in_input(&found).iter().zip(&moved_views).for_each(|((_, camera), view)| assert_close(camera, &view.camera, 1e-9));
}

#[test]
fn the_origin_is_what_cameras_look_at_and_their_middle_if_they_look_outwards() {
    let folder = Folder::new();
    let origin = |views: &[View]| {
        write_transforms(&folder, views);
        let dataset = open(&folder).unwrap();
        let center = &dataset.normalization().describe()[2].1;
        (dataset.to_input().translation, center.split(':').next().unwrap().to_owned())
    };
    let turned = |angle: f64, view: View| {
        let mut pose = view.camera.camera_to_world;
        pose.matrix3 *= DMat3::from_rotation_y(angle);
        View { camera: Camera { camera_to_world: pose, ..view.camera }, ..view }
    };
    // All look at the origin of the files; one that looks elsewhere hardly moves it.
    let (focus, name) = origin(&views());
    assert!(focus.length() < 1e-9 && name == "focus", "{focus:?} {name}");
    let mut astray = views();
    astray[4] = turned(0.3, astray[4].clone());
    let (focus, name) = origin(&astray);
    assert!(focus.length() < 0.05 && name == "focus", "{focus:?} {name}");
    let outwards: Vec<View> = views().into_iter().map(|view| turned(std::f64::consts::PI, view)).collect();
    let mean = outwards.iter().map(|view| view.camera.position()).sum::<DVec3>() / 9.0;
    let (center, name) = origin(&outwards);
    assert!(center.distance(mean) < 1e-9 && name == "poses", "{center:?} {name}");
}

/// Cameras side by side that look along -z of the given frame.
fn forward_facing(spread: f64) -> Vec<View> {
    let place = |k: usize| dvec3(spread * (k % 3) as f64, spread * (k / 3) as f64, 0.1 * spread * (k % 2) as f64);
    let pose = |k: usize| DAffine3 { matrix3: DMat3::from_rotation_y(0.02 * k as f64 - 0.08), translation: place(k) };
    let turned = |(k, view): (usize, View)| View { camera: Camera { camera_to_world: pose(k), ..view.camera }, ..view };
    views().into_iter().enumerate().map(turned).collect()
}

#[test]
fn cameras_that_face_forward_before_the_scene_get_ndc_and_others_do_not() {
    let folder = Folder::new();
    write_llff(&folder, &forward_facing(0.2));
    let dataset = open(&folder).unwrap();
    let k = dataset.cameras(Split::Train)[0].intrinsics;
    let Space::Ndc { a, b } = dataset.space() else { panic!("{:?}", dataset.space()) };
    assert!((a - 2.0 * k.fx / 16.0).abs() < 1e-12 && (b - 2.0 * k.fy / 12.0).abs() < 1e-12);
    // The nearest depth is 2, and 1 / 0.75 in the world.
    assert!((dataset.to_input().scale - 0.75 * 2.0).abs() < 1e-12);
    let mean = Split::ALL.iter().flat_map(|split| dataset.cameras(*split)).map(|camera| camera.position()).sum::<DVec3>();
    assert!(mean.length() < 1e-9);
    for (spread, space) in [(1.5, SpaceChoice::Auto), (0.2, SpaceChoice::Contracted)] {
        write_llff(&folder, &forward_facing(spread));
        let options = CaptureOptions { space, ..CaptureOptions::default() };
        assert_eq!(open_with(&folder, options).unwrap().space(), Space::Contracted);
    }
    let ndc = CaptureOptions { space: SpaceChoice::Ndc, ..CaptureOptions::default() };
    write_llff(&folder, &forward_facing(1.5));
    refused(open_with(&folder, ndc), 2, &["space", "nearest depth is 2.000", "contracted"]);
    write_llff(&folder, &forward_facing(0.2));
    for options in [
        CaptureOptions { orient: Orient::Pca, ..ndc },
        CaptureOptions { center: Center::None, ..ndc },
        CaptureOptions { scale: Scale::None, ..ndc },
    ] {
        refused(open_with(&folder, options), 2, &["has no effect in NDC"]);
    }
    // Without any depth there is no near plane.
    remove(&folder.path("poses_bounds.npy"));
    write_transforms(&folder, &forward_facing(0.2));
    assert_eq!(open(&folder).unwrap().space(), Space::Contracted);
    refused(open_with(&folder, ndc), 2, &["space", "ndc needs the depth of the nearest surface"]);
}

#[test]
fn llff_has_the_lens_of_the_reconstruction_that_it_was_made_from() {
    let folder = Folder::new();
    let views = views();
    write_llff(&folder, &views);
    let pinhole = open(&folder).unwrap().cameras(Split::Train)[0].intrinsics;
    let with_cameras = |cameras: &[(usize, f64, f64)]| {
        let line =
            |(k, (width, focal, radial)): (usize, &(usize, f64, f64))| format!("{k} SIMPLE_RADIAL {width} 12 {focal} 8 6 {radial}\n");
        folder.write("sparse/0/cameras.txt", cameras.iter().enumerate().map(line).collect::<String>());
        let dataset = open(&folder).unwrap();
        (dataset.cameras(Split::Train)[0].intrinsics, dataset.notes().len())
    };
    let lens = Lens::perspective([0.02, 0.0, 0.0, 0.0], [0.0; 3], [0.0; 2]);
    let focal = pinhole.fx;
    // A camera of another size or focal length is not that of the views.
    assert_eq!(with_cameras(&[(32, focal, 0.1), (16, focal, 0.02), (16, 1.01 * focal, 0.1)]), (Intrinsics { lens, ..pinhole }, 0));
    // Cameras that may be meant and differ: nothing says which one it is.
    assert_eq!(with_cameras(&[(16, focal, 0.02), (16, focal, 0.1)]), (pinhole, 1));
    assert_eq!(with_cameras(&[(16, 1.01 * focal, 0.02)]), (pinhole, 1));
}

#[test]
fn the_frame_of_the_files_can_be_kept() {
    let folder = Folder::new();
    let views = views();
    write_colmap(&folder, &views, &points());
    let none = CaptureOptions { orient: Orient::None, center: Center::None, scale: Scale::None, ..CaptureOptions::default() };
    let dataset = open_with(&folder, none).unwrap();
    assert_eq!(dataset.to_input(), Similarity::default());
    assert_eq!(dataset.points()[7].position, points()[7]);
    assert_eq!(dataset.points()[7].color, [10, 20, 30]);
    let twice = open_with(&folder, CaptureOptions { scale: Scale::Factor(2.0), ..none }).unwrap();
    let (one, two) = (dataset.cameras(Split::Train)[0], twice.cameras(Split::Train)[0]);
    assert_eq!(two.position(), 2.0 * one.position());
    let pca = open_with(&folder, CaptureOptions { orient: Orient::Pca, center: Center::Poses, ..CaptureOptions::default() }).unwrap();
    let mean = Split::ALL.iter().flat_map(|split| pca.cameras(*split)).map(|camera| camera.position()).sum::<DVec3>();
    assert!(mean.length() < 1e-9);
    assert_eq!(pca.normalization().describe().len(), 4);
}

#[test]
fn splits_reductions_and_missing_images() {
    let folder = Folder::new();
    let views = views();
    write_transforms(&folder, &views);
    let none = CaptureOptions { test_every: 0, ..CaptureOptions::default() };
    let held = OpenOptions { validation_every: Some(3), capture: none, ..OpenOptions::default() };
    assert_eq!(Split::ALL.map(|split| dataset::open(&folder.0, &held).unwrap().count(split)), [6, 3, 0]);
    let lists =
        r#""train_filenames": ["images/r_1.png", "./images/r_2.png"], "test_filenames": ["images/r_0.png"], "val_filenames": [], "fl_x""#;
    folder.edit("transforms.json", "\"fl_x\"", lists);
    let dataset = open(&folder).unwrap();
    assert_eq!((dataset.view_names(Split::Train), dataset.view_names(Split::Test)), (vec!["r_1", "r_2"], vec!["r_0"]));
    assert!(dataset.notes()[0].starts_with("left out 6 views"), "{:?}", dataset.notes());

    write_transforms(&folder, &views);
    remove(&folder.path("images/r_3.png"));
    remove(&folder.path("images/r_5.png"));
    let dataset = open(&folder).unwrap();
    assert_eq!(dataset.notes(), ["skipped 2 of 9 views without an image: images/r_3.png, images/r_5.png"]);

    // Images that were reduced afterwards, under images or under images_4; 5 does not divide 16 and 12.
    let small: Vec<View> = views.iter().map(|view| view.reduced(4)).collect();
    folder.images("images_4", &small);
    let reduced = |downscale: usize| dataset::open(&folder.0, &OpenOptions { downscale, ..OpenOptions::default() }).unwrap();
    for (downscale, size) in [(1, (16, 12)), (2, (8, 6)), (4, (4, 3)), (5, (3, 2))] {
        let dataset = reduced(downscale);
        let (full, k) = (views[1].camera.intrinsics, dataset.cameras(Split::Train)[0].intrinsics);
        assert_eq!((dataset.size(), k.width, k.height), (size, size.0, size.1));
        assert!((k.fx - full.fx / downscale as f64).abs() < 1e-12 && (k.cx - full.cx / downscale as f64).abs() < 1e-12);
        assert_eq!(dataset.load(Split::Train, &|_, _| ()).unwrap()[0].size(), [size.0, size.1]);
    }
    std::fs::remove_dir_all(folder.path("images")).unwrap();
    assert_eq!((reduced(1).size(), reduced(4).size()), ((4, 3), (4, 3)));
    folder.images("images", &small);
    std::fs::remove_dir_all(folder.path("images_4")).unwrap();
    let dataset = reduced(1);
    assert_eq!((dataset.size(), dataset.notes().len()), ((4, 3), 1));
}

#[test]
fn a_folder_of_two_formats_says_which_one_is_read() {
    let folder = Folder::new();
    write_llff(&folder, &views());
    write_colmap(&folder, &views(), &[]);
    let dataset = open(&folder).unwrap();
    assert!(dataset.format().contains("COLMAP"));
    assert_eq!(dataset.notes(), ["the folder also has poses_bounds.npy, which --format llff reads"]);
    write_transforms(&folder, &views());
    assert_eq!(open(&folder).unwrap().notes().len(), 2);
    let read_as = |format| open_with(&folder, CaptureOptions { format, ..CaptureOptions::default() });
    for (format, name) in [(FormatChoice::Transforms, "transforms.json"), (FormatChoice::Colmap, "COLMAP"), (FormatChoice::Llff, "LLFF")] {
        let dataset = read_as(format).unwrap();
        assert!(dataset.format().contains(name), "{name}: {}", dataset.format());
        assert!(dataset.notes().iter().all(|note| !note.contains(&format!("--format {format}"))), "{:?}", dataset.notes());
    }
    refused(read_as(FormatChoice::Nsvf), 2, &["format", "a reconstruction of COLMAP", "no files of the format nsvf"]);
}

fn refused<T>(result: Result<T, Error>, code: u8, words: &[&str]) {
    let error = result.err().unwrap_or_else(|| panic!("this should have been refused: {words:?}"));
    let message = error.to_string();
    assert_eq!(error.exit_code(), code, "{message}");
    for word in words {
        assert!(message.contains(word), "\"{word}\" is missing in: {message}");
    }
}

/// A way to break a capture, with the words of the message. The exit code is 3.
type Broken = (fn(&Folder, &[View]), &'static [&'static str]);

fn cut(folder: &Folder, name: &str, length: usize) {
    let bytes = folder.read(name);
    folder.write(name, &bytes[..length]);
}

fn set(folder: &Folder, name: &str, at: usize, new: &[u8]) {
    let mut bytes = folder.read(name);
    bytes[at..at + new.len()].copy_from_slice(new);
    folder.write(name, bytes);
}

const CAMERAS: &str = "sparse/0/cameras.bin";
const IMAGES: &str = "sparse/0/images.bin";
const POINTS: &str = "sparse/0/points3D.bin";

/// Broken binary files of COLMAP. A camera has 56 bytes after the first 8. An image has 4 + 56 + 4 bytes, 8 of the name, and 8 + 48 of points.
const BINARY: &[Broken] = &[
    (|f, _| cut(f, CAMERAS, 0), &["cameras.bin", "ends within cameras"]),
    (|f, _| cut(f, CAMERAS, 20), &["cameras.bin", "9 cameras, and 12 bytes"]),
    (|f, _| cut(f, CAMERAS, 8 + 9 * 56 - 1), &["cameras.bin", "ends within a camera"]),
    (|f, _| set(f, CAMERAS, 0, &u64::MAX.to_le_bytes()), &["cameras.bin", "18446744073709551615 cameras"]),
    (|f, _| set(f, CAMERAS, 0, &8u64.to_le_bytes()), &["cameras.bin", "56 bytes follow the last entry"]),
    (|f, _| set(f, CAMERAS, 12, &99i32.to_le_bytes()), &["camera 7", "unknown model number 99", "0 to 17"]),
    (|f, _| set(f, CAMERAS, 12, &(-1i32).to_le_bytes()), &["camera 7", "unknown model number -1"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 16, 16, 12, vec![9.0; 6])])), &["camera 7", "EUCM"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 17, 16, 12, vec![9.0; 2])])), &["camera 7", "EQUIRECTANGULAR"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 1, 16, 12, vec![f64::NAN, 9.0, 8.0, 6.0])])), &["camera 7", "NaN"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 1, 16, 12, vec![-9.0, 9.0, 8.0, 6.0])])), &["camera 7", "-9"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 1, 0, 12, vec![9.0; 4])])), &["camera 7", "0 x 12 pixels"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 1, 1 << 40, 12, vec![9.0; 4])])), &["camera 7", "1099511627776 x 12"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&vec![(7, 1, 16, 12, vec![9.0; 4]); 2])), &["camera 7 is listed twice"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[(7, 2, 16, 12, vec![9.0, 8.0, 6.0, -3.0])])), &["camera 7", "folds over"]),
    (|f, v| f.write(CAMERAS, cameras_bin(&[pinhole(7, &v[0].camera)])), &["r_1.png has camera 8", "does not list"]),
    (|f, _| f.write(CAMERAS, cameras_bin(&[])), &["r_0.png has camera 7"]),
    (|f, _| cut(f, IMAGES, 4), &["images.bin", "ends within images"]),
    (|f, _| cut(f, IMAGES, 8 + 40), &["images.bin", "9 images, and 40 bytes"]),
    (|f, _| cut(f, IMAGES, 8 + 8 * 128 + 67), &["images.bin", "ends within the name"]),
    (|f, _| cut(f, IMAGES, 8 + 9 * 128 - 50), &["images.bin", "ends within points of an image"]),
    (|f, _| cut(f, IMAGES, 8 + 9 * 128 - 1), &["images.bin", "2 points of an image, and 47 bytes"]),
    (|f, _| set(f, IMAGES, 8 + 72, &(u64::MAX / 12).to_le_bytes()), &["images.bin", "points of an image"]),
    (|f, _| set(f, IMAGES, 12, &f64::NAN.to_le_bytes()), &["r_0.png", "rotation (NaN"]),
    (|f, _| set(f, IMAGES, 12, &[0; 32]), &["r_0.png", "rotation (0, 0, 0, 0)", "length 1"]),
    (|f, _| set(f, IMAGES, 44, &f64::INFINITY.to_le_bytes()), &["r_0.png", "translation [inf"]),
    (|f, _| set(f, IMAGES, 72, b"a//////"), &["an image has no name"]),
    (|f, _| set(f, IMAGES, 128 + 72, b"r_0.png"), &["r_0.png has two cameras"]),
    (|f, _| f.write(IMAGES, images_bin(&[])), &["there is no view"]),
    (|f, _| remove(&f.path(IMAGES)), &["no format is recognized", "cameras.bin and images.bin"]),
    (|f, _| cut(f, POINTS, 7), &["points3D.bin", "ends within points"]),
    (|f, _| cut(f, POINTS, 8 + 30), &["points3D.bin", "50 points, and 30 bytes"]),
    (|f, _| cut(f, POINTS, 8 + 50 * 59 - 3), &["points3D.bin", "images of a point, and 5 bytes"]),
    (|f, _| set(f, POINTS, 8 + 43, &u64::MAX.to_le_bytes()), &["points3D.bin", "images of a point"]),
    (|f, _| std::fs::remove_dir_all(f.path("images")).unwrap(), &["no folder of images"]),
    (|f, v| v[..6].iter().for_each(|v| remove(&f.path(&format!("images/{}.png", v.name)))), &["6 of 9 images do not exist", "r_0.png"]),
    (
        |f, v| f.images("images", &[View { image: image::rotated(&v[0]), ..v[0].clone() }]),
        &["12 x 16 pixels, but its camera 16 x 12", "turn"],
    ),
    (|f, _| f.write("images/r_4.png", b"not an image"), &["r_4.png"]),
];

/// Broken text files of COLMAP.
const TEXT: &[Broken] = &[
    (|f, _| f.edit("sparse/0/cameras.txt", "PINHOLE", "PINHOL"), &["cameras.txt: line 2", "unknown model \"PINHOL\"", "SIMPLE_PINHOLE"]),
    (|f, _| f.edit("sparse/0/cameras.txt", "PINHOLE", "OPENCV"), &["cameras.txt", "camera 7", "4 parameters", "8 of the model OPENCV"]),
    (|f, _| f.edit("sparse/0/cameras.txt", "16 12", "16 twelve"), &["line 2", "height is \"twelve\""]),
    (|f, _| f.edit("sparse/0/cameras.txt", "16 12", "nan 12"), &["line 2", "width is \"nan\""]),
    (|f, _| f.edit("sparse/0/images.txt", " 7 r_0.png", ""), &["images.txt: line 2", "there is no number of the camera"]),
    (|f, _| f.edit("sparse/0/images.txt", "100 ", "100 -nan(ind) "), &["images.txt: line 2", "rotation"]),
    (|f, _| f.write("sparse/0/images.txt", [0xff, 0x00, 0x80]), &["images.txt", "UTF-8"]),
    (|f, _| f.edit("sparse/0/points3D.txt", "10 20 30", "10 20 300"), &["points3D.txt: line 1", "blue is \"300\""]),
];

/// Broken LLFF captures.
const LLFF: &[Broken] = &[
    (|f, _| cut(f, "poses_bounds.npy", 5), &["poses_bounds.npy", "not a NumPy file"]),
    (|f, _| cut(f, "poses_bounds.npy", 30), &["ends within its header"]),
    (|f, _| cut(f, "poses_bounds.npy", 300), &["9 x 17 numbers, but the file"]),
    (|f, _| f.write("poses_bounds.npy", npy("<f4", "False", "(1, 17)", &[0.0; 17])), &["of type '<f4'", "float64"]),
    (|f, _| f.write("poses_bounds.npy", npy("<f8", "True", "(1, 17)", &[0.0; 17])), &["not in C order"]),
    (|f, _| f.write("poses_bounds.npy", npy("<f8", "False", "(1, 14)", &[0.0; 14])), &["14 columns", "expected 17"]),
    (|f, _| f.write("poses_bounds.npy", npy("<f8", "False", "(1, 17)", &[f64::NAN; 17])), &["row 0 has the number NaN"]),
    (|f, _| f.write("poses_bounds.npy", npy("<f8", "False", "(1, 17)", &[1.0; 17])), &["row 0 is not a rotation"]),
    (|f, v| f.write("poses_bounds.npy", poses_npy(&v[..8], [1.0, 2.0])), &["8 poses, but 9 images"]),
    (|f, _| f.write("sparse/0/cameras.txt", "1 SIMPLE_RADIAL 16 12 ten 8 6 0"), &["cameras.txt", "line 1", "\"ten\""]),
];

/// Broken transforms.json files.
const JSON: &[Broken] = &[
    (|f, _| cut(f, "transforms.json", 200), &["transforms.json", "ends early"]),
    (|f, _| f.edit("transforms.json", "\"frames\"", "\"views\""), &["no list \"frames\""]),
    (|f, _| f.edit("transforms.json", "file_path", "path"), &["frame 0 has no key \"file_path\""]),
    (
        |f, _| f.edit("transforms.json", "\"transform_matrix\": [[", "\"transform_matrix\": [[9, "),
        &["transform_matrix of frame 0", "5 numbers"],
    ),
    (|f, _| f.edit("transforms.json", "\"transform_matrix\": [[", "\"transform_matrix\": [[0, 0, 0, 0], ["), &["has 5 rows"]),
    (|f, _| f.edit("transforms.json", "\"fl_x\": ", "\"fl_x\": -"), &["fl_x is -", "positive"]),
    (
        |f, _| {
            f.edit("transforms.json", "\"fl_x\"", "\"f_x\"");
            f.edit("transforms.json", "\"fl_y\"", "\"f_y\"");
        },
        &["frame 0 has no focal length", "camera_angle_x"],
    ),
    (|f, _| f.edit("transforms.json", "\"w\": 16.0", "\"w\": 16.5"), &["w is 16.5"]),
    (|f, _| f.edit("transforms.json", "\"w\": 16.0", "\"w\": 10.0"), &["16 x 12 pixels, but its camera 10 x 12"]),
    (|f, _| f.edit("transforms.json", "\"w\"", "\"camera_model\": \"ORTHOPHOTO\", \"w\""), &["frame 0", "ORTHOPHOTO", "OPENCV_FISHEYE"]),
    (|f, _| f.edit("transforms.json", "\"w\"", "\"k1\": \"big\", \"w\""), &["k1 is \"big\""]),
    (|f, _| f.edit("transforms.json", "\"w\"", "\"rolling_shutter\": [0, 0, 1, 0], \"w\""), &["rolling_shutter is", "not supported"]),
    (|f, _| f.edit("transforms.json", "\"w\"", "\"k1\": -30, \"w\""), &["camera of images/r_0.png", "folds over"]),
    (|f, _| f.edit("transforms.json", "r_1.png", "r_0.png"), &["images/r_0.png has two cameras"]),
    (|f, _| f.edit("transforms.json", "\"w\"", "\"test_filenames\": [3], \"w\""), &["test_filenames is 3"]),
    (
        |f, v| write_transforms(f, &v.iter().map(|w| View { camera: v[0].camera, ..w.clone() }).collect::<Vec<_>>()),
        &["9 cameras are at one point"],
    ),
];

/// Broken NSVF captures.
const NSVF: &[Broken] = &[
    (|f, _| f.write("intrinsics.txt", ""), &["intrinsics.txt", "no matrix of intrinsics"]),
    (|f, _| f.write("intrinsics.txt", "nan 0 8 0"), &["intrinsics.txt", "line 1 has \"nan\""]),
    (|f, _| f.write("pose/2_r_0.txt", "1 0 0\n0 1 0\n0 0 1"), &["2_r_0.txt", "no 4 x 4 matrix"]),
    (|f, _| f.write("pose/2_r_0.txt", "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"), &["2_r_0.txt", "not a rotation"]),
];

#[test]
fn each_broken_capture_is_refused_with_the_file_and_the_reason() {
    let views = views();
    let (mut count, mut failures) = (0, Vec::new());
    for ((format, write), table) in WRITERS.into_iter().zip([JSON, BINARY, TEXT, LLFF, NSVF]) {
        for (number, (damage, words)) in table.iter().enumerate() {
            let folder = Folder::new();
            write(&folder, &views);
            damage(&folder, &views);
            count += 1;
            match open(&folder) {
                Ok(_) => failures.push(format!("{format} {number}: was opened, expected {words:?}")),
                Err(error) => {
                    let message = error.to_string();
                    println!("{format:16} {} {}", error.exit_code(), message.replace(&folder.0.display().to_string(), "DATA"));
                    if error.exit_code() != 3 || words.iter().any(|word| !message.contains(word)) {
                        failures.push(format!("{format} {number}: {words:?} in {message}"));
                    }
                }
            }
        }
    }
    assert!(count >= 70 && failures.is_empty(), "{count} captures; {}", failures.join("\n"));
}

mod image {
    use plenoxel::dataset::View;
    use plenoxel::dataset::image::RgbaImage;

    /// The image turned by 90 degrees.
    pub fn rotated(view: &View) -> RgbaImage {
        let (width, height) = view.image.dimensions();
        RgbaImage::from_fn(height, width, |x, y| *view.image.get_pixel(y, height - 1 - x))
    }
}
