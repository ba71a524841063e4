//! What rays see of each voxel: the largest weight, and the color.

use super::{BLOCK, Batch};
use crate::camera::Ray;
use crate::field::voxel_grid::{Color, VoxelGrid};
use crate::render::RenderOptions;
use autograd::{Real, parallel};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// What rays see of each row of a grid's tables.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// [`largest_weights`]
    pub weight: Vec<f32>,
    /// Σ w c(d) / Σ w over the samples that read the row, w being a sample's weight times the row's share of it and c(d) the color of the
    /// row alone into the ray's direction; black where no ray comes.
    pub color: Vec<[f32; 3]>,
}

/// For each row of the tables the largest weight wᵢ = Tᵢ (1 − exp(−σᵢδᵢ)) of the samples that read it, on any of the rays: how much of a
/// pixel its voxel is ever part of, 0 where no ray comes. Rays come in batches to bound the memory; svox2 prunes by it (`grid_weight_render`).
pub fn largest_weights<T: Real>(grid: &VoxelGrid<T>, batches: impl IntoIterator<Item = Vec<Ray>>, options: &RenderOptions<'_>) -> Vec<f32> {
    let largest = Largest::new(grid.lattice().rows());
    for_each_read(grid, batches, options, |row, weight, _, _| largest.raise(row, weight));
    largest.into_weights()
}

/// The largest weights, and the mean colors. Colors are added up as whole multiples of 2⁻²⁴, whose sum does not depend on the order, so that
/// the result has the same bits for any number of threads.
pub fn seen<T: Real>(grid: &VoxelGrid<T>, batches: impl IntoIterator<Item = Vec<Ray>>, options: &RenderOptions<'_>) -> Seen {
    const ONE: f64 = (1u64 << 24) as f64;
    /// A color is at most 1 on a screen. This only keeps sums over 2³¹ samples within 64 bits.
    const BRIGHTEST: f64 = 256.0;
    let rows = grid.lattice().rows();
    let largest = Largest::new(rows);
    let sums: Vec<[AtomicU64; 4]> = (0..rows).map(|_| Default::default()).collect();
    let (table, channels) = (grid.color.tensor().data(), grid.shape().color.channels());
    for_each_read(grid, batches, options, |row, weight, share, basis| {
        largest.raise(row, weight);
        let amount = (weight.as_f64() * share.as_f64() * ONE).round();
        let Some(sums) = sums.get(row as usize).filter(|_| amount > 0.0) else { return };
        let numbers = &table[row as usize * channels..][..channels];
        let color = |c: usize| match grid.shape().color {
            Color::Rgb => numbers[c].as_f64(),
            Color::Sh { offset, .. } => {
                let numbers = &numbers[c * basis.len()..][..basis.len()];
                offset + numbers.iter().zip(basis).map(|(&number, &y)| number * y).sum::<T>().as_f64()
            }
        };
        for (c, sum) in sums[..3].iter().enumerate() {
            sum.fetch_add((color(c).clamp(0.0, BRIGHTEST) * amount).round() as u64, Relaxed);
        }
        sums[3].fetch_add(amount as u64, Relaxed);
    });
    let mean = |sums: [AtomicU64; 4]| {
        let [r, g, b, weight] = sums.map(|sum| sum.into_inner() as f64);
        [r, g, b].map(|c| (c / weight.max(1.0)) as f32)
    };
    Seen { weight: largest.into_weights(), color: sums.into_iter().map(mean).collect() }
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

/// Calls `f(row, weight, share, basis)` for every row that a sample reads: the sample's weight, the row's share of the sample, and the
/// harmonics of the ray's direction.
fn for_each_read<T: Real>(
    grid: &VoxelGrid<T>,
    batches: impl IntoIterator<Item = Vec<Ray>>,
    options: &RenderOptions<'_>,
    f: impl Fn(u32, T, T, &[T]) + Sync,
) {
    for rays in batches {
        let batch = Batch::new(grid, &rays, options);
        let scene = batch.scene(grid, &rays, options);
        let count = batch.basis.shape()[1];
        parallel::map_chunks(rays.len(), BLOCK, |range| {
            let (block, corners) = scene.weights(range.start, range.len());
            for (ray, own) in range.zip(block.rays()) {
                let basis = &batch.basis.data()[ray * count..][..count];
                for i in own {
                    let weight = block.weight[i];
                    match &corners {
                        None => f(block.rows[i], weight, T::one(), basis),
                        Some(corners) => {
                            let (rows, shares) = corners.of(i);
                            let reads = rows.into_iter().zip(shares).filter(|(_, share)| *share > T::zero());
                            reads.for_each(|(row, share)| f(row, weight, share, basis));
                        }
                    }
                }
            }
        });
    }
}
