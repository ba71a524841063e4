//! Pixels of rays, one block of rays at a time.

use super::from_camera::Colors;
use super::lookup::{self, Corners, Directions, Group};
use super::pictures::PictureTables;
use super::places::Places;
use super::{BLOCK, Batch, COLUMNS};
use crate::camera::Ray;
use crate::field::voxel_grid::{Color, Interpolation};
use crate::render::RenderOptions;
use crate::render::along::{self, Along};
use crate::sampling::{March, Occupancy, Sections, march};
use autograd::lattice::{NodeMap, TOGETHER};
use autograd::{Buffer, Real, Tensor, parallel};
use std::ops::Range;
use std::sync::Arc;

/// Samples of a block of rays, with the data that the adjoint needs. Arrays have one entry per sample unless stated otherwise.
#[derive(Debug)]
pub(super) struct Block<T: Real> {
    /// Number of the first ray.
    pub first: usize,
    /// Number of evaluated samples, including samples without density, which are not kept.
    pub looked_at: usize,
    /// Ray r of the block owns the samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<u32>,
    /// Density as looked up; σ = max(0, density).
    pub density: Buffer<T>,
    /// Voxel coordinates. This and all following fields are empty if no gradient is recorded.
    pub at: [Buffer<T>; 3],
    /// Row that nearest look-up reads; empty with trilinear look-up.
    pub rows: Buffer<u32>,
    /// Rows and weights of trilinear look-up; `None` with nearest look-up.
    pub corners: Option<Corners<T>>,
    pub t: Buffer<T>,
    pub delta: Buffer<T>,
    /// wᵢ = Tᵢ (1 − exp(−σᵢδᵢ))
    pub weight: Buffer<T>,
    /// Tᵢ₊₁
    pub after: Buffer<T>,
    /// Color, three numbers per sample; before the clamping of harmonics at 0.
    pub color: Buffer<T>,
}

impl<T: Real> Block<T> {
    pub fn len(&self) -> usize {
        self.offsets[self.offsets.len() - 1] as usize
    }

    /// Returns the samples of each ray.
    pub fn rays(&self) -> impl DoubleEndedIterator<Item = Range<usize>> + '_ {
        self.offsets.windows(2).map(|o| o[0] as usize..o[1] as usize)
    }

    /// Returns a predicate that is true for samples that would be visible if they were dense.
    #[inline(always)]
    pub fn seen(&self) -> impl Fn(usize) -> bool {
        let (density, after, weight) = (&self.density[..], &self.after[..], &self.weight[..]);
        |i| density[i] >= T::zero() && (after[i] > T::zero() || weight[i] > T::zero())
    }

    /// Returns the rows and weights of trilinear look-up.
    ///
    /// Panics with nearest look-up.
    pub fn trilinear(&self) -> &Corners<T> {
        self.corners.as_ref().expect("trilinear look-up has corners")
    }

    /// Returns the samples as rendering sees them.
    pub fn along(&self) -> Along<'_, T> {
        Along { t: &self.t, delta: &self.delta, weight: &self.weight, after: &self.after }
    }

    /// Returns a function to the color of a sample ([`Batch::shown`]).
    #[inline(always)]
    pub fn shown<'a>(&'a self, batch: &'a Batch<T>) -> impl Fn(usize) -> [T; 3] + 'a {
        let colors = self.color.as_chunks::<3>().0;
        |i| batch.shown(colors[i])
    }

    /// Returns Σ ln(1 + 2σᵢ²) of each ray.
    pub fn sparsity(&self) -> impl Iterator<Item = T> + '_ {
        self.rays().map(|own| self.density[own].iter().map(|&d| along::sparsity(d.max(T::zero()))).sum())
    }
}

/// Number of rays whose samples are all placed before the first of these samples is looked up, with nearest look-up and if rays do not end early.
const RAYS_TOGETHER: usize = 32;

/// Smallest capacity of the arrays of a block, in samples. Capacities are powers of two, so that the arrays of one block fit another.
const ROOM: usize = 32 * BLOCK;

/// Inputs of rendering a batch.
pub(super) struct Scene<'a, T: Real> {
    pub batch: &'a Batch<T>,
    pub rays: &'a [Ray],
    pub options: &'a RenderOptions<'a>,
    pub cells: Option<&'a Occupancy>,
    /// Density, color and, if harmonics are reduced, harmonics.
    pub tables: [&'a [T]; 3],
    /// True for pictures, whose rays are those of neighbouring pixels: packets of them skip the empty space around the scene together ([`Sections`]).
    pub packets: bool,
    /// Tables from which pictures are rendered.
    pub picture: Option<&'a PictureTables<T>>,
    /// Colors as seen from the camera, if they are known.
    pub from_camera: Option<Arc<Colors<T>>>,
}

impl<'a, T: Real> Scene<'a, T> {
    /// Creates a scene from the tables of a grid.
    pub fn new(
        batch: &'a Batch<T>,
        rays: &'a [Ray],
        options: &'a RenderOptions<'a>,
        cells: Option<&'a Occupancy>,
        tables: impl IntoIterator<Item = &'a Tensor<T>>,
    ) -> Self {
        let mut scene = Scene { batch, rays, options, cells, tables: [&[]; 3], packets: false, picture: None, from_camera: None };
        scene.tables.iter_mut().zip(tables).for_each(|(table, tensor)| *table = tensor.data());
        scene
    }

    /// Renders rays from `first` on, one for each [`COLUMNS`] entries of `pixels`.
    pub fn render(&self, first: usize, pixels: &mut [T], keep: bool) -> Block<T> {
        if let Some(tables) = self.picture {
            return Block { first, looked_at: self.show(tables, first, pixels), ..Block::empty() };
        }
        let mut block = self.weights(first, pixels.len() / COLUMNS);
        block.color = Buffer::stale(3 * block.len());
        self.colors(&mut block);
        self.sum(&block, pixels);
        if !keep {
            return Block { first, looked_at: block.looked_at, offsets: block.offsets, ..Block::empty() };
        }
        block
    }

    /// Computes the samples of `count` rays from `first` on, without colors.
    pub fn weights(&self, first: usize, count: usize) -> Block<T> {
        let trilinear = self.batch.layout.shape.interpolation == Interpolation::Trilinear;
        with_bricks!(self.batch.layout.lattice, map => {
            // Where rays end early, samples far behind the end would be looked up in vain. Trilinear look-up finds corners in groups of `TOGETHER`.
            if trilinear || self.options.stop_below > 0.0 {
                self.weights_in_runs(map, first, count)
            } else {
                self.weights_of_whole_rays(map, first, count)
            }
        })
    }

    /// Makes room for all samples of rays at once if all samples of their marches are placed: growing copies.
    fn make_room_for_all(&self, block: &mut Block<T>, rays: &[Ray], first: usize) {
        if self.cells.is_none() && self.options.stop_below <= 0.0 {
            let samples: usize = (0..rays.len()).map(|r| self.march_of(rays, first, r).count).sum();
            // Every run has room for a whole one, also the last.
            block.make_room_for((samples + TOGETHER).max(ROOM).next_power_of_two());
        }
    }

    /// Computes the samples of rays that do not end early, with nearest look-up. Groups of rays are placed, then looked up, then weighed, so that no ray
    /// of a group waits for the densities of the one before. Samples that are kept move to the front; `end` never passes the sample that is read.
    fn weights_of_whole_rays(&self, map: impl NodeMap, first: usize, count: usize) -> Block<T> {
        let mut block = Block { first, ..Block::empty() };
        let rays = &self.rays[first..first + count];
        self.make_room_for_all(&mut block, rays, first);
        let mut sections = self.sections();
        let mut end = 0;
        for start in (0..count).step_by(RAYS_TOGETHER) {
            let together = start..count.min(start + RAYS_TOGETHER);
            let mut placed = end;
            let mut ends = [0; RAYS_TOGETHER];
            for r in together.clone() {
                let mut places = self.samples_of(rays, first, r, &mut sections);
                loop {
                    if placed + TOGETHER > block.t.len() {
                        block.make_room();
                    }
                    match places.next_run(block.places(placed)) {
                        0 => break,
                        own => placed += own,
                    }
                }
                ends[r - start] = placed;
            }
            self.find_nearest(map, &mut block, end..placed);
            self.read_nearest(&mut block, end..placed);
            block.looked_at += placed - end;
            let mut begin = end;
            for &ray_end in &ends[..together.len()] {
                let mut left = T::one();
                for i in begin..ray_end {
                    end += usize::from(block.keep(i, &mut left, end));
                }
                begin = ray_end;
                block.offsets.push(end as u32);
            }
        }
        block.truncate(end);
        block
    }

    /// Computes the samples in runs of at most [`TOGETHER`]. The densities of the next run are prefetched while this one is looked up.
    fn weights_in_runs(&self, map: impl NodeMap, first: usize, count: usize) -> Block<T> {
        let stop = T::lit(self.options.stop_below);
        let trilinear = self.batch.layout.shape.interpolation == Interpolation::Trilinear;
        let mut block = Block { first, corners: trilinear.then(Corners::none), ..Block::empty() };
        let [mut group, mut next_group] = [Group::none(), Group::none()];
        let mut kept = [0; TOGETHER];
        let mut end = 0;
        let rays = &self.rays[first..first + count];
        self.make_room_for_all(&mut block, rays, first);
        let mut sections = self.sections();
        for r in 0..count {
            let mut places = self.samples_of(rays, first, r, &mut sections);
            let mut left = T::one();
            // Places the run that begins at a sample, finds its rows, and prefetches their densities.
            let mut place = |start: usize, block: &mut Block<T>, group: &mut Group<T>| {
                if start + TOGETHER > block.t.len() {
                    block.make_room();
                }
                let run = start..start + places.next_run(block.places(start));
                if !trilinear {
                    self.find_nearest(map, block, run.clone());
                } else if !run.is_empty() {
                    group.find(block.at.each_ref().map(|at| &at[run.clone()]), map);
                    group.prefetch_rows(self.tables[0]);
                }
                run
            };
            let mut run = place(end, &mut block, &mut group);
            // Samples behind the stop are not looked up, except for the rest of the run in which the ray stops; that rest is dropped. The run behind it is placed
            // in vain.
            while left >= stop && !run.is_empty() {
                let next = place(run.end, &mut block, &mut next_group);
                if trilinear {
                    group.density(self.tables[0], &mut block.density[run.clone()]);
                    block.find_absorptions(run.clone());
                } else {
                    self.read_nearest(&mut block, run.clone());
                }
                let before = end;
                let start = run.start;
                for i in run {
                    if left < stop {
                        break;
                    }
                    block.looked_at += 1;
                    if block.keep(i, &mut left, end) {
                        kept[end - before] = i - start;
                        end += 1;
                    }
                }
                if let Some(corners) = &mut block.corners {
                    corners.put(before, kept[..end - before].iter().copied(), &group);
                }
                run = next;
                std::mem::swap(&mut group, &mut next_group);
            }
            block.offsets.push(end as u32);
        }
        block.truncate(end);
        block
    }

    /// Returns the sections of packets of rays. They are whole rays if the rays are not those of a picture.
    fn sections(&self) -> Sections<'a> {
        Sections::new(self.cells.filter(|_| self.packets), self.options.spacing)
    }

    /// Returns the march along `rays[r]`. `rays[0]` has number `first` in the batch, on which the jitter depends.
    fn march_of(&self, rays: &[Ray], first: usize, r: usize) -> March {
        let RenderOptions { aabb, spacing, jitter, .. } = self.options;
        march(&rays[r], aabb, *spacing, jitter.of(first + r))
    }

    /// Returns the samples of `rays[r]`; see [`march_of`](Self::march_of).
    fn samples_of(&self, rays: &'a [Ray], first: usize, r: usize, sections: &mut Sections<'_>) -> Places<'a, T> {
        let march = self.march_of(rays, first, r);
        let occupied = self.cells.map(|cells| march.occupied(&rays[r], cells).between(sections.of(rays, r)));
        Places::new(march, &rays[r], occupied, &self.batch.layout.shape)
    }

    /// Finds the rows of some samples with nearest look-up, and prefetches their densities.
    fn find_nearest(&self, map: impl NodeMap, block: &mut Block<T>, samples: Range<usize>) {
        let rows = &mut block.rows[samples.clone()];
        lookup::nearest_rows(block.at.each_ref().map(|at| &at[samples.clone()]), map, rows);
        lookup::prefetch_rows(self.tables[0], rows);
    }

    /// Reads the densities of rows that were found before, and computes absorptions.
    fn read_nearest(&self, block: &mut Block<T>, samples: Range<usize>) {
        // Absent voxels have density -1: no light, and no gradient.
        lookup::read_or(self.tables[0], &block.rows[samples.clone()], -T::one(), &mut block.density[samples.clone()]);
        block.find_absorptions(samples);
    }

    /// Computes the color of every sample that would be visible if it were dense, and zero for the others.
    pub fn colors(&self, block: &mut Block<T>) {
        let mut color = std::mem::replace(&mut block.color, Buffer::stale(0));
        let out = color.as_chunks_mut::<3>().0;
        let seen = block.seen();
        let nearest = |i: usize| ([block.rows[i]], [T::one()]);
        match (self.directions(block.first), &block.corners) {
            (None, None) => lookup::plain(self.tables[1], nearest, seen, out),
            (None, Some(corners)) => lookup::plain(self.tables[1], |i| corners.of(i), seen, out),
            (Some(directions), None) => lookup::harmonics(self.tables[1], &block.offsets, directions, nearest, seen, out),
            (Some(directions), Some(corners)) => {
                lookup::harmonics(self.tables[1], &block.offsets, directions, |i| corners.of(i), seen, out);
            }
        }
        if let Some(lattice) = &self.batch.layout.harmonics {
            self.add_harmonics(lattice, block, out);
        }
        block.color = color;
    }

    /// Returns the harmonics of rays from `first` on; `None` if rows of the color table hold no harmonics.
    pub fn directions(&self, first: usize) -> Option<Directions<'_, T>> {
        let Color::Sh { offset, .. } = self.batch.layout.shape.color else { return None };
        let count = self.batch.harmonics();
        (count > 0).then(|| Directions { basis: &self.batch.basis().data()[first * count..], count, offset: T::lit(offset) })
    }

    /// Computes pixels from weights and colors.
    pub fn sum(&self, block: &Block<T>, pixels: &mut [T]) {
        let (along, color) = (block.along(), block.shown(self.batch));
        for (own, pixel) in block.rays().zip(pixels.as_chunks_mut::<COLUMNS>().0) {
            *pixel = along.pixel(own, self.batch.background, |i| block.density[i].max(T::zero()), &color);
        }
    }
}

impl<T: Real> Block<T> {
    pub fn empty() -> Self {
        let none = || Buffer::stale(0);
        Block {
            first: 0,
            looked_at: 0,
            offsets: vec![0],
            density: none(),
            at: [none(), none(), none()],
            rows: Buffer::stale(0),
            corners: None,
            t: none(),
            delta: none(),
            weight: none(),
            after: none(),
            color: none(),
        }
    }

    /// Returns the columns of each sample, except row, corners and color.
    fn columns(&mut self) -> [&mut Buffer<T>; 8] {
        let [x, y, z] = &mut self.at;
        [x, y, z, &mut self.t, &mut self.delta, &mut self.density, &mut self.weight, &mut self.after]
    }

    /// Doubles the capacity for samples.
    fn make_room(&mut self) {
        self.make_room_for((2 * self.t.len()).max(ROOM));
    }

    /// Raises the capacity to `size` samples.
    fn make_room_for(&mut self, size: usize) {
        self.columns().into_iter().for_each(|column| column.grow(size));
        match &mut self.corners {
            Some(corners) => corners.make_room(size),
            None => self.rows.grow(size),
        }
    }

    /// Returns positions, middles and lengths of the run of samples from `end` on.
    fn places(&mut self, end: usize) -> [&mut [T; TOGETHER]; 5] {
        let [x, y, z, t, delta, ..] = self.columns();
        [x, y, z, t, delta].map(|column| column[end..].first_chunk_mut().expect("there is room for a run"))
    }

    /// Computes the absorbed and the transmitted fraction of the interval of each sample from its density, and stores them in `weight` and `after`.
    fn find_absorptions(&mut self, samples: Range<usize>) {
        let (density, delta) = (&self.density[samples.clone()], &self.delta[samples.clone()]);
        let (weight, after) = (&mut self.weight[samples.clone()], &mut self.after[samples]);
        if parallel::fused() {
            lookup::absorptions::<T, true>(density, delta, weight, after);
        } else {
            lookup::absorptions::<T, false>(density, delta, weight, after);
        }
    }

    /// Computes weight and transmittance of sample i from the fractions that [`find_absorptions`](Self::find_absorptions) stored and the transmittance
    /// `left` in front of it, and moves it to `end` <= i. If its density is negative, does nothing and returns false: such a sample absorbs nothing, and
    /// no gradient changes it.
    #[inline(always)]
    fn keep(&mut self, i: usize, left: &mut T, end: usize) -> bool {
        if self.density[i] < T::zero() {
            return false;
        }
        self.weight[i] *= *left;
        *left *= self.after[i];
        self.after[i] = *left;
        if i != end {
            self.columns().into_iter().for_each(|column| column[end] = column[i]);
            if !self.rows.is_empty() {
                self.rows[end] = self.rows[i];
            }
        }
        true
    }

    fn truncate(&mut self, count: usize) {
        self.columns().into_iter().for_each(|column| column.truncate(count));
        self.rows.truncate(count);
        self.corners.iter_mut().for_each(|corners| corners.truncate(count));
    }
}

#[cfg(test)]
mod tests {
    use super::super::render;
    use crate::camera::Ray;
    use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
    use crate::geometry::Aabb;
    use crate::render::{Engine, RenderOptions};
    use crate::sampling::{Jitter, Spacing};
    use glam::DVec3;
    use std::slice::from_ref;

    #[test]
    fn each_ray_of_a_batch_has_the_pixel_that_it_has_alone() {
        // Rays beside the box, through edges and through the middle: with no sample, with less than a run, and with several runs.
        let ray = |i: usize| {
            let origin = DVec3::new(0.055 * i as f64 - 1.8, 0.3 - 0.02 * i as f64, 2.0);
            Ray { origin, direction: DVec3::new(0.2, 0.1, -1.0), stretch: 1.0 }
        };
        let rays: Vec<Ray> = (0..64).map(ray).collect();
        for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
            let shape = GridShape::new(20, 1.0, interpolation, Color::Rgb);
            let grid = VoxelGrid::<f64>::random(shape, 3.0, 0.2, 8);
            let counts = [0.0, 0.3].map(|stop_below| {
                let (spacing, jitter, engine) = (Spacing::Step(0.05), Jitter::None, Engine::Fused);
                let options =
                    RenderOptions { aabb: Aabb::cube(1.0), spacing, jitter, background: [1.0; 3], occupancy: None, engine, stop_below };
                let all = render(&grid, &rays, &options);
                for (i, ray) in rays.iter().enumerate() {
                    let one = render(&grid, from_ref(ray), &options);
                    let pixel = &all.rgb.data()[3 * i..3 * i + 3];
                    assert_eq!(one.rgb.data(), pixel, "{interpolation:?}, ray {i}, stop {stop_below}");
                }
                all.sample_count
            });
            assert!(counts[1] < counts[0], "no ray ends early: {counts:?}");
        }
    }
}
