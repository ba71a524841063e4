//! Point cloud filters as defined by CloudCompare (CCCoreLib, `CloudSamplingTools.cpp`). The same settings keep the same points, except for
//! noise at the limit of rounding: see [`NoiseError`].
//!
//! Filters are applied in the order box, value, noise, statistical outliers, each to the points that the previous filter kept. Like
//! CloudCompare, the filters use 32-bit coordinates, shifted if they are large. The cloud itself keeps its coordinates.

use super::sums::Sums;
use super::tree::Tree;
use crate::error::{Error, Result};
use crate::geometry::Aabb;
use autograd::parallel;
use glam::DVec3;

/// Number of points per task.
const RUN: usize = 4096;

/// Filters to apply; the default removes nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Filters {
    /// Removes points outside of the box. Faces belong to the box.
    pub within: Option<Aabb>,
    /// Removes points whose value is out of range.
    pub value: Option<Range>,
    /// Removes points off the surface formed by their neighbours.
    pub noise: Option<Noise>,
    /// Removes points far from others.
    pub outliers: Option<Outliers>,
}

/// Filter by value: keeps low ≤ v ≤ high, compared in 32 bits. Removes NaN.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Smallest value that is kept.
    pub low: f64,
    /// Largest value that is kept.
    pub high: f64,
}

/// Noise filter. The neighbours of a point are the other points within `radius`. A point with at least three neighbours is kept if its
/// distance to the least-squares plane of the neighbours is at most `error`. It is removed if it has exactly three neighbours A, B and C
/// that define no plane,
/// |AB × AC|² below 2⁻²³. This bound is CloudCompare's and depends on the unit of length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Radius of the neighbourhood, in units of the coordinates.
    pub radius: f64,
    /// Largest distance of a kept point from the plane.
    pub error: NoiseError,
    /// Removes points with fewer than three neighbours; otherwise they are kept.
    pub remove_isolated: bool,
}

/// Largest distance of a kept point from the plane of its neighbours. Distances that differ by less than the rounding of the coordinates, 8
/// · 2⁻²³ of the largest coordinate, count as equal. On a lattice this decides about whole edges; in CloudCompare, rounding decides.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NoiseError {
    /// Distance in units of the coordinates.
    Absolute(f64),
    /// Multiple of the standard deviation of the neighbours' distances to the plane; CloudCompare's default is 1.
    Relative(f64),
}

/// Statistical outlier removal (SOR). d is the mean distance of a point to its nearest `neighbours` − 1 other points (the point itself
/// counts as one, as in PCL). A point is kept if d ≤ mean of d + `sigma` · standard deviation of d, both over all points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outliers {
    /// Number of nearest points, including the point itself.
    pub neighbours: usize,
    /// Number of standard deviations above the mean.
    pub sigma: f64,
}

/// Result of a filter: numbers of points.
#[derive(Clone, Debug, PartialEq)]
pub struct Kept {
    /// Name of the filter.
    pub filter: &'static str,
    /// Number of points before the filter.
    pub before: usize,
    /// Number of points after the filter.
    pub after: usize,
}

impl Filters {
    /// Returns an upper estimate of the memory of [`Filters::apply`], bytes per point, without coordinates and values.
    pub(super) fn memory(&self) -> u64 {
        // Numbers of the remaining points, and a flag for each.
        const LEFT: u64 = 5;
        // Local coordinates; points and numbers in the order of the tree; axes of the tree; and its input, the first two once more.
        const TREE: u64 = 12 + 16 + 1 + 16;
        // Local coordinates, the tree, its sums with their ranges, and the result.
        const NOISE: u64 = 12 + 17 + 31 + 2;
        LEFT + match self {
            Filters { noise: Some(_), .. } => NOISE,
            Filters { outliers: Some(_), .. } => TREE,
            _ => 0,
        }
    }

    /// Applies the filters. Returns the numbers of the kept points, ascending, and the result of each filter. `values` are the values for
    /// [`Filters::value`], one per point. Points whose coordinates are not finite, or too large for 32 bits, are removed first.
    ///
    /// Errors if there is a value filter but no values, or if the number of neighbours is not below the number of points.
    pub fn apply(&self, positions: &[DVec3], values: Option<&[f32]>) -> Result<(Vec<u32>, Vec<Kept>)> {
        let mut left: Vec<u32> = (0..positions.len() as u32).collect();
        let mut report = Vec::new();
        let mut filter = |name: &'static str, left: &mut Vec<u32>, keep: &dyn Fn(&[u32]) -> Result<Vec<bool>>| -> Result<()> {
            let before = left.len();
            let mut keep = keep(left)?.into_iter();
            left.retain(|_| keep.next().unwrap_or(false));
            report.push(Kept { filter: name, before, after: left.len() });
            Ok(())
        };
        let position = |i: &u32| positions[*i as usize];
        let finite = |p: DVec3| p.abs().cmple(DVec3::splat(LARGEST)).all();
        if !positions.iter().all(|p| finite(*p)) {
            filter("finite", &mut left, &|left| Ok(left.iter().map(|i| finite(position(i))).collect()))?;
        }
        if let Some(within) = self.within {
            filter("bbox", &mut left, &|left| Ok(left.iter().map(|i| within.contains(position(i))).collect()))?;
        }
        if let Some(range) = self.value {
            let values = values.ok_or_else(|| Error::usage("min_value", "the cloud has no values", "use a cloud with a scalar field"))?;
            let (low, high) = (range.low as f32, range.high as f32);
            filter("value", &mut left, &|left| Ok(left.iter().map(|&i| (low..=high).contains(&values[i as usize])).collect()))?;
        }
        if let Some(noise) = self.noise {
            filter("noise", &mut left, &|left| Ok(noise.keep(&local(positions, left))))?;
        }
        if let Some(outliers) = self.outliers {
            filter("sor", &mut left, &|left| outliers.keep(&local(positions, left)))?;
        }
        Ok((left, report))
    }
}

/// Largest accepted coordinate. Differences of larger coordinates may overflow in 32 bits: a point would not be near itself.
const LARGEST: f64 = 0.25 * f32::MAX as f64;

/// Converts coordinates to 32 bits. Like in CloudCompare, large coordinates are shifted, which preserves distances and their digits.
fn local(positions: &[DVec3], chosen: &[u32]) -> Vec<[f32; 3]> {
    const LARGE: f64 = 1e4;
    let chosen = || chosen.iter().map(|&i| positions[i as usize]);
    let shift = match chosen().any(|p| p.abs().max_element() >= LARGE) {
        true => chosen().fold(DVec3::INFINITY, DVec3::min).floor(),
        false => DVec3::ZERO,
    };
    chosen().map(|p| (p - shift).as_vec3().to_array()).collect()
}

impl Noise {
    /// Returns which points are kept.
    fn keep(&self, points: &[[f32; 3]]) -> Vec<bool> {
        let tree = Tree::new(points);
        let largest = points.iter().flatten().fold(0.0f32, |largest, x| largest.max(x.abs()));
        let rounding = 8.0 * f64::from(f32::EPSILON * largest);
        // The radius is a 32-bit number too.
        let squared_radius = f64::from(self.radius as f32).powi(2);
        let sums = Sums::new(&tree);
        of_each(&tree, |point| {
            let mut moments = sums.within(point, squared_radius);
            // Relative to itself, the point adds nothing but its count.
            moments.count -= 1;
            if moments.count < 3 {
                return !self.remove_isolated;
            }
            moments.plane().is_some_and(|plane| {
                let limit = match self.error {
                    NoiseError::Absolute(error) => error,
                    NoiseError::Relative(sigma) => sigma * plane.deviation,
                };
                plane.normal.dot(plane.center).abs() <= limit + rounding
            })
        })
    }
}

impl Outliers {
    /// Returns which points are kept. Means and their squares are rounded to 32 bits and then summed in 64 bits, as in CloudCompare.
    fn keep(&self, points: &[[f32; 3]]) -> Result<Vec<bool>> {
        let k = self.neighbours;
        if k < 2 || k >= points.len() {
            let expected = format!("2 or more, and fewer than the {} points that the other filters kept", points.len());
            return Err(Error::config("sor_neighbours", k, expected));
        }
        let tree = Tree::new(points);
        let distances = of_each(&tree, |point| {
            let mut nearest = vec![0.0; k];
            tree.nearest(point, &mut nearest);
            // The first distance is that of the point itself, or of a coincident point.
            (nearest[1..].iter().map(|d| d.sqrt()).sum::<f64>() / (k - 1) as f64) as f32
        });
        let n = points.len() as f64;
        let (sum, squares) = distances.iter().fold((0.0, 0.0), |(sum, squares), &d| (sum + f64::from(d), squares + f64::from(d * d)));
        let mean = sum / n;
        let limit = mean + self.sigma * (squares / n - mean * mean).abs().sqrt();
        Ok(distances.iter().map(|&d| f64::from(d) <= limit).collect())
    }
}

/// Returns `f(point)` of every point, by number. Points are processed in the order of the tree, so that neighbours share caches.
fn of_each<R: Copy + Default + Send + Sync>(tree: &Tree, f: impl Fn([f32; 3]) -> R + Sync + Send) -> Vec<R> {
    let n = tree.points.len();
    let found = parallel::map_chunks(n, RUN, |range| -> Vec<R> { tree.points[range].iter().map(|&point| f(point)).collect() });
    let mut by_number = vec![R::default(); n];
    tree.numbers.iter().zip(found.into_iter().flatten()).for_each(|(&number, r)| by_number[number as usize] = r);
    by_number
}

#[cfg(test)]
mod tests;
