//! LLFF: `poses_bounds.npy`, and images in the order of their names (Mildenhall et al. 2019).
//!
//! A row has a 3 x 5 matrix, row by row, and the smallest and the largest depth. The columns of the matrix are the camera's down, right and
//! backward axis, its position, and height, width and focal length in pixels.
//!
//! The file has no lens, and the images are not undistorted. NeRF, Plenoxels and TensoRF take them as pinholes. The lens is in `sparse/0`, the
//! reconstruction from which the file was made: a camera of its `cameras` with the same size and focal length takes the place of the pinhole.

use super::blender::rigid;
use super::capture::{Capture, FARTHEST, ImageFolder, Photo};
use super::{colmap, npy};
use crate::camera::Intrinsics;
use crate::error::{Error, Result};
use crate::files::{self, Kind};
use glam::DAffine3;
use std::path::Path;

/// Name of the file.
pub const FILE: &str = "poses_bounds.npy";
/// The recognized format, as text for people.
const FORMAT: &str = "LLFF (poses_bounds.npy)";
/// The file: up to 100 000 views of 136 bytes.
const POSES: Kind = Kind { name: "a NumPy file of poses", most: 16 << 20, memory: 2 };
/// Largest relative difference of a focal length and that of the reconstruction that it was copied from.
const SAME_FOCAL: f64 = 1e-6;
/// Numbers of a view.
const COLUMNS: usize = 17;

/// A view of a poses_bounds.npy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Intrinsics at the original size.
    pub intrinsics: Intrinsics,
    /// Camera-to-world transform with OpenGL axes.
    pub camera_to_world: DAffine3,
    /// Smallest and largest depth.
    pub bounds: [f64; 2],
}

/// Parses the bytes of a poses_bounds.npy. `path` names it in error messages.
///
/// Errors if the file is damaged or a pose is not a motion, naming the row.
pub fn parse(path: &Path, bytes: &[u8]) -> Result<Vec<Pose>> {
    let table = npy::parse(path, bytes)?;
    if table.columns != COLUMNS {
        let found = format!("the table has {} columns", table.columns);
        return Err(Error::input(path, found, "expected 17: a 3 x 5 matrix, and the smallest and the largest depth"));
    }
    let (rows, _) = table.values.as_chunks::<COLUMNS>();
    rows.iter().enumerate().map(|(k, row)| pose(path, k, row)).collect()
}

fn pose(path: &Path, k: usize, row: &[f64; COLUMNS]) -> Result<Pose> {
    let refused = |found: String, remedy: &str| Error::input(path, format!("row {k} {found}"), remedy);
    if let Some(bad) = row.iter().find(|value| !value.is_finite()) {
        return Err(refused(format!("has the number {bad}"), "expected finite numbers"));
    }
    let at = |i: usize, j: usize| row[5 * i + j];
    let line = |i: usize| [at(i, 1), -at(i, 0), at(i, 2), at(i, 3)];
    let camera_to_world = rigid([line(0), line(1), line(2), [0.0, 0.0, 0.0, 1.0]]).map_err(|(found, remedy)| refused(found, remedy))?;
    let farthest = camera_to_world.translation.abs().max_element();
    if farthest > FARTHEST {
        return Err(refused(format!("puts the camera at {farthest:e}"), "expected coordinates of up to 1e12"));
    }
    let [height, width, focal] = [at(0, 4), at(1, 4), at(2, 4)];
    let is_size = |side: f64| (1.0..=1e6).contains(&side) && side.fract() == 0.0;
    if !is_size(height) || !is_size(width) || focal <= 0.0 {
        let found = format!("has height, width and focal length {height}, {width}, {focal}");
        return Err(refused(found, "expected whole numbers of pixels, and a positive focal length"));
    }
    let intrinsics = Intrinsics::centred(width as usize, height as usize, focal);
    Ok(Pose { intrinsics, camera_to_world, bounds: [row[15], row[16]] })
}

/// Reads the capture in the folder `root`.
pub(super) fn read(root: &Path, downscale: usize) -> Result<Capture> {
    let path = root.join(FILE);
    let poses = parse(&path, &files::read(&path, POSES)?)?;
    let Some(folder) = ImageFolder::find(root, &["images"], downscale) else {
        return Err(Error::input(root, "there is no folder of images", "copy the images to a folder `images` or `images_4`"));
    };
    let names = folder.sorted()?;
    if names.len() != poses.len() {
        let found = format!("there are {} poses, but {} images in {}", poses.len(), names.len(), folder.path.display());
        return Err(Error::input(
            path,
            found,
            "keep exactly the images that have a pose: they belong together by the order of their names",
        ));
    }
    // The poses were made from a reconstruction, and are in its frame.
    let model = root.join("sparse/0");
    let (cameras, points) = (colmap::cameras_in(&model)?, colmap::points_in(&model)?);
    let intrinsics: Vec<_> = poses.iter().map(|pose| reconstructed(&cameras, &pose.intrinsics)).collect();
    let pinholes = intrinsics.iter().filter(|found| found.is_none()).count();
    let mut notes = Vec::new();
    if !cameras.is_empty() && pinholes > 0 {
        notes.push(format!(
            "{pinholes} of {} views are pinholes: {} has no single camera of their size and focal length",
            poses.len(),
            model.display()
        ));
    }
    let near = poses.iter().map(|pose| pose.bounds[0]).fold(f64::INFINITY, f64::min);
    let far = poses.iter().map(|pose| pose.bounds[1]).fold(0.0, f64::max);
    let photos = poses.iter().zip(&names).zip(intrinsics).map(|((pose, name), intrinsics)| Photo {
        name: name.clone(),
        image: folder.path.join(name),
        mask: None,
        intrinsics: intrinsics.unwrap_or(pose.intrinsics),
        camera_to_world: pose.camera_to_world,
        split: None,
    });
    let bounds = (near > 0.0 && far > near).then_some([near, far]);
    Ok(Capture { format: FORMAT, photos: photos.collect(), points, bounds, reduced: folder.reduced, notes, ..Capture::default() })
}

/// Returns the camera of a reconstruction with the size and the focal length of a pinhole. `None` if there is none, or if there are several
/// that differ: the file does not say which belongs to which view.
fn reconstructed(cameras: &colmap::Cameras, pinhole: &Intrinsics) -> Option<Intrinsics> {
    let fits = |camera: &&Intrinsics| {
        (camera.width, camera.height) == (pinhole.width, pinhole.height) && (camera.fx / pinhole.fx - 1.0).abs() < SAME_FOCAL
    };
    let mut fitting = cameras.values().filter(fits);
    let first = *fitting.next()?;
    fitting.all(|camera| *camera == first).then_some(first)
}
