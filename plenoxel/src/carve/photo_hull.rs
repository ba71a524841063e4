//! The photo hull: a box of voxels from which voxels that contradict the photographs are carved (Kutulakos and Seitz, A Theory of Shape by
//! Space Carving, 2000). It finds hollows that no silhouette shows, and needs no alpha channel.
//!
//! A voxel v is *photo-consistent* if one color explains every pixel that sees it. A pixel sees v if its ray meets v before any other
//! remaining voxel. Each round has three steps:
//!
//! 1. look: the exact traversal of each object pixel's ray finds the first remaining voxel (item buffers, as in generalized voxel coloring:
//!    Culbertson, Malzbender and Slabaugh 1999). Only rays whose voxel was carved in the previous round are traversed again.
//! 2. test: voxels that new pixels see are tested with all of their pixels in all views. A voxel is inconsistent if its colors have a
//!    standard deviation above [`PhotoConfig::noise`]. A view contributes the range of the colors of its pixels, weighted by their number
//!    (`votes.rs`).
//! 3. carve: a voxel is carved if it is inconsistent, and at least half of the visible voxels among its 26 neighbours are too. Surfaces
//!    that are really elsewhere are inconsistent in patches. The true surface is inconsistent in single voxels and lines, where a texture
//!    or a silhouette crosses them. One wrongly carved voxel would expose the voxel behind it, which is inconsistent there too, and so on.
//!
//! Rounds end when no voxel is carved. All voxels of a round are carved together, so the result depends only on the input. Carving never
//! hides a voxel: the pixels that see a remaining voxel only become more, so a voxel that is contradicted before others of its round are
//! carved is contradicted afterwards. With a test that further pixels can only make stricter, any order has the same fixed point, the photo
//! hull: the union of all consistent shapes in the box, hence a superset of the true shape if that is consistent. Here the deviation is a
//! mean over pixels and patches must agree, so the rounds are part of the definition. At the end, no visible voxel is inconsistent together
//! with its patch.
//!
//! Pixels with alpha 0 show no voxel and do not vote: the visual hull has already carved what they contradict. Glossy surfaces have no
//! single color: where their color varies by more than `noise`, they are carved into. Uniformly colored walls of hollows cannot be
//! distinguished from a closed surface.

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

/// Settings of the test for photo-consistency.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PhotoConfig {
    /// Largest standard deviation of the colors of a voxel, for sRGB values in [0, 1]: the root of the mean square over the three channels.
    /// It accounts for deviations from a Lambertian surface of one color: sensor noise, other surfaces in a pixel, gloss. Smaller values
    /// carve more. Must be above 0.
    pub noise: f64,
}

impl Default for PhotoConfig {
    /// 15 % of the range of colors. On the built-in scene (100 views of 200 x 200, 128³ voxels) it carves half of the filling of the bowl,
    /// and 0.12 % of the voxels that are at least half full, nearly all of them in the glossy ball. 0.12 carves two thirds of the filling,
    /// and 1 % of these voxels.
    fn default() -> Self {
        PhotoConfig { noise: 0.15 }
    }
}

/// Returns the voxels of `start` that are photo-consistent in all views. `start` must contain the scene: a visual hull, or the whole box if
/// there is no alpha channel. `progress(round, carved, left)` is called after each round, from 1, with the numbers of carved and remaining
/// voxels.
///
/// Errors with a configuration error if the noise is not above 0.
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

/// Voxels that pixels see, as masks of bricks.
struct Surface {
    bricks: BrickGrid,
    visible: Vec<u64>,
    /// Visible voxels that failed the test.
    inconsistent: Vec<u64>,
}

impl Surface {
    /// Returns true if at least half of the visible neighbours are inconsistent.
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
