//! Thumbnails of a run: the first test view, from the pictures in its folder.

use super::figures::{Figures, Measured};
use crate::images::part;
use plenoxel::dataset::image::{self as files, RgbaImage};

/// A photograph, and its rendering.
#[derive(Default)]
pub struct Thumbnails {
    pub target: Option<RgbaImage>,
    pub render: Option<RgbaImage>,
}

/// Reads the thumbnails of a run; pictures that are missing or unreadable are left out.
pub fn of(run: &Measured) -> Thumbnails {
    let images = run.folder.images();
    let named = |test: &dyn Fn(&str) -> bool| images.iter().find(|path| path.file_name().is_some_and(|name| test(&name.to_string_lossy())));
    let Figures { width: Some(width), height: Some(height), .. } = run.figures else {
        return Thumbnails::default();
    };
    let cut = |strip: &RgbaImage, number: usize| part(strip, number, (width, height));
    let read = |test: &dyn Fn(&str) -> bool| files::read(named(test)?).ok();
    if let Some(panel) = read(&|name| name.starts_with("test_") && name.ends_with(".png")) {
        return Thumbnails { target: cut(&panel, 0), render: cut(&panel, 1) };
    }
    // The strip of a carved run begins with the first test camera.
    let render = read(&|name| name == "carved.png").and_then(|strip| cut(&strip, 0));
    Thumbnails { target: None, render }
}
