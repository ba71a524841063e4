//! What fills space: a density and the radiance it emits towards a viewer.

pub(crate) mod neighbours;
pub mod sh;
pub mod voxel_grid;

use crate::camera::Ray;
use crate::render::{RenderOptions, Rendered};
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

/// Anything that can be rendered.
pub trait Field<T: Real>: Send + Sync {
    /// Density at world positions `[m, 3]`: `[m]`, 1 / world length.
    fn density(&self, positions: &Tensor<T>) -> Tensor<T>;

    /// Density and color at packed samples.
    fn radiance(&self, samples: &Samples<T>) -> Radiance<T>;

    /// The cells in which a sample can find anything; `None` if that is everywhere.
    fn reach(&self) -> Option<&Occupancy> {
        None
    }

    /// Pixels in one pass, if this field has a kernel that renders it: the same as [`crate::render::composite()`] of its radiance.
    fn render_fused(&self, _rays: &[Ray], _options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        None
    }
}
