//! **The specification**: emission and absorption along a ray (Max 1995), as a graph of small ops. When in doubt, this file is right.
//!
//! With optical depth τᵢ = σᵢ δᵢ per sample, transmittance before it Tᵢ = exp(−Σ_{j<i} τⱼ), weight wᵢ = Tᵢ (1 − e^{−τᵢ}) and
//! T_N = exp(−Σ τⱼ) left for the background b:  C = Σ wᵢ cᵢ + T_N b,  depth = Σ wᵢ tᵢ,  opacity = 1 − T_N = Σ wᵢ.

use crate::field::Radiance;
use crate::render::fused;
use crate::sampling::Samples;
use autograd::{Real, Tensor};

/// Pixels of n rays, with what the losses may want. Columns that cost something are computed when asked for.
#[derive(Debug, Clone)]
pub struct Rendered<T: Real> {
    /// `[n, 3]` color over the background.
    pub rgb: Tensor<T>,
    /// `[n]` in [0, 1]: 1 − T_N.
    pub opacity: Tensor<T>,
    /// `[n]` ln T_N <= 0.
    pub log_transmittance: Tensor<T>,
    /// Samples behind all the pixels.
    pub sample_count: usize,
    pub(crate) rest: Rest<T>,
}

/// What the columns that are not asked for are computed from.
#[derive(Debug, Clone)]
pub(crate) enum Rest<T: Real> {
    Graph(Box<PerSample<T>>),
    Fused(fused::Columns<T>),
}

/// What is known of each of m samples.
#[derive(Debug, Clone)]
pub struct PerSample<T: Real> {
    /// `[m]` wᵢ = Tᵢ (1 − e^{−σᵢδᵢ}), in [0, 1].
    pub weights: Tensor<T>,
    /// Density and color.
    pub radiance: Radiance<T>,
    /// Positions, intervals, and which ray they belong to.
    pub samples: Samples<T>,
}

/// Pixels from samples. `background` is `[3]`, or `[n, 3]` for one color a ray.
///
/// Panics if radiance and samples differ in number.
#[track_caller]
pub fn composite<T: Real>(samples: Samples<T>, radiance: Radiance<T>, background: &Tensor<T>) -> Rendered<T> {
    let offsets = &samples.offsets;
    let tau = &radiance.sigma * &samples.delta;
    let transmittance = (-tau.segment_exclusive_sum(offsets)).exp();
    let weights = transmittance * tau.one_minus_exp_neg();
    let optical_depth = tau.segment_sum(offsets);
    let opacity = optical_depth.one_minus_exp_neg();
    let log_transmittance = -optical_depth;
    let rgb = (weights.unsqueeze(1) * &radiance.rgb).segment_sum(offsets) + log_transmittance.exp().unsqueeze(1) * background;
    let sample_count = samples.len();
    Rendered { rgb, opacity, log_transmittance, sample_count, rest: Rest::Graph(Box::new(PerSample { weights, radiance, samples })) }
}

impl<T: Real> Rendered<T> {
    /// Density, color and weight of every sample, if the graph rendered this: the fused engine does not keep them.
    pub fn samples(&self) -> Option<&PerSample<T>> {
        match &self.rest {
            Rest::Graph(samples) => Some(samples),
            Rest::Fused(_) => None,
        }
    }

    /// `[n]` Σ wᵢ tᵢ, world length. Not divided by opacity, so that it is smooth; pictures divide.
    pub fn depth(&self) -> Tensor<T> {
        match &self.rest {
            Rest::Graph(samples) => samples.depth(),
            Rest::Fused(columns) => columns.depth(),
        }
    }

    /// `[n]` Σ ln(1 + 2σᵢ²): Cauchy sparsity (PlenOctrees, svox2).
    pub fn sparsity(&self) -> Tensor<T> {
        match &self.rest {
            Rest::Graph(samples) => samples.sparsity(),
            Rest::Fused(columns) => columns.sparsity(),
        }
    }

    /// `[n]` Σᵢⱼ wᵢ wⱼ |tᵢ − tⱼ| + ⅓ Σ wᵢ² δᵢ, world length: the distortion of mip-NeRF 360 (eq. 15).
    pub fn distortion(&self) -> Tensor<T> {
        match &self.rest {
            Rest::Graph(samples) => samples.distortion(),
            Rest::Fused(columns) => columns.distortion(),
        }
    }
}

impl<T: Real> PerSample<T> {
    fn depth(&self) -> Tensor<T> {
        (&self.weights * &self.samples.t).segment_sum(&self.samples.offsets)
    }

    fn sparsity(&self) -> Tensor<T> {
        (2.0 * self.radiance.sigma.square() + 1.0).ln().segment_sum(&self.samples.offsets)
    }

    /// In linear time by prefix sums Wᵢ = Σ_{j<i} wⱼ, Mᵢ = Σ_{j<i} wⱼ tⱼ as Σ 2 wᵢ (tᵢ Wᵢ − Mᵢ) + wᵢ² δᵢ / 3.
    fn distortion(&self) -> Tensor<T> {
        let PerSample { weights: w, samples: s, .. } = self;
        let before = w.segment_exclusive_sum(&s.offsets);
        let moment = (w * &s.t).segment_exclusive_sum(&s.offsets);
        (2.0 * w * (&s.t * before - moment) + w.square() * &s.delta / 3.0).segment_sum(&s.offsets)
    }
}
