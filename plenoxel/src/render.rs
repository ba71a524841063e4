//! From rays to pixels.

pub mod composite;
pub mod picture;

use crate::camera::Ray;
use crate::field::Field;
use crate::geometry::Aabb;
use crate::sampling::{Jitter, Occupancy, Spacing, sample};
use autograd::{Real, Tensor};
pub use composite::{Rendered, composite};
use serde::{Deserialize, Serialize};

/// What computes a batch of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Engine {
    /// The graph of small ops: [`composite()`] on any field, differentiable any number of times.
    #[default]
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
    /// Cells outside of which no sample is looked at.
    pub occupancy: Option<&'a Occupancy>,
}

/// Renders a batch: dataset → rays → **samples → radiance → pixels**.
pub fn render<T: Real>(field: &impl Field<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
    let samples = sample(rays, &options.aabb, options.spacing, options.jitter, options.occupancy);
    let radiance = field.radiance(&samples);
    let background = Tensor::from_vec(options.background.map(|c| T::lit(f64::from(c))).to_vec(), &[3]);
    composite(samples, radiance, &background)
}
