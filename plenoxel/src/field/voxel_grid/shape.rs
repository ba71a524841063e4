//! Shape and meaning of a grid, without its numbers.

use super::layout::Layout;
use crate::field::{Radiance, sh};
use crate::sampling::Occupancy;
use autograd::{Indices, Lattice, Real, Tensor};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// How values between voxel centres are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// The voxel the point lies in.
    Nearest,
    /// The eight voxel centres around the point.
    Trilinear,
}

impl Interpolation {
    /// The values `[m, width]` of a table `[rows, width]` at positions `[m, 3]`, in voxels whose centres are the integers.
    pub fn look_up<T: Real>(self, table: &Tensor<T>, voxels: &Tensor<T>, lattice: &Lattice) -> Tensor<T> {
        match self {
            Interpolation::Nearest => table.nearest(voxels, lattice),
            Interpolation::Trilinear => table.trilinear(voxels, lattice),
        }
    }
}

/// What the numbers of a color mean.
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
    /// Numbers of a color: of a row of the color table, unless harmonics have a table of their own.
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
    pub(super) fn shade<T: Real>(self, color: &Tensor<T>, basis: impl FnOnce(usize) -> Tensor<T>) -> Tensor<T> {
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
    /// Meaning of colors.
    pub color: Color,
    /// Harmonics of degree 1 and more are stored for every so many voxels along each axis, in a table of their own; 1 for all coefficients in
    /// the color table. Colors that have no such harmonics cannot be reduced: there it means nothing, and the shape of a grid has 1.
    pub sh_reduction: usize,
}

impl GridShape {
    /// Half widths whose voxels can be computed with in 32 bits, whatever the resolution.
    pub const HALF_WIDTHS: RangeInclusive<f64> = 1e-9..=1e9;

    /// The same shape with a reduction that means something.
    pub fn normalised(self) -> Self {
        GridShape { sh_reduction: if self.is_reduced() { self.sh_reduction } else { 1 }, ..self }
    }

    /// True if harmonics of degree 1 and more have a table of their own, for larger voxels.
    pub fn is_reduced(&self) -> bool {
        self.sh_reduction > 1 && self.color.channels() > 3
    }

    /// Numbers in a row of the color table: all of a color, or its mean alone where harmonics are reduced.
    pub fn color_width(&self) -> usize {
        if self.is_reduced() { 3 } else { self.color.channels() }
    }

    /// Numbers in a row of the table of harmonics, all those of red, then green, then blue; 0 where there is no such table.
    pub fn harmonics_width(&self) -> usize {
        self.color.channels() - self.color_width()
    }

    /// Voxels of the harmonics along each axis: ⌈resolution / reduction⌉. The first begins where the grid does, the last may reach beyond it.
    pub fn harmonics_resolution(&self) -> usize {
        self.resolution.div_ceil(self.sh_reduction)
    }

    /// Factor a and shift b from voxel coordinates u to those of the harmonics, (u + ½) / reduction − ½ = a u + b.
    pub fn to_harmonics(&self) -> [f64; 2] {
        let scale = 1.0 / self.sh_reduction as f64;
        [scale, 0.5 * scale - 0.5]
    }

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

    /// The rows of the harmonics of a grid with the voxels of a lattice; `None` if they are not reduced.
    ///
    /// Panics if the lattice is of another resolution.
    #[track_caller]
    pub fn harmonics_lattice(&self, lattice: &Lattice) -> Option<Lattice> {
        Layout::new(*self, lattice.clone()).harmonics
    }

    /// Shapes of the tables of a grid with the voxels of a lattice: density, color and, where they are reduced, harmonics.
    pub fn tables(&self, lattice: &Lattice) -> Vec<[usize; 2]> {
        Layout::new(*self, lattice.clone()).tables()
    }

    /// The voxels in which a sample can read one of `voxels`: the same with nearest look-up, their neighbours too with trilinear.
    pub fn reached_from(&self, voxels: &Occupancy) -> Occupancy {
        voxels.dilated(usize::from(self.interpolation == Interpolation::Trilinear))
    }

    /// The cells in which a sample reads one of `voxels`: the same with nearest look-up, those between centres with trilinear.
    pub fn cells_reading(&self, voxels: Occupancy) -> Occupancy {
        match self.interpolation {
            Interpolation::Nearest => voxels,
            Interpolation::Trilinear => voxels.between_centres(),
        }
    }

    /// Bytes of a voxel in all tables, in `f32`, with its share of the harmonics where they are reduced.
    pub fn voxel_bytes(&self) -> usize {
        let shared = (self.harmonics_width() * size_of::<f32>()).div_ceil(self.sh_reduction.pow(3));
        (1 + self.color_width()) * size_of::<f32>() + shared
    }

    /// Bytes of all tables in `f32`, all voxels being present.
    pub fn bytes(&self) -> usize {
        let harmonics = self.harmonics_resolution().pow(3) * self.harmonics_width();
        (self.voxels() * (1 + self.color_width()) + harmonics) * size_of::<f32>()
    }
}
