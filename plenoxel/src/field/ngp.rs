//! The radiance field of Instant-NGP (Müller et al. 2022): a [hash grid](super::hash_grid) and two small networks.
//!
//! With x the position in the unit cube, into which the box is scaled by its longest side w, and e(x) its encoding:
//!
//! * h = MLP(e(x)), 16 numbers; density σ = d exp(h₀) / w, where d, 1 by default, is the density at the start;
//! * color = sigmoid(MLP([h, y(d)])), where y(d) encodes the unit direction d of the ray ([`Directions`]).
//!
//! Both networks have ReLU and no biases: their biases are zeros, and the models that train them give these the learning rate 0.

use super::encoding::Directions;
use super::hash_grid::{self, HashGrid};
use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::render::{Field, Radiance, RenderOptions, Rendered, ShadedField, composite, weights};
use crate::sampling::{Occupancy, Samples, sample_visible};
use autograd::nn::{Activation, Init, Mlp};
use autograd::{Cotangent, Indices, Keep, Op, Param, Precision, Real, Tensor, Vjp, impl_module, no_grad, random::Stream};
use glam::DVec3;

/// Sizes of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Hash grid.
    pub grid: hash_grid::Shape,
    /// Width of the hidden layers of both networks.
    pub hidden: usize,
    /// Hidden layers of the color network; the density network has one.
    pub color_layers: usize,
    /// Encoding of directions.
    pub directions: Directions,
}

/// Outputs of the density network.
const OUTPUTS: usize = 16;

/// A radiance field.
#[derive(Debug)]
pub struct HashField<T: Real> {
    shape: Shape,
    aabb: Aabb,
    grid: HashGrid,
    table: Param<T>,
    density: Mlp<T>,
    color: Mlp<T>,
    /// Cells outside of which nothing is sampled; `None` for the whole box.
    pub occupied: Option<Occupancy>,
    /// Optical depth d of the longest side of the box where h₀ = 0, as at the start.
    pub depth: f64,
    /// Samples whose weight on their pixel is not above this have no color.
    pub color_above: f64,
}

impl_module!(HashField { table, density, color });

/// Name of the table.
pub const TABLE: &str = "hash_table";

impl<T: Real> HashField<T> {
    /// Creates a field. The table is uniform in ±10⁻⁴; the networks' weights have [`Init::XavierUniform`].
    pub fn new(shape: Shape, aabb: Aabb, random: &Stream) -> Self {
        let grid = HashGrid::new(shape.grid);
        let table = random.named(TABLE).uniform_tensor(&[grid.rows(), shape.grid.features], -1e-4, 1e-4);
        let network = |name: &str, inputs: usize, hidden: usize, outputs: usize| {
            let widths: Vec<usize> = [inputs].into_iter().chain(std::iter::repeat_n(shape.hidden, hidden)).chain([outputs]).collect();
            let mut network = Mlp::new(name, &widths, Activation::Relu, random);
            network.layers.iter_mut().for_each(|layer| layer.initialize(Init::XavierUniform, Init::Zeros, random));
            network
        };
        HashField {
            table: Param::from_tensor(TABLE, table),
            density: network("density", grid.width(), 1, OUTPUTS),
            color: network("color", OUTPUTS + shape.directions.width(), shape.color_layers, 3),
            occupied: None,
            depth: 1.0,
            color_above: 0.0,
            shape,
            aabb,
            grid,
        }
    }

    /// Sets the precision of the products of both networks. It is [`Precision::Full`] in a new field.
    pub fn set_precision(&mut self, precision: Precision) {
        (self.density.precision, self.color.precision) = (precision, precision);
    }

    /// Returns the sizes of the field.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Returns the layout of the table.
    pub fn grid(&self) -> &HashGrid {
        &self.grid
    }

    /// Returns the bounding box.
    pub fn aabb(&self) -> Aabb {
        self.aabb
    }

    /// Sets the bounding box.
    pub fn set_aabb(&mut self, aabb: Aabb) {
        self.aabb = aabb;
    }

    /// Returns the longest side of the box, world length.
    pub fn extent(&self) -> f64 {
        (self.aabb.max - self.aabb.min).max_element()
    }

    /// Returns the networks of the density and of the color.
    pub fn networks(&self) -> [&Mlp<T>; 2] {
        [&self.density, &self.color]
    }

    /// Returns the outputs of the density network and the density, at world positions `[m, 3]`.
    fn outputs(&self, positions: &Tensor<T>) -> (Tensor<T>, Tensor<T>) {
        let low = 0.5 * (self.aabb.min + self.aabb.max) - 0.5 * self.extent();
        let low = Tensor::from_vec(low.to_array().map(T::lit).to_vec(), &[3]);
        let unit = (positions - low) / self.extent();
        let outputs = self.density.forward(&self.grid.encode(self.table.tensor(), &unit));
        let sigma = exponential(&outputs.index_axis(1, 0)) * (self.depth / self.extent());
        (outputs, sigma)
    }

    /// Returns the colors of outputs of the density network and encoded directions.
    fn shade_encoded(&self, outputs: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
        self.color.forward(&Tensor::concat(&[outputs, directions], 1)).sigmoid()
    }
}

impl<T: Real> ShadedField<T> for HashField<T> {
    /// Returns the outputs of the density network.
    fn features(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.outputs(positions).0
    }

    fn shade(&self, features: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
        self.shade_encoded(features, &self.shape.directions.encode(directions))
    }

    fn voxel_sides(&self) -> Option<DVec3> {
        let finest = self.grid.levels().iter().map(|level| level.resolution).max()?;
        Some(DVec3::splat(self.extent() / finest as f64))
    }
}

impl<T: Real> Field<T> for HashField<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.outputs(positions).1
    }

    /// Samples have a color if their weight on their pixel is above [`HashField::color_above`].
    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        let (outputs, sigma) = self.outputs(&samples.positions);
        let directions = no_grad(|| self.shape.directions.encode(&samples.directions).segment_repeat(&samples.offsets));
        if self.color_above == 0.0 {
            return Radiance { rgb: self.shade_encoded(&outputs, &directions), sigma };
        }
        let weights = weights(samples, &sigma);
        let above = T::lit(self.color_above);
        let seen = (0..).zip(weights.data()).filter(|(_, weight)| **weight > above).map(|(i, _)| i);
        let seen = Indices::from(seen.collect::<Vec<u32>>());
        let rgb = self.shade_encoded(&outputs.gather_rows(&seen), &directions.gather_rows(&seen));
        Radiance { sigma, rgb: rgb.scatter_rows(&seen, samples.len()) }
    }

    fn reach(&self) -> Option<&Occupancy> {
        self.occupied.as_ref()
    }

    /// Renders the samples that are not behind opaque matter. They are found before the graph is recorded.
    fn render_fused(&self, rays: &[Ray], options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        let cells = options.occupancy.or(self.reach());
        let RenderOptions { aabb, spacing, jitter, background, stop_below, .. } = options;
        let samples = sample_visible(rays, aabb, *spacing, *jitter, cells, *stop_below, |at| self.density(at));
        let radiance = self.radiance(&samples);
        let background = Tensor::from_vec(background.map(|c| T::lit(f64::from(c))).to_vec(), &[3]);
        Some(composite(samples, radiance, &background))
    }
}

/// Largest magnitude of x at which the derivative of the density's exponential is eˣ.
const LIMIT: f64 = 15.0;

/// y = eˣ. Its derivative is taken as e to the power of x clamped to ±15, so that a very dense sample does not blow up the step.
fn exponential<T: Real>(x: &Tensor<T>) -> Tensor<T> {
    Tensor::from_op(autograd::Buffer::copy_of(x.detach().exp().data()), x.shape(), &[x], Exponential)
}

#[derive(Debug)]
struct Exponential;

impl<T: Real> Op<T> for Exponential {
    fn name(&self) -> &'static str {
        "clamped_exp"
    }

    fn keep(&self) -> Keep {
        Keep::INPUTS
    }

    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent_factor() * cx.input(0).clamp(-LIMIT, LIMIT).exp())]
    }
}
