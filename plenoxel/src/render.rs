//! Volume rendering: pixels from rays.

pub(crate) mod along;
pub mod composite;
mod field;
pub mod picture;

use crate::camera::{Ray, TrackedRays};
use crate::geometry::Aabb;
use crate::sampling::{Jitter, Occupancy, Samples, Spacing, sample};
use autograd::{Real, Tensor};
pub use composite::{Columns, PerSample, Rendered, composite, weights};
pub use field::{Field, Radiance, ShadedField};
use serde::{Deserialize, Serialize};

/// Implementation that renders a batch of rays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Engine {
    /// One fused pass with a hand-written adjoint, for fields with a kernel; the graph for other fields.
    #[default]
    Fused,
    /// Graph of small ops: [`composite()`] on any field. It keeps the values of every sample.
    Graph,
}

/// Options for rendering rays.
#[derive(Clone, Debug)]
pub struct RenderOptions<'a> {
    /// Bounding box; space outside of it is empty.
    pub aabb: Aabb,
    /// Spacing of samples.
    pub spacing: Spacing,
    /// Random shift of samples; [`Jitter::None`] for evaluation.
    pub jitter: Jitter,
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Cells in which samples are evaluated; `None` for the cells that the field can reach.
    pub occupancy: Option<&'a Occupancy>,
    /// Implementation.
    pub engine: Engine,
    /// Transmittance below which the fused engine ends a ray; 0 never ends it early. Samples behind are not looked up: columns and
    /// gradients include only the samples before. The error of a color is at most this value times the largest difference between colors.
    pub stop_below: f64,
}

/// Renders a batch of rays: dataset → rays → **samples → radiance → pixels**.
pub fn render<T: Real>(field: &impl Field<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    let fused = match options.engine {
        Engine::Fused => field.render_fused(rays, options),
        Engine::Graph => None,
    };
    fused.unwrap_or_else(|| render_graph(field, rays, |samples| samples, options))
}

/// Renders a batch of rays like [`render`]. Gradients also flow to the rays, through the positions of samples and the directions in which the field is seen.
/// The distances of samples from the origins of their rays, and their lengths, are constants.
pub fn render_tracked<T: Real>(field: &impl Field<T>, rays: &TrackedRays<T>, options: &RenderOptions<'_>) -> Rendered<T> {
    let fused = match options.engine {
        Engine::Fused => field.render_fused_tracked(rays, options),
        Engine::Graph => None,
    };
    fused.unwrap_or_else(|| render_graph(field, &rays.rays, |samples| samples.tracking(rays, options.spacing), options))
}

fn render_graph<T: Real>(
    field: &impl Field<T>,
    rays: &[Ray],
    track: impl FnOnce(Samples<T>) -> Samples<T>,
    options: &RenderOptions<'_>,
) -> Rendered<T> {
    let cells = options.occupancy.or(field.reach());
    let samples = track(sample(rays, &options.aabb, options.spacing, options.jitter, cells));
    let radiance = field.radiance(&samples);
    let background = Tensor::from_vec(options.background.map(|c| T::lit(f64::from(c))).to_vec(), &[3]);
    composite(samples, radiance, &background)
}
