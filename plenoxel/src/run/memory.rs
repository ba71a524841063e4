//! Memory estimates of commands, made before the memory is allocated, and the available memory.
//!
//! An estimate is the sum of the images, the tables of the grid, the optimizer state, and the arrays that a training step keeps for its gradient.
//! The last part depends on the number of samples per ray: those between two faces of the box, or fewer after pruning to the voxels near surfaces.

pub use crate::memory::{available, bytes, limit, now, peak};

use super::machine;
use super::training::RunOptions;
use crate::carve::Fit;
use crate::carve::color::KEPT_LIGHT;
use crate::carve::visual_hull::silhouette_bytes;
use crate::checkpoint;
use crate::dataset::{Dataset, Split};
use crate::error::{Error, Result};
use crate::field::voxel_grid::fused::CHUNK;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::geometry::Aabb;
use crate::memory;
use crate::model::plenoxels::config::{Config, Hull, OptimizerConfig, Sampling};
use crate::model::recipe::{Memory, Recipe};
use crate::model::{self, plenoxels, recipe};
use crate::render::{Engine, picture};
use crate::tensor_file::TensorFile;
use std::path::Path;

/// An estimate in bytes, by purpose.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// 8-bit images of the training views or of the test views, whichever are more, full-size images during decoding, and the pictures of the page of `--view`.
    pub images: u64,
    /// Tables of the finest grid, of the previous grid, and of kept stages.
    pub grid: u64,
    /// Optimizer state.
    pub optimizer: u64,
    /// Samples, intermediate values and gradients of one step, or the memory of evaluating or saving if that is more.
    pub step: u64,
    /// True if the estimate depends on the number of voxels after pruning, of which only the expectation is known.
    expected: bool,
    /// Setting with the largest part, and the remedy.
    key: String,
    advice: &'static str,
}

/// Program, threads and temporary buffers, measured on small runs.
const BASE: u64 = 60_000_000;
/// Pixels whose voxels are in memory at a time during carving, 12 bytes for each voxel and in up to three copies.
const CARVING_PIXELS: u64 = 1 << 16;
/// Bytes per pixel of rendered pictures: five numbers each for colors and normals, their encoded form, and the file.
const PICTURE_BYTES: u64 = 100;
/// Advice for the page of `--view`, for messages.
const LEAVE_OUT: &str = "leave it out";
/// Bytes per pixel of a view during its comparison with the photograph: the picture, the photograph in floats, and both in double precision for SSIM.
const COMPARED_BYTES: u64 = 82;
/// Bytes per pixel of a view while its panel is drawn at the end of training: picture, photograph, error and depth, all four side by side in floats
/// and in 8 bits, and the mean of the training images.
const DRAWN_BYTES: u64 = 130;
/// Maximum memory for building report.html: its grid of up to 30 MB exists compressed, as text, and as a part of longer texts.
const PAGE_BYTES: u64 = 150_000_000;
/// Rays per batch during evaluation. Larger tiles, of fused pictures of voxel grids, keep no samples.
const EVALUATION_RAYS: u64 = (picture::TILE * picture::TILE) as u64;

impl Estimate {
    /// Estimates a training run and its evaluation; `initial` is the initial grid (`init_from`), if there is one.
    pub fn of_training(config: &Config, dataset: &Dataset, initial: Option<&Stored>, options: &RunOptions) -> Self {
        let states = states(config);
        let of_initial = initial.map_or(1.0, Stored::share);
        let share = |config: &Config, stage: usize| share(config, stage).min(of_initial);
        // Bytes of a stage's tables, and of its and the previous stage's tables at its start.
        let tables = |index: usize| (share(config, index) * config.grid_shape(config.stages[index].resolution).bytes() as f64) as u64;
        let begins = |index: usize| {
            let before = share(config, index.saturating_sub(1));
            let outline = OUTLINE as f64 * before * config.grid_shape(config.stages[index].resolution).voxels() as f64;
            // The first grid is dense, unless it is the initial one.
            let dense = index == 0 && initial.is_none();
            let own = if dense { config.grid_shape(config.stages[0].resolution).bytes() as u64 } else { tables(index) };
            let before = if options.stage_psnr { (0..index).map(tables).sum() } else { index.checked_sub(1).map_or(0, tables) };
            before + (outline as u64).max(own)
        };
        let finest = (0..config.stages.len()).max_by_key(|&index| tables(index) * (1 + states));
        let index = finest.unwrap_or(0);
        let shape = config.grid_shape(config.stages[index].resolution);
        let optimizer = states * tables(index);
        let rays = config.rays_per_step as u64;
        let step = config.stages.iter().enumerate().map(|(index, stage)| {
            let shape = config.grid_shape(stage.resolution);
            let samples = rays * (mean_samples(stage.sampling, &shape) as f64 * crossed(config, index)).ceil() as u64;
            // The fused engine keeps the samples of one chunk. It accumulates rows chunk by chunk: the rows so far, those of a chunk, and their sum.
            let chunked = config.engine == Engine::Fused && rays > CHUNK as u64;
            let kept = if chunked { samples / rays * CHUNK as u64 } else { samples };
            let gradient = match whole_grid_losses(config) {
                // Dense gradients.
                true => tables(index),
                false => 0,
            };
            // Otherwise it accumulates rows directly for the optimizer.
            let rows = match config.engine == Engine::Graph || whole_grid_losses(config) {
                _ if chunked => 3 * touched_rows(&shape, samples),
                true => touched_rows(&shape, samples),
                false => 0,
            };
            // Origins, directions, targets and pixels, some of them in two copies.
            let batch = rays * 200;
            kept * training_bytes_per_sample(config.engine, &shape) + batch + rows + gradient
        });
        let (width, height) = dataset.size();
        let hull = if config.hull == Hull::Auto { silhouette_bytes(dataset.count(Split::Train), width * height) } else { 0 };
        let step = step.max().unwrap_or(0).max(hull);
        let comparison = if options.test_views > 0 { comparison(dataset, Split::Test, DRAWN_BYTES) } else { 0 };
        let shown = PICTURE_BYTES * options.shown_pixels as u64;
        let evaluation = evaluation_samples(config, config.evaluation, &shape) * evaluation_bytes_per_sample(config.engine, &shape);
        // A copy of the tables as bytes.
        let saving = tables(index);
        let page = if options.report { page(tables(index)) } else { 0 };
        // It renders after the optimizer state is freed.
        let reporting = (evaluation + comparison.max(page)).saturating_sub(optimizer);
        let views = dataset.count(Split::Train).max(dataset.count(Split::Test).min(options.test_views));
        let images = images(dataset, config.downscale, views) + importance(config, dataset);
        let grid = (0..config.stages.len()).map(begins).max().unwrap_or(0) + 2 * initial.map_or(0, Stored::bytes);
        let voxels = (format!("stages[{index}].resolution"), "use fewer voxels per side, a lower sh_degree, or a higher sh_reduction");
        let parts = [
            (images + comparison.max(hull), ("downscale".to_owned(), "reduce the images by a larger factor")),
            (step, ("rays_per_step".to_owned(), "use fewer rays per step")),
            (evaluation, ("evaluation".to_owned(), "use fewer samples per ray")),
            (grid + optimizer + saving, voxels),
            (page, ("report.html".to_owned(), "leave it out with --no-report")),
            (shown, ("--view".to_owned(), LEAVE_OUT)),
        ];
        let (key, advice) = parts.into_iter().max_by_key(|(bytes, _)| *bytes).map(|(_, setting)| setting).unwrap_or_default();
        Estimate {
            images: images + shown,
            grid,
            optimizer,
            // The free buffers of the graph engine differ in size between training and evaluation, and both are kept.
            step: if config.engine == Engine::Graph { step + evaluation } else { step.max(evaluation) }.max(saving).max(reporting),
            expected: share(config, index) < 1.0,
            key,
            advice,
        }
    }

    /// Returns the maximum number of table rows that fit into the available memory, if that is known. The actual number is known only after pruning.
    pub fn most_rows(&self, config: &Config) -> Option<usize> {
        let held = self.grid + self.optimizer;
        // Tables, optimizer state, and the tables of the previous stage.
        let row = (2 + states(config)) * config.grid_shape(1).voxel_bytes() as u64;
        available().map(|available| (available.saturating_sub(self.total() - held) / row) as usize)
    }

    /// Estimates rendering a stored model, and comparing it with at most so many views of a split if `compare` has one.
    pub fn of_evaluation(config: &Config, sampling: Sampling, stored: &Stored, compare: Option<(&Dataset, Split, usize)>) -> Self {
        let rendering = match stored {
            Stored::Grid { shape, .. } => evaluation_samples(config, sampling, shape) * evaluation_bytes_per_sample(config.engine, shape),
            Stored::Other { recipe, .. } => EVALUATION_RAYS * recipe.memory(config.engine).ray_of_picture,
        };
        Estimate {
            images: compare.map_or(0, |(dataset, split, most)| images(dataset, config.downscale, dataset.count(split).min(most))),
            // The file, the tables read from it, and those of pictures.
            grid: 2 * stored.bytes() + picture_tables(config, stored),
            optimizer: 0,
            step: rendering + compare.map_or(0, |(dataset, split, _)| comparison(dataset, split, COMPARED_BYTES)),
            expected: false,
            key: "RUN".to_owned(),
            advice: "use a machine with more memory, or fewer --samples",
        }
    }

    /// Estimates finding the visibility of the voxels of a grid in the training views
    /// ([`visibility`](crate::run::visibility::visibility())).
    pub fn of_visibility(config: &Config, grid: &VoxelGrid<f32>, dataset: &Dataset) -> Self {
        let stored = Stored::Grid { shape: *grid.shape(), voxels: grid.lattice().present() };
        let rendering = Self::of_evaluation(config, config.evaluation, &stored, Some((dataset, Split::Train, usize::MAX)));
        // The sums of each row.
        let sums = grid.lattice().rows() * (size_of::<[u64; 5]>() + size_of::<[f32; 6]>());
        Estimate { grid: rendering.grid + sums as u64, ..rendering }
    }

    /// Estimates writing the report of a run whose grid has `voxels` voxels. A few views are rendered for it.
    pub fn of_report(config: &Config, stored: &Stored) -> Self {
        let rendering = Self::of_evaluation(config, config.evaluation, stored, None);
        let step = rendering.step + page(stored.bytes());
        Estimate { step, advice: "use a machine with more memory", ..rendering }
    }

    /// Estimates rendering a trained grid of `voxels` voxels to pictures of `pixels` pixels, with or without its normals.
    pub fn of_pictures(config: &Config, sampling: Sampling, stored: &Stored, pixels: usize, normals: bool) -> Self {
        let rendering = Self::of_evaluation(config, sampling, stored, None);
        let voxels = if let Stored::Grid { voxels, .. } = stored { *voxels } else { 0 };
        let images = PICTURE_BYTES * pixels as u64;
        let grid = rendering.grid + if normals { (voxels * 3 * size_of::<f32>()) as u64 } else { 0 };
        let (key, advice) = match images > grid {
            true => ("--size".to_owned(), "use fewer pixels"),
            false => (rendering.key, rendering.advice),
        };
        Estimate { images, grid, key, advice, ..rendering }
    }

    /// Estimates carving: the images and the masks of the box. If the number of table `rows` after carving is known and not 0, also the fit of the
    /// colors, and the report if `report` is true.
    pub fn of_carving(config: &Config, dataset: &Dataset, rows: usize, report: bool) -> Self {
        let shape = config.grid_shape(config.carve.resolution);
        let coefficients = shape.color.channels() as u64 / 3;
        // A bit for each voxel, in a few copies, and a byte for each brick.
        let masks = shape.voxels() as u64;
        let (width, height) = dataset.size();
        // Summed-area tables of some views, or the light of a batch of pixels.
        let step = silhouette_bytes(dataset.count(Split::Train), width * height).max(CARVING_PIXELS * 36 * hits_of_pixel(config));
        // The voxel that each pixel sees, and the list from which gradient descent draws pixels.
        let pixels = (width * height * dataset.count(Split::Train)) as u64;
        let items = if config.carve.photo.is_some() { 4 * pixels } else { 0 } + if config.carve.fit == Fit::Sgd { 8 * pixels } else { 0 };
        // Both sides of the normal equations, the solution, its residual, and the weight of a voxel.
        let fit = 4 * rows as u64 * (coefficients * (coefficients + 1) / 2 + 9 * coefficients + 2);
        let images = images(dataset, config.downscale, dataset.count(Split::Train)) + items;
        let kept = if rows > 0 { (KEPT_LIGHT as u64).min(12 * pixels * hits_of_pixel(config)) } else { 0 };
        let page = if rows > 0 && report { page((rows * shape.voxel_bytes()) as u64) } else { 0 };
        let step = (step + kept).max(page);
        let grid = masks + fit;
        let parts = [
            (images, ("--downscale", "reduce the images by a larger factor")),
            (grid, ("--resolution", "use fewer voxels per side, or a lower --sh-degree")),
            (page, ("report.html", "leave it out with --no-report")),
        ];
        let (key, advice) = parts.into_iter().max_by_key(|(bytes, _)| *bytes).map(|(_, setting)| setting).unwrap_or_default();
        Estimate { images, grid, optimizer: 0, step, expected: false, key: key.to_owned(), advice }
    }

    /// Estimates a training run of another model than the grid, and its evaluation.
    pub fn of_recipe(config: &Config, recipe: &dyn Recipe, dataset: &Dataset, options: &RunOptions) -> Self {
        let Memory { parameters, ray, ray_of_picture, picture_tables, rays: key_of_rays, size, smaller } = recipe.memory(config.engine);
        let rays = recipe.stages().iter().map(|stage| stage.rays_per_step.unwrap_or(config.rays_per_step) as u64).max().unwrap_or(0);
        let comparison = if options.test_views > 0 { comparison(dataset, Split::Test, DRAWN_BYTES) } else { 0 };
        let shown = PICTURE_BYTES * options.shown_pixels as u64;
        let (width, height) = dataset.size();
        let hull = if config.hull == Hull::Auto { silhouette_bytes(dataset.count(Split::Train), width * height) } else { 0 };
        let views = dataset.count(Split::Train).max(dataset.count(Split::Test).min(options.test_views));
        let images = images(dataset, config.downscale, views) + importance(config, dataset);
        let of_rays = (rays * ray).max(EVALUATION_RAYS * ray_of_picture).max(hull) + comparison;
        let step = of_rays.max(EVALUATION_RAYS * ray_of_picture + picture_tables + comparison);
        let own = |key: &str| format!("{}.{key}", recipe.kind());
        let parts = [
            (images, "downscale".to_owned(), "reduce the images by a larger factor"),
            (of_rays, own(key_of_rays), "use fewer rays in a step"),
            (3 * parameters + picture_tables, own(size), smaller),
            (shown, "--view".to_owned(), LEAVE_OUT),
        ];
        let (_, key, advice) = parts.into_iter().max_by_key(|(bytes, ..)| *bytes).unwrap_or_default();
        // The values of a stage and of the stage before, and both moments of Adam.
        Estimate { images: images + shown, grid: 2 * parameters, optimizer: 2 * parameters, step, expected: true, key, advice }
    }

    /// Estimates reading a trained grid of `voxels` voxels and exporting all of them, with `bytes_per_voxel` for the export.
    pub fn of_export(shape: &GridShape, voxels: usize, bytes_per_voxel: u64) -> Self {
        Estimate {
            images: 0,
            // The file and the tables read from it.
            grid: 2 * (voxels * shape.voxel_bytes()) as u64,
            optimizer: 0,
            step: bytes_per_voxel * voxels as u64,
            expected: false,
            key: "RUN".to_owned(),
            advice: "use a machine with more memory",
        }
    }

    /// Estimates the images of the largest split alone.
    pub fn of_images(dataset: &Dataset) -> Self {
        let images = images(dataset, 1, Split::ALL.into_iter().map(|split| dataset.count(split)).max().unwrap_or(0));
        Estimate { images, grid: 0, optimizer: 0, step: 0, expected: false, key: "DIR".to_owned(), advice: "use fewer or smaller views" }
    }

    /// Returns the sum of all parts, in bytes.
    pub fn total(&self) -> u64 {
        BASE + self.images + self.grid + self.optimizer + self.step
    }

    /// Returns the size of a saved state in bytes: the tables and the optimizer state.
    pub fn saved(&self) -> u64 {
        self.grid + self.optimizer
    }

    /// Formats the estimate as one line of text.
    pub fn describe(&self) -> String {
        let part = |name: &str, n: u64| match n {
            0 => String::new(),
            n => format!(", {name} {}", bytes(n)),
        };
        format!(
            "memory: about {} (images {}{}{}{}){}",
            bytes(self.total()),
            bytes(self.images),
            part("grid", self.grid),
            part("optimizer", self.optimizer),
            part("step", self.step),
            if self.expected { ", for a typical scene" } else { "" },
        )
    }

    /// Checks that the estimate fits into the available memory. Checks nothing on systems that do not report free memory.
    ///
    /// Errors: it does not fit; the message names the setting with the largest part.
    pub fn check(&self) -> Result<()> {
        match memory::allowance() {
            Some(allowance) if self.total() > allowance.bytes => {
                let found = format!("the command needs about {} of memory, but {allowance}", bytes(self.total()));
                // A limit may be too low for any command.
                let advice = format!("{}{}", self.advice, if allowance.is_limit { ", or a higher --max-memory" } else { "" });
                Err(Error::usage(&self.key, found, advice))
            }
            _ => Ok(()),
        }
    }
}

/// Bytes for report.html with a grid of `grid` bytes: the grid, its quantized copy, and the page.
fn page(grid: u64) -> u64 {
    2 * grid + (2 * grid).min(PAGE_BYTES)
}

/// The model of a checkpoint: what determines the memory for reading and rendering it.
pub enum Stored {
    /// A voxel grid.
    Grid {
        /// Its shape.
        shape: GridShape,
        /// Number of its voxels.
        voxels: usize,
    },
    /// Another model.
    Other {
        /// Its settings.
        recipe: Box<dyn Recipe>,
        /// Size of the file.
        bytes: u64,
        /// Half the longest side of its box, world length.
        half_width: f64,
    },
}

impl Stored {
    /// Returns the largest share of the voxels of its box that a grid has in training, where it gets a layer of empty voxels; 1 for another model.
    fn share(&self) -> f64 {
        // A grid of bonsai at 404 voxels per side: 1.26.
        const GROWN: f64 = 1.5;
        match self {
            Stored::Grid { shape, voxels } => (GROWN * *voxels as f64 / shape.voxels() as f64).min(1.0),
            Stored::Other { .. } => 1.0,
        }
    }

    /// Reads the header of a checkpoint.
    ///
    /// Errors: the file cannot be read; its kind is not one of [`KINDS`](model::KINDS).
    pub fn read(path: &Path) -> Result<Self> {
        let kind = model::kind(path)?;
        if kind != plenoxels::KIND {
            let file = TensorFile::open(path)?;
            let recipe = recipe::read(&kind, &file)?;
            let [min, max]: [[f64; 3]; 2] = file.fact("box")?;
            let half_width = (0..3).map(|a| 0.5 * (max[a] - min[a])).fold(0.0, f64::max);
            let bytes = std::fs::metadata(path).map_err(|e| Error::io(path, e, "reading"))?.len();
            return Ok(Stored::Other { recipe, bytes, half_width });
        }
        let (header, voxels) = checkpoint::header(path)?;
        Ok(Stored::Grid { shape: header.shape(), voxels })
    }

    /// Half the longest side of the box, in the coordinates of its space.
    pub fn half_width(&self) -> f64 {
        match self {
            Stored::Grid { shape, .. } => {
                let Aabb { min, max } = shape.box_in_space();
                0.5 * (max - min).max_element()
            }
            Stored::Other { half_width, .. } => *half_width,
        }
    }

    fn bytes(&self) -> u64 {
        match self {
            Stored::Grid { shape, voxels } => (voxels * shape.voxel_bytes()) as u64,
            Stored::Other { bytes, .. } => *bytes,
        }
    }
}

/// Numbers in the optimizer state for each number of the tables.
fn states(config: &Config) -> u64 {
    match config.optimizer {
        OptimizerConfig::Sgd => 0,
        OptimizerConfig::Momentum { .. } | OptimizerConfig::RmsProp { .. } => 1,
        OptimizerConfig::LazyAdam { .. } => 2,
    }
}

/// Bytes per voxel while the voxels of a new grid are selected: its density, and an unused color.
const OUTLINE: u64 = 16;
/// Ratio of the voxels near surfaces to the voxels of a face of the box. Measured after pruning: 30 and 26 on the built-in scene at 128 and 206
/// voxels per side, 22 on lego at 320 and 358, 16 on lego in a wide box at 512. Like surfaces, both grow with the square of the resolution.
const SURFACE: f64 = 28.0;
/// Ratio of the samples of a ray through these voxels to the samples of a ray through the same share of the box. Measured in first steps, where
/// it is largest: 0.6 on the built-in scene at 128 voxels per side, 0.4 on lego at 320.
const CROSSED: f64 = 0.6;

/// Expected share of the box's voxels that are present in a stage: all of them, or those near surfaces after pruning, a hull or a scout.
fn share(config: &Config, stage: usize) -> f64 {
    let located = config.hull == Hull::Auto || config.scout.is_some() || config.prune_from_stage.is_some_and(|first| first <= stage);
    if located { near_surfaces(config.stages[stage].resolution) } else { 1.0 }
}

/// Expected share of the box's voxels that are near surfaces.
fn near_surfaces(resolution: usize) -> f64 {
    (SURFACE / resolution as f64).min(1.0)
}

/// Samples in memory at a time during evaluation. All rays of a batch may meet surfaces: they count with twice the share of the box.
fn evaluation_samples(config: &Config, sampling: Sampling, shape: &GridShape) -> u64 {
    let last = config.stages.len().checked_sub(1);
    let share = match last.map(|stage| share(config, stage)) {
        Some(1.0) => 1.0,
        // A carved grid consists of surfaces only.
        _ => (2.0 * near_surfaces(shape.resolution)).min(1.0),
    };
    (EVALUATION_RAYS as f64 * mean_samples(sampling, shape) as f64 * share).ceil() as u64
}

/// Expected ratio of the samples of a ray in a stage to those of a ray through the whole box.
fn crossed(config: &Config, stage: usize) -> f64 {
    let share = share(config, stage);
    if share < 1.0 { CROSSED * share } else { 1.0 }
}

/// Bytes of the images of `views` views, with depth if the scene has it, and of the full-size image that each thread reduces.
fn images(dataset: &Dataset, downscale: usize, views: usize) -> u64 {
    let (width, height) = dataset.size();
    let pixels = (width * height) as u64;
    let per_pixel = if dataset.scene().is_some() { 8 } else { 4 };
    let threads = machine::threads() as u64;
    // Pixels are decoded row by row to 8 bits, into the image counted above unless it will be reduced.
    let decoding = if downscale > 1 { threads * 4 * pixels * (downscale * downscale) as u64 } else { 0 };
    views as u64 * pixels * per_pixel + decoding
}

/// Bytes of the importance of the training pixels: a byte of each, and the tiles of 8 × 8 pixels in which they are found.
fn importance(config: &Config, dataset: &Dataset) -> u64 {
    const TILE: usize = 32;
    let (width, height) = dataset.size();
    let pixels = dataset.count(Split::Train) * width * height;
    if config.contrast_floor > 0.0 { (pixels + pixels / 64 * TILE) as u64 } else { 0 }
}

/// Bytes for comparing the views of a split, one after the other, if there are any.
fn comparison(dataset: &Dataset, split: Split, bytes_per_pixel: u64) -> u64 {
    let (width, height) = dataset.size();
    if dataset.count(split) > 0 { bytes_per_pixel * (width * height) as u64 } else { 0 }
}

/// Maximum number of voxels that a pixel sees in a carved grid: until the ray is opaque or leaves the box.
fn hits_of_pixel(config: &Config) -> u64 {
    // Two voxels for each optical depth of one, since rays are oblique; e^-4.9 is what `carve::light` cuts off.
    let opaque = 2.0 * 4.9 / config.carve.depth + 2.0;
    opaque.min(3f64.sqrt() * config.carve.resolution as f64) as u64
}

/// Mean number of samples per ray in the box: the mean length of rays that fill the frame is about the side of the box.
fn mean_samples(sampling: Sampling, shape: &GridShape) -> u64 {
    let side = 2.0 * shape.half_width;
    let samples = match sampling {
        Sampling::Step { step } => side / (step * shape.voxel_side()),
        Sampling::Points { samples, far } => (side / (far / samples as f64)).min(samples as f64),
    };
    samples.ceil() as u64 + 1
}

/// Bytes that a training step keeps for each sample. The numbers for the graph engine were counted on single stages of 96 voxels per side, with
/// harmonics of degree 0 and 2 and with plain colors.
fn training_bytes_per_sample(engine: Engine, shape: &GridShape) -> u64 {
    // Positions, distances, lengths, densities, optical depths, weights; then coefficients, the basis, their products, and gradients.
    let geometry = 21;
    let color = match shape.color {
        Color::Rgb => 3,
        Color::Sh { .. } => 5 * shape.color.channels() as u64,
    };
    match engine {
        Engine::Graph => 4 * (geometry + color),
        // Thirteen numbers per sample, sixteen of its corners, and one or two gradient entries of twenty numbers.
        // Reduced harmonics need 41 more for each group of samples that read the same rows, estimated as (1 + reduction) / 2 samples.
        Engine::Fused if shape.is_reduced() => 4 * (64 + 82 / (1 + shape.sh_reduction as u64)),
        Engine::Fused => 4 * 64,
    }
}

/// Bytes per sample without gradients: the numbers and corners of the fused engine. The graph engine also keeps free buffers of many sizes, about as
/// much again.
fn evaluation_bytes_per_sample(engine: Engine, shape: &GridShape) -> u64 {
    let color = match shape.color {
        Color::Rgb => 3,
        Color::Sh { .. } => 5 * shape.color.channels() as u64 / 2,
    };
    match engine {
        Engine::Graph => 2 * 4 * (15 + color),
        Engine::Fused => 4 * 30,
    }
}

/// Bytes of the tables of pictures. Those of a grid have a density and a color of four numbers for each entry, and a brick of 4³ cells has twice as many entries as cells.
fn picture_tables(config: &Config, stored: &Stored) -> u64 {
    match stored {
        Stored::Grid { shape, voxels } if config.engine == Engine::Fused && shape.interpolation == Interpolation::Trilinear => {
            2 * (1 + 4) * (voxels * size_of::<f32>()) as u64
        }
        Stored::Grid { .. } => 0,
        Stored::Other { recipe, .. } => recipe.memory(config.engine).picture_tables,
    }
}

/// Bytes of the rows that a step reads, with their gradients.
fn touched_rows(shape: &GridShape, samples: u64) -> u64 {
    let of = |voxels: usize, numbers: usize| (voxels as u64).min(8 * samples) * 4 * numbers as u64;
    let harmonics = match shape.is_reduced() {
        true => of(shape.harmonics_resolution().pow(3), 1 + shape.harmonics_width()),
        false => 0,
    };
    of(shape.voxels(), 2 + shape.color_width()) + harmonics
}

/// True if a loss depends on the whole grid, so that gradients are dense.
fn whole_grid_losses(config: &Config) -> bool {
    ["tv_density", "tv_color"].iter().any(|name| config.losses.contains_key(*name))
}
