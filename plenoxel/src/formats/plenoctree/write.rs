//! Writing of octrees.

use super::CHILDREN;
use super::leaves::{Leaves, Placed};
use crate::error::{Error, Result};
use crate::field::voxel_grid::{Interpolation, VoxelGrid};
use crate::formats::check_scale;
use crate::formats::npz::NpzWriter;
use half::f16;
use std::ops::Range;
use std::path::Path;

/// Nodes whose bytes are made at a time.
const RUN: usize = 1 << 12;
/// Deepest node that svox refines, a setting without effect on the picture. svox's default.
const DEPTH_LIMIT: i64 = 10;
/// Growth of svox's tables when it refines, a setting. svox's default.
const GROWTH: f32 = 1.5;

/// Options of octrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OctreeOptions {
    /// Leaves per voxel along each axis: 1, 2, 4 or 8. Grids with nearest look-up have one.
    pub subdivide: usize,
    /// Length in the file of one world unit.
    pub scene_scale: f64,
}

impl Default for OctreeOptions {
    fn default() -> Self {
        OctreeOptions { subdivide: 1, scene_scale: 1.0 }
    }
}

/// Encodes a grid as an octree. A voxel without density has no leaf. `path` names the grid in error messages; `progress(done, all)` is
/// called with numbers of voxels.
///
/// Errors: `subdivide` is not accepted; the octree would have no leaves; there is not enough memory.
pub fn encode(path: &Path, grid: &VoxelGrid<f32>, options: &OctreeOptions, progress: &dyn Fn(usize, usize)) -> Result<(Vec<u8>, usize)> {
    let OctreeOptions { subdivide, scene_scale } = *options;
    check_scale(scene_scale)?;
    let shape = *grid.shape();
    if ![1, 2, 4, 8].contains(&subdivide) {
        return Err(Error::config("subdivide", subdivide, "1, 2, 4 or 8"));
    }
    if shape.interpolation == Interpolation::Nearest && subdivide > 1 {
        return Err(Error::usage("subdivide", "the voxels of this grid are constant", "use 1: more leaves show the same"));
    }
    let voxels = shape.resolution.next_power_of_two().max(2);
    // The grid is in the middle, up to half a voxel.
    let before = (voxels - shape.resolution) / 2;
    let depth = (voxels * subdivide).trailing_zeros() as usize;
    let leaves = Placed { grid, subdivide, before, scene_scale }.leaves(path, progress)?;
    if leaves.codes.is_empty() {
        return Err(Error::input(path, "no voxel of the grid has a density above 0.01", "train longer"));
    }
    let (side, low) = (voxels as f64 * shape.voxel_side(), -shape.half_width - before as f64 * shape.voxel_side());
    let tree = Tree::new(&leaves, depth);
    let count = leaves.codes.len();
    let mut file = NpzWriter::new(true);
    let basis = (leaves.width - 1) / 3;
    file.integer("data_dim", leaves.width as i64)?;
    file.integers("child", &[tree.nodes(), 2, 2, 2], &tree.children())?;
    file.integers("parent_depth", &[tree.nodes(), 2], &tree.parents())?;
    file.integer("n_internal", tree.nodes() as i64)?;
    file.integer("n_free", 0)?;
    file.floats("invradius3", &[3], &[(1.0 / (side * scene_scale)) as f32; 3])?;
    file.floats("offset", &[3], &[(-low / side) as f32; 3])?;
    file.integer("depth_limit", DEPTH_LIMIT.max(depth as i64 - 1))?;
    file.floats("geom_resize_fact", &[], &[GROWTH])?;
    file.text("data_format", &format!("SH{basis}"))?;
    file.add("data", "<f2", &[tree.nodes(), 2, 2, 2, leaves.width], tree.data(&leaves))?;
    Ok((file.finish()?, count))
}

/// The nodes of an octree, level after level.
struct Tree {
    /// Places of the nodes of each level along the Morton curve, in units of the level, ascending. The first level is the root.
    levels: Vec<Vec<u64>>,
}

impl Tree {
    /// Creates the nodes above the leaves of the finest of `depth` levels.
    fn new(leaves: &Leaves, depth: usize) -> Self {
        let mut levels: Vec<Vec<u64>> = Vec::with_capacity(depth);
        for _ in 0..depth {
            let mut above: Vec<u64> = levels.last().unwrap_or(&leaves.codes).iter().map(|code| code / CHILDREN as u64).collect();
            above.dedup();
            levels.push(above);
        }
        levels.reverse();
        Tree { levels }
    }

    /// Returns the number of nodes.
    fn nodes(&self) -> usize {
        self.levels.iter().map(Vec::len).sum()
    }

    /// Calls `f` with level, number of the parent, place in the parent and number of each node but the root.
    fn links(&self, mut f: impl FnMut(usize, usize, usize, usize)) {
        let (mut above, mut first) = (0, self.levels[0].len());
        for (level, pair) in self.levels.windows(2).enumerate() {
            let mut parent = 0;
            for (k, code) in pair[1].iter().enumerate() {
                while pair[0][parent] != code / CHILDREN as u64 {
                    parent += 1;
                }
                f(level + 1, above + parent, (code % CHILDREN as u64) as usize, first + k);
            }
            above = first;
            first += pair[1].len();
        }
    }

    fn children(&self) -> Vec<i32> {
        let mut children = vec![0; self.nodes() * CHILDREN];
        self.links(|_, parent, place, node| children[parent * CHILDREN + place] = (node - parent) as i32);
        children
    }

    fn parents(&self) -> Vec<i32> {
        let mut parents = vec![0; self.nodes() * 2];
        self.links(|level, parent, place, node| {
            parents[2 * node..][..2].copy_from_slice(&[(parent * CHILDREN + place) as i32, level as i32]);
        });
        parents
    }

    /// Returns the bytes of the values of all nodes, in parts: zeros above the finest level and in empty leaves.
    fn data<'a>(&'a self, leaves: &'a Leaves) -> impl Iterator<Item = Vec<u8>> + 'a {
        let row = leaves.width * size_of::<f16>();
        let finest = self.levels.last().map_or(&[][..], |level| level);
        let above = self.nodes() - finest.len();
        let zeros = runs(above).map(move |run| vec![0; run.len() * CHILDREN * row]);
        let mut next = 0;
        let filled = finest.chunks(RUN).map(move |nodes| {
            let mut bytes = vec![0; nodes.len() * CHILDREN * row];
            for (node, bytes) in nodes.iter().zip(bytes.chunks_exact_mut(CHILDREN * row)) {
                while let Some(code) = leaves.codes.get(next).filter(|code| **code / CHILDREN as u64 == *node) {
                    let values = &leaves.values[next * leaves.width..][..leaves.width];
                    let place = (code % CHILDREN as u64) as usize;
                    for (to, value) in bytes[place * row..][..row].as_chunks_mut::<2>().0.iter_mut().zip(values) {
                        *to = value.to_le_bytes();
                    }
                    next += 1;
                }
            }
            bytes
        });
        zeros.chain(filled)
    }
}

/// Divides a number of nodes into runs.
fn runs(nodes: usize) -> impl Iterator<Item = Range<usize>> {
    (0..nodes).step_by(RUN).map(move |start| start..(start + RUN).min(nodes))
}
