//! The same field in another grid: another resolution, other voxels, another meaning of colors. Parameters get new identities, so an optimizer
//! starts afresh.

use super::{Color, GridShape, Interpolation, VoxelGrid};
use crate::field::{neighbours, sh};
use crate::sampling::Occupancy;
use autograd::ops::trilinear::nearest_node;
use autograd::{Buffer, Lattice, Param, Real, Tensor, no_grad, parallel};

impl<T: Real> VoxelGrid<T> {
    /// The same field at another resolution: the old field read at the new centres, with the look-up that renders it. So a nearest grid
    /// of twice the resolution shows exactly what the old one showed; a trilinear one does inside the old cells, and is smoother within a
    /// quarter of an old voxel of the planes through old centres.
    /// A new voxel is present if it reads one that is.
    pub fn resample(&self, resolution: usize) -> Self {
        let shape = GridShape { resolution, ..self.shape };
        let ratio = self.shape.resolution as f64 / resolution as f64;
        let center = |k: usize| (k as f64 + 0.5) * ratio - 0.5;
        let lattice = match &self.reach {
            None => shape.full(),
            Some(_) => {
                let last = self.shape.resolution - 1;
                let corners = |k: usize| match self.shape.interpolation {
                    Interpolation::Nearest => {
                        let [nearest, ..] = nearest_node([T::lit(center(k)); 3], [last + 1; 3]);
                        nearest as usize..nearest as usize + 1
                    }
                    Interpolation::Trilinear => {
                        let low = center(k).clamp(0.0, last as f64) as usize;
                        low..(low + 2).min(last + 1)
                    }
                };
                Lattice::bricks_where([resolution; 3], |[i, j, k]| {
                    corners(i).any(|a| corners(j).any(|b| corners(k).any(|c| self.lattice.row([a, b, c]).is_some())))
                })
            }
        };
        let table = |old: &Param<T>| {
            let width = old.shape()[1];
            let mut values = Buffer::stale(lattice.rows() * width);
            // A run of rows at a time bounds the memory for positions.
            const RUN: usize = 1 << 16;
            for (run, part) in values.chunks_mut(RUN * width).enumerate() {
                let rows = part.len() / width;
                let mut at = Buffer::stale(rows * 3);
                parallel::for_each_chunk(&mut at, 3 * 4096, |first, chunk| {
                    for (r, p) in chunk.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                        let row = run * RUN + first / 3 + r;
                        *p = lattice.node(row as u32).map_or([T::zero(); 3], |node| node.map(|k| T::lit(center(k))));
                    }
                });
                let read = no_grad(|| self.look_up(old, &Tensor::from_buffer(at, &[rows, 3])));
                parallel::copy(read.data(), part);
            }
            Tensor::from_buffer(values, &[lattice.rows(), width])
        };
        let (density, color) = (table(&self.density), table(&self.color));
        Self::with_lattice(shape, lattice, density, color)
    }

    /// The same grid without the voxels outside of `kept`.
    ///
    /// Panics if `kept` has other cells than this grid has voxels.
    pub fn pruned(&self, kept: &Occupancy) -> Self {
        assert_eq!(kept.cells(), self.lattice.nodes(), "pruned: occupancy of another grid");
        let masks = kept.masks().iter().zip(self.lattice.masks()).map(|(kept, present)| kept & present).collect();
        self.in_lattice(Lattice::from_masks(self.lattice.nodes(), masks))
    }

    /// The same grid with a layer of voxels around those that are present: without density, and of the mean color of the voxels that they
    /// touch. So trilinear look-up at the border reads colors of the object and not of nothing.
    pub fn grown(&self) -> Self {
        let present = Occupancy::from_masks(self.aabb(), self.lattice.nodes(), self.lattice.masks().to_vec());
        let mut grown = self.in_lattice(Lattice::from_masks(self.lattice.nodes(), present.dilated(1).masks().to_vec()));
        let width = self.shape.color.channels();
        let mut colors = Buffer::copy_of(grown.color.tensor().data());
        parallel::for_each_rows(&mut colors, width, |first, chunk| {
            for (r, color) in chunk.chunks_exact_mut(width).enumerate() {
                if let Some(voxel) = grown.lattice.node((first + r) as u32).filter(|voxel| self.lattice.row(*voxel).is_none()) {
                    neighbours::average(&self.lattice, self.color.tensor().data(), voxel, color);
                }
            }
        });
        let shape = colors.len() / width;
        grown.color.replace(Tensor::from_buffer(colors, &[shape, width]));
        grown
    }

    /// The same grid with colors of another kind. Harmonics that are left out are lost; colors that become harmonics look the same from
    /// everywhere; harmonics that become colors are seen as the mean over all directions.
    pub fn with_color(&self, color: Color) -> Self {
        // Offset, factor of the mean, and numbers of a channel.
        let kind = |color: Color| match color {
            Color::Rgb => (0.0, 1.0, 1),
            Color::Sh { degree, offset } => (offset, sh::Y0, sh::count(degree)),
        };
        let ((offset, factor, count), (new_offset, new_factor, new_count)) = (kind(self.shape.color), kind(color));
        let (old, rows) = (self.color.tensor().data(), self.lattice.rows());
        let mut table = Buffer::zeros(rows * 3 * new_count);
        parallel::for_each_rows(&mut table, 3 * new_count, |first, chunk| {
            for (new, old) in chunk.chunks_exact_mut(new_count).zip(old[3 * count * first..].chunks_exact(count)) {
                let same = count.min(new_count);
                new[..same].copy_from_slice(&old[..same]);
                new[0] = (old[0] * T::lit(factor) + T::lit(offset - new_offset)) / T::lit(new_factor);
            }
        });
        let shape = GridShape { color, ..self.shape };
        Self::with_lattice(shape, self.lattice.clone(), self.density.tensor().detach(), Tensor::from_buffer(table, &[rows, 3 * new_count]))
    }

    /// The same numbers, looked up another way.
    pub fn with_interpolation(&self, interpolation: Interpolation) -> Self {
        let shape = GridShape { interpolation, ..self.shape };
        Self::with_lattice(shape, self.lattice.clone(), self.density.tensor().detach(), self.color.tensor().detach())
    }

    fn in_lattice(&self, lattice: Lattice) -> Self {
        let [density, color] = [&self.density, &self.color].map(|table| moved(table.tensor(), &self.lattice, &lattice));
        Self::with_lattice(self.shape, lattice, density, color)
    }
}

/// A table in another layout of the same grid, with zeros where the old one has no node.
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
