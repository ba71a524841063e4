//! The filters with which people clean point clouds, as CloudCompare defines them (CCCoreLib, `CloudSamplingTools.cpp`): the same settings
//! keep the same points, but for noise that nobody can decide: see [`NoiseError`].
//!
//! Each filter looks at the points that the one before has left, in this order: box, value, noise, statistical outliers.
//! CloudCompare stores coordinates in 32 bits, shifted where they are large, and so do the filters; the cloud itself keeps its own.

use super::sums::Sums;
use super::tree::Tree;
use crate::error::{Error, Result};
use crate::geometry::Aabb;
use autograd::parallel;
use glam::DVec3;

/// Points that one task looks at.
const RUN: usize = 4096;

/// What to remove; the default removes nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Filters {
    /// Points outside of the box; its faces belong to it.
    pub within: Option<Aabb>,
    /// Points whose value is not in the range.
    pub value: Option<Range>,
    /// Points off the surface that their neighbours make.
    pub noise: Option<Noise>,
    /// Points far from others.
    pub outliers: Option<Outliers>,
}

/// Filter by value: keeps low ≤ v ≤ high, compared in 32 bits; a value that is no number goes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// The smallest value that stays.
    pub low: f64,
    /// The largest value that stays.
    pub high: f64,
}

/// Noise filter. The neighbours of a point are the others within `radius`. If there are at least three, the point stays if its distance to
/// the plane nearest to them is at most `error`. If there are three that make no plane, A, B and C with |AB × AC|² below 2⁻²³, it goes: the
/// bound is CloudCompare's and depends on the unit of length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Distance within which points are neighbours, in the units of the coordinates.
    pub radius: f64,
    /// How far from the plane a point may be.
    pub error: NoiseError,
    /// Removes points with fewer than three neighbours; else they stay.
    pub remove_isolated: bool,
}

/// How far from the plane of its neighbours a point may be. Distances count as equal that differ by less than the rounding of the coordinates,
/// 8 · 2⁻²³ of the largest:
/// on a lattice that decides about whole edges, and CloudCompare lets chance decide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NoiseError {
    /// In the units of the coordinates.
    Absolute(f64),
    /// In standard deviations of the neighbours' own distances to the plane; CloudCompare's default is 1.
    Relative(f64),
}

/// Statistical outlier removal (SOR): d is the mean distance of a point to its nearest `neighbours` − 1 others (the point itself counts as
/// one, as in PCL); it stays if d ≤ mean of d + `sigma` · standard deviation of d, both over all points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outliers {
    /// Nearest points, the point itself among them.
    pub neighbours: usize,
    /// Standard deviations above the mean.
    pub sigma: f64,
}

/// How many points one filter kept.
#[derive(Clone, Debug, PartialEq)]
pub struct Kept {
    /// Name of the filter.
    pub filter: &'static str,
    /// Points before it.
    pub before: usize,
    /// Points after it.
    pub after: usize,
}

impl Filters {
    /// Numbers of the points that stay, ascending, and what each filter did. `values` are those that [`Filters::value`] looks at, one for
    /// each point. Points whose coordinates are no numbers, or none of 32 bits, go first of all.
    ///
    /// Errors: a value filter without values; as many neighbours asked for as there are points.
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

/// Coordinates beyond this may have differences that 32 bits do not hold: then a point would not be near itself.
const LARGEST: f64 = 0.25 * f32::MAX as f64;

/// The coordinates in 32 bits. As CloudCompare does it, large ones are shifted, which changes no distance but keeps its digits.
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
    /// Which points stay.
    fn keep(&self, points: &[[f32; 3]]) -> Vec<bool> {
        let tree = Tree::new(points);
        let largest = points.iter().flatten().fold(0.0f32, |largest, x| largest.max(x.abs()));
        let rounding = 8.0 * f64::from(f32::EPSILON * largest);
        // The radius is a 32-bit number too.
        let squared_radius = f64::from(self.radius as f32).powi(2);
        let sums = Sums::new(&tree);
        of_each(&tree, |point| {
            let mut moments = sums.within(point, squared_radius);
            // About itself, the point adds nothing but its number.
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
    /// Which points stay. The means are rounded to 32 bits, and so are their squares, before they are added up in 64, as in CloudCompare.
    fn keep(&self, points: &[[f32; 3]]) -> Result<Vec<bool>> {
        let k = self.neighbours;
        if k < 2 || k >= points.len() {
            let accepted = format!("2 or more, and fewer than the {} points that are left", points.len());
            return Err(Error::config("sor_neighbours", k, accepted));
        }
        let tree = Tree::new(points);
        let distances = of_each(&tree, |point| {
            let mut nearest = vec![0.0; k];
            tree.nearest(point, &mut nearest);
            // The first is the point itself, or one that coincides with it.
            (nearest[1..].iter().map(|d| d.sqrt()).sum::<f64>() / (k - 1) as f64) as f32
        });
        let n = points.len() as f64;
        let (sum, squares) = distances.iter().fold((0.0, 0.0), |(sum, squares), &d| (sum + f64::from(d), squares + f64::from(d * d)));
        let mean = sum / n;
        let limit = mean + self.sigma * (squares / n - mean * mean).abs().sqrt();
        Ok(distances.iter().map(|&d| f64::from(d) <= limit).collect())
    }
}

/// `f(point)` of every point, by number. Points are taken in the order of the tree, in which neighbours share caches.
fn of_each<R: Copy + Default + Send + Sync>(tree: &Tree, f: impl Fn([f32; 3]) -> R + Sync + Send) -> Vec<R> {
    let n = tree.points.len();
    let found = parallel::map_chunks(n, RUN, |range| -> Vec<R> { tree.points[range].iter().map(|&point| f(point)).collect() });
    let mut by_number = vec![R::default(); n];
    tree.numbers.iter().zip(found.into_iter().flatten()).for_each(|(&number, r)| by_number[number as usize] = r);
    by_number
}

#[cfg(test)]
mod tests;
