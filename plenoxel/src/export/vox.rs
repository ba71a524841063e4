//! MagicaVoxel files: the .vox format, version 150, with the scene graph of its extension.
//!
//! The format's axes are those of the dataset, right-handed and z up: voxel (i, j, k) of the grid is voxel (i, j, k) of the file. A model
//! has at most 256 voxels per side. Larger grids become tiles of 256³ with the grid's coordinates modulo 256, arranged by the scene graph
//! so that the box is centred in x and y and its bottom is at z = 0. MagicaVoxel places a single model there by default, so smaller grids
//! need no scene graph, which some readers do not support.
//!
//! A voxel stores the index of its color, 1 to 255; 0 means empty. Entry i − 1 of the 256 palette entries in the file belongs to index i.
//! Source: the specification `MagicaVoxel-file-format-vox.txt` of github.com/ephtracy/voxel-model, and its extension.

use super::{SURFACE_ALPHA, directions, near_colors};
use crate::error::{Error, Result};
use crate::export::palette::quantize;
use crate::field::voxel_grid::VoxelGrid;
use crate::sampling::Occupancy;
use autograd::{Real, parallel};
use glam::DVec3;

/// Voxels of a .vox file.
#[derive(Debug, Clone, PartialEq)]
pub struct Vox {
    /// Number of voxels along each axis of the grid.
    pub resolution: usize,
    /// Palette of at most 255 sRGB colors.
    pub palette: Vec<[u8; 3]>,
    /// Voxels (i, j, k) of the grid with the indices of their colors; 1 is the first color of the palette.
    pub voxels: Vec<([u16; 3], u8)>,
}

/// Options of .vox files.
#[derive(Debug, Clone, Copy)]
pub struct VoxOptions {
    /// Smallest fraction of the crossing light that an exported voxel absorbs ([`VoxelGrid::voxels_absorbing`]).
    pub min_alpha: f64,
    /// Also export voxels that are hidden by others on all six sides.
    pub solid: bool,
    /// Unit direction from the viewer into the scene in which colors are evaluated; `None` for the direction opposite to
    /// [`VoxelGrid::outward`] of each voxel, restricted to open faces.
    pub direction: Option<DVec3>,
}

impl Default for VoxOptions {
    fn default() -> Self {
        VoxOptions { min_alpha: SURFACE_ALPHA, solid: false, direction: None }
    }
}

/// Returns the exported voxels of a grid, with a palette made from their colors.
///
/// Errors if `min_alpha` is not in [0, 1), or if no voxel absorbs as much.
pub fn vox<T: Real>(grid: &VoxelGrid<T>, options: &VoxOptions) -> Result<Vox> {
    let VoxOptions { min_alpha, solid, direction } = *options;
    if !(0.0..1.0).contains(&min_alpha) {
        return Err(Error::config("min_alpha", min_alpha, "a number in [0, 1)"));
    }
    let dense = grid.voxels_absorbing(min_alpha);
    let places = places(&dense, solid);
    if places.is_empty() {
        let found = format!("no voxel of this grid has an alpha of {min_alpha} or more");
        return Err(Error::usage("min_alpha", found, "use a smaller value; if 0 fails too, train longer"));
    }
    // All exported voxels are present, because absent voxels have no density.
    let rows: Vec<u32> = places.iter().map(|voxel| grid.lattice().row(voxel.map(usize::from)).unwrap_or_default()).collect();
    let signed = |place: &[u16; 3]| place.map(|k| k as isize);
    let points: Vec<DVec3> = places.iter().map(|place| grid.shape().center(signed(place))).collect();
    let outward: Vec<DVec3> = places.iter().map(|place| open(grid.outward(signed(place)), signed(place), &dense)).collect();
    let colors = near_colors(grid, &points, &directions(&outward, direction), &rows);
    let (palette, entries) = quantize(&colors, 255);
    let voxels = places.into_iter().zip(entries).map(|(place, entry)| (place, entry + 1)).collect();
    Ok(Vox { resolution: grid.shape().resolution, palette, voxels })
}

/// Returns the part of an outward vector that points through open faces of a voxel. Faces to other exported voxels are hidden.
fn open(outward: DVec3, voxel: [isize; 3], dense: &Occupancy) -> DVec3 {
    let taken = |voxel: [isize; 3]| {
        let inside = (0..3).all(|a| (0..dense.cells()[a] as isize).contains(&voxel[a]));
        inside && dense.contains(voxel.map(|k| k as usize))
    };
    DVec3::from([0, 1, 2].map(|axis| {
        let mut beyond = voxel;
        beyond[axis] += if outward[axis] > 0.0 { 1 } else { -1 };
        if taken(beyond) { 0.0 } else { outward[axis] }
    }))
}

/// Returns the voxels of an occupancy, x slowest; unless `solid`, without voxels that have all six neighbours.
fn places(dense: &Occupancy, solid: bool) -> Vec<[u16; 3]> {
    let n = dense.cells()[0];
    let hidden = |[i, j, k]: [usize; 3]| {
        [i, j, k].iter().all(|c| (1..n - 1).contains(c))
            && [[i - 1, j, k], [i + 1, j, k], [i, j - 1, k], [i, j + 1, k], [i, j, k - 1], [i, j, k + 1]].iter().all(|&c| dense.contains(c))
    };
    let planes = parallel::map_indices(n, |i| {
        let voxels = (0..n * n).map(|v| [i, v / n, v % n]).filter(|&voxel| dense.contains(voxel) && (solid || !hidden(voxel)));
        voxels.map(|voxel| voxel.map(|c| c as u16)).collect::<Vec<_>>()
    });
    planes.concat()
}

/// Largest number of voxels per side of a model, because coordinates are bytes.
const SIDE: usize = 256;

impl Vox {
    /// Returns the bytes of the file.
    ///
    /// Errors if there are more voxels than the format can store.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        // The length of a chunk has 31 bits, and a voxel takes four bytes.
        const MOST: usize = (1 << 29) - (1 << 20);
        if self.voxels.len() > MOST {
            let found = format!("{} voxels are selected, but a .vox file may have at most {MOST}", self.voxels.len());
            return Err(Error::usage("min_alpha", found, "use a larger value, or leave out hidden voxels"));
        }
        let tiles = self.tiles();
        let mut chunks = Vec::new();
        for tile in &tiles {
            chunk(&mut chunks, b"SIZE", &integers(tile.size.map(|side| side as i32)));
            let count = integers([tile.voxels.len() as i32]);
            chunk(&mut chunks, b"XYZI", &[count.as_slice(), tile.voxels.as_flattened()].concat());
        }
        if self.resolution > SIDE {
            self.scene_graph(&tiles, &mut chunks);
        }
        let mut entries: Vec<u8> = self.palette.iter().flat_map(|&[r, g, b]| [r, g, b, 255]).collect();
        entries.resize(4 * 256, 0);
        chunk(&mut chunks, b"RGBA", &entries);
        Ok([b"VOX ".as_slice(), &integers([150]), b"MAIN", &integers([0, chunks.len() as i32]), &chunks].concat())
    }

    /// Returns the parts of at most 256 voxels per side that are not empty, x slowest.
    fn tiles(&self) -> Vec<Tile> {
        let count = self.resolution.div_ceil(SIDE);
        let mut tiles: Vec<Tile> = (0..count * count * count)
            .map(|t| {
                let origin = [t / (count * count), t / count % count, t % count].map(|c| c * SIDE);
                Tile { origin, size: origin.map(|start| (self.resolution - start).min(SIDE)), voxels: Vec::new() }
            })
            .collect();
        for &(place, index) in &self.voxels {
            let [a, b, c] = place.map(|k| usize::from(k) / SIDE);
            let [x, y, z] = place.map(|k| (usize::from(k) % SIDE) as u8);
            tiles[(a * count + b) * count + c].voxels.push([x, y, z, index]);
        }
        tiles.retain(|tile| !tile.voxels.is_empty());
        tiles
    }

    /// Writes the scene graph. Node 0 is the transform of the root, node 1 the group of all tiles. Tile m has its transform in node 2 m + 2
    /// and its shape in node 2 m + 3.
    fn scene_graph(&self, tiles: &[Tile], chunks: &mut Vec<u8>) {
        const NO_ATTRIBUTES: i32 = 0;
        const RESERVED: i32 = -1;
        const LAYER: i32 = 0;
        const FRAMES: i32 = 1;
        const MODELS: i32 = 1;
        let count = tiles.len() as i32;
        chunk(chunks, b"nTRN", &integers([0, NO_ATTRIBUTES, 1, RESERVED, RESERVED, FRAMES, NO_ATTRIBUTES]));
        let children: Vec<u8> = (0..count).flat_map(|m| (2 * m + 2).to_le_bytes()).collect();
        chunk(chunks, b"nGRP", &[integers([1, NO_ATTRIBUTES, count]), children].concat());
        for (m, tile) in (0..).zip(tiles) {
            let [place, shape] = [2 * m + 2, 2 * m + 3];
            // The position of a model is that of its voxel number size / 2, rounded down.
            let half = self.resolution / 2;
            let [x, y, z] = [0, 1, 2].map(|a| (tile.origin[a] + tile.size[a] / 2) as i32 - [half, half, 0][a] as i32);
            let translation = [integers([1]), string("_t"), string(&format!("{x} {y} {z}"))].concat();
            chunk(chunks, b"nTRN", &[integers([place, NO_ATTRIBUTES, shape, RESERVED, LAYER, FRAMES]), translation].concat());
            chunk(chunks, b"nSHP", &integers([shape, NO_ATTRIBUTES, MODELS, m, NO_ATTRIBUTES]));
        }
    }
}

/// Part of the grid.
struct Tile {
    /// First voxel of the tile.
    origin: [usize; 3],
    size: [usize; 3],
    /// Voxels of the tile with the indices of their colors.
    voxels: Vec<[u8; 4]>,
}

/// Appends a chunk without children: its name, the lengths of its content and its children, and the content.
fn chunk(chunks: &mut Vec<u8>, name: &[u8; 4], content: &[u8]) {
    chunks.extend_from_slice(name);
    chunks.extend(integers([content.len() as i32, 0]));
    chunks.extend_from_slice(content);
}

fn integers<const N: usize>(numbers: [i32; N]) -> Vec<u8> {
    numbers.into_iter().flat_map(i32::to_le_bytes).collect()
}

fn string(text: &str) -> Vec<u8> {
    [integers([text.len() as i32]).as_slice(), text.as_bytes()].concat()
}
