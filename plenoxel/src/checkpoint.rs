//! Checkpoints of trained grids: `safetensors` files that state the meaning of their numbers.
//!
//! A dense grid has the tensors `density` `[n, n, n]` and `color` `[n, n, n, channels]`, `f32`, x slowest. A sparse grid has `voxels`
//! `[k]`, `u32`, ascending: the present voxels, where voxel (x, y, z) has the number (x n + y) n + z; and `density` `[k]` and `color` `[k,
//! channels]` in that order.
//!
//! If harmonics of degree 1 and more are reduced, the grid is written as a sparse grid even if all voxels are present. `color` is `[k, 3]`,
//! the coefficients of degree 0. The other harmonics follow in the same form: `harmonics_voxels` `[h]`, where (x, y, z) of m = ⌈n /
//! reduction⌉ voxels per axis has the number (x m + y) m + z, and `harmonics` `[h, channels − 3]`.
//!
//! A grid in other coordinates than those of the world is written as a sparse grid too, and its header has [`coordinates`](Header::coordinates).
//!
//! The metadata have one entry, `plenoxel`: a JSON object with the version and every convention that a reader needs.

use crate::error::{Error, Result};
use crate::field::voxel_grid::{Color, GridShape, GridSpace, Interpolation, VoxelGrid};
use crate::files;
use crate::memory;
use crate::tensor_file::{self, Dtype, Entry, RETRAIN, TensorFile, bytes_of};
use crate::train::About;
use autograd::lattice::BrickGrid;
use autograd::{Indices, Lattice, Module, Param, Real, Tensor};
use serde::{Deserialize, Serialize};
use std::io::{Read, Seek};
use std::path::Path;

/// Kind of model in these files.
pub const KIND: &str = "plenoxels";
/// Format version of dense grids.
pub const FORMAT: &str = "plenoxel 1";
/// Format version of sparse grids.
pub const SPARSE_FORMAT: &str = "plenoxel 2";
/// Format version of grids with reduced harmonics.
pub const REDUCED_FORMAT: &str = "plenoxel 3";
/// Format version of grids in other coordinates than those of the world.
pub const SPACE_FORMAT: &str = "plenoxel 4";
/// Position and meaning of a voxel's values, as text.
pub const CONVENTION: &str = "voxel k of n has its centre at (k + 0.5) * 2 * half_width / n - half_width; \
    sigma = max(0, density) after interpolation, per world length; \
    harmonics in the order and signs of svox2, blocks of R, G, B: \
    1, -y, z, -x, xy, -yz, 2zz-xx-yy, -xz, xx-yy, -y(3xx-yy), xyz, -y(4zz-xx-yy), z(2zz-3xx-3yy), -x(4zz-xx-yy), z(xx-yy), -x(xx-3yy), \
    orthonormal over the sphere; color = max(0, offset + sum)";
/// Addition to [`CONVENTION`] for reduced harmonics.
const REDUCED_CONVENTION: &str = "; `color` has the means of R, G, B alone; `harmonics` has those of degree 1 and more, in voxels whose sides are \
    sh_reduction times as long and whose box begins at the same corner and may end beyond it; they are looked up as the other values are";

/// Addition to [`CONVENTION`] for other coordinates than those of the world.
const SPACE_CONVENTION: &str =
    "; positions are stretch * p, component by component, where p is in the box of the space; sigma is per length of that box";

/// Header of a checkpoint: everything but its tables.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Kind of model, [`KIND`]. Files of early versions do not have it.
    #[serde(default = "kind")]
    pub kind: String,
    /// [`FORMAT`], [`SPARSE_FORMAT`], [`REDUCED_FORMAT`] or [`SPACE_FORMAT`].
    pub format: String,
    /// [`CONVENTION`] and additions, for human readers.
    pub convention: String,
    /// Number of voxels along each axis.
    pub resolution: usize,
    /// Half the side of the cube, in units of the dataset or in those of other coordinates.
    pub half_width: f64,
    /// Coordinates of the cube. Not written if they are those of the world.
    #[serde(default, skip_serializing_if = "is_world")]
    pub coordinates: GridSpace,
    /// Interpolation between voxel centres.
    pub interpolation: Interpolation,
    /// Degree of the harmonics; `None` for RGB.
    pub sh_degree: Option<usize>,
    /// Color of zero coefficients.
    pub sh_offset: f64,
    /// Reduction of harmonics: those of degree 1 and more are stored for every n-th voxel along each axis. Not written if it is 1.
    #[serde(default = "unreduced", skip_serializing_if = "is_unreduced")]
    pub sh_reduction: usize,
    /// Background color of training.
    pub background: [f32; 3],
    /// Transform from grid world to dataset world, a row-major 4 × 4 matrix. Always the identity, because grids are in the frame of the
    /// dataset.
    pub scene_transform: [[f64; 4]; 4],
    /// Name of the scene.
    pub scene: String,
    /// Seed of the run.
    pub seed: u64,
    /// Number of steps taken.
    pub step: u64,
    /// Program that wrote the file.
    pub writer: String,
}

impl From<Header> for About {
    fn from(header: Header) -> Self {
        About { scene: header.scene, background: header.background, seed: header.seed, step: header.step }
    }
}

fn kind() -> String {
    KIND.to_owned()
}

fn unreduced() -> usize {
    1
}

fn is_unreduced(reduction: &usize) -> bool {
    *reduction == 1
}

fn is_world(coordinates: &GridSpace) -> bool {
    *coordinates == GridSpace::WORLD
}

impl Header {
    /// Transform of grids in the frame of the dataset.
    const IDENTITY: [[f64; 4]; 4] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

    /// Creates the header of a grid.
    pub fn new<T: Real>(grid: &VoxelGrid<T>, scene: &str, background: [f32; 3], seed: u64, step: u64) -> Self {
        let shape = grid.shape();
        let (sh_degree, sh_offset) = match shape.color {
            Color::Rgb => (None, 0.0),
            Color::Sh { degree, offset } => (Some(degree), offset),
        };
        let in_world = is_world(&shape.coordinates);
        let format = match (shape.is_reduced(), grid.lattice().is_full()) {
            _ if !in_world => SPACE_FORMAT,
            (true, _) => REDUCED_FORMAT,
            (false, true) => FORMAT,
            (false, false) => SPARSE_FORMAT,
        };
        let additions = [if shape.is_reduced() { REDUCED_CONVENTION } else { "" }, if in_world { "" } else { SPACE_CONVENTION }];
        Header {
            kind: kind(),
            format: format.to_owned(),
            convention: CONVENTION.to_owned() + &additions.concat(),
            resolution: shape.resolution,
            half_width: shape.half_width,
            coordinates: shape.coordinates,
            interpolation: shape.interpolation,
            sh_degree,
            sh_offset,
            sh_reduction: shape.sh_reduction,
            background,
            scene_transform: Self::IDENTITY,
            scene: scene.to_owned(),
            seed,
            step,
            writer: concat!("plenoxel ", env!("CARGO_PKG_VERSION")).to_owned(),
        }
    }

    /// Returns the shape of the grid.
    pub fn shape(&self) -> GridShape {
        let color = self.sh_degree.map_or(Color::Rgb, |degree| Color::Sh { degree, offset: self.sh_offset });
        let Header { resolution, half_width, coordinates, interpolation, sh_reduction, .. } = *self;
        GridShape { sh_reduction, coordinates, ..GridShape::new(resolution, half_width, interpolation, color) }
    }
}

/// Writes a grid atomically.
pub fn save<T: Real>(path: &Path, grid: &VoxelGrid<T>, header: &Header) -> Result<()> {
    let (n, channels) = (header.resolution, grid.shape().color_width());
    let mut entries: Vec<Entry<'_>> = Vec::new();
    if header.format == FORMAT {
        let [density, color] = grid.to_row_major();
        entries.push(Entry::new("density", Dtype::F32, vec![n, n, n], move || bytes_of(density.data(), Dtype::F32)));
        entries.push(Entry::new("color", Dtype::F32, vec![n, n, n, channels], move || bytes_of(color.data(), Dtype::F32)));
    } else {
        let mut list = |name: &'static str, lattice: &Lattice, tables: &[(&'static str, &Param<T>)]| {
            let voxels = present(lattice);
            let rows = Indices::from(rows_of(&voxels, lattice));
            for (name, table) in tables {
                let width = table.shape()[1];
                let shape = if *name == "density" { vec![voxels.len()] } else { vec![voxels.len(), width] };
                let (table, rows) = (table.tensor().detach(), rows.clone());
                entries.push(Entry::new(*name, Dtype::F32, shape, move || bytes_of(table.gather_rows(&rows).data(), Dtype::F32)));
            }
            entries.push(Entry::new(name, Dtype::U32, vec![voxels.len()], move || voxels.iter().flat_map(|v| v.to_le_bytes()).collect()));
        };
        list("voxels", grid.lattice(), &[("density", &grid.density), ("color", &grid.color)]);
        if let (Some(table), Some(lattice)) = (&grid.harmonics, grid.harmonics_lattice()) {
            list("harmonics_voxels", lattice, &[("harmonics", table)]);
        }
    }
    tensor_file::write(path, header, &entries)
}

/// Returns the numbers of the present voxels, ascending.
fn present(lattice: &Lattice) -> Vec<u32> {
    let n = lattice.nodes()[0];
    let mut voxels: Vec<u32> =
        (0..lattice.rows() as u32).filter_map(|row| lattice.node(row)).map(|[x, y, z]| ((x * n + y) * n + z) as u32).collect();
    voxels.sort_unstable();
    voxels
}

/// Returns the rows of present voxels, in the order of their numbers.
fn rows_of(voxels: &[u32], lattice: &Lattice) -> Vec<u32> {
    voxels.iter().filter_map(|&voxel| lattice.row(node(voxel, lattice.nodes()[0]))).collect()
}

/// Returns the voxel with a number.
fn node(voxel: u32, n: usize) -> [usize; 3] {
    let voxel = voxel as usize;
    [voxel / (n * n), voxel / n % n, voxel % n]
}

/// Bytes per brick of a grid while its lattice is created: masks, links, and the order along a Morton curve.
pub(crate) const BRICK_BYTES: u64 = 72;

/// Creates the lattice of n³ voxels in which these are present.
fn with_voxels(voxels: &[u32], n: usize) -> Lattice {
    let masks = BrickGrid::new([n; 3]).masks_of(voxels.iter().map(|&voxel| node(voxel, n)));
    Lattice::from_masks([n; 3], masks)
}

/// Reads the header of a checkpoint and the number of present voxels, without its tables.
pub fn header(path: &Path) -> Result<(Header, usize)> {
    let file = TensorFile::open(path)?;
    let shape = file.info("voxels").or_else(|| file.info("density")).map_or(&[][..], |info| &info.shape);
    Ok((header_of(path, &file)?, shape.iter().product()))
}

/// Reads and validates the header in the metadata of a file.
fn header_of(path: &Path, file: &TensorFile<'_>) -> Result<Header> {
    // Check the version first: later versions may have other fields.
    let value = file.facts()?;
    if let Some(kind) = value["kind"].as_str().filter(|kind| *kind != KIND) {
        let found = format!("a model of kind `{kind}` has no voxels");
        return Err(Error::input(
            path,
            found,
            format!("use a model of kind `{KIND}`; `plenoxel bake` makes one from a model without voxels"),
        ));
    }
    let format = value["format"].as_str().unwrap_or("none");
    const KNOWN: [&str; 4] = [FORMAT, SPARSE_FORMAT, REDUCED_FORMAT, SPACE_FORMAT];
    if !KNOWN.contains(&format) {
        let known = KNOWN.map(|format| format!("`{format}`")).join(", ");
        return Err(Error::input(
            path,
            format!("format `{format}`"),
            format!("expected one of {known}; use the program version that wrote the file"),
        ));
    }
    let format = format.to_owned();
    let header: Header = serde_json::from_value(value).map_err(|e| file.unreadable(&e))?;
    let degree_known = header.sh_degree.is_none_or(|d| d <= crate::field::sh::MAX_DEGREE);
    if header.scene_transform != Header::IDENTITY {
        return Err(Error::input(
            path,
            "the grid is not in the frame of its dataset",
            "expected a grid whose scene_transform is the identity",
        ));
    }
    let shape = header.shape();
    let as_format_says = match &*format {
        SPACE_FORMAT => !is_world(&shape.coordinates),
        format => is_world(&shape.coordinates) && shape.is_reduced() == (format == REDUCED_FORMAT),
    };
    let reduced = (1..=1024).contains(&header.sh_reduction) && as_format_says;
    if !((1..=1024).contains(&header.resolution) && degree_known && reduced && shape.has_valid_box()) {
        return Err(Error::input(path, "the header has values out of range", RETRAIN));
    }
    Ok(header)
}

/// Reads a grid.
///
/// Errors if the file is truncated, or has another format or a later version; the error names the file and the problem.
pub fn load<T: Real>(path: &Path) -> Result<(VoxelGrid<T>, Header)> {
    read(path, files::open(path, files::TENSORS)?)
}

/// Reads a grid from any source, such as a file or bytes. `path` names it in error messages.
pub fn read<T: Real>(path: &Path, source: impl Read + Seek) -> Result<(VoxelGrid<T>, Header)> {
    let mut file = TensorFile::new(path, source)?;
    let header = header_of(path, &file)?;
    let shape = header.shape();
    let n = header.resolution;
    // A few voxels may be spread over many bricks.
    memory::check(path, &format!("reading a grid of {n}³ voxels"), BRICK_BYTES * BrickGrid::new([n; 3]).len() as u64)?;
    fn table<T: Real>(file: &mut TensorFile<'_>, name: &str, width: usize, expected: &[usize]) -> Result<Tensor<T>> {
        let values = file.numbers(name, Dtype::F32, expected)?;
        let rows = values.len() / width;
        Ok(Tensor::from_vec(values, &[rows, width]))
    }
    let channels = shape.color_width();
    let grid = if header.format == FORMAT {
        VoxelGrid::from_row_major(
            shape,
            &table(&mut file, "density", 1, &[n, n, n])?,
            &table(&mut file, "color", channels, &[n, n, n, channels])?,
        )
    } else {
        let list = |file: &mut TensorFile<'_>, name: &str, n: usize| -> Result<Vec<u32>> {
            let k = file.info(name).map_or(0, |info| info.shape.iter().product());
            let bytes = file.read(name, Dtype::U32, &[k])?;
            let voxels: Vec<u32> = bytes.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
            if !voxels.is_sorted_by(|a, b| a < b) || voxels.last().is_none_or(|&last| last as usize >= n * n * n) {
                return Err(Error::input(path, "the list of voxels is empty, not ascending, or beyond the grid", RETRAIN));
            }
            Ok(voxels)
        };
        let placed = |listed: Tensor<T>, voxels: &[u32], lattice: &Lattice| {
            listed.scatter_rows(&Indices::from(rows_of(voxels, lattice)), lattice.rows())
        };
        let voxels = list(&mut file, "voxels", n)?;
        let k = voxels.len();
        let lattice = with_voxels(&voxels, n);
        let fine = [table(&mut file, "density", 1, &[k])?, table(&mut file, "color", channels, &[k, channels])?];
        let mut tables = fine.map(|table| placed(table, &voxels, &lattice)).to_vec();
        if let Some(lattice) = shape.harmonics_lattice(&lattice) {
            let (voxels, width) = (list(&mut file, "harmonics_voxels", shape.harmonics_resolution())?, shape.harmonics_width());
            if voxels != present(&lattice) {
                return Err(Error::input(path, "the file has harmonics of other voxels than the grid needs", RETRAIN));
            }
            tables.push(placed(table(&mut file, "harmonics", width, &[voxels.len(), width])?, &voxels, &lattice));
        }
        VoxelGrid::with_tables(shape, lattice, tables)
    };
    if !grid.is_finite() {
        return Err(Error::input(path, "the grid has values that are not finite", RETRAIN));
    }
    Ok((grid, header))
}
