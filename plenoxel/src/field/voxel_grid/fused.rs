//! Fused kernel: the pixels of [`composite()`] in one pass over a voxel grid, with a hand-written adjoint.
//!
//! *Forward.* Rays are processed in blocks of fixed size. Each block computes the positions of its samples, their densities, their weights,
//! and the colors of samples that can have a weight. If gradients are recorded, a few numbers per sample are kept.
//!
//! *Adjoint.* Each block computes dL/dσ and dL/dc of its samples, ray by ray from back to front, and sorts them by the table rows that they
//! read. The contributions are not summed yet. The optimizer requests one range of rows after another ([`RowSums`]), and the blocks add
//! their contributions in the order of the rays. A step therefore writes no gradient table, no two threads write to the same location, and
//! the sums are bit-identical for any number of threads.
//!
//! *Memory.* A batch of more than [`CHUNK`] rays keeps no samples. Its adjoint marches the rays again, one chunk after another, and sums
//! the rows of a chunk before it starts the next. A step therefore needs the memory of one chunk, and of the touched rows.

/// Evaluates an expression with the layout of a grid's tables as a `NodeMap`. It is compiled once for dense grids and once for sparse
/// grids.
macro_rules! with_bricks {
    ($lattice:expr, $map:ident => $body:expr) => {
        match ($lattice.full_brick_map(), $lattice.brick_map()) {
            (Some($map), _) => $body,
            (None, Some($map)) => $body,
            (None, None) => unreachable!("the tables of a voxel grid are in bricks"),
        }
    };
}

mod adjoint;
mod cell_bricks;
mod forward;
mod from_camera;
mod lookup;
mod pictures;
mod places;
mod reduced;
mod seen;
mod sorted;

use super::layout::Layout;
use super::{Color, VoxelGrid};
use crate::camera::{self, Ray};
use crate::field::{Field, sh};
use crate::render::along::{COLUMNS, column};
use crate::render::{self, RenderOptions, Rendered, composite};
use crate::sampling::{Jitter, Occupancy, RAYS_OF_PACKET, Samples};
use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Param, Real, RowSparse, RowSums, Tensor, no_grad, parallel};
use forward::{Block, Scene};
pub use pictures::PictureTables;
pub use seen::{Seen, largest_weights, seen};
use std::sync::{Arc, OnceLock};

/// Number of rays that one task renders and whose gradients it sorts: about ten thousand samples. `sorted::rays_of_block` may double it.
const BLOCK: usize = 4 * RAYS_OF_PACKET;

/// Number of rays whose samples are kept, or marched again, at a time. It bounds the memory of a step. A usual batch is an eighth of it.
pub const CHUNK: usize = 128 * BLOCK;

/// Binary logarithm of the rows in a bucket: 64 bricks, in a dense grid a cube of 16³ voxels.
const BUCKET_SHIFT: u32 = 12;

/// Data shared by all blocks of a batch.
#[derive(Debug)]
struct Batch<T: Real> {
    layout: Layout,
    background: [T; 3],
    /// `[n, 3]`; `[0, 3]` for pictures with colors from a camera.
    directions: Tensor<T>,
    /// Harmonics of each ray's direction. Pictures with colors from a camera do not need them.
    basis: OnceLock<Tensor<T>>,
}

/// Rendered batch, with the data that its adjoint needs.
#[derive(Debug)]
struct State<T: Real> {
    batch: Batch<T>,
    kept: Kept<T>,
}

/// Samples of a batch, or its rays if there are too many samples or no gradient is recorded. Pictures from tables keep nothing.
#[derive(Debug)]
enum Kept<T: Real> {
    Samples(Vec<Block<T>>),
    Rays(Box<Rays>),
    Nothing,
}

/// Data to march the rays of a batch again.
#[derive(Debug)]
struct Rays {
    rays: Vec<Ray>,
    options: RenderOptions<'static>,
    cells: Option<Occupancy>,
}

/// Rendered columns beyond the color of the pixels.
#[derive(Debug)]
struct Columns<T: Real> {
    /// `[n, COLUMNS]`
    pixels: Tensor<T>,
    state: Arc<State<T>>,
    /// Tables of the grid.
    tables: Vec<Tensor<T>>,
}

impl<T: Real> render::Columns<T> for Columns<T> {
    fn depth(&self) -> Tensor<T> {
        self.pixels.index_axis(1, column::DEPTH)
    }

    fn distortion(&self) -> Tensor<T> {
        self.pixels.index_axis(1, column::DISTORTION)
    }

    fn sparsity(&self) -> Tensor<T> {
        let n = self.pixels.shape()[0];
        let mut values = Vec::with_capacity(n);
        self.state.for_each_chunk(&self.tables, |blocks| values.extend(blocks.iter().flat_map(Block::sparsity)));
        Tensor::from_kernel(
            values.into(),
            &[n],
            &self.tables.iter().collect::<Vec<_>>(),
            Fused { state: self.state.clone(), output: Output::Sparsity },
        )
    }
}

impl<T: Real> Batch<T> {
    fn new(grid: &VoxelGrid<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Self {
        let background = options.background.map(|c| T::lit(f64::from(c)));
        Batch { layout: grid.layout().clone(), background, directions: camera::directions(rays), basis: OnceLock::new() }
    }

    /// Returns the harmonics of each ray's direction, `[n, (degree + 1)²]`; `[n, 0]` for RGB. The first call must not be in a parallel task: it is parallel itself.
    fn basis(&self) -> &Tensor<T> {
        self.basis.get_or_init(|| match self.layout.shape.color {
            Color::Rgb => Tensor::zeros(&[self.directions.shape()[0], 0]),
            Color::Sh { degree, .. } => no_grad(|| sh::basis(&self.directions, degree)),
        })
    }

    /// Returns the number of harmonics per channel in a row of the color table; 0 if a row holds an RGB color, or the coefficients of
    /// degree 0 of reduced harmonics.
    fn harmonics(&self) -> usize {
        let shape = &self.layout.shape;
        if shape.color == Color::Rgb || shape.is_reduced() { 0 } else { shape.color_width() / 3 }
    }

    /// Returns a color as it is shown: harmonics are clamped at 0.
    #[inline(always)]
    fn shown(&self, color: [T; 3]) -> [T; 3] {
        if self.layout.shape.color == Color::Rgb { color } else { color.map(|c| c.max(T::zero())) }
    }

    fn scene<'a>(&'a self, grid: &'a VoxelGrid<T>, rays: &'a [Ray], options: &'a RenderOptions<'a>) -> Scene<'a, T> {
        Scene::new(self, rays, options, options.occupancy.or(Field::<T>::reach(grid)), grid.params().map(Param::tensor))
    }
}

impl<T: Real> Scene<'_, T> {
    /// Renders rays from `first` on, one for each [`COLUMNS`] entries of `pixels`. Returns their blocks.
    fn render_all(&self, first: usize, pixels: &mut [T], keep: bool) -> Vec<Block<T>> {
        if keep && self.worth_sorting() {
            return self.render_sorted(first, pixels);
        }
        let parts: Vec<_> = pixels.chunks_mut(BLOCK * COLUMNS).collect();
        parallel::map_items(parts, |b, pixels| self.render(first + b * BLOCK, pixels, keep))
    }
}

/// Renders a batch of rays through a grid.
pub(super) fn render<T: Real>(grid: &VoxelGrid<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    render_with(grid, None, rays, options)
}

/// Renders a batch of straight rays for a picture, without recording a gradient, with tables of the same grid. The colors of 8-bit images are those of the other
/// renderer up to a step: see [`PictureTables`].
///
/// The samples are not kept: [`Rendered::sparsity`] of the result panics.
pub fn render_picture<T: Real>(grid: &VoxelGrid<T>, tables: &PictureTables<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    no_grad(|| render_with(grid, Some(tables), rays, options))
}

fn render_with<T: Real>(grid: &VoxelGrid<T>, picture: Option<&PictureTables<T>>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    let n = rays.len();
    let from_camera = picture.and_then(|tables| tables.colors_from_camera(grid, rays));
    let batch = Batch::new(grid, if from_camera.is_some() { &[] } else { rays }, options);
    let tables: Vec<&Tensor<T>> = grid.params().map(Param::tensor).collect();
    let keep = tables.iter().any(|t| t.is_tracked()) && autograd::is_recording() && n <= CHUNK;
    let mut pixels = Buffer::stale(n * COLUMNS);
    let packets = !keep && matches!(options.jitter, Jitter::None);
    if from_camera.is_none() {
        batch.basis();
    }
    let scene = Scene { packets, picture, from_camera, ..batch.scene(grid, rays, options) };
    let mut sample_count = 0;
    let mut blocks = Vec::new();
    // Pictures from tables keep no samples, but were 8 % slower in one chunk of all rays of a tile.
    for (chunk, pixels) in pixels.chunks_mut(CHUNK * COLUMNS).enumerate() {
        blocks = scene.render_all(chunk * CHUNK, pixels, keep);
        sample_count += blocks.iter().map(|block| block.looked_at).sum::<usize>();
    }
    let kept = if keep {
        Kept::Samples(blocks)
    } else if picture.is_some() {
        Kept::Nothing
    } else {
        let options = RenderOptions { occupancy: None, ..options.clone() };
        Kept::Rays(Box::new(Rays { rays: rays.to_vec(), options, cells: scene.cells.cloned() }))
    };
    let state = Arc::new(State { batch, kept });
    let pixels = Tensor::from_kernel(pixels, &[n, COLUMNS], &tables, Fused { state: state.clone(), output: Output::Pixels });
    Rendered::new(
        pixels.narrow(1, 0, 3),
        pixels.index_axis(1, column::OPACITY),
        pixels.index_axis(1, column::LOG_TRANSMITTANCE),
        sample_count,
        Columns { pixels, state, tables: tables.into_iter().cloned().collect() },
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

/// Kernel that maps the tables of a grid to columns.
#[derive(Debug)]
struct Fused<T: Real> {
    state: Arc<State<T>>,
    output: Output,
}

impl<T: Real> Kernel<T> for Fused<T> {
    fn name(&self) -> &'static str {
        "render_fused"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let rendered = self.state.composite(inputs);
        match self.output {
            Output::Sparsity => rendered.sparsity(),
            Output::Pixels => {
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
        }
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let later = matches!(self.state.kept, Kept::Samples(_));
        let batch = &self.state.batch;
        let tables: Vec<Tensor<T>> = (0..batch.layout.tables().len()).map(|input| call.input(input)).collect();
        self.state.for_each_chunk(&tables, |blocks| {
            let sums = Arc::new(adjoint::Sums::new(batch, blocks, call.cotangent(), self.output));
            let rows = |input: usize, sums: Arc<dyn RowSums<T>>| {
                let rows = RowSparse::deferred(tables[input].shape(), sums);
                if later { rows } else { rows.added_up() }
            };
            if call.needs(0) {
                out.rows(0, rows(0, Arc::new(adjoint::DensitySums(sums.clone()))));
            }
            if call.needs(1) {
                out.rows(1, rows(1, Arc::new(adjoint::ColorSums(sums))));
            }
            if let Some(lattice) = batch.layout.harmonics.as_ref().filter(|_| call.needs(2) && self.output == Output::Pixels) {
                out.rows(2, rows(2, reduced::sums(batch, lattice, blocks, call.cotangent())));
            }
        });
    }
}

impl<T: Real> State<T> {
    /// Calls `f` with the samples of each chunk of rays, in the order of the rays.
    fn for_each_chunk(&self, tables: &[Tensor<T>], mut f: impl FnMut(&[Block<T>])) {
        match &self.kept {
            Kept::Samples(blocks) => f(blocks),
            Kept::Rays(again) => {
                let Rays { rays, options, cells } = &**again;
                self.batch.basis();
                let scene = Scene::new(&self.batch, rays, options, cells.as_ref(), tables);
                for first in (0..rays.len()).step_by(CHUNK) {
                    let mut pixels = Buffer::stale(CHUNK.min(rays.len() - first) * COLUMNS);
                    f(&scene.render_all(first, &mut pixels, true));
                }
            }
            Kept::Nothing => panic!("a picture from tables keeps no samples: use `render` for their sparsity"),
        }
    }

    /// Computes the same pixels as a graph of small ops.
    fn composite(&self, tables: &[Tensor<T>]) -> Rendered<T> {
        let batch = &self.batch;
        let mut offsets = vec![0u32];
        let mut columns: [Vec<T>; 5] = Default::default();
        self.for_each_chunk(tables, |blocks| {
            for block in blocks {
                let [x, y, z] = &block.at;
                for own in block.rays() {
                    // Samples without density are left out: they include empty space and everything behind the stop of a ray.
                    for i in own.filter(|&i| block.density[i] >= T::zero()) {
                        columns.iter_mut().zip([x, y, z, &block.t, &block.delta]).for_each(|(to, from)| to.push(from[i]));
                    }
                    offsets.push(columns[0].len() as u32);
                }
            }
        });
        let offsets = Indices::from(offsets);
        let m = columns[0].len();
        let [x, y, z, t, delta] = columns.map(|values| Tensor::from_vec(values, &[m]));
        let voxels = Tensor::stack(&[&x, &y, &z], 1);
        let [density, color] = [0, 1].map(|table: usize| batch.layout.look_up(&tables[table], &voxels));
        let color = batch.layout.whole_colors(color, tables.get(2), &voxels);
        let radiance = batch.layout.shape.color.activate(&density, &color, &batch.directions, &offsets);
        // Positions in world coordinates are not needed any more.
        let samples = Samples { t, delta, positions: voxels, directions: batch.directions.clone(), offsets };
        composite(samples, radiance, &Tensor::from_vec(batch.background.to_vec(), &[3]))
    }
}
