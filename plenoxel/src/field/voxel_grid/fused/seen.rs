//! Visibility of voxels: largest rendering weight and mean color over rays.

use super::{BLOCK, Batch, reduced};
use crate::camera::Ray;
use crate::field::voxel_grid::{Color, VoxelGrid};
use crate::render::RenderOptions;
use autograd::{Real, Tensor, parallel};
use std::cell::LazyCell;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// Visibility and observed color of each row of a grid's tables.
///
/// Each sample on a ray counts with its rendering weight w times the interpolation weight of the row in the sample. a is the alpha of the
/// ray's pixel, the fraction of the pixel that an object covers. Values are 0 for rows that no ray reads.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// Largest w a: the largest share that the row has in the object of any pixel.
    pub weight: Vec<f32>,
    /// Σ w a / Σ w: 1 for voxels in front of objects, 0 for voxels that are seen only in front of background pixels.
    pub object: Vec<f32>,
    /// Σ w a c / Σ w a, where c is the color of the sample seen along the ray.
    pub color: Vec<[f32; 3]>,
}

/// Returns the largest rendering weight wᵢ = Tᵢ (1 − exp(−σᵢδᵢ)) over the samples that read each row of the tables, on any of the rays; 0
/// for rows that no ray reads. Rays come in batches to bound the memory. svox2 prunes by this value (`grid_weight_render`).
pub fn largest_weights<T: Real>(grid: &VoxelGrid<T>, batches: impl IntoIterator<Item = Vec<Ray>>, options: &RenderOptions<'_>) -> Vec<f32> {
    let largest = Largest::new(grid.lattice().rows());
    for rays in batches {
        for_each_sample(grid, &rays, options, 0.0, |sample| sample.own.iter().for_each(|(row, _)| largest.raise(row, sample.weight)));
    }
    largest.into_weights()
}

/// Returns what rays see of each row. `batches` contain rays and the alphas of their pixels. Samples with a weight below 1 / 1024, a
/// quarter of an 8-bit level, are not counted. Sums are integer multiples of 2⁻²⁴ and do not depend on their order: the result is
/// bit-identical for any number of threads.
pub fn seen<T: Real>(grid: &VoxelGrid<T>, batches: impl IntoIterator<Item = (Vec<Ray>, Vec<f32>)>, options: &RenderOptions<'_>) -> Seen {
    const LEAST: f64 = 1.0 / 1024.0;
    const ONE: f64 = (1u64 << 24) as f64;
    /// Largest color value that is counted. Displayed colors are at most 1; the bound keeps sums over 2³¹ samples within 64 bits.
    const BRIGHTEST: f64 = 256.0;
    let rows = grid.lattice().rows();
    let largest = Largest::new(rows);
    // Sums of w, of w a, and of w a c.
    let sums: Vec<[AtomicU64; 5]> = (0..rows).map(|_| Default::default()).collect();
    let add = |sum: &AtomicU64, amount: f64| sum.fetch_add((amount * ONE + 0.5) as u64, Relaxed);
    for (rays, alphas) in batches {
        for_each_sample(grid, &rays, options, LEAST, |sample| {
            let alpha = f64::from(alphas[sample.ray]);
            let color = if alpha > 0.0 { sample.color(grid) } else { [0.0; 3] };
            for (row, share) in sample.own.iter() {
                let Some(sums) = sums.get(row as usize) else { continue };
                let amount = (sample.weight * share).as_f64();
                add(&sums[0], amount);
                if alpha > 0.0 {
                    largest.raise(row, sample.weight * T::lit(alpha));
                    add(&sums[1], amount * alpha);
                    for (c, sum) in color.iter().zip(&sums[2..]) {
                        add(sum, amount * alpha * c.clamp(0.0, BRIGHTEST));
                    }
                }
            }
        });
    }
    let sums: Vec<[f64; 5]> = sums.into_iter().map(|sums| sums.map(|sum| sum.into_inner() as f64)).collect();
    Seen {
        weight: largest.into_weights(),
        object: sums.iter().map(|sums| (sums[1] / sums[0].max(1.0)) as f32).collect(),
        color: sums.iter().map(|sums| [2, 3, 4].map(|c| (sums[c] / sums[1].max(1.0)) as f32)).collect(),
    }
}

/// Largest weight of each row so far. Non-negative floating-point numbers are ordered like their bits, and a maximum does not depend on the
/// order of its terms.
struct Largest(Vec<AtomicU32>);

impl Largest {
    fn new(rows: usize) -> Self {
        Largest((0..rows).map(|_| AtomicU32::new(0)).collect())
    }

    #[inline(always)]
    fn raise<T: Real>(&self, row: u32, weight: T) {
        let bits = (weight.as_f64() as f32).to_bits();
        if let Some(largest) = self.0.get(row as usize).filter(|largest| largest.load(Relaxed) < bits) {
            largest.fetch_max(bits, Relaxed);
        }
    }

    fn into_weights(self) -> Vec<f32> {
        self.0.into_iter().map(|bits| f32::from_bits(bits.into_inner())).collect()
    }
}

/// Sample on a ray, with the table rows that it reads.
struct Sample<'a, T> {
    /// Number of the ray.
    ray: usize,
    weight: T,
    /// Rows of density and color.
    own: Reads<'a, T>,
    /// Rows of reduced harmonics with their weights, found on demand.
    reduced: &'a dyn Fn() -> Option<([u32; 8], [T; 8])>,
    /// Values of the reduced harmonics for the ray's direction.
    beyond: &'a [T],
}

/// Rows of a table with their interpolation weights.
struct Reads<'a, T> {
    rows: &'a [u32],
    shares: &'a [T],
    /// Values of the harmonics for the ray's direction that the coefficients in a row are multiplied by; empty for plain colors.
    basis: &'a [T],
}

impl<T: Real> Reads<'_, T> {
    /// Returns the rows with a weight above 0.
    fn iter(&self) -> impl Iterator<Item = (u32, T)> + '_ {
        self.rows.iter().copied().zip(self.shares.iter().copied()).filter(|(_, share)| *share > T::zero())
    }

    /// Returns the interpolated color of a table.
    fn color(&self, table: &Tensor<T>) -> [T; 3] {
        let (table, channels) = (table.data(), table.shape()[1]);
        let mut sum = [T::zero(); 3];
        for (row, share) in self.iter() {
            let Some(numbers) = table.get(row as usize * channels..(row as usize + 1) * channels) else { continue };
            for (sum, numbers) in sum.iter_mut().zip(numbers.chunks_exact(channels / 3)) {
                let own: T = match self.basis {
                    [] => numbers[0],
                    basis => numbers.iter().zip(basis).map(|(&number, &y)| number * y).sum(),
                };
                *sum += share * own;
            }
        }
        sum
    }
}

impl<T: Real> Sample<'_, T> {
    /// Returns the color of the sample seen along its ray.
    fn color(&self, grid: &VoxelGrid<T>) -> [f64; 3] {
        let mut sum = self.own.color(grid.color.tensor());
        if let (Some((rows, shares)), Some(table)) = ((self.reduced)(), &grid.harmonics) {
            let changing = Reads { rows: &rows, shares: &shares, basis: self.beyond }.color(table.tensor());
            sum.iter_mut().zip(changing).for_each(|(sum, c)| *sum += c);
        }
        let offset = if let Color::Sh { offset, .. } = grid.shape().color { offset } else { 0.0 };
        sum.map(|c| c.as_f64() + offset)
    }
}

/// Calls `f` for every sample with a weight above `least`.
fn for_each_sample<T: Real>(grid: &VoxelGrid<T>, rays: &[Ray], options: &RenderOptions<'_>, least: f64, f: impl Fn(Sample<'_, T>) + Sync) {
    // No sample weighs more than the transmittance before it.
    let options = &RenderOptions { stop_below: options.stop_below.max(least), ..options.clone() };
    let least = T::lit(least);
    let batch = Batch::new(grid, rays, options);
    let scene = batch.scene(grid, rays, options);
    let count = batch.basis().shape()[1];
    // Number of harmonics in a row of the color table; the following harmonics are reduced.
    let here = batch.harmonics().max(1).min(count);
    parallel::map_chunks(rays.len(), BLOCK, |range| {
        let block = scene.weights(range.start, range.len());
        let reads = LazyCell::new(|| reduced::reads(&batch, &block));
        for (ray, own) in range.zip(block.rays()) {
            let (basis, beyond) = batch.basis().data()[ray * count..][..count].split_at(here);
            for i in own.filter(|&i| block.weight[i] > least) {
                let weight = block.weight[i];
                let reduced = || reads.as_ref().map(|reads| reads(i));
                let sample = |own| f(Sample { ray, weight, own, reduced: &reduced, beyond });
                match &block.corners {
                    None => sample(Reads { rows: &block.rows[i..=i], shares: &[T::one()], basis }),
                    Some(corners) => {
                        let (rows, shares) = corners.of(i);
                        sample(Reads { rows: &rows, shares: &shares, basis });
                    }
                }
            }
        }
    });
}
