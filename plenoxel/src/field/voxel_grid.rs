//! Density and color in a dense grid of voxels.
//!
//! Voxel (i, j, k) of n³ has its centre at (i + ½, j + ½, k + ½) · side − half and is row (i·n + j)·n + k of the tables: z runs fastest.
//! Nearest look-up takes the voxel a point lies in; trilinear look-up runs between centres, and in the outer half voxel repeats the
//! border. Outside the box there is nothing. Values are stored raw and activated after interpolation: σ = max(0, density).

use super::{Field, Radiance, sh};
use crate::geometry::Aabb;
use crate::random::{Purpose, uniform};
use crate::sampling::{Occupancy, Samples};
use autograd::{Buffer, Grad, Gradients, Module, Param, Real, Tensor, no_grad, parallel};
use serde::{Deserialize, Serialize};

/// How values between voxel centres are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// The voxel the point lies in.
    Nearest,
    /// The eight voxel centres around the point.
    Trilinear,
}

/// What a row of the color table means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Color {
    /// Red, green and blue, the same from everywhere.
    Rgb,
    /// Spherical harmonics, all coefficients of red, then green, then blue: c = max(0, offset + Σ Yₖ(d) cₖ).
    Sh {
        /// 0 to 3.
        degree: usize,
        /// The color of zero coefficients: 0.5 in svox2, 0 in the source paper.
        offset: f64,
    },
}

impl Color {
    /// Numbers in a row of the color table.
    pub fn channels(self) -> usize {
        match self {
            Color::Rgb => 3,
            Color::Sh { degree, .. } => 3 * sh::count(degree),
        }
    }
}

/// Shape and meaning of a grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridShape {
    /// Voxels along each axis.
    pub resolution: usize,
    /// Half the side of the cube it fills, world length.
    pub half_width: f64,
    /// Look-up between centres.
    pub interpolation: Interpolation,
    /// Meaning of the color table.
    pub color: Color,
}

impl GridShape {
    /// The number of voxels.
    pub fn voxels(&self) -> usize {
        self.resolution.pow(3)
    }

    /// Side of a voxel, world length.
    pub fn voxel_side(&self) -> f64 {
        2.0 * self.half_width / self.resolution as f64
    }

    /// Bytes of both tables in `f32`.
    pub fn bytes(&self) -> usize {
        self.voxels() * (1 + self.color.channels()) * size_of::<f32>()
    }
}

/// A dense grid with its two parameters, `density` `[n³, 1]` and `color` `[n³, channels]`.
#[derive(Debug)]
pub struct VoxelGrid<T: Real> {
    shape: GridShape,
    /// Raw density; σ = max(0, ·) after interpolation, 1 / world length.
    pub density: Param<T>,
    /// Colors or their harmonics.
    pub color: Param<T>,
}

impl<T: Real> VoxelGrid<T> {
    /// A grid with the same density and the same color numbers everywhere.
    pub fn uniform(shape: GridShape, density: f64, color: f64) -> Self {
        let n = shape.voxels();
        Self::from_tables(shape, Tensor::full(&[n, 1], density), Tensor::full(&[n, shape.color.channels()], color))
    }

    /// A grid of uniform random numbers: density in [0, `density`), colors in [0, `color`). A function of the seed.
    pub fn random(shape: GridShape, density: f64, color: f64, seed: u64) -> Self {
        let table = |step: u64, width: usize, scale: f64| {
            let mut values = Buffer::stale(shape.voxels() * width);
            parallel::for_each_chunk(&mut values, parallel::CHUNK, |start, chunk| {
                for (i, v) in chunk.iter_mut().enumerate() {
                    *v = T::lit(scale * uniform(seed, Purpose::Initial, step, (start + i) as u64));
                }
            });
            Tensor::from_buffer(values, &[shape.voxels(), width])
        };
        Self::from_tables(shape, table(0, 1, density), table(1, shape.color.channels(), color))
    }

    /// A grid from its tables.
    ///
    /// Panics if they are not `[n³, 1]` and `[n³, channels]`.
    #[track_caller]
    pub fn from_tables(shape: GridShape, density: Tensor<T>, color: Tensor<T>) -> Self {
        assert_eq!(density.shape(), [shape.voxels(), 1], "density table of a grid of {}³ voxels", shape.resolution);
        assert_eq!(color.shape(), [shape.voxels(), shape.color.channels()], "color table of a grid of {}³ voxels", shape.resolution);
        VoxelGrid { shape, density: Param::from_tensor("density", density), color: Param::from_tensor("color", color) }
    }

    /// Shape and meaning.
    pub fn shape(&self) -> &GridShape {
        &self.shape
    }

    /// Voxels along each axis, as lookups take them.
    pub fn nodes(&self) -> [usize; 3] {
        [self.shape.resolution; 3]
    }

    /// The box it fills.
    pub fn aabb(&self) -> Aabb {
        Aabb::cube(self.shape.half_width)
    }

    /// World positions to voxel coordinates, in which centres are the integers: (p + half) / side − ½.
    pub fn world_to_voxels(&self, positions: &Tensor<T>) -> Tensor<T> {
        let scale = 1.0 / self.shape.voxel_side();
        positions.affine(scale, self.shape.half_width * scale - 0.5)
    }

    fn look_up(&self, table: &Param<T>, voxels: &Tensor<T>) -> Tensor<T> {
        match self.shape.interpolation {
            Interpolation::Nearest => table.tensor().nearest(voxels, self.nodes()),
            Interpolation::Trilinear => table.tensor().trilinear(voxels, self.nodes()),
        }
    }

    /// Clamps density to >= 0, and RGB colors to [0, 1], in the rows that `gradients` touched: after a step from a feasible grid this
    /// equals clamping the whole of it. (The source paper's projection; harmonics are not clamped.)
    pub fn project(&mut self, gradients: &Gradients<T>) {
        project_param(&mut self.density, gradients, |v| v.max(T::zero()));
        if self.shape.color == Color::Rgb {
            project_param(&mut self.color, gradients, |v| v.max(T::zero()).min(T::one()));
        }
    }

    /// The same field at another resolution: the old field read at the new centres, trilinearly whatever the interpolation.
    /// Parameters get new identities, so an optimizer starts afresh.
    pub fn resample(&self, resolution: usize) -> Self {
        let shape = GridShape { resolution, ..self.shape };
        let table = |old: &Param<T>| {
            let width = old.shape()[1];
            let old = old.tensor().detach();
            let mut values = Buffer::stale(shape.voxels() * width);
            let ratio = self.shape.resolution as f64 / resolution as f64;
            let center = |k: usize| T::lit((k as f64 + 0.5) * ratio - 0.5);
            // One slab of new voxels at a time bounds the memory for positions.
            let slab = resolution * resolution;
            for (i, part) in values.chunks_exact_mut(slab * width).enumerate() {
                let mut at = Buffer::stale(slab * 3);
                for (v, p) in at.chunks_exact_mut(3).enumerate() {
                    p.copy_from_slice(&[center(i), center(v / resolution), center(v % resolution)]);
                }
                let read = no_grad(|| old.trilinear(&Tensor::from_buffer(at, &[slab, 3]), self.nodes()));
                parallel::copy(read.data(), part);
            }
            Tensor::from_buffer(values, &[shape.voxels(), width])
        };
        Self::from_tables(shape, table(&self.density), table(&self.color))
    }

    /// The voxels in which a sample can have positive density: those whose own value, or with trilinear look-up a neighbour's, is above
    /// `threshold`. With threshold 0, leaving out the samples elsewhere changes no rendered value.
    pub fn occupancy(&self, threshold: f64) -> Occupancy {
        let (density, threshold) = (self.density.tensor().data(), T::lit(threshold));
        self.reached(|row| density[row] > threshold)
    }

    /// The voxels in which a sample can read one of `kept`: the same with nearest look-up, their neighbours too with trilinear.
    ///
    /// Panics if it has other cells than this grid has voxels.
    pub fn reached_from(&self, kept: &Occupancy) -> Occupancy {
        assert_eq!(kept.cells(), self.nodes(), "reached_from: occupancy of another grid");
        self.reached(|row| kept.mask()[row])
    }

    fn reached(&self, full: impl Fn(usize) -> bool + Sync) -> Occupancy {
        let n = self.shape.resolution;
        let mut mask = vec![false; n * n * n];
        let reach = usize::from(self.shape.interpolation == Interpolation::Trilinear);
        parallel::for_each_chunk(&mut mask, n * n, |start, slab| {
            let around = |c: usize| c.saturating_sub(reach)..(c + reach + 1).min(n);
            let i = start / (n * n);
            for (cell, m) in slab.iter_mut().enumerate() {
                let (j, k) = (cell / n, cell % n);
                *m = around(i).any(|a| around(j).any(|b| around(k).any(|c| full((a * n + b) * n + c))));
            }
        });
        Occupancy::new(self.aabb(), self.nodes(), mask)
    }

    /// Sets the density of every voxel outside of `occupancy` to 0.
    ///
    /// Panics if it has other cells than this grid has voxels.
    pub fn clear_outside(&mut self, occupancy: &Occupancy) {
        assert_eq!(occupancy.cells(), self.nodes(), "clear_outside: occupancy of another grid");
        let mask = occupancy.mask();
        self.density.update(|density| {
            parallel::for_each_chunk(density, parallel::CHUNK, |start, chunk| {
                chunk.iter_mut().zip(&mask[start..]).filter(|(_, m)| !**m).for_each(|(d, _)| *d = T::zero());
            });
        });
    }

    /// The same for the rows that `gradients` touched: what an optimizer moved out there goes back to 0.
    pub fn clear_touched_outside(&mut self, gradients: &Gradients<T>, occupancy: &Occupancy) {
        match gradients.of(&self.density) {
            None => {}
            Some(Grad::Dense(_)) => self.clear_outside(occupancy),
            Some(Grad::Rows(rows)) => {
                let (rows, mask) = (rows.rows(), occupancy.mask());
                self.density.update(|density| {
                    parallel::for_each_table_row(density, 1, rows, |k, row| {
                        if !mask[rows[k] as usize] {
                            row[0] = T::zero();
                        }
                    });
                });
            }
        }
    }

    /// True if every stored number is finite.
    pub fn is_finite(&self) -> bool {
        [&self.density, &self.color]
            .iter()
            .all(|p| parallel::sum(p.tensor().data(), |v| if v.is_finite() { T::zero() } else { T::one() }) == T::zero())
    }
}

fn project_param<T: Real>(param: &mut Param<T>, gradients: &Gradients<T>, clamp: impl Fn(T) -> T + Sync) {
    match gradients.of(param) {
        None => {}
        Some(Grad::Dense(_)) => param
            .update(|values| parallel::for_each_chunk(values, parallel::CHUNK, |_, chunk| chunk.iter_mut().for_each(|v| *v = clamp(*v)))),
        Some(Grad::Rows(rows)) => {
            let width = rows.width();
            param.update(|values| {
                parallel::for_each_table_row(values, width, rows.rows(), |_, row| row.iter_mut().for_each(|v| *v = clamp(*v)))
            });
        }
    }
}

impl<T: Real> Field<T> for VoxelGrid<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.look_up(&self.density, &self.world_to_voxels(positions)).reshape(&[positions.shape()[0]]).relu()
    }

    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        let m = samples.len();
        let voxels = self.world_to_voxels(&samples.positions);
        let sigma = self.look_up(&self.density, &voxels).reshape(&[m]).relu();
        let row = self.look_up(&self.color, &voxels);
        let rgb = match self.shape.color {
            Color::Rgb => row,
            Color::Sh { degree, offset } => {
                let count = sh::count(degree);
                let basis = sh::basis(&samples.directions, degree).segment_repeat(&samples.offsets);
                let sum = (row.reshape(&[m, 3, count]) * basis.reshape(&[m, 1, count])).sum_axis(2);
                (sum + offset).relu()
            }
        };
        Radiance { sigma, rgb }
    }
}

impl<T: Real> Module<T> for VoxelGrid<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        f(&self.density);
        f(&self.color);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        f(&mut self.density);
        f(&mut self.color);
    }
}
