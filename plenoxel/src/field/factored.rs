//! The vector-matrix decomposition VM of TensoRF (Chen et al. 2022): density and appearance are sums of products of planes and lines.
//!
//! With p in [−1, 1]³ the position in the box, and for each axis a the plane of the other two axes (b, c):
//!
//! * density feature s = Σₐ Σᵣ Pₐᵣ(p_b, p_c) Lₐᵣ(pₐ), density σ = 25 softplus(s − 10);
//! * appearance feature f = B · concatₐᵣ(P'ₐᵣ(p_b, p_c) L'ₐᵣ(pₐ));
//! * color = sigmoid(MLP(γ(f), e(d))), where γ appends sin and cos of 2ᵏ f, and e encodes the unit direction d of the ray ([`Directions`]).
//!
//! Planes are bilinear and lines linear, with corners aligned: the outermost nodes lie on the faces of the box. This file states the field
//! as a graph of small ops. [`fused`] computes pixels in one pass.

pub mod fused;

use super::encoding::{Directions, frequency};
use super::grouping::Grouping;
use crate::camera::{Ray, TrackedRays};
use crate::geometry::Aabb;
use crate::render::{Field, Radiance, RenderOptions, Rendered, ShadedField, weights};
use crate::sampling::{Occupancy, Samples};
use autograd::nn::{Activation, Init, Linear, Mlp};
use autograd::{Indices, Module, Param, Precision, Real, Tensor, impl_module, no_grad, random::Stream};
use glam::DVec3;

/// Sizes of a factored field, except its resolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Components of each of the three plane-line pairs of the density.
    pub density_components: usize,
    /// Components of each of the three plane-line pairs of the appearance.
    pub appearance_components: usize,
    /// Length of the appearance feature.
    pub features: usize,
    /// Width of the two hidden layers of the color network.
    pub hidden: usize,
    /// Octaves of the positional encoding of the appearance feature.
    pub feature_octaves: usize,
    /// Encoding of directions.
    pub directions: Directions,
}

/// Factors of a density or an appearance: for each axis a plane of the other two axes (b, c), `[n_b n_c, R]` with
/// the later axis fastest, and a line `[nₐ, R]`.
#[derive(Debug)]
pub struct Factors<T: Real> {
    /// Planes, of the axes (y, z), (x, z) and (x, y).
    pub planes: Vec<Param<T>>,
    /// Lines along x, y and z.
    pub lines: Vec<Param<T>>,
}

impl_module!(Factors { planes, lines });

const AXES: [&str; 3] = ["x", "y", "z"];
/// Axes of the plane that belongs to the line of each axis.
pub const PLANE_OF: [[usize; 2]; 3] = [[1, 2], [0, 2], [0, 1]];

impl<T: Real> Factors<T> {
    /// Creates factors of 0.1 · N(0, 1).
    fn new(name: &str, nodes: [usize; 3], components: usize, random: &Stream) -> Self {
        let param = |kind: &str, axis: &str, rows: usize| {
            let name = format!("{name}.{kind}.{axis}");
            let values = random.named(&name).normal_tensor(&[rows, components], 0.0, 0.1);
            Param::from_tensor(name, values)
        };
        Factors {
            planes: (0..3).map(|axis| param("plane", AXES[axis], PLANE_OF[axis].map(|a| nodes[a]).iter().product())).collect(),
            lines: (0..3).map(|axis| param("line", AXES[axis], nodes[axis])).collect(),
        }
    }

    /// Returns the number of nodes along each axis.
    pub fn nodes(&self) -> [usize; 3] {
        [0, 1, 2].map(|axis| self.lines[axis].shape()[0])
    }

    /// Sets the first component of every plane and line to a constant.
    fn set_first(&mut self, value: f64) {
        let set = |param: &mut Param<T>| {
            let width = param.shape()[1];
            param.update(|values| values.iter_mut().step_by(width).for_each(|first| *first = T::lit(value)));
        };
        self.planes.iter_mut().chain(&mut self.lines).for_each(set);
    }

    /// Resamples planes and lines at new nodes: `at[a]` are their positions along axis a, in units of the old cells.
    fn resample(&mut self, at: &[Vec<f64>; 3]) {
        let old = self.nodes();
        let resampled = |param: &mut Param<T>, axes: [usize; 2]| {
            let [b, c] = axes.map(|a| at.get(a).map_or(&[0.0][..], |at| at));
            let places = b.iter().flat_map(|&b| c.iter().flat_map(move |&c| [b, c, 0.0])).map(T::lit).collect();
            let nodes = axes.map(|a| old.get(a).copied().unwrap_or(1));
            let places = Tensor::from_vec(places, &[b.len() * c.len(), 3]);
            *param = Param::from_tensor(param.name(), no_grad(|| param.tensor().trilinear(&places, [nodes[0], nodes[1], 1])));
        };
        for (axis, plane_of) in PLANE_OF.into_iter().enumerate() {
            resampled(&mut self.planes[axis], plane_of);
            // A line is a plane whose second axis has one node.
            resampled(&mut self.lines[axis], [axis, 3]);
        }
    }
}

/// Returns the products plane · line of each axis at positions `[m, 3]` in units of cells: three tensors `[m, R]`.
fn products<T: Real>(planes: &[Tensor<T>], lines: &[Tensor<T>], cells: &Tensor<T>) -> [Tensor<T>; 3] {
    let nodes = [0, 1, 2].map(|axis| lines[axis].shape()[0]);
    let column = |axis: usize| cells.narrow(1, axis, 1);
    let zero = Tensor::zeros(&[cells.shape()[0], 1]);
    [0, 1, 2].map(|axis| {
        let [b, c] = PLANE_OF[axis];
        let plane = planes[axis].trilinear(&Tensor::concat(&[&column(b), &column(c), &zero], 1), [nodes[b], nodes[c], 1]);
        let line = lines[axis].trilinear(&Tensor::concat(&[&column(axis), &zero, &zero], 1), [nodes[axis], 1, 1]);
        plane * line
    })
}

/// The authors' `density_shift`.
const SHIFT: f64 = -10.0;
/// The authors' `distance_scale`: factor of the softplus in the density.
pub const SCALE: f64 = 25.0;

/// Returns the density at positions `[m, 3]` in units of cells, from the tables of a field in the order of its parameters.
fn density<T: Real>(tables: &[Tensor<T>], cells: &Tensor<T>) -> Tensor<T> {
    let [x, y, z] = products(&tables[..3], &tables[3..6], cells).map(|product| product.sum_axis(1));
    (x + y + z + SHIFT).softplus() * SCALE
}

/// Returns the appearance features at positions `[m, 3]` in units of cells: `[m, features]`.
fn features<T: Real>(tables: &[Tensor<T>], cells: &Tensor<T>) -> Tensor<T> {
    let products = products(&tables[6..9], &tables[9..12], cells);
    Tensor::concat(&products.each_ref(), 1).matmul(&tables[12])
}

/// Returns the colors of features `[m, features]`, seen along encoded directions `[m, e]`: `[m, 3]`.
fn shade<T: Real>(tables: &[Tensor<T>], feature_octaves: usize, features: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
    let mut hidden = Tensor::concat(&[&frequency(features, feature_octaves), directions], 1);
    let layers = &tables[13..];
    for (l, layer) in layers.chunks(2).enumerate() {
        hidden = hidden.matmul(&layer[0]) + &layer[1];
        if 2 * (l + 1) < layers.len() {
            hidden = hidden.relu();
        }
    }
    hidden.sigmoid()
}

/// Returns the colors at positions `[m, 3]` in units of cells, seen along encoded directions `[m, e]`: `[m, 3]`.
fn colors<T: Real>(tables: &[Tensor<T>], feature_octaves: usize, cells: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
    shade(tables, feature_octaves, &features(tables, cells), directions)
}

/// A factored radiance field.
#[derive(Debug)]
pub struct Factored<T: Real> {
    shape: Shape,
    aabb: Aabb,
    density: Factors<T>,
    appearance: Factors<T>,
    /// Matrix B, `[3 R, features]`.
    basis: Param<T>,
    color: Mlp<T>,
    /// Cells outside of which nothing is sampled; `None` for the whole box.
    pub occupied: Option<Occupancy>,
    /// Where the color network is evaluated in training, that is with jitter.
    pub grouping: Grouping,
    /// Where the color network is evaluated in pictures.
    pub grouping_in_pictures: Grouping,
    /// Stochastic pruning of gradients (Ye et al. 2020) in the adjoint of the fused kernel. Let g be the gradient of the density feature of a sample, or of the
    /// color of a group, |g| the sum over its channels, and τ this number times the mean of |g| over a block of rays. With jitter, a gradient with |g| < τ becomes
    /// τ g / |g| with the probability |g| / τ, and 0 otherwise, so that its expectation is unchanged. 0 for exact gradients. Gradients that can be
    /// differentiated again are always exact.
    pub gradient_above: f64,
    /// Gradient scaling (Philip and Deschaintre 2023), a length d: the gradients of density and color of a sample at t ([`Samples`]) are multiplied by
    /// min(1, (t / d)²), in the graph and in the kernel; 0 for exact gradients. Gradients of rays become smaller with them. Near a camera, rays are dense and no
    /// other camera sees the place, so that matter may form there which no other view contradicts.
    pub gradient_scaling: f64,
}

impl<T: Real> Module<T> for Factored<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.density.visit(f);
        self.appearance.visit(f);
        f(&self.basis);
        self.color.visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.density.visit_mut(f);
        self.appearance.visit_mut(f);
        f(&mut self.basis);
        self.color.visit_mut(f);
    }
}

impl<T: Real> Factored<T> {
    /// Creates a field. Factors are 0.1 · N(0, 1), network and matrix have the default [`Init`] except for the biases of the last layer, which are 0.
    pub fn new(shape: Shape, aabb: Aabb, nodes: [usize; 3], random: &Stream) -> Self {
        let inputs = shape.features * (1 + 2 * shape.feature_octaves) + shape.directions.width();
        let mut color = Mlp::new("color", &[inputs, shape.hidden, shape.hidden, 3], Activation::Relu, random);
        if let Some(last) = color.layers.last_mut() {
            last.initialize(Init::default(), Init::Zeros, random);
        }
        Factored {
            density: Factors::new("density", nodes, shape.density_components, random),
            appearance: Factors::new("appearance", nodes, shape.appearance_components, random),
            basis: Linear::new("basis", 3 * shape.appearance_components, shape.features, random).weight,
            color,
            shape,
            aabb,
            occupied: None,
            grouping: Grouping::NONE,
            grouping_in_pictures: Grouping::NONE,
            gradient_above: 0.0,
            gradient_scaling: 0.0,
        }
    }

    /// Sets the precision of the products of the color network and, with the fused kernel, of the matrix B. It is [`Precision::Full`] in a new field.
    pub fn set_precision(&mut self, precision: Precision) {
        self.color.precision = precision;
    }

    /// Makes the field opaque: the density feature is set to about s = 13 everywhere.
    pub fn make_opaque(&mut self) {
        self.set_density_feature(13.0);
    }

    /// Makes the field a uniform fog: the density is set to about `density` everywhere, in units of the box. Densities below 25 softplus(−10) = 0.0011 become
    /// this one.
    pub fn make_fog(&mut self, density: f64) {
        self.set_density_feature(((density / SCALE).exp_m1().ln() - SHIFT).max(0.0));
    }

    /// Sets the density feature everywhere, by the first component of each pair. The other components keep their values, whose sum is about 0.
    fn set_density_feature(&mut self, feature: f64) {
        self.density.set_first((feature / 3.0).sqrt());
    }

    /// Returns the sizes of the field.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Returns the factors of the density.
    pub fn density_factors(&self) -> &Factors<T> {
        &self.density
    }

    /// Returns the names of the parameters of the matrix and of the color network.
    pub fn network_names(&self) -> Vec<String> {
        [self.basis.name().to_owned()].into_iter().chain(self.color.param_names()).collect()
    }

    /// Returns the bounding box.
    pub fn aabb(&self) -> Aabb {
        self.aabb
    }

    /// Returns the number of nodes along each axis.
    pub fn nodes(&self) -> [usize; 3] {
        self.density.nodes()
    }

    /// Returns the sides of a cell, world length.
    pub fn sides(&self) -> DVec3 {
        (self.aabb.max - self.aabb.min) / DVec3::from_array(self.nodes().map(|n| (n - 1) as f64))
    }

    /// Returns the mean side of a cell, world length.
    pub fn cell(&self) -> f64 {
        self.sides().element_sum() / 3.0
    }

    /// Resamples all factors at the nodes of a box, if they are others. Factors do not change outside of the old box.
    pub fn resample(&mut self, aabb: Aabb, nodes: [usize; 3]) {
        if (aabb, nodes) == (self.aabb, self.nodes()) {
            return;
        }
        let (sides, old) = (self.sides(), self.nodes());
        let at = [0, 1, 2].map(|a| {
            let (from, side) = (aabb.min[a] - self.aabb.min[a], (aabb.max[a] - aabb.min[a]) / (nodes[a] - 1) as f64);
            (0..nodes[a]).map(|k| ((from + k as f64 * side) / sides[a]).clamp(0.0, (old[a] - 1) as f64)).collect()
        });
        self.density.resample(&at);
        self.appearance.resample(&at);
        self.aabb = aabb;
    }

    /// Returns positions `[m, 3]` in units of cells.
    fn cells(&self, positions: &Tensor<T>) -> Tensor<T> {
        let [low, sides] = [self.aabb.min, self.sides()].map(|v| Tensor::from_vec(v.to_array().map(T::lit).to_vec(), &[3]));
        (positions - low) / sides
    }

    /// Returns all parameters, in the order of [`Module::visit`].
    fn tables(&self) -> Vec<Tensor<T>> {
        let mut tables = Vec::new();
        self.visit(&mut |param| tables.push(param.tensor().clone()));
        tables
    }
}

/// Returns the factor of the gradients of a sample at the distance `t` from the camera ([`Factored::gradient_scaling`]).
#[inline(always)]
fn gradient_share<T: Real>(t: T, scaling: f64) -> T {
    let d = T::lit(scaling);
    if t < d { t * t / (d * d) } else { T::one() }
}

/// Returns the same densities and colors, with gradients that are scaled by the distances `t`, `[n]`: x̂ + s (x − x̂), where no gradient flows through x̂ = x.
fn with_scaled_gradients<T: Real>(radiance: Radiance<T>, t: &Tensor<T>, scaling: f64) -> Radiance<T> {
    if scaling == 0.0 {
        return radiance;
    }
    let share = Tensor::from_vec(t.data().iter().map(|&t| gradient_share(t, scaling)).collect(), &[t.len()]);
    let scaled = |x: &Tensor<T>, share: &Tensor<T>| x.detach() + share * (x - x.detach());
    Radiance { sigma: scaled(&radiance.sigma, &share), rgb: scaled(&radiance.rgb, &share.unsqueeze(1)) }
}

impl<T: Real> Field<T> for Factored<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        density(&self.tables(), &self.cells(positions))
    }

    /// Every sample has its own color if its weight on its pixel is above [`Grouping::above`], and no color otherwise.
    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        let (tables, cells) = (self.tables(), self.cells(&samples.positions));
        let sigma = density(&tables, &cells);
        let weights = weights(samples, &sigma);
        let seen = weights.data().iter().enumerate().filter(|(_, weight)| weight.as_f64() > self.grouping.above);
        let seen = Indices::from(seen.map(|(i, _)| i as u32).collect::<Vec<_>>());
        let directions = self.shape.directions.encode(&samples.directions.segment_repeat(&samples.offsets).gather_rows(&seen));
        let rgb = colors(&tables, self.shape.feature_octaves, &cells.gather_rows(&seen), &directions);
        with_scaled_gradients(Radiance { sigma, rgb: rgb.scatter_rows(&seen, samples.len()) }, &samples.t, self.gradient_scaling)
    }

    fn reach(&self) -> Option<&Occupancy> {
        self.occupied.as_ref()
    }

    fn render_fused(&self, rays: &[Ray], options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        fused::supports(&self.shape).then(|| fused::render(self, rays, options))
    }

    fn render_fused_tracked(&self, rays: &TrackedRays<T>, options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        fused::supports(&self.shape).then(|| fused::render_tracked(self, rays, options))
    }
}

impl<T: Real> ShadedField<T> for Factored<T> {
    fn features(&self, positions: &Tensor<T>) -> Tensor<T> {
        features(&self.tables(), &self.cells(positions))
    }

    fn shade(&self, features: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
        shade(&self.tables(), self.shape.feature_octaves, features, &self.shape.directions.encode(directions))
    }

    fn voxel_sides(&self) -> Option<DVec3> {
        Some(self.sides())
    }
}
