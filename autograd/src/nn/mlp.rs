//! [`Mlp`]: a multilayer perceptron.

mod fused;

use super::Linear;
use crate::impl_module;
use crate::matrix::Precision;
use crate::random::Stream;
use crate::real::Real;
use crate::tensor::Tensor;

/// An activation function.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Activation {
    /// ReLU, max(x, 0): [`Tensor::relu`].
    Relu,
    /// Leaky ReLU, x for x >= 0 and `slope` · x for x < 0: [`Tensor::leaky_relu`].
    LeakyRelu {
        /// Slope for x < 0; PyTorch's default is 0.01.
        slope: f64,
    },
    /// Softplus, ln(1 + eˣ): [`Tensor::softplus`]. It has derivatives of all orders.
    Softplus,
    /// Hyperbolic tangent, tanh x: [`Tensor::tanh`].
    Tanh,
    /// Sine, sin(ω x) (SIREN; Sitzmann et al. 2020). The paper initializes the weights by [`Init::Uniform`](super::Init::Uniform) with the bound
    /// 1 / inputs in the first layer and √(6 / inputs) / ω in the others.
    Sine {
        /// Frequency ω; 30 in the paper.
        omega: f64,
    },
}

impl Activation {
    /// Applies the function to each element.
    pub fn apply<T: Real>(self, x: &Tensor<T>) -> Tensor<T> {
        match self {
            Activation::Relu => x.relu(),
            Activation::LeakyRelu { slope } => x.leaky_relu(slope),
            Activation::Softplus => x.softplus(),
            Activation::Tanh => x.tanh(),
            Activation::Sine { omega } => (x * omega).sin(),
        }
    }
}

/// A multilayer perceptron: linear layers with an activation after each layer except the last.
#[derive(Debug)]
pub struct Mlp<T: Real> {
    /// Linear layers, from input to output.
    pub layers: Vec<Linear<T>>,
    /// Activation after each layer except the last.
    pub activation: Activation,
    /// Index of the layer that reads the input of the network concatenated with the previous activations, `[…, input + hidden]`.
    pub skip: Option<usize>,
    /// Precision of the products of layers, forward and in the adjoint; [`Precision::Full`] in a new network. With a sine, and for derivatives that are differentiated
    /// again, products are always in full precision.
    pub precision: Precision,
}

impl_module!(Mlp { layers });

impl<T: Real> Mlp<T> {
    /// Creates a network with the given widths, including the widths of the input and the output: `&[63, 256, 256, 4]` gives three layers. The parameters
    /// are named `<name>.0.weight`, `<name>.0.bias`, `<name>.1.weight`, and so on. Their initial values come from the default [`Init`](super::Init).
    ///
    /// Panics if there are fewer than two widths.
    #[track_caller]
    pub fn new(name: &str, widths: &[usize], activation: Activation, random: &Stream) -> Self {
        Self::of(name, widths, activation, None, random)
    }

    /// Creates a network like [`Mlp::new`] with a skip connection: layer `skip`, counted from 0, also reads the input of the network. NeRF (Mildenhall et al.
    /// 2020) uses `skip` = 5.
    ///
    /// Panics unless `skip` is the index of a layer other than the first.
    #[track_caller]
    pub fn with_skip(name: &str, widths: &[usize], activation: Activation, skip: usize, random: &Stream) -> Self {
        assert!(
            skip >= 1 && skip + 1 < widths.len(),
            "Mlp: `{name}` with widths {widths:?} got skip = {skip}; expected the index of a layer other than the first"
        );
        Self::of(name, widths, activation, Some(skip), random)
    }

    #[track_caller]
    fn of(name: &str, widths: &[usize], activation: Activation, skip: Option<usize>, random: &Stream) -> Self {
        assert!(widths.len() >= 2, "Mlp: `{name}` got widths {widths:?}; expected at least an input and an output width");
        let layer = |(i, pair): (usize, &[usize])| {
            let more = if skip == Some(i) { widths[0] } else { 0 };
            Linear::new(&format!("{name}.{i}"), pair[0] + more, pair[1], random)
        };
        Mlp { layers: widths.windows(2).enumerate().map(layer).collect(), activation, skip, precision: Precision::Full }
    }

    /// Returns the output, of shape `[…, last width]`, for x of shape `[…, first width]` with at least two dimensions.
    ///
    /// Every activation but the sine is computed by a kernel, block by block of rows, and its derivatives with respect to x and to the parameters are
    /// computed only where they are needed. At the kink of a ReLU the derivative is that of the right side.
    ///
    /// Panics with the name of the layer and the shapes if x has fewer dimensions or another last dimension.
    #[track_caller]
    pub fn forward(&self, x: &Tensor<T>) -> Tensor<T> {
        if let Some(first) = self.layers.first() {
            first.check_input(x);
        }
        let graph = || layered(x, self.activation, self.skip, self.layers.iter().map(|layer| |x: &Tensor<T>| layer.forward(x)));
        fused::forward(self, x).unwrap_or_else(graph)
    }
}

/// Applies layers to x one after another, with the activation between them; layer `skip` reads x concatenated with the activations.
fn layered<T: Real, L: Fn(&Tensor<T>) -> Tensor<T>>(
    x: &Tensor<T>,
    activation: Activation,
    skip: Option<usize>,
    layers: impl Iterator<Item = L>,
) -> Tensor<T> {
    let mut hidden = x.clone();
    for (i, layer) in layers.enumerate() {
        if i > 0 {
            hidden = activation.apply(&hidden);
        }
        if skip == Some(i) {
            hidden = Tensor::concat(&[x, &hidden], x.ndim() - 1);
        }
        hidden = layer(&hidden);
    }
    hidden
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::Init;
    use crate::{Gradcheck, Module, gradcheck};
    use ndarray::{ArrayD, arr2};

    const ALL: [Activation; 5] =
        [Activation::Relu, Activation::LeakyRelu { slope: 0.01 }, Activation::Softplus, Activation::Tanh, Activation::Sine { omega: 3.0 }];

    #[test]
    fn names_shapes_and_initial_values_are_pytorchs() {
        let net = Mlp::<f32>::new("mlp", &[3, 16, 2], Activation::Relu, &Stream::new(7));
        assert_eq!(net.param_names(), ["mlp.0.weight", "mlp.0.bias", "mlp.1.weight", "mlp.1.bias"]);
        let mut shapes = Vec::new();
        net.visit(&mut |param| shapes.push(param.shape().to_vec()));
        assert_eq!(shapes, [vec![3, 16], vec![16], vec![16, 2], vec![2]]);
        for layer in &net.layers {
            let bound = 1.0 / (layer.inputs() as f32).sqrt();
            layer.visit(&mut |param| assert!(param.tensor().data().iter().all(|x| x.abs() <= bound && *x != 0.0)));
        }
        let again = Mlp::<f32>::new("mlp", &[3, 16, 2], Activation::Relu, &Stream::new(7));
        assert_eq!(net.layers[1].weight.tensor().data(), again.layers[1].weight.tensor().data());
        assert_ne!(net.layers[0].bias.tensor().data(), net.layers[0].weight.tensor().data()[..16].to_vec());
    }

    #[test]
    fn the_output_is_what_the_layers_say_and_a_skip_sees_the_input() {
        let mut net = Mlp::<f64>::with_skip("mlp", &[2, 3, 1], Activation::Relu, 1, &Stream::new(7));
        assert_eq!(net.layers[1].inputs(), 5);
        net.layers[0].initialize(Init::Zeros, Init::Zeros, &Stream::new(7));
        net.layers[1].weight.update(|w| w.copy_from_slice(&[10.0, 1.0, 5.0, 6.0, 7.0]));
        net.layers[1].bias.update(|b| b[0] = 0.5);
        let x = Tensor::constant(arr2(&[[1.0, 2.0], [-3.0, 4.0]]));
        assert_eq!(net.forward(&x).data(), [12.5, -25.5]);
        assert_eq!(net.forward(&x.reshape(&[1, 2, 2])).shape(), [1, 2, 1]);
    }

    /// Checks derivatives with respect to the input and to all parameters, which are bound to the inputs of the check.
    #[test]
    fn derivatives_of_both_orders_are_right_with_every_activation() {
        for activation in ALL {
            let net = Mlp::<f64>::with_skip("mlp", &[2, 4, 3, 1], activation, 1, &Stream::new(3));
            let mut inputs: Vec<ArrayD<f64>> = vec![Stream::new(5).uniform_tensor::<f64>(&[3, 2], -1.0, 1.0).to_array()];
            net.visit(&mut |param| inputs.push(param.tensor().to_array()));
            let output = |x: &[Tensor<f64>]| {
                let mut net = Mlp::<f64>::with_skip("mlp", &[2, 4, 3, 1], activation, 1, &Stream::new(3));
                let mut given = x[1..].iter();
                net.visit_mut(&mut |param| {
                    let tensor = given.next().expect("a tensor for each parameter").clone();
                    if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
                });
                net.forward(&x[0])
            };
            Gradcheck::new(output, inputs).named(format!("{activation:?}")).run().unwrap_or_else(|e| panic!("{e}"));
        }
        gradcheck(|x| Activation::Sine { omega: 30.0 }.apply(&x[0]), [arr2(&[[0.1, -0.2]]).into_dyn()]);
    }

    #[test]
    #[should_panic(expected = "`mlp.0.weight` of shape [2, 3] got an input of shape [4, 3]; expected […, 2]")]
    fn an_input_of_another_width_is_refused_by_the_name_of_the_layer() {
        Mlp::<f32>::new("mlp", &[2, 3, 1], Activation::Relu, &Stream::new(0)).forward(&Tensor::ones(&[4, 3]));
    }

    #[test]
    #[should_panic(expected = "got skip = 2; expected the index of a layer other than the first")]
    fn a_skip_to_a_layer_that_does_not_exist_is_refused() {
        Mlp::<f32>::with_skip("mlp", &[2, 3, 1], Activation::Relu, 2, &Stream::new(0));
    }
}
