//! Decimation: edges are collapsed in the order of their quadric errors (Garland and Heckbert 1997), with the crate `alum`.
//!
//! Quadrics are probabilistic (Trettner and Kobbelt 2020): planes have a variance, so that vertices in flat regions have a unique best
//! position too. Collapses that would join or tear the surface are not made.

use super::Vertex;
use crate::error::{Error, Result};
use alum::decimate::quadric::{QuadricDecimater, QuadricType};
use alum::{Handle, HasDecimation, HasIterators, HasTopology, PolyMeshF64};
use glam::DVec3;

/// Reduces a surface to at most `most` triangles, or to the fewest that can be reached. Parts that shrink to two triangles, back to back,
/// are removed. Remaining vertices keep their rows and normals.
///
/// Errors if nothing remains.
pub fn decimate(vertices: Vec<Vertex>, triangles: Vec<[u32; 3]>, most: usize) -> Result<(Vec<Vertex>, Vec<[u32; 3]>)> {
    if triangles.len() <= most {
        return Ok((vertices, triangles));
    }
    let (positions, mut left) = collapsed(&vertices, &triangles, most).map_err(|e| {
        let found = format!("this surface cannot be decimated ({e:?})");
        Error::usage("max_triangles", found, "leave it out")
    })?;
    // Each edge has two triangles, so two triangles with the same vertices form a part.
    left.sort_unstable_by_key(sorted);
    let left: Vec<[u32; 3]> = left.chunk_by(|a, b| sorted(a) == sorted(b)).filter(|same| same.len() == 1).map(|single| single[0]).collect();
    if left.is_empty() {
        let found = format!("{most} triangles are too few for the parts of this surface: nothing is left");
        return Err(Error::usage("max_triangles", found, "increase it, or leave out small parts with a larger --min-part"));
    }
    let mut numbers = vec![u32::MAX; vertices.len()];
    let mut kept = Vec::new();
    let triangles = left.iter().map(|triangle| {
        triangle.map(|v| {
            let number = &mut numbers[v as usize];
            if *number == u32::MAX {
                *number = kept.len() as u32;
                kept.push(Vertex { position: positions[v as usize], ..vertices[v as usize] });
            }
            *number
        })
    });
    let triangles = triangles.collect();
    Ok((kept, triangles))
}

/// Returns the position of each vertex after the collapses, including removed vertices, and the remaining triangles.
fn collapsed(vertices: &[Vertex], triangles: &[[u32; 3]], most: usize) -> std::result::Result<(Vec<DVec3>, Vec<[u32; 3]>), alum::Error> {
    let mut mesh = PolyMeshF64::with_capacity(vertices.len(), 3 * triangles.len() / 2, triangles.len());
    for vertex in vertices {
        mesh.add_vertex(alum::DVec3(vertex.position.x, vertex.position.y, vertex.position.z))?;
    }
    for [a, b, c] in triangles {
        mesh.add_tri_face((*a).into(), (*b).into(), (*c).into())?;
    }
    let mut decimater = QuadricDecimater::new(&mesh, QuadricType::ProbabilisticTriangle)?;
    mesh.decimate_to_face_count(&mut decimater, most)?;
    let (points, status) = (mesh.points(), mesh.face_status_prop());
    let (points, status) = (points.try_borrow()?, status.try_borrow()?);
    let positions = points.iter().map(|point| DVec3::new(point.0, point.1, point.2)).collect();
    Ok((positions, mesh.triangulated_vertices(&status).map(|corners| corners.map(|v| v.index())).collect()))
}

/// Returns the vertices of a triangle in ascending order.
fn sorted(triangle: &[u32; 3]) -> [u32; 3] {
    let mut sorted = *triangle;
    sorted.sort_unstable();
    sorted
}
