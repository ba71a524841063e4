//! Shape of a grid and meaning of its values, without the values.

use super::GridSpace;
use super::layout::Layout;
use crate::field::{Radiance, sh};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::space::Space;
use autograd::{Indices, Lattice, Real, Tensor};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Interpolation between voxel centres.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Value of the voxel that contains the point.
    Nearest,
    /// Trilinear interpolation of the eight voxel centres around the point.
    Trilinear,
}

impl Interpolation {
    /// Looks up a table `[rows, width]` at positions `[m, 3]`, in coordinates in which voxel centres are integers. Returns `[m, width]`.
    pub fn look_up<T: Real>(self, table: &Tensor<T>, voxels: &Tensor<T>, lattice: &Lattice) -> Tensor<T> {
        match self {
            Interpolation::Nearest => table.nearest(voxels, lattice),
            Interpolation::Trilinear => table.trilinear(voxels, lattice),
        }
    }
}

/// Color representation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Color {
    /// Red, green and blue, independent of the view direction.
    Rgb,
    /// Spherical harmonics: c = max(0, offset + Σ Yₖ(d) cₖ). A row holds all coefficients of red, then green, then blue.
    Sh {
        /// Degree, 0 to 3.
        degree: usize,
        /// Color of zero coefficients: 0.5 in svox2, 0 in the source paper.
        offset: f64,
    },
}

impl Color {
    /// Returns the count of numbers per color. A row of the color table has as many, unless harmonics are reduced.
    pub fn channels(self) -> usize {
        match self {
            Color::Rgb => 3,
            Color::Sh { degree, .. } => 3 * sh::count(degree),
        }
    }

    /// Returns degree and offset of the harmonics; 0 and 0 for RGB.
    pub fn harmonics(self) -> (usize, f64) {
        match self {
            Color::Rgb => (0, 0.0),
            Color::Sh { degree, offset } => (degree, offset),
        }
    }

    /// Computes density and color of samples from interpolated values, `[m, 1]` and `[m, channels]`. `directions` is `[n, 3]`; ray r owns
    /// the samples `offsets[r]..offsets[r + 1]`.
    pub fn activate<T: Real>(self, density: &Tensor<T>, color: &Tensor<T>, directions: &Tensor<T>, offsets: &Indices) -> Radiance<T> {
        let m = density.shape()[0];
        let sigma = density.reshape(&[m]).relu();
        let rgb = self.shade(color, |degree| sh::basis(directions, degree).segment_repeat(offsets));
        Radiance { sigma, rgb }
    }

    /// Computes colors `[m, 3]` from color numbers `[m, channels]`. `basis` returns the harmonics of a degree for each direction, `[m,
    /// count]`.
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

/// Shape of a grid, and meaning of its values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridShape {
    /// Number of voxels along each axis.
    pub resolution: usize,
    /// Half the side of the grid's cube, in its coordinates.
    pub half_width: f64,
    /// Interpolation between voxel centres.
    pub interpolation: Interpolation,
    /// Color representation.
    pub color: Color,
    /// Reduction of harmonics: coefficients of degree 1 and more are stored for every n-th voxel along each axis, in a separate table. 1
    /// stores all coefficients in the color table. A normalised shape without such coefficients has 1.
    pub sh_reduction: usize,
    /// Coordinates of the cube. The positions and rays of a grid are in these coordinates. Lengths along rays, and densities, which are 1 / length, are those of the
    /// box of their space: world lengths in [`Space::Box`].
    pub coordinates: GridSpace,
}

impl GridShape {
    /// Half widths for which voxels can be computed in 32 bits at any resolution.
    pub const HALF_WIDTHS: RangeInclusive<f64> = 1e-9..=1e9;

    /// Returns the shape of a cube of the world whose harmonics are not reduced.
    pub const fn new(resolution: usize, half_width: f64, interpolation: Interpolation, color: Color) -> Self {
        GridShape { resolution, half_width, interpolation, color, sh_reduction: 1, coordinates: GridSpace::WORLD }
    }

    /// Returns the shape with `sh_reduction` 1 if there are no harmonics to reduce.
    pub fn normalised(self) -> Self {
        GridShape { sh_reduction: if self.is_reduced() { self.sh_reduction } else { 1 }, ..self }
    }

    /// Returns true if harmonics of degree 1 and more are stored in a separate table, for larger voxels.
    pub fn is_reduced(&self) -> bool {
        self.sh_reduction > 1 && self.color.channels() > 3
    }

    /// Returns the width of the color table: all color numbers, or the coefficients of degree 0 only if harmonics are reduced.
    pub fn color_width(&self) -> usize {
        if self.is_reduced() { 3 } else { self.color.channels() }
    }

    /// Returns the width of the table of harmonics, whose rows hold red, then green, then blue; 0 if there is no such table.
    pub fn harmonics_width(&self) -> usize {
        self.color.channels() - self.color_width()
    }

    /// Returns the number of voxels of the harmonics along each axis: ⌈resolution / reduction⌉. The first begins at the grid's corner, the
    /// last may extend beyond the grid.
    pub fn harmonics_resolution(&self) -> usize {
        self.resolution.div_ceil(self.sh_reduction)
    }

    /// Returns scale a and shift b from a coordinate x of the grid to the voxel coordinate a x + b; voxel centres are at whole numbers.
    pub fn to_voxels(&self) -> [f64; 2] {
        let scale = 1.0 / self.voxel_side();
        [scale, self.half_width * scale - 0.5]
    }

    /// Returns scale a and shift b from voxel coordinates u to coordinates of the harmonics, (u + ½) / reduction − ½ = a u + b.
    pub fn to_harmonics(&self) -> [f64; 2] {
        let scale = 1.0 / self.sh_reduction as f64;
        [scale, 0.5 * scale - 0.5]
    }

    /// Returns the number of voxels.
    pub fn voxels(&self) -> usize {
        self.resolution.pow(3)
    }

    /// Returns the side of a voxel, in the coordinates of the grid.
    pub fn voxel_side(&self) -> f64 {
        2.0 * self.half_width / self.resolution as f64
    }

    /// Returns the box of the grid in the coordinates of its space, without what lies beyond infinity in normalized device coordinates.
    pub fn box_in_space(&self) -> Aabb {
        let Aabb { min, max } = self.coordinates.unstretched(Aabb::cube(self.half_width));
        match self.coordinates.space {
            Space::Ndc { .. } => Aabb { min: min.with_z(min.z.max(-1.0)), max: max.with_z(max.z.min(1.0)) },
            Space::Box | Space::Contracted => Aabb { min, max },
        }
    }

    /// Returns true if the numbers of the box lie in the range of [`HALF_WIDTHS`](Self::HALF_WIDTHS), and if they are those of its space: 2 for contracted space, and in
    /// normalized device coordinates, the only ones that are stretched, factors from 1e-3 to 1e3.
    pub(crate) fn has_valid_box(&self) -> bool {
        let GridSpace { space, stretch } = self.coordinates;
        let straight = stretch.x == 1.0 && stretch.y == 1.0;
        let of_space = match space {
            Space::Box => stretch == DVec3::ONE,
            Space::Contracted => stretch == DVec3::ONE && self.half_width == Space::CONTRACTED,
            Space::Ndc { a, b } => straight && [a, b, stretch.z].iter().all(|x| (1e-3..=1e3).contains(x)),
        };
        Self::HALF_WIDTHS.contains(&self.half_width) && of_space
    }

    /// Returns the fraction α of light that a voxel of raw density σ, 1 / length, absorbs along an axis: 1 − exp(−max(0, σ) side), in
    /// [0, 1].
    pub fn alpha_of_density(&self, density: f64) -> f64 {
        -(-density.max(0.0) * self.voxel_side()).exp_m1()
    }

    /// Returns the density, 1 / length, of a voxel that absorbs the fraction `alpha` of the light: −ln(1 − α) / side.
    pub fn density_of_alpha(&self, alpha: f64) -> f64 {
        -(-alpha).ln_1p() / self.voxel_side()
    }

    /// Returns the position of a voxel's centre. The voxel may lie outside of the grid.
    pub fn center(&self, voxel: [isize; 3]) -> DVec3 {
        DVec3::from(voxel.map(|k| (k as f64 + 0.5) * self.voxel_side() - self.half_width))
    }

    /// Returns the lattice with all voxels present.
    pub fn full(&self) -> Lattice {
        Lattice::bricks([self.resolution; 3])
    }

    /// Returns the lattice of the harmonics for the voxels of a lattice; `None` if they are not reduced.
    ///
    /// Panics if the lattice has another resolution.
    #[track_caller]
    pub fn harmonics_lattice(&self, lattice: &Lattice) -> Option<Lattice> {
        Layout::new(*self, lattice.clone()).harmonics
    }

    /// Returns the shapes of the tables for the voxels of a lattice: density, color and, if they are reduced, harmonics.
    pub fn tables(&self, lattice: &Lattice) -> Vec<[usize; 2]> {
        Layout::new(*self, lattice.clone()).tables()
    }

    /// Returns the voxels in which a sample can read one of `voxels`: with nearest look-up `voxels`, with trilinear look-up also their
    /// neighbours.
    pub fn reached_from(&self, voxels: &Occupancy) -> Occupancy {
        voxels.dilated(usize::from(self.interpolation == Interpolation::Trilinear))
    }

    /// Returns the cells in which a sample reads one of `voxels`: with nearest look-up `voxels`, with trilinear look-up the cells between
    /// centres.
    pub fn cells_reading(&self, voxels: Occupancy) -> Occupancy {
        match self.interpolation {
            Interpolation::Nearest => voxels,
            Interpolation::Trilinear => voxels.between_centres(),
        }
    }

    /// Returns the bytes per voxel in all tables, in `f32`, including its share of reduced harmonics.
    pub fn voxel_bytes(&self) -> usize {
        let shared = (self.harmonics_width() * size_of::<f32>()).div_ceil(self.sh_reduction.pow(3));
        (1 + self.color_width()) * size_of::<f32>() + shared
    }

    /// Returns the bytes of all tables in `f32`, with all voxels present.
    pub fn bytes(&self) -> usize {
        let harmonics = self.harmonics_resolution().pow(3) * self.harmonics_width();
        (self.voxels() * (1 + self.color_width()) + harmonics) * size_of::<f32>()
    }
}
