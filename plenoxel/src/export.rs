//! Export of grids to files of other programs.
//!
//! Positions are in the world of the run, z up; [`mesh::Mesh::moved`] moves them to the coordinates of the dataset. Colors are 8-bit sRGB, as in the photographs.
//! View-dependent colors are evaluated in one direction: for each voxel opposite to its outward direction, or in a given direction for all.

pub mod mesh;
pub mod mesh_file;
pub mod palette;
pub mod vox;
pub mod web;

use crate::camera::Ray;
use crate::field::voxel_grid::VoxelGrid;
use crate::render::{Engine, RenderOptions, render};
use crate::sampling::{Jitter, Spacing};
use autograd::{Real, no_grad};
use glam::DVec3;

/// Fraction of light that a voxel absorbs at the surface, for meshes and .vox files. It was chosen from 0.03, 0.05, 0.1, 0.15, 0.2, 0.3 and
/// 0.5 as the one whose exports look most like test photographs (lego at 128³, views 0, 60 and 130). With 0.5 surfaces have holes, with 0.1
/// a crust.
pub const SURFACE_ALPHA: f64 = 0.3;

/// Distance in voxels between a point and the start of the ray that determines its color.
const CLEARANCE: f64 = 1.0;
/// Number of rays rendered at a time. It bounds the memory.
const RAYS: usize = 4096;

/// Returns the directions, from the viewer into the scene, in which colors are evaluated: `along`, or, if it is `None`, opposite to each
/// vector of `outward`, normalised; zero for zero vectors.
fn directions(outward: &[DVec3], along: Option<DVec3>) -> Vec<DVec3> {
    outward.iter().map(|out| along.unwrap_or(-out.normalize_or_zero())).collect()
}

/// Returns the 8-bit colors that a camera near `points` sees in the unit `directions`: the rendered color of a ray that starts one voxel
/// before the point, divided by its opacity. A surface in a radiance field is several voxels thick, and only the sum of their colors was
/// fitted, not the color of each.
///
/// A point with direction zero gets the mean color of its voxel. `rows` has the rows of the points' voxels in the tables.
pub(crate) fn near_colors<T: Real>(grid: &VoxelGrid<T>, points: &[DVec3], directions: &[DVec3], rows: &[u32]) -> Vec<[u8; 3]> {
    let side = grid.shape().voxel_side();
    let options = RenderOptions {
        aabb: grid.aabb(),
        spacing: Spacing::Step(side / 2.0),
        jitter: Jitter::None,
        background: [0.0; 3],
        occupancy: None,
        engine: Engine::Fused,
        stop_below: 1e-3,
    };
    let mut colors = grid.colors_of(rows, directions);
    let facing: Vec<usize> = (0..points.len()).filter(|&i| directions[i] != DVec3::ZERO).collect();
    for facing in facing.chunks(RAYS) {
        let ray = |&i: &usize| Ray { origin: points[i] - CLEARANCE * side * directions[i], direction: directions[i], stretch: 1.0 };
        let rays: Vec<Ray> = facing.iter().map(ray).collect();
        let rendered = no_grad(|| render(grid, &rays, &options));
        for ((&i, rgb), opacity) in facing.iter().zip(rendered.rgb.data().as_chunks::<3>().0).zip(rendered.opacity.data()) {
            if opacity.as_f64() > 0.0 {
                colors[i] = rgb.map(|c| c.as_f64() / opacity.as_f64());
            }
        }
    }
    colors.into_iter().map(in_bytes).collect()
}

/// Converts an sRGB color to 8 bits, 0 to 255.
pub(crate) fn in_bytes(rgb: [f64; 3]) -> [u8; 3] {
    rgb.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8)
}
