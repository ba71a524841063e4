//! What rays see of each voxel: the largest weight, and the color.

use super::{BLOCK, Batch};
use crate::camera::Ray;
use crate::field::voxel_grid::{Color, VoxelGrid};
use crate::render::RenderOptions;
use autograd::{Real, parallel};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// What photographs show of each row of a grid's tables. Each sample on a ray counts by its weight w, times the share that the row has in it;
/// a is the alpha of the ray's pixel, how much of an object it shows. Numbers are 0 where no ray comes.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// The largest w a: how much of a pixel's object the row is ever part of.
    pub weight: Vec<f32>,
    /// Σ w a / Σ w: 1 for what stands in front of objects, 0 for what stands only where photographs show the background.
    pub object: Vec<f32>,
    /// Σ w a c(d) / Σ w a, c(d) being the color of the row alone into the ray's direction.
    pub color: Vec<[f32; 3]>,
}

/// For each row of the tables the largest weight wᵢ = Tᵢ (1 − exp(−σᵢδᵢ)) of the samples that read it, on any of the rays: how much of a
/// pixel its voxel is ever part of, 0 where no ray comes. Rays come in batches to bound the memory; svox2 prunes by it (`grid_weight_render`).
pub fn largest_weights<T: Real>(grid: &VoxelGrid<T>, batches: impl IntoIterator<Item = Vec<Ray>>, options: &RenderOptions<'_>) -> Vec<f32> {
    let largest = Largest::new(grid.lattice().rows());
    for rays in batches {
        for_each_read(grid, &rays, options, 0.0, |row, _, weight, _, _| largest.raise(row, weight));
    }
    largest.into_weights()
}

/// What rays with the alphas of their pixels see. Samples with a weight below 1 / 1024, a quarter of a step of 8 bits, are not counted. Sums
/// are of whole multiples of 2⁻²⁴ and so do not depend on their order: the result has the same bits for any number of threads.
pub fn seen<T: Real>(grid: &VoxelGrid<T>, batches: impl IntoIterator<Item = (Vec<Ray>, Vec<f32>)>, options: &RenderOptions<'_>) -> Seen {
    const LEAST: f64 = 1.0 / 1024.0;
    const ONE: f64 = (1u64 << 24) as f64;
    /// A color is at most 1 on a screen. This only keeps sums over 2³¹ samples within 64 bits.
    const BRIGHTEST: f64 = 256.0;
    let rows = grid.lattice().rows();
    let largest = Largest::new(rows);
    // Of w, of w a, and of w a c.
    let sums: Vec<[AtomicU64; 5]> = (0..rows).map(|_| Default::default()).collect();
    let (table, channels) = (grid.color.tensor().data(), grid.shape().color.channels());
    for (rays, alphas) in batches {
        for_each_read(grid, &rays, options, LEAST, |row, ray, weight, share, basis| {
            let Some(sums) = sums.get(row as usize) else { return };
            let add = |sum: usize, amount: f64| {
                sums[sum].fetch_add((amount * ONE + 0.5) as u64, Relaxed);
            };
            let amount = (weight * share).as_f64();
            add(0, amount);
            let alpha = f64::from(alphas[ray]);
            if alpha == 0.0 {
                return;
            }
            largest.raise(row, weight * T::lit(alpha));
            add(1, amount * alpha);
            let numbers = &table[row as usize * channels..][..channels];
            if let Color::Sh { offset, .. } = grid.shape().color {
                for c in 0..3 {
                    let numbers = numbers[c * basis.len()..].iter().zip(basis);
                    let color = offset + numbers.map(|(&number, &y)| number * y).sum::<T>().as_f64();
                    add(2 + c, amount * alpha * color.clamp(0.0, BRIGHTEST));
                }
            }
        });
    }
    let sums: Vec<[f64; 5]> = sums.into_iter().map(|sums| sums.map(|sum| sum.into_inner() as f64)).collect();
    let color = |row: usize| match grid.shape().color {
        Color::Rgb => [0, 1, 2].map(|c| if sums[row][1] > 0.0 { table[row * channels + c].as_f64() as f32 } else { 0.0 }),
        Color::Sh { .. } => [2, 3, 4].map(|c| (sums[row][c] / sums[row][1].max(1.0)) as f32),
    };
    Seen {
        weight: largest.into_weights(),
        object: sums.iter().map(|sums| (sums[1] / sums[0].max(1.0)) as f32).collect(),
        color: (0..rows).map(color).collect(),
    }
}

/// The largest weight of each row so far. Numbers that are not negative are in the order of their bits, and a maximum does not depend on the
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

/// Calls `f(row, ray, weight, share, basis)` for every row that a sample with a weight above `least` reads: the number of its ray, its weight,
/// the row's share of it, and the harmonics of the ray's direction.
fn for_each_read<T: Real>(
    grid: &VoxelGrid<T>,
    rays: &[Ray],
    options: &RenderOptions<'_>,
    least: f64,
    f: impl Fn(u32, usize, T, T, &[T]) + Sync,
) {
    let least = T::lit(least);
    let batch = Batch::new(grid, rays, options);
    let scene = batch.scene(grid, rays, options);
    let count = batch.basis.shape()[1];
    parallel::map_chunks(rays.len(), BLOCK, |range| {
        let (block, corners) = scene.weights(range.start, range.len());
        for (ray, own) in range.zip(block.rays()) {
            let basis = &batch.basis.data()[ray * count..][..count];
            for i in own.filter(|&i| block.weight[i] > least) {
                let weight = block.weight[i];
                match &corners {
                    None => f(block.rows[i], ray, weight, T::one(), basis),
                    Some(corners) => {
                        let (rows, shares) = corners.of(i);
                        let reads = rows.into_iter().zip(shares).filter(|(_, share)| *share > T::zero());
                        reads.for_each(|(row, share)| f(row, ray, weight, share, basis));
                    }
                }
            }
        }
    });
}
