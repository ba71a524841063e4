//! Tensors on disk: one in a NumPy file, those of a module in a safetensors file.
//!
//! A file appears whole or not at all: it is written beside its place, under a name of its own, and then renamed.

mod npy;
mod safetensors;

pub use self::safetensors::{load_safetensors, save_safetensors};

use crate::error::FileError;
use crate::real::Real;
use std::fs::{self, OpenOptions};
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

/// A number as files have it, little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Dtype {
    F32,
    F64,
}

impl Dtype {
    /// The type that holds every number of T, and no more.
    fn of<T: Real>() -> Self {
        if size_of::<T>() == 8 { Dtype::F64 } else { Dtype::F32 }
    }

    /// Bytes of one number.
    fn size(self) -> usize {
        match self {
            Dtype::F32 => 4,
            Dtype::F64 => 8,
        }
    }
}

/// Numbers as bytes of T's own type.
fn bytes_of<T: Real>(values: &[T]) -> Vec<u8> {
    match Dtype::of::<T>() {
        Dtype::F32 => values.iter().flat_map(|x| (x.as_f64() as f32).to_le_bytes()).collect(),
        Dtype::F64 => values.iter().flat_map(|x| x.as_f64().to_le_bytes()).collect(),
    }
}

/// Fills a slice with the numbers of as many bytes, rounded if they are of higher precision.
fn read_numbers<T: Real>(bytes: &[u8], dtype: Dtype, out: &mut [T]) {
    match dtype {
        Dtype::F32 => out.iter_mut().zip(bytes.as_chunks().0).for_each(|(x, b)| *x = T::lit(f64::from(f32::from_le_bytes(*b)))),
        Dtype::F64 => out.iter_mut().zip(bytes.as_chunks().0).for_each(|(x, b)| *x = T::lit(f64::from_le_bytes(*b))),
    }
}

/// The bytes of a file.
fn read(path: &Path) -> Result<Vec<u8>, FileError> {
    fs::read(path).map_err(|source| FileError::Io { path: path.to_owned(), doing: "reading the file", source })
}

/// [`atomically`], with an error that names the file.
fn replace(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), FileError> {
    atomically(path, write).map_err(|source| FileError::Io { path: path.to_owned(), doing: "writing the file", source })
}

/// Replaces the file at `path` by one that `write` makes under the name it is given, a hidden one in the same folder: other processes see the
/// old content or the new, and nothing is left behind on failure. The file has the permissions of a new file.
///
/// Errors: those of `write`, and of syncing and renaming the file.
pub fn atomically(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> io::Result<()> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    // No other process and no other thread has this name, and it does not contain the file's own, which may be as long as is allowed.
    let temporary = path.with_file_name(format!(".{}-{}.tmp", std::process::id(), COUNTER.fetch_add(1, Ordering::Relaxed)));
    let written = write(&temporary)
        .and_then(|()| OpenOptions::new().write(true).open(&temporary)?.sync_all())
        .and_then(|()| fs::rename(&temporary, path));
    written.inspect_err(|_| {
        // The write is what failed; a second failure while tidying up would only hide it.
        let _ = fs::remove_file(&temporary);
    })
}
