//! Encodings of positions, directions and features for networks.

use super::sh;
use crate::error::{Error, Result};
use autograd::{Real, Tensor};
use serde::{Deserialize, Serialize};

/// Encoding of the unit direction of a ray for the color network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Directions {
    /// The direction, and sin and cos of 2ᵏ times it for k below this number (TensoRF).
    Frequency(usize),
    /// Spherical harmonics up to this degree, at most 3 (Instant-NGP).
    Harmonics(usize),
}

impl Directions {
    /// Returns the number of values per direction.
    pub fn width(self) -> usize {
        match self {
            Directions::Frequency(octaves) => 3 * (1 + 2 * octaves),
            Directions::Harmonics(degree) => sh::count(degree),
        }
    }

    /// Checks the number of octaves or the degree. `key` names the setting in errors.
    pub fn validate(self, key: &str) -> Result<()> {
        let valid = match self {
            Directions::Frequency(octaves) => octaves <= 16,
            Directions::Harmonics(degree) => degree <= sh::MAX_DEGREE,
        };
        match valid {
            true => Ok(()),
            false => Err(Error::config(key, format!("{self:?}"), "up to 16 octaves, or harmonics up to degree 3")),
        }
    }

    /// Encodes unit directions `[n, 3]`: `[n, width]`.
    pub fn encode<T: Real>(self, directions: &Tensor<T>) -> Tensor<T> {
        match self {
            Directions::Frequency(octaves) => frequency(directions, octaves),
            Directions::Harmonics(degree) => sh::basis(directions, degree),
        }
    }
}

/// Returns the frequency encoding of x `[n, c]`: x with sin 2ᵏx and cos 2ᵏx for k < `octaves` appended, `[n, c (1 + 2 octaves)]` (NeRF: Mildenhall et al. 2020,
/// section 5.1, without its factor π, as in the authors' program).
pub fn frequency<T: Real>(x: &Tensor<T>, octaves: usize) -> Tensor<T> {
    let waves = (0..octaves).map(|k| x * f64::from(1 << k)).flat_map(|x| [x.sin(), x.cos()]);
    let all: Vec<Tensor<T>> = [x.clone()].into_iter().chain(waves).collect();
    Tensor::concat(&all.iter().collect::<Vec<_>>(), 1)
}
