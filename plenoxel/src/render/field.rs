//! The trait that a field implements to be rendered.

use super::{RenderOptions, Rendered};
use crate::camera::Ray;
use crate::sampling::{Occupancy, Samples};
use autograd::{Real, Tensor};

/// Density and color at samples.
#[derive(Debug, Clone)]
pub struct Radiance<T: Real> {
    /// `[m]`, 1 / world length, >= 0.
    pub sigma: Tensor<T>,
    /// `[m, 3]`, sRGB as the photographs have it.
    pub rgb: Tensor<T>,
}

/// A density and the radiance it emits towards a viewer, at every point of space.
pub trait Field<T: Real>: Send + Sync {
    /// Density at world positions `[m, 3]`: `[m]`, 1 / world length.
    fn density(&self, positions: &Tensor<T>) -> Tensor<T>;

    /// Density and color at packed samples.
    fn radiance(&self, samples: &Samples<T>) -> Radiance<T>;

    /// The cells outside of which the density is 0; `None` if it may be above 0 everywhere.
    fn reach(&self) -> Option<&Occupancy> {
        None
    }

    /// Pixels in one pass, if this field has a kernel that renders it. The result equals [`composite()`](super::composite()) of its radiance.
    fn render_fused(&self, _rays: &[Ray], _options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        None
    }
}
