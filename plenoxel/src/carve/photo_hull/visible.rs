//! First voxel that each pixel sees: item buffers (Weghorst, Hooper and Greenberg 1984).

use crate::dataset::View;
use crate::geometry::Aabb;
use crate::sampling::walk::Walk;
use ::image::Rgba;
use autograd::lattice::{BRICK_ROWS, BrickGrid, has};
use autograd::parallel;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The ray meets no voxel, or its pixel is background or ignored by the mask.
const NOTHING: u32 = u32::MAX;
/// The ray has not been traversed yet.
const UNKNOWN: u32 = u32::MAX - 1;

/// Returns the number of a voxel in an item buffer.
pub fn number(brick: usize, bit: usize) -> u32 {
    (brick * BRICK_ROWS + bit) as u32
}

/// First voxel on the ray through the centre of each pixel, four bytes per pixel.
pub struct FirstVoxels<'a> {
    views: &'a [View],
    walk: Walk,
    /// `[views][height · width]`
    numbers: Vec<Vec<u32>>,
}

impl<'a> FirstVoxels<'a> {
    /// Creates item buffers in which all object pixels are unknown.
    ///
    /// Panics if there are more voxels than numbers, about 1600³.
    pub fn new(views: &'a [View], aabb: Aabb, voxels: [usize; 3]) -> Self {
        assert!(
            BrickGrid::new(voxels).len() * BRICK_ROWS < UNKNOWN as usize,
            "photo hull: {voxels:?} voxels cannot be numbered with 32 bits"
        );
        let of_view = |view: &View| {
            let of_pixel = |(x, y, pixel): (u32, u32, &Rgba<u8>)| match pixel.0[3] > 0 && view.keeps(x as usize, y as usize) {
                true => UNKNOWN,
                false => NOTHING,
            };
            view.image.enumerate_pixels().map(of_pixel).collect()
        };
        let numbers = views.iter().map(of_view).collect();
        FirstVoxels { views, walk: Walk::new(aabb, voxels), numbers }
    }

    /// Traverses the rays whose voxel is no longer in the masks. Returns the voxels that these rays see now, as masks.
    pub fn update(&mut self, masks: &[u64]) -> Vec<u64> {
        let fresh: Vec<AtomicU64> = masks.iter().map(|_| AtomicU64::new(0)).collect();
        let rows = self.numbers.iter_mut().zip(self.views).flat_map(|(numbers, view)| {
            let rows = numbers.chunks_mut(view.image.width() as usize).enumerate();
            rows.map(move |(y, row)| (view, y, row))
        });
        let is_left = |number: u32| has(masks[number as usize / BRICK_ROWS], number as usize % BRICK_ROWS);
        let walk = &self.walk;
        parallel::for_each_item(rows.collect(), |_, (view, y, row)| {
            for (x, first) in row.iter_mut().enumerate() {
                if *first == NOTHING || *first != UNKNOWN && is_left(*first) {
                    continue;
                }
                *first = NOTHING;
                let ray = view.camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                walk.along(
                    &ray,
                    |brick| u8::from(masks[brick] == 0),
                    |crossing| {
                        if !has(masks[crossing.brick], crossing.bit) {
                            return ControlFlow::Continue(());
                        }
                        *first = number(crossing.brick, crossing.bit);
                        fresh[crossing.brick].fetch_or(1 << crossing.bit, Relaxed);
                        ControlFlow::Break(())
                    },
                );
            }
        });
        fresh.into_iter().map(AtomicU64::into_inner).collect()
    }

    /// Returns the numbers of the first voxels of a view's pixels, row after row. Pixels without a voxel have a number that no voxel has.
    pub fn of_view(&self, view: usize) -> &[u32] {
        &self.numbers[view]
    }
}
