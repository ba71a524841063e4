//! Trait of fields that can be rendered.

use super::{RenderOptions, Rendered};
use crate::camera::{Ray, TrackedRays};
use crate::sampling::{Occupancy, Samples};
use autograd::{Real, Tensor};
use glam::DVec3;

/// Density and color at samples.
#[derive(Debug, Clone)]
pub struct Radiance<T: Real> {
    /// Density, `[m]`, 1 / world length, >= 0.
    pub sigma: Tensor<T>,
    /// Color, `[m, 3]`, sRGB like the photographs.
    pub rgb: Tensor<T>,
}

/// Radiance field: a density, and a color that depends on the view direction, at every point of space.
pub trait Field<T: Real>: Send + Sync {
    /// Returns the density at world positions `[m, 3]`: `[m]`, 1 / world length.
    fn density(&self, positions: &Tensor<T>) -> Tensor<T>;

    /// Returns density and color of packed samples.
    fn radiance(&self, samples: &Samples<T>) -> Radiance<T>;

    /// Returns the cells outside of which the density is 0; `None` if it may be above 0 everywhere.
    fn reach(&self) -> Option<&Occupancy> {
        None
    }

    /// Renders rays in one pass, if this field has a kernel. The result must equal [`composite()`](super::composite()) of the field's
    /// radiance.
    fn render_fused(&self, _rays: &[Ray], _options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        None
    }

    /// Renders tracked rays in one pass, if this field has a kernel whose adjoint gives gradients to rays. The result must equal that of the graph
    /// ([`render_tracked`](super::render_tracked)).
    fn render_fused_tracked(&self, _rays: &TrackedRays<T>, _options: &RenderOptions<'_>) -> Option<Rendered<T>> {
        None
    }
}

/// A field whose color is a function of a feature of the position, and of the direction. It can be [baked](crate::bake).
pub trait ShadedField<T: Real>: Field<T> {
    /// Returns the features at world positions `[m, 3]`: `[m, F]`.
    fn features(&self, positions: &Tensor<T>) -> Tensor<T>;

    /// Returns the colors of features `[m, F]`, seen along unit directions `[m, 3]`: `[m, 3]`, in [0, 1].
    fn shade(&self, features: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T>;

    /// Returns the sides of voxels that are as fine as the field, world length; `None` if the field has no cells.
    fn voxel_sides(&self) -> Option<DVec3> {
        None
    }
}
