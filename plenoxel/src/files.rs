//! Bounded reads and atomic writes of files.
//!
//! This crate reads files through [`open`], [`read`] and [`read_named`] only. It writes them through [`write_atomically`]: after an interrupted
//! run, a full disk or a power cut, a file has either its old contents or its new ones, never a part of them.

mod read;

pub use read::{
    ARRAYS, CAMERA_PATH, CAMERAS, CLOUD, IMAGE, Kind, METRICS, RECORD, RUN, SETTINGS, TENSORS, is_there, open, read, read_named, text,
};

mod lock;
pub mod npy;
mod room;

pub use lock::{FolderLock, is_abandoned};
pub use room::{check_handles, check_room};

use crate::error::{Error, Result};
use std::fs;
use std::path::Path;

/// Writes `bytes` to `path` and replaces an existing file: writes a temporary file in the same folder, syncs it to disk and
/// renames it. Other processes see either the old contents or the new ones. A failure leaves no temporary file.
///
/// Errors: [`Error::Io`] if the folder does not exist or cannot be written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    atomically(path, |temporary| fs::write(temporary, bytes))
}

/// Replaces the file `path` like [`write_atomically`]; `write` writes the temporary file whose path it receives.
///
/// Errors: those of [`write_atomically`], and those of `write`.
pub fn atomically(path: &Path, write: impl FnOnce(&Path) -> std::io::Result<()>) -> Result<()> {
    autograd::files::atomically(path, write).map_err(|source| Error::io(path, source, "writing the file"))
}

/// Creates the folder `path` and its parents; existing folders are no error.
///
/// Errors: [`Error::Io`] if it cannot be created, for example because a file has that name.
pub fn create_dir(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(|source| match path.ancestors().find(|path| path.is_symlink() && !path.exists()) {
        Some(link) => {
            Error::input(link, "this symbolic link is broken: its target does not exist", "remove the link, or choose another folder")
        }
        None => Error::io(path, source, "creating the folder"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("plenoxel-files-{}-{name}", std::process::id()));
        create_dir(&path).unwrap();
        path
    }

    #[test]
    fn a_file_is_replaced_and_no_temporary_file_remains() {
        let folder = folder("replace");
        let path = folder.join("a.txt");
        write_atomically(&path, b"old").unwrap();
        write_atomically(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_failed_write_names_the_file_and_leaves_nothing_behind() {
        let folder = folder("fail");
        // A folder cannot be replaced by a file: the rename fails after the temporary file was written.
        let occupied = folder.join("occupied");
        create_dir(&occupied.join("inner")).unwrap();
        let error = write_atomically(&occupied, b"x").unwrap_err();
        assert_eq!(error.exit_code(), 5);
        assert!(error.to_string().contains("occupied"), "{error}");
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        let error = write_atomically(&folder.join("missing/a.txt"), b"x").unwrap_err();
        assert_eq!(error.exit_code(), 5);
        fs::remove_dir_all(folder).unwrap();
    }
}
