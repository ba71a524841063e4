//! Folders of the images of a capture: `images`, or reduced in `images_2`, `images_4` or `images_8`.

use crate::error::{Error, Result};
use crate::files;
use std::path::{Path, PathBuf};

/// Reductions for which programs make folders.
const REDUCTIONS: [usize; 3] = [2, 4, 8];
/// Extensions of images, in the order in which they are looked for.
const EXTENSIONS: [&str; 10] = ["png", "jpg", "jpeg", "JPG", "JPEG", "PNG", "webp", "tif", "tiff", "bmp"];

/// A folder of images, perhaps reduced.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageFolder {
    /// The folder.
    pub path: PathBuf,
    /// Factor by which its images are smaller than the original ones.
    pub reduced: usize,
}

impl ImageFolder {
    /// Chooses the folder of images below `root`, whose name is one of `names`, for a reduction by `downscale`: `images_4` for 4 if it
    /// exists, else `images`. Without `images`, the reduced folder that comes nearest.
    pub fn find(root: &Path, names: &[&str], downscale: usize) -> Option<Self> {
        let reduced = |k: usize| {
            let path = root.join(format!("images_{k}"));
            path.is_dir().then_some(ImageFolder { path, reduced: k })
        };
        let there = REDUCTIONS.into_iter().filter_map(reduced);
        if let Some(exact) = there.clone().find(|folder| folder.reduced == downscale) {
            return Some(exact);
        }
        let full = names.iter().map(|name| root.join(name)).find(|path| path.is_dir());
        let full = full.map(|path| ImageFolder { path, reduced: 1 });
        // The largest images that a whole factor reduces to what is asked for; else the largest of all.
        full.or_else(|| there.clone().find(|folder| downscale.is_multiple_of(folder.reduced))).or_else(|| there.clone().next())
    }

    /// Returns the image of a name in this folder. Another extension is found too.
    pub fn image(&self, name: &str) -> Option<PathBuf> {
        with_any_extension(&self.path.join(name))
    }

    /// Returns the names of the images in this folder, sorted.
    pub fn sorted(&self) -> Result<Vec<String>> {
        let entries = std::fs::read_dir(&self.path).map_err(|source| Error::io(&self.path, source, "listing the folder"))?;
        let mut names: Vec<String> =
            entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).filter(|name| is_image(name)).collect();
        names.sort();
        Ok(names)
    }
}

/// Returns the path if it exists, or the same with another extension of an image.
pub fn with_any_extension(path: &Path) -> Option<PathBuf> {
    if files::is_there(path) && !path.is_dir() {
        return Some(path.to_owned());
    }
    let appended = EXTENSIONS.iter().map(|extension| {
        let mut path = path.to_owned();
        path.as_mut_os_string().push(format!(".{extension}"));
        path
    });
    let replaced = EXTENSIONS.iter().map(|extension| path.with_extension(extension));
    let known = is_image(&path.to_string_lossy());
    appended.filter(|_| !known).chain(replaced.filter(|_| known)).find(|path| files::is_there(path))
}

/// Returns true for names with the extension of an image.
pub fn is_image(name: &str) -> bool {
    let extension = name.rsplit_once('.').map_or("", |(_, extension)| extension);
    !name.starts_with('.') && EXTENSIONS.iter().any(|known| known.eq_ignore_ascii_case(extension))
}

/// Returns a path of a file with `/` and without a leading `./`.
pub fn plain(path: &str) -> String {
    let path = path.replace('\\', "/");
    path.trim_start_matches("./").to_owned()
}

/// Returns the last part of a path.
pub fn base_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}
