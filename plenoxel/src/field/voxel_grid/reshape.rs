//! Conversion of the grid: resolution, present voxels, look-up. Converted parameters have new identities, so optimizer state is not carried
//! over.
//!
//! Reduced harmonics are converted too. Where the new grid has harmonics and the old grid had none, they are the mean of their neighbours.

use super::layout::{Layout, dilated};
use super::{Color, GridShape, Interpolation, VoxelGrid};
use crate::field::neighbours;
use crate::sampling::Occupancy;
use autograd::lattice::BRICK;
use autograd::ops::trilinear::nearest_node;
use autograd::{Buffer, Lattice, Real, Tensor, no_grad, parallel};
use std::ops::Range;

impl<T: Real> VoxelGrid<T> {
    /// Resamples the field at another resolution: evaluates the old field at the new voxel centres, with the look-up that renders it. A
    /// voxel is present if it reads a present voxel.
    ///
    /// With nearest look-up, doubling the resolution preserves the field exactly. With trilinear look-up, it preserves the field inside the
    /// old cells, and smooths it within a quarter of an old voxel around the planes through old centres.
    pub fn resample(&self, resolution: usize) -> Self {
        self.resample_in(resolution, self.shape().half_width)
    }

    /// Resamples the field at a resolution in a smaller cube around the origin. Matter outside of the cube is lost.
    ///
    /// Panics if the cube is larger than the old one.
    #[track_caller]
    pub fn resample_in(&self, resolution: usize, half_width: f64) -> Self {
        let old = self.shape();
        assert!(half_width > 0.0 && half_width <= old.half_width, "half width {half_width} for a grid of half width {}", old.half_width);
        let shape = GridShape { resolution, half_width, ..*old };
        let center = center_of(old, &shape, 1);
        let lattice = match &self.reach {
            None => shape.full(),
            Some(_) => {
                let last = self.shape().resolution - 1;
                let corners = |k: usize| match self.shape().interpolation {
                    Interpolation::Nearest => {
                        let [nearest, ..] = nearest_node([T::lit(center(k)); 3], [last + 1; 3]);
                        nearest as usize..nearest as usize + 1
                    }
                    Interpolation::Trilinear => {
                        let low = center(k).clamp(0.0, last as f64) as usize;
                        low..(low + 2).min(last + 1)
                    }
                };
                // Old bricks that a new brick reads.
                let bricks = |k: usize| {
                    let last = (k * BRICK + BRICK - 1).min(resolution - 1);
                    corners(k * BRICK).start / BRICK..corners(last).end.div_ceil(BRICK)
                };
                Lattice::bricks_among(
                    [resolution; 3],
                    |place| any_of(place.map(bricks), |old| self.lattice().brick(old).is_some()),
                    |voxel| any_of(voxel.map(corners), |old| self.lattice().row(old).is_some()),
                )
            }
        };
        self.read_at(shape, lattice)
    }

    /// Resamples the field with the resolution, the cube and the voxels of another grid. The voxels must be among those of
    /// [`VoxelGrid::resample_in`].
    pub fn resample_as(&self, other: &Self) -> Self {
        let GridShape { resolution, half_width, .. } = *other.shape();
        self.read_at(GridShape { resolution, half_width, ..*self.shape() }, other.lattice().clone())
    }

    /// Evaluates the field at the centres of the voxels of `lattice`.
    fn read_at(&self, shape: GridShape, lattice: Lattice) -> Self {
        let old = self.shape();
        let layout = Layout::new(shape, lattice);
        let read = |table: &Tensor<T>, from: &Lattice, to: &Lattice, sides: usize| {
            let center = center_of(old, &shape, sides);
            let width = table.shape()[1];
            let mut values = Buffer::stale(to.rows() * width);
            // Processing a run of rows at a time bounds the memory for positions.
            const RUN: usize = 1 << 16;
            for (run, part) in values.chunks_mut(RUN * width).enumerate() {
                let rows = part.len() / width;
                let mut at = Buffer::stale(rows * 3);
                parallel::for_each_chunk(&mut at, 3 * 4096, |first, chunk| {
                    for (r, p) in chunk.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                        let row = run * RUN + first / 3 + r;
                        *p = to.node(row as u32).map_or([T::zero(); 3], |node| node.map(|k| T::lit(center(k))));
                    }
                });
                let read = no_grad(|| shape.interpolation.look_up(table, &Tensor::from_buffer(at, &[rows, 3]), from));
                parallel::copy(read.data(), part);
            }
            Tensor::from_buffer(values, &[to.rows(), width])
        };
        let whole = [&self.density, &self.color].map(|table| read(table.tensor(), self.lattice(), &layout.lattice, 1));
        let mut tables = Vec::from(whole);
        // Some centres of the new harmonics lie beyond the old present voxels.
        if let (Some(table), Some(from), Some(to)) = (&self.harmonics, self.harmonics_lattice(), &layout.harmonics) {
            let wider = dilated(from);
            tables.push(read(&spread(table.tensor(), from, &wider), &wider, to, old.sh_reduction));
        }
        Self::assembled(layout, tables)
    }

    /// Returns the grid without the voxels outside of `kept`.
    ///
    /// Panics if the cells of `kept` are not the voxels of this grid.
    pub fn pruned(&self, kept: &Occupancy) -> Self {
        assert_eq!(kept.cells(), self.lattice().nodes(), "pruned: the occupancy has another resolution than the grid");
        let masks = kept.masks().iter().zip(self.lattice().masks()).map(|(kept, present)| kept & present).collect();
        self.in_lattice(Lattice::from_masks(self.lattice().nodes(), masks))
    }

    /// Adds a layer of voxels around the present voxels, with density 0 and the mean color of the voxels that they touch. Trilinear look-up
    /// at the border then reads colors of the object. Voxels whose color numbers are all 0, such as carved voxels that no pixel shows, do
    /// not contribute to the mean.
    pub fn grown(&self) -> Self {
        let lattice = dilated(self.lattice());
        let density = moved(self.density.tensor(), self.lattice(), &lattice);
        let color = spread(self.color.tensor(), self.lattice(), &lattice);
        self.with_voxels(*self.shape(), lattice, density, color)
    }

    /// Adds a layer of voxels with density and color 0 around the present voxels. Absent voxels are read as zeros, so no rendered value
    /// changes, and the zeros can be converted ([`VoxelGrid::with_color`]).
    pub fn surrounded(&self) -> Self {
        self.in_lattice(dilated(self.lattice()))
    }

    /// Returns the grid with the same values and another look-up.
    pub fn with_interpolation(&self, interpolation: Interpolation) -> Self {
        let shape = GridShape { interpolation, ..*self.shape() };
        self.with_voxels(shape, self.lattice().clone(), self.density.tensor().detach(), self.color.tensor().detach())
    }

    /// Returns the grid with other densities, `[rows, 1]`. The other tables are shared until they are changed.
    pub fn with_density(&self, density: Tensor<T>) -> Self {
        let tables = [density].into_iter().chain(self.params().skip(1).map(|table| table.tensor().detach())).collect();
        Self::assembled(self.layout().clone(), tables)
    }

    /// Returns the grid with the same densities and RGB colors of 0.
    pub fn outline(&self) -> Self {
        let shape = GridShape { color: Color::Rgb, ..*self.shape() };
        let tables = vec![self.density.tensor().detach(), Tensor::zeros(&[self.lattice().rows(), 3])];
        Self::with_tables(shape, self.lattice().clone(), tables)
    }

    /// Returns the grid with other voxels, among them zeros for those that it does not have.
    fn in_lattice(&self, lattice: Lattice) -> Self {
        let [density, color] = [&self.density, &self.color].map(|table| moved(table.tensor(), self.lattice(), &lattice));
        self.with_voxels(*self.shape(), lattice, density, color)
    }

    /// Returns a grid with other voxels or another look-up, and the harmonics of this grid. Resolution and color representation are
    /// unchanged.
    fn with_voxels(&self, shape: GridShape, lattice: Lattice, density: Tensor<T>, color: Tensor<T>) -> Self {
        let layout = Layout::new(shape, lattice);
        let mut tables = vec![density, color];
        if let (Some(table), Some(from), Some(to)) = (&self.harmonics, self.harmonics_lattice(), &layout.harmonics) {
            tables.push(spread(table.tensor(), from, to));
        }
        Self::assembled(layout, tables)
    }
}

/// Returns true if `found` holds for a place in a box.
fn any_of([i, j, k]: [Range<usize>; 3], found: impl Fn([usize; 3]) -> bool) -> bool {
    i.into_iter().any(|a| j.clone().any(|b| k.clone().any(|c| found([a, b, c]))))
}

/// Returns the position of the centre of voxel k along an axis in coordinates of the old grid. Both grids have voxels `sides` times as
/// wide.
fn center_of(old: &GridShape, new: &GridShape, sides: usize) -> impl Fn(usize) -> f64 + use<> {
    let ratio = new.voxel_side() / old.voxel_side();
    let beyond = (old.half_width - new.half_width) / (old.voxel_side() * sides as f64);
    move |k| (k as f64 + 0.5) * ratio - 0.5 + beyond
}

/// Moves a table to another lattice of the same grid, with zeros for nodes that the old lattice lacks.
pub(super) fn moved<T: Real>(table: &Tensor<T>, from: &Lattice, to: &Lattice) -> Tensor<T> {
    let width = table.shape()[1];
    let mut values = Buffer::stale(to.rows() * width);
    parallel::for_each_rows(&mut values, width, |first, chunk| {
        for (r, row) in chunk.chunks_exact_mut(width).enumerate() {
            match to.node((first + r) as u32).and_then(|node| from.row(node)) {
                Some(old) => row.copy_from_slice(&table.data()[old as usize * width..][..width]),
                None => row.fill(T::zero()),
            }
        }
    });
    Tensor::from_buffer(values, &[to.rows(), width])
}

/// Moves a table to another lattice of the same grid. Nodes that the old lattice lacks get the mean of their neighbours; rows of zeros,
/// which were never set, do not contribute.
pub(super) fn spread<T: Real>(table: &Tensor<T>, from: &Lattice, to: &Lattice) -> Tensor<T> {
    let width = table.shape()[1];
    let mut values = Buffer::copy_of(moved(table, from, to).data());
    parallel::for_each_rows(&mut values, width, |first, chunk| {
        for (r, row) in chunk.chunks_exact_mut(width).enumerate() {
            if let Some(node) = to.node((first + r) as u32).filter(|node| from.row(*node).is_none()) {
                neighbours::average(from, table.data(), node, |row| row.iter().any(|x| *x != T::zero()), row);
            }
        }
    });
    Tensor::from_buffer(values, &[to.rows(), width])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_layer_around_has_the_colors_of_what_it_touches_but_not_of_what_nobody_saw() {
        let shape = GridShape::new(8, 1.0, Interpolation::Nearest, Color::Rgb);
        // Two adjacent voxels with colors and one that no pixel shows; and another such voxel far away.
        let present = [[1, 1, 1], [1, 1, 2], [1, 1, 3], [6, 6, 6]];
        let lattice = Lattice::bricks_where([8; 3], |voxel| present.contains(&voxel));
        let mut color = vec![0.0; 3 * lattice.rows()];
        for (voxel, rgb) in [(present[0], [0.2, 0.4, 0.6]), (present[1], [0.8, 0.0, 0.0])] {
            let row = lattice.row(voxel).unwrap() as usize;
            color[3 * row..3 * row + 3].copy_from_slice(&rgb);
        }
        let rows = lattice.rows();
        let grid = VoxelGrid::<f64>::with_lattice(shape, lattice, Tensor::full(&[rows, 1], 5.0), Tensor::from_vec(color, &[rows, 3]));
        let grown = grid.grown();
        let color_at = |voxel: [usize; 3]| {
            let row = grown.lattice().row(voxel).unwrap() as usize;
            [0, 1, 2].map(|c| grown.color.tensor().data()[3 * row + c])
        };
        assert_eq!(grown.density_at([2, 1, 1]), 0.0);
        assert_eq!(color_at([1, 1, 0]), [0.2, 0.4, 0.6]);
        // The voxel touches the second voxel across an edge, and the third across a face.
        let near = color_at([2, 1, 3]);
        assert!((near[0] - 0.8).abs() < 1e-12 && near[1..] == [0.0; 2], "{near:?}");
        // Voxels without colored neighbours stay black, and existing voxels are unchanged.
        assert_eq!((color_at([1, 1, 4]), color_at([6, 6, 7]), color_at([1, 1, 3])), ([0.0; 3], [0.0; 3], [0.0; 3]));
    }
}
