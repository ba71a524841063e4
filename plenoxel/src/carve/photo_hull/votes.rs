//! Colors of a voxel in the views, and their deviation.

use crate::camera::projection::{Pixels, Projection, Rectangle};
use crate::dataset::View;
use crate::dataset::image::RgbaImage;
use crate::geometry::Aabb;
use glam::DVec3;

/// Number of projection steps for finding the common color.
const ITERATIONS: usize = 12;

/// View that votes on voxels.
pub struct Witness {
    projection: Projection,
    /// Side of a voxel in pixels, times depth.
    scale: f64,
}

/// Colors of a voxel in a view.
#[derive(Clone, Copy, Debug)]
pub struct Vote {
    /// Smallest and largest value of each channel over the pixels that see the voxel, in [0, 1].
    range: [[f32; 2]; 3],
    /// Number of these pixels.
    pixels: u32,
}

/// Votes of the views that see a voxel.
#[derive(Default)]
pub struct Votes(Vec<Vote>);

impl Witness {
    /// Creates the witness of a view for the voxels of a box.
    pub fn of(view: &View, aabb: Aabb, voxels: [usize; 3]) -> Self {
        let side = (aabb.max - aabb.min) / DVec3::from_array(voxels.map(|n| n as f64));
        Witness {
            projection: Projection::of(&view.camera, view.size(), aabb, voxels),
            scale: view.camera.intrinsics.fx * side.max_element(),
        }
    }

    /// Returns the vote of the pixels whose first voxel is the given one, which is identified by position and number; `None` if there are
    /// no such pixels.
    ///
    /// A pixel that is wider than a voxel also shows the voxel's surroundings. If a voxel is w < 1 pixels wide, the range therefore extends
    /// by 1 − w of the difference to the neighbouring pixels, but at most half of it. Otherwise the blurred edge of a texture, which is as
    /// wide as a patch of such voxels, would contradict the whole patch.
    pub fn vote(&self, image: &RgbaImage, first: &[u32], voxel: [usize; 3], number: u32) -> Option<Vote> {
        let corners = self.projection.corners(voxel, voxel.map(|k| k + 1))?;
        let Pixels { x: columns, y: rows } = self.projection.touched(Rectangle::around(&corners, 0.0));
        let reach = (1.0 - self.scale / self.projection.corner(voxel).z).clamp(0.0, 0.5) as f32;
        let mut vote = Vote { range: [[1.0, 0.0]; 3], pixels: 0 };
        for y in rows.0..rows.1 {
            let start = y * self.projection.size[0];
            let seen = &first[start + columns.0..start + columns.1];
            for (x, _) in seen.iter().enumerate().filter(|(_, first)| **first == number) {
                vote.add(image, columns.0 + x, y, reach);
            }
        }
        (vote.pixels > 0).then_some(vote)
    }
}

impl Vote {
    /// Adds a pixel's color, and the colors at fraction `reach` of the way to the object pixels around it.
    fn add(&mut self, image: &RgbaImage, x: usize, y: usize, reach: f32) {
        let color = |x: usize, y: usize| {
            let [r, g, b, alpha] = image.get_pixel(x as u32, y as u32).0;
            (alpha > 0).then(|| [r, g, b].map(|value| f32::from(value) / 255.0))
        };
        let Some(middle) = color(x, y) else { return };
        self.pixels += 1;
        let around = if reach > 0.0 { 1 } else { 0 };
        for j in y.saturating_sub(around)..(y + around + 1).min(image.height() as usize) {
            for i in x.saturating_sub(around)..(x + around + 1).min(image.width() as usize) {
                let Some(other) = color(i, j) else { continue };
                for (c, range) in self.range.iter_mut().enumerate() {
                    let value = middle[c] + reach * (other[c] - middle[c]);
                    *range = [range[0].min(value), range[1].max(value)];
                }
            }
        }
    }
}

impl Votes {
    /// Removes all votes.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Adds the vote of a view, if there is one.
    pub fn extend(&mut self, vote: Option<Vote>) {
        self.0.extend(vote);
    }

    /// Returns the standard deviation of the colors from the color that explains them best, in [0, 1]; 0 for fewer than two views. With K
    /// views, nₖ pixels and the box Rₖ of colors of each,
    ///
    /// ```text
    /// s² = K / (K − 1) · min_c Σₖ nₖ |c − nearest point of Rₖ to c|² / (3 Σₖ nₖ).
    /// ```
    ///
    /// A view that sees several colors on a voxel accepts any color between them, so textures finer than voxels contradict nothing. A view
    /// that sees little of the voxel has little weight. The iteration c ← mean of the nearest points decreases the sum in every step.
    pub fn spread(&self) -> f64 {
        let (votes, views) = (&self.0, self.0.len());
        if views < 2 {
            return 0.0;
        }
        let total: f32 = votes.iter().map(|vote| vote.pixels as f32).sum();
        let mean = |of: &dyn Fn(&Vote) -> f32| votes.iter().map(|vote| vote.pixels as f32 * of(vote)).sum::<f32>() / total;
        let square: f32 = (0..3)
            .map(|channel| {
                let nearest = |vote: &Vote, c: f32| c.clamp(vote.range[channel][0], vote.range[channel][1]);
                let middle = mean(&|vote| 0.5 * (vote.range[channel][0] + vote.range[channel][1]));
                let c = (0..ITERATIONS).fold(middle, |c, _| mean(&|vote| nearest(vote, c)));
                mean(&|vote| (c - nearest(vote, c)).powi(2))
            })
            .sum();
        f64::from(square / 3.0 * views as f32 / (views - 1) as f32).sqrt()
    }
}
