//! Smoothing (Taubin 1995): each pass moves every vertex towards the mean of its neighbours, and then slightly farther back, which
//! preserves the volume.

use super::Vertex;
use glam::DVec3;

/// Steps of a pass: the fraction of the distance to the neighbours' mean that a vertex moves, and then moves back. Waves longer than the
/// pass band 1 / λ + 1 / μ = 0.1 are preserved.
const SHARES: [f64; 2] = [0.5, -0.526];

/// Smooths positions and normals in `passes` passes. A vertex stays within `reach` of its original position along each axis.
///
/// The surface is closed: each neighbour of a vertex follows it in exactly one of the triangles around it.
pub fn smooth(vertices: &mut [Vertex], triangles: &[[u32; 3]], passes: usize, reach: f64) {
    let first: Vec<DVec3> = vertices.iter().map(|vertex| vertex.position).collect();
    let mut around = vec![[DVec3::ZERO; 2]; vertices.len()];
    let mut count = vec![0.0; vertices.len()];
    triangles.as_flattened().iter().for_each(|&v| count[v as usize] += 1.0);
    for share in SHARES.iter().cycle().take(2 * passes) {
        around.fill([DVec3::ZERO; 2]);
        for &[a, b, c] in triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                let Vertex { position, normal, .. } = vertices[to as usize];
                around[from as usize][0] += position;
                around[from as usize][1] += normal;
            }
        }
        for (((vertex, first), [position, normal]), count) in vertices.iter_mut().zip(&first).zip(&around).zip(&count) {
            let moved = vertex.position.lerp(*position / *count, *share);
            vertex.position = moved.clamp(*first - reach, *first + reach);
            vertex.normal = vertex.normal.lerp(*normal / *count, *share);
        }
    }
    vertices.iter_mut().for_each(|vertex| vertex.normal = vertex.normal.normalize_or(DVec3::Z));
}
