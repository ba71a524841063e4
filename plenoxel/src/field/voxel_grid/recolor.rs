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

    /// The same grid with harmonics of degree 1 and more for every so many voxels along each axis; 1 for all in every voxel. A smaller voxel has
    /// what is read at its centre; a larger one the mean Σ αᵥ cᵥ / Σ αᵥ of the voxels v in it, αᵥ being the share of light that they absorb
    /// ([`GridShape::alpha_of_density`]), a plain mean if none absorbs any, or that of the larger ones around it if it holds none.
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
        let (width, all, density) = (shape.harmonics_width(), self.color.tensor().data(), self.density.tensor().data());
        let count = width / 3 + 1;
        let holding = holding(&shape, self.lattice());
        let mut means = Buffer::zeros(holding.rows() * width);
        parallel::for_each_rows(&mut means, width, |first, chunk| {
            for (r, mean) in chunk.chunks_exact_mut(width).enumerate() {
                let Some(place) = holding.node((first + r) as u32) else { continue };
                let rows = held(&shape, place).filter_map(|voxel| self.lattice().row(voxel));
                let rows: Vec<(usize, f64)> =
                    rows.map(|row| (row as usize, shape.alpha_of_density(density[row as usize].as_f64()))).collect();
                let total: f64 = rows.iter().map(|(_, alpha)| alpha).sum();
                for &(row, alpha) in &rows {
                    let weight = T::lit(if total > 0.0 { alpha / total } else { 1.0 / rows.len() as f64 });
                    let own = &all[row * 3 * count..][..3 * count];
                    for (mean, own) in mean.chunks_exact_mut(count - 1).zip(own.chunks_exact(count)) {
                        mean.iter_mut().zip(&own[1..]).for_each(|(mean, &own)| *mean += weight * own);
                    }
                }
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

#[cfg(test)]
mod tests {
    use super::super::Interpolation;
    use super::*;

    #[test]
    fn a_larger_voxel_has_the_harmonics_of_what_absorbs_light_in_it() {
        let color = Color::Sh { degree: 1, offset: 0.5 };
        let shape = GridShape { resolution: 4, half_width: 1.0, interpolation: Interpolation::Nearest, color, sh_reduction: 1 };
        // In the first of 2³ larger voxels two of eight absorb light, one of them twice the share; in the others none does.
        let density = |v: usize| match v {
            0 => shape.density_of_alpha(0.4),
            1 => shape.density_of_alpha(0.8),
            16 => -3.0,
            _ => 0.0,
        };
        let density = Tensor::from_vec((0..64).map(density).collect(), &[64, 1]);
        let number = |v: usize, k: usize| (v * 12 + k) as f64;
        let numbers = Tensor::from_vec((0..64 * 12).map(|i| number(i / 12, i % 12)).collect(), &[64, 12]);
        let reduced = VoxelGrid::<f64>::from_row_major(shape, &density, &numbers).with_reduction(2);
        let (table, lattice) = (reduced.harmonics.as_ref().unwrap(), reduced.harmonics_lattice().unwrap());
        let read = |place: [usize; 3]| &table.tensor().data()[9 * lattice.row(place).unwrap() as usize..][..9];
        for (i, k) in [1, 2, 3, 5, 6, 7, 9, 10, 11].into_iter().enumerate() {
            assert!((read([0, 0, 0])[i] - (number(0, k) + 2.0 * number(1, k)) / 3.0).abs() < 1e-12);
            // Voxels 42, 43, 46, 47 and those 16 further.
            assert!((read([1, 1, 1])[i] - number(0, k) - 12.0 * 52.5).abs() < 1e-12);
        }
    }
}
