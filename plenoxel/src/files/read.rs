//! Bounded reads: the only place where the library and the program open files for reading.
//!
//! Files of datasets and run folders must be regular files. Their size is limited by their [`Kind`] and by the available memory. A path given
//! on the command line may also be a pipe ([`read_named`]), with the same limits.

use crate::error::{Error, Result};
use crate::memory;
use std::borrow::Cow;
use std::fs::{self, File};
use std::io::{ErrorKind, Read};
use std::path::Path;

/// A kind of file, with its limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kind {
    /// Description of such a file, with its article.
    pub name: &'static str,
    /// Maximum size in bytes.
    pub most: u64,
    /// Bytes of memory that reading takes for each byte of the file; 0 if the reader checks the memory itself.
    pub memory: u64,
}

/// The cameras of a dataset: up to 100 000 views of 600 bytes. The memory is that of the text in UTF-16 and in UTF-8; values are counted while
/// they are read.
pub const CAMERAS: Kind = Kind { name: "a JSON file of cameras", most: 64 << 20, memory: 3 };

/// A camera path: up to 50 000 frames of nerfstudio. Memory as for [`CAMERAS`].
pub const CAMERA_PATH: Kind = Kind { name: "a JSON file of cameras", most: 32 << 20, memory: 3 };

/// Settings or a sweep file: up to 100 times the longest preset.
pub const SETTINGS: Kind = Kind { name: "a TOML file", most: 1 << 20, memory: 16 };

/// The final figures of a run, with an entry for each of up to 10 000 test views. Memory as for [`CAMERAS`].
pub const RECORD: Kind = Kind { name: "a JSON file that a run wrote", most: 16 << 20, memory: 3 };

/// `run.json`. It names one of several kinds, and its values are kept in memory until the kind is known.
pub const RUN: Kind = Kind { name: "a JSON file that a run wrote", most: 1 << 20, memory: 64 };

/// `metrics.jsonl`: up to several 100 000 lines; a run writes a few thousand. Its reader counts the memory of the parsed lines.
pub const METRICS: Kind = Kind { name: "the metrics of a run", most: 256 << 20, memory: 1 };

/// An image: up to twice the uncompressed size of the largest accepted image, 16384² pixels of 8 bytes.
pub const IMAGE: Kind = Kind { name: "a PNG, JPEG or WebP image", most: 4 << 30, memory: 0 };

/// A point cloud: up to 2³² points of 16 bytes. Its reader counts the memory of the points by the header.
pub const CLOUD: Kind = Kind { name: "a PLY file", most: 64 << 30, memory: 1 };

/// Arrays of NumPy: a grid of 1024³ voxels with its links and 27 coefficients in half precision. Their reader counts the memory of each array.
pub const ARRAYS: Kind = Kind { name: "a .npz file of NumPy arrays", most: 128 << 30, memory: 0 };

/// Tensors: up to a grid of 1024³ voxels with 27 harmonics and its optimizer state, in double precision.
pub const TENSORS: Kind = Kind { name: "a safetensors file", most: 1 << 40, memory: 0 };

/// Opens a regular file of a kind. Symbolic links are followed.
///
/// Errors: bad input if the file is missing, a folder, a pipe or a device, or exceeds the maximum size of its kind; any other error of the system.
pub fn open(path: &Path, kind: Kind) -> Result<File> {
    let file = autograd::files::open_plain(path).map_err(|e| refused(path, kind, e))?;
    check_size(path, kind, length(path, kind, &file)?)?;
    Ok(file)
}

/// Reads the bytes of a regular file of a kind. Symbolic links are followed.
///
/// Errors: those of [`open`]; there is not enough memory.
pub fn read(path: &Path, kind: Kind) -> Result<Vec<u8>> {
    let file = open(path, kind)?;
    all(path, kind, file)
}

/// Reads the bytes of a path given on the command line, which may also be a pipe or a device such as `/dev/stdin`.
///
/// Errors: those of [`read`].
pub fn read_named(path: &Path, kind: Kind) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| refused(path, kind, e))?;
    // On Unix a folder can be opened like a file.
    if file.metadata().is_ok_and(|data| data.is_dir()) {
        return Err(refused(path, kind, ErrorKind::IsADirectory.into()));
    }
    all(path, kind, file)
}

/// True unless the system reports that the path does not exist. Unreadable files and broken links count as existing.
pub fn is_there(path: &Path) -> bool {
    !fs::symlink_metadata(path).is_err_and(|e| e.kind() == ErrorKind::NotFound)
}

fn length(path: &Path, kind: Kind, file: &File) -> Result<u64> {
    file.metadata().map(|data| data.len()).map_err(|e| refused(path, kind, e))
}

fn all(path: &Path, kind: Kind, file: File) -> Result<Vec<u8>> {
    let length = length(path, kind, &file)?;
    check_size(path, kind, length)?;
    let what = |length: u64| format!("reading {} as {}", memory::bytes(length), kind.name);
    memory::check(path, &what(length), kind.memory * length)?;
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(length as usize).map_err(|_| refused(path, kind, ErrorKind::OutOfMemory.into()))?;
    // A pipe has no length before its end, and a file may grow. A buffer that grows is copied.
    let allowance = memory::allowance();
    let room = allowance.as_ref().map_or(u64::MAX, |allowance| allowance.bytes / (2 * kind.memory).max(1)).max(length);
    (&file).take(room.min(kind.most) + 1).read_to_end(&mut bytes).map_err(|e| refused(path, kind, e))?;
    let read = bytes.len() as u64;
    check_size(path, kind, read)?;
    match allowance.filter(|_| read > room) {
        Some(allowance) => Err(memory::refusal(path, &what(read), 2 * kind.memory * read, &allowance)),
        None => Ok(bytes),
    }
}

fn check_size(path: &Path, kind: Kind, length: u64) -> Result<()> {
    if length <= kind.most {
        return Ok(());
    }
    let found = format!("this file is too large: {} may have at most {}", kind.name, memory::bytes(kind.most));
    Err(Error::input(path, found, format!("expected {}", kind.name)))
}

/// The error for a file that cannot be opened or read.
fn refused(path: &Path, kind: Kind, e: std::io::Error) -> Error {
    let found = match e.kind() {
        ErrorKind::NotFound if is_there(path) => "this symbolic link is broken: its target does not exist".to_owned(),
        ErrorKind::NotFound => "this file does not exist".to_owned(),
        ErrorKind::IsADirectory => "this is a folder".to_owned(),
        // Created by autograd, with a message that describes the file.
        ErrorKind::InvalidInput if e.raw_os_error().is_none() => e.to_string(),
        _ => return Error::io(path, e, format!("reading {}", kind.name)),
    };
    Error::input(path, found, format!("expected {}", kind.name))
}

/// Decodes the bytes of the text file `path`: UTF-16 with a byte order mark, UTF-8 otherwise. The mark is removed.
///
/// Errors: the bytes are neither; the message names the line.
pub fn text<'b>(path: &Path, bytes: &'b [u8]) -> Result<Cow<'b, str>> {
    match bytes {
        [0xff, 0xfe, units @ ..] => utf16(path, units, u16::from_le_bytes),
        [0xfe, 0xff, units @ ..] => utf16(path, units, u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
            std::str::from_utf8(bytes).map(Cow::Borrowed).map_err(|e| {
                let line = 1 + bytes[..e.valid_up_to()].iter().filter(|byte| **byte == b'\n').count();
                Error::input(path, format!("line {line} is not valid UTF-8"), "save the file as UTF-8, or as UTF-16 with a byte order mark")
            })
        }
    }
}

fn utf16(path: &Path, bytes: &[u8], unit: fn([u8; 2]) -> u16) -> Result<Cow<'static, str>> {
    let (units, rest) = bytes.as_chunks::<2>();
    let letters = || char::decode_utf16(units.iter().map(|bytes| unit(*bytes)));
    // A text that grows while it is read would take twice the memory.
    let mut text = String::with_capacity(letters().map(|letter| letter.map_or(0, char::len_utf8)).sum());
    let read = letters().try_for_each(|letter| letter.map(|letter| text.push(letter)));
    match read {
        Ok(()) if rest.is_empty() => Ok(Cow::Owned(text)),
        _ => Err(Error::input(path, "this file has a byte order mark of UTF-16, but is not valid UTF-16", "save the file as UTF-8")),
    }
}

#[cfg(test)]
mod tests;
