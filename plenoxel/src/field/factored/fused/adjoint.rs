//! Cotangents of the parameters from cotangents of pixels.

use super::super::{PLANE_OF, gradient_share};
use super::forward::{Block, Tables};
use super::lookup::{self, BucketSums, Cotangents as OfProducts, Pairs, Places, PlaneOf, add_to_lines, first_rows};
use super::network::{OfNetwork, ROWS};
use super::positions::{self, OfRays};
use super::pruning::{self, prune};
use super::{Output, State};
use crate::random::Purpose;
use crate::render::along::{COLUMNS, sparsity_slope};
use autograd::rows::{Buckets, buckets_of};
use autograd::{Buffer, Real, RowSums, Tensor, parallel};
use std::sync::Arc;

/// Number of tables of planes and lines, which come before those of the network.
pub const PLANES_AND_LINES: usize = 12;
/// Number of tables: those, the matrix B, and weight and bias of the three layers. The tensors of tracked rays follow.
pub const TABLES: usize = PLANES_AND_LINES + 1 + 2 * 3;

/// Cotangents by the number of the input.
pub struct Cotangents<T: Real> {
    pub planes: Vec<(usize, Arc<dyn RowSums<T>>)>,
    pub dense: Vec<(usize, Buffer<T>)>,
}

/// Cotangents of one block.
#[derive(Debug)]
struct Part<T: Real> {
    /// Samples, with cotangents of their density features.
    density: Kept<T>,
    /// Groups, with cotangents of their products.
    products: Kept<T>,
}

/// Samples or groups that [`prune`] has kept.
#[derive(Debug)]
pub struct Kept<T: Real> {
    /// Numbers of the kept samples or groups in the block.
    pub numbers: Vec<u32>,
    /// Positions, in units of cells.
    at: [Buffer<T>; 3],
    /// ∂L/∂s of each sample, `[kept]`, or the cotangents of the products of each group, `[kept, 3 R]`.
    g: Buffer<T>,
    /// Places in these arrays, sorted by the rows of each plane that are read.
    sorted: [Sorted; 3],
}

impl<T: Real> Kept<T> {
    /// Takes the samples or groups with these numbers and positions, and their cotangents.
    fn new(numbers: Vec<u32>, at: [Buffer<T>; 3], g: Buffer<T>, of: Pairs<'_, T>) -> Self {
        let sorted = [0, 1, 2].map(|axis| Sorted::new(axis, slices(&at), of.nodes, bucket_shift(axis, of.nodes, of.width)));
        Kept { numbers, at, g, sorted }
    }

    pub fn at(&self) -> Places<'_, T> {
        slices(&self.at)
    }

    pub fn g(&self) -> OfProducts<'_, T> {
        if self.g.len() == self.numbers.len() { OfProducts::Shared(&self.g) } else { OfProducts::Each(&self.g) }
    }
}

/// Returns views of positions in columns.
fn slices<T: Real>(at: &[Buffer<T>; 3]) -> Places<'_, T> {
    at.each_ref().map(|at| &at[..])
}

/// Samples sorted by the bucket of rows that they read.
#[derive(Debug)]
struct Sorted {
    buckets: Buckets,
    samples: Buffer<u32>,
}

impl Sorted {
    fn new<T: Real>(axis: usize, at: [&[T]; 3], nodes: [usize; 3], shift: u32) -> Self {
        let mut rows = Buffer::stale(at[0].len());
        first_rows(axis, at, nodes, &mut rows);
        let (buckets, stride) = (plane_size(axis, nodes).div_ceil(1 << shift), nodes[PLANE_OF[axis][1]] as u32);
        let of = |i: usize| buckets_of([rows[i], rows[i] + 1, rows[i] + stride, rows[i] + stride + 1], shift);
        let mut places = Buckets::count(buckets, (0..rows.len()).flat_map(of));
        let mut samples = Buffer::stale(places.total());
        for i in 0..rows.len() {
            of(i).for_each(|bucket| samples[places.take(bucket)] = i as u32);
        }
        Sorted { buckets: places.filled(), samples }
    }
}

/// Returns the base-2 logarithm of the rows in a bucket: about a thirty-second of a plane, and not more than fits into a core's cache.
fn bucket_shift(axis: usize, nodes: [usize; 3], width: usize) -> u32 {
    const FLOATS: usize = 1 << 16;
    let rows = (plane_size(axis, nodes) / 32).min(FLOATS / width).max(64);
    rows.ilog2()
}

/// Returns the number of nodes of the plane that belongs to the line of an axis.
fn plane_size(axis: usize, nodes: [usize; 3]) -> usize {
    PLANE_OF[axis].map(|a| nodes[a]).iter().product()
}

/// Contributions of the kept samples or groups of a batch to one plane.
#[derive(Debug)]
struct PlaneSums<T: Real> {
    state: Arc<State<T>>,
    parts: Arc<Vec<Part<T>>>,
    /// The line along the axis. The sums must not hold the plane itself: the optimizer could not update it in place.
    line: Tensor<T>,
    axis: usize,
    of_density: bool,
}

impl<T: Real> PlaneSums<T> {
    fn width(&self) -> usize {
        let shape = &self.state.batch.shape;
        if self.of_density { shape.density_components } else { shape.appearance_components }
    }

    fn kept<'a>(&self, part: &'a Part<T>) -> &'a Kept<T> {
        if self.of_density { &part.density } else { &part.products }
    }
}

impl<T: Real> RowSums<T> for PlaneSums<T> {
    fn bucket_shift(&self) -> u32 {
        bucket_shift(self.axis, self.state.batch.nodes, self.width())
    }

    fn is_empty(&self, bucket: usize) -> bool {
        self.parts.iter().all(|part| self.kept(part).sorted[self.axis].buckets.range(bucket).is_empty())
    }

    fn add(&self, bucket: usize, sums: &mut [T], touched: &mut [u64]) {
        let plane = PlaneOf { axis: self.axis, line: self.line.data(), nodes: self.state.batch.nodes, width: self.width() };
        for kept in self.parts.iter().map(|part| self.kept(part)) {
            let sorted = &kept.sorted[self.axis];
            let which = &sorted.samples[sorted.buckets.range(bucket)];
            let (at, g) = (kept.at(), kept.g());
            let bucket = BucketSums { first: bucket << self.bucket_shift(), sums, touched };
            if parallel::fused() {
                lookup::add_to_plane::<T, true>(plane, at, which, g, bucket);
            } else {
                lookup::add_to_plane::<T, false>(plane, at, which, g, bucket);
            }
        }
    }
}

/// Computes the cotangents of the parameters `tables`.
pub fn cotangents<T: Real>(state: &Arc<State<T>>, tables: &[Tensor<T>], cotangent: &Tensor<T>, output: Output) -> Cotangents<T> {
    let of = Tables::new(&state.batch, tables);
    let parts = parallel::map_indices(state.blocks.len(), |b| part(state, &state.blocks[b], &of, cotangent, output));
    let nodes = state.batch.nodes;
    let (mut own, mut dense, mut rays) = (Vec::new(), Vec::new(), Vec::new());
    for (part, of_block, of_rays) in parts {
        own.push(part);
        dense.push(of_block);
        rays.extend(of_rays);
    }
    let sums = sum_in_order(dense);
    let mut dense = Vec::new();
    let mut sums = sums.into_iter();
    for first in [3, 9] {
        let all = sums.next().unwrap_or_default();
        let width = all.len() / nodes.iter().sum::<usize>().max(1);
        let mut rest = &all[..];
        for (axis, nodes) in nodes.into_iter().enumerate() {
            let (own, others) = rest.split_at(nodes * width);
            dense.push((first + axis, Buffer::copy_of(own)));
            rest = others;
        }
    }
    dense.extend((PLANES_AND_LINES..).zip(sums));
    if state.tracked.is_some() {
        dense.extend((TABLES..).zip(positions::joined(&rays)));
    }
    let parts = Arc::new(own);
    let planes =
        [(0, true), (6, false)].into_iter().flat_map(|(first, of_density)| (0..3).map(move |axis| (first + axis, axis, of_density)));
    let planes = planes.map(|(input, axis, of_density)| {
        let line = tables[input + 3].clone();
        let sums = PlaneSums { state: state.clone(), parts: parts.clone(), line, axis, of_density };
        (input, Arc::new(sums) as Arc<dyn RowSums<T>>)
    });
    Cotangents { planes: planes.collect(), dense }
}

/// Sums the arrays of the blocks, in the order of the blocks.
fn sum_in_order<T: Real>(blocks: Vec<Vec<Buffer<T>>>) -> Vec<Buffer<T>> {
    let Some(first) = blocks.first() else { return Vec::new() };
    let sum = |k: usize| {
        let mut total = Buffer::zeros(first[k].len());
        parallel::for_each_chunk(&mut total, 4096, |start, total| {
            for block in &blocks {
                let own = &block[k][start..start + total.len()];
                total.iter_mut().zip(own).for_each(|(sum, &x)| *sum += x);
            }
        });
        total
    };
    (0..first.len()).map(sum).collect()
}

/// Computes the cotangents of one block: those of its samples; those of the lines of density and appearance, the matrix and the layers; and those of its rays,
/// if they are tracked.
fn part<T: Real>(
    state: &State<T>,
    block: &Block<T>,
    tables: &Tables<'_, T>,
    cotangent: &Tensor<T>,
    output: Output,
) -> (Part<T>, Vec<Buffer<T>>, Option<OfRays<T>>) {
    let batch = &state.batch;
    let mut of_features = Buffer::stale(block.len());
    let mut rgb = Buffer::zeros(3 * block.groups.len());
    match output {
        Output::Sparsity => {
            for (own, &g) in block.rays().zip(&cotangent.data()[block.first..]) {
                own.for_each(|i| of_features[i] = g * sparsity_slope(block.sigma()[i]));
            }
        }
        Output::Pixels => {
            let (along, color) = (block.along(), block.color());
            let of_groups = rgb.as_chunks_mut::<3>().0;
            for (own, g) in block.rays().zip(&cotangent.data().as_chunks::<COLUMNS>().0[block.first..]) {
                along.sigma_adjoint(own.clone(), batch.background, g, &color, &mut of_features);
                for i in own {
                    let weight = along.weight[i] * gradient_share(along.t[i], batch.gradient_scaling);
                    block.groups.add_cotangent(of_groups, i, [0, 1, 2].map(|c| weight * g[c]));
                }
            }
        }
    }
    for ((g, &slope), &t) in of_features.iter_mut().zip(block.slope()).zip(block.t()) {
        *g *= slope * gradient_share(t, batch.gradient_scaling);
    }
    let random = |name| batch.jitter.stream(Purpose::GradientPruning, block.first).map(|stream| stream.numbered(output as u64).named(name));
    let samples = prune(&mut of_features, 1, batch.gradient_above, random("density"));
    let groups = prune(&mut rgb, 3, batch.gradient_above, random("color"));
    let of_samples = pruning::picked(&of_features, &samples);
    let samples_at = block.at().map(|at| pruning::picked(at, &samples));
    let groups_at = block.groups_at.each_ref().map(|at| pruning::picked(at, &groups));
    let density_lines = of_density_lines(tables.density, slices(&samples_at), &of_samples);
    let seen = (block.seen(&batch.encoded), state.tracked.is_some());
    let OfNetwork { products, encoded, lines, parameters } =
        tables.network.adjoint(&block.activations, &groups, (tables.appearance, slices(&groups_at)), seen, &rgb);
    let density = Kept::new(samples, samples_at, of_samples, tables.density);
    let products = Kept::new(groups, groups_at, products, tables.appearance);
    let rays = state.tracked.as_ref().map(|tracked| {
        let [of_origins, of_directions] = positions::of_rays(tracked, block, tables, [&density, &products]);
        [encoded, of_origins, of_directions]
    });
    (Part { density, products }, [density_lines, lines].into_iter().chain(parameters).collect(), rays)
}

/// Returns the cotangents of the three lines of the density, one after another.
fn of_density_lines<T: Real>(pairs: Pairs<'_, T>, at: Places<'_, T>, g: &[T]) -> Buffer<T> {
    let mut sums = pairs.zeros_of_lines();
    let mut of_planes = Buffer::stale(3 * pairs.width * ROWS.min(g.len()));
    for (part, g) in g.chunks(ROWS).enumerate() {
        let at = at.map(|at| &at[part * ROWS..][..g.len()]);
        let of_planes = &mut of_planes[..3 * pairs.width * g.len()];
        lookup::planes(pairs, at, of_planes);
        add_to_lines(pairs, at, of_planes, OfProducts::Shared(g), &mut sums);
    }
    sums
}
