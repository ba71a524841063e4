//! The folder that the command writes: a link to the photographs, the work of COLMAP, a record of the finished steps, and the reconstruction.
//!
//! ```text
//! images         link to the photographs, unless they are in this folder
//! sparse/0       the reconstruction; it appears when all steps are finished
//! colmap/        database, lists of photographs, further models, and colmap.log
//! cameras.json   photographs, settings and finished steps
//! ```

use super::Step;
use super::photos::Photo;
use super::settings::Settings;
use plenoxel::error::{Error, Result};
use plenoxel::files::{self, FolderLock};
use plenoxel::json;
use serde::{Deserialize, Serialize};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Lock file, by which a folder of this command is recognized.
const LOCK: &str = "cameras.lock";
/// Record of the finished steps.
const RECORD: &str = "cameras.json";
/// Folder of the images: the link to the photographs.
pub const IMAGES: &str = "images";
/// Folder of what only COLMAP needs.
pub const WORK: &str = "colmap";
/// Folder of the reconstruction.
const SPARSE: &str = "sparse/0";

/// Record of the photographs, the settings and the finished steps.
#[derive(Debug, Serialize, Deserialize)]
pub struct Record {
    /// The folder of photographs.
    photos: PathBuf,
    settings: Settings,
    files: Vec<Photo>,
    finished: Vec<Finished>,
}

/// A finished step.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Finished {
    step: Step,
    seconds: f64,
}

/// A folder of this command, locked.
pub struct CameraFolder {
    path: PathBuf,
    pub lock: FolderLock,
    record: Record,
}

impl Record {
    /// A record of what is asked for. `photos` is the folder of the photographs `files`.
    pub fn new(photos: &Path, files: &[Photo], settings: &Settings) -> Result<Self> {
        let photos = photos.canonicalize().map_err(|e| Error::io(photos, e, "reading the folder"))?;
        Ok(Record { photos, settings: settings.clone(), files: files.to_vec(), finished: Vec::new() })
    }

    /// Reads the record of a folder. `None` if there is none, or if it is damaged and will be replaced.
    fn read(folder: &Path, replaced: bool) -> Result<Option<Self>> {
        let path = folder.join(RECORD);
        if !files::is_there(&path) {
            return Ok(None);
        }
        let damaged = |e: serde_json::Error| {
            Error::input(
                &path,
                format!("this is no record of `plenoxel cameras` ({e})"),
                "start again with --force, or choose another --out",
            )
        };
        let read = files::read(&path, files::RECORD).and_then(|bytes| serde_json::from_slice(&bytes).map_err(damaged));
        if replaced { Ok(read.ok()) } else { read.map(Some) }
    }

    /// Returns how an earlier record differs, and the first step that is concerned.
    fn difference(&self, earlier: &Record) -> Option<(String, Step)> {
        if self.photos != earlier.photos {
            return Some((format!("the photographs were those of {}", earlier.photos.display()), Step::Features));
        }
        if self.files != earlier.files {
            return Some((format!("the photographs have changed: {} then, {} now", earlier.files.len(), self.files.len()), Step::Features));
        }
        self.settings.difference(&earlier.settings)
    }
}

impl CameraFolder {
    /// Creates or continues the folder `path` for `record`: locks it, and links the photographs. Finished steps of an earlier call are kept; with
    /// `force`, only those before the first difference.
    ///
    /// Errors if the folder has other files, or was begun for something else and `force` is not set.
    pub fn open(path: &Path, mut record: Record, force: bool) -> Result<Self> {
        check_place(path, &record.photos)?;
        files::create_dir(path)?;
        let lock = FolderLock::acquire(path, LOCK, "--out")?;
        if let Some(earlier) = Record::read(path, force)? {
            let difference = record.difference(&earlier);
            if let (Some((how, _)), false, false) = (&difference, force, earlier.finished.is_empty()) {
                let found = format!("{} was begun with something else ({how})", path.display());
                return Err(Error::usage("--out", found, "choose another folder, or repeat the steps concerned with --force"));
            }
            let is_kept = |finished: &Finished| difference.as_ref().is_none_or(|(_, first)| finished.step < *first);
            record.finished = earlier.finished.into_iter().filter(is_kept).collect();
        }
        if !path.join(SPARSE).is_dir() {
            record.finished.retain(|finished| finished.step != Step::Mapping);
        }
        let folder = CameraFolder { path: path.to_owned(), lock, record };
        if folder.seconds(Step::Mapping).is_none() {
            folder.remove(SPARSE)?;
        }
        folder.link()?;
        files::create_dir(&folder.path.join(WORK))?;
        folder.save()?;
        Ok(folder)
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the seconds that a finished step took.
    pub fn seconds(&self, step: Step) -> Option<f64> {
        self.record.finished.iter().find(|finished| finished.step == step).map(|finished| finished.seconds)
    }

    /// Records that a step is finished.
    pub fn finish(&mut self, step: Step, seconds: f64) -> Result<()> {
        self.record.finished.push(Finished { step, seconds });
        self.save()
    }

    /// Makes a model of COLMAP the reconstruction of this folder.
    pub fn adopt(&self, model: &Path) -> Result<()> {
        self.remove(SPARSE)?;
        let place = self.reconstruction();
        place.parent().map_or(Ok(()), files::create_dir)?;
        std::fs::rename(model, &place).map_err(|e| Error::io(&place, e, "moving the reconstruction"))
    }

    /// The folder of the reconstruction.
    pub fn reconstruction(&self) -> PathBuf {
        self.path.join(SPARSE)
    }

    /// Removes a file, or a folder with all of its files, if it exists.
    pub fn remove(&self, name: &str) -> Result<()> {
        let path = self.path.join(name);
        let removed = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(Error::io(&path, e, "removing what COLMAP wrote earlier")),
            _ => Ok(()),
        }
    }

    fn save(&self) -> Result<()> {
        files::write_atomically(&self.path.join(RECORD), (json::line(&self.record)? + "\n").as_bytes())
    }

    /// Links the photographs, unless they are in this folder.
    fn link(&self) -> Result<()> {
        let link = self.path.join(IMAGES);
        if link.canonicalize().is_ok_and(|target| target == self.record.photos) {
            return Ok(());
        }
        if link.is_symlink() {
            std::fs::remove_file(&link).map_err(|e| Error::io(&link, e, "replacing the link to the photographs"))?;
        }
        let from = self.path.canonicalize().map_err(|e| Error::io(&self.path, e, "reading the folder"))?;
        symlink(&relative(&from, &self.record.photos), &link).map_err(|e| {
            let found = format!("no link to the photographs can be made in {} ({e})", self.path.display());
            Error::usage("--out", found, format!("move the photographs to {}, and give that folder as PHOTOS", link.display()))
        })
    }
}

/// Checks that a folder is new, or of this command, or has nothing but the photographs.
fn check_place(out: &Path, photos: &Path) -> Result<()> {
    if out.is_file() {
        return Err(Error::usage("--out", format!("{} is a file", out.display()), "choose a folder"));
    }
    let is_ours = files::is_there(&out.join(LOCK));
    let is_photos = |path: PathBuf| path.ends_with(IMAGES) && path.canonicalize().is_ok_and(|path| path == photos);
    let has_only_photos = std::fs::read_dir(out).map_or(true, |entries| entries.flatten().all(|entry| is_photos(entry.path())));
    // A folder of that name with other photographs is never replaced.
    let images = out.join(IMAGES);
    let has_others = images.is_dir() && !images.is_symlink() && !is_photos(images);
    if (is_ours && !has_others) || has_only_photos {
        return Ok(());
    }
    let found = format!("{} is not empty, and not of `plenoxel cameras` for these photographs", out.display());
    Err(Error::usage("--out", found, "choose a new folder"))
}

/// Returns the path of the folder `to` as seen from the folder `from`, so that both can be moved together. Both are complete paths without links.
fn relative(from: &Path, to: &Path) -> PathBuf {
    let common = from.components().zip(to.components()).take_while(|(a, b)| a == b).count();
    if common == 0 {
        return to.to_owned();
    }
    let up = from.components().skip(common).map(|_| "..".as_ref());
    up.chain(to.components().skip(common).map(|part| part.as_os_str())).collect()
}

#[cfg(unix)]
fn symlink(target: &Path, link: &Path) -> std::io::Result<()> {
    std::os::unix::fs::symlink(target, link)
}

#[cfg(windows)]
fn symlink(target: &Path, link: &Path) -> std::io::Result<()> {
    std::os::windows::fs::symlink_dir(target, link)
}

#[cfg(not(any(unix, windows)))]
fn symlink(_: &Path, _: &Path) -> std::io::Result<()> {
    Err(ErrorKind::Unsupported.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn a_link_leads_from_one_folder_to_the_other() {
        let between = |from: &str, to: &str| relative(Path::new(from), Path::new(to)).to_string_lossy().into_owned();
        assert_eq!(between("/data/room", "/data/photos"), "../photos");
        assert_eq!(between("/data/photos/scene", "/data/photos"), "..");
        assert_eq!(between("/a/b", "/c/d"), "../../c/d");
    }
}
