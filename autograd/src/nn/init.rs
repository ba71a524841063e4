//! [`Init`]: initial values of parameters.

use crate::random::Stream;
use crate::real::Real;
use crate::tensor::Tensor;

/// A distribution of initial values. It may depend on the number of inputs (`fan_in`) and of outputs (`fan_out`) of the layer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// Uniform distribution in ±√(6 / ((1 + a²) fan_in)), for a layer that is followed by a leaky ReLU of slope `a` (He et al. 2015). With a = √5 the
    /// bound is 1/√fan_in: PyTorch's choice for linear layers, and the default here.
    KaimingUniform {
        /// Negative slope of the activation that follows; 0 for ReLU.
        a: f64,
    },
    /// Normal distribution with standard deviation √(2 / ((1 + a²) fan_in)) (He et al. 2015).
    KaimingNormal {
        /// Negative slope of the activation that follows; 0 for ReLU.
        a: f64,
    },
    /// Uniform distribution in ±√(6 / (fan_in + fan_out)) (Glorot and Bengio 2010).
    XavierUniform,
    /// Normal distribution with standard deviation √(2 / (fan_in + fan_out)) (Glorot and Bengio 2010).
    XavierNormal,
    /// Uniform distribution in ±`bound`.
    Uniform {
        /// Largest magnitude.
        bound: f64,
    },
    /// Zeros.
    Zeros,
}

impl Default for Init {
    fn default() -> Self {
        Init::KaimingUniform { a: 5f64.sqrt() }
    }
}

impl Init {
    /// Returns initial values of the given shape. Element `i` is computed from number `i` of the stream, so the bits are the same on every machine.
    pub fn tensor<T: Real>(self, shape: &[usize], fan_in: usize, fan_out: usize, random: Stream) -> Tensor<T> {
        let (inputs, both) = (fan_in as f64, (fan_in + fan_out) as f64);
        let uniform = |bound: f64| random.uniform_tensor(shape, -bound, bound);
        let normal = |deviation: f64| random.normal_tensor(shape, 0.0, deviation);
        match self {
            Init::KaimingUniform { a } => uniform((6.0 / ((1.0 + a * a) * inputs)).sqrt()),
            Init::KaimingNormal { a } => normal((2.0 / ((1.0 + a * a) * inputs)).sqrt()),
            Init::XavierUniform => uniform((6.0 / both).sqrt()),
            Init::XavierNormal => normal((2.0 / both).sqrt()),
            Init::Uniform { bound } => uniform(bound),
            Init::Zeros => Tensor::zeros(shape),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean square and largest magnitude of many values for 50 inputs and 150 outputs, against the formulas.
    #[test]
    fn values_have_the_spread_that_was_asked_for() {
        let cases = [
            (Init::default(), 1.0 / 150.0, Some(1.0 / 50f64.sqrt())),
            (Init::KaimingUniform { a: 0.0 }, 2.0 / 50.0, Some((6.0f64 / 50.0).sqrt())),
            (Init::KaimingNormal { a: 0.0 }, 2.0 / 50.0, None),
            (Init::XavierUniform, 0.01, Some(0.03f64.sqrt())),
            (Init::XavierNormal, 0.01, None),
            (Init::Uniform { bound: 0.3 }, 0.03, Some(0.3)),
            (Init::Zeros, 0.0, Some(0.0)),
        ];
        for (init, mean_square, bound) in cases {
            let x: Tensor<f64> = init.tensor(&[50, 1000], 50, 150, Stream::new(1));
            let largest = x.abs().max().item();
            assert!((x.square().mean().item() - mean_square).abs() <= 0.02 * mean_square, "{init:?}");
            assert!(bound.is_none_or(|bound| largest <= bound * (1.0 + 1e-15) && largest >= 0.999 * bound), "{init:?}: {largest}");
        }
    }
}
