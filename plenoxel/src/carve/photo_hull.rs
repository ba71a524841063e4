//! The photo hull: what is left of a box of voxels when those that the photographs contradict are carved away (Kutulakos and Seitz, A Theory
//! of Shape by Space Carving, 2000). It opens hollows that no silhouette shows, and needs no alpha.
//!
//! A voxel v is *photo-consistent* if one color explains every pixel that sees it, that is, whose ray meets v before any other voxel that is
//! left. Each round looks, tests and carves:
//!
//! 1. look: the exact walk of each object pixel's ray finds the first voxel left (item buffers, as in generalized voxel coloring: Culbertson,
//!    Malzbender and Slabaugh 1999). Only the rays of voxels that went in the round before are walked again.
//! 2. test: voxels that new pixels see are tested with all of their pixels in all views: those are inconsistent whose colors have a standard
//!    deviation above [`PhotoConfig::noise`]. A view votes by the range of the colors of its pixels, as much as there are of them
//!    (`votes.rs`).
//! 3. carve: voxels go that are inconsistent, and so are at least half of the visible ones among their 26 neighbours: surfaces that are
//!    really elsewhere are wrong in patches, while the surface itself is wrong in single voxels and lines, where a texture or a silhouette
//!    crosses them. One wrong removal would show the voxel behind it at a place where it is inconsistent too, and so on.
//!
//! until none goes. Voxels of a round go together, so the result depends on nothing but the input. This is right because carving hides
//! nothing: the pixels of a voxel that is left only become more, and what contradicts a voxel before others of its round are gone does so
//! afterwards. With a test that more pixels can only make stricter, any order has the same fixed point, the photo hull: the union of all
//! shapes in the box that are consistent, hence a superset of the true one if that is. Here the spread is a mean over pixels and patches
//! have to agree, so the rounds are part of the definition; at their end no visible voxel is inconsistent together with its patch.
//!
//! Pixels without alpha show no voxel and do not vote: what they contradict, the visual hull has left out already. Shiny surfaces have
//! no one color: where their shine varies by more than `noise` they are carved into. Plain walls of hollows give nothing to tell them from a
//! lid by.

mod visible;
mod votes;

use crate::dataset::View;
use crate::error::{Error, Result};
use crate::sampling::Occupancy;
use autograd::lattice::{BrickGrid, bits_where};
use autograd::parallel;
use serde::{Deserialize, Serialize};
use visible::FirstVoxels;
use votes::{Votes, Witness};

/// What makes a voxel photo-consistent.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PhotoConfig {
    /// The largest standard deviation among the colors of a voxel, in units of sRGB values in [0, 1], the mean square of the three channels.
    /// It stands for whatever is no Lambertian surface of one color: sensor noise, a pixel's share of other surfaces, shine. Less carves
    /// more. Above 0.
    pub noise: f64,
}

impl Default for PhotoConfig {
    /// 15 % of the range of colors. On the built-in scene (100 views of 200 x 200, 128³ voxels) half of what fills the bowl goes and 0.12 % of
    /// the voxels that are at least half full, nearly all of its shiny ball; at 0.12 it is two thirds, and 1 %.
    fn default() -> Self {
        PhotoConfig { noise: 0.15 }
    }
}

/// The voxels of `start` that are photo-consistent in all views. `start` must hold the scene: a visual hull, or the whole box where there is no alpha.
/// `progress(round, carved, left)` is called after each round, from 1, with the number of voxels carved in it and left.
///
/// Errors: a configuration error for a noise that is not above 0.
pub fn photo_hull(views: &[View], start: &Occupancy, config: &PhotoConfig, progress: &dyn Fn(usize, usize, usize)) -> Result<Occupancy> {
    if config.noise.is_nan() || config.noise <= 0.0 {
        return Err(Error::config("noise", config.noise, "a number above 0"));
    }
    let (aabb, voxels) = (start.aabb(), start.cells());
    let mut masks = start.masks().to_vec();
    let witnesses: Vec<Witness> = views.iter().map(|view| Witness::of(view, aabb, voxels)).collect();
    let mut first = FirstVoxels::new(views, aabb, voxels);
    let mut surface = Surface { bricks: start.bricks(), visible: vec![0; masks.len()], inconsistent: vec![0; masks.len()] };
    for round in 1.. {
        let fresh = first.update(&masks);
        let inconsistent = parallel::map_indices(masks.len(), |brick| {
            let mut votes = Votes::default();
            bits_where(fresh[brick], |bit| {
                votes.clear();
                for (v, view) in views.iter().enumerate() {
                    let voxel = surface.bricks.node(brick, bit);
                    votes.extend(witnesses[v].vote(&view.image, first.of_view(v), voxel, visible::number(brick, bit)));
                }
                votes.spread() > config.noise
            })
        });
        for (brick, inconsistent) in inconsistent.into_iter().enumerate() {
            surface.visible[brick] |= fresh[brick];
            surface.inconsistent[brick] = surface.inconsistent[brick] & !fresh[brick] | inconsistent;
        }
        let carved =
            parallel::map_indices(masks.len(), |brick| bits_where(surface.inconsistent[brick], |bit| surface.patch_agrees(brick, bit)));
        surface.remove(&carved);
        masks.iter_mut().zip(&carved).for_each(|(mask, carved)| *mask &= !carved);
        let ones = |masks: &[u64]| masks.iter().map(|mask| mask.count_ones() as usize).sum();
        let gone = ones(&carved);
        progress(round, gone, ones(&masks));
        if gone == 0 {
            break;
        }
    }
    Ok(Occupancy::from_masks(aabb, voxels, masks))
}

/// The voxels that pixels see, as masks of bricks.
struct Surface {
    bricks: BrickGrid,
    visible: Vec<u64>,
    /// Those among them that failed the test.
    inconsistent: Vec<u64>,
}

impl Surface {
    /// True if at least half of the visible neighbours are inconsistent.
    fn patch_agrees(&self, brick: usize, bit: usize) -> bool {
        let voxel = self.bricks.node(brick, bit);
        let (mut visible, mut inconsistent) = (0, 0);
        for k in (0..27).filter(|&k| k != 13) {
            let step = [k / 9, k / 3 % 3, k % 3];
            let around = [0, 1, 2].map(|a| (voxel[a] + step[a]).wrapping_sub(1));
            if (0..3).all(|a| around[a] < self.bricks.nodes()[a]) {
                let (brick, bit) = self.bricks.split(around);
                visible += self.visible[brick] >> bit & 1;
                inconsistent += self.inconsistent[brick] >> bit & 1;
            }
        }
        2 * inconsistent >= visible
    }

    fn remove(&mut self, carved: &[u64]) {
        for (brick, carved) in carved.iter().enumerate() {
            self.visible[brick] &= !carved;
            self.inconsistent[brick] &= !carved;
        }
    }
}

#[cfg(test)]
mod tests;
