//! Photographs with known cameras, whatever the format they came in.
//!
//! A [`Dataset`] is opened cheaply: all metadata is parsed and every image's header is checked, so that a broken file is
//! reported at once, but pixels are decoded only when a split is loaded. [`open`] recognizes the format of a folder;
//! [`Dataset::procedural`] is the built-in scene, which needs no files and knows its exact depth.

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

/// The three parts of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Split {
    /// Views to learn from.
    Train,
    /// Views to choose settings with.
    Val,
    /// Views to report numbers on.
    Test,
}

impl Split {
    /// All three, in the usual order.
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

/// One photograph and the camera that took it.
#[derive(Debug, Clone)]
pub struct View {
    /// The file's name without folder and extension, such as "r_17".
    pub name: String,
    /// Where it was taken from; its intrinsics have the size of `image`.
    pub camera: Camera,
    /// 8-bit sRGB with straight alpha.
    pub image: image::RgbaImage,
    /// Distance along the unit ray of each pixel's centre to the first surface, [height, width], infinite where there is none;
    /// only where it is known exactly.
    pub depth: Option<Array2<f32>>,
}

impl View {
    /// Width and height of the image in pixels.
    pub fn size(&self) -> [usize; 2] {
        [self.image.width() as usize, self.image.height() as usize]
    }

    /// Color of pixel (x, y) over `background`: rgb a + background (1 - a) on sRGB values in [0, 1].
    #[inline]
    pub fn color(&self, x: usize, y: usize, background: [f32; 3]) -> [f32; 3] {
        image::color(&self.image, x, y, background)
    }

    /// Alpha of pixel (x, y) in [0, 1].
    #[inline]
    pub fn alpha(&self, x: usize, y: usize) -> f32 {
        f32::from(self.image.get_pixel(x as u32, y as u32).0[3]) / 255.0
    }

    /// The same with an image reduced by `k` in both directions, with a box filter, or by the largest number below that divides its sides.
    /// There is no depth of it.
    pub fn reduced(&self, k: usize) -> Self {
        let (width, height) = self.image.dimensions();
        let divides = |k: &usize| width.is_multiple_of(*k as u32) && height.is_multiple_of(*k as u32);
        let k = (1..=k).rev().find(divides).unwrap_or(1);
        let camera = Camera { intrinsics: self.camera.intrinsics.downscaled(k), ..self.camera };
        View { name: self.name.clone(), camera, image: image::downscale(&self.image, k), depth: None }
    }

    /// The whole picture over `background`, [height, width, 3] in [0, 1].
    pub fn composite(&self, background: [f32; 3]) -> Array3<f32> {
        image::composite(&self.image, background)
    }
}

/// True if some pixel of some view is transparent: then alpha says in all of them what is object and what is background.
pub fn has_alpha(views: &[View]) -> bool {
    views.iter().any(|view| view.image.pixels().any(|pixel| pixel.0[3] == 0))
}

/// How to open a folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenOptions {
    /// Reduce every image this many times; must divide width and height. 1 leaves them as they are.
    pub downscale: usize,
    /// Without a validation split in the files, hold out every n-th training view (number n - 1, 2n - 1, ...) for validation;
    /// at least 2. `None` leaves the validation split empty.
    pub validation_every: Option<usize>,
}

impl Default for OpenOptions {
    fn default() -> Self {
        OpenOptions { downscale: 1, validation_every: None }
    }
}

/// Views in three splits, read or rendered when asked for.
#[derive(Debug, Clone)]
pub struct Dataset {
    name: String,
    format: &'static str,
    size: (usize, usize),
    frames: [Vec<Frame>; 3],
    source: Source,
}

/// What is known of a view before its pixels are.
#[derive(Debug, Clone)]
struct Frame {
    name: String,
    /// With the intrinsics after the reduction.
    camera: Camera,
    /// Empty for a rendered view.
    path: PathBuf,
}

#[derive(Debug, Clone)]
enum Source {
    Files { downscale: usize },
    Procedural { scene: Arc<procedural::Scene>, supersample: usize },
}

/// Opens the dataset in the folder `path`. The one format so far is NeRF-synthetic ([`blender`]), recognized by its
/// transforms_train.json.
///
/// Errors: bad input that names the file and the frame; a configuration error for `options` that do not fit the images.
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
    // What has that name and cannot be read is reported as such.
    if !files::is_there(&path.join("transforms_train.json")) {
        return Err(unrecognized(path));
    }
    blender::open(path, options)
}

impl Dataset {
    /// The built-in analytic scene with the given number of views; exact depth comes with every view.
    ///
    /// Errors: a configuration error for sizes of 0 or beyond [`image::MAX_SIDE`], for no training view and for a
    /// supersampling of 0 or above 16.
    pub fn procedural(options: ProceduralOptions) -> Result<Self> {
        procedural::dataset(options)
    }

    /// Name of the scene: the folder's name, or "procedural".
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The format that was recognized, in words for people.
    pub fn format(&self) -> &'static str {
        self.format
    }

    /// Number of views in a split.
    pub fn count(&self, split: Split) -> usize {
        self.frames(split).len()
    }

    /// Width and height of every image, after the reduction.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// The cameras of a split, in the order of its views.
    pub fn cameras(&self, split: Split) -> Vec<Camera> {
        self.frames(split).iter().map(|frame| frame.camera).collect()
    }

    /// The names of a split's views, in their order.
    pub fn view_names(&self, split: Split) -> Vec<&str> {
        self.frames(split).iter().map(|frame| frame.name.as_str()).collect()
    }

    /// The analytic scene behind a procedural dataset, for exact answers about space.
    pub fn scene(&self) -> Option<&procedural::Scene> {
        match &self.source {
            Source::Procedural { scene, .. } => Some(scene),
            Source::Files { .. } => None,
        }
    }

    /// Decodes (or renders) the views of a split in parallel, in the order of the files. `progress(done, total)` is called
    /// after each view, from any thread, with `done` from 1 to `total` not necessarily in order.
    ///
    /// Memory: 4 bytes a pixel, and 4 more where depth is known. Errors: the first view, in order, that cannot be read.
    pub fn load(&self, split: Split, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<Vec<View>> {
        self.load_views(split, &(0..self.count(split)).collect::<Vec<_>>(), progress)
    }

    /// Reads or renders some views of a split, in the order of their numbers. `progress(done, total)` is called from several threads.
    ///
    /// Errors as for [`load`](Self::load).
    ///
    /// Panics if there is no such view.
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
        // Collected in two steps: of several broken files it is always the first that is reported.
        views.into_iter().collect()
    }

    /// Decodes (or renders) one view of a split, in the order of the files.
    ///
    /// Panics if there are not so many. Errors: it cannot be read.
    pub fn load_view(&self, split: Split, number: usize) -> Result<View> {
        self.load_frame(&self.frames(split)[number])
    }

    /// Writes all views to the folder `path` in the NeRF-synthetic format, with 16-bit depth pictures beside the test views
    /// where depth is known (thousandths of a world unit, 0 where nothing was hit).
    ///
    /// Errors: a folder that is not empty unless `overwrite`; cameras without square pixels and a centred principal point,
    /// which the format cannot express; the disk's refusal.
    pub fn write_blender(&self, path: &Path, overwrite: bool) -> Result<()> {
        self.write_blender_changed(path, overwrite, &|_, _| ())
    }

    /// The same with images that `change` has changed, such as [`exposure::spread`]; it gets all views of a split at a time.
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
                    return Err(Error::input(&frame.path, "the image changed its size after the dataset was opened", "open it again"));
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

/// Says what is in a folder that has no transforms_train.json, and guesses what the user meant.
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
        format!("give one scene, for instance {}", path.join(scene).display())
    } else if has("transforms.json") {
        "a dataset in a single transforms.json, as of instant-ngp and nerfstudio, is not supported yet; NeRF-synthetic folders are".into()
    } else if has("poses_bounds.npy") {
        "LLFF captures (poses_bounds.npy) are not read yet; NeRF-synthetic folders are".into()
    } else if has("sparse") {
        "COLMAP reconstructions (sparse/) are not read yet; NeRF-synthetic folders are".into()
    } else {
        "a NeRF-synthetic folder has transforms_train.json and the images it lists".into()
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
