//! Carving: from photographs to an opaque colored grid, without gradients.
//!
//! 1. [`mod@visual_hull`]: what the silhouettes of all views leave of the box;
//!    [`mod@photo_hull`]: what the colors leave of that, or of the whole box;
//! 2. [`light`]: which voxels a pixel shows, and how much of it each is;
//! 3. [`color`]: the colors, or their harmonics, that explain the pixels best.
//!
//! Afterwards it is a grid like any other: it renders, and training can start from it.

pub mod color;
pub mod light;
pub mod photo_hull;
mod smooth;
pub mod visual_hull;

use crate::dataset::View;
use crate::error::{Error, Result};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, VoxelGrid};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use autograd::{Buffer, Lattice, Tensor};
use color::{Fitted, Seen};
use light::Opaque;
use serde::{Deserialize, Serialize};

/// How to carve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CarveConfig {
    /// Voxels along each axis.
    pub resolution: usize,
    /// What makes a voxel go.
    pub rule: Rule,
    /// By footprint, pixels around a voxel's projection that must be background too: half a pixel, since alpha is sampled and a pixel
    /// without any may still hold a little of the object.
    pub margin: f64,
    /// Optical depth of a voxel along its side, σ · side: how opaque what is left is.
    pub depth: f64,
    /// How colors are found.
    pub fit: Fit,
    /// Pull on the harmonics above the mean, as a share of what a voxel weighs in the pixels.
    pub ridge: f64,
    /// Sweeps over all voxels together, after each was solved by itself.
    pub sweeps: usize,
}

/// What makes a voxel go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// Some view shows all of it on background.
    Footprint,
    /// The ray of a background pixel passes through it: the source paper's.
    Rays,
}

/// How colors are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// Least squares, voxel by voxel and then together.
    Exact,
    /// The source paper's stochastic gradient descent.
    Sgd,
}

impl Default for CarveConfig {
    fn default() -> Self {
        CarveConfig { resolution: 256, rule: Rule::Footprint, margin: 0.5, depth: 0.875, fit: Fit::Exact, ridge: 0.01, sweeps: 3 }
    }
}

/// What the silhouettes leave.
///
/// Errors: no view has alpha, or shows anything at all; nothing is left.
pub fn visual_hull(views: &[View], aabb: Aabb, config: &CarveConfig) -> Result<Occupancy> {
    let alphas = || views.iter().flat_map(|view| view.image.as_raw().iter().skip(3).step_by(4));
    if alphas().all(|&alpha| alpha > 0) {
        return Err(Error::config("DATA", "images without a transparent pixel", "images with an alpha channel"));
    }
    if alphas().all(|&alpha| alpha == 0) {
        return Err(Error::config("DATA", "images that are transparent all over", "images that show an object"));
    }
    let voxels = [config.resolution; 3];
    let hull = match config.rule {
        Rule::Footprint => visual_hull::by_footprint(views, aabb, voxels, config.margin),
        Rule::Rays => visual_hull::by_rays(views, aabb, voxels),
    };
    Ok(hull)
}

/// The hull with the colors of the photographs.
pub fn colored(
    views: &[View],
    hull: &Occupancy,
    shape: GridShape,
    background: [f32; 3],
    seed: u64,
    config: &CarveConfig,
    progress: &dyn Fn(usize),
) -> VoxelGrid<f32> {
    let lattice = Lattice::from_masks(hull.cells(), hull.masks().to_vec());
    let density = config.depth / shape.voxel_side();
    let opaque = Opaque::new(&lattice, Aabb::cube(shape.half_width), density);
    let (degree, offset) = match shape.color {
        Color::Rgb => (0, 0.0),
        Color::Sh { degree, offset } => (degree, offset),
    };
    let seen = Seen { opaque: &opaque, lattice: &lattice, views, background, degree, offset: offset as f32 };
    let Fitted { mut table, .. } = match config.fit {
        Fit::Exact => color::fit_exactly(&seen, config.ridge as f32, config.sweeps, progress),
        Fit::Sgd => color::fit_by_descent(&seen, seed, progress),
    };
    if shape.color == Color::Rgb {
        table.iter_mut().for_each(|x| *x *= sh::Y0 as f32);
    }
    let rows = lattice.rows();
    let color = Tensor::from_buffer(Buffer::from(table), &[rows, shape.color.channels()]);
    VoxelGrid::with_lattice(shape, lattice, Tensor::full(&[rows, 1], density), color)
}
