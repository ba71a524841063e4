//! Writes a dataset as a NeRF-synthetic folder.

use super::file_name;
use crate::camera::Intrinsics;
use crate::camera::lens::Lens;
use crate::dataset::{Dataset, Split, View, image};
use crate::error::{Error, Result};
use crate::files;
use glam::{DAffine3, DVec3};
use ndarray::Array2;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::path::Path;

/// Writes `dataset` to the folder `root`; see [`Dataset::write_blender_changed`].
pub fn write(dataset: &Dataset, root: &Path, overwrite: bool, change: &dyn Fn(Split, &mut [View])) -> Result<()> {
    let occupied = root.exists() && !std::fs::read_dir(root).is_ok_and(|mut entries| entries.next().is_none());
    if occupied && !overwrite {
        return Err(Error::input(root, "the folder is not empty", "choose a new folder, or allow overwriting"));
    }
    for split in Split::ALL {
        let cameras = dataset.cameras(split);
        if let Some(odd) = cameras.iter().position(|camera| !expressible(&camera.intrinsics) || camera.intrinsics != cameras[0].intrinsics)
        {
            let found = format!("{split} view {odd} has intrinsics that the NeRF-synthetic format cannot express");
            return Err(Error::input(root, found, "expected one pinhole camera with square pixels and a centred principal point"));
        }
        files::create_dir(&root.join(split.to_string()))?;
        let mut views = dataset.load(split, &|_, _| ())?;
        change(split, &mut views);
        let written: Vec<Result<()>> = views
            .par_iter()
            .map(|view| {
                let folder = root.join(split.to_string());
                if let (Split::Test, Some(depth)) = (split, &view.depth) {
                    image::write_gray16(&folder.join(format!("{}_depth_0000.png", view.name)), &millimetres(depth))?;
                }
                image::write_rgba(&folder.join(format!("{}.png", view.name)), &view.image)
            })
            .collect();
        written.into_iter().collect::<Result<()>>()?;
        // The JSON file is written last: a folder that contains it has all the images it lists.
        if let Some(first) = cameras.first() {
            let frames: Vec<Value> = views
                .iter()
                .map(|view| json!({ "file_path": format!("./{split}/{}", view.name), "transform_matrix": rows(&view.camera.camera_to_world) }))
                .collect();
            let index = json!({ "camera_angle_x": first.intrinsics.fov_x(), "frames": frames });
            files::write_atomically(&file_name(root, split), format!("{index:#}\n").as_bytes())?;
        }
    }
    Ok(())
}

fn expressible(k: &Intrinsics) -> bool {
    k.lens == Lens::Pinhole && k.fx == k.fy && k.cx == 0.5 * k.width as f64 && k.cy == 0.5 * k.height as f64
}

pub(super) fn rows(pose: &DAffine3) -> [[f64; 4]; 4] {
    let row = |axis: DVec3, offset: f64| [axis.x, axis.y, axis.z, offset];
    let r = pose.matrix3.transpose();
    let t = pose.translation;
    [row(r.x_axis, t.x), row(r.y_axis, t.y), row(r.z_axis, t.z), [0.0, 0.0, 0.0, 1.0]]
}

/// Converts distances to thousandths of a world unit; 0 for rays that hit nothing.
fn millimetres(depth: &Array2<f32>) -> Array2<u16> {
    depth.mapv(|t| if t.is_finite() { (t * 1000.0).round() as u16 } else { 0 })
}
