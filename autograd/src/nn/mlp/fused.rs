//! A network as one [`Kernel`]: all layers for a block of rows, whose activations stay in the cache, then the next block.
//!
//! *Forward.* Blocks are independent. The hidden activations of the first blocks are kept for the adjoint, up to a limit ([`KEPT`]); those of the others are
//! computed again.
//!
//! *Adjoint.* A part is a range of blocks, at most [`PARTS`] in all. Each part adds the weight gradients of its blocks in their order, and the sums of
//! the parts are added in their order. Bounds depend on the number of rows only, so the bits do not depend on the number of threads. A product that no
//! needed cotangent depends on is not computed.

use super::{Activation, Mlp, layered};
use crate::matrix::{Matrix, Precision, add_product, multiply};
use crate::op::{GradSink, Kernel, KernelCall};
use crate::parallel::{self, dispatched};
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;

/// Rows of a block. With fewer, the products spend their time packing the weights; with more, activations of 256 columns leave the second-level cache.
const ROWS: usize = 256;
/// Most partial sums of the gradients of the weights.
const PARTS: usize = 32;
/// Most numbers of hidden activations that are kept: 512 MB in `f32`. Computing them again takes a third of the operations of a step without.
const KEPT: usize = 1 << 27;

/// An activation function whose derivative is a function of its value.
#[derive(Clone, Copy, Debug)]
enum Curve<T> {
    /// x for x >= 0, and the slope times x for x < 0, which is −0 if the slope is 0: the sign of the value tells the side.
    Leaky(T),
    Softplus,
    Tanh,
}

impl<T: Real> Curve<T> {
    fn of(activation: Activation) -> Option<Self> {
        match activation {
            Activation::Relu => Some(Curve::Leaky(T::zero())),
            Activation::LeakyRelu { slope } => (slope >= 0.0).then(|| Curve::Leaky(T::lit(slope))),
            Activation::Softplus => Some(Curve::Softplus),
            Activation::Tanh => Some(Curve::Tanh),
            Activation::Sine { .. } => None,
        }
    }

    /// Adds the bias to each row and applies the function.
    fn apply(self, y: &mut [T], bias: &[T]) {
        match self {
            Curve::Leaky(slope) => add_bias(y, bias, move |z: T| if z < T::zero() { slope * z } else { z + T::zero() }),
            Curve::Softplus if parallel::fused() => add_bias(y, bias, softplus::<T, true>),
            Curve::Softplus => add_bias(y, bias, softplus::<T, false>),
            Curve::Tanh => add_bias(y, bias, T::tanh_),
        }
    }

    /// Multiplies g by the derivative where the function has the value y.
    fn adjoint(self, g: &mut [T], y: &[T]) {
        match self {
            Curve::Leaky(slope) => multiply_by(g, y, move |y: T| if y.is_sign_negative() { slope } else { T::one() }),
            Curve::Softplus if parallel::fused() => multiply_by(g, y, T::one_minus_exp_neg::<true>),
            Curve::Softplus => multiply_by(g, y, T::one_minus_exp_neg::<false>),
            Curve::Tanh => multiply_by(g, y, |y: T| T::one() - y * y),
        }
    }
}

#[inline(always)]
fn softplus<T: Real, const FUSED: bool>(z: T) -> T {
    z.max(T::zero()) + (-z.abs()).exp_::<FUSED>().ln_1p()
}

/// A layer: y = x A + h B + b with the input x of the network and the activations h of the layer before. A and B are the upper and the lower rows of the
/// weight; the first layer has no B, and only the first and the skip layer have A.
struct Layer<'a, T> {
    weight: &'a [T],
    bias: &'a [T],
    /// Rows of A.
    of_input: usize,
    /// Rows of B.
    of_hidden: usize,
    outputs: usize,
    precision: Precision,
}

impl<T: Real> Layer<'_, T> {
    fn upper(&self) -> Matrix<'_, T> {
        Matrix::new(&self.weight[..self.of_input * self.outputs], self.of_input, self.outputs)
    }

    fn lower(&self) -> Matrix<'_, T> {
        Matrix::new(&self.weight[self.of_input * self.outputs..], self.of_hidden, self.outputs)
    }

    /// Computes x A + h B for a block of m rows.
    fn products(&self, x: &[T], hidden: &[T], m: usize, out: &mut [T]) {
        if self.of_hidden > 0 {
            multiply(Matrix::new(hidden, m, self.of_hidden), self.lower(), out, self.precision);
            if self.of_input > 0 {
                add_product(Matrix::new(x, m, self.of_input), self.upper(), out, self.precision);
            }
        } else {
            multiply(Matrix::new(x, m, self.of_input), self.upper(), out, self.precision);
        }
    }
}

struct Network<'a, T> {
    layers: Vec<Layer<'a, T>>,
    curve: Curve<T>,
}

/// The cotangents that a part computes: of its rows of the input, and its shares of those of the weights and biases, in the order of the parameters.
struct Cotangents<'a, T: Real> {
    of_input: Option<&'a mut [T]>,
    of_params: Vec<Option<Buffer<T>>>,
}

impl<'a, T: Real> Network<'a, T> {
    /// Creates the network from input, weights and biases.
    fn new(inputs: &'a [Tensor<T>], curve: Curve<T>, skip: Option<usize>, precision: Precision) -> Self {
        let width = inputs[1].shape()[0];
        let layer = |(i, pair): (usize, &'a [Tensor<T>])| {
            let [rows, outputs] = [0, 1].map(|axis| pair[0].shape()[axis]);
            let of_input = if i == 0 || skip == Some(i) { width } else { 0 };
            Layer { weight: pair[0].data(), bias: pair[1].data(), of_input, of_hidden: rows - of_input, outputs, precision }
        };
        Network { layers: inputs[1..].chunks(2).enumerate().map(layer).collect(), curve }
    }

    fn inputs(&self) -> usize {
        self.layers[0].of_input
    }

    fn outputs(&self) -> usize {
        self.layers[self.layers.len() - 1].outputs
    }

    /// Computes the output of a block. Returns the activations of all hidden layers, or of the last one only.
    fn forward(&self, x: &[T], out: &mut [T], all: bool) -> Vec<Buffer<T>> {
        let m = x.len() / self.inputs();
        let mut hidden: Vec<Buffer<T>> = Vec::new();
        let (last, others) = self.layers.split_last().expect("a layer");
        for layer in others {
            let mut y = Buffer::stale(m * layer.outputs);
            layer.products(x, hidden.last().map_or(&[], |h| &h[..]), m, &mut y);
            self.curve.apply(&mut y, layer.bias);
            if !all {
                hidden.clear();
            }
            hidden.push(y);
        }
        last.products(x, hidden.last().map_or(&[], |h| &h[..]), m, out);
        add_bias(out, last.bias, |z| z);
        hidden
    }

    /// Stores the cotangent of the input of a block and adds those of the parameters, given its input, its hidden activations and the cotangent of its output.
    /// `first` is the first row of the block in the cotangent of the input.
    fn adjoint(&self, x: &[T], hidden: &[Buffer<T>], g: &[T], first: usize, to: &mut Cotangents<'_, T>) {
        let m = x.len() / self.inputs();
        let needed = |l: usize, to: &Cotangents<'_, T>| {
            let of_input = to.of_input.is_some() && self.layers[l].of_input > 0;
            of_input || to.of_params[2 * l].is_some() || to.of_params[2 * l + 1].is_some()
        };
        let Some(lowest) = (0..self.layers.len()).find(|&l| needed(l, to)) else { return };
        let mut of_output = Buffer::stale(g.len());
        drop_tiny(g, &mut of_output);
        let mut g = of_output;
        let mut unwritten = true;
        for (l, layer) in self.layers.iter().enumerate().skip(lowest).rev() {
            let cotangent = Matrix::new(&g, m, layer.outputs);
            if let Some(sum) = &mut to.of_params[2 * l + 1] {
                add_rows(sum, &g);
            }
            if let Some(sum) = &mut to.of_params[2 * l] {
                let (upper, lower) = sum.split_at_mut(layer.of_input * layer.outputs);
                if layer.of_input > 0 {
                    add_product(Matrix::transposed(x, layer.of_input, m), cotangent, upper, layer.precision);
                }
                if layer.of_hidden > 0 {
                    add_product(Matrix::transposed(&hidden[l - 1], layer.of_hidden, m), cotangent, lower, layer.precision);
                }
            }
            if let Some(sum) = to.of_input.as_mut().filter(|_| layer.of_input > 0) {
                let (upper, sum) = (layer.upper().transpose(), &mut sum[first * layer.of_input..][..m * layer.of_input]);
                // The layers are visited from the last to the first: the skip layer, if there is one, before the first layer.
                let product = if std::mem::take(&mut unwritten) { multiply } else { add_product };
                product(cotangent, upper, sum, layer.precision);
            }
            if l > lowest {
                let mut below = Buffer::stale(m * layer.of_hidden);
                multiply(cotangent, layer.lower().transpose(), &mut below, layer.precision);
                self.curve.adjoint(&mut below, &hidden[l - 1]);
                g = below;
            }
        }
    }
}

/// Returns the output of a network, or `None` if the kernel does not compute networks like this one.
pub fn forward<T: Real>(mlp: &Mlp<T>, x: &Tensor<T>) -> Option<Tensor<T>> {
    forward_keeping(mlp, x, KEPT)
}

/// Computes the output as [`forward`] does, and keeps at most `most` numbers of hidden activations.
fn forward_keeping<T: Real>(mlp: &Mlp<T>, x: &Tensor<T>, most: usize) -> Option<Tensor<T>> {
    let curve = Curve::of(mlp.activation)?;
    let widths = || mlp.layers.iter().map(|layer| (layer.inputs(), layer.outputs()));
    let fits = |l: usize, (above, before): ((usize, usize), (usize, usize))| {
        above.0 == before.1 + if mlp.skip == Some(l + 1) { x.shape()[x.ndim() - 1] } else { 0 }
    };
    let chained = widths().skip(1).zip(widths()).enumerate().all(|(l, pair)| fits(l, pair));
    if mlp.layers.is_empty() || !chained || mlp.skip == Some(0) || widths().any(|(inputs, outputs)| inputs == 0 || outputs == 0) {
        return None;
    }
    let mut inputs = vec![x.clone()];
    inputs.extend(mlp.layers.iter().flat_map(|layer| [layer.weight.tensor().clone(), layer.bias.tensor().clone()]));
    let network = Network::new(&inputs, curve, mlp.skip, mlp.precision);
    let rows = x.len() / network.inputs();
    let hidden: usize = network.layers.iter().map(|layer| layer.of_hidden).sum();
    let recorded = crate::graph::recording() && inputs.iter().any(Tensor::is_tracked);
    let kept_blocks = if recorded { most / (ROWS * hidden).max(1) } else { 0 };
    let mut out = Buffer::stale(rows * network.outputs());
    let blocks: Vec<&mut [T]> = out.chunks_mut(ROWS * network.outputs()).collect();
    let hidden = parallel::map_items(blocks, |b, out| {
        let (m, keep) = (out.len() / network.outputs(), b < kept_blocks);
        let hidden = network.forward(&x.data()[b * ROWS * network.inputs()..][..m * network.inputs()], out, keep);
        keep.then_some(hidden)
    });
    let mut shape = x.shape().to_vec();
    shape[x.ndim() - 1] = network.outputs();
    let kernel = Fused { layers: mlp.layers.len(), activation: mlp.activation, curve, skip: mlp.skip, precision: mlp.precision, hidden };
    Some(Tensor::from_kernel(out, &shape, &inputs.iter().collect::<Vec<_>>(), kernel))
}

#[derive(Debug)]
struct Fused<T: Real> {
    layers: usize,
    activation: Activation,
    curve: Curve<T>,
    skip: Option<usize>,
    precision: Precision,
    /// Hidden activations of each block, unless they are to be computed again.
    hidden: Vec<Option<Vec<Buffer<T>>>>,
}

impl<T: Real> Kernel<T> for Fused<T> {
    fn name(&self) -> &'static str {
        "mlp"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let layers = inputs[1..].chunks(2).map(|pair| move |x: &Tensor<T>| x.matmul(&pair[0]) + &pair[1]);
        layered(&inputs[0], self.activation, self.skip, layers)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let count = 1 + 2 * self.layers;
        let inputs: Vec<Tensor<T>> = (0..count).map(|i| call.input(i)).collect();
        let network = Network::new(&inputs, self.curve, self.skip, self.precision);
        let (x, g) = (inputs[0].data(), call.cotangent().data());
        let (width, outputs) = (network.inputs(), network.outputs());
        let rows = x.len() / width;
        let of_part = ROWS * rows.div_ceil(ROWS).div_ceil(PARTS).max(1);
        // Each row is stored by the skip layer, or without one by the first layer.
        let mut of_input = call.needs(0).then(|| Buffer::stale(x.len()));
        let zeros = || (1..count).map(|i| call.needs(i).then(|| Buffer::zeros(inputs[i].len()))).collect();
        let parts: Vec<Option<&mut [T]>> = match &mut of_input {
            Some(all) => all.chunks_mut(of_part * width).map(Some).collect(),
            None => (0..rows.div_ceil(of_part)).map(|_| None).collect(),
        };
        let parts = parallel::map_items(parts, |part, of_input| {
            let mut to = Cotangents { of_input, of_params: zeros() };
            for start in (part * of_part..rows.min((part + 1) * of_part)).step_by(ROWS) {
                let end = rows.min(start + ROWS);
                let (x, g) = (&x[start * width..end * width], &g[start * outputs..end * outputs]);
                let first = start - part * of_part;
                match &self.hidden[start / ROWS] {
                    Some(kept) => network.adjoint(x, kept, g, first, &mut to),
                    None => {
                        let mut again = Buffer::stale(g.len());
                        network.adjoint(x, &network.forward(x, &mut again, true), g, first, &mut to);
                    }
                }
            }
            to.of_params
        });
        let mut sums: Vec<Option<Buffer<T>>> = zeros();
        for part in &parts {
            for (sum, part) in sums.iter_mut().flatten().zip(part.iter().flatten()) {
                parallel::zip_in_place(sum, part, |a, b| a + b);
            }
        }
        for (i, values) in [of_input].into_iter().chain(sums).enumerate() {
            if let Some(values) = values {
                out.dense(i, values);
            }
        }
    }
}

dispatched! {
/// Adds the bias to each row and applies a function.
fn add_bias<T: Real, F: Fn(T) -> T>(y: &mut [T], bias: &[T], f: F) {
    for row in y.chunks_exact_mut(bias.len()) {
        for (y, &b) in row.iter_mut().zip(bias) {
            *y = f(*y + b);
        }
    }
}
}

dispatched! {
fn multiply_by<T: Real, F: Fn(T) -> T>(g: &mut [T], y: &[T], slope: F) {
    for (g, &y) in g.iter_mut().zip(y) {
        *g *= slope(y);
    }
}
}

dispatched! {
/// Copies cotangents. Those below 10¹² times the smallest normal number become 0, as those of samples behind opaque matter may be. Products with them may be
/// subnormal, which takes processors up to 40 times as long: the adjoint of eight layers of 128 took 9200 instead of 220 ms with cotangents of 10⁻³⁶.
fn drop_tiny<T: Real>(from: &[T], to: &mut [T]) {
    let least = T::min_positive_value() * T::lit(1e12);
    for (to, &g) in to.iter_mut().zip(from) {
        *to = if g.abs() < least { T::zero() } else { g };
    }
}
}

dispatched! {
/// Adds the rows of g to the sum.
fn add_rows<T: Real>(sum: &mut [T], g: &[T]) {
    for row in g.chunks_exact(sum.len()) {
        for (sum, &g) in sum.iter_mut().zip(row) {
            *sum += g;
        }
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Stream;
    use crate::{Module, check_kernel};
    use ndarray::ArrayD;

    const CURVES: [Activation; 4] = [Activation::Relu, Activation::LeakyRelu { slope: 0.1 }, Activation::Softplus, Activation::Tanh];

    fn net<T: Real>(activation: Activation, skip: Option<usize>) -> Mlp<T> {
        Mlp::of("net", &[3, 7, 5, 6, 2], activation, skip, &Stream::new(1))
    }

    fn input<T: Real>(rows: usize) -> Tensor<T> {
        Stream::new(5).uniform_tensor(&[rows, 3], -2.0, 2.0)
    }

    fn bound<T: Real>(mut net: Mlp<T>, params: &[Tensor<T>]) -> Mlp<T> {
        let mut given = params.iter();
        net.visit_mut(&mut |param| {
            let tensor = given.next().expect("a tensor for each parameter").clone();
            if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
        });
        net
    }

    /// Rows that fill no block, several blocks, and several blocks of each part; activations that are kept and that are computed again.
    fn agrees<T: Real>(tolerance: f64) {
        for (i, activation) in CURVES.into_iter().enumerate() {
            for (rows, skip) in [(5, None), (ROWS + 1, Some(1)), (2 * PARTS * ROWS + 3, Some(3))] {
                let mut inputs: Vec<ArrayD<T>> = vec![input::<T>(rows).to_array()];
                net::<T>(activation, skip).visit(&mut |param| inputs.push(param.tensor().to_array()));
                let most = if i % 2 == 0 { KEPT } else { 0 };
                let output = |x: &[Tensor<T>]| forward_keeping(&bound(net(activation, skip), &x[1..]), &x[0], most).expect("a kernel");
                check_kernel(output, inputs, tolerance).unwrap_or_else(|e| panic!("{activation:?}, {rows} rows: {e}"));
            }
        }
    }

    #[test]
    fn the_kernel_is_what_the_layers_say_in_both_precisions() {
        agrees::<f64>(1e-12);
        // Sums of 16 387 rows, in another order.
        agrees::<f32>(3e-5);
    }

    /// A factor of eight binary digits has an error of at most 0.4 %, and there are four layers.
    #[test]
    fn mixed_precision_is_near_full_precision_in_values_and_gradients() {
        for skip in [None, Some(2)] {
            let mut inputs: Vec<ArrayD<f32>> = vec![input::<f32>(2 * ROWS + 1).to_array()];
            net::<f32>(Activation::Tanh, skip).visit(&mut |param| inputs.push(param.tensor().to_array()));
            let output =
                |x: &[Tensor<f32>]| Mlp { precision: Precision::Mixed, ..bound(net(Activation::Tanh, skip), &x[1..]) }.forward(&x[0]);
            let report = check_kernel(output, inputs, 0.01).unwrap_or_else(|e| panic!("{skip:?}: {e}"));
            assert!(!Precision::Mixed.is_available() || report.value.relative_l2 > 1e-4);
        }
    }

    #[test]
    fn activations_that_are_computed_again_and_any_number_of_threads_give_the_same_bits() {
        let bits = |threads: usize, most: usize, precision: Precision| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| {
                let net = Mlp { precision, ..net::<f32>(Activation::Relu, Some(2)) };
                let x = input::<f32>(10_000).into_variable();
                let y = forward_keeping(&net, &x, most).expect("a kernel");
                let gradients = y.square().sum().backward();
                let mut all: Vec<f32> = y.data().iter().copied().chain(gradients.array(&x)).collect();
                net.visit(&mut |param| all.extend(gradients.array(param.tensor())));
                all.into_iter().map(f32::to_bits).collect::<Vec<_>>()
            })
        };
        for precision in [Precision::Full, Precision::Mixed] {
            let want = bits(1, KEPT, precision);
            // Of 40 blocks, 20 fit in the last limit.
            let half = 20 * ROWS * (7 + 5 + 6);
            assert!(
                [(2, KEPT), (3, KEPT), (1, 0), (3, 0), (2, half)].into_iter().all(|(threads, most)| bits(threads, most, precision) == want)
            );
        }
    }

    /// The graph has derivative 1 at the kink, and so has the kernel: units whose input is exactly 0 are alive in both.
    #[test]
    fn cotangents_near_the_smallest_number_count_as_0() {
        let net = net::<f32>(Activation::Relu, None);
        let output = net.forward(&input::<f32>(40));
        let sum = |scale: f64| {
            let gradients = output.backward_from(&(Tensor::full(output.shape(), 1.0) * scale));
            gradients.array(net.layers[0].weight.tensor()).iter().map(|g| f64::from(g.abs())).sum::<f64>()
        };
        assert_eq!(sum(1e-27), 0.0);
        assert!((sum(1e-24) / sum(1e-3) / 1e-21 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn a_unit_at_its_kink_has_the_derivative_of_the_graph() {
        for z in [0.0, -0.0] {
            let mut net = Mlp::<f64>::new("net", &[1, 1, 1], Activation::Relu, &Stream::new(1));
            net.layers[0].weight.update(|w| w[0] = z);
            net.layers[0].bias.update(|b| b[0] = z);
            net.layers[1].weight.update(|w| w[0] = 3.0);
            let y = net.forward(&Tensor::ones(&[1, 1]));
            assert_eq!(y.backward().array(net.layers[0].bias.tensor())[[0]], 3.0);
        }
    }

    #[test]
    fn networks_that_the_kernel_does_not_compute_are_left_to_the_graph() {
        for net in [net::<f64>(Activation::Sine { omega: 1.0 }, None), net(Activation::LeakyRelu { slope: -0.5 }, None)] {
            assert!(forward(&net, &input(4)).is_none());
            assert_eq!(net.forward(&input(4)).shape(), [4, 2]);
        }
        let empty = net::<f64>(Activation::Relu, Some(1)).forward(&Tensor::zeros(&[0, 3]));
        assert_eq!(empty.shape(), [0, 2]);
    }
}
