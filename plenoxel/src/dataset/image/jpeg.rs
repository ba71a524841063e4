//! Headers of JPEG files: size, orientation, and whether the file has an end. The decoder would fill what is missing with gray.

use super::MAX_SIDE;
use super::decode::cut_short;
use crate::error::{Error, Result};
use crate::memory;
use ::image::metadata::Orientation;
use std::io::{BufRead, Cursor, ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;

pub const SIGNATURE: [u8; 3] = [0xff, START, 0xff];
/// The last marker of a JPEG.
pub const END: [u8; 2] = [0xff, END_OF_IMAGE];

const START: u8 = 0xd8;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;
const APPLICATION_1: u8 = 0xe1;
const EXIF: &[u8] = b"Exif\0\0";
/// Most bytes before the size. Cameras write a preview of less than 64 kB there, some programs up to a few megabytes.
const MOST_BEFORE: u64 = 64 << 20;
/// Most pixels per byte of a file: a block of 8 x 8 pixels takes a bit.
const MOST_PIXELS: u64 = 512;

/// Header of a JPEG.
#[derive(Debug, Clone, Copy)]
pub struct Header {
    /// Width and height as stored.
    pub width: u32,
    pub height: u32,
    /// Orientation by EXIF; as stored if there is none, or if it makes no sense.
    pub orientation: Orientation,
}

impl Header {
    /// Reads the segments up to the size.
    pub fn read(path: &Path, source: &mut (impl BufRead + Seek)) -> Result<Self> {
        let length = source.seek(SeekFrom::End(0)).and_then(|length| source.seek(SeekFrom::Start(2)).map(|_| length));
        let length = length.map_err(|e| failed(path, e))?;
        let mut orientation = None;
        let (mut at, mut exif) = (2, Vec::new());
        loop {
            let (marker, size) = segment(source).map_err(|e| failed(path, e))?;
            at += 4 + u64::from(size);
            match marker {
                // Start of frame, but for the tables and the reserved marker among these numbers.
                0xc0..=0xcf if ![0xc4, 0xc8, 0xcc].contains(&marker) => {
                    let mut frame = [0; 5];
                    source.read_exact(&mut frame).map_err(|e| failed(path, e))?;
                    let [_, h1, h0, w1, w0] = frame.map(u32::from);
                    let orientation = orientation.unwrap_or(Orientation::NoTransforms);
                    return Header { width: w1 << 8 | w0, height: h1 << 8 | h0, orientation }.checked(path, length);
                }
                APPLICATION_1 if orientation.is_none() => {
                    exif.clear();
                    let read = source.take(size.into()).read_to_end(&mut exif).map_err(|e| failed(path, e))?;
                    if read < usize::from(size) {
                        return Err(cut_short(path, "JPEG"));
                    }
                    orientation = exif.strip_prefix(EXIF).and_then(Orientation::from_exif_chunk);
                }
                START_OF_SCAN | END_OF_IMAGE => return Err(damaged(path, "it does not state its size")),
                _ => source.seek_relative(size.into()).map_err(|e| failed(path, e))?,
            }
            if at > MOST_BEFORE {
                return Err(Error::input(path, "the metadata in the file takes too much memory", "write it again, without metadata"));
            }
        }
    }

    fn checked(self, path: &Path, length: u64) -> Result<Self> {
        let Header { width, height, .. } = self;
        let refused = |remedy: String| Err(Error::input(path, format!("the header says {width} x {height} pixels"), remedy));
        if width == 0 || height == 0 || width.max(height) > MAX_SIDE {
            return refused(format!("expected an image of 1 to {MAX_SIDE} pixels per side"));
        }
        if u64::from(width) * u64::from(height) > MOST_PIXELS * length {
            return refused(format!("a file of {length} bytes cannot hold as many: copy or download it again"));
        }
        Ok(self)
    }
}

/// Reads the bytes and the header of a JPEG that has an end.
pub fn read(path: &Path, mut source: impl BufRead + Seek) -> Result<(Vec<u8>, Header)> {
    let header = Header::read(path, &mut source)?;
    let length = source.seek(SeekFrom::End(0)).and_then(|length| source.rewind().map(|()| length)).map_err(|e| failed(path, e))?;
    // The decoder copies the file.
    memory::check(path, &format!("reading {}", memory::bytes(length)), 2 * length)?;
    let mut bytes = Vec::new();
    source.read_to_end(&mut bytes).map_err(|e| failed(path, e))?;
    check_whole(path, &bytes)?;
    Ok((bytes, header))
}

/// Checks that a JPEG has an end. Bytes behind it are no damage.
pub fn check_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut source = Cursor::new(&bytes[bytes.len().min(2)..]);
    loop {
        let (marker, size) = segment(&mut source).map_err(|e| failed(path, e))?;
        if marker == END_OF_IMAGE {
            return Ok(());
        }
        source.set_position(source.position() + u64::from(size));
        if marker == START_OF_SCAN {
            let rest = source.get_ref().get(source.position() as usize..).unwrap_or_default();
            // In the data of a scan, 0xff is followed by 0 or by the number of a restart; in front of a marker it may be repeated.
            let is_marker = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0 | 0xd0..=0xd7 | 0xff);
            let Some(end) = rest.windows(2).position(is_marker) else { return Err(cut_short(path, "JPEG")) };
            source.set_position(source.position() + end as u64);
        }
    }
}

/// Reads the marker of the next segment and the number of its bytes after the length.
fn segment(source: &mut impl Read) -> std::io::Result<(u8, u16)> {
    let mut byte = || {
        let mut byte = [0];
        source.read_exact(&mut byte).map(|()| byte[0])
    };
    if byte()? != 0xff {
        return Err(ErrorKind::InvalidData.into());
    }
    let mut marker = byte()?;
    while marker == 0xff {
        marker = byte()?;
    }
    match marker {
        END_OF_IMAGE => Ok((marker, 0)),
        // Markers without a length belong into scans.
        0 | 1 | 0xd0..=START => Err(ErrorKind::InvalidData.into()),
        _ => match u16::from_be_bytes([byte()?, byte()?]).checked_sub(2) {
            Some(size) => Ok((marker, size)),
            None => Err(ErrorKind::InvalidData.into()),
        },
    }
}

fn failed(path: &Path, error: std::io::Error) -> Error {
    match error.kind() {
        ErrorKind::UnexpectedEof => cut_short(path, "JPEG"),
        ErrorKind::InvalidData => damaged(path, "a segment does not begin with a marker"),
        _ => Error::io(path, error, "reading the image"),
    }
}

fn damaged(path: &Path, how: &str) -> Error {
    Error::input(path, format!("the JPEG is damaged: {how}"), "copy or download the file again")
}
