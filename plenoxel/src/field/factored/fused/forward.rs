//! Pixels of rays, one block of rays at a time.

use super::Batch;
use super::lookup::{self, Pairs, RUN};
use super::network::{Activations, Network, Seen};
use crate::camera::Ray;
use crate::field::grouping::Groups;
use crate::geometry::Aabb;
use crate::render::RenderOptions;
use crate::render::along::{self, Along, COLUMNS};
use crate::sampling::{Occupancy, march};
use autograd::{Buffer, Real, Tensor, parallel};
use glam::DVec3;
use std::ops::Range;

/// Columns of a sample.
mod of_sample {
    pub const T: usize = 3;
    pub const DELTA: usize = 4;
    pub const SIGMA: usize = 5;
    pub const SLOPE: usize = 6;
    pub const WEIGHT: usize = 7;
    pub const AFTER: usize = 8;
    /// Number of columns; positions are the first three.
    pub const COUNT: usize = 9;
}

/// Returns the number of cells per length along each axis of a box.
pub fn cells_per_length(nodes: [usize; 3], aabb: &Aabb) -> DVec3 {
    DVec3::from_array(nodes.map(|n| n as f64 - 1.0)) / (aabb.max - aabb.min)
}

/// Samples of a block of rays.
#[derive(Debug)]
pub struct Block<T: Real> {
    /// Number of the first ray.
    pub first: usize,
    /// Ray r of the block owns the samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<u32>,
    columns: [Buffer<T>; of_sample::COUNT],
    /// Groups that have colors.
    pub groups: Groups<T>,
    /// Positions of the groups, where the color network is evaluated.
    pub groups_at: [Buffer<T>; 3],
    /// Values of the color network.
    pub activations: Activations<T>,
}

impl<T: Real> Block<T> {
    fn new(first: usize, offsets: Vec<u32>, columns: [Buffer<T>; of_sample::COUNT]) -> Self {
        let groups_at = std::array::from_fn(|_| Buffer::stale(0));
        Block { first, offsets, columns, groups: Groups::empty(), groups_at, activations: Activations::default() }
    }

    /// Creates a block without densities and transmittances.
    pub fn of_weights(first: usize, offsets: Vec<u32>, at: [Buffer<T>; 3], weight: Buffer<T>, [t, delta]: [Buffer<T>; 2]) -> Self {
        let ([x, y, z], none) = (at, || Buffer::stale(0));
        Block::new(first, offsets, [x, y, z, t, delta, none(), none(), weight, none()])
    }

    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.offsets[self.offsets.len() - 1] as usize
    }

    /// Returns the samples of each ray.
    pub fn rays(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        self.offsets.windows(2).map(|o| o[0] as usize..o[1] as usize)
    }

    /// Returns the positions of the samples, in units of cells.
    pub fn at(&self) -> [&[T]; 3] {
        [0, 1, 2].map(|axis| &self.columns[axis][..self.len()])
    }

    /// Returns the distance of each sample from the origin of its ray.
    pub fn t(&self) -> &[T] {
        &self.columns[of_sample::T][..self.len()]
    }

    /// Returns the length of each interval.
    pub fn delta(&self) -> &[T] {
        &self.columns[of_sample::DELTA][..self.len()]
    }

    /// Returns the density σ of each sample.
    pub fn sigma(&self) -> &[T] {
        &self.columns[of_sample::SIGMA][..self.len()]
    }

    /// Returns dσ/ds of each sample.
    pub fn slope(&self) -> &[T] {
        &self.columns[of_sample::SLOPE][..self.len()]
    }

    /// Returns the weight of each sample.
    pub fn weight(&self) -> &[T] {
        &self.columns[of_sample::WEIGHT][..self.len()]
    }

    /// Returns the samples as rendering sees them.
    pub fn along(&self) -> Along<'_, T> {
        Along { t: self.t(), delta: self.delta(), weight: self.weight(), after: &self.columns[of_sample::AFTER][..self.len()] }
    }

    /// Returns the directions of the groups, from the encoded directions of all rays, `[n, e]`.
    pub fn seen<'a>(&'a self, encoded: &'a Tensor<T>) -> Seen<'a, T> {
        let (width, rays) = (encoded.shape()[1], self.first..self.first + self.offsets.len() - 1);
        Seen { rays: &self.groups.rays, first: self.first, encoded: &encoded.data()[rays.start * width..rays.end * width], width }
    }

    /// Returns the color of a sample.
    #[inline(always)]
    pub fn color(&self) -> impl Fn(usize) -> [T; 3] + '_ {
        let colors = self.activations.rgb.as_chunks::<3>().0;
        |i| self.groups.color(colors, i)
    }
}

/// Samples of a ray that are looked up together.
struct Run<T> {
    count: usize,
    /// Columns up to [`of_sample::DELTA`].
    columns: [[T; RUN]; of_sample::DELTA + 1],
}

impl<T: Real> Run<T> {
    fn empty() -> Self {
        Run { count: 0, columns: [[T::zero(); RUN]; of_sample::DELTA + 1] }
    }

    /// Returns the positions of the samples, in units of cells.
    fn at(&self) -> [&[T]; 3] {
        [0, 1, 2].map(|axis| &self.columns[axis][..self.count])
    }
}

/// Inputs of rendering a batch.
pub struct Scene<'a, T: Real> {
    pub batch: &'a Batch<T>,
    pub rays: &'a [Ray],
    pub options: &'a RenderOptions<'a>,
    /// Cells outside of which nothing is sampled; `None` for the whole box.
    pub cells: Option<&'a Occupancy>,
    pub tables: Tables<'a, T>,
    /// True if an adjoint follows, which reads the inputs of the layers.
    pub keep: bool,
}

/// Parameters of a field.
pub struct Tables<'a, T> {
    pub density: Pairs<'a, T>,
    pub appearance: Pairs<'a, T>,
    pub network: Network<'a, T>,
}

impl<'a, T: Real> Tables<'a, T> {
    pub fn new(batch: &Batch<T>, tables: &'a [Tensor<T>]) -> Self {
        Tables {
            density: Pairs::of(&tables[..6], batch.nodes, batch.shape.density_components),
            appearance: Pairs::of(&tables[6..12], batch.nodes, batch.shape.appearance_components),
            network: Network::new(&batch.shape, &tables[12..], batch.precision),
        }
    }
}

impl<'a, T: Real> Scene<'a, T> {
    /// Renders rays from `first` on, one for each entry of `sparsity`.
    pub fn render(&self, first: usize, pixels: &mut [T], sparsity: &mut [T]) -> Block<T> {
        let mut block = self.samples(first, sparsity.len());
        self.compute_colors(&mut block, false);
        let (along, color, sigma) = (block.along(), block.color(), block.sigma());
        for ((own, pixel), sparsity) in block.rays().zip(pixels.as_chunks_mut::<COLUMNS>().0).zip(sparsity) {
            *pixel = along.pixel(own.clone(), self.batch.background, |i| sigma[i], &color);
            *sparsity = sigma[own].iter().map(|&sigma| along::sparsity(sigma)).sum();
        }
        drop(color);
        block
    }

    /// Computes densities and weights of the samples of `count` rays from `first` on, in runs of at most [`RUN`]. While the densities of a run are looked up,
    /// the rows of the next one, of this ray or of the next, are prefetched.
    fn samples(&self, first: usize, count: usize) -> Block<T> {
        let stop = T::lit(self.options.stop_below);
        let mut columns: [Buffer<T>; of_sample::COUNT] = std::array::from_fn(|_| Buffer::stale(0));
        let mut offsets = vec![0];
        let mut end = 0;
        // Returns the function for the later runs of a ray, and its first run.
        let open = |r: usize| {
            let mut runs = self.runs(first + r);
            let run = runs();
            (runs, run)
        };
        // The next ray, if it is opened before this one ends.
        let mut opened = None;
        for r in 0..count {
            let (mut runs, mut run) = opened.take().unwrap_or_else(|| open(r));
            let mut left = T::one();
            while left >= stop && run.count > 0 {
                let following = if run.count == RUN { runs() } else { Run::empty() };
                if following.count == 0 && r + 1 < count {
                    opened = Some(open(r + 1));
                }
                let later = if following.count > 0 { &following } else { opened.as_ref().map_or(&following, |(_, run)| run) };
                if end + RUN > columns[0].len() {
                    let room = (2 * columns[0].len()).max(32 * count);
                    columns.iter_mut().for_each(|column| column.grow(room));
                }
                let own = end..end + run.count;
                columns.iter_mut().zip(&run.columns).for_each(|(column, values)| column[own.clone()].copy_from_slice(&values[..run.count]));
                let [.., delta, sigma, slope, weight, after] = &mut columns;
                let (sigma, slope) = (&mut sigma[own.clone()], &mut slope[own.clone()]);
                let (delta, weight, after) = (&delta[own.clone()], &mut weight[own.clone()], &mut after[own]);
                if parallel::fused() {
                    lookup::density::<T, true>(self.tables.density, run.at(), later.at(), sigma, slope);
                    lookup::absorb::<T, true>(sigma, delta, weight, after);
                } else {
                    lookup::density::<T, false>(self.tables.density, run.at(), later.at(), sigma, slope);
                    lookup::absorb::<T, false>(sigma, delta, weight, after);
                }
                let mut used = 0;
                while used < run.count && left >= stop {
                    weight[used] *= left;
                    left *= after[used];
                    after[used] = left;
                    used += 1;
                }
                end += used;
                run = following;
            }
            offsets.push(end as u32);
        }
        columns.iter_mut().for_each(|column| column.truncate(end));
        Block::new(first, offsets, columns)
    }

    /// Returns a function that returns the next run of ray r at each call, and an empty one after the last.
    fn runs(&self, r: usize) -> impl FnMut() -> Run<T> {
        let RenderOptions { aabb, spacing, jitter, .. } = self.options;
        let (ray, most) = (&self.rays[r], DVec3::from_array(self.batch.nodes.map(|n| n as f64 - 1.0)));
        let per_length = cells_per_length(self.batch.nodes, aabb);
        let march = march(ray, aabb, *spacing, jitter.of(r));
        let mut occupied = self.cells.map(|cells| march.occupied(ray, cells));
        let mut all = (0..march.count).map(move |k| march.interval(k));
        let (start, along) = ((ray.origin - aabb.min) * per_length, ray.direction * per_length);
        move || {
            let mut run = Run::empty();
            while run.count < RUN
                && let Some((middle, length)) = occupied.as_mut().map_or_else(|| all.next(), Iterator::next)
            {
                let place = if march.is_straight() { start + middle * along } else { (march.at(ray, middle) - aabb.min) * per_length };
                let place = place.clamp(DVec3::ZERO, most);
                for (column, value) in run.columns.iter_mut().zip([place.x, place.y, place.z, middle, length]) {
                    column[run.count] = T::lit(value);
                }
                run.count += 1;
            }
            run
        }
    }

    /// Computes the colors of samples, from their weights; the linear part of the color network at the nodes around the groups if `by_nodes`.
    pub fn compute_colors(&self, block: &mut Block<T>, by_nodes: bool) {
        self.form_groups(block);
        let (network, pairs) = (&self.tables.network, self.tables.appearance);
        let at = block.groups_at.each_ref().map(|at| &at[..]);
        let seen = block.seen(&self.batch.encoded);
        block.activations = if by_nodes { network.forward_by_nodes(pairs, at, seen) } else { network.forward(pairs, at, self.keep, seen) };
    }

    /// Forms the groups of each ray and computes their positions.
    fn form_groups(&self, block: &mut Block<T>) {
        let groups = self.batch.grouping.groups(block.weight(), [block.t(), block.delta()], &block.offsets, block.first, self.batch.jitter);
        let mut means = [0, 1, 2].map(|_| Buffer::zeros(groups.len()));
        let at = block.at();
        for (group, sample, share) in groups.shares(block.weight()) {
            (0..3).for_each(|axis| means[axis][group] += share * at[axis][sample]);
        }
        (block.groups, block.groups_at) = (groups, means);
    }
}
