//! Checkpoints of svox2 (`ckpt.npz`; Fridovich-Keil et al. 2022).
//!
//! | array | type and shape | meaning |
//! | --- | --- | --- |
//! | `radius`, `center` | `<f4` `[3]` | half the side and the centre of the box |
//! | `links` | `<i4` `[n, n, n]`, x slowest | row of a voxel; negative for empty voxels |
//! | `density_data` | `<f4` `[rows, 1]` | raw density, 1 / length |
//! | `sh_data` | `<f2` `[rows, 3 dim]` | harmonics of red, then green, then blue; dim is 1, 4 or 9 |
//! | `basis_type` | integer | 1 for spherical harmonics; 4 and 255 are learned bases |
//! | `background_links`, `background_data` | | spheres around the box, absent in files of NeRF-synthetic scenes |
//!
//! Old files have `data` `[rows, 1 + 3 dim]`, the density first, instead of two tables.
//!
//! **Same conventions as here.** A voxel's centre is at (i + ½) side − radius. Raw values are interpolated trilinearly, with 0 for empty
//! voxels, and the border is repeated in the outer half voxel. Then σ = max(0, density) and color = max(0, ½ + Σ Yₖ(d) cₖ), with the
//! harmonics of [`crate::field::sh`].
//!
//! **Units.** svox2 multiplies σ by the length of a step in the world of its cameras, so a density is per unit of `radius`. Its loaders scale
//! the cameras: by 2/3 for NeRF-synthetic scenes (`scene_scale`). With scale s, a world position p of this crate is s p there, and a
//! density σ is σ / s.
//!
//! Not in the files: the background color, the cameras, and whether the box is in normalized device coordinates. Their boxes are not cubes,
//! and are refused.

use super::npz::{Array, Npz, NpzWriter};
use super::{Imported, check_numbers, check_scale, check_shape, check_tables};
use crate::error::{Error, Result};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use autograd::lattice::BrickGrid;
use autograd::{Buffer, Lattice, Tensor};
use std::path::Path;

/// Color of zero coefficients.
pub const OFFSET: f64 = 0.5;
/// Scale of the cameras of NeRF-synthetic scenes in svox2.
pub const BLENDER_SCALE: f64 = 2.0 / 3.0;
/// Highest degree of harmonics that svox2 renders.
const MOST_DEGREE: usize = 2;
/// Value of `basis_type` for spherical harmonics.
const SPHERICAL_HARMONICS: i64 = 1;

/// Reads a checkpoint.
pub(super) fn read(file: &mut Npz<'_>, scene_scale: f64) -> Result<Imported> {
    check_scale(scene_scale)?;
    let path = file.path().to_owned();
    check_basis(file)?;
    let mut warnings = Vec::new();
    if file.contains("background_data") {
        warnings.push("the background spheres of the file are left out: rays that leave the box show the background color".to_owned());
    }
    let links = file.integers("links")?;
    let [n, ny, nz] = links.shape[..] else {
        return Err(Error::input(&path, format!("array `links` has {} axes", links.shape.len()), "expected three"));
    };
    if [ny, nz] != [n; 2] {
        let found = format!("the grid has {n} x {ny} x {nz} voxels");
        return Err(Error::input(&path, found, "expected a cube; grids in normalized device coordinates cannot be read"));
    }
    let half_width = radius(file)? / scene_scale;
    let (density, harmonics) = tables(file)?;
    let rows = density.len();
    let Some(degree) = (0..=sh::MAX_DEGREE).find(|degree| 3 * sh::count(*degree) == harmonics.shape[1]) else {
        let found = format!("the rows of harmonics have {} numbers", harmonics.shape[1]);
        return Err(Error::input(&path, found, "expected 3, 12, 27 or 48"));
    };
    let color = Color::Sh { degree, offset: OFFSET };
    let shape = GridShape::new(n, half_width, Interpolation::Trilinear, color);
    check_shape(&path, &shape)?;

    if let Some(beyond) = links.values.iter().find(|link| **link >= 0 && **link as usize >= rows) {
        return Err(Error::input(&path, format!("a voxel has row {beyond} of {rows}"), "use an undamaged copy of the file"));
    }
    let present = || (0..).zip(&links.values).filter(|(_, link)| **link >= 0);
    let node = |voxel: usize| [voxel / (n * n), voxel / n % n, voxel % n];
    if present().next().is_none() {
        return Err(Error::input(&path, "all voxels of the grid are empty", "use a checkpoint of a trained grid"));
    }
    let lattice = Lattice::from_masks([n; 3], BrickGrid::new([n; 3]).masks_of(present().map(|(voxel, _)| node(voxel))));
    check_tables(&path, &shape, &lattice, 1)?;
    let (width, scale) = (harmonics.shape[1], scene_scale as f32);
    let mut tables = [Buffer::zeros(lattice.rows()), Buffer::zeros(lattice.rows() * width)];
    for (voxel, link) in present() {
        let (Some(to), from) = (lattice.row(node(voxel)), *link as usize) else { continue };
        let to = to as usize;
        tables[0][to] = density[from] * scale;
        tables[1][to * width..][..width].copy_from_slice(&harmonics.values[from * width..][..width]);
    }
    let rows = lattice.rows();
    let [density, color] = tables;
    let grid =
        VoxelGrid::with_lattice(shape, lattice, Tensor::from_buffer(density, &[rows, 1]), Tensor::from_buffer(color, &[rows, width]));
    check_numbers(&path, &grid)?;
    Ok(Imported { grid, warnings })
}

/// Checks that the colors are spherical harmonics.
fn check_basis(file: &mut Npz<'_>) -> Result<()> {
    let kind = if file.contains("basis_type") { file.integers("basis_type")?.values.first().map(|kind| i64::from(*kind)) } else { None };
    let learned = match kind {
        None | Some(SPHERICAL_HARMONICS) if !file.contains("basis_data") => return Ok(()),
        Some(4) => "a 3D texture".to_owned(),
        Some(255) => "a network".to_owned(),
        None | Some(SPHERICAL_HARMONICS) => "a texture".to_owned(),
        Some(other) => format!("of type {other}"),
    };
    let found = format!("the basis of the colors is learned ({learned})");
    Err(Error::input(file.path(), found, "expected spherical harmonics: train svox2 with --basis_type sh"))
}

/// Returns half the side of the box, which must be a cube around the origin.
fn radius(file: &mut Npz<'_>) -> Result<f64> {
    let mut vector = |name: &str, default: f32| -> Result<[f32; 3]> {
        if !file.contains(name) {
            return Ok([default; 3]);
        }
        let values = file.numbers(name)?.values;
        match values[..] {
            [all] => Ok([all; 3]),
            [x, y, z] => Ok([x, y, z]),
            _ => Err(Error::input(file.path(), format!("array `{name}` has {} numbers", values.len()), "expected three")),
        }
    };
    let ([x, y, z], center) = (vector("radius", 1.0)?, vector("center", 0.0)?);
    if [y, z] != [x; 2] {
        let found = format!("the box has the radii {x}, {y}, {z}");
        return Err(Error::input(file.path(), found, "expected a cube"));
    }
    // Also refuses what is not a number.
    if !center.iter().all(|c| c.abs() <= 1e-6 * x) {
        let [x, y, z] = center;
        let found = format!("the box has its center at {x}, {y}, {z}");
        return Err(Error::input(file.path(), found, "expected a box around the origin"));
    }
    Ok(f64::from(x))
}

/// Reads densities and harmonics, with as many rows.
fn tables(file: &mut Npz<'_>) -> Result<(Vec<f32>, Array<f32>)> {
    let path = file.path().to_owned();
    let checked = |array: Array<f32>, name: &str| match array.shape[..] {
        [_, width] if width > 0 => Ok((array, width)),
        _ => Err(Error::input(&path, format!("array `{name}` has {} axes", array.shape.len()), "expected rows of numbers")),
    };
    if file.contains("data") {
        let (data, width) = checked(file.numbers("data")?, "data")?;
        let (density, rest) = data.values.chunks_exact(width).map(|row| (row[0], &row[1..])).unzip::<_, _, Vec<f32>, Vec<&[f32]>>();
        let harmonics = Array { shape: vec![density.len(), width - 1], values: rest.concat() };
        return Ok((density, harmonics));
    }
    let (density, one) = checked(file.numbers("density_data")?, "density_data")?;
    let (harmonics, _) = checked(file.numbers("sh_data")?, "sh_data")?;
    if one != 1 || density.shape[0] != harmonics.shape[0] {
        let found = format!("density_data has the shape {:?}, and sh_data {:?}", density.shape, harmonics.shape);
        return Err(Error::input(&path, found, "expected one density for each row of harmonics"));
    }
    Ok((density.values, harmonics))
}

/// Encodes a grid as a checkpoint. Returns its bytes and its number of rows. `scene_scale` is the length in the file of one world unit. Rows are in the order of the voxels, x slowest.
///
/// The pictures are the same up to the precision of `sh_data`, which is a half. Reduced harmonics are interpolated to every voxel first;
/// that is exact for odd reductions only. `path` names the grid in error messages.
///
/// Errors: the look-up is nearest, or the harmonics have a degree above 2, which svox2 cannot render.
pub fn encode(path: &Path, grid: &VoxelGrid<f32>, scene_scale: f64) -> Result<(Vec<u8>, usize)> {
    check_scale(scene_scale)?;
    let shape = *grid.shape();
    if shape.interpolation == Interpolation::Nearest {
        let found = "the grid has constant voxels, and svox2 interpolates between voxels";
        return Err(Error::input(path, found, "export an octree (`plenoxel export plenoctree`), or train from this grid with --init-from"));
    }
    let (degree, offset) = shape.color.harmonics();
    if degree > MOST_DEGREE {
        let found = format!("the grid has harmonics of degree {degree}, and svox2 renders up to degree {MOST_DEGREE}");
        return Err(Error::input(path, found, "train or bake with a lower sh_degree"));
    }
    // Samples at the border read voxels that are not present: zeros there, but also gray in svox2, and without harmonics.
    let surrounded = (offset != OFFSET || shape.is_reduced()).then(|| grid.surrounded());
    let whole = surrounded.as_ref().unwrap_or(grid).with_reduction(1).with_color(Color::Sh { degree, offset: OFFSET });
    let (n, lattice) = (shape.resolution, whole.lattice());
    let voxels = (0..n.pow(3)).map(|voxel| lattice.row([voxel / (n * n), voxel / n % n, voxel % n]));
    let (mut links, mut rows) = (Vec::with_capacity(n.pow(3)), Vec::with_capacity(lattice.present()));
    for row in voxels {
        links.push(row.map_or(-1, |_| rows.len() as i32));
        rows.extend(row);
    }
    let width = whole.shape().color_width();
    let (density, color) = (whole.density.tensor().data(), whole.color.tensor().data());
    let scale = scene_scale as f32;
    let density: Vec<f32> = rows.iter().map(|row| density[*row as usize] / scale).collect();
    let color: Vec<f32> = rows.iter().flat_map(|row| &color[*row as usize * width..][..width]).copied().collect();

    let mut file = NpzWriter::new(false);
    file.floats("radius", &[3], &[(shape.half_width * scene_scale) as f32; 3])?;
    file.floats("center", &[3], &[0.0; 3])?;
    file.integers("links", &[n; 3], &links)?;
    file.floats("density_data", &[rows.len(), 1], &density)?;
    file.halves("sh_data", &[rows.len(), width], &color)?;
    file.integer("basis_type", SPHERICAL_HARMONICS)?;
    Ok((file.finish()?, rows.len()))
}
