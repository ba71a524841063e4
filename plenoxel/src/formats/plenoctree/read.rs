//! Reading of octrees.

use super::CHILDREN;
use crate::error::{Error, Result};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::formats::logistic::{Sphere, logistic};
use crate::formats::npz::Npz;
use crate::formats::svox2::OFFSET;
use crate::formats::{Imported, MOST_VOXELS, check_numbers, check_scale, check_shape, check_tables};
use autograd::lattice::BrickGrid;
use autograd::{Buffer, Lattice, Tensor, parallel};
use std::ops::Range;
use std::path::Path;

/// Deepest leaf, in halvings of the root.
const DEEPEST: u32 = 20;
/// Degree of the harmonics that are fitted to logistic colors: the highest.
const FITTED_DEGREE: usize = sh::MAX_DEGREE;
/// Largest distance of a leaf from a voxel, in voxels, that is taken for rounding.
const ROUNDING: f64 = 1e-2;
const DAMAGED: &str = "use an undamaged copy of the file";

/// Meaning of the color numbers.
#[derive(Clone, Copy)]
enum Colors {
    /// One number per channel.
    Plain,
    /// Harmonics of a degree.
    Harmonics(usize),
}

/// A leaf with a density above 0.
struct Leaf {
    /// Row of its values.
    row: usize,
    /// Lower corner, in sides of the leaf.
    corner: [u32; 3],
    /// Halvings of the root.
    depth: u32,
}

/// Reads an octree.
pub(in crate::formats) fn read(file: &mut Npz<'_>, scene_scale: f64) -> Result<Imported> {
    check_scale(scene_scale)?;
    let path = file.path().to_owned();
    if file.contains("quant_colors") {
        return Err(Error::input(&path, "the colors of the octree are quantized", "expected an octree as svox saves it, with `data`"));
    }
    let child = file.integers("child")?;
    let [nodes, 2, 2, 2] = child.shape[..] else {
        let found = format!("array `child` has the shape {:?}", child.shape);
        return Err(Error::input(&path, found, "expected nodes of 2 x 2 x 2 children"));
    };
    let data = file.numbers("data")?;
    let width = match data.shape[..] {
        [same, 2, 2, 2, width] if same == nodes && width > 0 => width,
        _ => {
            let found = format!("array `data` has the shape {:?} for {nodes} nodes", data.shape);
            return Err(Error::input(&path, found, "expected a row of numbers for each child"));
        }
    };
    let colors = colors(file, width)?;
    let leaves = leaves(&path, &child.values, |row| data.values[row * width + width - 1])?;
    let cube = Cube::of(file, scene_scale)?;
    let mut warnings = Vec::new();
    let (resolution, half_width) = cube.grid(&leaves, &mut warnings);
    let degree = match colors {
        Colors::Plain | Colors::Harmonics(0) => 0,
        Colors::Harmonics(_) => {
            warnings.push(
                "colors of the octree are logistic functions of harmonics; those of the grid are fitted to them, not the same".to_owned(),
            );
            FITTED_DEGREE
        }
    };
    let color = Color::Sh { degree, offset: OFFSET };
    let shape = GridShape::new(resolution, half_width, Interpolation::Nearest, color);
    check_shape(&path, &shape)?;

    let voxels = |leaf: &Leaf| cube.voxels(leaf, &shape);
    let masks = BrickGrid::new([resolution; 3]).masks_of(leaves.iter().flat_map(|leaf| all(voxels(leaf))));
    let lattice = Lattice::from_masks([resolution; 3], masks);
    if lattice.present() == 0 {
        return Err(Error::input(&path, "the octree has no leaf that is as large as a voxel", "use an octree with less depth"));
    }
    let numbers = shape.color_width();
    check_tables(&path, &shape, &lattice, 2)?;
    let mut fitted = Buffer::zeros(leaves.len() * numbers);
    let spheres = match colors {
        Colors::Plain => [Sphere::new(0), Sphere::new(0)],
        Colors::Harmonics(from) => [Sphere::new(from), Sphere::new(degree)],
    };
    parallel::for_each_rows(&mut fitted, numbers, |first, chunk| {
        for (leaf, row) in leaves[first..].iter().zip(chunk.chunks_exact_mut(numbers)) {
            let own = &data.values[leaf.row * width..][..width - 1];
            let channels = own.chunks_exact((width - 1) / 3).zip(row.chunks_exact_mut(numbers / 3));
            channels.for_each(|(from, to)| match colors {
                Colors::Plain => to[0] = (logistic(from[0]) - OFFSET as f32) / sh::Y0 as f32,
                Colors::Harmonics(_) => spheres[0].fit_plain(from, &spheres[1], to),
            });
        }
    });
    let (mut density, mut color) = (Buffer::zeros(lattice.rows()), Buffer::zeros(lattice.rows() * numbers));
    for (leaf, own) in leaves.iter().zip(fitted.chunks_exact(numbers)) {
        let sigma = data.values[leaf.row * width + width - 1] * scene_scale as f32;
        for row in all(voxels(leaf)).filter_map(|voxel| lattice.row(voxel)) {
            density[row as usize] = sigma;
            color[row as usize * numbers..][..numbers].copy_from_slice(own);
        }
    }
    let rows = lattice.rows();
    let grid =
        VoxelGrid::with_lattice(shape, lattice, Tensor::from_buffer(density, &[rows, 1]), Tensor::from_buffer(color, &[rows, numbers]));
    check_numbers(&path, &grid)?;
    Ok(Imported { grid, warnings })
}

/// Returns the meaning of rows of `width` numbers.
fn colors(file: &mut Npz<'_>, width: usize) -> Result<Colors> {
    let format = match (file.contains("data_format"), width) {
        (true, _) => file.text("data_format")?,
        (false, 4) => "RGBA".to_owned(),
        (false, _) => format!("SH{}", (width - 1) / 3),
    };
    let found = match &format[..] {
        "RGBA" => Some((Colors::Plain, 1)),
        text => {
            let count = text.strip_prefix("SH").and_then(|count| count.parse().ok());
            count.and_then(|count: usize| Some((Colors::Harmonics((0..=sh::MAX_DEGREE).find(|d| sh::count(*d) == count)?), count)))
        }
    };
    match found {
        Some((colors, count)) if 3 * count + 1 == width => Ok(colors),
        _ => {
            let found = format!("the octree has the format `{format}` with {width} numbers in a leaf");
            Err(Error::input(file.path(), found, "expected SH1 with 4, SH4 with 13, SH9 with 28, SH16 with 49 numbers, or RGBA with 4"))
        }
    }
}

/// Returns the leaves with a density above 0, in the order of a walk from the root.
fn leaves(path: &Path, child: &[i32], density: impl Fn(usize) -> f32) -> Result<Vec<Leaf>> {
    let bad = |found: String| Error::input(path, found, DAMAGED);
    let nodes = child.len() / CHILDREN;
    let mut visited = vec![false; nodes];
    let mut leaves = Vec::new();
    let mut open: Vec<(usize, [u32; 3], u32)> = if nodes > 0 { vec![(0, [0; 3], 1)] } else { Vec::new() };
    while let Some((node, corner, depth)) = open.pop() {
        if std::mem::replace(&mut visited[node], true) {
            return Err(bad(format!("node {node} of the octree has two parents")));
        }
        if depth > DEEPEST {
            return Err(bad(format!("the octree is deeper than {DEEPEST}")));
        }
        for k in 0..CHILDREN {
            let row = node * CHILDREN + k;
            let corner = [0, 1, 2].map(|axis| 2 * corner[axis] + (k >> (2 - axis) & 1) as u32);
            if child[row] != 0 {
                let next = i64::try_from(node).ok().and_then(|node| usize::try_from(node + i64::from(child[row])).ok());
                let next = next.filter(|next| *next < nodes);
                open.push((next.ok_or_else(|| bad(format!("node {node} has a child beyond the {nodes} nodes")))?, corner, depth + 1));
            } else if density(row) > 0.0 {
                leaves.push(Leaf { row, corner, depth });
            }
        }
    }
    if leaves.is_empty() {
        return Err(Error::input(path, "no leaf of the octree has a density above 0", "use a trained octree"));
    }
    Ok(leaves)
}

/// All voxels of a box.
fn all([x, y, z]: [Range<usize>; 3]) -> impl Iterator<Item = [usize; 3]> {
    x.flat_map(move |i| {
        let z = z.clone();
        y.clone().flat_map(move |j| z.clone().map(move |k| [i, j, k]))
    })
}

/// The root in the world.
struct Cube {
    low: [f64; 3],
    side: [f64; 3],
}

impl Cube {
    fn of(file: &mut Npz<'_>, scene_scale: f64) -> Result<Self> {
        let new = file.contains("invradius3");
        let mut vector = |name: &str, accepted: Range<f32>| -> Result<[f64; 3]> {
            let values = file.numbers(name)?.values;
            let values = match values[..] {
                [all] => Some([all; 3]),
                [x, y, z] => Some([x, y, z]),
                _ => None,
            };
            let values = values.filter(|values| values.iter().all(|value| accepted.contains(value)));
            let found = || format!("array `{name}` is not three numbers from {:e} to {:e}", accepted.start, accepted.end);
            Ok(values.ok_or_else(|| Error::input(file.path(), found(), DAMAGED))?.map(f64::from))
        };
        let offset = vector("offset", -1e6..1e6)?;
        let inverse = vector(if new { "invradius3" } else { "invradius" }, 1e-9..1e9)?;
        let side = inverse.map(|value| 1.0 / (value * scene_scale));
        Ok(Cube { low: [0, 1, 2].map(|axis| -offset[axis] * side[axis]), side })
    }

    /// Lower and upper bounds of a leaf along an axis.
    fn bounds(&self, leaf: &Leaf, axis: usize) -> [f64; 2] {
        let side = self.side[axis] / f64::from(1u32 << leaf.depth);
        [0.0, 1.0].map(|more| self.low[axis] + (f64::from(leaf.corner[axis]) + more) * side)
    }

    /// Returns resolution and half width of the smallest cube around the origin that holds the leaves. Its voxels are the smallest leaves, if
    /// these are cubes and their corners are at multiples of half a side.
    fn grid(&self, leaves: &[Leaf], warnings: &mut Vec<String>) -> (usize, f64) {
        let depth = leaves.iter().map(|leaf| leaf.depth).max().unwrap_or(1);
        let reach =
            leaves.iter().flat_map(|leaf| [0, 1, 2].map(|axis| self.bounds(leaf, axis))).flatten().map(f64::abs).fold(0.0, f64::max);
        let side = self.side.into_iter().fold(f64::INFINITY, f64::min) / f64::from(1u32 << depth);
        let halves = self.low.map(|low| 2.0 * low / side);
        let even = |halves: f64| (halves.round() / 2.0).fract() == 0.0;
        let aligned = halves.iter().all(|h| (h - h.round()).abs() < 2.0 * ROUNDING && even(*h) == even(halves[0]))
            && self.side.iter().all(|s| (s / self.side[0] - 1.0).abs() * f64::from(1u32 << depth) < ROUNDING);
        let needed = (2.0 * reach / side - 2.0 * ROUNDING).ceil().max(1.0);
        if aligned {
            let resolution = if even(needed) == even(halves[0]) { needed } else { needed + 1.0 };
            return (resolution as usize, resolution * side / 2.0);
        }
        let resolution = needed.min(MOST_VOXELS as f64);
        warnings.push(format!(
            "the leaves are not cubes around the origin: each of {resolution}³ voxels has the values of the leaf at its center"
        ));
        (resolution as usize, reach)
    }

    /// Returns the voxels whose centres are in a leaf.
    fn voxels(&self, leaf: &Leaf, shape: &GridShape) -> [Range<usize>; 3] {
        [0, 1, 2].map(|axis| {
            let [low, high] = self.bounds(leaf, axis).map(|bound| {
                let voxels = (bound + shape.half_width) / shape.voxel_side() - 0.5;
                (voxels.ceil().max(0.0) as usize).min(shape.resolution)
            });
            low..high
        })
    }
}
