//! The voxels of a grid as points.
//!
//! A point is the centre of a voxel. Its opacity is what a ray loses that crosses the voxel from face to face,
//! α = 1 − exp(−σ · side) with σ = max(0, density); its normal points to where opacity falls; its color is one of [`ColorFrom`].

use super::{PointCloud, ScalarField};
use crate::field::voxel_grid::VoxelGrid;
use crate::render::fused::Seen;
use autograd::{Real, parallel};
use glam::{DVec3, IVec3};

/// Frame of the points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coordinates {
    /// That of the dataset: voxel k has its centre at (k + ½) · side − half width.
    World,
    /// Indices of voxels, 0 to n − 1.
    Grid,
}

/// Where the one color of a voxel comes from. A plain color is the same into every direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ColorFrom<'a> {
    /// The mean color of the samples that read it, on rays whose pixels show objects, each counting by its weight. Nobody ever looked from
    /// other directions, and harmonics are arbitrary there; and what a voxel holds alone is not what is seen of it between its neighbors.
    Seen(&'a Seen),
    /// The mean over all directions, seen or not: the constant harmonic.
    Mean,
    /// What a ray in this unit direction shows.
    Direction(DVec3),
}

/// Which voxels become points, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct VoxelOptions<'a> {
    /// Frame of the points.
    pub coordinates: Coordinates,
    /// Source of the colors.
    pub color: ColorFrom<'a>,
    /// The least opacity of a point; voxels without density are left out at any rate.
    pub min_alpha: f64,
    /// What cameras must see of a voxel; `None` takes all.
    pub visible: Option<Visible<'a>>,
}

/// What cameras must see of a voxel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visible<'a> {
    /// What they see.
    pub seen: &'a Seen,
    /// The least [`Seen::weight`].
    pub min_weight: f64,
    /// The least [`Seen::object`]: clouds in the background's color, that hang where they hide nothing, are near 0.
    pub min_object: f64,
}

/// The voxels of a grid as points, in row-major order of voxels, x slowest. Fields: `opacity` (α) and `density` (σ, 1 / world length), and
/// `weight` and `object` of [`Seen`], where that is known. Coordinates are rounded to `f32`, as files have them.
///
/// Panics if what was seen is of a grid with another layout.
#[track_caller]
pub fn points<T: Real>(grid: &VoxelGrid<T>, options: &VoxelOptions<'_>) -> PointCloud {
    let (shape, lattice) = (grid.shape(), grid.lattice());
    let seen = match (options.visible, options.color) {
        (Some(Visible { seen, .. }), _) | (None, ColorFrom::Seen(seen)) => Some(seen),
        _ => None,
    };
    assert!(seen.is_none_or(|seen| seen.weight.len() == lattice.rows()), "points: what was seen is of another grid");
    let (n, side) = (shape.resolution, shape.voxel_side());
    let sigma = |row: u32| grid.density.tensor().data()[row as usize].as_f64().max(0.0);
    let alpha = |row: u32| -(-sigma(row) * side).exp_m1();
    let visible = |row: u32| {
        let at_least = |values: &[f32], least: f64| f64::from(values[row as usize]) >= least;
        options.visible.is_none_or(|v| at_least(&v.seen.weight, v.min_weight) && at_least(&v.seen.object, v.min_object))
    };
    let planes = parallel::map_indices(n, |x| {
        let voxels = (0..n).flat_map(|y| (0..n).map(move |z| [x, y, z]));
        let found = voxels.filter_map(|voxel| lattice.row(voxel).map(|row| (voxel, row)));
        found.filter(|&(_, row)| sigma(row) > 0.0 && alpha(row) >= options.min_alpha && visible(row)).collect::<Vec<_>>()
    });
    let chosen: Vec<([usize; 3], u32)> = planes.into_iter().flatten().collect();

    let position = |&([x, y, z], _): &([usize; 3], u32)| {
        let at = match options.coordinates {
            Coordinates::Grid => DVec3::new(x as f64, y as f64, z as f64),
            Coordinates::World => shape.center([x, y, z].map(|k| k as isize)),
        };
        at.as_vec3().as_dvec3()
    };
    let alpha_at = |at: IVec3| {
        let inside = at.cmpge(IVec3::ZERO).all() && at.cmplt(IVec3::splat(n as i32)).all();
        inside.then(|| lattice.row(at.to_array().map(|c| c as usize))).flatten().map_or(0.0, alpha)
    };
    let field = |name: &str, value: &(dyn Fn(u32) -> f64 + Sync)| ScalarField {
        name: name.to_owned(),
        values: chosen.iter().map(|&(_, row)| value(row) as f32).collect(),
    };
    let mut fields = vec![field("opacity", &alpha), field("density", &sigma)];
    if let Some(seen) = seen {
        fields.push(field("weight", &|row| f64::from(seen.weight[row as usize])));
        fields.push(field("object", &|row| f64::from(seen.object[row as usize])));
    }
    let rows: Vec<u32> = chosen.iter().map(|&(_, row)| row).collect();
    PointCloud {
        positions: chosen.iter().map(position).collect(),
        colors: Some(colors(grid, &rows, options.color)),
        normals: Some(parallel::map_indices(chosen.len(), |i| {
            let [x, y, z] = chosen[i].0;
            normal(IVec3::new(x as i32, y as i32, z as i32), alpha_at)
        })),
        fields,
    }
}

/// −∇α / |∇α|, or 0 where α does not change but for rounding: central differences, smoothed by 1, 2, 1 across (Sobel's operator in space). Of opacity and
/// not of density itself: the direction is the same, and a density of 10⁴ beside one of 10³, both opaque, does not turn it.
fn normal(at: IVec3, alpha: impl Fn(IVec3) -> f64) -> [f32; 3] {
    let mut gradient = DVec3::ZERO;
    for dx in -1i32..=1 {
        for dy in -1i32..=1 {
            for dz in -1i32..=1 {
                let offset = IVec3::new(dx, dy, dz);
                let smooth = (IVec3::splat(2) - offset.abs()).as_dvec3();
                let across = DVec3::new(smooth.y * smooth.z, smooth.z * smooth.x, smooth.x * smooth.y);
                gradient += offset.as_dvec3() * across * alpha(at + offset);
            }
        }
    }
    let changes = gradient.length() > 1e-6;
    if changes { (-gradient.normalize()).as_vec3().to_array() } else { [0.0; 3] }
}

/// Colors of some rows, 8-bit sRGB.
fn colors<T: Real>(grid: &VoxelGrid<T>, rows: &[u32], from: ColorFrom<'_>) -> Vec<[u8; 3]> {
    let along = |direction: DVec3| grid.colors_of(rows, &vec![direction; rows.len()]);
    let colors = match from {
        // What nobody sees has its mean color.
        ColorFrom::Seen(seen) => {
            let color = |(&row, mean)| if seen.weight[row as usize] > 0.0 { seen.color[row as usize].map(f64::from) } else { mean };
            rows.iter().zip(along(DVec3::ZERO)).map(color).collect()
        }
        ColorFrom::Direction(direction) => along(direction),
        // A direction of zero stands for all of them.
        ColorFrom::Mean => along(DVec3::ZERO),
    };
    colors.into_iter().map(|color: [f64; 3]| color.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8)).collect()
}

#[cfg(test)]
mod tests;
