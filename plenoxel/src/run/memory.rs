//! Estimates of the memory that a command will take, before it is taken, and the memory that there is.
//!
//! The parts are counted from what is known: images, tables, optimizer state, and the arrays that a training step keeps for its gradient.
//! The last depends on the number of samples on a ray: as many as fit between two faces of the box, or fewer where only voxels near surfaces are left.

pub use crate::memory::{available, bytes, limit, now, peak};

use super::machine;
use super::training::RunOptions;
use crate::carve::Fit;
use crate::carve::color::KEPT_LIGHT;
use crate::carve::visual_hull::silhouette_bytes;
use crate::dataset::{Dataset, Split};
use crate::error::{Error, Result};
use crate::field::voxel_grid::fused::CHUNK;
use crate::field::voxel_grid::{Color, GridShape};
use crate::memory;
use crate::model::plenoxels::config::{Config, Hull, OptimizerConfig, Sampling};
use crate::render::Engine;

/// An estimate in bytes, by purpose.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// 8-bit images of the training views or of the test views, whichever are more, and full-size ones in decoding.
    pub images: u64,
    /// Tables of the finest grid, of the one before it, and of kept stages.
    pub grid: u64,
    /// The optimizer's state.
    pub optimizer: u64,
    /// Samples, intermediate values and gradients of one step, or what evaluating or saving takes if that is more.
    pub step: u64,
    /// True if it depends on how many voxels are left near surfaces, of which only an expectation is known.
    expected: bool,
    /// The setting that counts most, and what would help.
    key: String,
    advice: &'static str,
}

/// Program, threads, buffers on their way: measured on small runs.
const BASE: u64 = 60_000_000;
/// Pixels whose voxels are in memory at a time when carving, 12 bytes each and in up to three copies.
const CARVING_PIXELS: u64 = 1 << 16;
/// Bytes of a pixel of rendered pictures: five numbers of the colors and of the normals each, what is made of them, and the file.
const PICTURE_BYTES: u64 = 100;
/// Bytes of a pixel of a view while it is compared with its photograph: the picture, the photograph in floats, and both in double precision for SSIM.
const COMPARED_BYTES: u64 = 82;
/// The same while its panel is drawn at the end of training: picture, photograph, error and depth, all four side by side in floats and in 8 bits, and
/// the mean of the training images.
const DRAWN_BYTES: u64 = 130;
/// The most bytes of the page about a run while it is put together: the grid in it of up to 30 MB, compressed, as text, and as part of longer texts.
const PAGE_BYTES: u64 = 150_000_000;
/// Rays that are rendered at a time when evaluating.
const EVALUATION_RAYS: u64 = 4096;

impl Estimate {
    /// Estimates a training run and its evaluation; `initial` is the size in bytes of the grid that it starts from, 0 if it starts from none.
    pub fn of_training(config: &Config, dataset: &Dataset, initial: u64, options: &RunOptions) -> Self {
        let states = states(config);
        // Bytes of a stage's tables, and what is held of it and of the one before while it begins.
        let tables = |index: usize| (share(config, index) * config.grid_shape(config.stages[index].resolution).bytes() as f64) as u64;
        let begins = |index: usize| {
            let before = share(config, index.saturating_sub(1));
            let outline = OUTLINE as f64 * before * config.grid_shape(config.stages[index].resolution).voxels() as f64;
            // The first is made whole.
            let own = if index == 0 { config.grid_shape(config.stages[0].resolution).bytes() as u64 } else { tables(index) };
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
            // What the fused engine keeps is bounded; it then adds rows up chunk by chunk: those so far, those of a chunk, and their sum.
            let chunked = config.engine == Engine::Fused && rays > CHUNK as u64;
            let kept = if chunked { samples / rays * CHUNK as u64 } else { samples };
            let gradient = match whole_grid_losses(config) {
                // Dense gradients, and the roots that a total variation keeps for them.
                true => 2 * tables(index),
                false => 0,
            };
            // Else it adds rows up where the optimizer wants them.
            let rows = match config.engine == Engine::Graph || whole_grid_losses(config) {
                _ if chunked => 3 * touched_rows(&shape, samples),
                true => touched_rows(&shape, samples),
                false => 0,
            };
            // Origins, directions, targets and pixels, some of them twice.
            let batch = rays * 200;
            kept * training_bytes_per_sample(config.engine, &shape) + batch + rows + gradient
        });
        let (width, height) = dataset.size();
        let hull = if config.hull == Hull::Auto { silhouette_bytes(dataset.count(Split::Train), width * height) } else { 0 };
        let step = step.max().unwrap_or(0).max(hull);
        let comparison = if options.test_views > 0 { comparison(dataset, Split::Test, DRAWN_BYTES) } else { 0 };
        let evaluation = evaluation_samples(config, config.evaluation, &shape) * evaluation_bytes_per_sample(config.engine, &shape);
        // A table's bytes beside it.
        let saving = tables(index);
        let page = if options.report { page(tables(index)) } else { 0 };
        // It renders, when the optimizer is gone.
        let reporting = (evaluation + comparison.max(page)).saturating_sub(optimizer);
        let views = dataset.count(Split::Train).max(dataset.count(Split::Test).min(options.test_views));
        let images = images(dataset, config.downscale, views);
        let grid = (0..config.stages.len()).map(begins).max().unwrap_or(0) + 2 * initial;
        let voxels = (format!("stages[{index}].resolution"), "fewer voxels a side, a lower sh_degree, or a higher sh_reduction");
        let parts = [
            (images + comparison.max(hull), ("downscale".to_owned(), "a larger factor, so that the images fit")),
            (step, ("rays_per_step".to_owned(), "fewer rays in a step")),
            (evaluation, ("evaluation".to_owned(), "fewer samples on a ray")),
            (grid + optimizer + saving, voxels),
            (page, ("report.html".to_owned(), "--no-report, which leaves it out")),
        ];
        let (key, advice) = parts.into_iter().max_by_key(|(bytes, _)| *bytes).map(|(_, setting)| setting).unwrap_or_default();
        Estimate {
            images,
            grid,
            optimizer,
            // The graph's free buffers of training and of evaluation have different sizes, and both kinds are kept.
            step: if config.engine == Engine::Graph { step + evaluation } else { step.max(evaluation) }.max(saving).max(reporting),
            expected: share(config, index) < 1.0,
            key,
            advice,
        }
    }

    /// The most rows of tables that fit into the memory that is free, if that is known: what pruning leaves is only known when it has.
    pub fn most_rows(&self, config: &Config) -> Option<usize> {
        let held = self.grid + self.optimizer;
        // Tables, states of the optimizer, and the tables of the stage before.
        let row = (2 + states(config)) * config.grid_shape(1).voxel_bytes() as u64;
        available().map(|available| (available.saturating_sub(self.total() - held) / row) as usize)
    }

    /// Rendering a trained grid of so many voxels, and comparing it with the views of a split where there are some.
    pub fn of_evaluation(
        config: &Config,
        sampling: Sampling,
        shape: &GridShape,
        voxels: usize,
        compare: Option<(&Dataset, Split)>,
    ) -> Self {
        let samples = evaluation_samples(config, sampling, shape);
        Estimate {
            images: compare.map_or(0, |(dataset, split)| images(dataset, config.downscale, dataset.count(split))),
            // The file and the tables read from it.
            grid: 2 * (voxels * shape.voxel_bytes()) as u64,
            optimizer: 0,
            step: samples * evaluation_bytes_per_sample(config.engine, shape)
                + compare.map_or(0, |(dataset, split)| comparison(dataset, split, COMPARED_BYTES)),
            expected: false,
            key: "RUN".to_owned(),
            advice: "a machine with more, or fewer --samples",
        }
    }

    /// Making the page about a run whose grid has so many voxels: it renders a few views.
    pub fn of_report(config: &Config, shape: &GridShape, voxels: usize) -> Self {
        let rendering = Self::of_evaluation(config, config.evaluation, shape, voxels, None);
        let step = rendering.step + page((voxels * shape.voxel_bytes()) as u64);
        Estimate { step, advice: "a machine with more", ..rendering }
    }

    /// Rendering a trained grid of so many voxels to pictures of so many pixels, with or without its normals.
    pub fn of_pictures(config: &Config, sampling: Sampling, shape: &GridShape, voxels: usize, pixels: usize, normals: bool) -> Self {
        let rendering = Self::of_evaluation(config, sampling, shape, voxels, None);
        let images = PICTURE_BYTES * pixels as u64;
        let grid = rendering.grid + if normals { (voxels * 3 * size_of::<f32>()) as u64 } else { 0 };
        let (key, advice) = match images > grid {
            true => ("--size".to_owned(), "fewer pixels"),
            false => (rendering.key, rendering.advice),
        };
        Estimate { images, grid, key, advice, ..rendering }
    }

    /// Carving: the images and the masks of the box; and, once it is known how many rows the tables of what is left have, their fit, and the
    /// page about it if there is to be one.
    pub fn of_carving(config: &Config, dataset: &Dataset, rows: usize, report: bool) -> Self {
        let shape = config.grid_shape(config.carve.resolution);
        let coefficients = shape.color.channels() as u64 / 3;
        // A bit for each voxel, in a few copies, and one byte for each brick.
        let masks = shape.voxels() as u64;
        let (width, height) = dataset.size();
        // Summed-area tables of some views, or the light of a batch of pixels.
        let step = silhouette_bytes(dataset.count(Split::Train), width * height).max(CARVING_PIXELS * 36 * hits_of_pixel(config));
        // Which voxel each pixel sees; the list that descent draws pixels from.
        let pixels = (width * height * dataset.count(Split::Train)) as u64;
        let items = if config.carve.photo.is_some() { 4 * pixels } else { 0 } + if config.carve.fit == Fit::Sgd { 8 * pixels } else { 0 };
        // The two sides of the normal equations, the answer, its error, and how much a voxel weighs.
        let fit = 4 * rows as u64 * (coefficients * (coefficients + 1) / 2 + 9 * coefficients + 2);
        let images = images(dataset, config.downscale, dataset.count(Split::Train)) + items;
        let kept = if rows > 0 { (KEPT_LIGHT as u64).min(12 * pixels * hits_of_pixel(config)) } else { 0 };
        let page = if rows > 0 && report { page((rows * shape.voxel_bytes()) as u64) } else { 0 };
        let step = (step + kept).max(page);
        let grid = masks + fit;
        let parts = [
            (images, ("--downscale", "a larger factor, so that the images fit")),
            (grid, ("--resolution", "fewer voxels a side, or a lower --sh-degree")),
            (page, ("report.html", "--no-report, which leaves it out")),
        ];
        let (key, advice) = parts.into_iter().max_by_key(|(bytes, _)| *bytes).map(|(_, setting)| setting).unwrap_or_default();
        Estimate { images, grid, optimizer: 0, step, expected: false, key: key.to_owned(), advice }
    }

    /// Estimates reading a trained grid of so many voxels and making a file of them, which takes `bytes_per_voxel` for each.
    pub fn of_export(shape: &GridShape, voxels: usize, bytes_per_voxel: u64) -> Self {
        Estimate {
            images: 0,
            // The file and the tables read from it.
            grid: 2 * (voxels * shape.voxel_bytes()) as u64,
            optimizer: 0,
            step: bytes_per_voxel * voxels as u64,
            expected: false,
            key: "RUN".to_owned(),
            advice: "a machine with more",
        }
    }

    /// The images of the largest split alone.
    pub fn of_images(dataset: &Dataset) -> Self {
        let images = images(dataset, 1, Split::ALL.into_iter().map(|split| dataset.count(split)).max().unwrap_or(0));
        Estimate { images, grid: 0, optimizer: 0, step: 0, expected: false, key: "DIR".to_owned(), advice: "fewer or smaller views" }
    }

    /// All of it.
    pub fn total(&self) -> u64 {
        BASE + self.images + self.grid + self.optimizer + self.step
    }

    /// Bytes of a saved state: the tables and what the optimizer remembers of them.
    pub fn saved(&self) -> u64 {
        self.grid + self.optimizer
    }

    /// One line for people.
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

    /// Refuses what does not fit into the memory that is free, naming the setting that counts most. Where the system does not say how
    /// much is free, nothing is refused.
    pub fn check(&self) -> Result<()> {
        match memory::allowance() {
            Some(allowance) if self.total() > allowance.bytes => {
                let found = format!("the command needs about {} of memory, but {allowance}", bytes(self.total()));
                // A limit may be too low for anything.
                let advice = format!("{}{}", self.advice, if allowance.is_limit { "; or a higher --max-memory" } else { "" });
                Err(Error::config(&self.key, found, advice))
            }
            _ => Ok(()),
        }
    }
}

/// Bytes for the page about a run with a grid of so many: what can be seen of it, what a viewer will see, and the page.
fn page(grid: u64) -> u64 {
    2 * grid + (2 * grid).min(PAGE_BYTES)
}

/// Numbers that the optimizer keeps for each one of the tables.
fn states(config: &Config) -> u64 {
    match config.optimizer {
        OptimizerConfig::Sgd => 0,
        OptimizerConfig::Momentum { .. } | OptimizerConfig::RmsProp { .. } => 1,
        OptimizerConfig::LazyAdam { .. } => 2,
    }
}

/// Bytes for each voxel while it is found out which of them there will be: its density, and a color that is not used.
const OUTLINE: u64 = 16;
/// Voxels near surfaces, over the voxels of a face of the box. Measured after pruning: 30 and 26 on the built-in scene at 128 and 206 voxels a side, 22 on lego at 320
/// and 358, 16 on lego in a wide box at 512. They grow with the square of the resolution, because surfaces do.
const SURFACE: f64 = 28.0;
/// Samples of a ray that meets these voxels, over those of a ray through the same share of the box. Measured in first steps, where it is largest: 0.6 on the built-in
/// scene at 128 voxels a side, 0.4 on lego at 320.
const CROSSED: f64 = 0.6;

/// Expected share of the box's voxels that are present in a stage: those near surfaces once pruning, silhouettes or a scout have found them.
fn share(config: &Config, stage: usize) -> f64 {
    let located = config.hull == Hull::Auto || config.scout.is_some() || config.prune_from_stage.is_some_and(|first| first <= stage);
    if located { near_surfaces(config.stages[stage].resolution) } else { 1.0 }
}

/// Expected share of the box's voxels that are near surfaces.
fn near_surfaces(resolution: usize) -> f64 {
    (SURFACE / resolution as f64).min(1.0)
}

/// Samples that are in memory at a time when evaluating. A batch may be of rays that all meet surfaces: twice the share of the box.
fn evaluation_samples(config: &Config, sampling: Sampling, shape: &GridShape) -> u64 {
    let last = config.stages.len().checked_sub(1);
    let share = match last.map(|stage| share(config, stage)) {
        Some(1.0) => 1.0,
        // A carved grid has surfaces only.
        _ => (2.0 * near_surfaces(shape.resolution)).min(1.0),
    };
    (EVALUATION_RAYS as f64 * mean_samples(sampling, shape) as f64 * share).ceil() as u64
}

/// Expected samples of a ray in a stage, over those of a ray through the whole box.
fn crossed(config: &Config, stage: usize) -> f64 {
    let share = share(config, stage);
    if share < 1.0 { CROSSED * share } else { 1.0 }
}

/// Images of so many views, with depth where the scene knows it, and the full-size ones that each thread reduces.
fn images(dataset: &Dataset, downscale: usize, views: usize) -> u64 {
    let (width, height) = dataset.size();
    let pixels = (width * height) as u64;
    let per_pixel = if dataset.scene().is_some() { 8 } else { 4 };
    let threads = machine::threads() as u64;
    // Pixels are decoded row by row to 8 bits, whatever the file has, into the image that is counted already, unless it is to be reduced.
    let decoding = if downscale > 1 { threads * 4 * pixels * (downscale * downscale) as u64 } else { 0 };
    views as u64 * pixels * per_pixel + decoding
}

/// Comparing the views of a split, one after the other, if there are any.
fn comparison(dataset: &Dataset, split: Split, bytes_per_pixel: u64) -> u64 {
    let (width, height) = dataset.size();
    if dataset.count(split) > 0 { bytes_per_pixel * (width * height) as u64 } else { 0 }
}

/// Voxels that a pixel may see in a carved grid: until it is opaque, or the box ends.
fn hits_of_pixel(config: &Config) -> u64 {
    // Two voxels for each optical depth of one, since rays are oblique; e^-4.9 is what `carve::light` cuts off.
    let opaque = 2.0 * 4.9 / config.carve.depth + 2.0;
    opaque.min(3f64.sqrt() * config.carve.resolution as f64) as u64
}

/// Samples a ray takes in the box, at the mean over rays that fill the frame: about the side of the box.
fn mean_samples(sampling: Sampling, shape: &GridShape) -> u64 {
    let side = 2.0 * shape.half_width;
    let samples = match sampling {
        Sampling::Step { step } => side / (step * shape.voxel_side()),
        Sampling::Points { samples, far } => (side / (far / samples as f64)).min(samples as f64),
    };
    samples.ceil() as u64 + 1
}

/// Bytes that a training step keeps for each sample. On the graph of small ops: numbers as counted on single stages of 96 voxels a side,
/// harmonics of degree 0 and 2 and plain colors.
fn training_bytes_per_sample(engine: Engine, shape: &GridShape) -> u64 {
    // Positions, distances, lengths, densities, optical depths, weights; then coefficients, the basis, their products, and gradients.
    let geometry = 21;
    let color = match shape.color {
        Color::Rgb => 3,
        Color::Sh { .. } => 5 * shape.color.channels() as u64,
    };
    match engine {
        Engine::Graph => 4 * (geometry + color),
        // Thirteen numbers of a sample, twenty of what it adds to the tables, of which it has one or two, and sixteen of its corners for a while.
        // Of reduced harmonics, forty-one more for each run of samples that read the same rows: of (1 + reduction) / 2, say.
        Engine::Fused if shape.is_reduced() => 4 * (64 + 82 / (1 + shape.sh_reduction as u64)),
        Engine::Fused => 4 * 64,
    }
}

/// Bytes for each sample when nothing is kept for a gradient: the fused engine's numbers and corners. On the graph, buffers that were free
/// for a short time count too: pictures need them in many sizes, about twice what is in use.
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

/// Rows that a step touches, with their gradients.
fn touched_rows(shape: &GridShape, samples: u64) -> u64 {
    let of = |voxels: usize, numbers: usize| (voxels as u64).min(8 * samples) * 4 * numbers as u64;
    let harmonics = match shape.is_reduced() {
        true => of(shape.harmonics_resolution().pow(3), 1 + shape.harmonics_width()),
        false => 0,
    };
    of(shape.voxels(), 2 + shape.color_width()) + harmonics
}

/// True if a loss looks at the whole grid, so that gradients are dense.
fn whole_grid_losses(config: &Config) -> bool {
    ["tv_density", "tv_color"].iter().any(|name| config.losses.contains_key(*name))
}
