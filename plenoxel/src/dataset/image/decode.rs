//! Image files of several formats, decoded to 8-bit RGBA. The format is recognized by the first bytes of a file, not by its name.

#[cfg(test)]
mod tests;

use super::{jpeg, rows, webp};
use crate::error::{Error, Result};
use crate::files;
use crate::memory;
use ::image::{DynamicImage, ImageDecoder, ImageError, RgbaImage, metadata};
use std::io::{BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::Path;

/// Treatment of the orientation that a file states (EXIF, of JPEG and WebP).
///
/// COLMAP, and programs that pass its cameras on, ignore the orientation: their cameras belong to the image as stored. Which one a camera
/// belongs to can be told by its size, unless the image is square or upside down.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Orientation {
    /// As the file states, as viewers show it.
    #[default]
    Stated,
    /// As it is stored.
    Stored,
}

/// Returns width and height of an image file without decoding it; see [`size_as`]. It is turned as the file states.
pub fn size(path: &Path) -> Result<(usize, usize)> {
    size_as(path, Orientation::Stated)
}

/// Returns width and height of the PNG, JPEG or WebP file `path`, after it is turned, without decoding it: reads the header, and the end of
/// the file.
///
/// A file without the end of its format is examined at once, so that a truncated file is reported when the dataset is opened, not hours
/// later; its pixels are not kept. Errors if the file is missing, not a regular file, of another format, truncated, empty, larger than
/// [`MAX_SIDE`](super::MAX_SIDE), or has more pixels than its size allows.
pub fn size_as(path: &Path, orientation: Orientation) -> Result<(usize, usize)> {
    let mut file = files::open(path, files::IMAGE)?;
    match Format::of(path, &mut file)? {
        Format::Png => rows::size_of_whole(path, file),
        Format::Jpeg => {
            let header = jpeg::Header::read(path, &mut BufReader::new(&mut file))?;
            let mut end = [0; 2];
            let is_whole = file.seek(SeekFrom::End(-2)).and_then(|_| file.read_exact(&mut end)).is_ok() && end == jpeg::END;
            if !is_whole {
                jpeg::check_whole(path, &files::read(path, files::IMAGE)?)?;
            }
            Ok(turned((header.width, header.height), header.orientation, orientation))
        }
        Format::Webp => webp::open(path, BufReader::new(file)).map(|(_, size, stated)| turned(size, stated, orientation)),
    }
}

/// Decodes an image file; see [`read_as`]. It is turned as the file states.
pub fn read(path: &Path) -> Result<RgbaImage> {
    read_as(path, Orientation::Stated)
}

/// Decodes the PNG, JPEG or WebP file `path` (gray, RGB or palette, with or without alpha, of any bit depth) to 8-bit RGBA, and turns it.
/// 16-bit values are rounded. An image without alpha is opaque.
///
/// Memory: 4 bytes per pixel of a PNG of any bit depth; up to 17 bytes per pixel of other formats, while they are decoded. Errors if the file
/// is missing, not a regular file, of another format, truncated, damaged, larger than [`MAX_SIDE`](super::MAX_SIDE), has more pixels than its
/// size allows, or does not fit into memory.
pub fn read_as(path: &Path, orientation: Orientation) -> Result<RgbaImage> {
    let file = files::open(path, files::IMAGE)?;
    picture(path, BufReader::new(file), orientation)
}

/// Decodes the bytes of an image file like [`read`]. `path` names it in error messages.
pub fn decode(path: &Path, bytes: &[u8]) -> Result<RgbaImage> {
    picture(path, Cursor::new(bytes), Orientation::Stated)
}

fn picture(path: &Path, mut source: impl BufRead + Seek, orientation: Orientation) -> Result<RgbaImage> {
    let (image, stated) = match Format::of(path, &mut source)? {
        Format::Png => return rows::picture(path, source),
        Format::Jpeg => {
            let (bytes, header) = jpeg::read(path, source)?;
            // Image, decoded and turned image at once, and the coefficients of a progressive image.
            check_memory(path, (header.width, header.height), 17)?;
            let decoder = ::image::codecs::jpeg::JpegDecoder::new(Cursor::new(bytes)).map_err(|e| refused(path, e))?;
            (decoded(path, decoder)?, header.orientation)
        }
        Format::Webp => {
            let (decoder, size, stated) = webp::open(path, source)?;
            check_memory(path, size, 12)?;
            (decoded(path, decoder)?, stated)
        }
    };
    let mut image = DynamicImage::ImageRgba8(image);
    if orientation == Orientation::Stated {
        image.apply_orientation(stated);
    }
    Ok(image.into_rgba8())
}

fn decoded(path: &Path, decoder: impl ImageDecoder) -> Result<RgbaImage> {
    DynamicImage::from_decoder(decoder).map(DynamicImage::into_rgba8).map_err(|e| refused(path, e))
}

fn check_memory(path: &Path, (width, height): (u32, u32), bytes_per_pixel: u64) -> Result<()> {
    let what = format!("reading an image of {width} x {height} pixels");
    memory::check(path, &what, bytes_per_pixel * u64::from(width) * u64::from(height))
}

/// Returns the size of an image after it is turned.
fn turned((width, height): (u32, u32), stated: metadata::Orientation, orientation: Orientation) -> (usize, usize) {
    // The orientations 5 to 8 exchange rows and columns.
    let is_sideways = orientation == Orientation::Stated && stated.to_exif() >= 5;
    let (width, height) = (width as usize, height as usize);
    if is_sideways { (height, width) } else { (width, height) }
}

pub(super) fn refused(path: &Path, error: ImageError) -> Error {
    match error {
        ImageError::IoError(source) if source.kind() == std::io::ErrorKind::UnexpectedEof => cut_short(path, "image"),
        ImageError::IoError(source) => Error::io(path, source, "reading the image"),
        other => Error::input(path, format!("the image cannot be decoded ({other})"), "write it again as PNG or JPEG"),
    }
}

pub(super) fn cut_short(path: &Path, what: &str) -> Error {
    Error::input(path, format!("the {what} is truncated"), "copy or download the file again")
}

/// Format of an image file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Png,
    Jpeg,
    Webp,
}

impl Format {
    /// Recognizes a format by the first bytes, also if no more than some of them are there. `source` is rewound to the start.
    fn of(path: &Path, source: &mut (impl Read + Seek)) -> Result<Self> {
        let mut head = Vec::with_capacity(12);
        source
            .by_ref()
            .take(12)
            .read_to_end(&mut head)
            .and_then(|_| source.rewind())
            .map_err(|e| Error::io(path, e, "reading the image's header"))?;
        let begins = |signature: &[u8]| !head.is_empty() && signature.starts_with(&head[..head.len().min(signature.len())]);
        let is_riff = begins(b"RIFF") && head.get(8..).is_none_or(|name| b"WEBP".starts_with(name));
        match head.as_slice() {
            _ if begins(&rows::SIGNATURE) => Ok(Format::Png),
            _ if begins(&jpeg::SIGNATURE) => Ok(Format::Jpeg),
            _ if is_riff => Ok(Format::Webp),
            [] => Err(other(path, "the file is empty")),
            [b'G', b'I', b'F', ..] => Err(other(path, "this is a GIF image")),
            [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => Err(other(path, "this is a TIFF or raw image")),
            [_, _, _, _, b'f', b't', b'y', b'p', b'h' | b'm', ..] => Err(other(path, "this is a HEIC image")),
            [_, _, _, _, b'f', b't', b'y', b'p', b'a', ..] => Err(other(path, "this is an AVIF image")),
            _ => Err(other(path, "this is not a PNG, JPEG or WebP image")),
        }
    }
}

fn other(path: &Path, found: &str) -> Error {
    Error::input(path, found, "convert it to PNG or JPEG")
}
