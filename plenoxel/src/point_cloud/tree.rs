//! Nearest neighbours in the arithmetic of CloudCompare: coordinates are `f32`, their differences are rounded to `f32`, and squares are
//! added in `f64`.
//!
//! A balanced kd-tree, split at the median point of the longest side. Lattices, where many points share a coordinate, coincident points,
//! and clouds with a single distant point cost no more than other clouds. (Cells of equal size would put such a cloud into one cell.) The
//! result does not depend on the number of threads.

use std::ops::Range;

/// Largest number of points in a leaf.
pub(super) const LEAF: usize = 12;
/// Size below which a part gets no task of its own.
const TASK: usize = 1 << 14;

/// Point in 32 bits.
pub(super) type Point = [f32; 3];

/// Points in the order of the tree.
#[derive(Debug)]
pub(super) struct Tree {
    /// Points, ordered so that neighbours are near each other.
    pub points: Vec<Point>,
    /// Numbers of the points in the cloud.
    pub numbers: Vec<u32>,
    /// Axis of the split, at the middle of each split part.
    axes: Vec<u8>,
}

impl Tree {
    /// Creates the tree of some points, which must be finite.
    pub fn new(points: &[Point]) -> Self {
        let mut order: Vec<(Point, u32)> = points.iter().zip(0..).map(|(&point, number)| (point, number)).collect();
        let mut axes = vec![0; order.len()];
        split(&mut order, &mut axes);
        let (points, numbers) = order.into_iter().unzip();
        Tree { points, numbers, axes }
    }

    /// Writes the squared distances of the points nearest to `query` into `nearest`, ascending; infinite if there are fewer points.
    pub fn nearest(&self, query: Point, nearest: &mut [f64]) {
        nearest.fill(f64::INFINITY);
        self.search(0..self.points.len(), query, nearest, &mut |nearest, i| {
            let d = squared_distance(self.points[i], query);
            let last = nearest.len() - 1;
            if d < nearest[last] {
                let place = nearest.partition_point(|&other| other <= d);
                nearest.copy_within(place..last, place + 1);
                nearest[place] = d;
            }
        });
    }

    /// Visits the points of a part that may be nearer than the last of `bounds`, nearer halves first. A visit may lower the bounds.
    fn search(&self, part: Range<usize>, query: Point, bounds: &mut [f64], visit: &mut impl FnMut(&mut [f64], usize)) {
        if part.len() <= LEAF {
            part.for_each(|i| visit(bounds, i));
            return;
        }
        let (low, high) = halves(part);
        let middle = low.end;
        let axis = usize::from(self.axes[middle]);
        // Rounding is monotonic: no point beyond the plane has a smaller difference than this.
        let ahead = f64::from(query[axis] - self.points[middle][axis]);
        let (near, far) = if ahead < 0.0 { (low, high) } else { (high, low) };
        self.search(near, query, bounds, visit);
        if ahead * ahead < bounds[bounds.len() - 1] {
            visit(bounds, middle);
            self.search(far, query, bounds, visit);
        }
    }
}

/// Returns the halves of a part of a tree. The point between them, at the end of the first, belongs to neither.
pub(super) fn halves(part: Range<usize>) -> (Range<usize>, Range<usize>) {
    let middle = part.start + part.len() / 2;
    (part.start..middle, middle + 1..part.end)
}

/// Returns the squared distance as in CloudCompare (CCCoreLib, `DgmOctree.cpp`).
pub(super) fn squared_distance(a: Point, b: Point) -> f64 {
    (0..3).map(|axis| f64::from(a[axis] - b[axis])).map(|d| d * d).sum()
}

/// Orders a part of the tree.
fn split(part: &mut [(Point, u32)], axes: &mut [u8]) {
    if part.len() <= LEAF {
        return;
    }
    let mut bounds = [[f32::INFINITY, f32::NEG_INFINITY]; 3];
    for (point, _) in part.iter() {
        for (bounds, &x) in bounds.iter_mut().zip(point) {
            *bounds = [bounds[0].min(x), bounds[1].max(x)];
        }
    }
    let longer = |a: &usize, b: &usize| (bounds[*a][1] - bounds[*a][0]).total_cmp(&(bounds[*b][1] - bounds[*b][0]));
    let axis = (0..3).max_by(longer).unwrap_or(0);
    let middle = part.len() / 2;
    part.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
    axes[middle] = axis as u8;
    let parallel = part.len() > TASK;
    let (low, high) = part.split_at_mut(middle);
    let (low_axes, high_axes) = axes.split_at_mut(middle);
    if parallel {
        rayon::join(|| split(low, low_axes), || split(&mut high[1..], &mut high_axes[1..]));
    } else {
        split(low, low_axes);
        split(&mut high[1..], &mut high_axes[1..]);
    }
}
