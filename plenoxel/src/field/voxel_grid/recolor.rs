//! The same field with another meaning of colors: other harmonics, or harmonics for larger or smaller voxels. Parameters get new identities,
//! so an optimizer starts afresh.

use super::layout::{Layout, held, holding};
use super::reshape::spread;
use super::{Color, GridShape, VoxelGrid};
use crate::field::sh;
use autograd::{Buffer, Real, Tensor, parallel};

impl<T: Real> VoxelGrid<T> {
    /// The same grid with colors of another kind, as far reduced as before. Harmonics that are left out are lost; colors that become harmonics
    /// look the same from everywhere; harmonics that become colors are seen as the mean over all directions.
    pub fn with_color(&self, color: Color) -> Self {
        // Offset and factor of the mean.
        let kind = |color: Color| match color {
            Color::Rgb => (0.0, 1.0),
            Color::Sh { offset, .. } => (offset, sh::Y0),
        };
        let ((offset, factor), (new_offset, new_factor)) = (kind(self.shape().color), kind(color));
        let layout = Layout { shape: GridShape { color, ..*self.shape() }.normalised(), ..self.layout().clone() };
        let width = layout.shape.color_width();
        let mut means = resized(self.color.tensor(), width);
        parallel::for_each_rows(&mut means, width, |_, chunk| {
            for channel in chunk.chunks_exact_mut(width / 3) {
                channel[0] = (channel[0] * T::lit(factor) + T::lit(offset - new_offset)) / T::lit(new_factor);
            }
        });
        let mut tables = vec![self.density.tensor().detach(), Tensor::from_buffer(means, &[self.lattice().rows(), width])];
        match (&self.harmonics, layout.shape.is_reduced()) {
            (Some(table), true) => {
                let width = layout.shape.harmonics_width();
                tables.push(Tensor::from_buffer(resized(table.tensor(), width), &[table.shape()[0], width]));
                Self::assembled(layout, tables)
            }
            _ => Self::assembled(Layout { harmonics: None, ..layout }, tables),
        }
    }

    /// The same grid with harmonics of degree 1 and more for every so many voxels along each axis; 1 for all in every voxel. A larger voxel has
    /// the mean of the voxels in it, or of the larger ones around it; a smaller one what is read at its centre.
    pub fn with_reduction(&self, reduction: usize) -> Self {
        let shape = GridShape { sh_reduction: reduction, ..*self.shape() }.normalised();
        if shape == *self.shape() {
            return self.with_density(self.density.tensor().detach());
        }
        let whole = self.with_all_numbers();
        if shape.is_reduced() { whole.reduced(shape) } else { whole }
    }

    /// The same grid with all coefficients in every voxel.
    fn with_all_numbers(&self) -> Self {
        /// Rows that are read at a time, which bounds the memory for their positions.
        const RUN: usize = 1 << 16;
        let rows: Vec<u32> = (0..self.lattice().rows() as u32).collect();
        let width = self.shape().color.channels();
        let mut values = Buffer::stale(rows.len() * width);
        for (rows, part) in rows.chunks(RUN).zip(values.chunks_mut(RUN * width)) {
            parallel::copy(self.numbers_of(rows).data(), part);
        }
        let shape = GridShape { sh_reduction: 1, ..*self.shape() };
        let color = Tensor::from_buffer(values, &[rows.len(), width]);
        Self::with_lattice(shape, self.lattice().clone(), self.density.tensor().detach(), color)
    }

    /// The same grid in a reduced shape, of one with all coefficients in every voxel.
    fn reduced(&self, shape: GridShape) -> Self {
        let layout = Layout::new(shape, self.lattice().clone());
        let (width, all) = (shape.harmonics_width(), self.color.tensor().data());
        let count = width / 3 + 1;
        let holding = holding(&shape, self.lattice());
        let mut means = Buffer::zeros(holding.rows() * width);
        parallel::for_each_rows(&mut means, width, |first, chunk| {
            for (r, mean) in chunk.chunks_exact_mut(width).enumerate() {
                let Some(place) = holding.node((first + r) as u32) else { continue };
                let mut voxels = 0.0;
                for row in held(&shape, place).filter_map(|voxel| self.lattice().row(voxel)) {
                    voxels += 1.0;
                    let own = &all[row as usize * 3 * count..][..3 * count];
                    for (mean, own) in mean.chunks_exact_mut(count - 1).zip(own.chunks_exact(count)) {
                        mean.iter_mut().zip(&own[1..]).for_each(|(mean, &own)| *mean += own);
                    }
                }
                mean.iter_mut().for_each(|mean| *mean /= T::lit(voxels));
            }
        });
        let means = Tensor::from_buffer(means, &[holding.rows(), width]);
        let harmonics = layout.harmonics.as_ref().map(|lattice| spread(&means, &holding, lattice));
        let color = Tensor::from_buffer(resized(self.color.tensor(), 3), &[self.lattice().rows(), 3]);
        Self::assembled(layout, [self.density.tensor().detach(), color].into_iter().chain(harmonics).collect())
    }
}

/// A table with so many numbers a row, a third for each channel: those that come first, and zeros behind them.
fn resized<T: Real>(table: &Tensor<T>, width: usize) -> Buffer<T> {
    let (old, old_width) = (table.data(), table.shape()[1]);
    let same = width.min(old_width) / 3;
    let mut values = Buffer::zeros(old.len() / old_width * width);
    parallel::for_each_rows(&mut values, width, |first, chunk| {
        for (new, old) in chunk.chunks_exact_mut(width / 3).zip(old[first * old_width..].chunks_exact(old_width / 3)) {
            new[..same].copy_from_slice(&old[..same]);
        }
    });
    values
}
