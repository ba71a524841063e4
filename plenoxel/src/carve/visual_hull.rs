//! The visual hull: what the silhouettes of all views leave of a box of voxels.
//!
//! By footprint and by rays, background is what has alpha 0, and a reduced picture has alpha 0 only where its whole block has ([`crate::dataset::image::downscale`]).

use crate::camera::projection::{Pixels, Projection, Rectangle};
use crate::dataset::View;
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::sampling::walk::Walk;
use autograd::lattice::{BrickGrid, bits_where, has};
use autograd::{dispatched, parallel};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Views whose silhouettes are in memory at a time.
const VIEWS: usize = 8;
/// Bricks that a thread takes at a time.
const BRICKS: usize = 16;

/// The voxels of which no view shows the whole projection, and `margin` pixels around it, inside of its image and on background. So no
/// voxel goes that holds matter of which the margin's surroundings show something; voxels that a view does not see whole stay for others to
/// decide.
///
/// Bricks of 4³ voxels are tested by the rectangle around their projection, voxels by the projection itself, a convex polygon.
/// `progress(views)` is called as views are done.
pub fn by_footprint(views: &[View], aabb: Aabb, voxels: [usize; 3], margin: f64, progress: &dyn Fn(usize)) -> Occupancy {
    by_footprint_of(views, &Occupancy::from_masks(aabb, voxels, full(voxels)), margin, progress)
}

/// The same of some of the voxels alone.
pub fn by_footprint_of(views: &[View], of: &Occupancy, margin: f64, progress: &dyn Fn(usize)) -> Occupancy {
    by_silhouettes(views, is_object, of, margin, progress)
}

/// Of some voxels those that [`by_footprint`] leaves, with silhouettes that need no alpha: `is_object` says which pixels (x, y) of a view show
/// the object, and is asked once for each, in parallel.
pub fn by_silhouettes(
    views: &[View],
    is_object: impl Fn(&View, usize, usize) -> bool + Sync,
    of: &Occupancy,
    margin: f64,
    progress: &dyn Fn(usize),
) -> Occupancy {
    let (aabb, voxels) = (of.aabb(), of.cells());
    let mut masks = of.masks().to_vec();
    for (chunk, views) in views.chunks(VIEWS).enumerate() {
        let silhouettes = parallel::map_indices(views.len(), |v| Silhouette::of(&views[v], &is_object, aabb, voxels));
        parallel::for_each_chunk(&mut masks, BRICKS, |first, masks| {
            for (brick, mask) in (first..).zip(masks) {
                for silhouette in &silhouettes {
                    if *mask != 0 {
                        *mask &= !outside(silhouette, of.bricks().bounds(brick), *mask, margin);
                    }
                }
            }
        });
        progress(chunk * VIEWS + views.len());
    }
    Occupancy::from_masks(aabb, voxels, masks)
}

/// Bytes of the silhouettes that are in memory at a time, for so many views of so many pixels: a number in a summed-area table for each.
pub(crate) fn silhouette_bytes(views: usize, pixels: usize) -> u64 {
    (views.min(VIEWS) * size_of::<u32>() * pixels) as u64
}

/// The voxels that the ray of no background pixel passes through: the source paper's rule, with every voxel on the ray instead of those
/// around 900 points. Rays are of pixel centres, so it carves into what thin parts leave between them.
/// `progress(views)` is called as views are done.
pub fn by_rays(views: &[View], aabb: Aabb, voxels: [usize; 3], progress: &dyn Fn(usize)) -> Occupancy {
    // Voxels only ever go, so the order in which they do is all the same.
    let masks: Vec<AtomicU64> = full(voxels).into_iter().map(AtomicU64::new).collect();
    let (mut done, mut group) = (0, 1);
    while done < views.len() {
        // What is empty now stays so: the next views, as many again, leave it out or cross it in large steps.
        let snapshot = || masks.iter().map(|mask| mask.load(Relaxed)).collect();
        let empty = Occupancy::from_masks(aabb, voxels, snapshot());
        let Some(extent) = empty.extent() else { break };
        let walk = Walk::new(aabb, voxels).within(extent);
        let free = |brick: usize| if masks[brick].load(Relaxed) == 0 { empty.free(brick).max(1) } else { 0 };
        let next = &views[done..(done + group).min(views.len())];
        let rows: Vec<(&View, usize)> = next.iter().flat_map(|view| (0..view.image.height() as usize).map(move |y| (view, y))).collect();
        parallel::map_items(rows, |_, (view, y)| {
            for x in (0..view.image.width() as usize).filter(|&x| is_background(view, x, y)) {
                let ray = view.camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                walk.along(&ray, free, |crossing| {
                    if has(masks[crossing.brick].load(Relaxed), crossing.bit) {
                        masks[crossing.brick].fetch_and(!(1 << crossing.bit), Relaxed);
                    }
                    ControlFlow::Continue(())
                });
            }
        });
        done += next.len();
        progress(done);
        group = done;
    }
    Occupancy::from_masks(aabb, voxels, masks.into_iter().map(AtomicU64::into_inner).collect())
}

/// True where nothing of the object is seen.
pub(super) fn is_background(view: &View, x: usize, y: usize) -> bool {
    view.image.get_pixel(x as u32, y as u32).0[3] == 0
}

fn is_object(view: &View, x: usize, y: usize) -> bool {
    !is_background(view, x, y)
}

/// Masks of all voxels.
pub(super) fn full(voxels: [usize; 3]) -> Vec<u64> {
    let bricks = BrickGrid::new(voxels);
    parallel::map_indices(bricks.len(), |brick| bricks.inside(brick))
}

/// Where a view shows the object, and how voxels project into it.
struct Silhouette {
    projection: Projection,
    /// Object pixels above and left of each corner of the pixels: a summed-area table (Crow 1984), width + 1 to a row.
    sums: Vec<u32>,
}

/// Pairs of corners ([`Projection::corners`]) that an edge joins.
const EDGES: [(usize, usize); 12] = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)];

dispatched! {
/// Those voxels of a brick within bounds, as a mask, whose projection lies on background.
fn outside(silhouette: &Silhouette, [low, high]: [[usize; 3]; 2], mask: u64, margin: f64) -> u64 {
    let projection = &silhouette.projection;
    if let Some(corners) = projection.corners(low, high) {
        let bounds = Rectangle::around(&corners, margin);
        match silhouette.object_pixels(bounds) {
            Some(0) if silhouette.holds(bounds) => return mask,
            // Not seen, or object all over: nothing in it lies on background.
            None => return 0,
            Some(n) if n == projection.touched(bounds).area() => return 0,
            Some(_) => {}
        }
    }
    let corners = projection.corners_in_brick(low);
    let on_background = |bit: usize| corners.of(bit).is_some_and(|corners| silhouette.is_on_background(&corners, margin));
    bits_where(mask, on_background)
}
}

impl Silhouette {
    fn of(view: &View, is_object: impl Fn(&View, usize, usize) -> bool, aabb: Aabb, voxels: [usize; 3]) -> Self {
        let [width, height] = view.size();
        let mut sums = vec![0; (width + 1) * (height + 1)];
        for y in 0..height {
            let mut row = 0;
            for x in 0..width {
                row += u32::from(is_object(view, x, y));
                sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + row;
            }
        }
        Silhouette { projection: Projection::of(&view.camera, [width, height], aabb, voxels), sums }
    }

    /// True if the convex polygon around some points, and a margin around it, are inside of the image and on background.
    #[inline(always)]
    fn is_on_background(&self, corners: &[[f64; 2]; 8], margin: f64) -> bool {
        let bounds = Rectangle::around(corners, margin);
        if !self.holds(bounds) {
            return false;
        }
        match self.object_pixels(bounds) {
            Some(0) => return true,
            None => return false,
            Some(_) => {}
        }
        let (first, last) = (bounds.low[1].floor() as usize, (bounds.high[1].floor() as usize).min(self.projection.size[1] - 1));
        for row in first..=last {
            // The part of the polygon that is in this row of pixels lies between ends of the parts of its edges that are.
            let (top, bottom) = (row as f64 - margin, row as f64 + 1.0 + margin);
            let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
            for (from, to) in EDGES.map(|(i, j)| (corners[i], corners[j])) {
                let (upper, lower) = if from[1] <= to[1] { (from, to) } else { (to, from) };
                if lower[1] < top || upper[1] > bottom {
                    continue;
                }
                let x_at = |y: f64| match lower[1] - upper[1] {
                    0.0 => upper[0],
                    height => upper[0] + (lower[0] - upper[0]) * ((y - upper[1]) / height),
                };
                for x in [if upper[1] < top { x_at(top) } else { upper[0] }, if lower[1] > bottom { x_at(bottom) } else { lower[0] }] {
                    (left, right) = (left.min(x), right.max(x));
                }
            }
            let strip = Rectangle { low: [left - margin, row as f64], high: [right + margin, row as f64 + 0.5] };
            if left <= right && self.object_pixels(strip).is_some_and(|n| n > 0) {
                return false;
            }
        }
        true
    }

    /// True if a rectangle is inside of the image.
    #[inline(always)]
    fn holds(&self, rectangle: Rectangle) -> bool {
        (0..2).all(|a| rectangle.low[a] >= 0.0 && rectangle.high[a] <= self.projection.size[a] as f64)
    }

    /// The number of object pixels that a rectangle touches; `None` if it is beside the image.
    #[inline(always)]
    fn object_pixels(&self, rectangle: Rectangle) -> Option<usize> {
        let pixels = self.projection.touched(rectangle);
        if pixels.area() == 0 {
            return None;
        }
        let Pixels { x, y } = pixels;
        let sum = |x: usize, y: usize| self.sums[y * (self.projection.size[0] + 1) + x];
        Some((sum(x.1, y.1) + sum(x.0, y.0) - sum(x.0, y.1) - sum(x.1, y.0)) as usize)
    }
}
