//! Weights of the voxels of an opaque grid in the pixels of photographs: wᵥ = T (1 − exp(−σ lᵥ)), where l is the exact chord of the ray in
//! the voxel and T the transmittance before it. Fits read the weights ray by ray. They accumulate per voxel in an order that depends only
//! on the pixels.

use crate::camera::Ray;
use crate::dataset::View;
use crate::field::sh;
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::sampling::walk::Walk;
use autograd::lattice::{BRICK_ROWS, has};
use autograd::rows::Buckets;
use autograd::{Lattice, Tensor, no_grad, parallel};
use std::ops::ControlFlow;

/// Transmittance below which a ray ends: two levels of an 8-bit image. The last voxel gets the rest.
const REST: f32 = 1.0 / 128.0;
/// Number of rays per task.
const CHUNK: usize = 1024;
/// Number of parts of the tables that are updated in parallel.
const PARTS: usize = 64;
/// Number of views that are searched for object pixels at a time.
const VIEWS: usize = 8;
/// Number of pixels whose weights are in memory at a time.
const BATCH: usize = 1 << 16;

/// Weight of a voxel in a pixel.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Row of the voxel.
    pub row: u32,
    /// Position of the pixel in its chunk.
    pub ray: u32,
    /// Weight of the voxel in the pixel.
    pub weight: f32,
}

/// Pixel of a view.
#[derive(Clone, Copy, Debug)]
pub struct Pixel {
    /// Number of the view.
    pub view: u32,
    /// Number of the pixel in the view, row after row.
    pub index: u32,
}

/// Grid of voxels with one density.
#[derive(Debug)]
pub struct Opaque<'a> {
    lattice: &'a Lattice,
    walk: Walk,
    occupancy: Occupancy,
    /// First row of each brick, bricks in row-major order.
    first_rows: Vec<u32>,
    density: f64,
}

/// Weights of voxels in some pixels, with a value for each pixel: initially its color over the background.
pub struct Light {
    chunks: Vec<Chunk>,
    /// Number of harmonics per pixel.
    count: usize,
    /// Number of rows per part.
    part: usize,
}

/// Hits of a part of the voxels.
#[derive(Clone, Copy)]
pub struct PartHits<'a> {
    light: &'a Light,
    part: usize,
}

/// Voxel of a part, seen by a pixel.
pub struct SeenBy<'a> {
    /// Row of the voxel, relative to the first row of the part.
    pub row: usize,
    /// Weight of the voxel in the pixel.
    pub weight: f32,
    /// Value of the pixel.
    pub value: [f32; 3],
    /// Harmonics for the ray's direction.
    pub basis: &'a [f32],
}

impl<'a> PartHits<'a> {
    /// Iterates in the order of the pixels.
    pub fn iter(self) -> impl Iterator<Item = SeenBy<'a>> {
        let PartHits { light, part } = self;
        light.chunks.iter().flat_map(move |chunk| {
            chunk.hits[chunk.parts.range(part)].iter().map(move |hit| {
                let ray = hit.ray as usize;
                SeenBy {
                    row: hit.row as usize - part * light.part,
                    weight: hit.weight,
                    value: chunk.values[ray],
                    basis: &chunk.basis.data()[ray * light.count..][..light.count],
                }
            })
        })
    }
}

/// Chunk of consecutive pixels, with their hits sorted by part of the tables.
struct Chunk {
    hits: Vec<Hit>,
    parts: Buckets,
    /// Color of each pixel without the background behind the voxels.
    objects: Vec<[f32; 3]>,
    values: Vec<[f32; 3]>,
    /// `[pixels, (degree + 1)²]`
    basis: Tensor<f32>,
    /// Number of pixels that see no voxel.
    missed: usize,
}

impl<'a> Opaque<'a> {
    /// Creates a grid of all voxels of a lattice with the same density, 1 / world length.
    pub fn new(lattice: &'a Lattice, aabb: Aabb, density: f64) -> Self {
        let bricks = lattice.brick_grid();
        let first_rows = parallel::map_indices(lattice.masks().len(), |b| {
            let brick = lattice.brick(bricks.place(b));
            brick.map_or(0, |(brick, _)| (brick * BRICK_ROWS) as u32)
        });
        let occupancy = Occupancy::from_masks(aabb, lattice.nodes(), lattice.masks().to_vec());
        let extent = occupancy.extent().unwrap_or_default();
        Opaque { lattice, walk: Walk::new(aabb, lattice.nodes()).within(extent), occupancy, first_rows, density }
    }

    /// Appends the voxels along a ray from the camera on until it is opaque. The weight of each is the optical depth behind it.
    fn depths(&self, ray: &Ray, number: u32, out: &mut Vec<Hit>) {
        let masks = self.occupancy.masks();
        let opaque = -REST.ln();
        let (mut depth, density) = (0.0_f32, self.density);
        self.walk.along(
            ray,
            |brick| self.occupancy.free(brick),
            |crossing| {
                if has(masks[crossing.brick], crossing.bit) {
                    depth += (density * (crossing.leave - crossing.enter)) as f32;
                    out.push(Hit { row: self.first_rows[crossing.brick] + crossing.bit as u32, ray: number, weight: depth });
                }
                if depth > opaque { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            },
        );
    }

    /// Computes the weights for some pixels. `degree` is the degree of the harmonics.
    pub fn light(&self, views: &[View], pixels: &[Pixel], background: [f32; 3], degree: usize) -> Light {
        let part = self.lattice.rows().div_ceil(PARTS).max(1);
        let chunks = parallel::map_chunks(pixels.len(), CHUNK, |range| {
            let pixels = &pixels[range];
            let rays: Vec<Ray> = pixels.iter().map(|pixel| pixel.ray(views)).collect();
            let (mut hits, mut ends) = (Vec::with_capacity(16 * CHUNK), Vec::with_capacity(CHUNK));
            let mut missed = 0;
            for (i, ray) in rays.iter().enumerate() {
                let first = hits.len();
                self.depths(ray, i as u32, &mut hits);
                missed += usize::from(hits.len() == first);
                ends.push(hits.len());
            }
            let rests = to_weights(&mut hits, &ends);
            let values: Vec<[f32; 3]> = pixels.iter().map(|pixel| pixel.color(views, background)).collect();
            let behind = |(value, rest): (&[f32; 3], f32)| [0, 1, 2].map(|c| value[c] - rest * background[c]);
            let objects = values.iter().zip(rests).map(behind).collect();
            let (hits, parts) = by_part(&hits, part);
            Chunk { hits, parts, objects, values, basis: basis(&rays, degree), missed }
        });
        Light { chunks, count: sh::count(degree), part }
    }
}

/// Converts optical depths behind voxels to weights, e^(-depth before) - e^(-depth behind). Returns the remaining transmittance of each
/// ray, 0 if it is opaque, because the last voxel got the rest. The hits of ray r end at `ends[r]`.
fn to_weights(hits: &mut [Hit], ends: &[usize]) -> Vec<f32> {
    let depths: Vec<f32> = hits.iter().map(|hit| -hit.weight).collect();
    let n = depths.len();
    let light = no_grad(|| Tensor::from_vec(depths, &[n]).exp());
    let light = light.data();
    let mut first = 0;
    let rests = ends.iter().map(|&end| {
        let mut before = 1.0;
        for i in std::mem::replace(&mut first, end)..end {
            let behind = if light[i] < REST { 0.0 } else { light[i] };
            hits[i].weight = before - behind;
            before = behind;
        }
        before
    });
    rests.collect()
}

/// Sorts hits by the part of the tables that they belong to, keeping their order within each part.
fn by_part(hits: &[Hit], part: usize) -> (Vec<Hit>, Buckets) {
    let part_of = |hit: &Hit| hit.row as usize / part;
    let mut places = Buckets::count(PARTS, hits.iter().map(part_of));
    let mut sorted = vec![Hit { row: 0, ray: 0, weight: 0.0 }; hits.len()];
    hits.iter().for_each(|hit| sorted[places.take(part_of(hit))] = *hit);
    (sorted, places.filled())
}

impl Light {
    /// Sets the value of each pixel to its color minus Σ w color + rest · background. `color(row, basis)` is the color of a voxel in the
    /// ray's direction.
    pub fn say_errors(&mut self, color: impl Fn(usize, &[f32]) -> [f32; 3] + Sync) {
        let count = self.count;
        parallel::for_each_chunk(&mut self.chunks, 1, |_, chunks| {
            for Chunk { hits, objects, values, basis, .. } in chunks {
                values.copy_from_slice(objects);
                for hit in &*hits {
                    let ray = hit.ray as usize;
                    let color = color(hit.row as usize, &basis.data()[ray * count..][..count]);
                    values[ray].iter_mut().zip(color).for_each(|(value, color)| *value -= hit.weight * color);
                }
            }
        });
    }

    /// Calls `f` in parallel with the hits of each part of the voxels and with the corresponding rows of some tables. Tables are given with
    /// their width. Hits of a voxel are in the order of the pixels.
    pub fn for_each_part<const N: usize>(&self, tables: [(&mut Vec<f32>, usize); N], f: impl Fn(PartHits<'_>, [&mut [f32]; N]) + Sync) {
        let widths = tables.each_ref().map(|(_, width)| *width);
        let mut rows = tables.map(|(table, width)| table.chunks_mut(self.part * width));
        let parts: Vec<[&mut [f32]; N]> = std::iter::from_fn(|| {
            let next = rows.each_mut().map(|rows| rows.next().unwrap_or_default());
            (!next[0].is_empty()).then_some(next)
        })
        .collect();
        debug_assert!(parts.iter().all(|part| (0..N).all(|t| part[t].len() * widths[0] == part[0].len() * widths[t])));
        parallel::for_each_item(parts, |part, rows| f(PartHits { light: self, part }, rows));
    }

    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.values.len()).sum()
    }

    /// Returns the size in bytes.
    pub fn bytes(&self) -> usize {
        let of_chunk = |chunk: &Chunk| size_of_val(&*chunk.hits) + (24 + 4 * self.count) * chunk.values.len();
        self.chunks.iter().map(of_chunk).sum()
    }

    /// Returns the number of pixels that see no voxel.
    pub fn missed(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.missed).sum()
    }
}

impl Pixel {
    fn place(self, views: &[View]) -> (&View, usize, usize) {
        let view = &views[self.view as usize];
        (view, (self.index % view.image.width()) as usize, (self.index / view.image.width()) as usize)
    }

    fn ray(self, views: &[View]) -> Ray {
        let (view, x, y) = self.place(views);
        view.camera.ray(x as f64 + 0.5, y as f64 + 0.5)
    }

    fn color(self, views: &[View], background: [f32; 3]) -> [f32; 3] {
        let (view, x, y) = self.place(views);
        view.color(x, y, background)
    }
}

/// Returns the harmonics for the directions of rays, `[rays, (degree + 1)²]`.
fn basis(rays: &[Ray], degree: usize) -> Tensor<f32> {
    let directions = rays.iter().flat_map(|ray| ray.direction.as_vec3().to_array()).collect();
    no_grad(|| sh::basis(&Tensor::from_vec(directions, &[rays.len(), 3]), degree))
}

/// Returns the pixels that show the object (alpha above 0, and kept by the mask), view after view, row after row, in batches.
pub fn object_pixels(views: &[View]) -> impl Iterator<Item = Vec<Pixel>> + '_ {
    views.chunks(VIEWS).enumerate().flat_map(|(group, views)| {
        let lists = parallel::map_indices(views.len(), |v| {
            let alphas = views[v].image.as_raw().as_chunks::<4>().0;
            let view = (group * VIEWS + v) as u32;
            let [width, _] = views[v].size();
            let is_object = |i: usize, alpha: u8| alpha > 0 && views[v].keeps(i % width, i / width);
            let shows = |(i, pixel): (usize, &[u8; 4])| is_object(i, pixel[3]).then_some(Pixel { view, index: i as u32 });
            alphas.iter().enumerate().filter_map(shows).collect::<Vec<_>>()
        });
        lists.concat().chunks(BATCH).map(<[Pixel]>::to_vec).collect::<Vec<_>>()
    })
}
