//! Conversion of colors: between RGB and harmonics, and between reductions of harmonics. Converted parameters have new identities, so
//! optimizer state is not carried over.

use super::layout::{Layout, held, holding};
use super::reshape::spread;
use super::{Color, GridShape, VoxelGrid};
use crate::field::sh;
use autograd::{Buffer, Real, Tensor, parallel};

impl<T: Real> VoxelGrid<T> {
    /// Returns the grid with another color representation and the same reduction of harmonics. Coefficients beyond the new degree are
    /// dropped. RGB colors become harmonics without view dependence. Harmonics become RGB colors by their mean over all directions.
    pub fn with_color(&self, color: Color) -> Self {
        // Offset and factor of the coefficient of degree 0.
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

    /// Returns the grid with harmonics of degree 1 and more stored for every `reduction`-th voxel along each axis; 1 stores all
    /// coefficients in every voxel.
    ///
    /// A smaller voxel gets the interpolated value at its centre. A larger voxel gets the mean Σ αᵥ cᵥ / Σ αᵥ of the voxels v inside it,
    /// where αᵥ is the fraction of light that a voxel absorbs ([`GridShape::alpha_of_density`]); a plain mean if no voxel absorbs light;
    /// and the mean of its neighbours if it contains no voxel.
    pub fn with_reduction(&self, reduction: usize) -> Self {
        let shape = GridShape { sh_reduction: reduction, ..*self.shape() }.normalised();
        if shape == *self.shape() {
            return self.with_density(self.density.tensor().detach());
        }
        let whole = self.with_all_numbers();
        if shape.is_reduced() { whole.reduced(shape) } else { whole }
    }

    /// Returns the grid with all coefficients in every voxel.
    fn with_all_numbers(&self) -> Self {
        /// Number of rows read at a time. It bounds the memory for their positions.
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

    /// Returns the grid in a reduced shape. All coefficients must be stored in every voxel before.
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

/// Resizes the rows of a table to `width` numbers, a third per channel. Leading numbers are kept, missing numbers are 0.
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
        let shape = GridShape::new(4, 1.0, Interpolation::Nearest, color);
        // In the first of 2³ larger voxels, two of eight voxels absorb light, one of them twice as much. In the others none does.
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
            // Voxels 42, 43, 46, 47, and the same plus 16.
            assert!((read([1, 1, 1])[i] - number(0, k) - 12.0 * 52.5).abs() < 1e-12);
        }
    }
}
