//! Photographs with known cameras, independent of the file format.
//!
//! Opening a [`Dataset`] is cheap: all metadata is parsed and the header of every image is checked, so that a broken file is reported at
//! once. Pixels are decoded when a split is loaded. [`open`] recognizes the format of a folder. [`Dataset::procedural`] is the built-in
//! scene, which needs no files and has exact depth.

pub mod blender;
pub mod exposure;
pub mod image;
pub mod procedural;

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::files;
use ndarray::{Array2, Array3};
use procedural::ProceduralOptions;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Split of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Split {
    /// Views for training.
    Train,
    /// Views for choosing settings.
    Val,
    /// Views for reported results.
    Test,
}

impl Split {
    /// All splits, in the usual order.
    pub const ALL: [Split; 3] = [Split::Train, Split::Val, Split::Test];
}

impl std::fmt::Display for Split {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Split::Train => "train",
            Split::Val => "val",
            Split::Test => "test",
        })
    }
}

impl std::str::FromStr for Split {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let known = Split::ALL.into_iter().find(|split| split.to_string() == text);
        known.ok_or_else(|| Error::config("split", format!("\"{text}\""), "train, val, test"))
    }
}

/// Photograph with its camera.
#[derive(Debug, Clone)]
pub struct View {
    /// Name of the file without folder and extension, such as "r_17".
    pub name: String,
    /// Camera. Its intrinsics have the size of `image`.
    pub camera: Camera,
    /// Image, 8-bit sRGB with straight alpha.
    pub image: image::RgbaImage,
    /// Distance along the unit ray of each pixel's centre to the first surface, [height, width]; infinite if there is none. `None` unless
    /// known exactly.
    pub depth: Option<Array2<f32>>,
}

impl View {
    /// Returns width and height of the image in pixels.
    pub fn size(&self) -> [usize; 2] {
        [self.image.width() as usize, self.image.height() as usize]
    }

    /// Returns the color of pixel (x, y) over `background`: rgb a + background (1 - a) on sRGB values in [0, 1].
    #[inline]
    pub fn color(&self, x: usize, y: usize, background: [f32; 3]) -> [f32; 3] {
        image::color(&self.image, x, y, background)
    }

    /// Returns the alpha of pixel (x, y) in [0, 1].
    #[inline]
    pub fn alpha(&self, x: usize, y: usize) -> f32 {
        f32::from(self.image.get_pixel(x as u32, y as u32).0[3]) / 255.0
    }

    /// Returns the view with its image reduced by `k` along both axes with a box filter. If k does not divide both sides, the largest
    /// smaller divisor is used. The result has no depth.
    pub fn reduced(&self, k: usize) -> Self {
        let (width, height) = self.image.dimensions();
        let divides = |k: &usize| width.is_multiple_of(*k as u32) && height.is_multiple_of(*k as u32);
        let k = (1..=k).rev().find(divides).unwrap_or(1);
        let camera = Camera { intrinsics: self.camera.intrinsics.downscaled(k), ..self.camera };
        View { name: self.name.clone(), camera, image: image::downscale(&self.image, k), depth: None }
    }

    /// Returns the whole image over `background`, [height, width, 3] in [0, 1].
    pub fn composite(&self, background: [f32; 3]) -> Array3<f32> {
        image::composite(&self.image, background)
    }
}

/// Returns true if some pixel of some view is transparent. Alpha then separates object and background in all views.
pub fn has_alpha(views: &[View]) -> bool {
    views.iter().any(|view| view.image.pixels().any(|pixel| pixel.0[3] == 0))
}

/// Options for opening a folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenOptions {
    /// Factor by which every image is reduced; must divide width and height. 1 keeps the full size.
    pub downscale: usize,
    /// Interval at which training views are held out for validation, if the files have no validation split: every n-th view (number n - 1,
    /// 2n - 1, ...). At least 2. `None` leaves the validation split empty.
    pub validation_every: Option<usize>,
}

impl Default for OpenOptions {
    fn default() -> Self {
        OpenOptions { downscale: 1, validation_every: None }
    }
}

/// Dataset of three splits, whose views are read or rendered on demand.
#[derive(Debug, Clone)]
pub struct Dataset {
    name: String,
    format: &'static str,
    size: (usize, usize),
    frames: [Vec<Frame>; 3],
    source: Source,
}

/// View before its pixels are loaded.
#[derive(Debug, Clone)]
struct Frame {
    name: String,
    /// Camera with the intrinsics after the reduction.
    camera: Camera,
    /// Path of the image; empty for a rendered view.
    path: PathBuf,
}

#[derive(Debug, Clone)]
enum Source {
    Files { downscale: usize },
    Procedural { scene: Arc<procedural::Scene>, supersample: usize },
}

/// Opens the dataset in the folder `path`. The only supported format is NeRF-synthetic ([`blender`]), recognized by its
/// transforms_train.json.
///
/// Errors if a file is invalid, naming file and frame; also if `options` do not fit the images (a configuration error).
pub fn open(path: &Path, options: &OpenOptions) -> Result<Dataset> {
    if let Some(every @ 0..=1) = options.validation_every {
        return Err(Error::config("validation_every", every, "2 or more"));
    }
    let metadata = std::fs::metadata(path).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => {
            Error::input(path, "there is no such folder", "give the folder that contains transforms_train.json")
        }
        _ => Error::io(path, source, "opening the dataset"),
    })?;
    if !metadata.is_dir() {
        return Err(Error::input(path, "this is a file", "give the folder that contains transforms_train.json"));
    }
    // A file of this name that cannot be read is reported as unreadable, not as missing.
    if !files::is_there(&path.join("transforms_train.json")) {
        return Err(unrecognized(path));
    }
    blender::open(path, options)
}

impl Dataset {
    /// Creates the built-in analytic scene with the given numbers of views. Every view has exact depth.
    ///
    /// Errors with a configuration error if a size is 0 or beyond [`image::MAX_SIDE`], if there is no training view, or if the
    /// supersampling is 0 or above 16.
    pub fn procedural(options: ProceduralOptions) -> Result<Self> {
        procedural::dataset(options)
    }

    /// Returns the name of the scene: the folder's name, or "procedural".
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the recognized format, as text for people.
    pub fn format(&self) -> &'static str {
        self.format
    }

    /// Returns the number of views in a split.
    pub fn count(&self, split: Split) -> usize {
        self.frames(split).len()
    }

    /// Returns width and height of the images, after the reduction.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Returns the cameras of a split, in the order of its views.
    pub fn cameras(&self, split: Split) -> Vec<Camera> {
        self.frames(split).iter().map(|frame| frame.camera).collect()
    }

    /// Returns the names of a split's views, in order.
    pub fn view_names(&self, split: Split) -> Vec<&str> {
        self.frames(split).iter().map(|frame| frame.name.as_str()).collect()
    }

    /// Returns the analytic scene of a procedural dataset, for exact queries about its geometry.
    pub fn scene(&self) -> Option<&procedural::Scene> {
        match &self.source {
            Source::Procedural { scene, .. } => Some(scene),
            Source::Files { .. } => None,
        }
    }

    /// Decodes or renders the views of a split in parallel. The result is in the order of the files. `progress(done, total)` is called
    /// after each view, from any thread, with `done` from 1 to `total`, not necessarily in order.
    ///
    /// Memory: 4 bytes per pixel, and 4 more if depth is known. Errors if a view cannot be read; the first such view is reported.
    pub fn load(&self, split: Split, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<Vec<View>> {
        self.load_views(split, &(0..self.count(split)).collect::<Vec<_>>(), progress)
    }

    /// Decodes or renders some views of a split, in the order of their numbers. `progress(done, total)` is called from several threads.
    ///
    /// Errors as for [`load`](Self::load).
    ///
    /// Panics if a number is out of range.
    pub fn load_views(&self, split: Split, numbers: &[usize], progress: &(dyn Fn(usize, usize) + Sync)) -> Result<Vec<View>> {
        let frames = self.frames(split);
        let done = AtomicUsize::new(0);
        let views: Vec<Result<View>> = numbers
            .par_iter()
            .map(|&number| {
                let view = self.load_frame(&frames[number]);
                progress(done.fetch_add(1, Ordering::Relaxed) + 1, numbers.len());
                view
            })
            .collect();
        // Collect in two steps, so that of several broken files the first is always reported.
        views.into_iter().collect()
    }

    /// Decodes or renders one view of a split; views are numbered in the order of the files.
    ///
    /// Panics if the number is out of range. Errors if the view cannot be read.
    pub fn load_view(&self, split: Split, number: usize) -> Result<View> {
        self.load_frame(&self.frames(split)[number])
    }

    /// Writes all views to the folder `path` in the NeRF-synthetic format. If depth is known, it also writes 16-bit depth images of the
    /// test views, in thousandths of a world unit, 0 for rays that hit nothing.
    ///
    /// Errors if the folder is not empty, unless `overwrite`; if a camera has a lens, non-square pixels or a principal point off the centre,
    /// which the format cannot express; or if a file cannot be written.
    pub fn write_blender(&self, path: &Path, overwrite: bool) -> Result<()> {
        self.write_blender_changed(path, overwrite, &|_, _| ())
    }

    /// Writes the dataset like [`write_blender`](Self::write_blender), with images modified by `change`, for example [`exposure::spread`].
    /// `change` receives all views of a split.
    pub fn write_blender_changed(&self, path: &Path, overwrite: bool, change: &dyn Fn(Split, &mut [View])) -> Result<()> {
        blender::write(self, path, overwrite, change)
    }

    fn frames(&self, split: Split) -> &[Frame] {
        &self.frames[split as usize]
    }

    fn load_frame(&self, frame: &Frame) -> Result<View> {
        let (name, camera) = (frame.name.clone(), frame.camera);
        match &self.source {
            Source::Files { downscale } => {
                let full = image::read(&frame.path)?;
                if (full.width() as usize, full.height() as usize) != (self.size.0 * downscale, self.size.1 * downscale) {
                    return Err(Error::input(&frame.path, "the size of the image changed after the dataset was opened", "open it again"));
                }
                let image = if *downscale == 1 { full } else { image::downscale(&full, *downscale) };
                Ok(View { name, camera, image, depth: None })
            }
            Source::Procedural { scene, supersample } => {
                let (image, depth) = scene.render(&camera, *supersample);
                Ok(View { name, camera, image, depth: Some(depth) })
            }
        }
    }
}

/// Returns the error for a folder without transforms_train.json. It lists the content and guesses the format.
fn unrecognized(path: &Path) -> Error {
    let mut names: Vec<String> = match std::fs::read_dir(path) {
        Ok(entries) => entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect(),
        Err(source) => return Error::io(path, source, "listing the folder"),
    };
    names.sort();
    let listed = match names.len() {
        0 => "it is empty".to_owned(),
        n if n <= 8 => format!("it contains {}", names.join(", ")),
        n => format!("it contains {} and {} more", names[..8].join(", "), n - 8),
    };
    let has = |name: &str| names.iter().any(|found| found == name);
    let below = names.iter().find(|name| path.join(name).join("transforms_train.json").exists());
    let remedy = if let Some(scene) = below {
        format!("give one scene, for example {}", path.join(scene).display())
    } else if has("transforms.json") {
        "a dataset in a single transforms.json, as for instant-ngp and nerfstudio, is not supported yet; use a NeRF-synthetic folder".into()
    } else if has("poses_bounds.npy") {
        "LLFF captures (poses_bounds.npy) are not supported yet; use a NeRF-synthetic folder".into()
    } else if has("sparse") {
        "COLMAP reconstructions (sparse/) are not supported yet; use a NeRF-synthetic folder".into()
    } else {
        "use a NeRF-synthetic folder, with transforms_train.json and the images that it lists".into()
    };
    Error::input(path, format!("no transforms_train.json in this folder, {listed}"), remedy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_are_written_and_read_by_the_same_names() {
        for split in Split::ALL {
            assert_eq!(split.to_string().parse::<Split>().unwrap(), split);
        }
        let error = "valid".parse::<Split>().unwrap_err();
        assert_eq!(error.to_string(), "split: invalid value \"valid\"; expected train, val, test");
    }
}
