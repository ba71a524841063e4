//! Files in a folder: listed, told apart by their names, removed; and names that are free.

use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// Endings of what `render` writes.
pub const RENDERED: [&str; 5] = ["png", "exr", "npy", "gif", "mp4"];

/// Paths in a folder; none if it cannot be listed.
pub fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

fn file_name(path: &Path) -> std::borrow::Cow<'_, str> {
    path.file_name().unwrap_or_default().to_string_lossy()
}

/// True for a name that ends in a dot and one of `endings`.
pub fn is_one_of(path: &Path, endings: &[&str]) -> bool {
    path.extension().is_some_and(|ending| endings.iter().any(|e| ending == *e))
}

/// True for a frame of a film.
pub fn is_frame(path: &Path) -> bool {
    file_name(path).starts_with("frame_") && is_one_of(path, &RENDERED)
}

/// True for a file that was being written.
pub fn is_fragment(path: &Path) -> bool {
    let name = file_name(path);
    name.starts_with(".tmp") || name.starts_with('.') && name.ends_with(".tmp")
}

/// Removes files.
pub fn remove(files: impl Iterator<Item = PathBuf>) -> Result<()> {
    files.into_iter().try_for_each(|path| std::fs::remove_file(&path).map_err(|e| Error::io(&path, e, "removing it")))
}

/// `root/<scene>-<n>` with the first n from 1 on that nothing has.
pub fn first_free(root: &Path, scene: &str) -> PathBuf {
    let plain = |c: char| {
        let keep = c.is_alphanumeric() || matches!(c, '-' | '_' | '.');
        if keep { c } else { '-' }
    };
    let scene: String = scene.chars().map(plain).collect();
    let mut n = 1;
    loop {
        let path = root.join(format!("{scene}-{n}"));
        // A dangling link exists too: nothing may be written through it.
        if path.symlink_metadata().is_err() {
            return path;
        }
        n += 1;
    }
}
