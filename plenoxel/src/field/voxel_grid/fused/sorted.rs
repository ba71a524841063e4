//! The colors of a batch, read in the order of the table's rows.
//!
//! The rays of a training batch have nothing to do with each other: taken ray by ray, nearly every sample waits for its rows to come from
//! memory. Sorted by the buckets that they lie in, samples of other rays find the rows of a bucket in the cache.

use super::forward::{Block, Scene};
use super::lookup::{self, Corners};
use super::{BLOCK, BUCKET_SHIFT, COLUMNS};
use crate::field::voxel_grid::Interpolation;
use autograd::rows::Buckets;
use autograd::{Buffer, Real, parallel};

/// Tasks, each with a range of buckets: some for every thread, so that a dense corner of the scene holds up no one.
const TASKS: usize = 64;

/// Bytes of a color table from which sorting pays: a smaller one stays in the caches as it is. Builds that the tests run in sort sooner.
const LARGE: usize = if cfg!(debug_assertions) { 64 << 10 } else { 64 << 20 };

/// The samples of a block that need a color, by the bucket of their lowest corner.
struct Order {
    buckets: Buckets,
    samples: Buffer<u32>,
    /// Number of the ray of each of them.
    rays: Buffer<u32>,
}

impl Order {
    fn new<T: Real>(block: &Block<T>, corners: &Corners<T>, buckets: usize) -> Self {
        let seen = block.seen();
        let bucket = |i: usize| (corners.of(i).0[0] >> BUCKET_SHIFT) as usize;
        let mut places = Buckets::count(buckets, (0..block.len()).filter(|&i| seen(i)).map(bucket));
        let (mut samples, mut rays) = (Buffer::stale(places.total()), Buffer::stale(places.total()));
        for (r, own) in block.rays().enumerate() {
            for i in own.filter(|&i| seen(i)) {
                let place = places.take(bucket(i));
                (samples[place], rays[place]) = (i as u32, (block.first + r) as u32);
            }
        }
        Order { buckets: places.filled(), samples, rays }
    }
}

impl<T: Real> Scene<'_, T> {
    /// True if the colors of a training batch are worth sorting: eight rows of harmonics for each sample, from a table beyond the caches.
    pub fn worth_sorting(&self) -> bool {
        let shape = &self.batch.layout.shape;
        self.batch.harmonics() > 0 && shape.interpolation == Interpolation::Trilinear && size_of_val(self.tables[1]) >= LARGE
    }

    /// The blocks of the rays from number `first` on, one ray for each [`COLUMNS`] of `pixels`, with all that the adjoint needs.
    pub fn render_sorted(&self, first: usize, pixels: &mut [T]) -> Vec<Block<T>> {
        let buckets = self.batch.layout.lattice.rows().div_ceil(1 << BUCKET_SHIFT);
        let count = pixels.len() / COLUMNS;
        let (blocks, orders): (Vec<_>, Vec<_>) = parallel::map_chunks(count, BLOCK, |range| {
            let (block, corners) = self.weights(first + range.start, range.len());
            let corners = corners.expect("trilinear look-up has corners");
            let order = Order::new(&block, &corners, buckets);
            (block, order)
        })
        .into_iter()
        .unzip();
        let colors = self.colors_in_order(&blocks, &orders, buckets);
        let parts = blocks.into_iter().zip(orders).zip(colors).zip(pixels.chunks_mut(BLOCK * COLUMNS)).collect();
        parallel::map_items(parts, |_, (((mut block, order), sorted), pixels)| {
            block.color = Buffer::zeros(3 * block.len());
            let color = block.color.as_chunks_mut::<3>().0;
            order.samples.iter().zip(sorted.as_chunks::<3>().0).for_each(|(&i, &sorted)| color[i as usize] = sorted);
            self.sum(&block, pixels);
            block
        })
    }

    /// The colors of the samples of each order.
    fn colors_in_order(&self, blocks: &[Block<T>], orders: &[Order], buckets: usize) -> Vec<Buffer<T>> {
        let directions = self.directions(0).expect("only harmonics are worth sorting");
        let per_task = buckets.div_ceil(TASKS).max(1);
        let of_task = |task: usize| task * per_task..((task + 1) * per_task).min(buckets);
        let mut colors: Vec<Buffer<T>> = orders.iter().map(|order| Buffer::stale(3 * order.samples.len())).collect();
        let mut tasks: Vec<Vec<&mut [T]>> = (0..buckets.div_ceil(per_task)).map(|_| Vec::with_capacity(blocks.len())).collect();
        for (order, colors) in orders.iter().zip(&mut colors) {
            let lengths = (0..tasks.len()).map(|task| 3 * order.buckets.ranges(of_task(task)).len());
            tasks.iter_mut().zip(parallel::split_lengths(colors, lengths)).for_each(|(task, part)| task.push(part));
        }
        parallel::for_each_item(tasks, |task, mut parts| {
            for bucket in of_task(task) {
                for ((block, order), part) in blocks.iter().zip(orders).zip(&mut parts) {
                    let range = order.buckets.range(bucket);
                    if range.is_empty() {
                        continue;
                    }
                    let (out, rest) = std::mem::take(part).split_at_mut(3 * range.len());
                    *part = rest;
                    let at = block.at.each_ref().map(|a| &a[..]);
                    let (samples, rays) = (&order.samples[range.clone()], &order.rays[range]);
                    with_bricks!(self.batch.layout.lattice, map => {
                        lookup::harmonics_of(self.tables[1], at, map, samples, rays, directions, out.as_chunks_mut().0);
                    });
                }
            }
        });
        colors
    }
}
