//! Pictures of a voxel grid.

use super::config::Sampling;
use super::{render_grid, single};
use crate::camera::Ray;
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::{PictureTables, render_picture};
use crate::render::picture::TILE;
use crate::render::{Engine, RenderOptions, Rendered};
use crate::sampling::{Jitter, Occupancy};
use autograd::Real;
use autograd::single::{cast, cast_ref, is_single};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Transmittance below which rays of rendered images end, and the largest sum of the weights along a ray whose colors are those of other samples. Together they
/// change an 8-bit value by at most 0.26 of a step, without groups ([`Pictures::in_groups_of`]).
const STOP_BELOW: f64 = 5e-4;
/// Opacity of a sample that rendered images leave out.
const NEGLIGIBLE: f64 = 1e-6;
/// Number of rays that a viewer renders before it computes tables. The computation takes about as long as these rays.
const RAYS_BEFORE_TABLE: usize = 1 << 17;

/// Renderer of pictures of a grid, without jitter. It skips empty cells.
pub struct Pictures<T: Real> {
    sampling: Sampling,
    engine: Engine,
    background: [f32; 3],
    /// Weight of the samples of a ray that share a color.
    group: f64,
    matter: Occupancy,
    /// Rays rendered so far.
    rendered: AtomicUsize,
    tables: OnceLock<Option<PictureTables<T>>>,
}

impl<T: Real> Pictures<T> {
    /// Creates a renderer of a grid. The same grid must be given to [`render`](Self::render).
    pub fn new(grid: &VoxelGrid<T>, sampling: Sampling, engine: Engine, background: [f32; 3]) -> Self {
        Pictures { sampling, engine, background, group: 0.0, matter: grid.matter(), rendered: AtomicUsize::new(0), tables: OnceLock::new() }
    }

    /// Sets the weight of the samples of a ray that share a color ([`PictureTables::in_groups_of`]).
    pub fn in_groups_of(self, weight: f64) -> Self {
        Pictures { group: weight, ..self }
    }

    /// Renders rays of the world through the grid.
    pub fn render(&self, grid: &VoxelGrid<T>, rays: &[Ray]) -> Rendered<T> {
        let rays = &*grid.shape().coordinates.rays(rays);
        let options = RenderOptions {
            aabb: grid.aabb(),
            spacing: self.sampling.spacing(grid.shape()),
            jitter: Jitter::None,
            background: self.background,
            occupancy: Some(&self.matter),
            engine: self.engine,
            stop_below: STOP_BELOW,
        };
        // With groups, the first pixels must be those of the tables too.
        let many = self.rendered.fetch_add(rays.len(), Relaxed) >= RAYS_BEFORE_TABLE || self.group > 0.0;
        let tables = if many && self.engine == Engine::Fused { self.tables_of(grid) } else { None };
        match tables {
            Some(tables) => picture_of_grid(grid, tables, rays, &options),
            None => render_grid(grid, rays, &options),
        }
    }

    /// Returns the tables of the grid; `None` for nearest look-up.
    fn tables_of(&self, grid: &VoxelGrid<T>) -> Option<&PictureTables<T>> {
        let negligible = NEGLIGIBLE / self.sampling.longest(grid.shape());
        let compute = || {
            if const { is_single::<T>() } {
                cast(single::picture_tables(cast_ref(grid), negligible))
            } else {
                PictureTables::new(grid, negligible)
            }
            .map(|tables: PictureTables<T>| tables.in_groups_of(self.group))
        };
        self.tables.get_or_init(compute).as_ref()
    }
}

/// Returns the side of the tiles of pixels that are rendered at a time. The graph keeps all samples of a tile.
pub fn tile(engine: Engine) -> usize {
    match engine {
        Engine::Fused => PictureTables::<f32>::TILE,
        Engine::Graph => TILE,
    }
}

/// Renders rays of a picture through a grid.
fn picture_of_grid<T: Real>(grid: &VoxelGrid<T>, tables: &PictureTables<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    match const { is_single::<T>() } {
        true => cast(single::render_picture(cast_ref(grid), cast_ref(tables), rays, options)),
        false => render_picture(grid, tables, rays, options),
    }
}
