//! [`Linear`]: y = x W + b.

use super::Init;
use crate::impl_module;
use crate::param::Param;
use crate::random::Stream;
use crate::real::Real;
use crate::tensor::Tensor;

/// A linear layer, y = x W + b.
#[derive(Debug)]
pub struct Linear<T: Real> {
    /// Weight W, `[inputs, outputs]`: the transpose of PyTorch's weight.
    pub weight: Param<T>,
    /// Bias b, `[outputs]`.
    pub bias: Param<T>,
}

impl_module!(Linear { weight, bias });

impl<T: Real> Linear<T> {
    /// Creates a layer whose parameters are named `<name>.weight` and `<name>.bias`. Their initial values come from the default [`Init`].
    pub fn new(name: &str, inputs: usize, outputs: usize, random: &Stream) -> Self {
        let mut layer = Linear {
            weight: Param::from_tensor(format!("{name}.weight"), Tensor::zeros(&[inputs, outputs])),
            bias: Param::from_tensor(format!("{name}.bias"), Tensor::zeros(&[outputs])),
        };
        layer.initialize(Init::default(), Init::default(), random);
        layer
    }

    /// Initializes weight and bias. `fan_in` and `fan_out` of both are the numbers of inputs and outputs of the layer. Each parameter uses the random stream
    /// of its name, so the values do not depend on other layers.
    pub fn initialize(&mut self, weight: Init, bias: Init, random: &Stream) {
        let (fan_in, fan_out) = (self.inputs(), self.outputs());
        for (param, init) in [(&mut self.weight, weight), (&mut self.bias, bias)] {
            let value = init.tensor::<T>(param.shape(), fan_in, fan_out, random.named(param.name()));
            param.update(|values| values.copy_from_slice(value.data()));
        }
    }

    /// Returns x W + b, of shape `[…, outputs]`, for x of shape `[…, inputs]` with at least two dimensions.
    ///
    /// Panics with the name of the parameter and the shapes if x has fewer dimensions or another last dimension.
    #[track_caller]
    pub fn forward(&self, x: &Tensor<T>) -> Tensor<T> {
        self.check_input(x);
        x.matmul(self.weight.tensor()) + self.bias.tensor()
    }

    #[track_caller]
    pub(super) fn check_input(&self, x: &Tensor<T>) {
        assert!(
            x.ndim() >= 2 && x.shape().last() == Some(&self.inputs()),
            "Linear: `{}` of shape {:?} got an input of shape {:?}; expected […, {}]",
            self.weight.name(),
            self.weight.shape(),
            x.shape(),
            self.inputs()
        );
    }

    /// Returns the number of inputs.
    pub fn inputs(&self) -> usize {
        self.weight.shape()[0]
    }

    /// Returns the number of outputs.
    pub fn outputs(&self) -> usize {
        self.weight.shape()[1]
    }
}
