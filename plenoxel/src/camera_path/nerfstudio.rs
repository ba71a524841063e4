//! nerfstudio's `camera_path.json`: every frame, as `get_path_from_json` in its `camera_paths.py` reads them.

use super::{CameraPath, Entries, Entry, Format, Fov, Shot};
use crate::dataset::blender::rigid;
use crate::error::{Error, Result};

pub(super) fn read(file: &Entry<'_>) -> Result<CameraPath> {
    let kind = file.value.get("camera_type");
    if kind.is_some_and(|kind| !kind.as_str().is_some_and(|kind| kind.eq_ignore_ascii_case("perspective"))) {
        return Err(file.wrong("camera_type", "`perspective`"));
    }
    let size = file.size("render_width", "render_height")?;
    let fps = file.optional("fps", |fps| (0.1..=1000.0).contains(&fps), "frames per second from 0.1 to 1000")?;
    let shots: Result<Vec<Shot>> = file.list("camera_path", "frame")?.map(|frame| shot(&frame)).collect();
    Ok(CameraPath { format: Format::Nerfstudio, size, fps, entries: Entries::Frames(shots?) })
}

fn shot(frame: &Entry<'_>) -> Result<Shot> {
    const FIELD: &str = "camera_to_world";
    let numbers: [f64; 16] = frame.numbers(FIELD, "a list of 16 finite numbers, row by row")?;
    let (rows, _) = numbers.as_chunks::<4>();
    let rows = [rows[0], rows[1], rows[2], rows[3]];
    let camera_to_world =
        rigid(rows).map_err(|(found, remedy)| Error::input(frame.path, format!("`{FIELD}`{} {found}", frame.place), remedy))?;
    Ok(Shot { camera_to_world: frame.near_enough(FIELD, camera_to_world)?, fov: Fov::Vertical(frame.fov()?) })
}
