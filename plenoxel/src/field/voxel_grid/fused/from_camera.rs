//! Colors of a grid as they are seen from one place.
//!
//! All rays of a picture begin at its camera, so each row of harmonics is seen in one direction, that from the camera to its voxel. With the color
//! gᵢ = Σₖ Yₖ(dᵢ) rowᵢₖ of each row, a sample reads Σᵢ vᵢ gᵢ, three numbers a row, instead of Σₖ Yₖ(d) Σᵢ vᵢ rowᵢₖ. The weighted mean of the directions dᵢ is the
//! direction d of the sample up to second order in the angle of a voxel, so the two differ by that angle times the difference between the slopes of
//! neighbouring rows. RGB, harmonics of degree 0, and the means of reduced harmonics are the same from every place. All are in tables whose bricks share faces ([`NodeTable`]).

use super::cell_bricks::CellBricks;
use crate::camera::Ray;
use crate::field::node_table::{Cells, NodeTable, StoredBricks};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, GridSpace, VoxelGrid};
use autograd::lattice::{Lattice, TOGETHER};
use autograd::{Buffer, Real, Tensor, dispatched, no_grad, parallel};
use glam::DVec3;
use std::slice::ChunksExact;
use std::sync::{Arc, Mutex, PoisonError};

/// Least distance from a camera to the box of the grid, in sides of the voxels of harmonics.
const FAR: f64 = 32.0;
/// Least number of rays from a camera after which the colors of harmonics are computed.
const ENOUGH: usize = 1 << 14;
/// Rows whose colors take roughly as long as those along one ray, by a profile of 128³ voxels with harmonics of degree 2.
const ROWS_OF_RAY: usize = 64;
/// Rows that one task computes.
const ROWS: usize = 1024;

/// Colors of a grid from one place, as tables whose interpolated vectors add up to the color of a sample. The fourth number of a vector is 0.
#[derive(Debug)]
pub(super) struct Colors<T: Real> {
    /// Colors that are the same from every place, at the voxels.
    constant: Option<Arc<NodeTable<T, 4>>>,
    /// gᵢ at the voxels of harmonics, with the offset if they are not reduced.
    harmonics: Option<NodeTable<T, 4>>,
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
    shared: Option<Shared<T>>,
}

/// Parts of colors that do not depend on the place.
#[derive(Clone, Debug)]
struct Shared<T: Real> {
    constant: Option<Arc<NodeTable<T, 4>>>,
    /// Bricks of the table of harmonics.
    of_harmonics: Option<Arc<StoredBricks>>,
}

impl<T: Real> FromCamera<T> {
    pub fn none() -> Self {
        FromCamera(Mutex::new(Latest { origin: DVec3::NAN, rays: 0, colors: None, shared: None }))
    }

    /// Returns the colors as seen from the origin of the next rays. All samples must lie in `bricks`. `None` if a table has more than 2³² entries. With harmonics, also
    /// `None` if there were only few rays, if they have several origins, if the camera is near the grid, if the grid is not one of the world, or if there is one voxel of harmonics along an axis.
    pub fn of(&self, grid: &VoxelGrid<T>, bricks: &Arc<StoredBricks>, rays: &[Ray]) -> Option<Arc<Colors<T>>> {
        let harmonics = Harmonics::of(grid);
        let (origin, enough) = match &harmonics {
            Some(harmonics) => (harmonics.place_of(rays, grid)?, ENOUGH.max(harmonics.lattice.rows() / ROWS_OF_RAY)),
            // One table serves all places.
            None => (DVec3::ZERO, 0),
        };
        let mut latest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if latest.origin != origin {
            (latest.origin, latest.rays, latest.colors) = (origin, 0, None);
        }
        latest.rays += rays.len();
        if latest.colors.is_none() && latest.rays >= enough {
            if latest.shared.is_none() {
                latest.shared = Some(Shared::new(grid, harmonics.as_ref(), bricks)?);
            }
            let Shared { constant, of_harmonics } = latest.shared.clone()?;
            let harmonics = harmonics.zip(of_harmonics).map(|(harmonics, bricks)| harmonics.seen_from(origin, grid.shape(), bricks));
            latest.colors = Some(Arc::new(Colors { constant, harmonics }));
        }
        latest.colors.clone()
    }
}

impl<T: Real> Shared<T> {
    /// Computes the parts for samples in these bricks. `None` if a table has more than 2³² entries.
    fn new(grid: &VoxelGrid<T>, harmonics: Option<&Harmonics<'_, T>>, bricks: &Arc<StoredBricks>) -> Option<Self> {
        let constant = || Some(Arc::new(constant(grid, bricks)));
        Some(match harmonics {
            None => Shared { constant: constant(), of_harmonics: None },
            Some(harmonics) if harmonics.is_whole => Shared { constant: None, of_harmonics: Some(bricks.clone()) },
            Some(Harmonics { lattice, .. }) => {
                let stored = StoredBricks::new(lattice.nodes(), CellBricks::new(lattice).reading(lattice.masks()))?;
                Shared { constant: constant(), of_harmonics: Some(Arc::new(stored)) }
            }
        })
    }
}

/// Returns the table of the color table's RGB, or of offset + Y₀ c for harmonics c of degree 0, in these bricks.
fn constant<T: Real>(grid: &VoxelGrid<T>, bricks: &Arc<StoredBricks>) -> NodeTable<T, 4> {
    let (offset, factor) = match grid.shape().color {
        Color::Rgb => (T::zero(), T::one()),
        Color::Sh { offset, .. } => (T::lit(offset), T::lit(sh::Y0)),
    };
    let (table, of_cells) = (grid.color.tensor().data().as_chunks::<3>().0, CellBricks::new(grid.lattice()));
    let of_row = |row: usize| {
        let [r, g, b] = table[row].map(|x| offset + factor * x);
        [r, g, b, T::zero()]
    };
    let absent = [offset, offset, offset, T::zero()];
    NodeTable::new(bricks.clone(), absent, |brick, values| of_cells.fill(brick, absent, of_row, values))
}

/// Table of harmonics that depend on the direction: of whole colors, or of those without degree 0 if they are reduced.
struct Harmonics<'a, T: Real> {
    lattice: &'a Lattice,
    rows: &'a Tensor<T>,
    degree: usize,
    is_whole: bool,
    /// Color without harmonics.
    offset: T,
}

impl<'a, T: Real> Harmonics<'a, T> {
    /// Returns the table of a grid; `None` if its colors are the same from every place.
    fn of(grid: &'a VoxelGrid<T>) -> Option<Self> {
        let Color::Sh { degree: degree @ 1.., offset } = grid.shape().color else { return None };
        Some(match (&grid.layout().harmonics, &grid.harmonics) {
            (Some(lattice), Some(rows)) => Harmonics { lattice, rows: rows.tensor(), degree, is_whole: false, offset: T::zero() },
            _ => Harmonics { lattice: grid.lattice(), rows: grid.color.tensor(), degree, is_whole: true, offset: T::lit(offset) },
        })
    }

    /// Returns the origin of all rays, if it is far from the grid, which is one of the world.
    fn place_of(&self, rays: &[Ray], grid: &VoxelGrid<T>) -> Option<DVec3> {
        let (origin, aabb) = (rays.first()?.origin, grid.aabb());
        let side = grid.shape().voxel_side() * grid.shape().sh_reduction as f64;
        let is_far = origin.clamp(aabb.min, aabb.max).distance(origin) >= FAR * side;
        let is_far = is_far && grid.shape().coordinates == GridSpace::WORLD;
        let is_one = rays.iter().all(|ray| ray.origin == origin);
        (is_far && is_one && !self.lattice.nodes().contains(&1)).then_some(origin)
    }

    /// Computes the table of the colors as seen from `origin`, in these bricks.
    fn seen_from(&self, origin: DVec3, shape: &GridShape, bricks: Arc<StoredBricks>) -> NodeTable<T, 4> {
        let ([scale, shift], [of_harmonics, start]) = (shape.to_voxels(), shape.to_harmonics());
        // Voxel n of harmonics is at n step + first along each axis.
        let (step, first) = ((of_harmonics * scale).recip(), -(start / of_harmonics + shift) / scale);
        let from_camera = DVec3::splat(first) - origin;
        let colors = self.colors(|node| DVec3::from_array(node.map(|n| n as f64)) * step + from_camera);
        let (rows, of_cells) = (colors.as_chunks::<4>().0, CellBricks::new(self.lattice));
        let absent = [self.offset, self.offset, self.offset, T::zero()];
        NodeTable::new(bricks, absent, |brick, values| of_cells.fill(brick, absent, |row| rows[row], values))
    }

    /// Computes the colors of all rows as vectors of four numbers; `view` returns the vector from the camera to a node.
    fn colors(&self, view: impl Fn([usize; 3]) -> DVec3 + Sync) -> Buffer<T> {
        let width = self.rows.shape()[1];
        let (count, functions) = (width / 3, sh::count(self.degree));
        let mut colors = Buffer::stale(4 * self.lattice.rows());
        parallel::for_each_chunk(&mut colors, 4 * ROWS, |first, colors| {
            let (first, colors) = (first / 4, colors.as_chunks_mut::<4>().0);
            let mut directions = Vec::with_capacity(3 * colors.len());
            for row in first..first + colors.len() {
                // Rows of absent voxels are not read.
                let view = self.lattice.node(row as u32).map_or(DVec3::Z, &view);
                directions.extend((view * view.length_recip()).to_array().map(T::lit));
            }
            let basis = no_grad(|| sh::basis(&Tensor::from_vec(directions, &[colors.len(), 3]), self.degree));
            let (rows, basis) = (&self.rows.data()[first * width..], basis.data().chunks_exact(functions));
            match count {
                3 => colors_of_rows::<T, 3>(rows, basis, self.offset, colors),
                4 => colors_of_rows::<T, 4>(rows, basis, self.offset, colors),
                8 => colors_of_rows::<T, 8>(rows, basis, self.offset, colors),
                9 => colors_of_rows::<T, 9>(rows, basis, self.offset, colors),
                15 => colors_of_rows::<T, 15>(rows, basis, self.offset, colors),
                16 => colors_of_rows::<T, 16>(rows, basis, self.offset, colors),
                _ => unreachable!("{count} harmonics per channel"),
            }
        });
        colors
    }
}

dispatched! {
/// Computes the colors of rows of 3 × `N` coefficients from the last `N` functions of the basis in the direction of each row.
fn colors_of_rows<T: Real, const N: usize>(rows: &[T], basis: ChunksExact<'_, T>, offset: T, out: &mut [[T; 4]]) {
    let rows = rows.as_chunks::<N>().0.as_chunks::<3>().0;
    for ((out, row), basis) in out.iter_mut().zip(rows).zip(basis) {
        let basis: &[T; N] = basis.last_chunk().expect("as many functions as coefficients, or more");
        let mut color = [offset, offset, offset, T::zero()];
        for c in 0..3 {
            for k in 0..N {
                color[c] += row[c][k] * basis[k];
            }
        }
        *out = color;
    }
}
}

impl<T: Real> Colors<T> {
    /// Returns the colors at voxel coordinates, as vectors of four numbers.
    pub fn at(&self, at: [&[T]; 3], shape: &GridShape) -> Buffer<T> {
        let mut colors = Buffer::stale(4 * at[0].len());
        let (to_harmonics, out) = (shape.to_harmonics().map(T::lit), colors.as_chunks_mut::<4>().0);
        match parallel::fused() {
            true => look_up::<T, true>(self, at, to_harmonics, out),
            false => look_up::<T, false>(self, at, to_harmonics, out),
        }
        colors
    }
}

dispatched! {
/// Computes the colors of samples. All four numbers of a vector are written: with three, the compiler splits each operation into two.
fn look_up<T: Real, const FUSED: bool>(colors: &Colors<T>, at: [&[T]; 3], to_harmonics: [T; 2], out: &mut [[T; 4]]) {
    let mut own = [[T::zero(); TOGETHER]; 3];
    for (group, out) in out.chunks_mut(TOGETHER).enumerate() {
        for a in 0..3 {
            let at = &at[a][group * TOGETHER..];
            match at.first_chunk() {
                Some(whole) => own[a] = *whole,
                None => own[a][..at.len()].copy_from_slice(at),
            }
        }
        out.fill([T::zero(); 4]);
        if let Some(table) = &colors.constant {
            add_colors::<T, FUSED>(table, &own, [T::one(), T::zero()], out);
        }
        if let Some(table) = &colors.harmonics {
            add_colors::<T, FUSED>(table, &own, to_harmonics, out);
        }
    }
}
}

/// Adds the interpolated colors of a table at scale x + shift to those of samples at x.
#[inline(always)]
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn add_colors<T: Real, const FUSED: bool>(table: &NodeTable<T, 4>, at: &[[T; TOGETHER]; 3], [scale, shift]: [T; 2], out: &mut [[T; 4]]) {
    let mut own = [[T::zero(); TOGETHER]; 3];
    for a in 0..3 {
        for i in 0..TOGETHER {
            own[a][i] = at[a][i] * scale + shift;
        }
    }
    let cells = Cells::find(table.bricks(), own.each_ref());
    for (i, out) in out.iter_mut().enumerate() {
        let color = cells.vector::<FUSED>(table, i);
        for c in 0..4 {
            out[c] += color[c];
        }
    }
}
