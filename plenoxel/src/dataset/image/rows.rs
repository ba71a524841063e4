//! PNG decoding to 8-bit RGBA, row by row. Memory is needed for the result and one row only.

use super::decode::cut_short;
use crate::error::{Error, Result};
use crate::memory;
use ::image::RgbaImage;
use png::{BitDepth, ColorType, Decoder, DecodingError, InterlaceInfo, Limits, Reader, Transformations};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Largest accepted width or height in pixels. It bounds the memory that a header can request.
pub const MAX_SIDE: u32 = 16384;

pub(super) const SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// Last chunk of every PNG: length 0, name, checksum.
const END: [u8; 12] = *b"\0\0\0\0IEND\xae\x42\x60\x82";
/// Number of bytes up to the bit depth and the color type.
const HEAD: usize = 26;
/// Largest expansion of Deflate: 258 bytes from two bits.
const MOST_INFLATION: u64 = 1032;
/// Memory limit for metadata of a file.
const MOST_BESIDE: usize = 16 << 20;

/// Returns width and height of a PNG file; see [`size_as`](super::size_as). Reads its first 26 bytes and its last 12; a file without the end
/// of a PNG is decoded.
pub(super) fn size_of_whole(path: &Path, mut file: File) -> Result<(usize, usize)> {
    let (width, height) = size(path, &mut file)?;
    let mut tail = [0_u8; END.len()];
    let whole = file.seek(SeekFrom::End(-(END.len() as i64))).and_then(|_| file.read_exact(&mut tail)).is_ok() && tail == END;
    if !whole {
        file.rewind().map_err(|e| Error::io(path, e, "reading the image"))?;
        Rows::new(path, BufReader::new(file))?.check()?;
    }
    Ok((width as usize, height as usize))
}

/// Decodes a PNG.
pub(super) fn picture(path: &Path, mut source: impl BufRead + Seek) -> Result<RgbaImage> {
    let (width, height) = size(path, &mut source)?;
    let rows = Rows::new(path, source)?;
    let bytes = 4 * width as usize * height as usize;
    memory::check(path, &format!("reading an image of {width} x {height} pixels"), bytes as u64)?;
    let mut pixels = Vec::new();
    // Address space may be exhausted before memory is.
    pixels.try_reserve_exact(bytes).map_err(|_| Error::io(path, std::io::ErrorKind::OutOfMemory.into(), "decoding the image"))?;
    pixels.resize(bytes, 0);
    rows.read(&mut pixels)?;
    // The buffer has exactly the size of the image, so this never falls back to the default.
    Ok(RgbaImage::from_raw(width, height, pixels).unwrap_or_default())
}

/// Reads width and height from the first bytes of a file that begins like a PNG. `source` is rewound to the start.
fn size(path: &Path, source: &mut (impl Read + Seek)) -> Result<(u32, u32)> {
    let mut head = Vec::with_capacity(HEAD);
    let read = source.seek(SeekFrom::End(0)).and_then(|length| {
        source.rewind()?;
        source.by_ref().take(HEAD as u64).read_to_end(&mut head)?;
        source.rewind()?;
        Ok(length)
    });
    let length = read.map_err(|e| Error::io(path, e, "reading the image's header"))?;
    if head.len() < HEAD || &head[12..16] != b"IHDR" {
        return Err(cut_short(path, "PNG"));
    }
    let number = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    let (width, height) = (number(16), number(20));
    let refused = |remedy: String| Err(Error::input(path, format!("the header says {width} x {height} pixels"), remedy));
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return refused(format!("expected an image of 1 to {MAX_SIDE} pixels per side"));
    }
    // Gray and palette, RGB, gray with alpha, RGBA.
    let channels = [1, 0, 3, 1, 2, 0, 4].get(usize::from(head[25])).copied().unwrap_or(0);
    let row = (u64::from(width) * channels * u64::from(head[24])).div_ceil(8);
    if row * u64::from(height) > MOST_INFLATION * length {
        return refused(format!("a file of {length} bytes cannot hold as many: copy or download it again"));
    }
    Ok((width, height))
}

/// PNG image that is read row by row.
struct Rows<'p, R: BufRead + Seek> {
    path: &'p Path,
    reader: Reader<R>,
    row: Vec<u8>,
}

impl<'p, R: BufRead + Seek> Rows<'p, R> {
    /// Reads everything before the pixels. `path` names the file in error messages.
    fn new(path: &'p Path, source: R) -> Result<Self> {
        let mut decoder = Decoder::new_with_limits(source, Limits { bytes: MOST_BESIDE });
        decoder.set_ignore_text_chunk(true);
        decoder.set_ignore_iccp_chunk(true);
        // Expand palettes and depths below 8 bits to 8 bits, and a transparent color to alpha.
        decoder.set_transformations(Transformations::EXPAND);
        let reader = decoder.read_info().map_err(|e| refused(path, e))?;
        // The decoder panics at the first row of such an image (png 0.18.1, issue 694).
        if reader.info().palette.as_ref().is_some_and(|colors| !colors.len().is_multiple_of(3)) {
            return Err(Error::input(path, "the palette ends within a color", "write it again as PNG"));
        }
        Ok(Rows { path, reader, row: Vec::new() })
    }

    /// Returns the next row, 4 bytes per pixel, and its position. Rows of an interlaced image contain only some of the pixels. `None` at
    /// the end.
    fn next(&mut self) -> Result<Option<(&[u8], InterlaceInfo)>> {
        let (color, depth) = self.reader.output_color_type();
        let Some(row) = self.reader.next_interlaced_row().map_err(|e| refused(self.path, e))? else { return Ok(None) };
        self.row.clear();
        match depth {
            BitDepth::Sixteen => to_rgba(color, row.data().as_chunks::<2>().0, |bytes| rounded(u16::from_be_bytes(bytes)), &mut self.row),
            _ => to_rgba(color, row.data(), |byte| byte, &mut self.row),
        }
        Ok(Some((&self.row, *row.interlace())))
    }

    /// Decodes the image into `pixels`, 4 bytes per pixel.
    fn read(mut self, pixels: &mut [u8]) -> Result<()> {
        let stride = 4 * self.reader.info().width as usize;
        let mut y = 0;
        while let Some((row, place)) = self.next()? {
            match place {
                InterlaceInfo::Null(_) => {
                    pixels.chunks_exact_mut(stride).nth(y).into_iter().for_each(|line| line.copy_from_slice(row));
                    y += 1;
                }
                InterlaceInfo::Adam7(place) => png::expand_interlaced_row(pixels, stride, row, &place, 32),
            }
        }
        Ok(())
    }

    /// Decodes the image without keeping its pixels.
    fn check(mut self) -> Result<()> {
        while self.next()?.is_some() {}
        Ok(())
    }
}

/// Appends pixels of any color type as RGBA. Pixels without alpha are opaque.
fn to_rgba<S: Copy>(color: ColorType, samples: &[S], byte: impl Fn(S) -> u8, rgba: &mut Vec<u8>) {
    match color {
        ColorType::Grayscale | ColorType::Indexed => {
            rgba.extend(samples.iter().map(|&gray| byte(gray)).flat_map(|gray| [gray, gray, gray, 255]))
        }
        ColorType::GrayscaleAlpha => rgba.extend(samples.as_chunks().0.iter().flat_map(|&[gray, alpha]| {
            let gray = byte(gray);
            [gray, gray, gray, byte(alpha)]
        })),
        ColorType::Rgb => rgba.extend(samples.as_chunks().0.iter().flat_map(|&[r, g, b]| [byte(r), byte(g), byte(b), 255])),
        ColorType::Rgba => rgba.extend(samples.iter().map(|&sample| byte(sample))),
    }
}

/// Converts 16 bits to 8: value / 257, rounded to nearest.
fn rounded(value: u16) -> u8 {
    ((u32::from(value) + 128) / 257) as u8
}

fn refused(path: &Path, error: DecodingError) -> Error {
    match error {
        DecodingError::IoError(source) if source.kind() == std::io::ErrorKind::UnexpectedEof => cut_short(path, "PNG"),
        DecodingError::IoError(source) => Error::io(path, source, "reading the image"),
        DecodingError::LimitsExceeded => {
            Error::input(path, "the metadata in the file takes too much memory", "write it again as PNG, without metadata")
        }
        other => Error::input(path, format!("the image cannot be decoded ({other})"), "write it again as PNG"),
    }
}
