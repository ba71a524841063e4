//! Writes captures in the formats that the program reads: the same views as transforms.json, COLMAP (binary and text), LLFF and NSVF.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use plenoxel::camera::Camera;
use plenoxel::dataset::View;
use plenoxel::dataset::image::write_rgba;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// A folder that is removed when the test ends, also when it fails.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new() -> Self {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let unique = format!("plenoxel-captures-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(unique);
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        fs::create_dir_all(self.path(name).parent().unwrap()).unwrap();
        fs::write(self.path(name), bytes).unwrap();
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    /// Replaces text in a file.
    pub fn edit(&self, name: &str, from: &str, to: &str) {
        let text = String::from_utf8(self.read(name)).unwrap();
        assert!(text.contains(from), "{name} has no {from}");
        self.write(name, text.replacen(from, to, 1));
    }

    /// Writes the images of views to a folder.
    pub fn images(&self, folder: &str, views: &[View]) {
        fs::create_dir_all(self.path(folder)).unwrap();
        views.iter().for_each(|view| write_rgba(&self.path(folder).join(format!("{}.png", view.name)), &view.image).unwrap());
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Rows of a camera-to-world matrix.
pub fn rows(pose: &DAffine3) -> [[f64; 4]; 4] {
    let (r, t) = (pose.matrix3.transpose(), pose.translation);
    let row = |axis: DVec3, offset: f64| [axis.x, axis.y, axis.z, offset];
    [row(r.x_axis, t.x), row(r.y_axis, t.y), row(r.z_axis, t.z), [0.0, 0.0, 0.0, 1.0]]
}

/// World-to-camera quaternion (w, x, y, z) and translation with OpenCV axes.
pub fn world_to_camera(camera: &Camera) -> ([f64; 4], [f64; 3]) {
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let rotation = flip * camera.camera_to_world.matrix3.transpose();
    let q = DQuat::from_mat3(&rotation);
    ([q.w, q.x, q.y, q.z], (-(rotation * camera.position())).to_array())
}

/// A camera file's entries: number, model, width, height, parameters.
pub type CameraRow = (u32, i32, u64, u64, Vec<f64>);

/// cameras.bin.
pub fn cameras_bin(rows: &[CameraRow]) -> Vec<u8> {
    let mut bytes = (rows.len() as u64).to_le_bytes().to_vec();
    for (id, model, width, height, parameters) in rows {
        bytes.extend([id.to_le_bytes(), model.to_le_bytes()].concat());
        bytes.extend([width.to_le_bytes(), height.to_le_bytes()].concat());
        parameters.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    }
    bytes
}

/// The PINHOLE camera of a view, with its own number.
pub fn pinhole(id: usize, camera: &Camera) -> CameraRow {
    let k = camera.intrinsics;
    (id as u32, 1, k.width as u64, k.height as u64, vec![k.fx, k.fy, k.cx, k.cy])
}

/// images.bin, of views whose cameras have the numbers 7, 8, 9 ...; each has two points.
pub fn images_bin(views: &[View]) -> Vec<u8> {
    let mut bytes = (views.len() as u64).to_le_bytes().to_vec();
    for (k, view) in views.iter().enumerate() {
        let (q, t) = world_to_camera(&view.camera);
        bytes.extend((100 - k as u32).to_le_bytes());
        q.iter().chain(&t).for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes.extend((7 + k as u32).to_le_bytes());
        bytes.extend(format!("{}.png\0", view.name).bytes());
        bytes.extend(2u64.to_le_bytes());
        (0..2).for_each(|_| bytes.extend([1.5f64.to_le_bytes(), 2.5f64.to_le_bytes(), (-1i64).to_le_bytes()].concat()));
    }
    bytes
}

/// points3D.bin, each point with a track of one image.
pub fn points_bin(points: &[DVec3]) -> Vec<u8> {
    let mut bytes = (points.len() as u64).to_le_bytes().to_vec();
    for (k, point) in points.iter().enumerate() {
        bytes.extend((k as u64).to_le_bytes());
        point.to_array().iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes.extend([10, 20, 30]);
        bytes.extend([0.5f64.to_le_bytes(), 1u64.to_le_bytes()].concat());
        bytes.extend([100u32.to_le_bytes(), 1u32.to_le_bytes()].concat());
    }
    bytes
}

/// Writes `sparse/0` of COLMAP in the binary form.
pub fn write_colmap(folder: &Folder, views: &[View], points: &[DVec3]) {
    folder.images("images", views);
    let cameras: Vec<CameraRow> = views.iter().enumerate().map(|(k, view)| pinhole(7 + k, &view.camera)).collect();
    folder.write("sparse/0/cameras.bin", cameras_bin(&cameras));
    folder.write("sparse/0/images.bin", images_bin(views));
    folder.write("sparse/0/points3D.bin", points_bin(points));
}

/// Writes `sparse/0` of COLMAP in the text form.
pub fn write_colmap_text(folder: &Folder, views: &[View], points: &[DVec3]) {
    folder.images("images", views);
    let (mut cameras, mut images) = ("# Camera list\n".to_owned(), "# Image list\n".to_owned());
    for (k, view) in views.iter().enumerate() {
        let (id, _, width, height, parameters) = pinhole(7 + k, &view.camera);
        let words = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        cameras += &format!("{id} PINHOLE {width} {height} {}\n", words(&parameters));
        let (q, t) = world_to_camera(&view.camera);
        // The list of points may be empty.
        let seen = if k % 2 == 0 { "" } else { "1.5 2.5 -1" };
        images += &format!("{} {} {} {id} {}.png\n{seen}\n", 100 - k, words(&q), words(&t), view.name);
    }
    let points: Vec<String> = points.iter().zip(1..).map(|(p, k)| format!("{k} {} {} {} 10 20 30 0.5 100 1", p.x, p.y, p.z)).collect();
    folder.write("sparse/0/cameras.txt", cameras);
    folder.write("sparse/0/images.txt", images);
    folder.write("sparse/0/points3D.txt", points.join("\n"));
}

/// Writes transforms.json with the intrinsics of the first view.
pub fn write_transforms(folder: &Folder, views: &[View]) {
    folder.images("images", views);
    let k = views[0].camera.intrinsics;
    let frame = |view: &View| {
        let matrix = rows(&view.camera.camera_to_world);
        format!("  {{\"file_path\": \"./images/{}.png\", \"transform_matrix\": {matrix:?}}}", view.name)
    };
    let frames: Vec<String> = views.iter().map(frame).collect();
    let head = format!("\"fl_x\": {}, \"fl_y\": {}, \"cx\": {}, \"cy\": {}", k.fx, k.fy, k.cx, k.cy);
    let size = format!("\"w\": {:?}, \"h\": {:?}, \"aabb_scale\": 4", k.width as f64, k.height as f64);
    folder.write("transforms.json", format!("{{\n {head}, {size},\n \"frames\": [\n{}\n]}}\n", frames.join(",\n")));
}

/// poses_bounds.npy with depths from `bounds`.
pub fn poses_npy(views: &[View], bounds: [f64; 2]) -> Vec<u8> {
    let row = |view: &View| {
        let (m, k) = (rows(&view.camera.camera_to_world), view.camera.intrinsics);
        let last = [k.height as f64, k.width as f64, k.fx];
        let line = move |i: usize| [-m[i][1], m[i][0], m[i][2], m[i][3], last[i]];
        [line(0).as_slice(), &line(1), &line(2), &bounds].concat()
    };
    npy("<f8", "False", &format!("({}, 17)", views.len()), &views.iter().flat_map(row).collect::<Vec<_>>())
}

/// A .npy file.
pub fn npy(kind: &str, fortran_order: &str, shape: &str, values: &[f64]) -> Vec<u8> {
    let header = format!("{{'descr': '{kind}', 'fortran_order': {fortran_order}, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    values.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    bytes
}

/// Writes poses_bounds.npy.
pub fn write_llff(folder: &Folder, views: &[View]) {
    folder.images("images", views);
    folder.write("poses_bounds.npy", poses_npy(views, [2.0, 6.0]));
}

/// Writes a folder of NSVF; every third view is one of the test split.
pub fn write_nsvf(folder: &Folder, views: &[View]) {
    let k = views[0].camera.intrinsics;
    folder.write("intrinsics.txt", format!("{} 0 {} 0\n0 {} {} 0\n0 0 1 0\n0 0 0 1\n", k.fx, k.cx, k.fy, k.cy));
    fs::create_dir_all(folder.path("rgb")).unwrap();
    for (i, view) in views.iter().enumerate() {
        let name = format!("{}_{}", if i % 3 == 0 { 2 } else { 0 }, view.name);
        write_rgba(&folder.path("rgb").join(format!("{name}.png")), &view.image).unwrap();
        let m = rows(&view.camera.camera_to_world);
        let lines = m.map(|[x, y, z, t]| format!("{x} {} {} {t}", -y, -z));
        folder.write(&format!("pose/{name}.txt"), lines.join("\n"));
    }
}

/// Removes a file.
pub fn remove(path: &Path) {
    fs::remove_file(path).unwrap();
}
