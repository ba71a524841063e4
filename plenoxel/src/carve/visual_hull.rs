//! The visual hull: the voxels of a box inside the silhouettes of all views.
//!
//! In [`by_footprint`] and [`by_rays`], background pixels have alpha 0. A pixel of a reduced image has alpha 0 only if its whole block has
//! ([`crate::dataset::image::downscale`]).

use crate::camera::projection::{EDGES, Pixels, Projection, Rectangle};
use crate::dataset::View;
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::sampling::walk::Walk;
use autograd::lattice::{BrickGrid, bits_where, has};
use autograd::{dispatched, parallel};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Number of views whose silhouettes are in memory at a time.
const VIEWS: usize = 8;
/// Number of bricks per task.
const BRICKS: usize = 16;

/// Returns the voxels that remain when a voxel is carved if some view shows its whole projection, and `margin` pixels around it, inside of
/// the image and on background. A voxel with matter stays if the margin's pixels show some of it. A view that sees a voxel only in part
/// does not decide on it.
///
/// Bricks of 4³ voxels are tested by the bounding rectangle of their projection, voxels by the projection itself, a convex polygon.
/// `progress(views)` is called with the number of processed views.
pub fn by_footprint(views: &[View], aabb: Aabb, voxels: [usize; 3], margin: f64, progress: &dyn Fn(usize)) -> Occupancy {
    by_footprint_of(views, &Occupancy::from_masks(aabb, voxels, full(voxels)), margin, progress)
}

/// Carves like [`by_footprint`], starting from the voxels `of`.
pub fn by_footprint_of(views: &[View], of: &Occupancy, margin: f64, progress: &dyn Fn(usize)) -> Occupancy {
    by_silhouettes(views, is_object, of, margin, progress)
}

/// Carves like [`by_footprint_of`], with silhouettes that need no alpha channel. `is_object` returns whether pixel (x, y) of a view shows
/// the object. It is called once per pixel, in parallel.
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

/// Returns the bytes of the silhouettes that are in memory at a time, for views of `pixels` pixels each: one number of a summed-area table
/// per pixel.
pub(crate) fn silhouette_bytes(views: usize, pixels: usize) -> u64 {
    (views.min(VIEWS) * size_of::<u32>() * pixels) as u64
}

/// Returns the voxels through which no ray of a background pixel passes: the source paper's rule, with every voxel on the ray instead of
/// the voxels at 900 points. Rays pass through pixel centres, so thin parts are carved where they lie between rays. `progress(views)` is
/// called with the number of processed views.
pub fn by_rays(views: &[View], aabb: Aabb, voxels: [usize; 3], progress: &dyn Fn(usize)) -> Occupancy {
    // Voxels are only ever removed, so the order does not matter.
    let masks: Vec<AtomicU64> = full(voxels).into_iter().map(AtomicU64::new).collect();
    let (mut done, mut group) = (0, 1);
    while done < views.len() {
        // Empty voxels stay empty: the next views, as many again, skip them or cross them in large steps.
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

/// Returns true for background pixels. Pixels that a mask ignores are none.
pub(super) fn is_background(view: &View, x: usize, y: usize) -> bool {
    view.image.get_pixel(x as u32, y as u32).0[3] == 0 && view.keeps(x, y)
}

fn is_object(view: &View, x: usize, y: usize) -> bool {
    !is_background(view, x, y)
}

/// Returns masks of all voxels.
pub(super) fn full(voxels: [usize; 3]) -> Vec<u64> {
    let bricks = BrickGrid::new(voxels);
    parallel::map_indices(bricks.len(), |brick| bricks.inside(brick))
}

/// Object pixels of a view, and the projection of voxels into it.
struct Silhouette {
    projection: Projection,
    /// Summed-area table (Crow 1984): the number of object pixels above and left of each pixel corner, width + 1 per row.
    sums: Vec<u32>,
}

dispatched! {
/// Returns, as a mask, the voxels of a brick whose projection lies on background.
fn outside(silhouette: &Silhouette, [low, high]: [[usize; 3]; 2], mask: u64, margin: f64) -> u64 {
    let projection = &silhouette.projection;
    if let Some(bounds) = projection.bounds(low, high, margin) {
        match silhouette.object_pixels(bounds) {
            Some(0) if silhouette.holds(bounds) => return mask,
            // The brick is not visible, or is covered by the object: no voxel lies on background.
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

    /// Returns true if the convex hull of some points, and a margin around it, lies inside of the image and on background.
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
            // The polygon's part in this row of pixels lies between the ends of its edges' parts in the row.
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

    /// Returns true if a rectangle lies inside of the image.
    #[inline(always)]
    fn holds(&self, rectangle: Rectangle) -> bool {
        (0..2).all(|a| rectangle.low[a] >= 0.0 && rectangle.high[a] <= self.projection.size[a] as f64)
    }

    /// Returns the number of object pixels that a rectangle touches; `None` if it is outside of the image.
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
