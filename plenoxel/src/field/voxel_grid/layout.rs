//! Which rows of the tables belong to which voxels, and how numbers are read there.

use super::shape::{GridShape, Interpolation};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use autograd::{Lattice, Real, Tensor};

/// A shape with the rows that its voxels have. Cloning copies pointers.
#[derive(Clone, Debug)]
pub(crate) struct Layout {
    /// Shape and meaning, normalised.
    pub shape: GridShape,
    /// Rows of density and color.
    pub lattice: Lattice,
    /// Rows of the harmonics, where they are reduced.
    pub harmonics: Option<Lattice>,
}

impl Layout {
    /// Harmonics are present in the larger voxels that hold a present voxel and, with trilinear look-up, in those around them: wherever a
    /// sample that reads a present voxel can read them, and at most one voxel further.
    ///
    /// Panics if the lattice is of another resolution.
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

    /// Shapes of the tables: density, color and, where they are reduced, harmonics.
    pub fn tables(&self) -> Vec<[usize; 2]> {
        let rows = self.lattice.rows();
        let harmonics = self.harmonics.iter().map(|lattice| [lattice.rows(), self.shape.harmonics_width()]);
        [[rows, 1], [rows, self.shape.color_width()]].into_iter().chain(harmonics).collect()
    }

    /// Density or color at voxel coordinates `[m, 3]`, as stored: `[m, width]`.
    pub fn look_up<T: Real>(&self, table: &Tensor<T>, voxels: &Tensor<T>) -> Tensor<T> {
        self.shape.interpolation.look_up(table, voxels, &self.lattice)
    }

    /// All numbers of the colors at voxel coordinates `[m, 3]`, `[m, channels]`, from what the color table has for them: as it is, or with the
    /// harmonics put behind the mean of each channel.
    pub fn whole_colors<T: Real>(&self, color: Tensor<T>, harmonics: Option<&Tensor<T>>, voxels: &Tensor<T>) -> Tensor<T> {
        let (Some(table), Some(lattice)) = (harmonics, &self.harmonics) else { return color };
        let [scale, shift] = self.shape.to_harmonics();
        let read = self.shape.interpolation.look_up(table, &voxels.affine(scale, shift), lattice);
        let (m, count) = (color.shape()[0], self.shape.color.channels() / 3);
        let parts = [color.reshape(&[m, 3, 1]), read.reshape(&[m, 3, count - 1])];
        Tensor::concat(&parts.each_ref(), 2).reshape(&[m, 3 * count])
    }
}

/// The voxels of the harmonics that hold a voxel of a lattice.
pub(super) fn holding(shape: &GridShape, lattice: &Lattice) -> Lattice {
    Lattice::bricks_where([shape.harmonics_resolution(); 3], |place| held(shape, place).any(|voxel| lattice.row(voxel).is_some()))
}

/// The voxels of a grid that a voxel of the harmonics holds.
pub(super) fn held(shape: &GridShape, place: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    let (n, f) = (shape.resolution, shape.sh_reduction);
    let [x, y, z] = place.map(|k| k * f..((k + 1) * f).min(n));
    x.flat_map(move |i| {
        let z = z.clone();
        y.clone().flat_map(move |j| z.clone().map(move |k| [i, j, k]))
    })
}

/// A lattice with a layer of nodes around those that are present.
pub(super) fn dilated(lattice: &Lattice) -> Lattice {
    let present = Occupancy::from_masks(Aabb::cube(1.0), lattice.nodes(), lattice.masks().to_vec());
    Lattice::from_masks(lattice.nodes(), present.dilated(1).masks().to_vec())
}
