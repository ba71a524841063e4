//! Rays that gradients flow to.

use super::Ray;
use autograd::{Real, Tensor};
use glam::DVec3;

/// Rays with their origins and directions as tensors. Gradients of rendered pixels flow through the tensors to whatever moves the rays, such as a
/// correction of their camera's pose.
#[derive(Clone, Debug)]
pub struct TrackedRays<T: Real> {
    /// The rays.
    pub rays: Vec<Ray>,
    /// Their origins, `[n, 3]`.
    pub origins: Tensor<T>,
    /// Their unit directions, `[n, 3]`.
    pub directions: Tensor<T>,
}

impl<T: Real> TrackedRays<T> {
    /// Creates the rays with these origins and unit directions, `[n, 3]`, and the stretches of the rays `like`.
    ///
    /// Panics if the numbers of rays differ.
    #[track_caller]
    pub fn new(origins: Tensor<T>, directions: Tensor<T>, like: &[Ray]) -> Self {
        assert!(
            origins.shape() == [like.len(), 3] && directions.shape() == [like.len(), 3],
            "TrackedRays: one origin and direction per ray"
        );
        let vectors = |tensor: &Tensor<T>| {
            let rows = tensor.data().as_chunks::<3>().0;
            rows.iter().map(|row| DVec3::from_array(row.map(|x| x.as_f64()))).collect::<Vec<_>>()
        };
        let both = vectors(&origins).into_iter().zip(vectors(&directions));
        let rays = both.zip(like).map(|((origin, direction), ray)| Ray { origin, direction, ..*ray }).collect();
        TrackedRays { rays, origins, directions }
    }
}
