//! Pixels of pictures: the sums along a ray are taken while its samples are found, and only samples whose color is looked up are kept.
//!
//! Samples of little weight take the color of the next sample, or the last ones that of the sample before. The sum of such weights is at most
//! [`RenderOptions::stop_below`](crate::render::RenderOptions::stop_below) for each ray, so a color differs from that of [`render`](super::render) by at most
//! this value times the largest difference between colors along the ray. This holds for pictures without groups ([`PictureTables::in_groups_of`]).

use super::COLUMNS;
use super::cell_bricks::CellBricks;
use super::forward::{Block, Scene};
use super::from_camera::{Colors, FromCamera};
use super::lookup::Corners;
use crate::camera::Ray;
use crate::field::lanes::{Bent, Guide, LANES, Matter, Shown, Straight};
use crate::field::node_table::{NodeTable, StoredBricks};
use crate::field::voxel_grid::{Interpolation, VoxelGrid};
use crate::sampling::{Occupancy, Spacing};
use autograd::{Buffer, Real};
use glam::DVec3;
use std::sync::Arc;

/// Tables of a grid with trilinear look-up, from which pictures are rendered.
///
/// Colors differ from those of [`render`](super::render) in two ways, and positions are rounded to the precision of the grid. Samples whose weights sum to at most `stop_below` for each ray take the color of a
/// neighbour. Harmonics are evaluated in the direction from a far camera to their row. Together these changed 8-bit values of lego, with reduced harmonics, by at
/// most one step.
#[derive(Debug)]
pub struct PictureTables<T: Real> {
    densities: NodeTable<T>,
    /// Cells outside of which samples may be left out.
    cells: Occupancy,
    group: f64,
    from_camera: FromCamera<T>,
}

impl<T: Real> PictureTables<T> {
    /// Side of the tiles of pixels that are rendered at a time: a ray takes little memory, and each tile has 256 tasks.
    pub const TILE: usize = 256;

    /// Computes the tables. Samples are left out if the densities of all voxels around them, 1 / length, are at most `negligible`. `None` for nearest
    /// look-up, for grids of one voxel along an axis, and for tables of more than 2³² entries.
    pub fn new(grid: &VoxelGrid<T>, negligible: f64) -> Option<Self> {
        let (lattice, density) = (grid.lattice(), grid.density.tensor().data());
        let nodes = lattice.nodes();
        if grid.shape().interpolation != Interpolation::Trilinear || nodes.contains(&1) {
            return None;
        }
        let dense = grid.voxels_denser_than(negligible);
        let bricks = CellBricks::new(lattice);
        let stored = StoredBricks::new(nodes, bricks.reading(dense.masks()))?;
        let densities =
            NodeTable::new(Arc::new(stored), [T::zero()], |brick, values| bricks.fill(brick, [T::zero()], |row| [density[row]], values));
        Some(PictureTables { densities, cells: grid.shape().cells_reading(dense), group: 0.0, from_camera: FromCamera::none() })
    }

    /// Sets the sum of weights of consecutive samples up to which they take the color of the next one, however many there are. The last samples of a ray take the color
    /// before them, or that of the background. 0 leaves the bound of `stop_below`.
    pub fn in_groups_of(self, weight: f64) -> Self {
        PictureTables { group: weight, ..self }
    }

    /// Returns the colors of the grid as seen by these rays ([`FromCamera::of`]).
    pub(super) fn colors_from_camera(&self, grid: &VoxelGrid<T>, rays: &[Ray]) -> Option<Arc<Colors<T>>> {
        self.from_camera.of(grid, self.densities.bricks(), rays)
    }
}

impl<T: Real> Matter<T> for PictureTables<T> {
    fn table(&self) -> &NodeTable<T> {
        &self.densities
    }

    #[inline(always)]
    fn sigma<const FUSED: bool>(&self, _: &[[T; LANES]; 3], mut densities: [T; LANES]) -> [T; LANES] {
        for density in &mut densities {
            // `max` would turn a density that is not a number into 0.
            *density = if *density < T::zero() { T::zero() } else { *density };
        }
        densities
    }
}

impl<T: Real> Scene<'_, T> {
    /// Computes the pixels of rays from `first` on, one for each [`COLUMNS`] entries of `pixels`. Returns the number of samples.
    pub fn show(&self, tables: &PictureTables<T>, first: usize, pixels: &mut [T]) -> usize {
        let pixels = pixels.as_chunks_mut::<COLUMNS>().0;
        let (options, to_cells) = (self.options, self.batch.layout.shape.to_voxels().map(DVec3::splat));
        let guide = Guide { matter: tables, options, cells: &tables.cells, to_cells, merged: options.stop_below, group: tables.group };
        let rays = &self.rays[first..first + pixels.len()];
        let mut shown = match options.spacing {
            Spacing::Contracted(_) => guide.lead::<T, Bent<T>, 4>(rays),
            Spacing::Step(_) | Spacing::Points { .. } => guide.lead::<T, Straight<T>, 4>(rays),
        };
        let (colors, width) = match &self.from_camera {
            Some(colors) => (colors.at(shown.at(), &self.batch.layout.shape), 4),
            None => (self.colors_along_rays(first, &mut shown), 3),
        };
        let color = |i: usize| self.batch.shown([0, 1, 2].map(|c| colors[i * width + c]));
        shown.write(shown.weight(), color, self.batch.background, pixels);
        shown.looked_at
    }

    /// Computes the colors of samples, as seen along their rays. Sorts the samples by their rays, and takes their positions.
    fn colors_along_rays(&self, first: usize, shown: &mut Shown<T, 4>) -> Buffer<T> {
        let offsets = shown.sort();
        let count = shown.of.len();
        let corners = with_bricks!(self.batch.layout.lattice, map => Corners::find(shown.at(), map, count));
        let [x, y, z, weight] = &mut shown.columns;
        let (at, weight) = ([x, y, z].map(std::mem::take), Buffer::copy_of(weight));
        // All samples have a weight, so they are visible with any density of 0 or more, whatever the transmittance behind them.
        let [density, after] = [Buffer::zeros(count), Buffer::zeros(count)];
        let mut block =
            Block { first, offsets, at, corners: Some(corners), weight, density, after, color: Buffer::stale(3 * count), ..Block::empty() };
        self.colors(&mut block);
        block.color
    }
}

#[cfg(test)]
mod tests {
    use super::super::{render, render_picture};
    use super::*;
    use crate::camera::{Camera, Intrinsics};
    use crate::field::Field;
    use crate::field::voxel_grid::{Color, GridShape, GridSpace};
    use crate::render::{Engine, RenderOptions, Rendered};
    use crate::sampling::{Jitter, sample};
    use crate::space::Space;
    use autograd::lattice::BRICK_ROWS;

    /// A ball with holes; voxels of every fifth brick have a negative density.
    fn ball<T: Real>(sh_reduction: usize, color: Color) -> VoxelGrid<T> {
        let shape = GridShape { sh_reduction, ..GridShape::new(30, 1.1, Interpolation::Trilinear, color) };
        let grid = VoxelGrid::random(shape, 25.0, 0.2, 8);
        let kept = grid.voxels_where(|row| {
            let at = grid.lattice().node(row as u32).map(|node| DVec3::from_array(node.map(|n| n as f64 - 14.0)));
            at.is_some_and(|at| at.length() < 12.0 && !row.is_multiple_of(11))
        });
        let grid = grid.pruned(&kept);
        let sign = |row: usize| if (row / BRICK_ROWS).is_multiple_of(5) { -1.0 } else { 1.0 };
        let density: Vec<T> = grid.density.tensor().data().iter().enumerate().map(|(row, &density)| T::lit(sign(row)) * density).collect();
        grid.with_density(autograd::Tensor::from_vec(density, grid.density.tensor().shape()))
    }

    fn rays(distance: f64, side: usize) -> Vec<Ray> {
        let eye = distance * DVec3::new(0.5, -0.7, 0.5).normalize();
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(side, side, 2.4 / distance));
        (0..side * side).map(|i| camera.ray((i % side) as f64 + 0.5, (i / side) as f64 + 0.5)).collect()
    }

    fn options(stop_below: f64) -> RenderOptions<'static> {
        RenderOptions {
            aabb: crate::geometry::Aabb::cube(1.1),
            spacing: Spacing::Step(0.06),
            jitter: Jitter::None,
            background: [1.0, 0.5, 0.0],
            occupancy: None,
            engine: Engine::Fused,
            stop_below,
        }
    }

    /// Returns the largest difference between columns of two batches.
    fn difference(a: &Rendered<f64>, b: &Rendered<f64>) -> f64 {
        let columns = |of: &Rendered<f64>| [of.rgb.clone(), of.opacity.clone(), of.log_transmittance.clone(), of.depth(), of.distortion()];
        let pairs = columns(a).into_iter().zip(columns(b));
        pairs.flat_map(|(a, b)| a.data().iter().zip(b.data()).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>()).fold(0.0, f64::max)
    }

    const KINDS: [(usize, Color); 3] =
        [(1, Color::Rgb), (1, Color::Sh { degree: 1, offset: 0.5 }), (3, Color::Sh { degree: 2, offset: 0.5 })];

    #[test]
    fn pictures_are_those_of_the_other_renderer() {
        // Rays of the contracted space bend beyond 1, in the ball.
        let spacings = [(options(0.0).spacing, 3.0), (Spacing::Points { samples: 80, far: 5.0 }, 3.0), (Spacing::Contracted(0.06), 1.3)];
        for ((sh_reduction, color), (spacing, distance)) in KINDS.into_iter().flat_map(|kind| spacings.map(|spacing| (kind, spacing))) {
            let (grid, rays, options) = (ball::<f64>(sh_reduction, color), rays(distance, 48), RenderOptions { spacing, ..options(0.0) });
            let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
            let [want, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
            assert!(difference(&want, &found) < 1e-10, "{color:?}: {}", difference(&want, &found));
            assert!(want.opacity.data().iter().filter(|&&opacity| opacity > 0.9).count() > 500);
        }
    }

    #[test]
    fn single_precision_changes_no_color_by_a_tenth_of_a_step_from_near_or_far() {
        let (grid, single) = (ball::<f64>(1, Color::Rgb), ball::<f32>(1, Color::Rgb));
        let tables = PictureTables::new(&single, 0.0).expect("trilinear look-up");
        for distance in [3.0, 3000.0] {
            let rays = rays(distance, 48);
            let want = render(&grid, &rays, &options(0.0));
            let found = render_picture(&single, &tables, &rays, &options(0.0));
            let largest = |a: &autograd::Tensor<f64>, b: &autograd::Tensor<f32>| {
                a.data().iter().zip(b.data()).map(|(a, b)| (a - f64::from(*b)).abs()).fold(0.0, f64::max)
            };
            let [rgb, opacity] = [largest(&want.rgb, &found.rgb), largest(&want.opacity, &found.opacity)];
            assert!(rgb > 0.0 && rgb.max(opacity) < 0.1 / 255.0, "{rgb} and {opacity} at distance {distance}");
            // Depths are sums of distances from the camera.
            let depth = largest(&want.depth(), &found.depth());
            assert!(depth < 3e-6 * distance + 1e-4, "{depth} at distance {distance}");
        }
    }

    #[test]
    fn colors_of_other_samples_change_a_pixel_by_less_than_the_bound() {
        let (grid, rays) = (ball::<f64>(1, Color::Rgb), rays(3.0, 48));
        let (options, bound) = (options(0.02), 0.02);
        let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
        let [want, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
        // Colors of samples are at most 0.2 apart, those of the background up to 1.
        let largest = (&want.rgb - &found.rgb).data().iter().fold(0.0, |largest: f64, d| largest.max(d.abs()));
        assert!(largest > 1e-4 && largest <= bound, "{largest}");
        assert!((&want.opacity - &found.opacity).data().iter().all(|d| d.abs() < 1e-12));
    }

    #[test]
    fn colors_seen_from_a_far_camera_change_no_pixel_by_half_a_step() {
        for (sh_reduction, color) in KINDS {
            let (grid, options) = (ball::<f64>(sh_reduction, color), options(0.0));
            let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
            // The nearest camera that is far enough.
            let mut cameras = (20..).map(|tenths| rays(0.1 * f64::from(tenths), 128));
            let rays = cameras.find(|rays| tables.colors_from_camera(&grid, rays).is_some()).expect("a far camera");
            let [want, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
            let bounds = if color == Color::Rgb { 0.0..1e-10 } else { 1e-7..0.5 / 255.0 };
            assert!(bounds.contains(&difference(&want, &found)), "{color:?}: {}", difference(&want, &found));
        }
    }

    #[test]
    fn far_cameras_of_the_contracted_space_see_colors_along_their_rays() {
        let color = Color::Sh { degree: 1, offset: 0.5 };
        let contracted = GridSpace { space: Space::Contracted, ..GridSpace::WORLD };
        for coordinates in [GridSpace::WORLD, contracted] {
            let shape = GridShape { coordinates, ..GridShape::new(12, Space::CONTRACTED, Interpolation::Trilinear, color) };
            let grid = VoxelGrid::<f32>::random(shape, 25.0, 0.2, 8);
            let (tables, rays) = (PictureTables::new(&grid, 0.0).expect("trilinear look-up"), rays(20.0, 128));
            let colors = (0..3).filter_map(|_| tables.colors_from_camera(&grid, &rays)).next();
            assert_eq!(colors.is_some(), coordinates == GridSpace::WORLD);
        }
    }

    #[test]
    fn samples_of_a_group_have_the_color_of_the_last_one() {
        const GROUP: f64 = 0.1;
        let (grid, rays, options) = (ball::<f64>(1, Color::Sh { degree: 1, offset: 0.5 }), rays(3.0, 48), options(0.0));
        let samples = sample::<f64>(&rays, &options.aabb, options.spacing, Jitter::None, None);
        let radiance = grid.radiance(&samples);
        let (sigma, delta, color) = (radiance.sigma.data(), samples.delta.data(), radiance.rgb.data().as_chunks::<3>().0);
        let pixel = |own: std::ops::Range<usize>| {
            let (mut left, mut waiting, mut last, mut rgb) = (1.0, 0.0, options.background.map(f64::from), [0.0; 3]);
            for i in own.filter(|&i| sigma[i] > 0.0) {
                let through = (-sigma[i] * delta[i]).exp();
                waiting += left * (1.0 - through);
                left *= through;
                if waiting > GROUP {
                    last = color[i];
                    (0..3).for_each(|c| rgb[c] += waiting * last[c]);
                    waiting = 0.0;
                }
            }
            // The last samples take the color before them.
            [0, 1, 2].map(|c| rgb[c] + waiting * last[c] + left * f64::from(options.background[c]))
        };
        let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up").in_groups_of(GROUP);
        let [whole, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
        let mut changed = 0;
        for (r, own) in samples.offsets.windows(2).enumerate() {
            let [whole, found] = [&whole, &found].map(|rendered| rendered.rgb.data().as_chunks::<3>().0[r]);
            let want = pixel(own[0] as usize..own[1] as usize);
            assert!((0..3).all(|c| (found[c] - want[c]).abs() < 1e-10), "ray {r}: {found:?}, not {want:?}");
            changed += usize::from((0..3).any(|c| (found[c] - whole[c]).abs() > 1e-3));
        }
        assert!(changed > 100, "{changed}");
        assert!((&whole.opacity - &found.opacity).data().iter().all(|d| d.abs() < 1e-12));
    }

    #[test]
    fn pictures_have_the_same_bits_for_any_number_of_threads() {
        let (sh_reduction, color) = KINDS[2];
        let (grid, options, rays) = (ball::<f64>(sh_reduction, color), options(1e-3), rays(12.0, 128));
        let bits = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| {
                let tables = PictureTables::new(&grid, 1e-3).expect("trilinear look-up");
                let rendered = render_picture(&grid, &tables, &rays, &options);
                rendered.rgb.data().iter().chain(rendered.depth().data()).map(|x| x.to_bits()).collect::<Vec<_>>()
            })
        };
        assert!(bits(1) == bits(2) && bits(1) == bits(3));
    }

    #[test]
    fn nearest_look_up_has_no_tables() {
        let grid = VoxelGrid::<f64>::uniform(
            GridShape { resolution: 4, interpolation: Interpolation::Nearest, ..*ball::<f64>(1, Color::Rgb).shape() },
            1.0,
            0.5,
        );
        assert!(PictureTables::new(&grid, 0.0).is_none());
    }
}
