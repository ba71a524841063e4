//! Harmonics of a grid as they are seen from one place.
//!
//! All rays of a picture begin at its camera, so each row of reduced harmonics is seen in one direction, that from the camera to its voxel. With the color
//! gᵢ = Σₖ Yₖ(dᵢ) rowᵢₖ of each row, a sample reads Σᵢ vᵢ gᵢ, three numbers a row, instead of Σₖ Yₖ(d) Σᵢ vᵢ rowᵢₖ. The weighted mean of the directions dᵢ is the
//! direction d of the sample up to second order in the angle of a voxel, so the two differ by that angle times the difference between the slopes of
//! neighbouring rows. The colors gᵢ and the means are in tables whose bricks share faces ([`NodeTable`]).

use super::cell_bricks::CellBricks;
use crate::camera::Ray;
use crate::field::node_table::{Cells, NodeTable, StoredBricks};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, VoxelGrid};
use autograd::lattice::TOGETHER;
use autograd::{Buffer, Real, dispatched, parallel};
use glam::DVec3;
use ndarray::Array2;
use std::sync::{Arc, Mutex, PoisonError};

/// Least distance from a camera to the box of the grid, in sides of the voxels of harmonics.
const FAR: f64 = 32.0;
/// Number of rays from a camera after which the colors are computed. It takes about as long as these rays.
const ENOUGH: usize = 1 << 14;
/// Rows that one task computes.
const ROWS: usize = 1024;

/// Colors of a grid from one place, as tables whose interpolated vectors add up to the color of a sample. The fourth number of a vector is 0.
#[derive(Debug)]
pub(super) struct Colors<T: Real> {
    /// offset + Y₀ mean at the voxels.
    means: Arc<NodeTable<T, 4>>,
    /// gᵢ at the voxels of harmonics.
    harmonics: NodeTable<T, 4>,
}

/// Colors from the place of the latest rays.
#[derive(Debug)]
pub(super) struct FromCamera<T: Real>(Mutex<Latest<T>>);

#[derive(Debug)]
struct Latest<T: Real> {
    origin: DVec3,
    /// Rays from there so far.
    rays: usize,
    colors: Option<Arc<Colors<T>>>,
    /// Parts that do not depend on the place: the means, and the bricks of the table of harmonics.
    shared: Option<(Arc<NodeTable<T, 4>>, Arc<StoredBricks>)>,
}

impl<T: Real> FromCamera<T> {
    pub fn none() -> Self {
        FromCamera(Mutex::new(Latest { origin: DVec3::NAN, rays: 0, colors: None, shared: None }))
    }

    /// Returns the colors as seen from the origin of the next rays. All samples must lie in `bricks`. `None` if the rays have several origins, if there were only
    /// few of them, if the camera is near the grid, or if harmonics are not reduced or have one voxel along an axis.
    pub fn of(&self, grid: &VoxelGrid<T>, bricks: &Arc<StoredBricks>, rays: &[Ray]) -> Option<Arc<Colors<T>>> {
        let lattice = grid.layout().harmonics.as_ref().filter(|lattice| !lattice.nodes().contains(&1))?;
        let origin = rays.first()?.origin;
        let side = grid.shape().voxel_side() * grid.shape().sh_reduction as f64;
        let aabb = grid.aabb();
        if rays.iter().any(|ray| ray.origin != origin) || origin.clamp(aabb.min, aabb.max).distance(origin) < FAR * side {
            return None;
        }
        let mut latest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if latest.origin != origin {
            (latest.origin, latest.rays, latest.colors) = (origin, 0, None);
        }
        latest.rays += rays.len();
        if latest.colors.is_none() && latest.rays >= ENOUGH {
            let of_cells = CellBricks::new(lattice);
            if latest.shared.is_none() {
                let stored = StoredBricks::new(lattice.nodes(), of_cells.reading(lattice.masks()))?;
                latest.shared = Some((Arc::new(means(grid, bricks)?), Arc::new(stored)));
            }
            let (means, stored) = latest.shared.clone()?;
            let rows = colors(grid, origin)?;
            let (rows, none) = (rows.as_chunks::<4>().0, [T::zero(); 4]);
            let harmonics = NodeTable::new(stored, none, |brick| of_cells.values(brick, none, |row| rows[row]));
            latest.colors = Some(Arc::new(Colors { means, harmonics }));
        }
        latest.colors.clone()
    }
}

/// Returns the table of the mean colors in these bricks.
fn means<T: Real>(grid: &VoxelGrid<T>, bricks: &Arc<StoredBricks>) -> Option<NodeTable<T, 4>> {
    let Color::Sh { offset, .. } = grid.shape().color else { return None };
    let (table, offset, of_cells) = (grid.color.tensor().data().as_chunks::<3>().0, T::lit(offset), CellBricks::new(grid.lattice()));
    let color = |mean: T| offset + T::lit(sh::Y0) * mean;
    let absent = [offset, offset, offset, T::zero()];
    let of_row = |row: usize| {
        let [r, g, b] = table[row].map(color);
        [r, g, b, T::zero()]
    };
    Some(NodeTable::new(bricks.clone(), absent, |brick| of_cells.values(brick, absent, of_row)))
}

/// Computes the colors of all rows of reduced harmonics, seen from `origin`, as vectors of four numbers.
fn colors<T: Real>(grid: &VoxelGrid<T>, origin: DVec3) -> Option<Buffer<T>> {
    let (lattice, table) = (grid.layout().harmonics.as_ref()?, grid.harmonics.as_ref()?.tensor());
    let Color::Sh { degree, .. } = grid.shape().color else { return None };
    let ([scale, shift], [of_harmonics, start]) = (grid.shape().to_voxels(), grid.shape().to_harmonics());
    let place = |node: [usize; 3]| DVec3::from_array(node.map(|n| ((n as f64 - start) / of_harmonics - shift) / scale));
    let width = table.shape()[1];
    let count = width / 3;
    let mut colors = Buffer::stale(4 * lattice.rows());
    parallel::for_each_chunk(&mut colors, 4 * ROWS, |first, colors| {
        let (first, colors) = (first / 4, colors.as_chunks_mut::<4>().0);
        // Rows of absent voxels are not read.
        let direction = |row: usize| lattice.node((first + row) as u32).map_or(DVec3::Z, |node| (place(node) - origin).normalize());
        let directions: Vec<T> = (0..colors.len()).flat_map(|row| direction(row).to_array().map(T::lit)).collect();
        let directions = Array2::from_shape_vec((colors.len(), 3), directions).expect("three numbers a row");
        let basis = sh::values(directions.view(), degree);
        let rows = table.data()[first * width..].chunks_exact(width);
        for ((color, row), basis) in colors.iter_mut().zip(rows).zip(basis.rows()) {
            color[3] = T::zero();
            for (color, row) in color.iter_mut().zip(row.chunks_exact(count)) {
                *color = row.iter().zip(basis.iter().skip(1)).map(|(&number, &y)| number * y).sum();
            }
        }
    });
    Some(colors)
}

impl<T: Real> Colors<T> {
    /// Returns the colors at voxel coordinates, three numbers each.
    pub fn at(&self, at: [&[T]; 3], shape: &GridShape) -> Buffer<T> {
        let mut colors = Buffer::stale(3 * at[0].len());
        let (to_harmonics, out) = (shape.to_harmonics().map(T::lit), colors.as_chunks_mut::<3>().0);
        match parallel::fused() {
            true => look_up::<T, true>(self, at, to_harmonics, out),
            false => look_up::<T, false>(self, at, to_harmonics, out),
        }
        colors
    }
}

dispatched! {
/// Computes the colors of samples.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn look_up<T: Real, const FUSED: bool>(colors: &Colors<T>, at: [&[T]; 3], [scale, shift]: [T; 2], out: &mut [[T; 3]]) {
    let mut own = [[T::zero(); TOGETHER]; 3];
    let mut of_harmonics = own;
    for (group, out) in out.chunks_mut(TOGETHER).enumerate() {
        for a in 0..3 {
            let at = &at[a][group * TOGETHER..];
            match at.first_chunk() {
                Some(whole) => own[a] = *whole,
                None => own[a][..at.len()].copy_from_slice(at),
            }
            for i in 0..TOGETHER {
                of_harmonics[a][i] = own[a][i] * scale + shift;
            }
        }
        let means = Cells::find(colors.means.bricks(), own.each_ref());
        let harmonics = Cells::find(colors.harmonics.bricks(), of_harmonics.each_ref());
        for (i, out) in out.iter_mut().enumerate() {
            let (mean, rest) = (means.vector::<FUSED>(&colors.means, i), harmonics.vector::<FUSED>(&colors.harmonics, i));
            for c in 0..3 {
                out[c] = mean[c] + rest[c];
            }
        }
    }
}
}
