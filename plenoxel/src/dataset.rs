//! Photographs with known cameras, independent of the file format.
//!
//! [`open`] recognizes the format of a folder: NeRF-synthetic ([`blender`]), whose coordinates are the world's, or a capture
//! ([`transforms`], [`colmap`], [`llff`], [`nsvf`]), which is moved and scaled first ([`normalize`]). A program may also give photographs in memory
//! ([`memory`]).
//!
//! Opening a [`Dataset`] is cheap: all metadata is parsed and the header of every image is checked, so that a broken file is reported at
//! once. Pixels are decoded when a split is loaded. [`Dataset::procedural`] is the built-in scene, which needs no files and has exact
//! depth.

pub mod blender;
pub mod capture;
pub mod colmap;
pub mod exposure;
pub mod image;
pub mod llff;
pub mod mask;
pub mod memory;
pub mod normalize;
mod npy;
pub mod nsvf;
pub mod procedural;
pub mod transforms;

use crate::camera::{Camera, Intrinsics};
use crate::error::{Error, Result};
use crate::files;
use crate::geometry::Similarity;
use crate::space::Space;
use capture::Point;
use mask::Mask;
use ndarray::{Array2, Array3};
use normalize::{CaptureOptions, FormatChoice, Normalization};
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
    /// Pixels to use, of the size of `image`; `None` for all.
    pub mask: Option<Mask>,
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

    /// Returns true if pixel (x, y) is not ignored by the mask.
    #[inline]
    pub fn keeps(&self, x: usize, y: usize) -> bool {
        self.mask.as_ref().is_none_or(|mask| mask.keeps(x, y))
    }

    /// Returns the view with its image reduced by `k` along both axes with a box filter. If k does not divide both sides, the largest
    /// smaller divisor is used. The result has no depth.
    pub fn reduced(&self, k: usize) -> Self {
        let (width, height) = self.image.dimensions();
        let divides = |k: &usize| width.is_multiple_of(*k as u32) && height.is_multiple_of(*k as u32);
        let k = (1..=k).rev().find(divides).unwrap_or(1);
        let camera = Camera { intrinsics: self.camera.intrinsics.downscaled(k), ..self.camera };
        let mask = self.mask.as_ref().map(|mask| mask.reduced(k));
        View { name: self.name.clone(), camera, image: image::downscale(&self.image, k), depth: None, mask }
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
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OpenOptions {
    /// Factor by which every image is reduced. 1 keeps the full size. For a NeRF-synthetic folder it must divide width and height. For a
    /// capture, the folder `images_k` of images that are reduced already is used if it exists, and incomplete blocks at the right and
    /// bottom are dropped.
    pub downscale: usize,
    /// Interval at which training views are held out for validation, if the files have no validation split: every n-th view (number n - 1,
    /// 2n - 1, ...). At least 2. `None` leaves the validation split empty.
    pub validation_every: Option<usize>,
    /// Choices about a capture. A NeRF-synthetic folder has only defaults.
    pub capture: CaptureOptions,
}

impl Default for OpenOptions {
    fn default() -> Self {
        OpenOptions { downscale: 1, validation_every: None, capture: CaptureOptions::default() }
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
    normalization: Normalization,
    points: Arc<Vec<Point>>,
    notes: Vec<String>,
}

/// View before its pixels are loaded.
#[derive(Debug, Clone)]
struct Frame {
    name: String,
    /// Camera with the intrinsics after the reduction.
    camera: Camera,
    /// Path of the image; empty for a rendered view and for one in memory.
    path: PathBuf,
    /// Path of the mask.
    mask: Option<PathBuf>,
    /// Orientation in which the image has the shape of the camera's.
    orientation: image::Orientation,
    /// Width and height of the image before the reduction.
    full: (usize, usize),
}

#[derive(Debug, Clone)]
enum Source {
    Files { downscale: usize },
    Procedural { scene: Arc<procedural::Scene>, supersample: usize },
    Memory { photographs: Arc<memory::Photographs>, downscale: usize },
}

/// Opens the dataset in the folder `path`, in the first of these formats that it has: NeRF-synthetic (transforms_train.json,
/// [`blender`]), transforms.json ([`transforms`]), COLMAP ([`colmap`]), LLFF (poses_bounds.npy, [`llff`]), NSVF (intrinsics.txt, [`nsvf`]);
/// or in the format that `options` choose.
///
/// Errors if a file is invalid, naming file and frame; also if `options` do not fit the images (a configuration error).
pub fn open(path: &Path, options: &OpenOptions) -> Result<Dataset> {
    if let Some(every @ 0..=1) = options.validation_every {
        return Err(Error::config("validation_every", every, "2 or more"));
    }
    options.capture.validate()?;
    if options.downscale == 0 {
        return Err(Error::config("downscale", 0, "1 or more"));
    }
    let remedy = "give the folder that contains transforms_train.json, transforms.json, sparse or poses_bounds.npy";
    let metadata = std::fs::metadata(path).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => Error::input(path, "there is no such folder", remedy),
        _ => Error::io(path, source, "opening the dataset"),
    })?;
    if !metadata.is_dir() {
        return Err(Error::input(path, "this is a file", remedy));
    }
    let mut formats = formats(path);
    let asked = options.capture.format;
    if asked != FormatChoice::Auto && !formats.is_empty() {
        let Some(chosen) = formats.iter().position(|format| format.choice() == asked) else {
            let found = formats.iter().map(Format::what).collect::<Vec<_>>().join(" and ");
            let problem = format!("{} has {found}, but no files of the format {asked}", path.display());
            return Err(Error::usage("format", problem, "leave it out, or choose a format that the folder has"));
        };
        formats.swap(0, chosen);
    }
    let mut capture = match formats.first() {
        Some(Format::Blender) => return blender::open(path, options),
        Some(Format::Transforms) => transforms::read(path, options.downscale),
        Some(Format::Colmap(model)) => colmap::read(path, model, options.downscale),
        Some(Format::Llff) => llff::read(path, options.downscale),
        Some(Format::Nsvf(poses)) => nsvf::read(path, poses),
        None => return Err(unrecognized(path)),
    }?;
    for other in &formats[1..] {
        capture.notes.push(format!("the folder also has {}, which --format {} reads", other.what(), other.choice()));
    }
    capture::dataset(path, capture, options)
}

/// Returns true if [`open`] opens the folder as a capture, not as a NeRF-synthetic scene. Files are not read.
pub fn is_capture(path: &Path) -> bool {
    formats(path).first().is_some_and(|format| !matches!(format, Format::Blender))
}

/// Format of a folder, with the path of the folder that has the poses, where it may have several names.
enum Format {
    Blender,
    Transforms,
    Colmap(PathBuf),
    Llff,
    Nsvf(PathBuf),
}

impl Format {
    /// Returns the choice of this format.
    fn choice(&self) -> FormatChoice {
        match self {
            Format::Blender => FormatChoice::Auto,
            Format::Transforms => FormatChoice::Transforms,
            Format::Colmap(_) => FormatChoice::Colmap,
            Format::Llff => FormatChoice::Llff,
            Format::Nsvf(_) => FormatChoice::Nsvf,
        }
    }

    /// Returns what the folder has of this format.
    fn what(&self) -> &'static str {
        match self {
            Format::Blender => "transforms_train.json",
            Format::Transforms => transforms::FILE,
            Format::Colmap(_) => "a reconstruction of COLMAP",
            Format::Llff => llff::FILE,
            Format::Nsvf(_) => nsvf::FILE,
        }
    }
}

/// Returns the formats whose files a folder has; the first is the one that is read.
fn formats(path: &Path) -> Vec<Format> {
    // A file of this name that cannot be read is reported as unreadable, not as missing.
    let has = |name: &str| files::is_there(&path.join(name));
    let found = [
        has("transforms_train.json").then_some(Format::Blender),
        has(transforms::FILE).then_some(Format::Transforms),
        colmap::find(path).map(Format::Colmap),
        has(llff::FILE).then_some(Format::Llff),
        nsvf::poses(path).filter(|_| has(nsvf::FILE)).map(Format::Nsvf),
    ];
    found.into_iter().flatten().collect()
}

/// Returns the largest width and the largest height of images.
fn largest(frames: &[Vec<Frame>; 3]) -> (usize, usize) {
    let most = |side: fn(&Intrinsics) -> usize| frames.iter().flatten().map(|frame| side(&frame.camera.intrinsics)).max().unwrap_or(0);
    (most(|k| k.width), most(|k| k.height))
}

/// Returns the name of the scene in a folder.
fn scene_name(root: &Path) -> String {
    let name = root.canonicalize().ok().and_then(|path| path.file_name().map(|name| name.to_string_lossy().into_owned()));
    name.unwrap_or_else(|| "scene".into())
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

    /// Returns width and height of the images, after the reduction. If images have several sizes, these are the largest width
    /// and the largest height.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Returns all sizes of images, width and height after the reduction, with the number of views that have them; the most frequent first.
    pub fn sizes(&self) -> Vec<((usize, usize), usize)> {
        let mut counts = std::collections::BTreeMap::new();
        for frame in self.frames.iter().flatten() {
            *counts.entry((frame.camera.intrinsics.width, frame.camera.intrinsics.height)).or_insert(0) += 1;
        }
        let mut sizes: Vec<_> = counts.into_iter().collect();
        sizes.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        sizes
    }

    /// Returns the space that fits the cameras, and how it was chosen.
    pub fn normalization(&self) -> &Normalization {
        &self.normalization
    }

    /// Returns the space that fits the cameras.
    pub fn space(&self) -> Space {
        self.normalization.space
    }

    /// Returns the similarity from the world to the frame of the files, for exports. It is the identity for NeRF-synthetic folders and the
    /// built-in scene.
    pub fn to_input(&self) -> Similarity {
        self.normalization.to_world.inverse()
    }

    /// Returns points of the scene's surfaces in world coordinates, if structure from motion found any.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Returns what a person should know about the files, such as images that are missing, as sentences without a stop.
    pub fn notes(&self) -> &[String] {
        &self.notes
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
            Source::Files { .. } | Source::Memory { .. } => None,
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
                let full = image::read_as(&frame.path, frame.orientation)?;
                if (full.width() as usize, full.height() as usize) != frame.full {
                    return Err(Error::input(&frame.path, "the size of the image changed after the dataset was opened", "open it again"));
                }
                let image = if *downscale == 1 { full } else { image::downscale(&image::cropped(full, *downscale), *downscale) };
                let mask = frame.mask.as_ref().map(|mask| Mask::read(mask, frame.full)).transpose()?;
                let mask = mask.map(|mask| if *downscale == 1 { mask } else { mask.reduced(*downscale) });
                Ok(View { name, camera, image, depth: None, mask })
            }
            Source::Procedural { scene, supersample } => {
                let (image, depth) = scene.render(&camera, *supersample);
                Ok(View { name, camera, image, depth: Some(depth), mask: None })
            }
            Source::Memory { photographs, downscale } => {
                let view = photographs.view(&name, camera, *downscale);
                view.ok_or_else(|| Error::input(name, "there is no such view in memory", "this is a bug in the program"))
            }
        }
    }
}

/// Returns the error for a folder without a known format. It lists the content and guesses what is missing.
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
    let files = ["transforms_train.json", "transforms.json", "sparse", "poses_bounds.npy", "intrinsics.txt"];
    let is_scene = |folder: &Path| files.iter().any(|file| folder.join(file).exists());
    let below = names.iter().find(|name| is_scene(&path.join(name)));
    let above = path.parent().map(|parent| if parent == Path::new("") { Path::new("..") } else { parent });
    let remedy = if let Some(scene) = below {
        format!("give one scene, for example {}", path.join(scene).display())
    } else if let Some(scene) = above.filter(|folder| is_scene(folder)) {
        format!("give the folder of the scene, {}", scene.display())
    } else if has("sparse") || has("colmap") {
        "the reconstruction lacks its cameras or images: expected cameras.bin and images.bin, or .txt, in sparse/0".into()
    } else if names.iter().any(|name| image::is_photograph(name)) {
        format!("photographs need cameras: `plenoxel cameras {}` computes them with COLMAP", path.display())
    } else {
        "use a NeRF-synthetic folder, or a capture with transforms.json, sparse/0 of COLMAP, poses_bounds.npy, or intrinsics.txt of NSVF"
            .into()
    };
    Error::input(path, format!("no format is recognized in this folder, {listed}"), remedy)
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
