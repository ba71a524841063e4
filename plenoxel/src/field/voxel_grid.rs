//! Density and color in a grid of voxels, dense or sparse.
//!
//! Voxel (i, j, k) of n³ has its centre at (i + ½, j + ½, k + ½) · side − half. A [`Lattice`] of bricks says which row of the tables is
//! its own, if it is present; one that is not has density and color 0 and takes no part in training. Nearest look-up takes the voxel a
//! point lies in; trilinear look-up runs between centres, and in the outer half voxel repeats the border. Outside the box there is nothing.
//! Values are stored raw and activated after interpolation: σ = max(0, density).
//!
//! How a color changes with the direction changes little from voxel to voxel. So harmonics of degree 1 and more may be stored for every f-th
//! voxel along each axis only ([`GridShape::sh_reduction`]), which leaves 3 numbers of color in a voxel and is harder to overfit:
//! c(x, d) = max(0, offset + Y₀ c₀(x) + Σ_{k≥1} Yₖ(d) cₖ(x)), where c₀ is read as density is, and cₖ the same way in a grid of ⌈n / f⌉³ voxels
//! of side f · side with the same lowest corner. Its coordinates are (u + ½) / f − ½ of the voxel coordinates u.

mod appearance;
pub mod fused;
pub(crate) mod layout;
mod recolor;
mod reshape;
mod shape;

use super::{Field, Radiance};
use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::random::{Purpose, uniform};
use crate::render::{RenderOptions, Rendered};
use crate::sampling::{Occupancy, Samples};
use autograd::lattice::{BRICK_ROWS, bits_where};
use autograd::{Bounds, Buffer, Lattice, Module, Param, Real, Tensor, parallel};
use layout::Layout;
use reshape::moved;
pub use shape::{Color, GridShape, Interpolation};

/// A grid with its parameters: `density` `[rows, 1]`, `color` `[rows, color_width]` and, where harmonics are reduced, `harmonics`
/// `[rows of larger voxels, harmonics_width]`.
#[derive(Debug)]
pub struct VoxelGrid<T: Real> {
    layout: Layout,
    /// The voxels in which a sample can read a present one; `None` if that is everywhere.
    reach: Option<Occupancy>,
    /// Raw density; σ = max(0, ·) after interpolation, 1 / world length.
    pub density: Param<T>,
    /// Colors or their harmonics; of harmonics that are reduced, the means.
    pub color: Param<T>,
    /// Harmonics of degree 1 and more, where they are reduced.
    pub harmonics: Option<Param<T>>,
}

impl<T: Real> VoxelGrid<T> {
    /// A grid with the same density and the same color numbers everywhere.
    pub fn uniform(shape: GridShape, density: f64, color: f64) -> Self {
        Self::filled(shape, |table, shape| Tensor::full(&shape, [density, color, color][table]))
    }

    /// A grid of uniform random numbers: density in [0, `density`), colors in [0, `color`). A function of the seed.
    pub fn random(shape: GridShape, density: f64, color: f64, seed: u64) -> Self {
        Self::filled(shape, |table, [rows, width]| {
            let scale = [density, color, color][table];
            let mut values = Buffer::stale(rows * width);
            parallel::for_each_chunk(&mut values, parallel::CHUNK, |start, chunk| {
                for (i, v) in chunk.iter_mut().enumerate() {
                    *v = T::lit(scale * uniform(seed, Purpose::Initial, table as u64, (start + i) as u64));
                }
            });
            Tensor::from_buffer(values, &[rows, width])
        })
    }

    /// A grid with all voxels from what `fill` makes of each table's number and shape.
    fn filled(shape: GridShape, fill: impl Fn(usize, [usize; 2]) -> Tensor<T>) -> Self {
        let layout = Layout::new(shape, shape.full());
        let tables = layout.tables().into_iter().enumerate().map(|(table, shape)| fill(table, shape)).collect();
        Self::assembled(layout, tables)
    }

    /// A grid with all voxels from its tables, whose rows are in the order of [`GridShape::full`].
    ///
    /// Panics if they are not `[rows, 1]` and `[rows, channels]`, or if the shape's harmonics are reduced.
    #[track_caller]
    pub fn from_tables(shape: GridShape, density: Tensor<T>, color: Tensor<T>) -> Self {
        Self::with_lattice(shape, shape.full(), density, color)
    }

    /// A grid with the voxels of a lattice.
    ///
    /// Panics if the lattice is of another resolution, the tables do not have its rows, or the shape's harmonics are reduced.
    #[track_caller]
    pub fn with_lattice(shape: GridShape, lattice: Lattice, density: Tensor<T>, color: Tensor<T>) -> Self {
        Self::with_tables(shape, lattice, vec![density, color])
    }

    /// A grid with the voxels of a lattice and all its tables: density, color and, if the shape's harmonics are reduced, these, whose rows are
    /// those of [`GridShape::harmonics_lattice`].
    ///
    /// Panics if the lattice is of another resolution, or the tables are not as many or not of these shapes.
    #[track_caller]
    pub fn with_tables(shape: GridShape, lattice: Lattice, tables: Vec<Tensor<T>>) -> Self {
        Self::assembled(Layout::new(shape, lattice), tables)
    }

    #[track_caller]
    fn assembled(layout: Layout, tables: Vec<Tensor<T>>) -> Self {
        let found: Vec<&[usize]> = tables.iter().map(Tensor::shape).collect();
        assert_eq!(found, layout.tables(), "tables of a grid of {}³ voxels, with {:?}", layout.shape.resolution, layout.shape);
        let lattice = &layout.lattice;
        let reach = (!lattice.is_full()).then(|| {
            let present = Occupancy::from_masks(Aabb::cube(layout.shape.half_width), lattice.nodes(), lattice.masks().to_vec());
            layout.shape.cells_reading(present)
        });
        let mut params = ["density", "color", "harmonics"].into_iter().zip(tables).map(|(name, table)| Param::from_tensor(name, table));
        let (Some(density), Some(color)) = (params.next(), params.next()) else { unreachable!("every layout has two tables") };
        let harmonics = params.next();
        VoxelGrid { layout, reach, density, color, harmonics }
    }

    /// A grid with all voxels from tables in row-major order, voxel (i, j, k) being row (i·n + j)·n + k.
    ///
    /// Panics if they are not `[n³, 1]` and `[n³, channels]`, or if the shape's harmonics are reduced.
    #[track_caller]
    pub fn from_row_major(shape: GridShape, density: &Tensor<T>, color: &Tensor<T>) -> Self {
        assert_eq!(density.shape(), [shape.voxels(), 1], "density table of a grid of {}³ voxels", shape.resolution);
        assert_eq!(color.shape(), [shape.voxels(), shape.color.channels()], "color table of a grid of {}³ voxels", shape.resolution);
        let full = shape.full();
        let row_major = Lattice::from([shape.resolution; 3]);
        Self::from_tables(shape, moved(density, &row_major, &full), moved(color, &row_major, &full))
    }

    /// Density and color in row-major order, with zeros for voxels that are not present: `[n³, 1]` and `[n³, color_width]`.
    pub fn to_row_major(&self) -> [Tensor<T>; 2] {
        let row_major = Lattice::from(self.lattice().nodes());
        [&self.density, &self.color].map(|table| moved(table.tensor(), self.lattice(), &row_major))
    }

    /// Shape and meaning.
    pub fn shape(&self) -> &GridShape {
        &self.layout.shape
    }

    /// Which voxels are present, and their rows: what look-ups take.
    pub fn lattice(&self) -> &Lattice {
        &self.layout.lattice
    }

    /// The same for the harmonics, where they are reduced.
    pub fn harmonics_lattice(&self) -> Option<&Lattice> {
        self.layout.harmonics.as_ref()
    }

    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The parameters in the order of the tables: density, color, and harmonics where they are reduced.
    pub fn params(&self) -> impl Iterator<Item = &Param<T>> {
        [&self.density, &self.color].into_iter().chain(&self.harmonics)
    }

    /// The box it fills.
    pub fn aabb(&self) -> Aabb {
        Aabb::cube(self.shape().half_width)
    }

    /// World positions to voxel coordinates, in which centres are the integers: (p + half) / side − ½.
    pub fn world_to_voxels(&self, positions: &Tensor<T>) -> Tensor<T> {
        let scale = 1.0 / self.shape().voxel_side();
        positions.affine(scale, self.shape().half_width * scale - 0.5)
    }

    /// Makes optimizers keep density >= 0, and RGB colors in [0, 1] (the source paper's projection; harmonics are free).
    pub fn project(&mut self) {
        self.density.set_bounds(Bounds { low: T::zero(), high: T::infinity() });
        if self.shape().color == Color::Rgb {
            self.color.set_bounds(Bounds { low: T::zero(), high: T::one() });
        }
    }

    /// The cells in which a sample can have a density above 0: with trilinear look-up those between centres of voxels, with nearest the voxels.
    /// Leaving out the samples elsewhere changes no rendered value.
    pub fn matter(&self) -> Occupancy {
        let density = self.density.tensor().data();
        self.shape().cells_reading(self.voxels_where(|row| density[row] > T::zero()))
    }

    /// The cells in which a sample can have a gradient: it has none where its density is below 0.
    pub fn learning(&self) -> Occupancy {
        let density = self.density.tensor().data();
        self.shape().cells_reading(self.voxels_where(|row| density[row] >= T::zero()))
    }

    /// The voxels in which a sample can have a density above `threshold`: those whose own value, or with trilinear look-up a neighbour's, is.
    pub fn occupancy(&self, threshold: f64) -> Occupancy {
        let (density, threshold) = (self.density.tensor().data(), T::lit(threshold));
        self.shape().reached_from(&self.voxels_where(|row| density[row] > threshold))
    }

    /// The present voxels whose rows `full` names.
    pub fn voxels_where(&self, full: impl Fn(usize) -> bool + Sync) -> Occupancy {
        let mut masks = self.lattice().masks().to_vec();
        let grid = self.lattice().brick_grid();
        parallel::for_each_chunk(&mut masks, 256, |first, chunk| {
            for (b, mask) in (first..).zip(chunk) {
                if let Some((brick, present)) = self.lattice().brick(grid.place(b)) {
                    *mask = bits_where(present, |bit| full(brick * BRICK_ROWS + bit));
                }
            }
        });
        Occupancy::from_masks(self.aabb(), self.lattice().nodes(), masks)
    }
}

impl<T: Real> Field<T> for VoxelGrid<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.layout.look_up(self.density.tensor(), &self.world_to_voxels(positions)).reshape(&[positions.shape()[0]]).relu()
    }

    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        let voxels = self.world_to_voxels(&samples.positions);
        let [density, color] = [&self.density, &self.color].map(|table| self.layout.look_up(table.tensor(), &voxels));
        let color = self.layout.whole_colors(color, self.harmonics.as_ref().map(Param::tensor), &voxels);
        self.shape().color.activate(&density, &color, &samples.directions, &samples.offsets)
    }

    fn reach(&self) -> Option<&Occupancy> {
        self.reach.as_ref()
    }

    fn render_fused(&self, rays: &[Ray], options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        Some(fused::render(self, rays, options))
    }
}

impl<T: Real> AsRef<Self> for VoxelGrid<T> {
    fn as_ref(&self) -> &Self {
        self
    }
}

impl<T: Real> Module<T> for VoxelGrid<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.params().for_each(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        f(&mut self.density);
        f(&mut self.color);
        self.harmonics.iter_mut().for_each(f);
    }
}
