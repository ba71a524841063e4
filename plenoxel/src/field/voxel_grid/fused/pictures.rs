//! Pixels of pictures: the sums along a ray are taken while its samples are found, and only samples whose color is looked up are kept.
//!
//! Samples of little weight take the color of the next sample, or the last ones that of the sample before. The sum of such weights is at most
//! [`RenderOptions::stop_below`](crate::render::RenderOptions::stop_below) for each ray, so a color differs from that of [`render`](super::render) by at most
//! this value times the largest difference between colors along the ray.

use super::COLUMNS;
use super::forward::{Block, Scene};
use super::from_camera::FromCamera;
use super::lookup::{Corners, absorptions};
use super::places::place;
use crate::camera::Ray;
use crate::field::node_table::{self, ENTRIES, NodeTable, SIDE};
use crate::field::voxel_grid::{Interpolation, VoxelGrid};
use crate::render::RenderOptions;
use crate::render::along::Sums;
use crate::sampling::{Look, March, Occupancy, Sections, march};
use autograd::lattice::{BRICK, BRICK_ROWS, BrickGrid, STRIDE, bits_where, has, local_of};
use autograd::{Buffer, Real, dispatched, parallel};

/// Tables of a grid with trilinear look-up, from which pictures are rendered.
///
/// Colors differ from those of [`render`](super::render) in two ways. Samples whose weights sum to at most `stop_below` for each ray take the color of a
/// neighbour. Reduced harmonics are evaluated in the direction from the camera to their row. Together these changed 8-bit values of lego by at most one step.
#[derive(Debug)]
pub struct PictureTables<T> {
    densities: NodeTable<T>,
    /// Cells outside of which samples may be left out.
    cells: Occupancy,
    pub(super) from_camera: FromCamera<T>,
}

/// Offsets from a brick to itself and to the next ones along the axes.
const AHEAD: [[usize; 3]; 8] = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0], [1, 1, 1]];

impl<T: Real> PictureTables<T> {
    /// Computes the tables. Samples are left out if the densities of all voxels around them, 1 / length, are at most `negligible`. `None` for nearest
    /// look-up, and for tables of more than 2³² entries.
    pub fn new(grid: &VoxelGrid<T>, negligible: f64) -> Option<Self> {
        let (lattice, density) = (grid.lattice(), grid.density.tensor().data());
        let nodes = lattice.nodes();
        if grid.shape().interpolation != Interpolation::Trilinear || nodes.contains(&1) {
            return None;
        }
        let dense = grid.voxels_denser_than(negligible);
        // A brick of cells reads the voxels of its own brick, and those at the faces of the next ones.
        let read = AHEAD.map(|offset| bits_where(!0, |bit| (0..3).all(|a| offset[a] == 0 || local_of(bit)[a] == 0)));
        let (bricks, count) = (BrickGrid::new(nodes.map(|n| n - 1)), lattice.brick_grid().count());
        let next = |place: [usize; 3], offset: [usize; 3]| {
            let next = [0, 1, 2].map(|a| place[a] + offset[a]);
            (0..3).all(|a| next[a] < count[a]).then_some(next)
        };
        let holds = |brick: &u32| {
            let place = bricks.place(*brick as usize);
            let masks = AHEAD.iter().zip(read).filter_map(|(&offset, read)| Some((next(place, offset)?, read)));
            masks.into_iter().any(|(next, read)| dense.masks()[lattice.brick_grid().number(next)] & read != 0)
        };
        let stored = parallel::map_chunks(bricks.len(), parallel::CHUNK, |range| {
            (range.start as u32..range.end as u32).filter(holds).collect::<Vec<_>>()
        });
        let values = |brick: u32| {
            let place = bricks.place(brick as usize);
            let parts = AHEAD.map(|offset| lattice.brick(next(place, offset)?));
            let mut values = [T::zero(); ENTRIES];
            for (entry, value) in values[..SIDE * SIDE * SIDE].iter_mut().enumerate() {
                let node = [entry / (SIDE * SIDE), entry / SIDE % SIDE, entry % SIDE];
                let part = node.iter().fold(0, |part, n| 2 * part + n / BRICK);
                let bit = (0..3).map(|a| node[a] % BRICK * STRIDE[a]).sum();
                if let Some((number, _)) = parts[part].filter(|(_, mask)| has(*mask, bit)) {
                    *value = density[number * BRICK_ROWS + bit];
                }
            }
            values
        };
        let stored = stored.concat();
        if NodeTable::<T>::entries(stored.len()) > u32::MAX as usize {
            return None;
        }
        let densities = NodeTable::new(nodes, &stored, T::zero(), values);
        Some(PictureTables { densities, cells: grid.shape().cells_reading(dense), from_camera: FromCamera::none() })
    }
}

/// Pixel whose samples are found front to back.
#[derive(Clone, Copy)]
struct Pixel<T> {
    sums: Sums<T>,
    /// Transmittance behind the samples so far.
    left: T,
    /// Weight of the samples that take the color of the next one.
    waiting: T,
    /// Largest weight that may still wait.
    allowed: T,
}

impl<T: Real> Pixel<T> {
    fn new(allowed: T) -> Self {
        Pixel { sums: Sums::new(), left: T::one(), waiting: T::zero(), allowed }
    }

    /// Adds a sample of weight w. Returns the weight that its color gets; `None` if it takes the color of the next sample.
    #[inline(always)]
    fn add(&mut self, w: T, t: T, delta: T, sigma: T) -> Option<T> {
        self.sums.add(w, t, delta, sigma);
        let all = self.waiting + w;
        if all <= self.allowed {
            self.waiting = all;
            return None;
        }
        self.allowed -= self.waiting;
        self.waiting = T::zero();
        Some(all)
    }
}

impl<T: Real> Scene<'_, T> {
    /// Computes the pixels of rays from `first` on, one for each [`COLUMNS`] entries of `pixels`. Returns the number of samples.
    pub fn show(&self, tables: &PictureTables<T>, first: usize, pixels: &mut [T]) -> usize {
        let mut shown = vec![Pixel::new(T::lit(self.options.stop_below)); pixels.len() / COLUMNS];
        let mut block = self.with_color(tables, first, &mut shown);
        let at = block.at.each_ref().map(|at| &at[..]);
        let corners = with_bricks!(self.batch.layout.lattice, map => Corners::find(at, map, block.len()));
        match &self.from_camera {
            Some(rows) => self.colors_from_camera(rows, &mut block, &corners),
            None => {
                block.color = Buffer::stale(3 * block.len());
                self.colors(&mut block, Some(&corners));
            }
        }
        let (color, background) = (block.shown(self.batch), self.batch.background);
        for ((own, pixel), to) in block.rays().zip(shown).zip(pixels.as_chunks_mut::<COLUMNS>().0) {
            let (mut rgb, mut last) = ([T::zero(); 3], background);
            for i in own {
                last = color(i);
                (0..3).for_each(|c| rgb[c] += block.weight[i] * last[c]);
            }
            (0..3).for_each(|c| rgb[c] += pixel.waiting * last[c]);
            *to = pixel.sums.pixel(rgb, pixel.left, background);
        }
        block.looked_at
    }

    /// Adds the samples of rays from `first` on to their pixels. Returns those whose color is looked up: positions, and the weights of the colors.
    fn with_color(&self, tables: &PictureTables<T>, first: usize, pixels: &mut [Pixel<T>]) -> Block<T> {
        let RenderOptions { aabb, spacing, stop_below, .. } = self.options;
        let (stop, cells) = (T::lit(*stop_below), &tables.cells);
        let to_voxels = self.batch.layout.shape.to_voxels().map(T::lit);
        let rays = &self.rays[first..first + pixels.len()];
        let mut sections = Sections::new(Some(cells), *spacing);
        let (mut run, fused) = (Run::none(), parallel::fused());
        let mut block = Block { first, ..Block::empty() };
        let mut end = 0;
        for (r, (ray, pixel)) in rays.iter().zip(pixels).enumerate() {
            let section = sections.of(rays, r);
            let march = march(ray, aabb, *spacing, 0.0);
            let along = cells.along(ray);
            let mut rest = march.between(section);
            // Dense bricks are near where a section begins.
            let mut lost = section[0] == 0.0;
            while pixel.left >= stop && !rest.is_empty() {
                if lost && let Look::EmptyUntil(exit) = along.look(march.interval(rest.start).0) {
                    rest.start = (rest.start + 1).max(march.before(exit));
                    continue;
                }
                let own = RUN.min(rest.len());
                run.place(&march, ray, rest.start, to_voxels);
                rest.start += own;
                lost = !if fused { run.read::<true>(&tables.densities) } else { run.read::<false>(&tables.densities) };
                if lost {
                    continue;
                }
                if end + RUN > block.weight.len() {
                    let room = (2 * end).max(16 * rays.len());
                    block.at.iter_mut().chain([&mut block.weight]).for_each(|column| column.grow(room));
                }
                for i in 0..own {
                    if pixel.left < stop {
                        break;
                    }
                    block.looked_at += 1;
                    if run.density[i] <= T::zero() {
                        continue;
                    }
                    let weight = run.absorbed[i] * pixel.left;
                    pixel.left *= run.through[i];
                    if let Some(weight) = pixel.add(weight, run.t[i], run.delta[i], run.density[i]) {
                        block.at.iter_mut().zip(&run.at).for_each(|(column, at)| column[end] = at[i]);
                        block.weight[end] = weight;
                        end += 1;
                    }
                }
            }
            block.offsets.push(end as u32);
        }
        block.at.iter_mut().chain([&mut block.weight]).for_each(|column| column.truncate(end));
        // They are visible.
        (block.density, block.after) = (Buffer::zeros(end), Buffer::zeros(end));
        block
    }
}

/// Number of samples that are looked up together. Rays end after few samples, so that it is less than in training.
const RUN: usize = 8;

/// Consecutive samples of a ray.
struct Run<T> {
    /// Voxel coordinates.
    at: [[T; RUN]; 3],
    t: [T; RUN],
    delta: [T; RUN],
    density: [T; RUN],
    /// 1 − exp(−σδ) and exp(−σδ)
    absorbed: [T; RUN],
    through: [T; RUN],
}

impl<T: Real> Run<T> {
    fn none() -> Self {
        let none = [T::zero(); RUN];
        Run { at: [none; 3], t: none, delta: none, density: none, absorbed: none, through: none }
    }

    /// Places the samples of the intervals from `first` on.
    fn place(&mut self, march: &March, ray: &Ray, first: usize, to_voxels: [T; 2]) {
        let [x, y, z] = &mut self.at;
        place_intervals(march, ray, first, to_voxels, [x, y, z, &mut self.t, &mut self.delta]);
    }

    /// Reads the densities, and computes what they absorb. Returns false if there is no matter near the samples.
    fn read<const FUSED: bool>(&mut self, table: &NodeTable<T>) -> bool {
        let any = node_table::interpolate::<T, RUN, FUSED>(table, self.at.each_ref(), &mut self.density);
        if any {
            absorptions::<T, FUSED>(&self.density, &self.delta, &mut self.absorbed, &mut self.through);
        }
        any
    }
}

dispatched! {
fn place_intervals<T: Real>(march: &March, ray: &Ray, first: usize, to_voxels: [T; 2], out: [&mut [T; RUN]; 5]) {
    let [middles, lengths] = march.intervals::<RUN>(first);
    place(ray, [&middles, &lengths], to_voxels, out);
}
}

#[cfg(test)]
mod tests {
    use super::super::{render, render_picture};
    use super::*;
    use crate::camera::{Camera, Intrinsics};
    use crate::field::voxel_grid::{Color, GridShape};
    use crate::render::{Engine, Rendered};
    use crate::sampling::{Jitter, Spacing};
    use glam::DVec3;

    /// A ball with holes; voxels of every fifth brick have a negative density.
    fn ball(sh_reduction: usize, color: Color) -> VoxelGrid<f64> {
        let shape = GridShape { resolution: 30, half_width: 1.1, interpolation: Interpolation::Trilinear, color, sh_reduction };
        let grid = VoxelGrid::random(shape, 25.0, 0.2, 8);
        let kept = grid.voxels_where(|row| {
            let at = grid.lattice().node(row as u32).map(|node| DVec3::from_array(node.map(|n| n as f64 - 14.0)));
            at.is_some_and(|at| at.length() < 12.0 && !row.is_multiple_of(11))
        });
        let grid = grid.pruned(&kept);
        let sign = |row: usize| if (row / BRICK_ROWS).is_multiple_of(5) { -1.0 } else { 1.0 };
        let density: Vec<f64> = grid.density.tensor().data().iter().enumerate().map(|(row, density)| sign(row) * density).collect();
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
        for (sh_reduction, color) in KINDS {
            let (grid, rays, options) = (ball(sh_reduction, color), rays(3.0, 48), options(0.0));
            let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
            let [want, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
            assert!(difference(&want, &found) < 1e-10, "{color:?}: {}", difference(&want, &found));
            assert!(want.opacity.data().iter().filter(|&&opacity| opacity > 0.9).count() > 500);
        }
    }

    #[test]
    fn colors_of_other_samples_change_a_pixel_by_less_than_the_bound() {
        let (grid, rays) = (ball(1, Color::Rgb), rays(3.0, 48));
        let (options, bound) = (options(0.02), 0.02);
        let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
        let [want, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
        // Colors of samples are at most 0.2 apart, those of the background up to 1.
        let largest = (&want.rgb - &found.rgb).data().iter().fold(0.0, |largest: f64, d| largest.max(d.abs()));
        assert!(largest > 1e-4 && largest <= bound, "{largest}");
        assert!((&want.opacity - &found.opacity).data().iter().all(|d| d.abs() < 1e-12));
    }

    #[test]
    fn harmonics_seen_from_a_far_camera_change_no_pixel_by_half_a_step() {
        let (sh_reduction, color) = KINDS[2];
        let (grid, options) = (ball(sh_reduction, color), options(0.0));
        let tables = PictureTables::new(&grid, 0.0).expect("trilinear look-up");
        let rays = rays(12.0, 128);
        let [want, found] = [render(&grid, &rays, &options), render_picture(&grid, &tables, &rays, &options)];
        assert!((1e-7..0.5 / 255.0).contains(&difference(&want, &found)), "{}", difference(&want, &found));
    }

    #[test]
    fn pictures_have_the_same_bits_for_any_number_of_threads() {
        let (sh_reduction, color) = KINDS[2];
        let (grid, options, rays) = (ball(sh_reduction, color), options(1e-3), rays(12.0, 128));
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
            GridShape { resolution: 4, interpolation: Interpolation::Nearest, ..*ball(1, Color::Rgb).shape() },
            1.0,
            0.5,
        );
        assert!(PictureTables::new(&grid, 0.0).is_none());
    }
}
