//! Samples that are seen: neither transparent nor behind an opaque surface.

use crate::sampling::Samples;
use autograd::{Indices, Real, Tensor, parallel};

/// Returns the samples whose own opacity 1 − exp(−σδ) is above `opacity_above` and whose transmittance T is at least `stop_below`. T counts only the
/// samples that are returned, as does the pixel that is composited from them: the sample at which T falls below `stop_below` is the last of its ray.
///
/// The error of a color is at most `opacity_above` for each sample that is left out before, and `stop_below` for those behind.
pub fn seen<T: Real>(all: Samples<T>, density: impl Fn(&Tensor<T>) -> Tensor<T>, opacity_above: f64, stop_below: f64) -> Samples<T> {
    const RAYS: usize = 128;
    let sigma = density(&all.positions);
    let (sigma, delta) = (sigma.data(), all.delta.data());
    // The opacity of a sample is above a threshold where its optical depth is above another.
    let (thin, deep) = (T::lit(-(-opacity_above).ln_1p()), T::lit(-stop_below.ln()));
    let rays = all.offsets.len() - 1;
    let parts = parallel::map_chunks(rays, RAYS, |range| {
        let (mut kept, mut ends) = (Vec::new(), Vec::with_capacity(range.len()));
        for ray in range {
            let mut depth = T::zero();
            for i in all.offsets[ray]..all.offsets[ray + 1] {
                let tau = sigma[i as usize] * delta[i as usize];
                if tau > thin {
                    kept.push(i);
                    depth += tau;
                    if depth > deep {
                        break;
                    }
                }
            }
            ends.push(kept.len() as u32);
        }
        (kept, ends)
    });
    let (mut kept, mut offsets) = (Vec::new(), vec![0]);
    for (own, ends) in &parts {
        let before = kept.len() as u32;
        offsets.extend(ends.iter().map(|end| before + end));
        kept.extend_from_slice(own);
    }
    let kept = Indices::from(kept);
    Samples {
        t: all.t.gather_rows(&kept),
        delta: all.delta.gather_rows(&kept),
        positions: all.positions.gather_rows(&kept),
        directions: all.directions,
        offsets: offsets.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Ray;
    use crate::geometry::Aabb;
    use crate::sampling::{Jitter, Spacing, sample};
    use glam::DVec3;

    /// Samples at t = 1, 2, 3 … of two rays along x through a box of ten units, and a third ray that misses it.
    fn samples() -> Samples<f64> {
        let ray = |y: f64| Ray { origin: DVec3::new(-0.5, y, 0.0), direction: DVec3::X, stretch: 1.0 };
        let aabb = Aabb { min: DVec3::new(0.0, -2.0, -1.0), max: DVec3::new(10.0, 2.0, 1.0) };
        sample(&[ray(-1.0), ray(3.0), ray(1.0)], &aabb, Spacing::Step(1.0), Jitter::None, None)
    }

    #[test]
    fn transparent_and_hidden_samples_are_left_out() {
        // The first ray is clear up to its fourth sample, and the sixth sample is opaque. The last ray is clear.
        let density = |positions: &Tensor<f64>| {
            let at = positions.data().as_chunks::<3>().0.iter();
            let of = at.map(|p| if p[1] > 0.0 { 0.0 } else { [0.0, 0.0, 0.0, 0.1, 0.1, 9.0, 9.0, 9.0, 9.0, 9.0][p[0] as usize] });
            Tensor::from_vec(of.collect(), &[positions.shape()[0]])
        };
        let kept = seen(samples(), density, 1e-4, 1e-3);
        assert_eq!((&kept.offsets[..], kept.t.data()), (&[0, 3, 3, 3][..], &[4.0, 5.0, 6.0][..]));
        let all = seen(samples(), |positions| density(positions) + 1e-3, 0.0, 0.0);
        assert_eq!((&all.offsets[..], all.positions.data()), (&[0, 10, 10, 20][..], samples().positions.data()));
    }
}
