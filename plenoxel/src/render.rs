//! From rays to pixels.

pub mod composite;
mod field;
pub mod picture;

use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::sampling::{Jitter, Occupancy, Spacing, sample};
use autograd::{Real, Tensor};
pub use composite::{Columns, PerSample, Rendered, composite};
pub use field::{Field, Radiance};
use serde::{Deserialize, Serialize};

/// What computes a batch of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Engine {
    /// One pass over a field that has a kernel, with a hand-written adjoint; the graph for any other field.
    #[default]
    Fused,
    /// The graph of small ops: [`composite()`] on any field, with every number of every sample at hand.
    Graph,
}

/// How rays become pixels.
#[derive(Clone, Debug)]
pub struct RenderOptions<'a> {
    /// The box outside of which there is nothing.
    pub aabb: Aabb,
    /// Where samples lie.
    pub spacing: Spacing,
    /// Their random shift: none when evaluating.
    pub jitter: Jitter,
    /// Color behind the box, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Cells outside of which no sample is looked at; `None` for those that the field itself can reach.
    pub occupancy: Option<&'a Occupancy>,
    /// What does it.
    pub engine: Engine,
    /// The fused engine ends a ray where less than this share of the light comes from behind; 0 for never. What lies behind is not looked up:
    /// all columns and all gradients are of the samples before. A color is then off by at most this times the largest difference between
    /// colors.
    pub stop_below: f64,
}

/// Renders a batch: dataset → rays → **samples → radiance → pixels**.
pub fn render<T: Real>(field: &impl Field<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    let fused = match options.engine {
        Engine::Fused => field.render_fused(rays, options),
        Engine::Graph => None,
    };
    fused.unwrap_or_else(|| render_graph(field, rays, options))
}

fn render_graph<T: Real>(field: &impl Field<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    let cells = options.occupancy.or(field.reach());
    let samples = sample(rays, &options.aabb, options.spacing, options.jitter, cells);
    let radiance = field.radiance(&samples);
    let background = Tensor::from_vec(options.background.map(|c| T::lit(f64::from(c))).to_vec(), &[3]);
    composite(samples, radiance, &background)
}
