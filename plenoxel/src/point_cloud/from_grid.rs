//! Point clouds of the voxels of a grid.
//!
//! A point is the centre of a voxel. Its opacity is the fraction of light that a voxel absorbs from face to face
//! ([`crate::field::voxel_grid::GridShape::alpha_of_density`]), its normal is [`VoxelGrid::outward`], and its color is given by
//! [`ColorFrom`].

use super::{PointCloud, ScalarField};
use crate::export::{in_bytes, near_colors};
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::Seen;
use autograd::{Real, parallel};
use glam::DVec3;

/// Default of [`VoxelOptions::min_alpha`] for point clouds. This and the following were chosen by inspecting clouds of lego, of the presets `fast` and `paper`. The
/// alpha is lower than in other exports, because the training views select voxels as well, and because no voxel of a short run, such as one of the preset
/// `paper`, has an alpha of 0.3.
pub const LEAST_ALPHA: f64 = 0.05;
/// Default of [`Visible::min_weight`].
pub const LEAST_WEIGHT: f64 = 0.05;
/// Default of [`Visible::min_object`].
pub const LEAST_OBJECT: f64 = 0.7;

/// Frame of the points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coordinates {
    /// World of the run: voxel k has its centre at (k + ½) · side − half width.
    World,
    /// Voxel indices, 0 to n − 1.
    Grid,
}

/// Source of the color of a voxel. A color without view dependence is the same in every direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ColorFrom<'a> {
    /// Mean color of the samples that read the voxel, weighted by their rendering weights, on rays of pixels that show objects. Harmonics
    /// are arbitrary in directions that no camera looks from, and the color stored in a voxel differs from its visible color between its
    /// neighbours.
    Seen(&'a Seen),
    /// Mean over all directions: the harmonic of degree 0.
    Mean,
    /// Color rendered by a ray in this unit direction, from the viewer into the scene, that starts one voxel before the point.
    Direction(DVec3),
}

/// Selection of voxels, and attributes of their points.
#[derive(Clone, Debug, PartialEq)]
pub struct VoxelOptions<'a> {
    /// Frame of the points.
    pub coordinates: Coordinates,
    /// Source of the colors.
    pub color: ColorFrom<'a>,
    /// Smallest opacity of a point ([`VoxelGrid::voxels_absorbing`]).
    pub min_alpha: f64,
    /// Required visibility of a voxel; `None` selects all voxels.
    pub visible: Option<Visible<'a>>,
}

/// Required visibility of a voxel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visible<'a> {
    /// Visibility of the grid's voxels.
    pub seen: &'a Seen,
    /// Smallest [`Seen::weight`].
    pub min_weight: f64,
    /// Smallest [`Seen::object`]. Fog in the background's color that hides nothing has values near 0.
    pub min_object: f64,
}

const FIELDS: [&str; 4] = ["opacity", "density", "weight", "object"];

/// Returns the names of the fields of [`points`], depending on whether visibility is known: `opacity` (α) and `density` (σ, 1 / world
/// length), and if `seen`, also `weight` and `object` of [`Seen`].
pub fn field_names(seen: bool) -> &'static [&'static str] {
    if seen { &FIELDS } else { &FIELDS[..2] }
}

/// Returns the selected voxels of a grid as points, in row-major order, x slowest, with the fields of [`field_names`]. Coordinates are
/// rounded to `f32`, as in files.
///
/// Panics if the visibility belongs to a grid with another layout.
#[track_caller]
pub fn points<T: Real>(grid: &VoxelGrid<T>, options: &VoxelOptions<'_>) -> PointCloud {
    let (shape, lattice) = (grid.shape(), grid.lattice());
    let seen = match (options.visible, options.color) {
        (Some(Visible { seen, .. }), _) | (None, ColorFrom::Seen(seen)) => Some(seen),
        _ => None,
    };
    assert!(seen.is_none_or(|seen| seen.weight.len() == lattice.rows()), "points: the visibility belongs to another grid");
    let n = shape.resolution;
    let dense = grid.voxels_absorbing(options.min_alpha);
    let sigma = |row: u32| grid.density.tensor().data()[row as usize].as_f64().max(0.0);
    let alpha = |row: u32| shape.alpha_of_density(sigma(row));
    let visible = |row: u32| {
        let at_least = |values: &[f32], least: f64| f64::from(values[row as usize]) >= least;
        options.visible.is_none_or(|v| at_least(&v.seen.weight, v.min_weight) && at_least(&v.seen.object, v.min_object))
    };
    let planes = parallel::map_indices(n, |x| {
        let voxels = (0..n).flat_map(|y| (0..n).map(move |z| [x, y, z]));
        let found = voxels.filter(|voxel| dense.contains(*voxel)).filter_map(|voxel| lattice.row(voxel).map(|row| (voxel, row)));
        found.filter(|&(_, row)| visible(row)).collect::<Vec<_>>()
    });
    let chosen: Vec<([usize; 3], u32)> = planes.into_iter().flatten().collect();

    let centers: Vec<DVec3> = chosen.iter().map(|(voxel, _)| shape.center(voxel.map(|k| k as isize))).collect();
    let positions = match options.coordinates {
        Coordinates::Grid => chosen.iter().map(|(voxel, _)| DVec3::from(voxel.map(|k| k as f64))).collect(),
        Coordinates::World => centers.iter().map(|center| center.as_vec3().as_dvec3()).collect(),
    };
    let of_seen = |values: fn(&Seen) -> &[f32], row: u32| seen.map_or(0.0, |seen| f64::from(values(seen)[row as usize]));
    let values: [&dyn Fn(u32) -> f64; FIELDS.len()] =
        [&alpha, &sigma, &|row| of_seen(|seen| &seen.weight, row), &|row| of_seen(|seen| &seen.object, row)];
    let field = |(name, value): (&&str, &dyn Fn(u32) -> f64)| ScalarField {
        name: (*name).to_owned(),
        values: chosen.iter().map(|&(_, row)| value(row) as f32).collect(),
    };
    let fields = field_names(seen.is_some()).iter().zip(values).map(field).collect();
    let rows: Vec<u32> = chosen.iter().map(|&(_, row)| row).collect();
    PointCloud {
        positions,
        colors: Some(colors(grid, &centers, &rows, options.color)),
        normals: Some(parallel::map_indices(chosen.len(), |i| normal(grid, chosen[i].0))),
        fields,
    }
}

/// Returns the unit normal of a voxel; zero if it has no direction.
fn normal<T: Real>(grid: &VoxelGrid<T>, voxel: [usize; 3]) -> [f32; 3] {
    /// Change of α per voxel below which there is no surface, as inside opaque matter.
    const FLAT: f64 = 1e-7;
    let outward = grid.outward(voxel.map(|k| k as isize));
    if outward.length() > FLAT { outward.normalize().as_vec3().to_array() } else { [0.0; 3] }
}

/// Returns the colors of some voxels, given by centres and rows, as 8-bit sRGB.
fn colors<T: Real>(grid: &VoxelGrid<T>, centers: &[DVec3], rows: &[u32], from: ColorFrom<'_>) -> Vec<[u8; 3]> {
    let along = |direction: DVec3| near_colors(grid, centers, &vec![direction; rows.len()], rows);
    // A zero direction selects the mean over all directions.
    let mean = || along(DVec3::ZERO);
    match from {
        ColorFrom::Seen(seen) => {
            // Invisible voxels get their mean color.
            let color =
                |(&row, mean)| if seen.weight[row as usize] > 0.0 { in_bytes(seen.color[row as usize].map(f64::from)) } else { mean };
            rows.iter().zip(mean()).map(color).collect()
        }
        ColorFrom::Direction(direction) => along(direction),
        ColorFrom::Mean => mean(),
    }
}

#[cfg(test)]
mod tests;
