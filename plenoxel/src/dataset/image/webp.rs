//! Headers of WebP files.

use super::MAX_SIDE;
use super::decode::{cut_short, refused};
use crate::error::{Error, Result};
use ::image::ImageDecoder;
use ::image::codecs::webp::WebPDecoder;
use ::image::metadata::Orientation;
use std::io::{BufRead, Seek, SeekFrom};
use std::path::Path;

/// Most pixels of a file, and most further pixels for each of its bytes. An image of one color takes no bytes at all for its pixels, so the
/// first number bounds the memory that a header can request.
const MOST_PIXELS: [u64; 2] = [1 << 22, 1024];

/// Reads everything before the pixels: the decoder, width and height as stored, and the orientation by EXIF.
pub fn open<R: BufRead + Seek>(path: &Path, mut source: R) -> Result<(WebPDecoder<R>, (u32, u32), Orientation)> {
    let mut head = [0; 8];
    let length = source.seek(SeekFrom::End(0)).and_then(|length| {
        source.rewind()?;
        source.read_exact(&mut head)?;
        source.rewind().map(|()| length)
    });
    let length = length.map_err(|e| refused(path, e.into()))?;
    let stated = 8 + u64::from(u32::from_le_bytes([head[4], head[5], head[6], head[7]]));
    if length < stated {
        return Err(cut_short(path, "WebP"));
    }
    let mut decoder = WebPDecoder::new(source).map_err(|e| refused(path, e))?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 || width.max(height) > MAX_SIDE {
        let found = format!("the header says {width} x {height} pixels");
        return Err(Error::input(path, found, format!("expected an image of 1 to {MAX_SIDE} pixels per side")));
    }
    if u64::from(width) * u64::from(height) > MOST_PIXELS[0] + MOST_PIXELS[1] * length {
        let found = format!("the header says {width} x {height} pixels, in {length} bytes");
        return Err(Error::input(path, found, "write it as PNG, or copy or download it again"));
    }
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok((decoder, (width, height), orientation))
}
