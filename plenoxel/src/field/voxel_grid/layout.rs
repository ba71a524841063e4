//! Mapping from voxels to rows of the tables, and look-up of values.

use super::shape::{GridShape, Interpolation};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use autograd::{Lattice, Real, Tensor};

/// Shape of a grid, with the rows of its voxels. Cloning copies pointers.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// Shape, normalised.
    pub shape: GridShape,
    /// Rows of density and color.
    pub lattice: Lattice,
    /// Rows of the harmonics, if they are reduced.
    pub harmonics: Option<Lattice>,
}

impl Layout {
    /// Creates the layout of the voxels of a lattice. Harmonics are present in the larger voxels that contain a present voxel and, with
    /// trilinear look-up, in their neighbours. A sample that reads a present voxel therefore finds its harmonics, with a margin of at most
    /// one larger voxel.
    ///
    /// Panics if the lattice has another resolution.
    #[track_caller]
    pub fn new(shape: GridShape, lattice: Lattice) -> Self {
        assert_eq!(lattice.nodes(), [shape.resolution; 3], "lattice of a grid of {}³ voxels", shape.resolution);
        let shape = shape.normalised();
        let harmonics = shape.is_reduced().then(|| {
            let holding = holding(&shape, &lattice);
            match shape.interpolation {
                Interpolation::Nearest => holding,
                Interpolation::Trilinear => dilated(&holding),
            }
        });
        Layout { shape, lattice, harmonics }
    }

    /// Returns the shapes of the tables: density, color and, if they are reduced, harmonics.
    pub fn tables(&self) -> Vec<[usize; 2]> {
        let rows = self.lattice.rows();
        let harmonics = self.harmonics.iter().map(|lattice| [lattice.rows(), self.shape.harmonics_width()]);
        [[rows, 1], [rows, self.shape.color_width()]].into_iter().chain(harmonics).collect()
    }

    /// Looks up density or color at voxel coordinates `[m, 3]`. Returns raw values `[m, width]`.
    pub fn look_up<T: Real>(&self, table: &Tensor<T>, voxels: &Tensor<T>) -> Tensor<T> {
        self.shape.interpolation.look_up(table, voxels, &self.lattice)
    }

    /// Returns all color numbers at voxel coordinates `[m, 3]`, `[m, channels]`. `color` is the look-up in the color table; reduced
    /// harmonics are appended to each channel.
    pub fn whole_colors<T: Real>(&self, color: Tensor<T>, harmonics: Option<&Tensor<T>>, voxels: &Tensor<T>) -> Tensor<T> {
        let (Some(table), Some(lattice)) = (harmonics, &self.harmonics) else { return color };
        let [scale, shift] = self.shape.to_harmonics();
        let read = self.shape.interpolation.look_up(table, &voxels.affine(scale, shift), lattice);
        let (m, count) = (color.shape()[0], self.shape.color.channels() / 3);
        let parts = [color.reshape(&[m, 3, 1]), read.reshape(&[m, 3, count - 1])];
        Tensor::concat(&parts.each_ref(), 2).reshape(&[m, 3 * count])
    }
}

/// Returns the lattice of the larger voxels that contain a voxel of `lattice`.
pub(super) fn holding(shape: &GridShape, lattice: &Lattice) -> Lattice {
    Lattice::bricks_where([shape.harmonics_resolution(); 3], |place| held(shape, place).any(|voxel| lattice.row(voxel).is_some()))
}

/// Returns the voxels of a grid inside a voxel of the harmonics.
pub(super) fn held(shape: &GridShape, place: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    let (n, f) = (shape.resolution, shape.sh_reduction);
    let [x, y, z] = place.map(|k| k * f..((k + 1) * f).min(n));
    x.flat_map(move |i| {
        let z = z.clone();
        y.clone().flat_map(move |j| z.clone().map(move |k| [i, j, k]))
    })
}

/// Returns a lattice extended by a layer of nodes around the present nodes.
pub(super) fn dilated(lattice: &Lattice) -> Lattice {
    let present = Occupancy::from_masks(Aabb::cube(1.0), lattice.nodes(), lattice.masks().to_vec());
    Lattice::from_masks(lattice.nodes(), present.dilated(1).masks().to_vec())
}
