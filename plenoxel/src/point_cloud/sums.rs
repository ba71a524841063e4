//! Sums over the points within a radius. Parts of the tree that lie entirely within the radius are added at once. A query therefore costs
//! time in proportion to the boundary of its neighbourhood, and almost none if the radius contains the whole cloud.

use super::plane::Moments;
use super::tree::{LEAF, Point, Tree, halves, squared_distance};
use autograd::parallel;
use glam::DVec3;
use std::ops::Range;

/// Tree with the bounds and the moments of each part.
pub(super) struct Sums<'a> {
    tree: &'a Tree,
    /// The whole tree, its halves, their halves, and so on to the leaves: part i is split into 2 i + 1 and 2 i + 2.
    parts: Vec<Part>,
}

struct Part {
    /// Smallest and largest coordinates.
    low: Point,
    high: Point,
    /// Mean of the points, about which the moments are computed.
    center: DVec3,
    moments: Moments,
}

impl<'a> Sums<'a> {
    /// Computes the sums of a tree, about 20 bytes per point.
    pub fn new(tree: &'a Tree) -> Self {
        let mut parts = Vec::new();
        let mut level: Vec<Range<usize>> = std::iter::once(0..tree.points.len()).collect();
        while level.iter().any(|part| part.len() > LEAF) {
            parts.extend(parallel::map_indices(level.len(), |i| Part::of(&tree.points[level[i].clone()])));
            level = level.into_iter().flat_map(|part| <[_; 2]>::from(halves(part))).collect();
        }
        Sums { tree, parts }
    }

    /// Returns the moments about `query` of the points whose squared distance to it is at most `squared_radius`, in the arithmetic of
    /// [`squared_distance`].
    pub fn within(&self, query: Point, squared_radius: f64) -> Moments {
        let mut moments = Moments::default();
        self.add(0, 0..self.tree.points.len(), query, squared_radius, &mut moments);
        moments
    }

    fn add(&self, number: usize, part: Range<usize>, query: Point, squared_radius: f64, moments: &mut Moments) {
        let mut add = |point: &Point| {
            if squared_distance(*point, query) <= squared_radius {
                moments.add(exact(*point) - exact(query));
            }
        };
        if part.len() <= LEAF {
            return self.tree.points[part].iter().for_each(add);
        }
        let Part { center, moments: own, .. } = &self.parts[number];
        let [nearest, farthest] = self.parts[number].squared_distances(query);
        if farthest <= squared_radius {
            moments.add_all(own, *center - exact(query));
        } else if nearest <= squared_radius {
            let (low, high) = halves(part);
            add(&self.tree.points[low.end]);
            self.add(2 * number + 1, low, query, squared_radius, moments);
            self.add(2 * number + 2, high, query, squared_radius, moments);
        }
    }
}

impl Part {
    fn of(points: &[Point]) -> Self {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for point in points {
            for axis in 0..3 {
                (low[axis], high[axis]) = (low[axis].min(point[axis]), high[axis].max(point[axis]));
            }
        }
        let center = points.iter().map(|point| exact(*point)).sum::<DVec3>() / points.len() as f64;
        let mut moments = Moments::default();
        points.iter().for_each(|point| moments.add(exact(*point) - center));
        Part { low, high, center, moments }
    }

    /// Returns bounds of [`squared_distance`] over all points of the part. Rounding is monotonic, so they hold exactly.
    fn squared_distances(&self, query: Point) -> [f64; 2] {
        let mut squares = [0.0; 2];
        for axis in 0..3 {
            let [low, high] = [self.low, self.high].map(|bound| f64::from(bound[axis] - query[axis]));
            let [nearest, farthest] = [low.max(-high).max(0.0), high.max(-low)];
            squares[0] += nearest * nearest;
            squares[1] += farthest * farthest;
        }
        squares
    }
}

fn exact(point: Point) -> DVec3 {
    DVec3::from(point.map(f64::from))
}
