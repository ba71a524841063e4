//! Spherical harmonics as surfaces, whose distance from the origin in a direction is the absolute value of the function.

use super::text;
use crate::images::Rgb;
use glam::DVec3;
use ndarray::{Array2, Array4, Axis};
use plenoxel::field::sh;
use rayon::iter::{IndexedParallelIterator, IntoParallelRefMutIterator, ParallelIterator};

/// Color of positive values.
const POSITIVE: [f32; 3] = [0.16, 0.42, 0.78];
/// Color of negative values.
const NEGATIVE: [f32; 3] = [0.93, 0.47, 0.13];
/// Color around the surfaces.
const PAPER: f32 = 1.0;
/// Color of labels.
const INK: f32 = 0.25;

/// Radius of the longest lobe, in units of half a cell.
const LONGEST: f64 = 0.92;
/// Number of rays per pixel along each axis.
const RAYS: usize = 2;
/// Number of samples on a ray through the middle, at which the sign of the distance to the surface is evaluated.
const PLACES: usize = 160;
/// Step of the finite differences for the normal, in units of half a cell.
const STEP: f64 = 1e-4;
/// Azimuth and elevation of the eye, in degrees.
const EYE: [f64; 2] = [25.0, 22.0];

/// Picture of all functions up to a degree.
#[derive(Debug, Clone, Copy)]
pub struct Lobes {
    pub degree: usize,
    /// Side of a cell in pixels.
    pub size: usize,
}

/// World directions of the picture: right, up, and towards the eye.
struct Axes {
    right: DVec3,
    up: DVec3,
    eye: DVec3,
}

impl Axes {
    fn new() -> Self {
        let [azimuth, elevation] = EYE.map(f64::to_radians);
        let eye = DVec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
        let right = DVec3::Z.cross(eye).normalize();
        Axes { right, up: eye.cross(right), eye }
    }

    fn point(&self, [x, y, depth]: [f64; 3]) -> DVec3 {
        self.right * x + self.up * y + self.eye * depth
    }
}

impl Lobes {
    /// Draws the picture: one centered row per degree, with its functions from m = -l to m = l.
    pub fn picture(&self) -> Rgb {
        let size = self.size;
        let mut picture = Rgb::from_elem((size * (self.degree + 1), size * (2 * self.degree + 1), 3), PAPER);
        for (function, mut cell) in self.cells().axis_iter_mut(Axis(0)).enumerate() {
            let l = function.isqrt();
            let label = format!("l={l} m={}", function as i64 - (l * (l + 1)) as i64);
            text::write(&mut cell, &label, (size / 100).max(1), INK);
            let [top, left] = self.corner(function);
            for ((row, column, c), value) in cell.indexed_iter() {
                picture[[top + row, left + column, c]] = *value;
            }
        }
        picture
    }

    /// Row and column of the first pixel of a function's cell.
    fn corner(&self, function: usize) -> [usize; 2] {
        let l = function.isqrt();
        [l * self.size, (self.degree - l + function - l * l) * self.size]
    }

    /// Draws the cells of all functions, `[function, row, column, channel]`.
    fn cells(&self) -> Array4<f32> {
        let functions = sh::count(self.degree);
        let mut cells = Array4::zeros((self.size, functions, self.size, 3));
        // One row of pixels at a time, so that memory does not grow with the square of the size.
        let mut rows: Vec<_> = cells.axis_iter_mut(Axis(0)).collect();
        rows.par_iter_mut().enumerate().for_each(|(row, out)| {
            for k in 0..RAYS * RAYS {
                let [down, across] = [k / RAYS, k % RAYS].map(|k| (k as f64 + 0.5) / RAYS as f64);
                let place = |pixel: usize, part: f64| 2.0 * (pixel as f64 + part) / self.size as f64 - 1.0;
                let seen = self.along(-place(row, down), &(0..self.size).map(|column| place(column, across)).collect::<Vec<_>>());
                out.zip_mut_with(&seen, |sum, seen| *sum += seen / (RAYS * RAYS) as f32);
            }
        });
        drop(rows);
        cells.permuted_axes([1, 0, 2, 3])
    }

    /// Colors of the rays at one height, `[function, place, channel]`.
    fn along(&self, y: f64, across: &[f64]) -> Rgb {
        let axes = Axes::new();
        let mut rays = Vec::new();
        for (column, &x) in across.iter().enumerate() {
            let reach = (1.0 - x * x - y * y).max(0.0).sqrt();
            let count = (reach * PLACES as f64).ceil() as usize;
            // From the eye to the back. An even number of steps would hit the origin, which has no direction.
            rays.extend((0..=2 * count).map(|k| (column, [x, y, reach * (1.0 - (k as f64 + 0.25) / (count.max(1) as f64))])));
        }
        let points: Vec<DVec3> = rays.iter().map(|(_, place)| axes.point(*place)).collect();
        let inside = self.inside(&points);
        let mut colors = Rgb::from_elem((sh::count(self.degree), across.len(), 3), PAPER);
        for (function, mut colors) in colors.axis_iter_mut(Axis(0)).enumerate() {
            let mut found = vec![None; across.len()];
            for (i, &(column, [x, y, depth])) in rays.iter().enumerate() {
                if found[column].is_none() && inside[[i, function]] >= 0.0 {
                    // The surface is between this sample and the previous one, if that is on the same ray.
                    let before = i.checked_sub(1).filter(|before| rays[*before].0 == column);
                    let depth = before.map_or(depth, |before| {
                        let [a, b] = [inside[[before, function]], inside[[i, function]]];
                        rays[before].1[2] + (depth - rays[before].1[2]) * (-a / (b - a).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
                    });
                    found[column] = Some(axes.point([x, y, depth]));
                }
            }
            let hits: Vec<(usize, DVec3)> = found.into_iter().enumerate().filter_map(|(column, hit)| Some((column, hit?))).collect();
            for ((column, _), color) in hits.iter().zip(self.shaded(function, &hits, &axes)) {
                (0..3).for_each(|c| colors[[*column, c]] = color[c]);
            }
        }
        colors
    }

    /// Returns the signed distance of places to the surface of each function along the line to the origin, positive inside, as `[place, function]`.
    fn inside(&self, points: &[DVec3]) -> Array2<f64> {
        let mut values = self.values(points);
        for (mut row, point) in values.axis_iter_mut(Axis(0)).zip(points) {
            row.mapv_inplace(|value| value.abs() * self.scale() - point.length());
        }
        values
    }

    /// Evaluates the functions in the directions of places, `[place, function]`.
    fn values(&self, points: &[DVec3]) -> Array2<f64> {
        let directions: Vec<DVec3> = points.iter().map(|point| point.try_normalize().unwrap_or(DVec3::Z)).collect();
        let directions = Array2::from_shape_fn((points.len(), 3), |(i, axis)| directions[i][axis]);
        sh::values(directions.view(), self.degree)
    }

    /// Returns the length of a value of 1, in units of half a cell. The squares of the functions of degree l sum to (2l + 1) / 4π in every direction. In
    /// direction z only m = 0 is not 0, so this is the largest square.
    fn scale(&self) -> f64 {
        LONGEST / ((2 * self.degree + 1) as f64 / (4.0 * std::f64::consts::PI)).sqrt()
    }

    /// Shades places on the surface of a function.
    fn shaded(&self, function: usize, hits: &[(usize, DVec3)], axes: &Axes) -> Vec<[f32; 3]> {
        let around = hits.iter().flat_map(|(_, hit)| DVec3::AXES.map(|axis| [*hit + axis * STEP, *hit - axis * STEP])).flatten();
        let distances = self.inside(&around.collect::<Vec<_>>());
        let values = self.values(&hits.iter().map(|(_, hit)| *hit).collect::<Vec<_>>());
        let light = axes.point([-0.45, 0.65, 0.7]).normalize();
        let halfway = (light + axes.eye).normalize();
        let shade = |i: usize| {
            let difference = |axis: usize| distances[[6 * i + 2 * axis + 1, function]] - distances[[6 * i + 2 * axis, function]];
            let normal = DVec3::new(difference(0), difference(1), difference(2)).normalize_or_zero();
            let matt = 0.35 + 0.65 * normal.dot(light).max(0.0);
            let gloss = 0.25 * normal.dot(halfway).max(0.0).powi(30);
            let color = if values[[i, function]] < 0.0 { NEGATIVE } else { POSITIVE };
            color.map(|c| (c * matt as f32 + gloss as f32).min(1.0))
        };
        (0..hits.len()).map(shade).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOBES: Lobes = Lobes { degree: 3, size: 48 };

    #[derive(Debug, PartialEq)]
    enum Seen {
        Positive,
        Negative,
        Paper,
    }

    /// Returns the content of a pixel.
    fn seen(picture: &Rgb, [row, column]: [usize; 2]) -> Seen {
        let [red, green, blue] = [0, 1, 2].map(|c| picture[[row, column, c]]);
        match (red - blue).abs() < 0.02 && green > 0.9 {
            true => Seen::Paper,
            false if blue > red => Seen::Positive,
            false => Seen::Negative,
        }
    }

    /// The pixel of a function's cell that shows a place, given in units of half a cell.
    fn pixel(function: usize, place: DVec3) -> [usize; 2] {
        let axes = Axes::new();
        let half = 0.5 * LOBES.size as f64;
        let [top, left] = LOBES.corner(function);
        [top + (half - half * place.dot(axes.up)) as usize, left + (half + half * place.dot(axes.right)) as usize]
    }

    #[test]
    fn lobes_have_the_signs_of_svox2() {
        let picture = LOBES.picture();
        let at = |function: usize, x: f64, y: f64, z: f64| seen(&picture, pixel(function, 0.4 * DVec3::new(x, y, z).normalize()));
        assert_eq!(at(0, 0.0, 0.1, 0.1), Seen::Positive);
        // -y, z, -x.
        assert_eq!([at(1, 0.0, 1.0, 0.0), at(1, 0.0, -1.0, 0.0)], [Seen::Negative, Seen::Positive]);
        assert_eq!([at(2, 0.0, 0.0, 1.0), at(2, 0.0, 0.0, -1.0)], [Seen::Positive, Seen::Negative]);
        assert_eq!([at(3, 1.0, 0.0, 0.0), at(3, -1.0, 0.0, 0.0)], [Seen::Negative, Seen::Positive]);
        // xy, -yz, and x² - y² along its axes; 2z² - x² - y² has a positive lobe on each side of a negative ring.
        assert_eq!([at(4, 1.0, 1.0, 0.0), at(4, -1.0, 1.0, 0.0)], [Seen::Positive, Seen::Negative]);
        assert_eq!([at(5, 0.0, 1.0, 1.0), at(5, 0.0, 1.0, -1.0)], [Seen::Negative, Seen::Positive]);
        assert_eq!([at(6, 0.0, 0.0, 1.0), at(6, 0.0, 0.0, -1.0)], [Seen::Positive, Seen::Positive]);
        assert_eq!([at(8, 1.0, 0.0, 0.0), at(8, 0.0, 1.0, 0.0)], [Seen::Positive, Seen::Negative]);
        // z (2z² - 3x² - 3y²).
        assert_eq!([at(12, 0.0, 0.0, 1.0), at(12, 0.0, 0.0, -1.0)], [Seen::Positive, Seen::Negative]);
        // The space between the lobes of z is empty.
        assert_eq!(at(2, 0.0, 1.0, 0.0), Seen::Paper);
    }

    #[test]
    fn outlines_are_symmetric_about_the_middle_and_those_of_m_0_about_the_vertical() {
        let cells = LOBES.cells();
        let n = LOBES.size;
        for function in 0..16 {
            let cell = cells.index_axis(Axis(0), function).to_owned();
            let covered = |row: usize, column: usize| seen(&cell, [row, column]) != Seen::Paper;
            let pixels = || (0..n * n).map(|i| (i / n, i % n));
            let all = pixels().filter(|&(row, column)| covered(row, column)).count();
            let turned = pixels().filter(|&(row, column)| covered(row, column) != covered(n - 1 - row, n - 1 - column)).count();
            let mirrored = pixels().filter(|&(row, column)| covered(row, column) != covered(row, n - 1 - column)).count();
            assert!(all > 60 && turned <= all / 20, "function {function}: {turned} of {all}");
            assert!(mirrored <= all / 20 || ![0, 2, 6, 12].contains(&function), "function {function}: {mirrored} of {all}");
            // The lobes of -yz and -xz lean to one side.
            assert!(mirrored > all / 10 || ![5, 7].contains(&function), "function {function}: {mirrored} of {all}");
        }
    }

    #[test]
    fn rows_are_centred() {
        let picture = LOBES.picture();
        assert_eq!(picture.dim(), (4 * 48, 7 * 48, 3));
        assert_eq!(
            [0, 1, 3, 4, 9, 15].map(|function| LOBES.corner(function)),
            [[0, 144], [48, 96], [48, 192], [96, 48], [144, 0], [144, 288]]
        );
        let is_paper = |row: usize, columns: std::ops::Range<usize>| columns.into_iter().all(|column| picture[[row, column, 0]] == PAPER);
        assert!((0..48).all(|row| is_paper(row, 0..144) && is_paper(row, 192..336)));
        assert!(!is_paper(24, 144..192) && !is_paper(168, 0..48) && !is_paper(168, 288..336));
    }
}
