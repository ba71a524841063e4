//! The color network on arrays, from the planes and lines of the appearance to colors: forward and adjoint for the groups of samples of one block.
//!
//! The input of the first layer is x = (γ(f), e(d)): encoded features f of a group, and the encoded direction d of its ray. So x W = γ(f) W_f + e(d) W_d. The second
//! product and its adjoint are computed once for each ray of a chunk of groups.

use super::super::Shape;
use super::lookup::{self, Cotangents, Pairs, Places};
use super::nodes::Nodes;
use super::pruning;
use autograd::{Buffer, Matrix, Precision, Real, Tensor, add_product, dispatched, multiply, parallel};
use std::ops::Range;

/// Number of groups, or of samples, that are processed before others: their values stay in the second-level cache.
pub const ROWS: usize = 256;

/// Fewest groups for each node, on average, for which [`Network::forward_by_nodes`] computes values at nodes.
const GROUPS_OF_NODE: usize = 2;

/// Linear layer.
#[derive(Clone, Copy)]
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
    /// Layers; the first one without the rows of its weight that encoded directions are multiplied by.
    layers: Vec<Layer<'a, T>>,
    /// Rows of the first layer's weight that encoded directions are multiplied by, `[e, outputs]`.
    of_directions: Matrix<'a, T>,
    precision: Precision,
}

/// The directions in which the groups of a block are seen.
#[derive(Clone, Copy)]
pub struct Seen<'a, T> {
    /// Number of the ray of each group. The groups of a ray follow one another.
    pub rays: &'a [u32],
    /// Number of the first ray of the block.
    pub first: usize,
    /// Encoded directions of the rays of the block, `[rays, e]`.
    pub encoded: &'a [T],
    /// Numbers of an encoded direction, e.
    pub width: usize,
}

/// The rays of some groups.
struct Rays<T: Real> {
    /// Numbers in the block.
    numbers: Vec<usize>,
    /// Place of the ray of each group in `numbers`.
    of_groups: Vec<usize>,
    /// Encoded directions, `[rays, e]`.
    encoded: Vec<T>,
}

impl<T: Real> Rays<T> {
    fn none() -> Self {
        Rays { numbers: Vec::new(), of_groups: Vec::new(), encoded: Vec::new() }
    }

    /// Finds the rays of these groups.
    fn find(&mut self, seen: Seen<'_, T>, groups: impl Iterator<Item = usize>) {
        self.numbers.clear();
        self.of_groups.clear();
        self.encoded.clear();
        for group in groups {
            let ray = seen.rays[group] as usize - seen.first;
            if self.numbers.last() != Some(&ray) {
                self.numbers.push(ray);
                self.encoded.extend_from_slice(&seen.encoded[ray * seen.width..][..seen.width]);
            }
            self.of_groups.push(self.numbers.len() - 1);
        }
    }
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
    /// Cotangents of the encoded directions of the rays of the block, `[rays, e]`, if they are tracked.
    pub encoded: Buffer<T>,
    /// Cotangents of the three lines of the appearance, one after another.
    pub lines: Buffer<T>,
    /// Cotangents of the matrix and of the layers' weights and biases, in the order of the parameters.
    pub parameters: Vec<Buffer<T>>,
}

impl<'a, T: Real> Network<'a, T> {
    /// Creates the network from its parameters.
    pub fn new(shape: &Shape, tables: &'a [Tensor<T>], precision: Precision) -> Self {
        let encoded = shape.features * (1 + 2 * shape.feature_octaves);
        let layer = |pair: &'a [Tensor<T>]| {
            let [inputs, outputs] = [0, 1].map(|axis| pair[0].shape()[axis]);
            Layer { weight: pair[0].data(), bias: pair[1].data(), inputs, outputs }
        };
        let mut layers: Vec<_> = tables[1..].chunks(2).map(layer).collect();
        let first = &mut layers[0];
        let (of_features, of_directions) = first.weight.split_at(encoded * first.outputs);
        let of_directions = Matrix::new(of_directions, first.inputs - encoded, first.outputs);
        (first.weight, first.inputs) = (of_features, encoded);
        Network {
            basis: tables[0].data(),
            products: tables[0].shape()[0],
            features: shape.features,
            octaves: shape.feature_octaves,
            layers,
            of_directions,
            precision,
        }
    }

    /// Computes the colors of groups from the planes and lines of the appearance at their positions. The inputs of the layers are kept for the adjoint if `keep`.
    pub fn forward(&self, pairs: Pairs<'_, T>, at: Places<'_, T>, keep: bool, seen: Seen<'_, T>) -> Activations<T> {
        let m = at[0].len();
        let mut features_at = self.features_at(pairs, ROWS.min(m));
        let mut features = Buffer::stale(ROWS.min(m) * self.features);
        self.layers_of(m, keep, seen, |groups, input, out| {
            let features = &mut features[..groups.len() * self.features];
            features_at(at.map(|at| &at[groups.clone()]), features);
            self.encode(features, input);
            self.multiply_by_first(input, out);
        })
    }

    /// Computes the colors of groups near each other, without an adjoint. What is linear in the products is computed at the nodes around the groups ([`Nodes`]), unless
    /// they are too many: the product of the features with the weight of the first layer, or the features if the layer reads sines of them. In mixed precision,
    /// factors are rounded at the nodes.
    pub fn forward_by_nodes(&self, pairs: Pairs<'_, T>, at: Places<'_, T>, seen: Seen<'_, T>) -> Activations<T> {
        let m = at[0].len();
        let Some(nodes) = Nodes::around(at, pairs.nodes, m / GROUPS_OF_NODE) else {
            return self.forward(pairs, at, false, seen);
        };
        let mut features_at = self.features_at(pairs, ROWS.min(nodes.len()));
        let mut features = Buffer::stale(ROWS.min(m) * self.features);
        let width = if self.octaves == 0 { self.layers[0].outputs } else { self.features };
        let mut values = Buffer::stale(nodes.len() * width);
        for (chunk, values) in values.chunks_mut(ROWS * width).enumerate() {
            let count = values.len() / width;
            let places = nodes.places.each_ref().map(|places| &places[chunk * ROWS..][..count]);
            if self.octaves == 0 {
                let features = &mut features[..count * self.features];
                features_at(places, features);
                self.multiply_by_first(features, values);
            } else {
                features_at(places, values);
            }
        }
        self.layers_of(m, false, seen, |groups, input, out| {
            if self.octaves == 0 {
                nodes.interpolate(groups.start, &values, out);
            } else {
                let features = &mut features[..groups.len() * self.features];
                nodes.interpolate(groups.start, &values, features);
                self.encode(features, input);
                self.multiply_by_first(input, out);
            }
        })
    }

    /// Returns a function that computes the features of up to `most` positions.
    fn features_at<'b>(&'b self, pairs: Pairs<'b, T>, most: usize) -> impl FnMut(Places<'_, T>, &mut [T]) + 'b {
        let [mut of_planes, mut products] = [(); 2].map(|()| Buffer::stale(most * self.products));
        move |at, features| {
            let count = at[0].len();
            let [of_planes, products] = [&mut of_planes, &mut products].map(|values| &mut values[..count * self.products]);
            lookup::planes(pairs, at, of_planes);
            lookup::times_lines(pairs, at, of_planes, products);
            let products = Matrix::new(products, count, self.products);
            multiply(products, Matrix::new(self.basis, self.products, self.features), features, self.precision);
        }
    }

    /// Writes the inputs of the first layer from features.
    fn encode(&self, features: &[T], input: &mut [T]) {
        let rows = features.chunks_exact(self.features).zip(input.chunks_exact_mut(self.layers[0].inputs));
        rows.for_each(|(features, input)| encode(features, self.octaves, input));
    }

    /// Multiplies inputs by the weight of the first layer.
    fn multiply_by_first(&self, input: &[T], out: &mut [T]) {
        let Layer { weight, inputs, outputs, .. } = self.layers[0];
        multiply(Matrix::new(input, input.len() / inputs, inputs), Matrix::new(weight, inputs, outputs), out, self.precision);
    }

    /// Computes the colors of m groups. `first(groups, input, out)` computes the input of the first layer and its product with the weight; if nothing is kept, it
    /// need not write the input.
    fn layers_of(
        &self,
        m: usize,
        keep: bool,
        seen: Seen<'_, T>,
        mut first: impl FnMut(Range<usize>, &mut [T], &mut [T]),
    ) -> Activations<T> {
        let kept = if keep { m } else { ROWS.min(m) };
        let mut inputs: Vec<_> = self.layers.iter().map(|layer| Buffer::stale(kept * layer.inputs)).collect();
        let mut rgb = Buffer::stale(3 * m);
        let mut of_rays = Buffer::stale(ROWS.min(m) * self.layers[0].outputs);
        let mut rays = Rays::none();
        for start in (0..m).step_by(ROWS) {
            let groups = start..m.min(start + ROWS);
            let count = groups.len();
            let place = if keep { start } else { 0 };
            let own = |width: usize| place * width..(place + count) * width;
            rays.find(seen, groups.clone());
            let of_rays = &mut of_rays[..rays.numbers.len() * self.layers[0].outputs];
            let encoded = Matrix::new(&rays.encoded, rays.numbers.len(), seen.width);
            multiply(encoded, self.of_directions, of_rays, self.precision);
            add_bias::<T, false>(of_rays, self.layers[0].bias);
            let (input, above) = inputs.split_at_mut(1);
            let out = &mut above[0][own(self.layers[0].outputs)];
            first(groups.clone(), &mut input[0][own(self.layers[0].inputs)], out);
            add_of_rays(out, of_rays, &rays.of_groups);
            for (l, layer) in self.layers.iter().enumerate().skip(1) {
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

    /// Computes the cotangents of the products, of the lines and of the parameters for the groups with these numbers and positions, from the cotangents of the colors
    /// of all groups; and those of encoded directions if `tracked`.
    pub fn adjoint(
        &self,
        activations: &Activations<T>,
        numbers: &[u32],
        (pairs, at): (Pairs<'_, T>, Places<'_, T>),
        (seen, tracked): (Seen<'_, T>, bool),
        of_colors: &[T],
    ) -> OfNetwork<T> {
        let mut lengths = vec![self.basis.len()];
        lengths.extend(self.layers.iter().flat_map(|layer| [layer.weight.len(), layer.bias.len()]));
        lengths[1] += seen.width * self.layers[0].outputs;
        let mut of = OfNetwork {
            products: Buffer::stale(numbers.len() * self.products),
            encoded: Buffer::zeros(if tracked { seen.encoded.len() } else { 0 }),
            lines: pairs.zeros_of_lines(),
            parameters: lengths.into_iter().map(Buffer::zeros).collect(),
        };
        let [mut of_planes, mut products] = [(); 2].map(|()| Buffer::stale(ROWS.min(numbers.len()) * self.products));
        let mut copies: Vec<_> = self.layers.iter().map(|_| Buffer::stale(0)).collect();
        let mut rays = Rays::none();
        for (chunk, numbers) in numbers.chunks(ROWS).enumerate() {
            let groups = chunk * ROWS..chunk * ROWS + numbers.len();
            let at = at.map(|at| &at[groups.clone()]);
            let [of_planes, products] = [&mut of_planes, &mut products].map(|values| &mut values[..numbers.len() * self.products]);
            lookup::planes(pairs, at, of_planes);
            lookup::times_lines(pairs, at, of_planes, products);
            let layers = activations.inputs.iter().zip(&self.layers).zip(&mut copies);
            let inputs: Vec<_> = layers.map(|((all, layer), copy)| pruning::rows(all, layer.inputs, numbers, copy)).collect();
            let of_products = &mut of.products[groups.start * self.products..groups.end * self.products];
            let of_logits = of_logits(&activations.rgb, of_colors, numbers);
            let of_hidden = self.add_adjoint((products, &inputs), of_logits, of_products, &mut of.parameters);
            lookup::add_to_lines(pairs, at, of_planes, Cotangents::Each(of_products), &mut of.lines);
            rays.find(seen, numbers.iter().map(|&i| i as usize));
            self.add_adjoint_of_rays(&rays, &of_hidden, seen.width, &mut of);
        }
        of
    }

    /// Computes the cotangents of products for some groups with these products and inputs of layers, from those of the output of the last layer. Adds those of the
    /// parameters, without the first layer's bias and rows for directions. Returns the cotangents of the output of the first layer, `[m, outputs]`.
    fn add_adjoint(
        &self,
        (products, inputs): (&[T], &[&[T]]),
        mut g: Buffer<T>,
        of_products: &mut [T],
        sums: &mut [Buffer<T>],
    ) -> Buffer<T> {
        let m = g.len() / 3;
        let (of_basis, of_layers) = sums.split_at_mut(1);
        for (l, (layer, input)) in self.layers.iter().zip(inputs).enumerate().rev() {
            let [of_weight, of_bias] = &mut of_layers.as_chunks_mut::<2>().0[l];
            let cotangent = Matrix::new(&g, m, layer.outputs);
            add_product(Matrix::transposed(input, layer.inputs, m), cotangent, &mut of_weight[..layer.weight.len()], self.precision);
            if l > 0 {
                add_rows(of_bias, &g);
                let mut below = Buffer::stale(m * layer.inputs);
                multiply(cotangent, Matrix::transposed(layer.weight, layer.outputs, layer.inputs), &mut below, self.precision);
                mask(&mut below, input);
                g = below;
            }
        }
        let first = &self.layers[0];
        let [mut of_input, mut of_features] = [first.inputs, self.features].map(|width| Buffer::stale(m * width));
        let weight = Matrix::transposed(first.weight, first.outputs, first.inputs);
        multiply(Matrix::new(&g, m, first.outputs), weight, &mut of_input, self.precision);
        let rows =
            of_features.chunks_exact_mut(self.features).zip(of_input.chunks_exact(first.inputs)).zip(inputs[0].chunks_exact(first.inputs));
        rows.for_each(|((out, g), encoded)| encode_adjoint(g, encoded, self.octaves, out));
        let features = Matrix::new(&of_features, m, self.features);
        add_product(Matrix::transposed(products, self.products, m), features, &mut of_basis[0], self.precision);
        multiply(features, Matrix::transposed(self.basis, self.features, self.products), of_products, self.precision);
        g
    }

    /// Adds the cotangents that the rays of some groups contribute, from those of the output of the first layer for these groups: of its bias, of the rows of its weight
    /// for directions, and, if rays are tracked, of encoded directions, which have `width` numbers.
    fn add_adjoint_of_rays(&self, rays: &Rays<T>, of_hidden: &[T], width: usize, of: &mut OfNetwork<T>) {
        let (first, count) = (&self.layers[0], rays.numbers.len());
        let mut of_rays = Buffer::zeros(count * first.outputs);
        add_to_rays(&mut of_rays, of_hidden, &rays.of_groups);
        add_rows(&mut of.parameters[2], &of_rays);
        let cotangent = Matrix::new(&of_rays, count, first.outputs);
        let of_weight = &mut of.parameters[1][first.weight.len()..];
        add_product(Matrix::transposed(&rays.encoded, width, count), cotangent, of_weight, self.precision);
        if of.encoded.is_empty() {
            return;
        }
        let mut of_encoded = Buffer::stale(count * width);
        multiply(cotangent, self.of_directions.transpose(), &mut of_encoded, self.precision);
        for (g, &ray) in of_encoded.chunks_exact(width).zip(&rays.numbers) {
            add_rows(&mut of.encoded[ray * width..][..width], g);
        }
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
        add_to_row::<T, RELU>(row, bias);
    }
}
}

dispatched! {
/// Adds to each row that of its ray, and applies ReLU.
fn add_of_rays<T: Real>(out: &mut [T], of_rays: &[T], rays: &[usize]) {
    let width = out.len() / rays.len();
    for (row, &ray) in out.chunks_exact_mut(width).zip(rays) {
        add_to_row::<T, true>(row, &of_rays[ray * width..][..width]);
    }
}
}

dispatched! {
/// Adds each row to that of its ray.
fn add_to_rays<T: Real>(of_rays: &mut [T], rows: &[T], rays: &[usize]) {
    let width = rows.len() / rays.len();
    for (row, &ray) in rows.chunks_exact(width).zip(rays) {
        add_to_row::<T, false>(&mut of_rays[ray * width..][..width], row);
    }
}
}

/// Adds values to a row, and applies ReLU if asked.
#[inline(always)]
fn add_to_row<T: Real, const RELU: bool>(row: &mut [T], values: &[T]) {
    for (x, &value) in row.iter_mut().zip(values) {
        let y = *x + value;
        *x = if RELU && y < T::zero() { T::zero() } else { y };
    }
}

dispatched! {
/// Adds the rows of a matrix to a sum.
fn add_rows<T: Real>(sum: &mut [T], rows: &[T]) {
    for row in rows.chunks_exact(sum.len()) {
        add_to_row::<T, false>(sum, row);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::encoding::Directions;
    use crate::field::factored::Factored;
    use crate::geometry::Aabb;
    use autograd::random::Stream;

    const NODES: [usize; 3] = [5, 4, 6];
    /// More groups than are processed together.
    const COUNT: usize = ROWS + 300;
    /// Number of the first ray. Each ray has five groups; one has some in the first chunk and some in the second.
    const FIRST: usize = 7;

    /// Calls a function with a network, its planes and lines, positions of groups, the last of which are at nodes and faces, and their directions.
    fn with_network(
        (features, hidden, feature_octaves): (usize, usize, usize),
        f: impl Fn(&Network<'_, f64>, Pairs<'_, f64>, Places<'_, f64>, Seen<'_, f64>),
    ) {
        let directions = Directions::Harmonics(1);
        let shape = Shape { density_components: 16, appearance_components: 32, features, hidden, feature_octaves, directions };
        let field = Factored::<f64>::new(shape, Aabb::cube(1.0), NODES, &Stream::new(3));
        let tables: Vec<_> = field.tables().iter().map(|table| table * 5.0).collect();
        let columns = [0, 1, 2].map(|axis| {
            let most = NODES[axis] as f64 - 1.0;
            let mut at = Stream::new(axis as u64).uniform_tensor::<f64>(&[COUNT], 0.0, most).data().to_vec();
            (0..12).for_each(|i| at[COUNT - 1 - i] = (i / [1, 2, 3][axis] % NODES[axis]) as f64);
            at
        });
        let rays: Vec<u32> = (0..COUNT).map(|i| (FIRST + i / 5) as u32).collect();
        let encoded = Stream::new(9).uniform_tensor::<f64>(&[COUNT.div_ceil(5) * 4], -1.0, 1.0);
        let seen = Seen { rays: &rays, first: FIRST, encoded: encoded.data(), width: 4 };
        let pairs = Pairs::of(&tables[6..12], NODES, 32);
        f(&Network::new(&shape, &tables[12..], Precision::Full), pairs, columns.each_ref().map(|column| &column[..]), seen);
    }

    /// Group i alone.
    fn alone<'a>(at: Places<'a, f64>, seen: Seen<'a, f64>, i: usize) -> (Places<'a, f64>, Seen<'a, f64>) {
        (at.map(|at| &at[i..=i]), Seen { rays: &seen.rays[i..=i], ..seen })
    }

    fn largest(a: &[f64], b: &[f64]) -> f64 {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn colors_by_nodes_are_those_at_the_positions() {
        // Widths with and without a remainder after whole chunks; sines of features, which are not linear.
        for sizes in [(4, 32, 0), (4, 20, 0), (18, 8, 2)] {
            with_network(sizes, |network, pairs, at, seen| {
                assert!(Nodes::around(at, NODES, COUNT / GROUPS_OF_NODE).is_some(), "the nodes are few enough");
                let [want, found] = [network.forward(pairs, at, false, seen), network.forward_by_nodes(pairs, at, seen)];
                let largest = largest(&want.rgb, &found.rgb);
                assert!(largest < 1e-12, "{sizes:?}: {largest}");
                let different = want.rgb.iter().filter(|&&x| (x - want.rgb[0]).abs() > 0.01).count();
                assert!(different > COUNT, "the colors differ: {different} of {}", want.rgb.len());
            });
        }
    }

    #[test]
    fn colors_and_cotangents_of_many_groups_are_those_of_each_alone() {
        with_network((4, 20, 0), |network, pairs, at, seen| {
            let all = network.forward(pairs, at, true, seen);
            let of_colors = Stream::new(5).uniform_tensor::<f64>(&[3 * COUNT], -1.0, 1.0);
            // Some groups are pruned.
            let numbers: Vec<u32> = (0..COUNT as u32).filter(|i| i % 7 != 3).collect();
            let kept = at.map(|at| numbers.iter().map(|&i| at[i as usize]).collect::<Vec<_>>());
            let kept = kept.each_ref().map(|column| &column[..]);
            let found = network.adjoint(&all, &numbers, (pairs, kept), (seen, true), of_colors.data());
            let mut want = found.parameters.iter().chain([&found.encoded, &found.lines]).map(|x| vec![0.0; x.len()]).collect::<Vec<_>>();
            let mut products = Vec::new();
            for &i in &numbers {
                let i = i as usize;
                let (at, seen) = alone(at, seen, i);
                let one = network.forward(pairs, at, true, seen);
                assert!(largest(&one.rgb, &all.rgb[3 * i..3 * i + 3]) < 1e-12, "group {i}");
                let one = network.adjoint(&one, &[0], (pairs, at), (seen, true), &of_colors.data()[3 * i..3 * i + 3]);
                for (sum, own) in want.iter_mut().zip(one.parameters.iter().chain([&one.encoded, &one.lines])) {
                    sum.iter_mut().zip(&own[..]).for_each(|(sum, x)| *sum += x);
                }
                products.extend_from_slice(&one.products);
            }
            for (want, found) in want.iter().zip(found.parameters.iter().chain([&found.encoded, &found.lines])) {
                assert!(want.iter().any(|x| x.abs() > 1e-3) && largest(want, found) < 1e-10, "{}", largest(want, found));
            }
            assert!(largest(&products, &found.products) < 1e-12);
        });
    }
}
