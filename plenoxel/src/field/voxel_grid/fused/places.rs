//! Positions of the samples of a ray, in runs, so that a ray that ends early computes no further positions.

use crate::camera::Ray;
use crate::field::voxel_grid::GridShape;
use crate::sampling::{March, Occupied};
use autograd::lattice::TOGETHER;
use autograd::{Real, dispatched};
use glam::DVec3;

/// Remaining samples of one ray.
pub(super) struct Places<'a, T> {
    ray: &'a Ray,
    /// Scale and shift from world to voxel coordinates.
    to_voxels: [T; 2],
    /// March along the ray, and the number of its intervals taken so far.
    march: March,
    next: usize,
    /// Intervals in occupied cells, if an occupancy is known.
    occupied: Option<Occupied<'a>>,
}

impl<'a, T: Real> Places<'a, T> {
    /// Starts at the first sample of a march, or at the first of `occupied`.
    pub fn new(march: March, ray: &'a Ray, occupied: Option<Occupied<'a>>, shape: &GridShape) -> Self {
        Places { ray, to_voxels: shape.to_voxels().map(T::lit), march, next: 0, occupied }
    }

    /// Writes voxel coordinates, middles and lengths of the next samples, at most [`TOGETHER`]. Returns their number; 0 at the end.
    pub fn next_run(&mut self, out: [&mut [T; TOGETHER]; 5]) -> usize {
        let [mut middles, mut lengths] = [[0.0; TOGETHER]; 2];
        let mut count = 0;
        match &mut self.occupied {
            None => {
                count = TOGETHER.min(self.march.count - self.next);
                for i in 0..TOGETHER {
                    (middles[i], lengths[i]) = self.march.interval(self.next + i);
                }
                self.next += count;
            }
            Some(occupied) => {
                for (middle, length) in occupied.take(TOGETHER) {
                    (middles[count], lengths[count]) = (middle, length);
                    count += 1;
                }
            }
        }
        if count == 0 {
            return 0;
        }
        if self.march.is_straight() {
            place(self.ray, [&middles, &lengths], self.to_voxels, out);
        } else {
            let at = middles.map(|middle| self.march.at(self.ray, middle));
            place_each(&at, [&middles, &lengths], self.to_voxels, out);
        }
        count
    }
}

dispatched! {
/// Places the samples of a straight ray in the middles of intervals of these lengths: voxel coordinates, middles and lengths.
fn place<T: Real>(ray: &Ray, [middles, lengths]: [&[f64; TOGETHER]; 2], to_voxels: [T; 2], out: [&mut [T; TOGETHER]; 5]) {
    let [x, y, z, t, delta] = out;
    let (o, d) = (ray.origin, ray.direction);
    for i in 0..TOGETHER {
        let (middle, length) = (middles[i], lengths[i]);
        x[i] = T::lit(o.x + middle * d.x) * to_voxels[0] + to_voxels[1];
        y[i] = T::lit(o.y + middle * d.y) * to_voxels[0] + to_voxels[1];
        z[i] = T::lit(o.z + middle * d.z) * to_voxels[0] + to_voxels[1];
        t[i] = T::lit(middle);
        delta[i] = T::lit(length);
    }
}
}

/// Like [`place`], for samples at these positions.
fn place_each<T: Real>(at: &[DVec3; TOGETHER], [middles, lengths]: [&[f64; TOGETHER]; 2], to_voxels: [T; 2], out: [&mut [T; TOGETHER]; 5]) {
    let [x, y, z, t, delta] = out;
    for i in 0..TOGETHER {
        (x[i], y[i], z[i]) = at[i].to_array().map(|p| T::lit(p) * to_voxels[0] + to_voxels[1]).into();
        (t[i], delta[i]) = (T::lit(middles[i]), T::lit(lengths[i]));
    }
}
