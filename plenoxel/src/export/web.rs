//! Compressed grid for the viewer of a page. It can be converted back, which measures the loss of compression.
//!
//! It contains only voxels that a sample with a density above 0 can read. Densities are half floats in units of 1 / voxel side, which makes
//! them independent of the world's unit, rounded to 6 of their 10 bits. The coefficient of degree 0 of each channel is one byte between the
//! smallest and the largest value in the grid. A coefficient of degree 1 or more is one byte b for (b − 128) steps, so that 0 stays 0. The
//! largest coefficient is 127 steps, or 63 or 31 if that makes the data small enough: bytes that use few of their values compress well.
//!
//! The bytes are a zlib stream. It contains first the voxels, then the harmonics, if any. Each begins with its places, unless the harmonics
//! share those of the voxels: one bit per brick of 4³, bricks in row-major order and the lowest bit first; then 64 bits for each brick that
//! has nodes, little-endian ([`Lattice::masks`]). Values follow, one kind after another, nodes in the order of their places: low bytes of
//! the densities, high bytes, red, green, blue; or harmonic 1 of red, green and blue, then harmonic 2, and so on.

use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use autograd::lattice::{BRICK_ROWS, bits};
use autograd::{Lattice, Tensor};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use half::f16;
use serde::Serialize;
use std::io::{self, Write};

/// Number of steps up to the largest harmonic: the most, and the fewest.
const FINEST: u8 = 127;
const COARSEST: u8 = 31;

/// Compressed grid.
#[derive(Debug)]
pub struct WebGrid {
    shape: GridShape,
    lattice: Lattice,
    harmonics_lattice: Option<Lattice>,
    /// Densities times the side of a voxel.
    density: Vec<f16>,
    means: Vec<Column>,
    /// Harmonics in the order of the bytes: red, green and blue of harmonic 1, then of harmonic 2, and so on.
    harmonics: Vec<Column>,
}

/// One number of each voxel as a byte: `zero + byte · step`.
#[derive(Debug)]
struct Column {
    bytes: Vec<u8>,
    zero: f32,
    step: f32,
}

/// Header that describes the bytes.
#[derive(Debug, Serialize)]
pub struct WebHeader {
    resolution: usize,
    half_width: f64,
    interpolation: Interpolation,
    /// Degree of the harmonics; `None` for RGB colors.
    degree: Option<usize>,
    /// Color of zero coefficients; 0 for RGB colors.
    offset: f64,
    /// Number of voxels in the page.
    pub voxels: usize,
    /// Mean colors: value of byte 0, and size of a step, for red, green and blue.
    zeros: Vec<f32>,
    steps: Vec<f32>,
    harmonics: Option<WebHarmonics>,
}

/// Description of the bytes of the harmonics.
#[derive(Debug, Serialize)]
struct WebHarmonics {
    resolution: usize,
    /// Reduction of the harmonics; 1 if they have the places of the voxels.
    reduction: usize,
    voxels: usize,
    /// Size of a step, for red, green and blue of harmonic 1, then of harmonic 2, and so on. Byte 128 is 0.
    steps: Vec<f32>,
}

impl WebGrid {
    /// Compresses the visible voxels of a grid. `harmonic_steps` is the number of steps up to the largest harmonic, at most 127.
    pub fn new(grid: &VoxelGrid<f32>, harmonic_steps: u8) -> Self {
        let seen = grid.pruned(&grid.occupancy(0.0));
        let shape = *seen.shape();
        let side = shape.voxel_side() as f32;
        let (lattice, harmonics_lattice) = (seen.lattice().clone(), seen.harmonics_lattice().cloned());
        let rows = rows(&lattice);
        let column = |table: &Tensor<f32>, rows: &[usize], at: usize| -> Vec<f32> {
            let width = table.shape()[1];
            rows.iter().map(|row| table.data()[row * width + at]).collect()
        };
        let density = column(seen.density.tensor(), &rows, 0).into_iter().map(|density| rounded(density * side)).collect();
        let color = seen.color.tensor();
        let stride = shape.color_width() / 3;
        let means = (0..3).map(|channel| Column::between(&column(color, &rows, channel * stride))).collect();
        let count = shape.color.channels() / 3;
        let kinds = (1..count).flat_map(|k| (0..3).map(move |channel| (k, channel)));
        let harmonics = match (&seen.harmonics, &harmonics_lattice) {
            (Some(table), Some(lattice)) => {
                let rows = self::rows(lattice);
                kinds
                    .map(|(k, channel)| Column::around_zero(&column(table.tensor(), &rows, channel * (count - 1) + k - 1), harmonic_steps))
                    .collect()
            }
            _ => kinds.map(|(k, channel)| Column::around_zero(&column(color, &rows, channel * count + k), harmonic_steps)).collect(),
        };
        WebGrid { shape, lattice, harmonics_lattice, density, means, harmonics }
    }

    /// Compresses a grid to at most `most` bytes. Until it fits, it uses fewer steps for harmonics, then a reduction of harmonics up to 4,
    /// then a lower resolution. Also returns the bytes.
    ///
    /// Never errors in practice, because the bytes are written to memory.
    pub fn within(grid: &VoxelGrid<f32>, most: usize) -> io::Result<(Self, Vec<u8>)> {
        let mut coarser: Option<VoxelGrid<f32>> = None;
        let mut steps = FINEST;
        loop {
            let grid = coarser.as_ref().unwrap_or(grid);
            let shape = grid.shape();
            let small = Self::new(grid, steps);
            let bytes = small.bytes()?;
            if bytes.len() <= most || shape.resolution == 1 {
                return Ok((small, bytes));
            }
            let has_harmonics = shape.color.channels() > 3;
            // Fewer steps save half of the bytes at most.
            if has_harmonics && steps > COARSEST && bytes.len() < 2 * most {
                steps /= 2;
                continue;
            }
            steps = FINEST;
            coarser = Some(match has_harmonics && shape.sh_reduction < 4 {
                true => grid.with_reduction((2 * shape.sh_reduction).min(4)),
                false => grid.resample((shape.resolution * 4 / 5).max(1)),
            });
        }
    }

    /// Returns the shape of the compressed grid.
    pub fn shape(&self) -> &GridShape {
        &self.shape
    }

    /// Returns the header that describes the bytes.
    pub fn header(&self) -> WebHeader {
        let (degree, offset) = match self.shape.color {
            Color::Rgb => (None, 0.0),
            Color::Sh { degree, offset } => (Some(degree), offset),
        };
        let harmonics = self.harmonics.first().map(|first| WebHarmonics {
            resolution: self.shape.harmonics_resolution(),
            reduction: self.shape.sh_reduction,
            voxels: first.bytes.len(),
            steps: self.harmonics.iter().map(|column| column.step).collect(),
        });
        WebHeader {
            resolution: self.shape.resolution,
            half_width: self.shape.half_width,
            interpolation: self.shape.interpolation,
            degree,
            offset,
            voxels: self.density.len(),
            zeros: self.means.iter().map(|column| column.zero).collect(),
            steps: self.means.iter().map(|column| column.step).collect(),
            harmonics,
        }
    }

    /// Returns the compressed bytes.
    ///
    /// Never errors in practice, because they are written to memory.
    pub fn bytes(&self) -> io::Result<Vec<u8>> {
        let mut stream = ZlibEncoder::new(Vec::new(), Compression::default());
        stream.write_all(&places(&self.lattice))?;
        for byte in 0..2 {
            stream.write_all(&self.density.iter().map(|value| value.to_le_bytes()[byte]).collect::<Vec<u8>>())?;
        }
        self.means.iter().try_for_each(|column| stream.write_all(&column.bytes))?;
        if let Some(lattice) = &self.harmonics_lattice {
            stream.write_all(&places(lattice))?;
        }
        self.harmonics.iter().try_for_each(|column| stream.write_all(&column.bytes))?;
        stream.finish()
    }

    /// Returns the grid as the viewer sees it.
    pub fn to_grid(&self) -> VoxelGrid<f32> {
        let side = self.shape.voxel_side() as f32;
        let density: Vec<f32> = self.density.iter().map(|value| value.to_f32() / side).collect();
        let [means, harmonics] = [&self.means, &self.harmonics].map(|columns| columns.iter().map(Column::values).collect::<Vec<_>>());
        // Tables store all numbers of red first, then of green, then of blue.
        let of_channel = |channel: usize| harmonics.iter().skip(channel).step_by(3);
        let mut tables = vec![table(&self.lattice, &[&density])];
        match &self.harmonics_lattice {
            Some(lattice) => {
                tables.push(table(&self.lattice, &means.iter().collect::<Vec<_>>()));
                tables.push(table(lattice, &(0..3).flat_map(of_channel).collect::<Vec<_>>()));
            }
            None => {
                let columns = means.iter().enumerate().flat_map(|(channel, mean)| [mean].into_iter().chain(of_channel(channel)));
                tables.push(table(&self.lattice, &columns.collect::<Vec<_>>()));
            }
        }
        VoxelGrid::with_tables(self.shape, self.lattice.clone(), tables)
    }
}

impl Column {
    /// Converts values to bytes between the smallest and the largest value.
    fn between(values: &[f32]) -> Self {
        let low = values.iter().copied().fold(f32::INFINITY, f32::min);
        let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        // If all values are equal, or if there are none, any step will do.
        let (zero, step) = if high > low { (low, (high - low) / 255.0) } else { (if values.is_empty() { 0.0 } else { low }, 1.0) };
        Self::with(values, zero, step)
    }

    /// Converts values to bytes with 0 in the middle, and `steps` steps up to the largest value.
    fn around_zero(values: &[f32], steps: u8) -> Self {
        let largest = values.iter().fold(0.0, |largest: f32, value| largest.max(value.abs()));
        let step = if largest > 0.0 { largest / f32::from(steps) } else { 1.0 };
        Self::with(values, -128.0 * step, step)
    }

    fn with(values: &[f32], zero: f32, step: f32) -> Self {
        Column { bytes: values.iter().map(|value| ((value - zero) / step).round() as u8).collect(), zero, step }
    }

    fn values(&self) -> Vec<f32> {
        self.bytes.iter().map(|byte| self.zero + f32::from(*byte) * self.step).collect()
    }
}

/// Rounds a density to a half float with 6 bits of mantissa, an error of at most 1 %.
fn rounded(density: f32) -> f16 {
    const DROPPED: u16 = 4;
    let limit = f32::from(f16::MAX);
    let bits = f16::from_f32(density.clamp(-limit, limit)).to_bits();
    // Rounding up may reach the next exponent, but must not reach that of infinity.
    let up = (bits & 0x7fff) + (1 << (DROPPED - 1));
    let bits = if up < f16::INFINITY.to_bits() { bits & 0x8000 | up } else { bits };
    f16::from_bits(bits >> DROPPED << DROPPED)
}

/// Returns the bricks of a lattice in row-major order: number and mask of those that have nodes.
fn bricks(lattice: &Lattice) -> impl Iterator<Item = Option<(usize, u64)>> {
    let grid = lattice.brick_grid();
    (0..grid.len()).map(move |b| lattice.brick(grid.place(b)))
}

/// Returns the rows of all present nodes, in the order of their places.
fn rows(lattice: &Lattice) -> Vec<usize> {
    bricks(lattice).flatten().flat_map(|(brick, mask)| bits(mask).map(move |bit| brick * BRICK_ROWS + bit)).collect()
}

/// Creates a table from its columns, which have one value per present node.
fn table(lattice: &Lattice, columns: &[&Vec<f32>]) -> Tensor<f32> {
    let width = columns.len();
    let mut values = vec![0.0; lattice.rows() * width];
    for (place, row) in rows(lattice).into_iter().enumerate() {
        for (value, column) in values[row * width..][..width].iter_mut().zip(columns) {
            *value = column[place];
        }
    }
    Tensor::from_vec(values, &[lattice.rows(), width])
}

/// Encodes the present nodes: a bit for each brick, then the masks of bricks with nodes.
fn places(lattice: &Lattice) -> Vec<u8> {
    let bricks: Vec<Option<(usize, u64)>> = bricks(lattice).collect();
    let byte =
        |bricks: &[Option<(usize, u64)>]| bricks.iter().enumerate().fold(0, |byte, (bit, brick)| byte | u8::from(brick.is_some()) << bit);
    let masks = bricks.iter().flatten().flat_map(|(_, mask)| mask.to_le_bytes());
    bricks.chunks(8).map(byte).chain(masks).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::read::ZlibDecoder;
    use std::io::Read;

    /// Returns a ball of random colors in an empty box.
    fn ball(color: Color, sh_reduction: usize, half_width: f64) -> VoxelGrid<f32> {
        let shape = GridShape { sh_reduction, ..GridShape::new(18, half_width, Interpolation::Trilinear, color) };
        let grid = VoxelGrid::random(shape, 1.0, 1.0, 7);
        let density = (0..grid.lattice().rows()).map(|row| {
            let far = grid.lattice().node(row as u32).map_or(9.0, |node| node.map(|k| (k as f32 - 8.5).powi(2)).iter().sum::<f32>().sqrt());
            // In the middle a voxel absorbs most of the light, whatever the unit.
            (6.0 - far) / half_width as f32
        });
        let density = Tensor::from_vec(density.collect(), &[grid.lattice().rows(), 1]);
        grid.with_density(density)
    }

    #[test]
    fn what_can_be_seen_comes_back_with_the_precision_of_its_bytes() {
        let sh = |degree| Color::Sh { degree, offset: 0.5 };
        for (color, reduction, half_width) in [(Color::Rgb, 1, 1e-6), (sh(2), 1, 1.0), (sh(1), 3, 1e6)] {
            let grid = ball(color, reduction, half_width);
            let small = WebGrid::new(&grid, FINEST);
            let back = small.to_grid();
            assert!(small.density.len() < 18 * 18 * 18 / 3 && back.lattice().present() == small.density.len());
            for (table, tolerance) in [(0, 6.0 / 120.0 / half_width as f32), (1, 0.6 / 255.0), (2, 0.6 / 127.0)] {
                let (Some(old), Some(new)) = (grid.params().nth(table), back.params().nth(table)) else { continue };
                let (from, to) = match table {
                    2 => (grid.harmonics_lattice(), back.harmonics_lattice()),
                    _ => (Some(grid.lattice()), Some(back.lattice())),
                };
                // In a common table, harmonics and coefficients of degree 0 have the tolerance of harmonics, whose bytes are less precise.
                let tolerance = if table == 1 && reduction == 1 { 0.6 / 127.0 } else { tolerance };
                let width = old.tensor().shape()[1];
                let mut compared = 0;
                for row in 0..to.unwrap().rows() {
                    let Some(node) = to.unwrap().node(row as u32) else { continue };
                    let before = from.unwrap().row(node).unwrap() as usize;
                    for at in 0..width {
                        let (old, new) = (old.tensor().data()[before * width + at], new.tensor().data()[row * width + at]);
                        assert!((old - new).abs() <= tolerance, "table {table}, {node:?}: {old} became {new}");
                        compared += 1;
                    }
                }
                assert!(compared > 100);
            }
        }
    }

    #[test]
    fn densities_are_rounded_to_the_nearest_and_stay_finite() {
        let around = |x: f32| rounded(x).to_f32();
        assert_eq!(
            [0.0, 1.0, -1.0, 1.007, 1.009, 65504.0, 1e9, -1e9].map(around),
            [0.0, 1.0, -1.0, 1.0, 1.015625, 65024.0, 65024.0, -65024.0]
        );
        assert!((1..2000).map(|k| 0.37 * k as f32).all(|x| (around(x) - x).abs() <= x / 120.0));
    }

    #[test]
    fn the_bytes_are_as_many_as_the_header_says() {
        for (color, reduction) in [(Color::Rgb, 1), (Color::Sh { degree: 2, offset: 0.5 }, 1), (Color::Sh { degree: 2, offset: 0.5 }, 4)] {
            let small = WebGrid::new(&ball(color, reduction, 1.0), FINEST);
            let mut bytes = Vec::new();
            ZlibDecoder::new(small.bytes().unwrap().as_slice()).read_to_end(&mut bytes).unwrap();
            let places = |lattice: &Lattice| lattice.brick_grid().len().div_ceil(8) + 8 * lattice.rows() / BRICK_ROWS;
            let header = serde_json::to_value(small.header()).unwrap();
            let voxels = header["voxels"].as_u64().unwrap() as usize;
            let harmonics = &header["harmonics"];
            let harmonics = harmonics["voxels"].as_u64().unwrap_or(0) as usize * harmonics["steps"].as_array().map_or(0, Vec::len);
            let shared = small.harmonics_lattice.as_ref().map_or(0, places);
            assert_eq!(bytes.len(), places(&small.lattice) + 5 * voxels + shared + harmonics);
        }
    }

    #[test]
    fn a_grid_becomes_coarser_until_it_fits() {
        let grid = ball(Color::Sh { degree: 2, offset: 0.5 }, 1, 1.0);
        let whole = WebGrid::new(&grid, FINEST).bytes().unwrap().len();
        let (_, same) = WebGrid::within(&grid, whole).unwrap();
        assert_eq!(same.len(), whole);
        let (rough, bytes) = WebGrid::within(&grid, whole * 9 / 10).unwrap();
        assert!(bytes.len() <= whole * 9 / 10 && rough.shape().sh_reduction == 1 && rough.harmonics[0].step > 1.5 / 127.0);
        let (reduced, bytes) = WebGrid::within(&grid, whole / 3).unwrap();
        assert!(bytes.len() <= whole / 3 && reduced.shape().resolution == 18 && reduced.shape().sh_reduction > 1);
        let (coarse, bytes) = WebGrid::within(&grid, whole / 50).unwrap();
        assert!(bytes.len() <= whole / 50 && coarse.shape().resolution < 18);
    }
}
