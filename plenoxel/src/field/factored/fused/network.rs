//! The color network on arrays, from the planes and lines of the appearance to colors: forward and adjoint for the groups of samples of one block.

use super::super::Shape;
use super::lookup::{self, Cotangents, Pairs, Places};
use super::pruning;
use autograd::{Buffer, Matrix, Precision, Real, Tensor, add_product, dispatched, multiply, parallel};

/// Number of groups, or of samples, that are processed before others: their values stay in the second-level cache.
pub const ROWS: usize = 256;

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
    precision: Precision,
}

/// Colors of m groups, and the values that the adjoint reads.
#[derive(Debug, Default)]
pub struct Activations<T: Real> {
    /// Input of each layer, `[m, inputs]`; none without an adjoint.
    inputs: Vec<Buffer<T>>,
    /// Colors, `[m, 3]`.
    pub rgb: Buffer<T>,
}

/// Cotangents of the network for m groups.
pub struct OfNetwork<T: Real> {
    /// Cotangents of the products, `[m, 3 R]`.
    pub products: Buffer<T>,
    /// Cotangents of the input of the first layer, `[m, inputs]`.
    pub input: Buffer<T>,
    /// Cotangents of the three lines of the appearance, one after another.
    pub lines: Buffer<T>,
    /// Cotangents of the matrix and of the layers' weights and biases, in the order of the parameters.
    pub parameters: Vec<Buffer<T>>,
}

impl<'a, T: Real> Network<'a, T> {
    /// Creates the network from its parameters.
    pub fn new(shape: &Shape, tables: &'a [Tensor<T>], precision: Precision) -> Self {
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
            precision,
        }
    }

    /// Computes the colors of groups from the planes and lines of the appearance at their positions; `direction(i)` is the encoded direction of group i. The inputs
    /// of the layers are kept for the adjoint if `keep`.
    pub fn forward(&self, pairs: Pairs<'_, T>, at: Places<'_, T>, keep: bool, direction: impl Fn(usize) -> &'a [T]) -> Activations<T> {
        let m = at[0].len();
        let kept = if keep { m } else { ROWS.min(m) };
        let mut inputs: Vec<_> = self.layers.iter().map(|layer| Buffer::stale(kept * layer.inputs)).collect();
        let mut rgb = Buffer::stale(3 * m);
        let width = self.layers[0].inputs;
        let encoded = self.features * (1 + 2 * self.octaves);
        let [mut products, mut features] = [self.products, self.features].map(|width| Buffer::stale(ROWS.min(m) * width));
        for first in (0..m).step_by(ROWS) {
            let groups = first..m.min(first + ROWS);
            let count = groups.len();
            let start = if keep { first } else { 0 };
            let own = |width: usize| start * width..(start + count) * width;
            let (products, features) = (&mut products[..count * self.products], &mut features[..count * self.features]);
            lookup::products(pairs, at.map(|at| &at[groups.clone()]), products);
            multiply(
                Matrix::new(products, count, self.products),
                Matrix::new(self.basis, self.products, self.features),
                features,
                self.precision,
            );
            let rows = inputs[0][own(width)].chunks_exact_mut(width);
            for ((i, input), features) in groups.clone().zip(rows).zip(features.chunks_exact(self.features)) {
                encode(features, self.octaves, &mut input[..encoded]);
                input[encoded..].copy_from_slice(direction(i));
            }
            for (l, layer) in self.layers.iter().enumerate() {
                let (below, above) = inputs.split_at_mut(l + 1);
                let input = Matrix::new(&below[l][own(layer.inputs)], count, layer.inputs);
                let out = match above.first_mut() {
                    Some(above) => &mut above[own(layer.outputs)],
                    None => &mut rgb[3 * groups.start..3 * groups.end],
                };
                multiply(input, Matrix::new(layer.weight, layer.inputs, layer.outputs), out, self.precision);
                if l + 1 < self.layers.len() {
                    add_bias::<T, true>(out, layer.bias);
                } else {
                    add_bias::<T, false>(out, layer.bias);
                    if parallel::fused() { sigmoid::<T, true>(out) } else { sigmoid::<T, false>(out) }
                }
            }
        }
        if !keep {
            inputs.clear();
        }
        Activations { inputs, rgb }
    }

    /// Returns the cotangents of encoded directions, one row for each group, from those of the input of the first layer.
    pub fn of_direction<'g>(&self, input: &'g [T]) -> impl Iterator<Item = &'g [T]> {
        let encoded = self.features * (1 + 2 * self.octaves);
        input.chunks_exact(self.layers[0].inputs).map(move |row| &row[encoded..])
    }

    /// Computes the cotangents of the products, of the lines and of the parameters for the groups with these numbers and positions, from the cotangents of the colors
    /// of all groups.
    pub fn adjoint(
        &self,
        activations: &Activations<T>,
        numbers: &[u32],
        pairs: Pairs<'_, T>,
        at: Places<'_, T>,
        of_colors: &[T],
    ) -> OfNetwork<T> {
        let width = self.layers[0].inputs;
        let mut lengths = vec![self.basis.len()];
        lengths.extend(self.layers.iter().flat_map(|layer| [layer.weight.len(), layer.bias.len()]));
        let mut of = OfNetwork {
            products: Buffer::stale(numbers.len() * self.products),
            input: Buffer::stale(numbers.len() * width),
            lines: pairs.zeros_of_lines(),
            parameters: lengths.into_iter().map(Buffer::zeros).collect(),
        };
        let [mut of_planes, mut products] = [(); 2].map(|()| Buffer::stale(ROWS.min(numbers.len()) * self.products));
        let mut copies: Vec<_> = self.layers.iter().map(|_| Buffer::stale(0)).collect();
        for (chunk, numbers) in numbers.chunks(ROWS).enumerate() {
            let groups = chunk * ROWS..chunk * ROWS + numbers.len();
            let own = |width: usize| groups.start * width..groups.end * width;
            let at = at.map(|at| &at[groups.clone()]);
            let [of_planes, products] = [&mut of_planes, &mut products].map(|values| &mut values[..numbers.len() * self.products]);
            lookup::planes(pairs, at, of_planes);
            products.copy_from_slice(of_planes);
            lookup::times_lines(pairs, at, products);
            let layers = activations.inputs.iter().zip(&self.layers).zip(&mut copies);
            let inputs: Vec<_> = layers.map(|((all, layer), copy)| pruning::rows(all, layer.inputs, numbers, copy)).collect();
            let of_rgb = of_logits(&activations.rgb, of_colors, numbers);
            let of_products = &mut of.products[own(self.products)];
            self.add_adjoint((products, &inputs), of_rgb, of_products, &mut of.input[own(width)], &mut of.parameters);
            lookup::add_to_lines(pairs, at, of_planes, Cotangents::Each(of_products), &mut of.lines);
        }
        of
    }

    /// Computes the cotangents of products and of the input of the first layer for some groups with these products and inputs of layers, from those of the output
    /// of the last layer, and adds those of the parameters.
    fn add_adjoint(
        &self,
        (products, inputs): (&[T], &[&[T]]),
        mut g: Buffer<T>,
        of_products: &mut [T],
        of_input: &mut [T],
        sums: &mut [Buffer<T>],
    ) {
        let m = g.len() / 3;
        let (of_basis, of_layers) = sums.split_at_mut(1);
        for (l, (layer, input)) in self.layers.iter().zip(inputs).enumerate().rev() {
            let [of_weight, of_bias] = &mut of_layers.as_chunks_mut::<2>().0[l];
            for row in g.chunks_exact(layer.outputs) {
                of_bias.iter_mut().zip(row).for_each(|(sum, &g)| *sum += g);
            }
            let cotangent = Matrix::new(&g, m, layer.outputs);
            add_product(Matrix::transposed(input, layer.inputs, m), cotangent, of_weight, self.precision);
            let weight = Matrix::transposed(layer.weight, layer.outputs, layer.inputs);
            if l == 0 {
                multiply(cotangent, weight, of_input, self.precision);
            } else {
                let mut below = Buffer::stale(m * layer.inputs);
                multiply(cotangent, weight, &mut below, self.precision);
                mask(&mut below, input);
                g = below;
            }
        }
        let width = self.layers[0].inputs;
        let mut of_features = Buffer::stale(m * self.features);
        let rows = of_features.chunks_exact_mut(self.features).zip(of_input.chunks_exact(width)).zip(inputs[0].chunks_exact(width));
        rows.for_each(|((out, g), encoded)| encode_adjoint(g, encoded, self.octaves, out));
        let features = Matrix::new(&of_features, m, self.features);
        add_product(Matrix::transposed(products, self.products, m), features, &mut of_basis[0], self.precision);
        multiply(features, Matrix::transposed(self.basis, self.features, self.products), of_products, self.precision);
    }
}

/// Returns the cotangents of the output of the last layer, from the colors sigmoid(output) and their cotangents, for the groups with these numbers.
fn of_logits<T: Real>(rgb: &[T], of_colors: &[T], numbers: &[u32]) -> Buffer<T> {
    let mut out = Buffer::stale(3 * numbers.len());
    let (rgb, of_colors) = (rgb.as_chunks::<3>().0, of_colors.as_chunks::<3>().0);
    for (out, &i) in out.as_chunks_mut::<3>().0.iter_mut().zip(numbers) {
        let (c, g) = (rgb[i as usize], of_colors[i as usize]);
        *out = [0, 1, 2].map(|k| g[k] * (c[k] * (T::one() - c[k])));
    }
    out
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
