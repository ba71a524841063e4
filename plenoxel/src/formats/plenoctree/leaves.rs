//! The leaves of an octree that shows a grid, and their values.

use super::LEAST_DENSITY;
use crate::error::Result;
use crate::field::sh;
use crate::field::voxel_grid::{Color, Interpolation, VoxelGrid};
use crate::formats::logistic::Sphere;
use crate::formats::npz::half;
use crate::formats::svox2::OFFSET;
use crate::memory;
use autograd::{Buffer, Tensor, no_grad, parallel};
use half::f16;
use std::path::Path;

/// Samples of an interpolated grid in a leaf, along each axis.
const SAMPLES: usize = 2;
/// Voxels whose leaves are computed together.
const RUN: usize = 1 << 12;

/// Leaves in the order of their codes.
pub(super) struct Leaves {
    /// Places along the Morton curve: the bits of x, y and z in turn, in leaves of the root's finest level.
    pub codes: Vec<u64>,
    /// Color and density of each leaf, `width` numbers.
    pub values: Vec<f16>,
    /// Numbers of a leaf.
    pub width: usize,
}

/// A grid in an octree.
pub(super) struct Placed<'a> {
    pub grid: &'a VoxelGrid<f32>,
    /// Leaves per voxel along each axis, a power of two.
    pub subdivide: usize,
    /// Voxels between the lower corners of the root and of the grid, along each axis.
    pub before: usize,
    /// The scale of positions; densities are divided by it.
    pub scene_scale: f64,
}

/// Returns the place of a cell along the Morton curve.
pub(super) fn code([x, y, z]: [usize; 3]) -> u64 {
    (0..21).rev().fold(0, |code, bit| code << 3 | super::place(x >> bit, y >> bit, z >> bit) as u64)
}

/// Returns the cell of a place along the Morton curve.
fn cell(code: u64) -> [usize; 3] {
    [2, 1, 0].map(|axis| (0..21).fold(0, |k, bit| k | ((code >> (3 * bit + axis) & 1) as usize) << bit))
}

impl Placed<'_> {
    /// Computes the leaves with a density above [`LEAST_DENSITY`]. `path` names the grid in error messages.
    ///
    /// Errors: there is not enough memory.
    pub fn leaves(&self, path: &Path, progress: &dyn Fn(usize, usize)) -> Result<Leaves> {
        let shape = *self.grid.shape();
        let (degree, offset) = shape.color.harmonics();
        let (channel, sphere) = (sh::count(degree), Sphere::new(degree));
        let width = 3 * channel + 1;
        let density = self.grid.density.tensor().data();
        let present = match shape.interpolation {
            Interpolation::Nearest => self.grid.voxels_where(|row| density[row] > 0.0),
            Interpolation::Trilinear => self.grid.occupancy(0.0),
        };
        let n = shape.resolution;
        let mut voxels: Vec<u64> = Vec::new();
        for i in 0..n.pow(3) {
            let voxel = [i / (n * n), i / n % n, i % n];
            if present.contains(voxel) {
                voxels.push(code(voxel.map(|k| k + self.before)));
            }
        }
        voxels.sort_unstable();
        let each = self.subdivide.pow(3);
        // The values, the bytes of the file, and their compressed form.
        let bytes = voxels.len() * each * (size_of::<u64>() + 3 * width * size_of::<f16>());
        memory::check(path, &format!("an octree of up to {} leaves", voxels.len() * each), bytes as u64)?;
        let mut leaves = Leaves { codes: Vec::new(), values: Vec::new(), width };
        for (run, part) in voxels.chunks(RUN).enumerate() {
            let mut rows = no_grad(|| self.means(part, width));
            parallel::for_each_rows(&mut rows, width, |_, chunk| {
                let mut fitted = [0.0; sh::count(sh::MAX_DEGREE)];
                for row in chunk.chunks_exact_mut(width).filter(|row| row[width - 1] > LEAST_DENSITY) {
                    for own in row[..width - 1].chunks_exact_mut(channel) {
                        own[0] = match shape.color {
                            Color::Rgb => (own[0] - OFFSET as f32) / sh::Y0 as f32,
                            Color::Sh { .. } => own[0] + ((offset - OFFSET) / sh::Y0) as f32,
                        };
                        sphere.fit_logistic(own, &mut fitted[..channel]);
                        own.copy_from_slice(&fitted[..channel]);
                    }
                }
            });
            let all = part.iter().flat_map(|voxel| (0..each as u64).map(move |k| voxel * each as u64 + k));
            for (leaf, row) in all.zip(rows.chunks_exact(width)).filter(|(_, row)| row[width - 1] > LEAST_DENSITY) {
                leaves.codes.push(leaf);
                leaves.values.extend(row.iter().map(|value| half(*value)));
            }
            progress((run * RUN + part.len()).min(voxels.len()), voxels.len());
        }
        Ok(leaves)
    }

    /// Returns the values of all leaves of some voxels, `width` numbers for each: the means over samples of the density σ, and of the color
    /// numbers weighted by σ.
    fn means(&self, voxels: &[u64], width: usize) -> Buffer<f32> {
        let each = self.subdivide.pow(3);
        let samples = if self.grid.shape().interpolation == Interpolation::Nearest { 1 } else { SAMPLES };
        let count = samples.pow(3);
        let steps = (self.subdivide * samples) as f32;
        let mut positions = Buffer::stale(voxels.len() * each * count * 3);
        parallel::for_each_rows(&mut positions, 3 * count, |first, chunk| {
            for (r, leaf) in chunk.chunks_exact_mut(3 * count).enumerate() {
                let (voxel, inside) = (cell(voxels[(first + r) / each]), cell(((first + r) % each) as u64));
                for (k, position) in leaf.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                    let sample = [k / (samples * samples), k / samples % samples, k % samples];
                    *position = [0, 1, 2].map(|axis| {
                        let within = (inside[axis] * samples + sample[axis]) as f32 + 0.5;
                        (voxel[axis] - self.before) as f32 + within / steps - 0.5
                    });
                }
            }
        });
        let rows = positions.len() / 3;
        let (grid, layout) = (self.grid, self.grid.layout());
        let positions = Tensor::from_buffer(positions, &[rows, 3]);
        let [density, color] = [&grid.density, &grid.color].map(|table| layout.look_up(table.tensor(), &positions));
        let color = layout.whole_colors(color, grid.harmonics.as_ref().map(autograd::Param::tensor), &positions);
        let (density, color, numbers) = (density.data(), color.data(), width - 1);
        let mut means = Buffer::zeros(rows / count * width);
        parallel::for_each_rows(&mut means, width, |first, chunk| {
            for (r, mean) in chunk.chunks_exact_mut(width).enumerate() {
                let own = (first + r) * count..(first + r + 1) * count;
                let total: f32 = density[own.clone()].iter().map(|sigma| sigma.max(0.0)).sum();
                if total > 0.0 {
                    for sample in own {
                        let weight = density[sample].max(0.0) / total;
                        mean.iter_mut().zip(&color[sample * numbers..][..numbers]).for_each(|(mean, c)| *mean += weight * c);
                    }
                    mean[numbers] = total / (count as f32 * self.scene_scale as f32);
                }
            }
        });
        means
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_has_one_place_and_its_children_follow_each_other() {
        assert_eq!([[0, 0, 1], [0, 1, 0], [1, 0, 0], [1, 1, 1]].map(code), [1, 2, 4, 7]);
        for at in [[0, 0, 0], [5, 300, 1023], [2047, 1, 0]] {
            assert_eq!(cell(code(at)), at);
            assert_eq!(code(at.map(|k| 2 * k + 1)), 8 * code(at) + 7);
        }
    }
}
