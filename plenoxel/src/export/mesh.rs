//! Surface of a grid's matter as a triangle mesh with normals and colors.
//!
//! Marching cubes (Lorensen and Cline 1987) on the cells between voxel centres: a vertex lies where the density crosses the level between
//! two neighbouring centres, and each cell connects its vertices to polygons. The polygons are not taken from a printed table but derived,
//! in `mesh/cases.rs`, from one rule for the faces of cells. Two cells treat their common face alike, so the surface is closed and each
//! edge has exactly two triangles. Surface nets were rejected for that reason: where matter touches along an edge, four of their triangles
//! meet.
//!
//! Space outside of the box is empty, so a surface that reaches the box is closed on its faces. Planes of centres are processed two at a
//! time: memory is that of the grid, the mesh, and a few arrays of resolution².
//!
//! Optional steps remove small parts (`mesh/parts.rs`), smooth the surface (`mesh/smoothing.rs`), and reduce the number of triangles
//! (`mesh/decimation.rs`). The surface stays closed.

mod cases;
mod decimation;
mod parts;
mod smoothing;

use super::{SURFACE_ALPHA, directions, near_colors};
use crate::error::{Error, Result};
use crate::field::voxel_grid::{Interpolation, VoxelGrid};
use crate::geometry::Similarity;
use autograd::{Real, parallel};
use cases::{CORNERS, EDGES};
use glam::{DMat3, DVec3};

/// Triangle mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Rotation from the coordinates of the mesh to the world, whose z is up.
    pub upright: DMat3,
    /// Position of each vertex; [`mesh`] returns a mesh in world coordinates.
    pub positions: Vec<[f32; 3]>,
    /// Unit normal of each vertex, pointing out of the matter.
    pub normals: Vec<[f32; 3]>,
    /// sRGB color of each vertex.
    pub colors: Vec<[u8; 3]>,
    /// Vertices of each triangle, counterclockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Number of removed parts: those with fewer triangles than [`MeshOptions::min_part`].
    pub parts_left_out: usize,
}

impl Mesh {
    /// Returns the image of the mesh under a similarity.
    pub fn moved(mut self, by: &Similarity) -> Self {
        let moved = |p: [f32; 3], map: &dyn Fn(DVec3) -> DVec3| map(DVec3::from(p.map(f64::from))).as_vec3().to_array();
        self.positions.iter_mut().for_each(|p| *p = moved(*p, &|p| by.point(p)));
        self.normals.iter_mut().for_each(|n| *n = moved(*n, &|n| by.rotation * n));
        self.upright *= by.rotation.transpose();
        self
    }

    /// Returns the enclosed volume, length³, by the divergence theorem: Σ a · (b × c) / 6.
    pub fn volume(&self) -> f64 {
        let corner = |v: u32| DVec3::from(self.positions[v as usize].map(f64::from));
        self.triangles.iter().map(|t| t.map(corner)).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
    }
}

/// Options of meshes.
#[derive(Debug, Clone, Copy)]
pub struct MeshOptions {
    /// Density of the surface, 1 / world length; `None` for the density at which a voxel absorbs [`SURFACE_ALPHA`].
    pub level: Option<f64>,
    /// Unit direction from the viewer into the scene in which colors are evaluated; `None` for the direction opposite to each vertex's
    /// normal.
    pub direction: Option<DVec3>,
    /// Smallest number of triangles of a part. Smaller parts are removed, except the largest part. Parts are connected by common vertices;
    /// floating specks and the walls of hollows are parts.
    pub min_part: usize,
    /// Number of smoothing passes over positions and normals. No vertex moves by more than half a voxel along each axis.
    pub smooth: usize,
    /// Number of triangles to decimate to; `None` for no decimation. Edges are collapsed until the number is reached, or until every
    /// further collapse would join or tear the surface.
    pub max_triangles: Option<usize>,
}

impl Default for MeshOptions {
    /// Level of [`SURFACE_ALPHA`], colors opposite to the normals, no parts of fewer than 100 triangles, no smoothing, no decimation.
    fn default() -> Self {
        MeshOptions { level: None, direction: None, min_part: 100, smooth: 0, max_triangles: None }
    }
}

/// Extracts the surface on which the density of a grid has a level.
///
/// In a trilinear grid, the density is interpolated linearly between neighbouring centres, as in rendering. In a nearest grid, a vertex
/// lies halfway, on the face between two voxels, so corners are rounded off. Normals are [`VoxelGrid::outward`], interpolated. A vertex has
/// the color that a camera sees there.
///
/// The result does not depend on the number of threads.
///
/// Errors if the level is not positive, or if no voxel is denser.
pub fn mesh<T: Real>(grid: &VoxelGrid<T>, options: &MeshOptions) -> Result<Mesh> {
    let shape = grid.shape();
    let level = options.level.unwrap_or_else(|| shape.density_of_alpha(SURFACE_ALPHA));
    let largest = parallel::map_chunks(grid.density.tensor().data().len(), parallel::CHUNK, |range| {
        range.filter_map(|row| grid.lattice().node(row as u32).map(|_| grid.density.tensor().data()[row].as_f64())).fold(0.0, f64::max)
    });
    let largest = largest.into_iter().fold(0.0, f64::max);
    if !(level > 0.0 && level < largest) {
        return Err(match largest > 0.0 {
            true => Error::config(
                "level",
                format!("{level:.4}"),
                format!("a number above 0 and below {largest:.4}, the largest density of this grid"),
            ),
            false => Error::usage("level", "this grid is empty, so it has no surface", "train it longer"),
        });
    }
    let mut surface = surface(grid, level);
    let parts_left_out = surface.leave_out_parts_below(options.min_part);
    let Surface { crossings, mut triangles } = surface;
    let mut vertices = parallel::map_indices(crossings.len(), |v| crossings[v].vertex(grid, level));
    smoothing::smooth(&mut vertices, &triangles, options.smooth, shape.voxel_side() / 2.0);
    if let Some(most) = options.max_triangles {
        (vertices, triangles) = decimation::decimate(vertices, triangles, most)?;
    }
    let rows: Vec<u32> = vertices.iter().map(|vertex| vertex.row).collect();
    let [points, normals] = [|v: &Vertex| v.position, |v: &Vertex| v.normal].map(|part| vertices.iter().map(part).collect::<Vec<_>>());
    let colors = near_colors(grid, &points, &directions(&normals, options.direction), &rows);
    Ok(Mesh {
        upright: DMat3::IDENTITY,
        positions: points.iter().map(|point| point.as_vec3().to_array()).collect(),
        normals: normals.iter().map(|normal| normal.as_vec3().to_array()).collect(),
        colors,
        triangles,
        parts_left_out,
    })
}

/// Edge between two neighbouring centres with the level between them: `low`, and the next centre along `axis`. Coordinates start at −1,
/// outside of the box.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    low: [i16; 3],
    axis: u8,
}

/// Attributes of a vertex.
#[derive(Clone, Copy)]
struct Vertex {
    position: DVec3,
    normal: DVec3,
    /// Row of the voxel on the dense side.
    row: u32,
}

/// Smallest distance between a vertex and a centre, relative to the voxel's side. Closer vertices of several edges could be equal in `f32`,
/// and programs that merge equal points would create degenerate triangles.
const NEAREST: f64 = 0.01;

impl Crossing {
    fn vertex<T: Real>(self, grid: &VoxelGrid<T>, level: f64) -> Vertex {
        let ends = [0, 1].map(|step| {
            let mut end = self.low.map(isize::from);
            end[usize::from(self.axis)] += step;
            end
        });
        let [a, b] = ends.map(|end| grid.density_at(end));
        let n = grid.shape().resolution as isize;
        let inside = ends.as_flattened().iter().all(|k| (0..n).contains(k));
        let t = match grid.shape().interpolation {
            Interpolation::Trilinear if inside => ((level - a) / (b - a)).clamp(NEAREST, 1.0 - NEAREST),
            // Voxels of a nearest grid end at their faces. So do those at the border, because their outer half has no look-up.
            Interpolation::Trilinear | Interpolation::Nearest => 0.5,
        };
        let [from, to] = ends.map(|end| grid.shape().center(end));
        let [dense, thin] = if a > b { [0, 1] } else { [1, 0] };
        let slope = grid.outward(ends[0]).lerp(grid.outward(ends[1]), t);
        // A speck of matter may have no gradient; the direction along the edge is used instead.
        let along = grid.shape().center(ends[thin]) - grid.shape().center(ends[dense]);
        let normal = slope.try_normalize().unwrap_or_else(|| along.normalize());
        // The density of this end is above a positive level, so its voxel is present.
        let row = grid.lattice().row(ends[dense].map(|k| k as usize)).unwrap_or_default();
        Vertex { position: from.lerp(to, t), normal, row }
    }
}

/// Vertices, given by the edges they lie on, and triangles.
#[derive(Default)]
struct Surface {
    crossings: Vec<Crossing>,
    triangles: Vec<[u32; 3]>,
}

/// Plane of centres of equal x with a margin of one, row-major in y and z.
struct Plane {
    /// True for centres that are denser than the level.
    dense: Vec<bool>,
    /// True for rows with a dense centre.
    rows: Vec<bool>,
    /// Vertices on the edges that start at each centre along x, y and z; arbitrary for edges without a vertex.
    vertices: [Vec<u32>; 3],
}

impl Plane {
    fn new(side: usize) -> Self {
        let vertices = [0, 1, 2].map(|_| vec![0; side * side]);
        Plane { dense: vec![false; side * side], rows: vec![false; side], vertices }
    }

    /// Reads the plane of centres at an x from −1 to n.
    fn read<T: Real>(&mut self, grid: &VoxelGrid<T>, level: f64, x: isize) {
        let side = self.rows.len();
        parallel::for_each_chunk(&mut self.dense, side, |start, row| {
            let y = (start / side) as isize - 1;
            for (z, dense) in (-1..).zip(row) {
                *dense = grid.density_at([x, y, z]) > level;
            }
        });
        for (row, any) in self.dense.chunks_exact(side).zip(&mut self.rows) {
            *any = row.contains(&true);
        }
    }
}

/// Extracts all vertices and triangles, x slowest.
fn surface<T: Real>(grid: &VoxelGrid<T>, level: f64) -> Surface {
    let n = grid.shape().resolution as isize;
    let side = n as usize + 2;
    let cases = cases::triangles();
    let mut found = Surface::default();
    let (mut low, mut high) = (Plane::new(side), Plane::new(side));
    // The plane at −1 is empty.
    for x in -1..n {
        high.read(grid, level, x + 1);
        found.add_vertices(&mut low, &mut high, x);
        found.add_triangles(&cases, &low, &high);
        std::mem::swap(&mut low, &mut high);
    }
    found
}

impl Surface {
    /// Adds the vertices on edges from the plane at `x` to the next plane, and on edges inside the next plane.
    fn add_vertices(&mut self, low: &mut Plane, high: &mut Plane, x: isize) {
        let side = low.rows.len();
        for y in 0..side {
            let beyond = y + 1 < side && high.rows[y + 1];
            if !(low.rows[y] || high.rows[y] || beyond) {
                continue;
            }
            for z in 0..side {
                let at = y * side + z;
                let here = high.dense[at];
                let mut place = |vertices: &mut [u32], x: isize, axis: u8| {
                    vertices[at] = self.crossings.len() as u32;
                    self.crossings.push(Crossing { low: [x as i16, y as i16 - 1, z as i16 - 1], axis });
                };
                if low.dense[at] != here {
                    place(&mut low.vertices[0], x, 0);
                }
                if y + 1 < side && high.dense[at + side] != here {
                    place(&mut high.vertices[1], x + 1, 1);
                }
                if z + 1 < side && high.dense[at + 1] != here {
                    place(&mut high.vertices[2], x + 1, 2);
                }
            }
        }
    }

    /// Adds the triangles in the cells between two planes.
    fn add_triangles(&mut self, cases: &[Vec<[u8; 3]>], low: &Plane, high: &Plane) {
        let side = low.rows.len();
        let planes = [low, high];
        for y in 0..side - 1 {
            if !planes.iter().any(|plane| plane.rows[y] || plane.rows[y + 1]) {
                continue;
            }
            for z in 0..side - 1 {
                let place = |[_, dy, dz]: [usize; 3]| (y + dy) * side + z + dz;
                let case = CORNERS
                    .iter()
                    .enumerate()
                    .fold(0, |case, (bit, &corner)| case | usize::from(planes[corner[0]].dense[place(corner)]) << bit);
                let vertex = |edge: u8| {
                    let (corner, axis) = EDGES[usize::from(edge)];
                    planes[corner[0]].vertices[axis][place(corner)]
                };
                self.triangles.extend(cases[case].iter().map(|triangle| triangle.map(vertex)));
            }
        }
    }
}
