//! Binary files of COLMAP, little endian. Every count is compared with what is left of the file before memory is taken.

use super::{Cameras, Image, Point, camera, image};
use crate::camera::lens::colmap::Model;
use crate::error::{Error, Result};
use crate::memory;
use glam::DVec3;
use std::io::{ErrorKind, Read, Seek};
use std::path::Path;

/// Longest accepted name of an image, which is the limit of common systems.
const LONGEST_NAME: usize = 4096;

/// A file of known length that is read from its beginning to its end.
pub(super) struct Source<'p, R> {
    path: &'p Path,
    reader: R,
    left: u64,
}

impl<'p, R: Read + Seek> Source<'p, R> {
    pub(super) fn new(path: &'p Path, reader: R, length: u64) -> Self {
        Source { path, reader, left: length }
    }

    fn cut(&self, what: &str) -> Error {
        Error::input(self.path, format!("the file ends within {what}"), "copy the file again, or let COLMAP write it again")
    }

    fn take<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        self.left = self.left.checked_sub(N as u64).ok_or_else(|| self.cut(what))?;
        self.reader.read_exact(&mut bytes).map_err(|e| match e.kind() {
            ErrorKind::UnexpectedEof => self.cut(what),
            _ => Error::io(self.path, e, "reading the file"),
        })?;
        Ok(bytes)
    }

    fn u32(&mut self, what: &str) -> Result<u32> {
        self.take(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> Result<u64> {
        self.take(what).map(u64::from_le_bytes)
    }

    fn numbers<const N: usize>(&mut self, what: &str) -> Result<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take(what)?);
        }
        Ok(numbers)
    }

    /// Reads a count of entries of at least `size` bytes each.
    fn count(&mut self, size: u64, what: &str) -> Result<u64> {
        let count = self.u64(what)?;
        if count > self.left / size {
            let found = format!("the file has {count} {what}, and {} bytes are left for them", self.left);
            return Err(Error::input(self.path, found, "copy the file again, or let COLMAP write it again"));
        }
        Ok(count)
    }

    /// Skips a list, whose entries have `size` bytes.
    fn skip_list(&mut self, size: u64, what: &str) -> Result<()> {
        let bytes = size * self.count(size, what)?;
        self.left -= bytes;
        // At most the length of the file, which is far from overflow.
        self.reader.seek_relative(bytes as i64).map_err(|e| Error::io(self.path, e, "reading the file"))
    }

    fn name(&mut self) -> Result<String> {
        let mut bytes = Vec::new();
        loop {
            match self.take::<1>("the name of an image")? {
                [0] => return Ok(String::from_utf8_lossy(&bytes).into_owned()),
                [byte] if bytes.len() < LONGEST_NAME => bytes.push(byte),
                _ => return Err(Error::input(self.path, "the name of an image does not end", "let COLMAP write the file again")),
            }
        }
    }

    fn end(&self) -> Result<()> {
        if self.left == 0 {
            return Ok(());
        }
        Err(Error::input(self.path, format!("{} bytes follow the last entry", self.left), "let COLMAP write the file again"))
    }
}

/// Parses cameras.bin.
pub(super) fn cameras(mut source: Source<'_, impl Read + Seek>) -> Result<Cameras> {
    let mut cameras = Cameras::new();
    for _ in 0..source.count(24, "cameras")? {
        let id = source.u32("a camera")?;
        let number = source.u32("a camera")? as i32;
        let size = [source.u64("a camera")?, source.u64("a camera")?];
        let Some(model) = Model::with_id(number) else {
            let found = format!("camera {id} has the unknown model number {number}");
            return Err(Error::input(source.path, found, "expected a model of COLMAP, 0 to 17"));
        };
        let parameters: Vec<f64> = (0..model.parameters).map(|_| Ok(source.numbers::<1>("a camera")?[0])).collect::<Result<_>>()?;
        if cameras.insert(id, camera(source.path, id, model, size, &parameters)?).is_some() {
            return Err(Error::input(source.path, format!("camera {id} is listed twice"), "let COLMAP write the file again"));
        }
    }
    source.end()?;
    Ok(cameras)
}

/// Parses images.bin.
pub(super) fn images(mut source: Source<'_, impl Read + Seek>) -> Result<Vec<Image>> {
    let count = source.count(73, "images")?;
    let mut images = Vec::new();
    for _ in 0..count {
        source.u32("an image")?;
        let (rotation, translation) = (source.numbers("an image")?, source.numbers("an image")?);
        let camera = source.u32("an image")?;
        let name = source.name()?;
        source.skip_list(24, "points of an image")?;
        images.push(image(source.path, &name, camera, rotation, translation)?);
    }
    source.end()?;
    Ok(images)
}

/// Parses points3D.bin.
pub(super) fn points(mut source: Source<'_, impl Read + Seek>) -> Result<Vec<Point>> {
    let count = source.count(51, "points")?;
    memory::check(source.path, &format!("reading {count} points"), count * size_of::<Point>() as u64)?;
    let mut points = Vec::new();
    for _ in 0..count {
        source.u64("a point")?;
        let position = DVec3::from_array(source.numbers("a point")?);
        let color = source.take("a point")?;
        source.numbers::<1>("a point")?;
        source.skip_list(8, "images of a point")?;
        if position.is_finite() {
            points.push(Point { position, color });
        }
    }
    source.end()?;
    Ok(points)
}
