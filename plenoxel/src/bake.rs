//! Baking: a sparse voxel grid with harmonics that resembles a [field](crate::render::ShadedField), for viewers and exports.
//!
//! 1. The grid is the smallest cube around the origin that contains the field's occupied cells, and the whole box in contracted space. A voxel has the raw density r = σ − a
//!    softplus(−x − 6) at its centre. There σ = a softplus(x) is the density of the field, x is not below −10, and a = min(25, 1 / (2 s)) with the side
//!    s of a voxel. max(0, r) differs from σ by at most 0.05 a: an opacity of 0.025 of a voxel. Unlike σ, r is nearly linear in x, below 0 too. With
//!    a = 25, x is the density feature of a [factored field](crate::field::factored). Interpolation between voxels places a surface where the field has it. If σ were
//!    interpolated, every surface would grow by up to half a voxel.
//! 2. A voxel is present if it or a neighbour has a density above 0, and if a camera sees it or a neighbour with [enough weight](BakeOptions::least_weight).
//! 3. The harmonics of a voxel v are the least-squares fit to the field's colors c at its centre, in the directions d of the cameras that see
//!    it (`bake/visible.rs`):
//!
//!    min Σ_d |c(d) − offset − S(d)·xᵥ|² + λ n Σ_{k≥1} |xᵥₖ|²        with n directions.
//!
//!    A voxel that no camera sees has its mean color.
//!
//! Harmonics are smoother than a color network, and they are interpolated: pictures of the grid differ from those of the field.

mod visible;

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::field::factored::SCALE;
use crate::field::sh;
use crate::field::sh::least_squares::improve;
use crate::field::voxel_grid::{Color, GridShape, GridSpace, Interpolation, VoxelGrid};
use crate::geometry::Aabb;
use crate::memory::{allowance, bytes};
use crate::render::ShadedField;
use crate::sampling::Occupancy;
use crate::space::Space;
use crate::train::Model;
use autograd::lattice::{BrickGrid, bits_where};
use autograd::{Buffer, Indices, Lattice, Tensor, no_grad, parallel};
use glam::DVec3;
pub use visible::focus;
use visible::{Sights, sight};

/// Color of zero coefficients.
pub const OFFSET: f64 = 0.5;
/// Feature x at which the raw density bends down, times −1; it is 0 at half of that.
const BEND: f32 = 6.0;
/// The least x of a voxel.
const LEAST: f32 = -10.0;
/// Most voxels along each axis of [`Source::resolution`].
const MOST_VOXELS: usize = 512;
/// Most directions in which the color of a voxel is computed.
const MOST_DIRECTIONS: usize = 32;
/// Most directions for a voxel that no camera sees.
const DIRECTIONS_OF_HIDDEN: usize = 4;
/// λ, relative to the number of directions.
const RIDGE: f32 = 1e-3;
/// Rows whose colors are computed together. It bounds the memory of a thread.
const ROWS: usize = 256;
/// Rows between reports of progress.
const BATCH: usize = 1 << 16;

/// Fewest voxels along each axis.
const LEAST_VOXELS: usize = 2;
/// Number of voxels along the longest side of a box, if the field has no cells.
const VOXELS_WITHOUT_CELLS: f64 = 256.0;

/// Field to bake, with its box.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// The field, a function of positions in the box.
    pub field: &'a dyn ShadedField<f32>,
    /// The box.
    pub aabb: Aabb,
    /// Space of the box.
    pub space: Space,
}

/// Size of a baked grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BakeOptions {
    /// Number of voxels along each axis, at most 1024.
    pub resolution: usize,
    /// Most voxels of the grid. If matter fills more, as the fog of a field whose training has just begun, the resolution is lowered.
    pub most_voxels: usize,
    /// Degree of the harmonics, 0 to 3.
    pub degree: usize,
    /// Largest rendering weight of a voxel in small pictures of the cameras below which it is left out, unless a neighbour has more; 0 keeps all voxels, and
    /// so do no cameras.
    pub least_weight: f32,
}

impl<'a> Source<'a> {
    /// Returns the field of a model; `None` if the model has none.
    pub fn of(model: &'a dyn Model<f32>) -> Option<Self> {
        model.shaded().map(|field| Source { field, aabb: model.aabb(), space: model.space() })
    }

    /// Returns the coordinates of the baked grid.
    fn coordinates(&self) -> GridSpace {
        GridSpace::of(self.space, self.sides())
    }

    /// Returns the number of voxels along each axis with which the grid is about as fine as the field, at most 512.
    pub fn resolution(&self) -> usize {
        let cell = (self.sides() * self.coordinates().stretch).element_sum() / 3.0;
        ((2.0 * self.half_width() / cell).ceil() as usize).clamp(LEAST_VOXELS, MOST_VOXELS)
    }

    /// Returns the rendering weight of voxels that may be left out ([`BakeOptions::least_weight`]): 0 in a box of the world if the field knows its occupied cells, and
    /// 1/256 elsewhere. Most of what is in other spaces, and of matter of a field that does not know where it was trained, no camera sees.
    pub fn least_weight(&self) -> f32 {
        if self.space == Space::Box && self.field.reach().is_some() { 0.0 } else { 1.0 / 256.0 }
    }

    /// Returns the sides of voxels that are as fine as the field.
    fn sides(&self) -> DVec3 {
        let side = (self.aabb.max - self.aabb.min).max_element() / VOXELS_WITHOUT_CELLS;
        self.field.voxel_sides().unwrap_or(DVec3::splat(side))
    }

    /// Returns half the side of the cube of the baked grid, in the coordinates of the grid.
    fn half_width(&self) -> f64 {
        // The rays of the contracted space end at the faces of its box.
        if self.space == Space::Contracted {
            return Space::CONTRACTED;
        }
        let aabb = self.field.reach().and_then(Occupancy::bounds).unwrap_or(self.aabb);
        (aabb.max.max(-aabb.min) * self.coordinates().stretch).max_element()
    }
}

/// Bakes a field. The colors are fitted to the directions of the `cameras`, or to directions all around if there are none.
/// `progress(done, all)` is called with numbers of table rows. Returns the grid, whose [coordinates](GridShape::coordinates) are those of the source.
///
/// Errors: no voxel has a density; there is not enough memory.
pub fn bake(source: Source<'_>, options: &BakeOptions, cameras: &[Camera], progress: &dyn Fn(usize, usize)) -> Result<VoxelGrid<f32>> {
    let degree = options.degree;
    let mut resolution = options.resolution;
    let plain = loop {
        let grid = opaque(source, resolution, options.least_weight, cameras)?;
        let voxels = grid.lattice().present();
        if voxels <= options.most_voxels || resolution <= LEAST_VOXELS {
            break grid;
        }
        // Voxels of fog grow with the cube of the resolution, those of surfaces with its square.
        let ratio = (options.most_voxels as f64 / voxels as f64).cbrt();
        resolution = ((resolution as f64 * ratio) as usize).clamp(LEAST_VOXELS, resolution - 1);
    };
    let shape = GridShape { color: Color::Sh { degree, offset: OFFSET }, ..*plain.shape() };
    let (lattice, density) = (plain.lattice().clone(), plain.density.tensor().clone());
    let rows = lattice.rows();
    let needed = (rows * (2 * shape.voxel_bytes() + 4 * size_of::<f32>())) as u64;
    check_memory(&format!("baking {} voxels", lattice.present()), needed)?;
    let sights = (!cameras.is_empty()).then(|| Sights::new(&plain, cameras));
    let painter = Painter { field: source.field, shape: &shape, lattice: &lattice, sights, degree };
    let width = shape.color_width();
    let mut table = Buffer::zeros(rows * width);
    for (first, part) in (0..).step_by(BATCH).zip(table.chunks_mut(BATCH * width)) {
        parallel::for_each_chunk(part, ROWS * width, |start, chunk| no_grad(|| painter.paint(first + start / width, chunk)));
        progress((first + BATCH).min(rows), rows);
    }
    Ok(VoxelGrid::with_lattice(shape, lattice, density, Tensor::from_buffer(table, &[rows, width])))
}

/// Errors if there is less memory than `what` needs.
fn check_memory(what: &str, needed: u64) -> Result<()> {
    let Some(allowance) = allowance().filter(|allowance| needed > allowance.bytes) else { return Ok(()) };
    let found = format!("{what} needs about {} of memory, but {allowance}", bytes(needed));
    Err(Error::usage("resolution", found, "use fewer voxels per axis, or a lower degree of harmonics"))
}

/// Returns a grid of the present voxels, with densities and without colors. Voxels that the cameras see with less than `least_weight` are absent.
fn opaque(source: Source<'_>, resolution: usize, least_weight: f32, cameras: &[Camera]) -> Result<VoxelGrid<f32>> {
    let shape = GridShape {
        coordinates: source.coordinates(),
        ..GridShape::new(resolution, source.half_width(), Interpolation::Trilinear, Color::Rgb)
    };
    let (lattice, density) = no_grad(|| densities(source, &shape))?;
    let rows = lattice.rows();
    let grid = VoxelGrid::with_lattice(shape, lattice, density, Tensor::zeros(&[rows, 3]));
    if least_weight == 0.0 || cameras.is_empty() {
        return Ok(grid);
    }
    let weights = visible::weights(&grid, cameras);
    let seen = grid.voxels_where(|row| weights[row] >= least_weight).dilated(1);
    Ok(grid.pruned(&seen))
}

/// Returns the present voxels and the table of their densities, `[rows, 1]`.
fn densities(source: Source<'_>, shape: &GridShape) -> Result<(Lattice, Tensor<f32>)> {
    let coordinates = shape.coordinates;
    let (aabb, nodes) = (coordinates.unstretched(Aabb::cube(shape.half_width)), [shape.resolution; 3]);
    // Nothing outside of the occupied cells was trained.
    let sampled = source.field.reach().cloned().unwrap_or_else(|| Occupancy::new(source.aabb, [1; 3], &[true]));
    let sampled = Lattice::from_masks(nodes, sampled.resampled(aabb, nodes).masks().to_vec());
    let needed = (sampled.rows() * size_of::<f32>()) as u64;
    check_memory(&format!("sampling the densities of {} voxels", sampled.present()), needed)?;
    let mut values = vec![0.0; sampled.rows()];
    for (first, values) in (0..).step_by(BATCH).zip(values.chunks_mut(BATCH)) {
        let rows: Vec<(usize, DVec3)> =
            (0..values.len()).filter_map(|r| Some((r, coordinates.to_box(center(shape, sampled.node((first + r) as u32)?))))).collect();
        let density = source.field.density(&positions(rows.iter().map(|(_, at)| *at)));
        rows.iter().zip(density.data()).for_each(|((r, _), &density)| values[*r] = density);
    }
    let scale = (0.5 / shape.voxel_side()).min(SCALE) as f32;
    let density = |node| raw(sampled.row(node).map_or(0.0, |row| values[row as usize]), scale);
    let bricks = BrickGrid::new(nodes);
    let dense = parallel::map_indices(bricks.len(), |b| bits_where(bricks.inside(b), |bit| density(bricks.node(b, bit)) > 0.0));
    if dense.iter().all(|mask| *mask == 0) {
        let found = format!("at {0}³ voxels, no voxel is opaque", shape.resolution);
        return Err(Error::usage("resolution", found, "use more voxels per axis, or train the field longer"));
    }
    let present = Occupancy::from_masks(aabb, nodes, dense).dilated(1);
    let lattice = Lattice::from_masks(nodes, present.masks().to_vec());
    let table = parallel::map_indices(lattice.rows(), |row| lattice.node(row as u32).map_or(0.0, density));
    let rows = table.len();
    Ok((lattice, Tensor::from_vec(table, &[rows, 1])))
}

/// Returns the raw density of a voxel from the density of the field. `scale` is a.
fn raw(density: f32, scale: f32) -> f32 {
    let softplus = |x: f32| x.max(0.0) + (-x.abs()).exp().ln_1p();
    // The inverse of the softplus. For large densities, the exponential overflows and x is the density itself.
    let x = (density / scale).exp_m1().max(f32::MIN_POSITIVE).ln().min(density / scale).max(LEAST);
    density - scale * softplus(-x - BEND)
}

fn center(shape: &GridShape, node: [usize; 3]) -> DVec3 {
    shape.center(node.map(|k| k as isize))
}

/// Returns points or directions as a tensor `[m, 3]`.
fn positions(points: impl Iterator<Item = DVec3>) -> Tensor<f32> {
    let values: Vec<f32> = points.flat_map(|point| point.as_vec3().to_array()).collect();
    let m = values.len() / 3;
    Tensor::from_vec(values, &[m, 3])
}

/// Inputs of the fit of the colors.
struct Painter<'a> {
    field: &'a dyn ShadedField<f32>,
    shape: &'a GridShape,
    lattice: &'a Lattice,
    sights: Option<Sights>,
    degree: usize,
}

/// A voxel: its centre in the box, and the unit directions in the box in which its color is computed.
struct Sample {
    center: DVec3,
    directions: Vec<DVec3>,
    /// False if no camera sees the voxel.
    seen: bool,
}

impl Painter<'_> {
    /// Fits the coefficients of consecutive rows, the first of which has the number `first`. Absent rows stay 0.
    fn paint(&self, first: usize, table: &mut [f32]) {
        let count = sh::count(self.degree);
        let samples: Vec<(usize, Sample)> = (0..table.len() / (3 * count))
            .filter_map(|r| Some((r, self.sample(center(self.shape, self.lattice.node((first + r) as u32)?)))))
            .collect();
        if samples.is_empty() {
            return;
        }
        let features = self.field.features(&positions(samples.iter().map(|(_, sample)| sample.center)));
        let owners = samples.iter().enumerate().flat_map(|(i, (_, sample))| sample.directions.iter().map(move |_| i as u32));
        let owners = Indices::from(owners.collect::<Vec<_>>());
        let directions = positions(samples.iter().flat_map(|(_, sample)| sample.directions.iter().copied()));
        let colors = self.field.shade(&features.gather_rows(&owners), &directions);
        let stretched = samples.iter().flat_map(|(_, sample)| sample.directions.iter().map(|d| self.shape.coordinates.stretch * *d));
        let basis = sh::basis(&positions(stretched), self.degree);
        let (mut colors, mut basis) = (colors.data().chunks_exact(3), basis.data().chunks_exact(count));
        for (r, sample) in &samples {
            let n = sample.directions.len();
            let coefficients = &mut table[r * 3 * count..][..3 * count];
            if sample.seen {
                fit(coefficients, count, colors.by_ref().zip(basis.by_ref()).take(n));
            } else {
                for color in colors.by_ref().zip(basis.by_ref()).take(n).map(|(color, _)| color) {
                    let scale = 1.0 / (n as f32 * sh::Y0 as f32);
                    coefficients.iter_mut().step_by(count).zip(color).for_each(|(x, c)| *x += (c - OFFSET as f32) * scale);
                }
            }
        }
    }

    /// Returns the directions in which the color of a voxel is computed, given its centre in the grid.
    fn sample(&self, center: DVec3) -> Sample {
        let at = self.shape.coordinates.to_box(center);
        let Some(sights) = &self.sights else {
            return Sample { center: at, directions: all_around(MOST_DIRECTIONS).collect(), seen: true };
        };
        let world = self.shape.coordinates.to_world(center);
        let seen_by = sights.cameras_that_see(world);
        let (cameras, most) = match seen_by.is_empty() {
            true => (sights.cameras().collect(), DIRECTIONS_OF_HIDDEN),
            false => (seen_by, MOST_DIRECTIONS),
        };
        let n = cameras.len().min(most);
        let direction = |i: usize| self.shape.coordinates.space.ray(&sight(cameras[i * cameras.len() / n], world).0).direction;
        Sample { center: at, directions: (0..n).map(direction).collect(), seen: most == MOST_DIRECTIONS }
    }
}

/// Fits coefficients that are 0 to colors and the harmonics of their directions.
fn fit<'a>(coefficients: &mut [f32], count: usize, colors: impl Iterator<Item = (&'a [f32], &'a [f32])>) {
    const MOST: usize = sh::count(sh::MAX_DEGREE);
    let (mut triangle, mut right) = ([0.0; MOST * (MOST + 1) / 2], [0.0; 3 * MOST]);
    for (color, basis) in colors {
        let mut at = 0;
        for i in 0..count {
            triangle[at..=at + i].iter_mut().zip(basis).for_each(|(a, s)| *a += basis[i] * s);
            at += i + 1;
        }
        for (right, c) in right.chunks_exact_mut(count).zip(color) {
            right.iter_mut().zip(basis).for_each(|(g, s)| *g += (c - OFFSET as f32) * s);
        }
    }
    let n = triangle[0] / (sh::Y0 * sh::Y0) as f32;
    improve(coefficients, &triangle[..count * (count + 1) / 2], &right[..3 * count], RIDGE * n);
}

/// Returns `n` directions spread evenly over the sphere, on a spiral of the golden angle.
fn all_around(n: usize) -> impl Iterator<Item = DVec3> {
    const GOLDEN: f64 = 2.399_963_229_728_653;
    (0..n).map(move |i| {
        let z = 1.0 - (2 * i + 1) as f64 / n as f64;
        let (sin, cos) = (GOLDEN * i as f64).sin_cos();
        let radius = (1.0 - z * z).sqrt();
        DVec3::new(radius * cos, radius * sin, z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::encoding::Directions;
    use crate::field::factored::{Factored, Shape};
    use crate::render::Field;
    use autograd::Module;
    use autograd::random::Stream;

    const SHAPE: Shape = Shape {
        density_components: 1,
        appearance_components: 2,
        features: 2,
        hidden: 3,
        feature_octaves: 0,
        directions: Directions::Frequency(0),
    };
    const NODES: usize = 17;

    /// A blob with the feature s = 13 exp(−3 |p|²) on the nodes, and the color sigmoid(0.2 d + 0.1) in direction d: nearly linear in d.
    fn blob() -> Factored<f32> {
        let mut field = Factored::new(SHAPE, Aabb::cube(1.0), [NODES; 3], &Stream::new(1));
        let bell = |k: usize| (-3.0 * (2.0 * k as f32 / (NODES - 1) as f32 - 1.0).powi(2)).exp();
        let diagonal = |values: &mut [f32], from: usize, value: f32| {
            values.fill(0.0);
            (0..3).for_each(|c| values[(from + c) * 3 + c] = value);
        };
        field.visit_mut(&mut |param| {
            let name = param.name().to_owned();
            param.update(|values| match &*name {
                "density.plane.x" => values.iter_mut().enumerate().for_each(|(i, v)| *v = bell(i / NODES) * bell(i % NODES)),
                "density.line.x" => values.iter_mut().enumerate().for_each(|(i, v)| *v = 13.0 * bell(i)),
                name if name.starts_with("density") => values.fill(0.0),
                // The first inputs are the features. Biases keep the ReLU in its linear part.
                "color.0.weight" => diagonal(values, SHAPE.features, 1.0),
                "color.0.bias" => values.fill(2.0),
                "color.1.weight" => diagonal(values, 0, 1.0),
                "color.1.bias" => values.fill(0.0),
                "color.2.weight" => diagonal(values, 0, 0.2),
                "color.2.bias" => values.fill(0.1 - 0.4),
                _ => {}
            });
        });
        field
    }

    fn source(field: &Factored<f32>) -> Source<'_> {
        Source { field, aabb: field.aabb(), space: Space::Box }
    }

    #[test]
    fn the_density_of_a_blob_is_that_of_the_field_at_voxel_centres() {
        let field = blob();
        let grid =
            bake(source(&field), &BakeOptions { resolution: 20, degree: 0, most_voxels: usize::MAX, least_weight: 0.0 }, &[], &|_, _| {})
                .expect("an opaque blob");
        let places: Vec<DVec3> = (0..20).map(|k| center(grid.shape(), [k, 9, 10])).collect();
        let at = positions(places.iter().copied());
        let (baked, own) = (grid.density(&at), field.density(&at));
        for (baked, own) in baked.data().iter().zip(own.data()) {
            assert!((baked - own).abs() < if *own < 50.0 { 1.25 } else { 1e-2 }, "{baked} instead of {own}");
        }
        assert!(own.data().iter().any(|density| *density > 50.0));
        // The corners are empty and have no voxels.
        assert!(!grid.lattice().is_full());
        assert_eq!(grid.lattice().row([0; 3]), None);
    }

    #[test]
    fn colors_that_are_linear_in_the_direction_are_reproduced() {
        let field = blob();
        let grid =
            bake(source(&field), &BakeOptions { resolution: 12, degree: 1, most_voxels: usize::MAX, least_weight: 0.0 }, &[], &|_, _| {})
                .expect("an opaque blob");
        let row = grid.lattice().row([6; 3]).expect("the middle is opaque") as usize;
        let numbers = &grid.color.tensor().data()[row * 12..][..12];
        let directions: Vec<DVec3> = all_around(7).collect();
        let basis = sh::basis(&positions(directions.iter().copied()), 1);
        for (direction, basis) in directions.iter().zip(basis.data().chunks_exact(4)) {
            for c in 0..3 {
                let baked = 0.5 + numbers[c * 4..][..4].iter().zip(basis).map(|(x, s)| x * s).sum::<f32>();
                let own = 1.0 / (1.0 + (-(0.2 * direction[c] + 0.1)).exp());
                assert!((f64::from(baked) - own).abs() < 2e-3, "{baked} instead of {own} along {direction}");
            }
        }
    }

    #[test]
    fn a_grid_has_no_more_voxels_than_asked_for() {
        let field = blob();
        let voxels = |most_voxels| {
            let options = BakeOptions { resolution: 24, most_voxels, degree: 0, least_weight: 0.0 };
            let grid = bake(source(&field), &options, &[], &|_, _| {}).expect("an opaque blob");
            (grid.shape().resolution, grid.lattice().present())
        };
        let (resolution, all) = voxels(usize::MAX);
        assert_eq!(resolution, 24);
        let (resolution, some) = voxels(all / 6);
        assert!(resolution < 24 && (all / 20..=all / 6).contains(&some), "{some} of {all} at {resolution}³");
    }

    #[test]
    fn a_field_without_density_cannot_be_baked() {
        let mut field = blob();
        field.visit_mut(&mut |param| {
            if param.name() == "density.line.x" {
                param.update(|values| values.fill(0.0));
            }
        });
        let error =
            bake(source(&field), &BakeOptions { resolution: 8, degree: 0, most_voxels: usize::MAX, least_weight: 0.0 }, &[], &|_, _| {})
                .expect_err("nothing is opaque");
        assert!(error.to_string().contains("no voxel is opaque"), "{error}");
    }
}
