//! What fills space: a density and the radiance it emits towards a viewer.

pub mod sh;
pub mod voxel_grid;

use crate::sampling::Samples;
use autograd::{Real, Tensor};

/// Density and color at samples.
#[derive(Debug, Clone)]
pub struct Radiance<T: Real> {
    /// `[m]`, 1 / world length, >= 0.
    pub sigma: Tensor<T>,
    /// `[m, 3]`, sRGB as the photographs have it.
    pub rgb: Tensor<T>,
}

/// Anything that can be rendered.
pub trait Field<T: Real>: Send + Sync {
    /// Density at world positions `[m, 3]`: `[m]`, 1 / world length.
    fn density(&self, positions: &Tensor<T>) -> Tensor<T>;

    /// Density and color at packed samples.
    fn radiance(&self, samples: &Samples<T>) -> Radiance<T>;
}
