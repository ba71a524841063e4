//! Harmonics of a grid as they are seen from one place.
//!
//! All rays of a picture begin at its camera, so each row of reduced harmonics is seen in one direction, that from the camera to its voxel. With the color
//! gᵢ = Σₖ Yₖ(dᵢ) rowᵢₖ of each row, a sample reads Σᵢ vᵢ gᵢ, three numbers a row, instead of Σₖ Yₖ(d) Σᵢ vᵢ rowᵢₖ. The weighted mean of the directions dᵢ is the
//! direction d of the sample up to second order in the angle of a voxel, so the two differ by that angle times the difference between the slopes of
//! neighbouring rows.

use super::Batch;
use super::forward::{Block, Scene};
use super::lookup::{Corners, plain};
use super::reduced::found;
use crate::camera::Ray;
use crate::field::sh;
use crate::field::voxel_grid::{Color, VoxelGrid};
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

/// Colors of the rows of harmonics from one place. The fourth number is 0.
pub(super) type Colors<T> = Vec<[T; 4]>;

/// Colors from the place of the latest rays.
#[derive(Debug)]
pub(super) struct FromCamera<T>(Mutex<Latest<T>>);

#[derive(Debug)]
struct Latest<T> {
    origin: DVec3,
    /// Rays from there so far.
    rays: usize,
    colors: Option<Arc<Colors<T>>>,
}

impl<T: Real> FromCamera<T> {
    pub fn none() -> Self {
        FromCamera(Mutex::new(Latest { origin: DVec3::NAN, rays: 0, colors: None }))
    }

    /// Returns the colors as seen from the origin of the next rays. `None` if the rays have several origins, if there were only few of them, if the camera is
    /// near the grid, or if harmonics are not reduced.
    pub fn of(&self, grid: &VoxelGrid<T>, rays: &[Ray]) -> Option<Arc<Colors<T>>> {
        let origin = rays.first()?.origin;
        let side = grid.shape().voxel_side() * grid.shape().sh_reduction as f64;
        let aabb = grid.aabb();
        if rays.iter().any(|ray| ray.origin != origin) || origin.clamp(aabb.min, aabb.max).distance(origin) < FAR * side {
            return None;
        }
        let mut latest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if latest.origin != origin {
            *latest = Latest { origin, rays: 0, colors: None };
        }
        latest.rays += rays.len();
        if latest.colors.is_none() && latest.rays >= ENOUGH {
            latest.colors = colors(grid, origin).map(Arc::new);
        }
        latest.colors.clone()
    }
}

/// Computes the colors of all rows of reduced harmonics, seen from `origin`.
fn colors<T: Real>(grid: &VoxelGrid<T>, origin: DVec3) -> Option<Colors<T>> {
    let (lattice, table) = (grid.layout().harmonics.as_ref()?, grid.harmonics.as_ref()?.tensor());
    let Color::Sh { degree, .. } = grid.shape().color else { return None };
    let ([scale, shift], [of_harmonics, start]) = (grid.shape().to_voxels(), grid.shape().to_harmonics());
    let place = |node: [usize; 3]| DVec3::from_array(node.map(|n| ((n as f64 - start) / of_harmonics - shift) / scale));
    let width = table.shape()[1];
    let count = width / 3;
    let mut colors = vec![[T::zero(); 4]; lattice.rows()];
    parallel::for_each_chunk(&mut colors, ROWS, |first, colors| {
        // Rows of absent voxels are not read.
        let direction = |row: usize| lattice.node((first + row) as u32).map_or(DVec3::Z, |node| (place(node) - origin).normalize());
        let directions: Vec<T> = (0..colors.len()).flat_map(|row| direction(row).to_array().map(T::lit)).collect();
        let directions = Array2::from_shape_vec((colors.len(), 3), directions).expect("three numbers a row");
        let basis = sh::values(directions.view(), degree);
        let rows = table.data()[first * width..].chunks_exact(width);
        for ((color, row), basis) in colors.iter_mut().zip(rows).zip(basis.rows()) {
            for (color, row) in color.iter_mut().zip(row.chunks_exact(count)) {
                *color = row.iter().zip(basis.iter().skip(1)).map(|(&number, &y)| number * y).sum();
            }
        }
    });
    Some(colors)
}

impl<T: Real> Scene<'_, T> {
    /// Computes the colors of all samples from the colors of rows of harmonics.
    pub fn colors_from_camera(&self, rows: &Colors<T>, block: &mut Block<T>, corners: &Corners<T>) {
        let Batch { layout, .. } = self.batch;
        let (Some(lattice), Color::Sh { offset, .. }) = (&layout.harmonics, layout.shape.color) else {
            unreachable!("there are reduced harmonics")
        };
        let mut color = Buffer::stale(3 * block.len());
        let out = color.as_chunks_mut::<3>().0;
        plain(self.tables[1], |i| corners.of(i), |_| true, out);
        let of_harmonics = found::<T, Corners<T>, 8>(self.batch, lattice, block);
        add_seen(rows, |i| of_harmonics.of(i), T::lit(offset), out);
        block.color = color;
    }
}

dispatched! {
/// Makes mean coefficients colors: offset + Y₀ mean + Σ vᵢ gᵢ.
fn add_seen<T: Real>(rows: &[[T; 4]], look: impl Fn(usize) -> ([u32; 8], [T; 8]), offset: T, out: &mut [[T; 3]]) {
    for (i, color) in out.iter_mut().enumerate() {
        let (own, weights) = look(i);
        let mut sum = [T::zero(); 4];
        for k in 0..8 {
            let row = rows[own[k] as usize];
            for c in 0..4 {
                sum[c] += weights[k] * row[c];
            }
        }
        for c in 0..3 {
            color[c] = offset + T::lit(sh::Y0) * color[c] + sum[c];
        }
    }
}
}
