//! The photographs of a folder.

use plenoxel::dataset::image::{Orientation, is_photograph, size_as};
use plenoxel::error::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Fewest photographs that can have cameras.
const FEWEST: usize = 2;

/// A photograph.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Photo {
    /// Name of the file.
    pub name: String,
    /// Length of the file.
    pub bytes: u64,
    /// Width and height as stored, in pixels.
    pub size: (usize, usize),
}

/// Content of a folder of photographs.
#[derive(Debug, Default)]
pub struct Photos {
    /// The photographs, sorted by name.
    pub all: Vec<Photo>,
    /// Number of photographs that are stored turned by 90°, as their EXIF orientation states.
    pub turned: usize,
    /// Names of the other files, sorted.
    pub others: Vec<String>,
}

/// Lists the photographs in a folder, without its subfolders. Reads their headers only.
///
/// Errors if the folder does not exist, if there are fewer than two photographs, or if one of them is damaged, naming it.
pub fn find(folder: &Path) -> Result<Photos> {
    const REMEDY: &str = "give a folder of photographs";
    let entries = std::fs::read_dir(folder).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::input(folder, "there is no such folder", REMEDY),
        std::io::ErrorKind::NotADirectory => Error::input(folder, "this is a file", REMEDY),
        _ => Error::io(folder, e, "listing the photographs"),
    })?;
    let (mut names, mut others) = (Vec::new(), Vec::new());
    for entry in entries.flatten().filter(|entry| !entry.path().is_dir()) {
        // COLMAP reads a list of names in UTF-8, one on each line.
        match entry.file_name().into_string() {
            // Hidden files are notes of systems, such as `._IMG_1.jpg`.
            Ok(name) if name.starts_with('.') => {}
            Ok(name) if is_photograph(&name) && !name.contains(['\n', '\r']) => names.push(name),
            Ok(name) => others.push(name),
            Err(name) => others.push(name.to_string_lossy().into_owned()),
        }
    }
    names.sort();
    others.sort();
    if names.len() < FEWEST {
        return Err(too_few(folder, names.first(), &others));
    }
    let read: Result<Vec<(Photo, bool)>> = names.into_par_iter().map(|name| photo(folder, name)).collect();
    let read = read?;
    let turned = read.iter().filter(|(_, turned)| *turned).count();
    Ok(Photos { all: read.into_iter().map(|(photo, _)| photo).collect(), turned, others })
}

/// Reads the header of a photograph. The second value is true if it is stored turned by 90°.
fn photo(folder: &Path, name: String) -> Result<(Photo, bool)> {
    let path = folder.join(&name);
    let size = size_as(&path, Orientation::Stored)?;
    let turned = size_as(&path, Orientation::Stated)? != size;
    let bytes = path.metadata().map_err(|e| Error::io(&path, e, "reading the photograph"))?.len();
    Ok((Photo { name, bytes, size }, turned))
}

fn too_few(folder: &Path, single: Option<&String>, others: &[String]) -> Error {
    match (single, others.first()) {
        (Some(name), _) => {
            let found = format!("there is only one photograph, {name}");
            Error::input(folder, found, "give at least two, better twenty, taken from different places")
        }
        (None, Some(other)) => {
            let found = format!("there is no JPEG, PNG or WebP file, only others such as {other}");
            Error::input(
                folder,
                found,
                "convert the photographs to JPEG or PNG; take frames of a film with `ffmpeg -i FILM -vf fps=2 %04d.png`",
            )
        }
        (None, None) => {
            Error::input(folder, "there is no photograph", "give a folder of JPEG, PNG or WebP files; subfolders are not searched")
        }
    }
}

/// The photographs by their size: groups that can share a camera.
pub fn by_size(photos: &[Photo]) -> Vec<Vec<&Photo>> {
    let mut sizes: Vec<(usize, usize)> = photos.iter().map(|photo| photo.size).collect();
    sizes.sort_unstable();
    sizes.dedup();
    sizes.into_iter().map(|size| photos.iter().filter(|photo| photo.size == size).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    #[test]
    fn sizes_are_those_of_the_stored_images_and_those_that_are_turned_are_counted() {
        let folder = std::env::temp_dir().join(format!("plenoxel-photos-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("below.jpg")).expect("a temporary folder");
        let jpeg = |width, height| {
            let mut bytes = Vec::new();
            JpegEncoder::new(&mut bytes).encode_image(&image::RgbImage::new(width, height)).expect("an image");
            bytes
        };
        // EXIF with one entry: orientation 6, a quarter turn.
        let exif = b"\xff\xe1\0\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
        let turned = [&jpeg(8, 6)[..2], exif, &jpeg(8, 6)[2..]].concat();
        for (name, bytes) in
            [("b.JPG", turned), ("a.jpeg", jpeg(8, 6)), ("c.jpg", jpeg(6, 8)), ("film.mp4", Vec::new()), ("line\n.jpg", jpeg(8, 6))]
        {
            std::fs::write(folder.join(name), bytes).expect("a file");
        }
        let photos = find(&folder).expect("photographs");
        assert_eq!(
            photos.all.iter().map(|photo| (photo.name.as_str(), photo.size)).collect::<Vec<_>>(),
            [("a.jpeg", (8, 6)), ("b.JPG", (8, 6)), ("c.jpg", (6, 8))]
        );
        assert_eq!((photos.turned, photos.others), (1, vec!["film.mp4".to_owned(), "line\n.jpg".to_owned()]));
        let sizes: Vec<usize> = by_size(&photos.all).iter().map(Vec::len).collect();
        assert_eq!(sizes, [1, 2]);
        std::fs::remove_dir_all(folder).expect("it is removed");
    }
}
