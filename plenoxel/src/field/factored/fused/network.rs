//! The color network on arrays: forward and adjoint for the groups of samples of one block.

use super::super::Shape;
use super::pruning;
use autograd::{Buffer, Matrix, Real, Tensor, dispatched, multiply, parallel};

/// Linear layer.
struct Layer<'a, T> {
    weight: &'a [T],
    bias: &'a [T],
    inputs: usize,
    outputs: usize,
}

/// Matrix B and layers.
pub struct Network<'a, T> {
    basis: &'a [T],
    products: usize,
    features: usize,
    octaves: usize,
    layers: Vec<Layer<'a, T>>,
}

/// Values of m groups that the adjoint reads.
#[derive(Debug, Default)]
pub struct Activations<T: Real> {
    /// Products plane · line, `[m, 3 R]`.
    pub products: Buffer<T>,
    /// Input of each layer, `[m, inputs]`.
    inputs: Vec<Buffer<T>>,
    /// Colors, `[m, 3]`.
    pub rgb: Buffer<T>,
}

impl<T: Real> Activations<T> {
    /// Returns the values of the groups with these numbers.
    pub fn rows(&self, numbers: &[u32]) -> Self {
        let of = |all: &Buffer<T>| pruning::rows(all, 3 * all.len() / self.rgb.len().max(1), numbers);
        Activations { products: of(&self.products), inputs: self.inputs.iter().map(of).collect(), rgb: of(&self.rgb) }
    }
}

/// Cotangents of the network for m groups.
pub struct OfNetwork<T: Real> {
    /// Cotangents of the products, `[m, 3 R]`.
    pub products: Buffer<T>,
    /// Cotangents of the input of the first layer, `[m, inputs]`.
    pub input: Buffer<T>,
    /// Cotangents of the matrix and of the layers' weights and biases, in the order of the parameters.
    pub parameters: Vec<Buffer<T>>,
}

impl<'a, T: Real> Network<'a, T> {
    /// Creates the network from its parameters.
    pub fn new(shape: &Shape, tables: &'a [Tensor<T>]) -> Self {
        let layer = |pair: &'a [Tensor<T>]| {
            let [inputs, outputs] = [0, 1].map(|axis| pair[0].shape()[axis]);
            Layer { weight: pair[0].data(), bias: pair[1].data(), inputs, outputs }
        };
        Network {
            basis: tables[0].data(),
            products: tables[0].shape()[0],
            features: shape.features,
            octaves: shape.feature_octaves,
            layers: tables[1..].chunks(2).map(layer).collect(),
        }
    }

    /// Computes the colors from products and encoded directions: `direction(i)` is the encoded direction of group i.
    pub fn forward(&self, products: Buffer<T>, direction: impl Fn(usize) -> &'a [T]) -> Activations<T> {
        let m = products.len() / self.products;
        let mut features = Buffer::stale(m * self.features);
        multiply(Matrix::new(&products, m, self.products), Matrix::new(self.basis, self.products, self.features), &mut features);
        let width = self.layers[0].inputs;
        let mut input = Buffer::stale(m * width);
        let encoded = self.features * (1 + 2 * self.octaves);
        for (i, (input, features)) in input.chunks_exact_mut(width).zip(features.chunks_exact(self.features)).enumerate() {
            encode(features, self.octaves, &mut input[..encoded]);
            input[encoded..].copy_from_slice(direction(i));
        }
        let mut inputs = vec![input];
        let mut rgb = Buffer::stale(0);
        for (l, layer) in self.layers.iter().enumerate() {
            let mut out = Buffer::stale(m * layer.outputs);
            multiply(Matrix::new(&inputs[l], m, layer.inputs), Matrix::new(layer.weight, layer.inputs, layer.outputs), &mut out);
            if l + 1 < self.layers.len() {
                add_bias::<T, true>(&mut out, layer.bias);
                inputs.push(out);
            } else {
                add_bias::<T, false>(&mut out, layer.bias);
                if parallel::fused() {
                    sigmoid::<T, true>(&mut out)
                } else {
                    sigmoid::<T, false>(&mut out)
                }
                rgb = out;
            }
        }
        Activations { products, inputs, rgb }
    }

    /// Returns the cotangents of encoded directions, one row for each group, from those of the input of the first layer.
    pub fn of_direction<'g>(&self, input: &'g [T]) -> impl Iterator<Item = &'g [T]> {
        let encoded = self.features * (1 + 2 * self.octaves);
        input.chunks_exact(self.layers[0].inputs).map(move |row| &row[encoded..])
    }

    /// Computes the cotangents of the products and of the parameters from those of the colors, `[m, 3]`.
    pub fn adjoint(&self, activations: &Activations<T>, mut g: Buffer<T>) -> OfNetwork<T> {
        let m = g.len() / 3;
        g.iter_mut().zip(activations.rgb.iter()).for_each(|(g, &c)| *g *= c * (T::one() - c));
        let mut cotangents = Vec::with_capacity(1 + 2 * self.layers.len());
        for (layer, input) in self.layers.iter().zip(&activations.inputs).rev() {
            let mut of_bias = Buffer::zeros(layer.outputs);
            for row in g.chunks_exact(layer.outputs) {
                of_bias.iter_mut().zip(row).for_each(|(sum, &g)| *sum += g);
            }
            let mut of_weight = Buffer::stale(layer.inputs * layer.outputs);
            multiply(Matrix::transposed(input, layer.inputs, m), Matrix::new(&g, m, layer.outputs), &mut of_weight);
            let mut of_input = Buffer::stale(m * layer.inputs);
            multiply(Matrix::new(&g, m, layer.outputs), Matrix::transposed(layer.weight, layer.outputs, layer.inputs), &mut of_input);
            cotangents.extend([of_bias, of_weight]);
            if cotangents.len() < 2 * self.layers.len() {
                mask(&mut of_input, input);
            }
            g = of_input;
        }
        let width = self.layers[0].inputs;
        let mut of_features = Buffer::stale(m * self.features);
        let rows = of_features.chunks_exact_mut(self.features).zip(g.chunks_exact(width)).zip(activations.inputs[0].chunks_exact(width));
        rows.for_each(|((out, g), encoded)| encode_adjoint(g, encoded, self.octaves, out));
        let mut of_basis = Buffer::stale(self.products * self.features);
        let features = Matrix::new(&of_features, m, self.features);
        multiply(Matrix::transposed(&activations.products, self.products, m), features, &mut of_basis);
        let mut of_products = Buffer::stale(m * self.products);
        multiply(features, Matrix::transposed(self.basis, self.features, self.products), &mut of_products);
        cotangents.push(of_basis);
        cotangents.reverse();
        OfNetwork { products: of_products, input: g, parameters: cotangents }
    }
}

/// Writes f, and sin and cos of 2ᵏ f for k < `octaves`.
fn encode<T: Real>(features: &[T], octaves: usize, out: &mut [T]) {
    let (own, mut waves) = out.split_at_mut(features.len());
    own.copy_from_slice(features);
    for k in 0..octaves {
        let scale = T::lit(f64::from(1 << k));
        let (sines, rest) = waves.split_at_mut(features.len());
        let (cosines, rest) = rest.split_at_mut(features.len());
        for ((&f, sine), cosine) in features.iter().zip(sines).zip(cosines) {
            (*sine, *cosine) = ((f * scale).sin_(), (f * scale).cos_());
        }
        waves = rest;
    }
}

/// Computes the cotangents of features from those of the encoding g, and the encoding.
fn encode_adjoint<T: Real>(g: &[T], encoded: &[T], octaves: usize, out: &mut [T]) {
    let n = out.len();
    out.copy_from_slice(&g[..n]);
    for k in 0..octaves {
        let (scale, at) = (T::lit(f64::from(1 << k)), n * (1 + 2 * k));
        for (i, out) in out.iter_mut().enumerate() {
            let (sine, cosine) = (at + i, at + n + i);
            *out += scale * (g[sine] * encoded[cosine] - g[cosine] * encoded[sine]);
        }
    }
}

dispatched! {
/// Adds the bias to each row, and applies ReLU if asked.
fn add_bias<T: Real, const RELU: bool>(out: &mut [T], bias: &[T]) {
    for row in out.chunks_exact_mut(bias.len()) {
        for (x, &b) in row.iter_mut().zip(bias) {
            let y = *x + b;
            *x = if RELU && y < T::zero() { T::zero() } else { y };
        }
    }
}
}

dispatched! {
/// Sets g to 0 where the output of the ReLU is 0.
fn mask<T: Real>(g: &mut [T], output: &[T]) {
    for (g, &y) in g.iter_mut().zip(output) {
        *g = if y > T::zero() { *g } else { T::zero() };
    }
}
}

dispatched! {
fn sigmoid<T: Real, const FUSED: bool>(x: &mut [T]) {
    for x in x {
        let e = (-x.abs()).exp_::<FUSED>();
        let above = T::one() / (T::one() + e);
        *x = if *x > T::zero() { above } else { e * above };
    }
}
}
