//! Positions of samples as functions of their rays.

use super::{Samples, Spacing};
use crate::camera::TrackedRays;
use crate::space::{Bend, tracked};
use autograd::{Buffer, Real, Tensor};

impl<T: Real> Samples<T> {
    /// Returns the samples with positions and directions through which gradients flow to their rays: x = o + t d, contracted for
    /// [`Spacing::Contracted`].
    ///
    /// The distances t and the lengths of the intervals are constants. They depend on the rays too, by the entry into the box and by the path of a bent ray;
    /// but a change of t only moves the samples along a ray, which changes the integral by the error of the quadrature alone.
    pub(crate) fn tracking(self, rays: &TrackedRays<T>, spacing: Spacing) -> Self {
        if self.is_empty() {
            return Samples { directions: rays.directions.clone(), ..self };
        }
        let contracted = matches!(spacing, Spacing::Contracted(_));
        let distances = if contracted { self.distances(rays) } else { self.t.clone() };
        let of_samples = |of_rays: &Tensor<T>| of_rays.segment_repeat(&self.offsets);
        let positions = of_samples(&rays.origins) + distances.unsqueeze(1) * of_samples(&rays.directions);
        let positions = if contracted { tracked::contract(&positions) } else { positions };
        Samples { positions, directions: rays.directions.clone(), ..self }
    }

    /// Returns the distances of samples on bent rays from the origins, `[m]`.
    fn distances(&self, rays: &TrackedRays<T>) -> Tensor<T> {
        let mut distances = Buffer::stale(self.len());
        for (ray, own) in rays.rays.iter().zip(self.offsets.windows(2)) {
            let (bend, own) = (Bend::of(ray), own[0] as usize..own[1] as usize);
            let of_ray = distances[own.clone()].iter_mut().zip(&self.t.data()[own]);
            of_ray.for_each(|(distance, s)| *distance = T::lit(bend.distance(s.as_f64())));
        }
        Tensor::from_buffer(distances, &[self.len()])
    }
}
