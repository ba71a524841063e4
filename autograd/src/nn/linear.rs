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
    /// W, `[inputs, outputs]`: the transpose of PyTorch's.
    pub weight: Param<T>,
    /// b, `[outputs]`.
    pub bias: Param<T>,
}

impl_module!(Linear { weight, bias });

impl<T: Real> Linear<T> {
    /// A layer whose parameters are called `<name>.weight` and `<name>.bias`, with values of the default [`Init`].
    pub fn new(name: &str, inputs: usize, outputs: usize, random: &Stream) -> Self {
        let mut layer = Linear {
            weight: Param::from_tensor(format!("{name}.weight"), Tensor::zeros(&[inputs, outputs])),
            bias: Param::from_tensor(format!("{name}.bias"), Tensor::zeros(&[outputs])),
        };
        layer.initialize(Init::default(), Init::default(), random);
        layer
    }

    /// Gives weight and bias new values. Both go by the inputs and outputs of the weight, and each has a stream of its own, by the name of the
    /// parameter: other layers do not change what this one begins with.
    pub fn initialize(&mut self, weight: Init, bias: Init, random: &Stream) {
        let (fan_in, fan_out) = (self.inputs(), self.outputs());
        for (param, init) in [(&mut self.weight, weight), (&mut self.bias, bias)] {
            let value = init.tensor::<T>(param.shape(), fan_in, fan_out, random.named(param.name()));
            param.update(|values| values.copy_from_slice(value.data()));
        }
    }

    /// x W + b, for x `[…, inputs]` of two dimensions or more: `[…, outputs]`.
    ///
    /// Panics, naming the parameter and the shapes, if x has another last dimension.
    #[track_caller]
    pub fn forward(&self, x: &Tensor<T>) -> Tensor<T> {
        assert!(
            x.ndim() >= 2 && x.shape().last() == Some(&self.inputs()),
            "Linear: `{}` of shape {:?} got an input of shape {:?}; expected […, {}]",
            self.weight.name(),
            self.weight.shape(),
            x.shape(),
            self.inputs()
        );
        x.matmul(self.weight.tensor()) + self.bias.tensor()
    }

    /// The number of inputs.
    pub fn inputs(&self) -> usize {
        self.weight.shape()[0]
    }

    /// The number of outputs.
    pub fn outputs(&self) -> usize {
        self.weight.shape()[1]
    }
}
