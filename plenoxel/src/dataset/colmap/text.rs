//! Text files of COLMAP. Lines that begin with `#` are comments. An image has two lines; the second, of its points, may be empty.

use super::{Cameras, Image, Point, camera, image};
use crate::camera::lens::colmap::{MODELS, Model};
use crate::error::{Error, Result};
use glam::DVec3;
use std::path::Path;

/// A line with its number.
struct Line<'t> {
    path: &'t Path,
    number: usize,
    fields: std::str::SplitWhitespace<'t>,
}

impl<'t> Line<'t> {
    fn refused(&self, found: impl std::fmt::Display, remedy: &str) -> Error {
        Error::input(self.path, format!("line {}: {found}", self.number), remedy)
    }

    fn word(&mut self, what: &str) -> Result<&'t str> {
        self.fields
            .next()
            .ok_or_else(|| self.refused(format_args!("there is no {what}"), "copy the file again, or let COLMAP write it again"))
    }

    fn value<V: std::str::FromStr>(&mut self, what: &str) -> Result<V> {
        let word = self.word(what)?;
        word.parse().map_err(|_| self.refused(format_args!("the {what} is \"{word}\""), "expected a number"))
    }

    fn numbers<const N: usize>(&mut self, what: &str) -> Result<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.value(what)?;
        }
        Ok(numbers)
    }
}

/// Returns all lines but comments.
fn lines<'t>(path: &'t Path, text: &'t str) -> impl Iterator<Item = Line<'t>> {
    let numbered = text.lines().zip(1..).filter(|(line, _)| !line.trim_start().starts_with('#'));
    numbered.map(move |(line, number)| Line { path, number, fields: line.split_whitespace() })
}

fn is_empty(line: &Line<'_>) -> bool {
    line.fields.clone().next().is_none()
}

/// Parses cameras.txt.
pub(super) fn cameras(path: &Path, text: &str) -> Result<Cameras> {
    let mut cameras = Cameras::new();
    for mut line in lines(path, text).filter(|line| !is_empty(line)) {
        let id: u32 = line.value("number of the camera")?;
        let name = line.word("camera model")?;
        let Some(model) = Model::named(name) else {
            let names = MODELS.map(|model| model.name).join(", ");
            return Err(line.refused(format_args!("camera {id} has the unknown model \"{name}\""), &format!("expected one of {names}")));
        };
        let size = [line.value("width")?, line.value("height")?];
        let words: Vec<&str> = line.fields.clone().collect();
        let parameters = words.iter().map(|_| line.value("parameter")).collect::<Result<Vec<f64>>>()?;
        if cameras.insert(id, camera(path, id, model, size, &parameters)?).is_some() {
            return Err(line.refused(format_args!("camera {id} is listed twice"), "let COLMAP write the file again"));
        }
    }
    Ok(cameras)
}

/// Parses images.txt.
pub(super) fn images(path: &Path, text: &str) -> Result<Vec<Image>> {
    let mut images = Vec::new();
    let mut lines = lines(path, text);
    while let Some(mut line) = lines.next() {
        // Empty lines between images are not COLMAP's, but do not harm.
        if is_empty(&line) {
            continue;
        }
        line.value::<u32>("number of the image")?;
        let (rotation, translation) = (line.numbers("rotation")?, line.numbers("translation")?);
        let camera = line.value("number of the camera")?;
        // A name may have spaces.
        let name = line.fields.by_ref().collect::<Vec<_>>().join(" ");
        images.push(image(path, &name, camera, rotation, translation)?);
        lines.next();
    }
    Ok(images)
}

/// Parses points3D.txt.
pub(super) fn points(path: &Path, text: &str) -> Result<Vec<Point>> {
    let mut points = Vec::new();
    for mut line in lines(path, text).filter(|line| !is_empty(line)) {
        line.value::<u64>("number of the point")?;
        let position = DVec3::from_array(line.numbers("position")?);
        let color = [line.value("red")?, line.value("green")?, line.value("blue")?];
        if position.is_finite() {
            points.push(Point { position, color });
        }
    }
    Ok(points)
}
