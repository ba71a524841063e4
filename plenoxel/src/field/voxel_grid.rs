//! Density and color in a grid of voxels, dense or sparse.
//!
//! Voxel (i, j, k) of n³ has its centre at (i + ½, j + ½, k + ½) · side − half. A [`Lattice`] of bricks says which row of the tables is
//! its own, if it is present; one that is not has density and color 0 and takes no part in training. Nearest look-up takes the voxel a
//! point lies in; trilinear look-up runs between centres, and in the outer half voxel repeats the border. Outside the box there is nothing.
//! Values are stored raw and activated after interpolation: σ = max(0, density).

mod appearance;
mod reshape;

use super::{Field, Radiance, sh};
use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::random::{Purpose, uniform};
use crate::render::{RenderOptions, Rendered, fused};
use crate::sampling::{Occupancy, Samples};
use autograd::lattice::{BRICK, BRICK_ROWS};
use autograd::{Bounds, Buffer, Indices, Lattice, Module, Param, Real, Tensor, parallel};
use glam::DVec3;
use reshape::moved;
use serde::{Deserialize, Serialize};

/// How values between voxel centres are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// The voxel the point lies in.
    Nearest,
    /// The eight voxel centres around the point.
    Trilinear,
}

/// What a row of the color table means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Color {
    /// Red, green and blue, the same from everywhere.
    Rgb,
    /// Spherical harmonics, all coefficients of red, then green, then blue: c = max(0, offset + Σ Yₖ(d) cₖ).
    Sh {
        /// 0 to 3.
        degree: usize,
        /// The color of zero coefficients: 0.5 in svox2, 0 in the source paper.
        offset: f64,
    },
}

impl Color {
    /// Numbers in a row of the color table.
    pub fn channels(self) -> usize {
        match self {
            Color::Rgb => 3,
            Color::Sh { degree, .. } => 3 * sh::count(degree),
        }
    }

    /// Density and color of samples from the numbers looked up for them, `[m, 1]` and `[m, channels]`; `directions` are `[n, 3]`, and ray
    /// r owns the samples `offsets[r]..offsets[r + 1]`.
    pub fn activate<T: Real>(self, density: &Tensor<T>, color: &Tensor<T>, directions: &Tensor<T>, offsets: &Indices) -> Radiance<T> {
        let m = density.shape()[0];
        let sigma = density.reshape(&[m]).relu();
        let rgb = self.shade(color, |degree| sh::basis(directions, degree).segment_repeat(offsets));
        Radiance { sigma, rgb }
    }

    /// Colors `[m, 3]` of color numbers `[m, channels]`; `basis` gives the harmonics of a degree at the direction of each, `[m, count]`.
    fn shade<T: Real>(self, color: &Tensor<T>, basis: impl FnOnce(usize) -> Tensor<T>) -> Tensor<T> {
        let m = color.shape()[0];
        match self {
            Color::Rgb => color.clone(),
            Color::Sh { degree, offset } => {
                let count = sh::count(degree);
                let sum = (color.reshape(&[m, 3, count]) * basis(degree).reshape(&[m, 1, count])).sum_axis(2);
                (sum + offset).relu()
            }
        }
    }
}

/// Shape and meaning of a grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridShape {
    /// Voxels along each axis.
    pub resolution: usize,
    /// Half the side of the cube it fills, world length.
    pub half_width: f64,
    /// Look-up between centres.
    pub interpolation: Interpolation,
    /// Meaning of the color table.
    pub color: Color,
}

impl GridShape {
    /// The number of voxels.
    pub fn voxels(&self) -> usize {
        self.resolution.pow(3)
    }

    /// Side of a voxel, world length.
    pub fn voxel_side(&self) -> f64 {
        2.0 * self.half_width / self.resolution as f64
    }

    /// The share α of the light that a voxel of a raw density σ, 1 / world length, absorbs when it crosses it along an axis:
    /// 1 − exp(−max(0, σ) side), in [0, 1].
    pub fn alpha_of_density(&self, density: f64) -> f64 {
        -(-density.max(0.0) * self.voxel_side()).exp_m1()
    }

    /// The density at which a voxel absorbs the share `alpha` of the light: −ln(1 − α) / side, 1 / world length.
    pub fn density_of_alpha(&self, alpha: f64) -> f64 {
        -(-alpha).ln_1p() / self.voxel_side()
    }

    /// World position of a voxel's centre. One outside of the grid has its place too.
    pub fn center(&self, voxel: [isize; 3]) -> DVec3 {
        DVec3::from(voxel.map(|k| (k as f64 + 0.5) * self.voxel_side() - self.half_width))
    }

    /// The layout with all voxels present.
    pub fn full(&self) -> Lattice {
        Lattice::bricks([self.resolution; 3])
    }

    /// The voxels in which a sample can read one of `voxels`: the same with nearest look-up, their neighbours too with trilinear.
    pub fn reached_from(&self, voxels: &Occupancy) -> Occupancy {
        voxels.dilated(usize::from(self.interpolation == Interpolation::Trilinear))
    }

    /// Bytes of a voxel in both tables, in `f32`.
    pub fn voxel_bytes(&self) -> usize {
        (1 + self.color.channels()) * size_of::<f32>()
    }

    /// Bytes of both tables in `f32`, all voxels being present.
    pub fn bytes(&self) -> usize {
        self.voxels() * self.voxel_bytes()
    }
}

/// A grid with its two parameters, `density` `[rows, 1]` and `color` `[rows, channels]`.
#[derive(Debug)]
pub struct VoxelGrid<T: Real> {
    shape: GridShape,
    lattice: Lattice,
    /// The voxels in which a sample can read a present one; `None` if that is everywhere.
    reach: Option<Occupancy>,
    /// Raw density; σ = max(0, ·) after interpolation, 1 / world length.
    pub density: Param<T>,
    /// Colors or their harmonics.
    pub color: Param<T>,
}

impl<T: Real> VoxelGrid<T> {
    /// A grid with the same density and the same color numbers everywhere.
    pub fn uniform(shape: GridShape, density: f64, color: f64) -> Self {
        let rows = shape.full().rows();
        Self::from_tables(shape, Tensor::full(&[rows, 1], density), Tensor::full(&[rows, shape.color.channels()], color))
    }

    /// A grid of uniform random numbers: density in [0, `density`), colors in [0, `color`). A function of the seed.
    pub fn random(shape: GridShape, density: f64, color: f64, seed: u64) -> Self {
        let rows = shape.full().rows();
        let table = |step: u64, width: usize, scale: f64| {
            let mut values = Buffer::stale(rows * width);
            parallel::for_each_chunk(&mut values, parallel::CHUNK, |start, chunk| {
                for (i, v) in chunk.iter_mut().enumerate() {
                    *v = T::lit(scale * uniform(seed, Purpose::Initial, step, (start + i) as u64));
                }
            });
            Tensor::from_buffer(values, &[rows, width])
        };
        Self::from_tables(shape, table(0, 1, density), table(1, shape.color.channels(), color))
    }

    /// A grid with all voxels from its tables, whose rows are in the order of [`GridShape::full`].
    ///
    /// Panics if they are not `[rows, 1]` and `[rows, channels]`.
    #[track_caller]
    pub fn from_tables(shape: GridShape, density: Tensor<T>, color: Tensor<T>) -> Self {
        Self::with_lattice(shape, shape.full(), density, color)
    }

    /// A grid with the voxels of a lattice.
    ///
    /// Panics if the lattice is of another resolution or the tables do not have its rows.
    #[track_caller]
    pub fn with_lattice(shape: GridShape, lattice: Lattice, density: Tensor<T>, color: Tensor<T>) -> Self {
        let rows = lattice.rows();
        assert_eq!(lattice.nodes(), [shape.resolution; 3], "lattice of a grid of {}³ voxels", shape.resolution);
        assert_eq!(density.shape(), [rows, 1], "density table of a grid of {}³ voxels", shape.resolution);
        assert_eq!(color.shape(), [rows, shape.color.channels()], "color table of a grid of {}³ voxels", shape.resolution);
        let reach = (!lattice.is_full()).then(|| {
            let present = Occupancy::from_masks(Aabb::cube(shape.half_width), lattice.nodes(), lattice.masks().to_vec());
            shape.reached_from(&present)
        });
        VoxelGrid { shape, lattice, reach, density: Param::from_tensor("density", density), color: Param::from_tensor("color", color) }
    }

    /// A grid with all voxels from tables in row-major order, voxel (i, j, k) being row (i·n + j)·n + k.
    ///
    /// Panics if they are not `[n³, 1]` and `[n³, channels]`.
    #[track_caller]
    pub fn from_row_major(shape: GridShape, density: &Tensor<T>, color: &Tensor<T>) -> Self {
        assert_eq!(density.shape(), [shape.voxels(), 1], "density table of a grid of {}³ voxels", shape.resolution);
        assert_eq!(color.shape(), [shape.voxels(), shape.color.channels()], "color table of a grid of {}³ voxels", shape.resolution);
        let full = shape.full();
        let row_major = Lattice::from([shape.resolution; 3]);
        Self::from_tables(shape, moved(density, &row_major, &full), moved(color, &row_major, &full))
    }

    /// Both tables in row-major order, with zeros for voxels that are not present: `[n³, 1]` and `[n³, channels]`.
    pub fn to_row_major(&self) -> [Tensor<T>; 2] {
        let row_major = Lattice::from(self.lattice.nodes());
        [&self.density, &self.color].map(|table| moved(table.tensor(), &self.lattice, &row_major))
    }

    /// Shape and meaning.
    pub fn shape(&self) -> &GridShape {
        &self.shape
    }

    /// Which voxels are present, and their rows: what look-ups take.
    pub fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// The box it fills.
    pub fn aabb(&self) -> Aabb {
        Aabb::cube(self.shape.half_width)
    }

    /// World positions to voxel coordinates, in which centres are the integers: (p + half) / side − ½.
    pub fn world_to_voxels(&self, positions: &Tensor<T>) -> Tensor<T> {
        let scale = 1.0 / self.shape.voxel_side();
        positions.affine(scale, self.shape.half_width * scale - 0.5)
    }

    fn look_up(&self, table: &Param<T>, voxels: &Tensor<T>) -> Tensor<T> {
        match self.shape.interpolation {
            Interpolation::Nearest => table.tensor().nearest(voxels, &self.lattice),
            Interpolation::Trilinear => table.tensor().trilinear(voxels, &self.lattice),
        }
    }

    /// Makes optimizers keep density >= 0, and RGB colors in [0, 1] (the source paper's projection; harmonics are free).
    pub fn project(&mut self) {
        self.density.set_bounds(Bounds { low: T::zero(), high: T::infinity() });
        if self.shape.color == Color::Rgb {
            self.color.set_bounds(Bounds { low: T::zero(), high: T::one() });
        }
    }

    /// The voxels in which a sample can have positive density: those whose own value, or with trilinear look-up a neighbour's, is above
    /// `threshold`. With threshold 0, leaving out the samples elsewhere changes no rendered value.
    pub fn occupancy(&self, threshold: f64) -> Occupancy {
        let (density, threshold) = (self.density.tensor().data(), T::lit(threshold));
        self.shape.reached_from(&self.voxels_where(|row| density[row] > threshold))
    }

    /// The present voxels whose rows `full` names.
    pub fn voxels_where(&self, full: impl Fn(usize) -> bool + Sync) -> Occupancy {
        let mut masks = self.lattice.masks().to_vec();
        let count = self.shape.resolution.div_ceil(BRICK);
        parallel::for_each_chunk(&mut masks, 256, |first, chunk| {
            for (b, mask) in chunk.iter_mut().enumerate() {
                let b = first + b;
                if let Some((brick, present)) = self.lattice.brick([b / (count * count), b / count % count, b % count]) {
                    *mask = (0..BRICK_ROWS)
                        .filter(|bit| present >> bit & 1 == 1 && full(brick * BRICK_ROWS + bit))
                        .fold(0, |m, bit| m | 1 << bit);
                }
            }
        });
        Occupancy::from_masks(self.aabb(), self.lattice.nodes(), masks)
    }

    /// True if every stored number is finite.
    pub fn is_finite(&self) -> bool {
        [&self.density, &self.color]
            .iter()
            .all(|p| parallel::sum(p.tensor().data(), |v| if v.is_finite() { T::zero() } else { T::one() }) == T::zero())
    }
}

impl<T: Real> Field<T> for VoxelGrid<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.look_up(&self.density, &self.world_to_voxels(positions)).reshape(&[positions.shape()[0]]).relu()
    }

    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        let voxels = self.world_to_voxels(&samples.positions);
        let (density, color) = (self.look_up(&self.density, &voxels), self.look_up(&self.color, &voxels));
        self.shape.color.activate(&density, &color, &samples.directions, &samples.offsets)
    }

    fn reach(&self) -> Option<&Occupancy> {
        self.reach.as_ref()
    }

    fn render_fused(&self, rays: &[Ray], options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        Some(fused::render(self, rays, options))
    }
}

impl<T: Real> Module<T> for VoxelGrid<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        f(&self.density);
        f(&self.color);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        f(&mut self.density);
        f(&mut self.color);
    }
}
