//! The readers of captures, as entries of `PARSERS`.

use super::{MIB, Parser, Then, nothing, text};
use glam::{DMat3, DQuat, DVec3};
use plenoxel::dataset::{colmap, llff, nsvf, transforms};
use std::path::Path;

pub const PARSERS: [Parser; 10] = [
    Parser {
        name: "transforms.json",
        valid: || [super::transforms(), captures()].concat(),
        read: read_capture,
        repair: |_| (),
        memory: [MIB, 400],
    },
    Parser { name: "cameras.bin", valid: || vec![cameras_bin()], read: read_colmap, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "images.bin", valid: || vec![images_bin()], read: read_colmap, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "points3D.bin", valid: || vec![points_bin()], read: read_colmap, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "cameras.txt", valid: || vec![CAMERAS.into()], read: read_colmap, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "images.txt", valid: || vec![IMAGES.into()], read: read_colmap, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "points3D.txt", valid: || vec![POINTS.into()], read: read_colmap, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "poses_bounds.npy", valid: || vec![poses()], read: read_poses, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "intrinsics.txt", valid: intrinsics, read: read_intrinsics, repair: |_| (), memory: [MIB, 400] },
    Parser { name: "pose.txt", valid: || vec![MATRIX.into()], read: read_pose, repair: |_| (), memory: [MIB, 400] },
];

const MATRIX: &str = "1 0 0 0.5\n0 0.8 -0.6 -2.5e-1\n0 0.6 0.8 4\n0 0 0 1\n";
const CAMERAS: &str =
    "# cameras\n1 PINHOLE 16 12 20 21 8 6\n\n7 OPENCV 16 12 20 21 8 6 0.01 -0.02 0.001 0\n3 SIMPLE_FISHEYE 16 12 20 8 6\n";
const IMAGES: &str = "# images\n1 0.6 0 0.8 0 1 -2 3.5 7 a/b c.png\n1.5 2 -1 3 4 9\n2 1 0 0 0 0 0 1e2 1 d.jpg\n\n";
const POINTS: &str = "# points\n1 0.5 -2 1e3 10 20 255 0.7 1 0 2 0\n2 1 2 3 0 0 0 0.1\n";

fn captures() -> Vec<Vec<u8>> {
    let frame = |k: usize, more: &str| {
        let pose = format!("[[1, 0, 0.0, 0], [0, 0.8, -0.6, -2.5e-1], [0, 0.6, 0.8, {k}], [0, 0, 0, 1]]");
        format!("{{\"file_path\": \"./images/{k}.jpg\", {more} \"sharpness\": 30.5, \"transform_matrix\": {pose}}}")
    };
    let ngp = format!(
        "{{\"camera_angle_x\": 0.75, \"fl_x\": 20.5, \"fl_y\": 21, \"k1\": 0.01, \"p2\": -0.001, \"w\": 16.0, \"h\": 12.0, \"aabb_scale\": 4, \
         \"frames\": [{}, {}]}}",
        frame(1, ""),
        frame(2, "\"mask_path\": \"masks/2.png\",")
    );
    let studio = format!(
        "{{\"camera_model\": \"OPENCV_FISHEYE\", \"k1\": 0.1, \"ply_file_path\": \"a.ply\", \"train_filenames\": [\"images/1.jpg\"], \
         \"test_filenames\": [], \"frames\": [{}, {}]}}",
        frame(1, "\"w\": 16, \"h\": 12, \"x_fov\": 60, \"cx\": 8.5,"),
        frame(2, "\"camera_angle_y\": 0.5, \"is_fisheye\": false,")
    );
    vec![ngp.into_bytes(), studio.into_bytes()]
}

fn read_capture(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let read = transforms::Transforms::parse(path, bytes).map_err(text)?;
    Ok(Box::new(move || {
        for frame in read.frames {
            let intrinsics = frame.stated.at(frame.stated.size.unwrap_or((8, 6)));
            assert!(intrinsics.fx > 0.0 && intrinsics.fy > 0.0 && frame.camera_to_world.is_finite(), "{intrinsics:?}");
            // An image whose pixels have no rays is refused.
            let _ = intrinsics.check_lens();
        }
    }))
}

fn numbers(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn cameras_bin() -> Vec<u8> {
    let camera = |id: u32, model: i32, parameters: &[f64]| {
        let head = [id.to_le_bytes(), model.to_le_bytes()].concat();
        [head, [16u64.to_le_bytes(), 12u64.to_le_bytes()].concat(), numbers(parameters)].concat()
    };
    let cameras = [camera(1, 1, &[20.0, 21.0, 8.0, 6.0]), camera(9, 2, &[20.0, 8.0, 6.0, 0.01]), camera(3, 14, &[20.0, 8.0, 6.0])];
    [3u64.to_le_bytes().to_vec(), cameras.concat()].concat()
}

fn images_bin() -> Vec<u8> {
    let q = DQuat::from_mat3(&DMat3::from_rotation_z(0.4));
    let image = |id: u32, name: &[u8], seen: u64| {
        let pose = numbers(&[q.w, q.x, q.y, q.z, 0.5, -1.0, 2.0]);
        let points = numbers(&vec![1.5; 3 * seen as usize]);
        [&id.to_le_bytes()[..], &pose, &1u32.to_le_bytes(), name, &seen.to_le_bytes(), &points].concat()
    };
    [2u64.to_le_bytes().to_vec(), image(1, b"a.png\0", 2), image(5, b"folder/b.jpg\0", 0)].concat()
}

fn points_bin() -> Vec<u8> {
    let point = |id: u64, p: DVec3, track: u64| {
        let seen = vec![1u8; 8 * track as usize];
        [&id.to_le_bytes()[..], &numbers(&p.to_array()), &[1, 2, 250], &numbers(&[0.5]), &track.to_le_bytes(), &seen].concat()
    };
    [2u64.to_le_bytes().to_vec(), point(3, DVec3::X, 2), point(4, DVec3::new(1.0, f64::NAN, 0.0), 0)].concat()
}

fn read_colmap(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    colmap::parse(path, bytes).map(|_| nothing()).map_err(text)
}

fn poses() -> Vec<u8> {
    let row = [0.0, 1.0, 0.0, 0.5, 12.0, -1.0, 0.0, 0.0, 0.25, 16.0, 0.0, 0.0, 1.0, -3.0, 20.0, 1.5, 9.0];
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 17), }                                  \n";
    [&b"\x93NUMPY\x01\x00"[..], &(header.len() as u16).to_le_bytes(), header.as_bytes(), &numbers(&row), &numbers(&row)].concat()
}

fn read_poses(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let poses = llff::parse(path, bytes).map_err(text)?;
    assert!(poses.iter().all(|pose| pose.camera_to_world.is_finite() && pose.intrinsics.fx > 0.0));
    Ok(nothing())
}

fn intrinsics() -> Vec<Vec<u8>> {
    vec![b"20 0 8 0\n0 21 6 0\n0 0 1 0\n0 0 0 1\n".to_vec(), b"20.5 8 6 0.\n0. 0. 0.\n0.\n1.\n16 12\n".to_vec()]
}

fn read_intrinsics(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    nsvf::intrinsics(path, bytes).map(|_| nothing()).map_err(text)
}

fn read_pose(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let pose = nsvf::pose(path, bytes).map_err(text)?;
    assert!(pose.is_finite());
    Ok(nothing())
}
