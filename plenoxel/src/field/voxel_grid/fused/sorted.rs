//! Colors of a batch, read in the order of the table's rows.
//!
//! The rays of a training batch are unrelated: taken ray by ray, nearly every sample waits for its rows to arrive from memory. Sorted by
//! bucket, samples of different rays find the rows of a bucket in the cache.

use super::forward::{Block, Scene};
use super::lookup;
use super::{BLOCK, BUCKET_SHIFT, COLUMNS};
use crate::field::voxel_grid::Interpolation;
use autograd::rows::Buckets;
use autograd::{Buffer, Real, parallel};

/// Number of tasks, each with a range of buckets. There are several per thread, so that a dense part of the scene does not delay the
/// others.
const TASKS: usize = 64;

/// Size of a color table, in bytes, from which sorting is faster; a smaller table stays in the caches. Debug builds sort earlier, for
/// tests.
const LARGE: usize = if cfg!(debug_assertions) { 64 << 10 } else { 64 << 20 };

/// Returns the number of rays of a block. Buckets have more samples of a larger block in a row, but each thread needs some blocks. Samples and sums have the same
/// order with blocks of any size, so the number of threads changes no bit.
fn rays_of_block(rays: usize) -> usize {
    if rays >= 4 * parallel::threads() * (2 * BLOCK) { 2 * BLOCK } else { BLOCK }
}

/// Samples of a block that need a color, sorted by the bucket of their lowest corner.
struct Order<T: Real> {
    buckets: Buckets,
    samples: Buffer<u32>,
    /// Position of each sample, in columns: a copy in this order.
    at: [Buffer<T>; 3],
    /// Number of the ray of each sample.
    rays: Buffer<u32>,
}

impl<T: Real> Order<T> {
    fn new(block: &Block<T>, buckets: usize) -> Self {
        let (seen, corners) = (block.seen(), block.trilinear());
        let bucket = |i: usize| (corners.of(i).0[0] >> BUCKET_SHIFT) as usize;
        let mut places = Buckets::count(buckets, (0..block.len()).filter(|&i| seen(i)).map(bucket));
        let total = places.total();
        let (mut samples, mut at, mut rays) = (Buffer::stale(total), [0, 1, 2].map(|_| Buffer::stale(total)), Buffer::stale(total));
        for (r, own) in block.rays().enumerate() {
            for i in own.filter(|&i| seen(i)) {
                let place = places.take(bucket(i));
                (samples[place], rays[place]) = (i as u32, (block.first + r) as u32);
                at.iter_mut().zip(&block.at).for_each(|(to, from)| to[place] = from[i]);
            }
        }
        Order { buckets: places.filled(), samples, at, rays }
    }
}

impl<T: Real> Scene<'_, T> {
    /// Returns true if sorting makes the colors of a training batch faster: each sample reads eight rows of harmonics from a table larger
    /// than the caches.
    pub fn worth_sorting(&self) -> bool {
        let shape = &self.batch.layout.shape;
        self.batch.harmonics() > 0 && shape.interpolation == Interpolation::Trilinear && size_of_val(self.tables[1]) >= LARGE
    }

    /// Renders rays from `first` on, one for each [`COLUMNS`] entries of `pixels`. Returns their blocks with everything that the adjoint
    /// needs.
    pub fn render_sorted(&self, first: usize, pixels: &mut [T]) -> Vec<Block<T>> {
        let buckets = self.batch.layout.lattice.rows().div_ceil(1 << BUCKET_SHIFT);
        let count = pixels.len() / COLUMNS;
        let rays = rays_of_block(count);
        let (blocks, orders): (Vec<_>, Vec<_>) = parallel::map_chunks(count, rays, |range| {
            let block = self.weights(first + range.start, range.len());
            let order = Order::new(&block, buckets);
            (block, order)
        })
        .into_iter()
        .unzip();
        let colors = self.colors_in_order(&orders, buckets);
        let parts = blocks.into_iter().zip(orders).zip(colors).zip(pixels.chunks_mut(rays * COLUMNS)).collect();
        parallel::map_items(parts, |_, (((mut block, order), sorted), pixels)| {
            block.color = Buffer::zeros(3 * block.len());
            let color = block.color.as_chunks_mut::<3>().0;
            order.samples.iter().zip(sorted.as_chunks::<3>().0).for_each(|(&i, &sorted)| color[i as usize] = sorted);
            self.sum(&block, pixels);
            block
        })
    }

    /// Returns the part of the color table with the rows of a bucket.
    fn rows_of_color(&self, bucket: usize) -> &[T] {
        let (table, numbers) = (self.tables[1], (3 * self.batch.harmonics()) << BUCKET_SHIFT);
        &table[bucket * numbers..table.len().min((bucket + 1) * numbers)]
    }

    /// Computes the colors of the samples of each order, one bucket after another for all blocks: a block alone has few samples in a bucket.
    fn colors_in_order(&self, orders: &[Order<T>], buckets: usize) -> Vec<Buffer<T>> {
        let directions = self.directions(0).expect("only harmonics are worth sorting");
        let per_task = buckets.div_ceil(TASKS).max(1);
        let of_task = |task: usize| task * per_task..((task + 1) * per_task).min(buckets);
        let mut colors: Vec<Buffer<T>> = orders.iter().map(|order| Buffer::stale(3 * order.samples.len())).collect();
        let mut tasks: Vec<Vec<&mut [T]>> = (0..buckets.div_ceil(per_task)).map(|_| Vec::with_capacity(orders.len())).collect();
        for (order, colors) in orders.iter().zip(&mut colors) {
            let lengths = (0..tasks.len()).map(|task| 3 * order.buckets.ranges(of_task(task)).len());
            tasks.iter_mut().zip(parallel::split_lengths(colors, lengths)).for_each(|(task, part)| task.push(part));
        }
        parallel::for_each_item(tasks, |task, mut parts| {
            let (mut at, mut rays, mut found) = ([0, 1, 2].map(|_| Buffer::stale(0)), Buffer::stale(0), Buffer::stale(0));
            for bucket in of_task(task) {
                let samples: usize = orders.iter().map(|order| order.buckets.range(bucket).len()).sum();
                if samples == 0 {
                    continue;
                }
                // From one look-up a row on, most of a bucket is read. Measured with 1.1 look-ups a row on average.
                if 8 * samples >= 1 << BUCKET_SHIFT {
                    parallel::load(self.rows_of_color(bucket));
                }
                // A power of two, so that the arrays of one task fit another.
                let room = samples.next_power_of_two();
                at.iter_mut().for_each(|at| at.grow(room));
                rays.grow(room);
                found.grow(3 * room);
                let mut start = 0;
                for order in orders {
                    let range = order.buckets.range(bucket);
                    let own = start..start + range.len();
                    at.iter_mut().zip(&order.at).for_each(|(to, from)| to[own.clone()].copy_from_slice(&from[range.clone()]));
                    start = own.end;
                    rays[own].copy_from_slice(&order.rays[range]);
                }
                let (at, rays) = (at.each_ref().map(|at| &at[..samples]), &rays[..samples]);
                with_bricks!(self.batch.layout.lattice, map => {
                    lookup::harmonics_of(self.tables[1], at, map, rays, directions, found[..3 * samples].as_chunks_mut().0);
                });
                let mut left = &found[..];
                for (order, part) in orders.iter().zip(&mut parts) {
                    let length = 3 * order.buckets.range(bucket).len();
                    let (own, others) = left.split_at(length);
                    let (out, later) = std::mem::take(part).split_at_mut(length);
                    out.copy_from_slice(own);
                    (left, *part) = (others, later);
                }
            }
        });
        colors
    }
}
