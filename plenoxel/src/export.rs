//! Grids as files of other programs.
//!
//! Positions are those of the dataset, z up, unless a format demands otherwise; colors are sRGB with 8 bits, as the photographs have them. A grid
//! whose colors depend on the direction is looked at in one direction: each voxel against the way it faces, or all along a given one.

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

/// The share of the light that a voxel absorbs where its matter counts as a surface, for meshes and .vox files. Of 0.03, 0.05, 0.1, 0.15, 0.2, 0.3 and
/// 0.5 the one whose exports look most like test photographs: lego at 128³, views 0, 60 and 130. With 0.5 surfaces have holes, with 0.1 they wear a crust.
pub const SURFACE_ALPHA: f64 = 0.3;

/// How far in front of a point the ray begins that finds its color, in voxels.
const CLEARANCE: f64 = 1.0;
/// Rays rendered at a time, which bounds the memory.
const RAYS: usize = 4096;

/// The directions, from the viewer into the scene, in which colors are seen: `along`, or where that is `None` each against its `outward`
/// vector, of any length; zero where that is zero.
fn directions(outward: &[DVec3], along: Option<DVec3>) -> Vec<DVec3> {
    outward.iter().map(|out| along.unwrap_or(-out.normalize_or_zero())).collect()
}

/// The 8-bit colors that a camera sees close by at `points`, looking along their unit `directions`: what a ray renders from a voxel before
/// the point, divided by its opacity. A surface in a radiance field is several voxels thick, and the colors of single ones mean little: only
/// their sum was fitted.
///
/// A point with a direction of zero has the mean color of its voxel, of which `rows` has the row in the tables.
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

/// An sRGB color in 8 bits, from 0 to 255.
pub(crate) fn in_bytes(rgb: [f64; 3]) -> [u8; 3] {
    rgb.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8)
}
