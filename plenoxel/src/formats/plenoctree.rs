//! Octrees of PlenOctrees (`tree.npz`, class N3Tree of svox; Yu et al. 2021).
//!
//! | array | type and shape | meaning |
//! | --- | --- | --- |
//! | `child` | `<i4` `[nodes, 2, 2, 2]` | number of the child's node minus that of its own node; 0 for a leaf |
//! | `data` | `<f2` `[nodes, 2, 2, 2, data_dim]` | values of the leaves: color, then density |
//! | `parent_depth` | `<i4` `[nodes, 2]` | 8 · parent + place in the parent; depth, 0 for the root |
//! | `invradius3`, `offset` | `<f4` `[3]` | a position p is at offset + p · invradius3 in the unit cube of the root, node 0 |
//! | `data_format` | text | `SH1`, `SH4`, `SH9` or `SH16`: harmonics of red, then green, then blue; `RGBA`: a color |
//! | `data_dim`, `n_internal`, `n_free`, `depth_limit`, `geom_resize_fact` | numbers | sizes; settings of svox |
//!
//! Old files have one number `invradius`, and no `data_format`. Other arrays are not read.
//!
//! **Conventions.** A leaf is constant. Its density is raw, 1 / length in the coordinates of p; svox renders leaves above 0.01. Its color is
//! 1 / (1 + exp(−Σ Yₖ(d) cₖ)) with the harmonics of [`crate::field::sh`], and RGBA is one number x per channel in place of the sum. (Some
//! versions of volrend show RGBA without the exponential.)
//!
//! **What is kept.** A grid with nearest look-up has the same densities in both directions. Colors that depend on the direction are fitted,
//! because colors of this crate are not logistic functions. A grid with trilinear look-up is written with
//! several leaves per voxel along each axis, each with its mean values; that is an approximation.

mod leaves;
mod read;
mod write;

pub(super) use read::read;
pub use write::{OctreeOptions, encode};

/// Children of a node.
const CHILDREN: usize = 8;
/// Smallest density of a leaf that svox renders.
const LEAST_DENSITY: f32 = 0.01;

/// Place of a child in its node, from the lowest bits of its coordinates.
fn place(x: usize, y: usize, z: usize) -> usize {
    (x & 1) << 2 | (y & 1) << 1 | z & 1
}
