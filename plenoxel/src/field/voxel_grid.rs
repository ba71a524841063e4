//! Density and color in a grid of voxels, dense or sparse.
//!
//! Voxel (i, j, k) of n³ has its centre at (i + ½, j + ½, k + ½) · side − half width. A [`Lattice`] of bricks maps each present voxel to
//! its row of the tables. An absent voxel has density and color 0 and is not trained. Nearest look-up reads the voxel that contains the
//! point. Trilinear look-up interpolates between voxel centres; in the outer half voxel it repeats the border. Space outside of the box is
//! empty. Values are stored raw and activated after interpolation: σ = max(0, density).
//!
//! View-dependent color varies slowly from voxel to voxel. Harmonics of degree 1 and more may therefore be stored for every f-th voxel
//! along each axis only ([`GridShape::sh_reduction`]). A voxel then stores 3 color numbers, and overfits less:
//!
//! c(x, d) = max(0, offset + Y₀ c₀(x) + Σ_{k≥1} Yₖ(d) cₖ(x)).
//!
//! Here c₀ is interpolated like the density, and cₖ likewise in a grid of ⌈n / f⌉³ voxels of side f · side with the same lowest corner.
//! Voxel coordinates u have the coordinates (u + ½) / f − ½ in that grid.

mod appearance;
pub mod fused;
mod grid_space;
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
pub use grid_space::GridSpace;
use layout::Layout;
use reshape::moved;
pub use shape::{Color, GridShape, Interpolation};

/// Voxel grid with its parameters: `density` `[rows, 1]`, `color` `[rows, color_width]` and, if harmonics are reduced, `harmonics` `[rows
/// of larger voxels, harmonics_width]`.
#[derive(Debug)]
pub struct VoxelGrid<T: Real> {
    layout: Layout,
    /// Cells in which a sample can read a present voxel; `None` if all cells are.
    reach: Option<Occupancy>,
    /// Raw density, 1 / length; σ = max(0, ·) after interpolation.
    pub density: Param<T>,
    /// RGB colors or coefficients of harmonics. If harmonics are reduced, the coefficients of degree 0.
    pub color: Param<T>,
    /// Coefficients of degree 1 and more, if harmonics are reduced.
    pub harmonics: Option<Param<T>>,
}

impl<T: Real> VoxelGrid<T> {
    /// Creates a grid with constant density and color numbers.
    pub fn uniform(shape: GridShape, density: f64, color: f64) -> Self {
        Self::filled(shape, |table, shape| Tensor::full(&shape, [density, color, color][table]))
    }

    /// Creates a grid of uniform random numbers, density in [0, `density`) and colors in [0, `color`). The result depends only on the seed.
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

    /// Creates a grid with all voxels. `fill` receives the number and the shape of each table.
    fn filled(shape: GridShape, fill: impl Fn(usize, [usize; 2]) -> Tensor<T>) -> Self {
        let layout = Layout::new(shape, shape.full());
        let tables = layout.tables().into_iter().enumerate().map(|(table, shape)| fill(table, shape)).collect();
        Self::assembled(layout, tables)
    }

    /// Creates a grid with all voxels from its tables. Their rows are in the order of [`GridShape::full`].
    ///
    /// Panics if the tables are not `[rows, 1]` and `[rows, channels]`, or if the shape's harmonics are reduced.
    #[track_caller]
    pub fn from_tables(shape: GridShape, density: Tensor<T>, color: Tensor<T>) -> Self {
        Self::with_lattice(shape, shape.full(), density, color)
    }

    /// Creates a grid with the voxels of a lattice.
    ///
    /// Panics if the lattice has another resolution, the tables have another number of rows, or the shape's harmonics are reduced.
    #[track_caller]
    pub fn with_lattice(shape: GridShape, lattice: Lattice, density: Tensor<T>, color: Tensor<T>) -> Self {
        Self::with_tables(shape, lattice, vec![density, color])
    }

    /// Creates a grid with the voxels of a lattice from all its tables: density, color and, if harmonics are reduced, harmonics, whose rows
    /// are those of [`GridShape::harmonics_lattice`].
    ///
    /// Panics if the lattice has another resolution, or if the number or the shapes of the tables do not match.
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

    /// Creates a grid with all voxels from tables in row-major order: voxel (i, j, k) is row (i·n + j)·n + k.
    ///
    /// Panics if the tables are not `[n³, 1]` and `[n³, channels]`, or if the shape's harmonics are reduced.
    #[track_caller]
    pub fn from_row_major(shape: GridShape, density: &Tensor<T>, color: &Tensor<T>) -> Self {
        assert_eq!(density.shape(), [shape.voxels(), 1], "density table of a grid of {}³ voxels", shape.resolution);
        assert_eq!(color.shape(), [shape.voxels(), shape.color.channels()], "color table of a grid of {}³ voxels", shape.resolution);
        let full = shape.full();
        let row_major = Lattice::from([shape.resolution; 3]);
        Self::from_tables(shape, moved(density, &row_major, &full), moved(color, &row_major, &full))
    }

    /// Returns density and color in row-major order, `[n³, 1]` and `[n³, color_width]`, with zeros for absent voxels.
    pub fn to_row_major(&self) -> [Tensor<T>; 2] {
        let row_major = Lattice::from(self.lattice().nodes());
        [&self.density, &self.color].map(|table| moved(table.tensor(), self.lattice(), &row_major))
    }

    /// Returns the shape of the grid.
    pub fn shape(&self) -> &GridShape {
        &self.layout.shape
    }

    /// Returns the lattice, which maps present voxels to rows of the tables.
    pub fn lattice(&self) -> &Lattice {
        &self.layout.lattice
    }

    /// Returns the lattice of the harmonics, if they are reduced.
    pub fn harmonics_lattice(&self) -> Option<&Lattice> {
        self.layout.harmonics.as_ref()
    }

    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Returns the parameters in the order of the tables: density, color and, if harmonics are reduced, harmonics.
    pub fn params(&self) -> impl Iterator<Item = &Param<T>> {
        [&self.density, &self.color].into_iter().chain(&self.harmonics)
    }

    /// Returns the box of the grid.
    pub fn aabb(&self) -> Aabb {
        Aabb::cube(self.shape().half_width)
    }

    /// Converts world positions to voxel coordinates, in which voxel centres are integers: (p + half width) / side − ½.
    pub fn world_to_voxels(&self, positions: &Tensor<T>) -> Tensor<T> {
        let scale = 1.0 / self.shape().voxel_side();
        positions.affine(scale, self.shape().half_width * scale - 0.5)
    }

    /// Bounds density to >= 0, and RGB colors to [0, 1], in all optimizers (the source paper's projection). Harmonics are not bounded.
    pub fn project(&mut self) {
        self.density.set_bounds(Bounds { low: T::zero(), high: T::infinity() });
        if self.shape().color == Color::Rgb {
            self.color.set_bounds(Bounds { low: T::zero(), high: T::one() });
        }
    }

    /// Returns the cells in which a sample can have a density above 0: cells between voxel centres with trilinear look-up, voxels with
    /// nearest look-up. Leaving out samples in other cells changes no rendered value.
    pub fn matter(&self) -> Occupancy {
        self.shape().cells_reading(self.voxels_denser_than(0.0))
    }

    /// Returns the present voxels whose own density is above a threshold.
    pub(crate) fn voxels_denser_than(&self, threshold: f64) -> Occupancy {
        let (density, threshold) = (self.density.tensor().data(), T::lit(threshold));
        self.voxels_where(|row| density[row] > threshold)
    }

    /// Returns the cells in which a sample can have a gradient. A sample whose density is negative has none.
    pub fn learning(&self) -> Occupancy {
        let density = self.density.tensor().data();
        self.shape().cells_reading(self.voxels_where(|row| density[row] >= T::zero()))
    }

    /// Returns the voxels in which a sample can have a density above `threshold`: the voxel's own density or, with trilinear look-up, a
    /// neighbour's is.
    pub fn occupancy(&self, threshold: f64) -> Occupancy {
        self.shape().reached_from(&self.voxels_denser_than(threshold))
    }

    /// Returns the present voxels whose rows satisfy `full`.
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
