//! Samples of rays up to the first opaque matter.

use super::{Jitter, March, Occupancy, Occupied, RUN, Samples, Spacing, march, packed};
use crate::camera::Ray;
use crate::geometry::Aabb;
use autograd::{Real, Tensor, no_grad, parallel};

/// Number of samples of each ray between two evaluations of the density.
const TOGETHER: usize = 16;

/// Ray whose samples are collected.
struct Front<'a> {
    march: March,
    /// Intervals in occupied cells; `None` for all intervals.
    occupied: Option<Occupied<'a>>,
    next: usize,
    /// Middle and length of the intervals found so far. The density is known at the first `known`.
    intervals: Vec<(f64, f64)>,
    known: usize,
    /// Transmittance behind the known intervals; 0 when the ray has no further samples.
    transmittance: f64,
}

impl Front<'_> {
    /// Finds the next intervals.
    fn extend(&mut self) {
        for _ in 0..TOGETHER {
            let found = match &mut self.occupied {
                Some(occupied) => occupied.next(),
                None => (self.next < self.march.count).then(|| self.march.interval(self.next)),
            };
            let Some(interval) = found else { break };
            self.next += 1;
            self.intervals.push(interval);
        }
    }

    fn new_intervals(&self) -> &[(f64, f64)] {
        &self.intervals[self.known..]
    }

    /// Ends the ray behind the first interval at which the transmittance falls below a limit.
    fn absorb<T: Real>(&mut self, sigma: &[T], below: f64) {
        let whole = sigma.len() == TOGETHER;
        for sigma in sigma {
            self.transmittance *= (-sigma.as_f64() * self.intervals[self.known].1).exp();
            self.known += 1;
            if self.transmittance < below {
                break;
            }
        }
        self.intervals.truncate(self.known);
        if !whole || self.transmittance < below {
            self.transmittance = 0.0;
        }
    }
}

/// Samples a batch of rays like [`sample`](super::sample()), but leaves out the samples in front of which the transmittance is below `below`.
///
/// `density` maps world positions `[m, 3]` to `[m]`, 1 / world length. It is evaluated without recording a gradient, at a few samples of all
/// rays together, until no ray is left.
pub fn sample_visible<T: Real>(
    rays: &[Ray],
    aabb: &Aabb,
    spacing: Spacing,
    jitter: Jitter,
    occupancy: Option<&Occupancy>,
    below: f64,
    density: impl Fn(&Tensor<T>) -> Tensor<T>,
) -> Samples<T> {
    let mut fronts: Vec<Front<'_>> = rays
        .iter()
        .enumerate()
        .map(|(r, ray)| {
            let march = march(ray, aabb, spacing, jitter.of(r));
            let occupied = occupancy.map(|cells| march.occupied(ray, cells));
            Front { march, occupied, next: 0, intervals: Vec::new(), known: 0, transmittance: 1.0 }
        })
        .collect();
    loop {
        let chunks: Vec<_> = fronts.chunks_mut(RUN).zip(rays.chunks(RUN)).collect();
        let positions = parallel::map_items(chunks, |_, (fronts, rays)| {
            let mut positions = Vec::new();
            for (front, ray) in fronts.iter_mut().zip(rays).filter(|(front, _)| front.transmittance > 0.0) {
                front.extend();
                for &(middle, _) in front.new_intervals() {
                    positions.extend(front.march.at(ray, middle).to_array().map(T::lit));
                }
            }
            positions
        });
        let positions = positions.concat();
        if positions.is_empty() {
            break;
        }
        let m = positions.len() / 3;
        let sigma = no_grad(|| density(&Tensor::from_vec(positions, &[m, 3])));
        let mut rest = sigma.data();
        for front in fronts.iter_mut().filter(|front| front.transmittance > 0.0) {
            let (own, others) = rest.split_at(front.new_intervals().len());
            front.absorb(own, below);
            rest = others;
        }
    }
    let counts: Vec<u32> = fronts.iter().map(|front| front.intervals.len() as u32).collect();
    packed(rays, counts.into_iter(), |r, slots| fronts[r].intervals.iter().for_each(|&interval| slots.put(&fronts[r].march, interval)))
}
