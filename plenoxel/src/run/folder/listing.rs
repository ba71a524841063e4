//! Files in a run folder: listing, classification by name, removal, and free names for new folders.

use crate::error::{Error, Result};
use crate::files;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// File extensions of `plenoxel render`.
pub const RENDERED: [&str; 5] = ["png", "exr", "npy", "gif", "mp4"];

/// Returns the paths in a folder; none if it cannot be listed.
pub fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

fn file_name(path: &Path) -> std::borrow::Cow<'_, str> {
    path.file_name().unwrap_or_default().to_string_lossy()
}

/// True if the file extension is one of `endings`.
pub fn is_one_of(path: &Path, endings: &[&str]) -> bool {
    path.extension().is_some_and(|ending| endings.iter().any(|e| ending == *e))
}

/// True for a frame of a video.
pub fn is_frame(path: &Path) -> bool {
    file_name(path).starts_with("frame_") && is_one_of(path, &RENDERED)
}

/// True for a temporary file of an interrupted write.
pub fn is_fragment(path: &Path) -> bool {
    let name = file_name(path);
    name.starts_with(".tmp") || name.starts_with('.') && name.ends_with(".tmp")
}

/// Removes files.
pub fn remove(files: impl Iterator<Item = PathBuf>) -> Result<()> {
    files.into_iter().try_for_each(|path| std::fs::remove_file(&path).map_err(|e| Error::io(&path, e, "removing the file")))
}

/// Creates the folder `root/<scene>-<n>` with the smallest free n from 1 on. Concurrent processes get different folders.
pub fn reserve(root: &Path, scene: &str) -> Result<PathBuf> {
    files::create_dir(root)?;
    let plain = |c: char| {
        let keep = c.is_alphanumeric() || matches!(c, '-' | '_' | '.');
        if keep { c } else { '-' }
    };
    let scene: String = scene.chars().map(plain).collect();
    for n in 1.. {
        let path = root.join(format!("{scene}-{n}"));
        match std::fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            Err(e) => return Err(Error::io(&path, e, "creating the folder")),
        }
    }
    unreachable!("there are more numbers than folders")
}
