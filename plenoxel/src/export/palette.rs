//! Color quantization: an exact palette if there are few colors, otherwise recursive cutting of boxes, refined by k-means.

use autograd::parallel;
use glam::DVec3;

/// Returns a palette of at most `most` colors, and the entry of each of `colors`, with a small squared error over sRGB bytes.
///
/// The box of colors with the largest squared error is repeatedly cut in two where that reduces the error most (Wu 1992). Entries then move
/// to the means of the colors nearest to them (Lloyd 1982). There is no random initialization: the same colors give the same palette. Equal
/// colors share an entry. If there are at most `most` different colors, the palette is exact. `most` must not exceed 256, because entries
/// are bytes.
pub fn quantize(colors: &[[u8; 3]], most: usize) -> (Vec<[u8; 3]>, Vec<u8>) {
    let mut distinct = colors.to_vec();
    distinct.sort_unstable();
    distinct.dedup();
    let place = |color: &[u8; 3]| distinct.binary_search(color).unwrap_or(0);
    let (palette, entries) = if distinct.len() <= most {
        (distinct.clone(), (0..distinct.len() as u32).collect())
    } else {
        let mut counts = vec![0u32; distinct.len()];
        colors.iter().for_each(|color| counts[place(color)] += 1);
        reduce(&distinct, &counts, most)
    };
    let entries = colors.iter().map(|color| entries[place(color)] as u8).collect();
    (palette, entries)
}

/// Number of k-means rounds. Further rounds change the error of real scenes by less than 1 %.
const ROUNDS: usize = 8;

/// Returns the palette of distinct colors with counts, and the entry of each.
fn reduce(colors: &[[u8; 3]], counts: &[u32], most: usize) -> (Vec<[u8; 3]>, Vec<u32>) {
    let points: Vec<(DVec3, f64)> =
        colors.iter().zip(counts).map(|(color, &count)| (DVec3::from(color.map(f64::from)), f64::from(count))).collect();
    let mut means = cut_boxes(&points, most);
    let mut nearest = assign(&points, &means);
    for _ in 0..ROUNDS {
        let mut sums = vec![(DVec3::ZERO, 0.0); means.len()];
        for (&(point, weight), &entry) in points.iter().zip(&nearest) {
            sums[entry as usize].0 += weight * point;
            sums[entry as usize].1 += weight;
        }
        for (mean, (sum, weight)) in means.iter_mut().zip(sums) {
            // A mean without points does not move.
            *mean = if weight > 0.0 { sum / weight } else { *mean };
        }
        nearest = assign(&points, &means);
    }
    (means.iter().map(|mean| mean.to_array().map(|c| c.round() as u8)).collect(), nearest)
}

/// Returns the number of the nearest mean for each point; the first if several are equally near.
fn assign(points: &[(DVec3, f64)], means: &[DVec3]) -> Vec<u32> {
    let mut nearest = vec![0; points.len()];
    parallel::for_each_chunk(&mut nearest, 1024, |first, chunk| {
        for (nearest, (point, _)) in chunk.iter_mut().zip(&points[first..]) {
            let mut best = f64::INFINITY;
            for (entry, mean) in means.iter().enumerate() {
                let distance = point.distance_squared(*mean);
                if distance < best {
                    (best, *nearest) = (distance, entry as u32);
                }
            }
        }
    });
    nearest
}

/// Returns the means of `most` boxes, or of fewer if each box has only one color.
fn cut_boxes(points: &[(DVec3, f64)], most: usize) -> Vec<DVec3> {
    let mut boxes = vec![Cell::new(points.to_vec())];
    while boxes.len() < most {
        let several = boxes.iter().enumerate().filter(|(_, b)| b.points.len() > 1);
        let Some((worst, _)) = several.max_by(|(_, a), (_, b)| a.error.total_cmp(&b.error)) else {
            break;
        };
        let [low, high] = boxes.swap_remove(worst).cut();
        boxes.extend([low, high]);
    }
    boxes.into_iter().map(|b| b.mean).collect()
}

/// Set of points, with their mean and the sum of their squared distances from it.
struct Cell {
    points: Vec<(DVec3, f64)>,
    mean: DVec3,
    error: f64,
}

impl Cell {
    fn new(points: Vec<(DVec3, f64)>) -> Self {
        let weight: f64 = points.iter().map(|(_, weight)| weight).sum();
        let mean = points.iter().map(|&(point, weight)| weight * point).sum::<DVec3>() / weight;
        let error = points.iter().map(|&(point, weight)| weight * point.distance_squared(mean)).sum();
        Cell { points, mean, error }
    }

    /// Splits the points by the plane across an axis that leaves the smallest squared error, with at least one point on each side.
    fn cut(self) -> [Self; 2] {
        let weight: f64 = self.points.iter().map(|(_, weight)| weight).sum();
        let sum = weight * self.mean;
        let (mut best, mut low, mut points) = (f64::NEG_INFINITY, Vec::new(), self.points);
        let mut high = Vec::new();
        for axis in 0..3 {
            points.sort_by(|(a, _), (b, _)| a[axis].total_cmp(&b[axis]));
            let (mut before, mut left) = (DVec3::ZERO, 0.0);
            let mut place = None;
            for (i, pair) in points.windows(2).enumerate() {
                let (point, count) = pair[0];
                (before, left) = (before + count * point, left + count);
                // The error decreases by what the two means explain.
                let gain = before.length_squared() / left + (sum - before).length_squared() / (weight - left);
                if pair[1].0[axis] > point[axis] && gain > best {
                    (best, place) = (gain, Some(i + 1));
                }
            }
            if let Some(place) = place {
                (low, high) = (points[..place].to_vec(), points[place..].to_vec());
            }
        }
        [Cell::new(low), Cell::new(high)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, uniform};

    #[test]
    fn few_colors_are_kept_as_they_are() {
        let colors = [[9, 8, 7], [0, 0, 0], [9, 8, 7], [255, 255, 255]];
        let (palette, entries) = quantize(&colors, 3);
        assert_eq!(palette.len(), 3);
        let back: Vec<_> = entries.iter().map(|&entry| palette[entry as usize]).collect();
        assert_eq!(back, colors);
    }

    #[test]
    fn clusters_get_an_entry_each_and_a_rare_one_is_not_lost() {
        let noise = |i: u64, axis: u64| (7.0 * uniform(1, Purpose::Initial, axis, i)) as u8;
        let centers = [[20, 30, 40], [200, 40, 30], [240, 240, 20], [90, 160, 220]];
        // One color in a thousand belongs to the last cluster.
        let of = |i: u64| if i.is_multiple_of(1000) { 3 } else { (i % 3) as usize };
        let colors: Vec<[u8; 3]> = (0..5000).map(|i| [0, 1, 2].map(|axis| centers[of(i)][axis] + noise(i, axis as u64))).collect();
        let (palette, entries) = quantize(&colors, 4);
        assert_eq!(palette.len(), 4);
        for (color, entry) in colors.iter().zip(entries) {
            assert!(color.iter().zip(palette[entry as usize]).all(|(a, b)| a.abs_diff(b) <= 6), "{color:?}");
        }
    }

    #[test]
    fn a_cube_of_colors_costs_at_most_half_more_than_with_the_best_palette() {
        // 12³ colors of a regular cube with 216 = 6³ entries: 2 x 2 x 2 colors share an entry, which differs from each by half a step of 20
        // along each axis.
        let colors: Vec<[u8; 3]> = (0..12 * 12 * 12).map(|c| [c / 144 * 20, c / 12 % 12 * 20, c % 12 * 20].map(|v| v as u8)).collect();
        let (palette, entries) = quantize(&colors, 216);
        let error = |(color, entry): (&[u8; 3], &u8)| {
            (0..3).map(|a| f64::from(color[a].abs_diff(palette[*entry as usize][a])).powi(2)).sum::<f64>()
        };
        let mean = colors.iter().zip(&entries).map(error).sum::<f64>() / colors.len() as f64;
        assert!(mean <= 1.5 * 3.0 * 100.0, "squared error {mean}");
    }
}
