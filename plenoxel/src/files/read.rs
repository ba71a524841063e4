//! Reading: every file that the library and its program read is opened here.
//!
//! A file that was found, in a dataset or in the folder of a run, is a plain one, of no more bytes than its [`Kind`] may have and than there is
//! memory for. What a user named on a command line may be a pipe too ([`read_named`]), within the same bounds.

use crate::error::{Error, Result};
use crate::memory;
use std::borrow::Cow;
use std::fs::{self, File};
use std::io::{ErrorKind, Read};
use std::path::Path;

/// A kind of file that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kind {
    /// What a file of this kind is, with its article.
    pub name: &'static str,
    /// The most bytes that it may have.
    pub most: u64,
    /// Bytes of memory that reading takes for each byte of it; 0 where the reader counts the parts that it keeps.
    pub memory: u64,
}

/// The cameras of a dataset: a hundred thousand views with 600 bytes each. The memory is that of the text in UTF-16 and in UTF-8; values are counted
/// while they are read.
pub const CAMERAS: Kind = Kind { name: "a JSON file of cameras", most: 64 << 20, memory: 3 };

/// The cameras of a film: 50 000 frames of nerfstudio. Memory as above.
pub const CAMERA_PATH: Kind = Kind { name: "a JSON file of cameras", most: 32 << 20, memory: 3 };

/// Settings, and the description of a sweep: a hundred times the longest preset.
pub const SETTINGS: Kind = Kind { name: "a TOML file", most: 1 << 20, memory: 16 };

/// Figures that a run notes, with a line for each of ten thousand test views. Memory as above.
pub const RECORD: Kind = Kind { name: "a JSON file that a run wrote", most: 16 << 20, memory: 3 };

/// `run.json`: a few facts. One that says which of several kinds it is has its values kept until that is known.
pub const RUN: Kind = Kind { name: "a JSON file that a run wrote", most: 1 << 20, memory: 64 };

/// `metrics.jsonl`: hundreds of thousands of lines, where a run has thousands. Its reader counts what they become.
pub const METRICS: Kind = Kind { name: "the metrics of a run", most: 256 << 20, memory: 1 };

/// An image: the largest that is accepted, of 16384² pixels of 8 bytes and not compressed, and as much beside it.
pub const IMAGE: Kind = Kind { name: "a PNG image", most: 4 << 30, memory: 0 };

/// A point cloud: as many points as 32 bits count, of 16 bytes each. What is made of it is counted by its header.
pub const CLOUD: Kind = Kind { name: "a PLY file", most: 64 << 30, memory: 1 };

/// Tensors: a grid of 1024³ voxels with 27 harmonics, what an optimizer remembers of it, and the same in double precision.
pub const TENSORS: Kind = Kind { name: "a safetensors file", most: 1 << 40, memory: 0 };

/// Opens a plain file of a kind; links are followed.
///
/// Errors: bad input if it is missing, a folder, a pipe, a device, or larger than the kind may be; the system's refusal.
pub fn open(path: &Path, kind: Kind) -> Result<File> {
    let file = autograd::files::open_plain(path).map_err(|e| refused(path, kind, e))?;
    check_size(path, kind, length(path, kind, &file)?)?;
    Ok(file)
}

/// The bytes of a plain file of a kind; links are followed.
///
/// Errors as for [`open`]; and there is not enough memory for it.
pub fn read(path: &Path, kind: Kind) -> Result<Vec<u8>> {
    let file = open(path, kind)?;
    all(path, kind, file)
}

/// The bytes of what a user named to be read, which may be a pipe or a device too, such as `/dev/stdin`.
///
/// Errors as for [`read`].
pub fn read_named(path: &Path, kind: Kind) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| refused(path, kind, e))?;
    // On Unix a folder can be opened like a file.
    if file.metadata().is_ok_and(|data| data.is_dir()) {
        return Err(refused(path, kind, ErrorKind::IsADirectory.into()));
    }
    all(path, kind, file)
}

/// True unless the system says that nothing has this name: what cannot be opened is there, and so is a link that leads nowhere.
pub fn is_there(path: &Path) -> bool {
    !fs::symlink_metadata(path).is_err_and(|e| e.kind() == ErrorKind::NotFound)
}

fn length(path: &Path, kind: Kind, file: &File) -> Result<u64> {
    file.metadata().map(|data| data.len()).map_err(|e| refused(path, kind, e))
}

fn all(path: &Path, kind: Kind, file: File) -> Result<Vec<u8>> {
    let length = length(path, kind, &file)?;
    check_size(path, kind, length)?;
    let what = |length: u64| format!("to read {} as {}", memory::bytes(length), kind.name);
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
    let found = format!("this file is larger than the {} that {} may have", memory::bytes(kind.most), kind.name);
    Err(Error::input(path, found, format!("{} is expected there", kind.name)))
}

/// Why a file of a kind is not opened or read.
fn refused(path: &Path, kind: Kind, e: std::io::Error) -> Error {
    let found = match e.kind() {
        ErrorKind::NotFound if is_there(path) => "this is a link to a file that is not there".to_owned(),
        ErrorKind::NotFound => "there is no such file".to_owned(),
        ErrorKind::IsADirectory => "this is a folder".to_owned(),
        // That of our own: it says what there is.
        ErrorKind::InvalidInput if e.raw_os_error().is_none() => e.to_string(),
        _ => return Error::io(path, e, format!("reading {}", kind.name)),
    };
    Error::input(path, found, format!("{} is expected there", kind.name))
}

/// The text in the bytes of the file `path`: UTF-8, or UTF-16 where a byte order mark says so. The mark is left out.
///
/// Errors: it is neither, with the line.
pub fn text<'b>(path: &Path, bytes: &'b [u8]) -> Result<Cow<'b, str>> {
    match bytes {
        [0xff, 0xfe, units @ ..] => utf16(path, units, u16::from_le_bytes),
        [0xfe, 0xff, units @ ..] => utf16(path, units, u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
            std::str::from_utf8(bytes).map(Cow::Borrowed).map_err(|e| {
                let line = 1 + bytes[..e.valid_up_to()].iter().filter(|byte| **byte == b'\n').count();
                Error::input(path, format!("line {line} is no text in UTF-8"), "save it as UTF-8, or as UTF-16 with a byte order mark")
            })
        }
    }
}

fn utf16(path: &Path, bytes: &[u8], unit: fn([u8; 2]) -> u16) -> Result<Cow<'static, str>> {
    let (units, rest) = bytes.as_chunks::<2>();
    let letters = || char::decode_utf16(units.iter().map(|bytes| unit(*bytes)));
    // A text that grows as it is read would take twice as much.
    let mut text = String::with_capacity(letters().map(|letter| letter.map_or(0, char::len_utf8)).sum());
    let read = letters().try_for_each(|letter| letter.map(|letter| text.push(letter)));
    match read {
        Ok(()) if rest.is_empty() => Ok(Cow::Owned(text)),
        _ => Err(Error::input(path, "the byte order mark says UTF-16, but the rest is not", "save it as UTF-8")),
    }
}

#[cfg(test)]
mod tests;
