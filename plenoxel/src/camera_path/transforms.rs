//! Cameras of a `transforms.json`, as in NeRF-synthetic scenes, instant-ngp and nerfstudio.
//!
//! A field of view is read in the order of instant-ngp (`read_focal_length` in its `nerf_loader.cu`): `x_fov` in degrees, `fl_x` and `w` in
//! pixels, `camera_angle_x` in radians, then the corresponding keys for y; first in the frame, then in the file.

use super::{CameraPath, Entries, Entry, Format, Fov, Shot};
use crate::camera::is_angle_of_view;
use crate::dataset::blender::pose;
use crate::error::{Error, Result};

pub(super) fn read(file: &Entry<'_>) -> Result<CameraPath> {
    let size = file.size("w", "h")?;
    let common = fov(file, None)?;
    let shots: Result<Vec<Shot>> = file.list("frames", "frame")?.map(|frame| shot(&frame, size, common)).collect();
    Ok(CameraPath { format: Format::Transforms, size, fps: None, entries: Entries::Frames(shots?) })
}

fn shot(frame: &Entry<'_>, size: Option<(usize, usize)>, common: Option<Fov>) -> Result<Shot> {
    const FIELD: &str = "transform_matrix";
    let matrix = frame.value.get(FIELD).ok_or_else(|| frame.wrong(FIELD, "a 4 x 4 camera-to-world matrix"))?;
    let camera_to_world =
        pose(matrix).map_err(|(found, remedy)| Error::input(frame.path, format!("`{FIELD}`{} {found}", frame.place), remedy))?;
    let fov = fov(frame, size)?.or(common);
    let fov = fov.ok_or_else(|| frame.wrong("camera_angle_x", "an angle of view in radians, in the frame or for all frames"))?;
    Ok(Shot { camera_to_world: frame.near_enough(FIELD, camera_to_world)?, fov })
}

/// Reads the field of view of a frame or of the file. `size` is the image size of the file, for frames without a size.
fn fov(entry: &Entry<'_>, size: Option<(usize, usize)>) -> Result<Option<Fov>> {
    let (width, height) = entry.size("w", "h")?.or(size).unzip();
    for (degrees, focal, radians, side, kind) in [
        ("x_fov", "fl_x", "camera_angle_x", width, Fov::Horizontal as fn(f64) -> Fov),
        ("y_fov", "fl_y", "camera_angle_y", height, Fov::Vertical),
    ] {
        if let Some(angle) = entry.optional(degrees, |a| is_angle_of_view(a.to_radians()), "an angle in degrees, above 0 and below 180")? {
            return Ok(Some(kind(angle.to_radians())));
        }
        if let Some(side) = side
            && let Some(focal) = entry.optional(focal, |f| (1e-3..=1e9).contains(&f), "a focal length in pixels")?
        {
            return Ok(Some(kind(2.0 * (0.5 * side as f64 / focal).atan())));
        }
        if let Some(angle) = entry.optional(radians, is_angle_of_view, "an angle in radians, above 0 and below pi")? {
            return Ok(Some(kind(angle)));
        }
    }
    Ok(None)
}
