//! The field of NeRF (Mildenhall et al. 2020): a network from the encoded position to density and feature, and another from the feature and the encoded
//! direction to the color.

use super::encoding::{Directions, frequency};
use crate::render::{Field, Radiance, ShadedField};
use crate::sampling::Samples;
use autograd::nn::{Activation, Mlp};
use autograd::{Precision, Real, Tensor, impl_module, random::Stream};
use serde::{Deserialize, Serialize};

/// Function from the raw density x to the density, which is not negative.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Density {
    /// max(x, 0), as in the paper. Where x < 0 on all rays, nothing is learned any more.
    Relu,
    /// ln(1 + eˣ⁻¹), as in mip-NeRF: it has a gradient everywhere.
    Softplus,
}

/// Sizes of the networks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Hidden layers of the network of the position.
    pub depth: usize,
    /// Their width, and the length of the feature.
    pub width: usize,
    /// Layer, from 0, that reads the encoded position again; 0 for none.
    pub skip: usize,
    /// Width of the hidden layer of the network of the color.
    pub color_width: usize,
    /// Octaves of the encoding of the position.
    pub position_octaves: usize,
    /// Octaves of the encoding of the direction.
    pub direction_octaves: usize,
    /// Function to the density.
    pub density: Density,
}

/// The field. Positions are encoded in world length, as in the authors' program.
#[derive(Debug)]
pub struct NerfField<T: Real> {
    shape: Shape,
    /// From the encoded position to raw density and feature, `[…, 1 + width]`.
    trunk: Mlp<T>,
    /// From feature and encoded direction to the raw color.
    color: Mlp<T>,
}

impl_module!(NerfField { trunk, color });

impl<T: Real> NerfField<T> {
    /// Creates a field whose parameters are named `<name>.trunk.0.weight` and so on, with the initial values of PyTorch's linear layers.
    ///
    /// Panics unless `skip` is less than `depth`.
    #[track_caller]
    pub fn new(name: &str, shape: Shape, random: &Stream) -> Self {
        let mut widths = vec![shape.width; shape.depth + 2];
        widths[0] = 3 * (1 + 2 * shape.position_octaves);
        widths[shape.depth + 1] = 1 + shape.width;
        assert!(shape.skip < shape.depth, "NerfField: skip = {} with {} layers", shape.skip, shape.depth);
        let name_of = |part: &str| format!("{name}.{part}");
        let trunk = match shape.skip {
            0 => Mlp::new(&name_of("trunk"), &widths, Activation::Relu, random),
            skip => Mlp::with_skip(&name_of("trunk"), &widths, Activation::Relu, skip, random),
        };
        let input = shape.width + Directions::Frequency(shape.direction_octaves).width();
        let color = Mlp::new(&name_of("color"), &[input, shape.color_width, 3], Activation::Relu, random);
        NerfField { shape, trunk, color }
    }

    /// Sets the precision of the products of both networks. It is [`Precision::Full`] in a new field.
    pub fn set_precision(&mut self, precision: Precision) {
        (self.trunk.precision, self.color.precision) = (precision, precision);
    }

    /// Returns the output of the trunk at world positions `[m, 3]`.
    fn trunk(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.trunk.forward(&frequency(positions, self.shape.position_octaves))
    }

    fn activate(&self, raw: &Tensor<T>) -> Tensor<T> {
        match self.shape.density {
            Density::Relu => raw.relu(),
            Density::Softplus => (raw - 1.0).softplus(),
        }
    }

    /// Returns density and color of packed samples. `noise`, `[m]`, is added to the raw density.
    pub fn radiance_with(&self, samples: &Samples<T>, noise: Option<&Tensor<T>>) -> Radiance<T> {
        let trunk = self.trunk(&samples.positions);
        let raw = trunk.index_axis(1, 0);
        let sigma = self.activate(&noise.map_or(raw.clone(), |noise| &raw + noise));
        let directions = Directions::Frequency(self.shape.direction_octaves).encode(&samples.directions).segment_repeat(&samples.offsets);
        Radiance { sigma, rgb: self.shade_encoded(&self.feature(&trunk), &directions) }
    }

    /// Returns the feature in outputs of the trunk.
    fn feature(&self, trunk: &Tensor<T>) -> Tensor<T> {
        trunk.narrow(1, 1, self.shape.width)
    }

    /// Returns the colors of features and encoded directions.
    fn shade_encoded(&self, features: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
        self.color.forward(&Tensor::concat(&[features, directions], 1)).sigmoid()
    }
}

impl<T: Real> ShadedField<T> for NerfField<T> {
    fn features(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.feature(&self.trunk(positions))
    }

    fn shade(&self, features: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
        self.shade_encoded(features, &Directions::Frequency(self.shape.direction_octaves).encode(directions))
    }
}

impl<T: Real> Field<T> for NerfField<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        self.activate(&self.trunk(positions).index_axis(1, 0))
    }

    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        self.radiance_with(samples, None)
    }
}
