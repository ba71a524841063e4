//! Fused kernel: the pixels of [`composite()`] in one pass over a factored field, with a hand-written adjoint.
//!
//! *Forward.* Rays are processed in blocks. Each block computes the densities of its samples and their weights, forms groups
//! ([`Grouping`]), and evaluates the color network at one position of each group, for all groups of the block together. Pictures read densities from a
//! table. If a block of their rays has many groups in few cells, the linear part of the network is computed at the nodes of these cells (`fused/nodes.rs`).
//!
//! *Adjoint.* Each block computes the cotangents of densities, of products, of its lines and of its network, and sorts its samples by the
//! rows of each plane that they read. The sums over the planes' rows are not computed yet: the optimizer requests one range of rows after
//! another ([`RowSums`](autograd::RowSums)), and the blocks add their contributions in the order of the rays. No two threads write to the same location, and
//! the sums are bit-identical for any number of threads. Small gradients can be pruned at random ([`Factored::gradient_above`]).
//!
//! *Tracked rays.* If gradients flow to the rays, each block also computes the cotangents of the positions of its kept samples and of encoded directions, and adds
//! them up for each ray.

mod adjoint;
mod densities;
mod forward;
mod lookup;
mod network;
mod nodes;
mod pictures;
mod positions;
mod pruning;

use super::{Factored, Shape};
use crate::camera::{self, Ray, TrackedRays};
use crate::field::grouping::{self, Grouping, Groups};
use crate::geometry::Aabb;
use crate::render::along::{COLUMNS, column};
use crate::render::{self, Field, Radiance, RenderOptions, Rendered, composite};
use crate::sampling::{Jitter, Samples, Spacing};
use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Precision, Real, RowSparse, Tensor, parallel};
pub use densities::{Densities, densities_at};
use forward::{Block, Scene, Tables};
use glam::DVec3;
pub use lookup::LANES;
use std::sync::Arc;

/// Returns true if the kernel computes fields of these sizes: if the numbers of components are multiples of [`LANES`].
pub fn supports(shape: &Shape) -> bool {
    [shape.density_components, shape.appearance_components].iter().all(|count| count % LANES == 0)
}

/// Returns the number of rays in a block, which depends on the size of the batch only.
fn block_of(rays: usize) -> usize {
    rays.div_ceil(16).clamp(16, 256)
}

/// Data of a batch that its blocks share.
#[derive(Debug)]
struct Batch<T: Real> {
    shape: Shape,
    nodes: [usize; 3],
    background: [T; 3],
    /// `[n, 3]`
    directions: Tensor<T>,
    /// Encoded directions, `[n, e]`.
    encoded: Tensor<T>,
    grouping: Grouping,
    gradient_above: f64,
    gradient_scaling: f64,
    precision: Precision,
    jitter: Jitter,
}

/// Rays to which gradients flow, and how positions become units of cells.
#[derive(Debug)]
struct Tracked {
    rays: Vec<Ray>,
    spacing: Spacing,
    aabb: Aabb,
    /// Cells per length along each axis.
    per_length: DVec3,
}

/// Rendered batch, with the data that its adjoint needs.
#[derive(Debug)]
struct State<T: Real> {
    batch: Batch<T>,
    /// `None` if no gradient flows to the rays.
    tracked: Option<Tracked>,
    /// Empty if no gradient is recorded.
    blocks: Vec<Block<T>>,
}

/// Rendered columns beyond the color of the pixels.
#[derive(Debug)]
struct Columns<T: Real> {
    /// `[n, COLUMNS]`
    pixels: Tensor<T>,
    /// Σ ln(1 + 2σᵢ²) of each ray.
    sparsity: Tensor<T>,
}

impl<T: Real> render::Columns<T> for Columns<T> {
    fn depth(&self) -> Tensor<T> {
        self.pixels.index_axis(1, column::DEPTH)
    }

    fn distortion(&self) -> Tensor<T> {
        self.pixels.index_axis(1, column::DISTORTION)
    }

    fn sparsity(&self) -> Tensor<T> {
        self.sparsity.clone()
    }
}

/// Renders a batch of rays through a field.
pub fn render<T: Real>(field: &Factored<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    render_inputs(field, rays, directions_of(field, rays), &[], (options, None))
}

/// Renders a batch of rays for a picture, without recording a gradient, with the densities of a table of the same field. Positions and distances are computed in the
/// precision of the field. The box of `options` must be that of the field. [`RenderOptions::occupancy`] is not used: the table has the cells that are reached.
/// [`Rendered::sparsity`] of the result is 0.
///
/// Panics with jitter.
pub fn render_picture<T: Real>(field: &Factored<T>, densities: &Densities<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    assert!(matches!(options.jitter, Jitter::None), "a picture has no jitter");
    autograd::no_grad(|| render_inputs(field, rays, directions_of(field, rays), &[], (options, Some(densities))))
}

/// Returns the directions of rays, `[n, 3]`, and their encodings, `[n, e]`.
fn directions_of<T: Real>(field: &Factored<T>, rays: &[Ray]) -> (Tensor<T>, Tensor<T>) {
    let directions = camera::directions(rays);
    let encoded = autograd::no_grad(|| field.shape.directions.encode(&directions));
    (directions, encoded)
}

/// Renders a batch of tracked rays through a field.
pub fn render_tracked<T: Real>(field: &Factored<T>, tracked: &TrackedRays<T>, options: &RenderOptions<'_>) -> Rendered<T> {
    let TrackedRays { rays, origins, directions } = tracked;
    let encoded = field.shape.directions.encode(directions);
    render_inputs(field, rays, (directions.detach(), encoded.detach()), &[&encoded, origins, directions], (options, None))
}

/// Renders a batch of rays with these directions and encoded directions. `of_rays` are the inputs of the kernel after the parameters of the field: nothing, or
/// encoded directions, origins and directions.
fn render_inputs<T: Real>(
    field: &Factored<T>,
    rays: &[Ray],
    (directions, encoded): (Tensor<T>, Tensor<T>),
    of_rays: &[&Tensor<T>],
    (options, densities): (&RenderOptions<'_>, Option<&Densities<T>>),
) -> Rendered<T> {
    let n = rays.len();
    let params = field.tables();
    let inputs: Vec<&Tensor<T>> = params.iter().chain(of_rays.iter().copied()).collect();
    let keep = inputs.iter().any(|input| input.is_tracked()) && autograd::is_recording();
    let background = options.background.map(|c| T::lit(f64::from(c)));
    let jitter = options.jitter;
    let grouping = if matches!(jitter, Jitter::None) { field.grouping_in_pictures } else { field.grouping };
    let batch = Batch {
        shape: field.shape,
        nodes: field.nodes(),
        background,
        directions,
        encoded,
        grouping,
        gradient_above: field.gradient_above,
        gradient_scaling: field.gradient_scaling,
        precision: field.color.precision,
        jitter,
    };
    let cells = options.occupancy.or(field.reach());
    let scene = Scene { batch: &batch, rays, options, cells, tables: Tables::new(&batch, &params), keep };
    let (mut pixels, mut sparsity) = (Buffer::stale(n * COLUMNS), Buffer::zeros(n));
    let size = match densities {
        Some(_) => pictures::BLOCK,
        None if keep => block_of(n),
        // Small blocks share the work of background and matter among the threads more evenly.
        None => block_of(n).div_ceil(4),
    };
    let parts: Vec<_> = pixels.chunks_mut(size * COLUMNS).zip(sparsity.chunks_mut(size)).collect();
    let blocks = parallel::map_items(parts, |b, (pixels, sparsity)| match densities {
        Some(densities) => (scene.show(densities, b * size, pixels), None),
        None => {
            let block = scene.render(b * size, pixels, sparsity);
            (block.len(), keep.then_some(block))
        }
    });
    let sample_count = blocks.iter().map(|(count, _)| count).sum();
    let tracked = (keep && !of_rays.is_empty()).then(|| Tracked {
        rays: rays.to_vec(),
        spacing: options.spacing,
        aabb: options.aabb,
        per_length: forward::cells_per_length(batch.nodes, &options.aabb),
    });
    let state = Arc::new(State { batch, tracked, blocks: blocks.into_iter().filter_map(|(_, block)| block).collect() });
    let kernel = |output| Fused { state: state.clone(), output };
    let pixels = Tensor::from_kernel(pixels, &[n, COLUMNS], &inputs, kernel(Output::Pixels));
    let sparsity = Tensor::from_kernel(sparsity, &[n], &inputs, kernel(Output::Sparsity));
    Rendered::new(
        pixels.narrow(1, 0, 3),
        pixels.index_axis(1, column::OPACITY),
        pixels.index_axis(1, column::LOG_TRANSMITTANCE),
        sample_count,
        Columns { pixels, sparsity },
    )
}

/// Columns that a kernel computes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Output {
    /// `[n, COLUMNS]`
    Pixels,
    /// `[n]`
    Sparsity,
}

/// Kernel that maps the parameters of a field, and the tensors of tracked rays, to columns.
#[derive(Debug)]
struct Fused<T: Real> {
    state: Arc<State<T>>,
    output: Output,
}

impl<T: Real> Kernel<T> for Fused<T> {
    fn name(&self) -> &'static str {
        "render_factored"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let rendered = self.state.composite(inputs);
        if self.output == Output::Sparsity {
            return rendered.sparsity();
        }
        let column = |x: Tensor<T>| x.unsqueeze(1);
        let columns = [
            rendered.rgb.clone(),
            column(rendered.depth()),
            column(rendered.opacity.clone()),
            column(rendered.log_transmittance.clone()),
            column(rendered.distortion()),
        ];
        Tensor::concat(&columns.iter().collect::<Vec<_>>(), 1)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let tables: Vec<Tensor<T>> = (0..adjoint::TABLES).map(|input| call.input(input)).collect();
        let adjoint::Cotangents { planes, dense } = adjoint::cotangents(&self.state, &tables, call.cotangent(), self.output);
        for (input, sums) in planes {
            out.rows(input, RowSparse::deferred(tables[input].shape(), sums));
        }
        for (input, values) in dense {
            out.dense(input, values);
        }
    }
}

impl<T: Real> State<T> {
    /// Computes the same pixels as a graph of small ops.
    fn composite(&self, inputs: &[Tensor<T>]) -> Rendered<T> {
        let batch = &self.batch;
        let (tables, of_rays) = inputs.split_at(adjoint::TABLES);
        let mut offsets = vec![0u32];
        let mut columns: [Vec<T>; 6] = Default::default();
        let (mut of, mut toward_next, mut sources, mut numbers) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for block in &self.blocks {
            let (first, before) = (columns[0].len() as u32, sources.len() as u32);
            let [x, y, z] = block.at();
            for (to, from) in columns.iter_mut().zip([x, y, z, block.t(), block.delta(), block.weight()]) {
                to.extend_from_slice(from);
            }
            offsets.extend(block.offsets[1..].iter().map(|offset| first + offset));
            of.extend(block.groups.of.iter().map(|&group| if group == grouping::NO_COLOR { group } else { before + group }));
            toward_next.extend_from_slice(&block.groups.toward_next);
            sources.extend(block.groups.sources.iter().map(|own| first + own.start..first + own.end));
            numbers.extend_from_slice(&block.groups.rays);
        }
        let groups = Groups { of: of.into(), toward_next: toward_next.into(), sources, rays: numbers };
        let offsets = Indices::from(offsets);
        let [x, y, z, t, delta, weights] = columns.map(|values| Tensor::from_vec(values, &[groups.of.len()]));
        let cells = Tensor::stack(&[&x, &y, &z], 1);
        // Positions in world coordinates are needed for tracked rays only.
        let samples = Samples { t, delta, positions: cells, directions: batch.directions.clone(), offsets };
        let (samples, encoded) = match (&self.tracked, of_rays) {
            (Some(tracked), [encoded, origins, directions]) => (tracked.cells(samples, [origins, directions], batch.nodes), encoded),
            _ => (samples, &batch.encoded),
        };
        let cells = samples.positions.clone();
        let directions = encoded.gather_rows(&Indices::from(groups.rays.clone()));
        let colors = super::colors(tables, batch.shape.feature_octaves, &groups.positions(weights.data(), &cells), &directions);
        let rgb = groups.colors_of_samples(&colors);
        let radiance = Radiance { sigma: super::density(tables, &cells), rgb };
        let radiance = super::with_scaled_gradients(radiance, &samples.t, batch.gradient_scaling);
        composite(samples, radiance, &Tensor::from_vec(batch.background.to_vec(), &[3]))
    }
}

impl Tracked {
    /// Returns samples whose positions, in units of cells, are functions of the origins and directions of the rays.
    fn cells<T: Real>(&self, samples: Samples<T>, [origins, directions]: [&Tensor<T>; 2], nodes: [usize; 3]) -> Samples<T> {
        let rays = TrackedRays { rays: self.rays.clone(), origins: origins.clone(), directions: directions.clone() };
        let samples = samples.tracking(&rays, self.spacing);
        let [low, per_length] = [self.aabb.min, self.per_length].map(|v| Tensor::from_vec(v.to_array().map(T::lit).to_vec(), &[3]));
        let most = Tensor::from_vec(nodes.map(|n| T::lit((n - 1) as f64)).to_vec(), &[3]);
        let cells = ((&samples.positions - low) * per_length).maximum(&Tensor::zeros(&[3])).minimum(&most);
        Samples { positions: cells, ..samples }
    }
}
