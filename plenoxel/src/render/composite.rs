//! **The specification**: emission and absorption along a ray (Max 1995), as a graph of small ops. When in doubt, this file is right.
//!
//! With optical depth τᵢ = σᵢ δᵢ per sample, transmittance before it Tᵢ = exp(−Σ_{j<i} τⱼ), weight wᵢ = Tᵢ (1 − e^{−τᵢ}) and
//! T_N = exp(−Σ τⱼ) left for the background b:  C = Σ wᵢ cᵢ + T_N b,  depth = Σ wᵢ tᵢ,  opacity = 1 − T_N = Σ wᵢ.

use super::Radiance;
use crate::sampling::Samples;
use autograd::{Real, Tensor};
use std::fmt::Debug;
use std::sync::Arc;

/// Pixels of n rays, with what the losses may want.
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
    columns: Arc<dyn Columns<T>>,
}

/// The columns of rendered pixels that cost something and are computed only when a loss or a picture asks for them.
///
/// A kernel that renders a field implements this; [`composite()`] computes them from the samples.
pub trait Columns<T: Real>: Debug + Send + Sync {
    /// `[n]` Σ wᵢ tᵢ, world length.
    fn depth(&self) -> Tensor<T>;

    /// `[n]` Σ ln(1 + 2σᵢ²).
    fn sparsity(&self) -> Tensor<T>;

    /// `[n]` Σᵢⱼ wᵢ wⱼ |tᵢ − tⱼ| + ⅓ Σ wᵢ² δᵢ, world length.
    fn distortion(&self) -> Tensor<T>;

    /// Density, color and weight of every sample, where they are kept.
    fn samples(&self) -> Option<&PerSample<T>> {
        None
    }
}

/// Columns without a place in the graph.
#[derive(Debug)]
struct Detached<T: Real>(Arc<dyn Columns<T>>);

impl<T: Real> Columns<T> for Detached<T> {
    fn depth(&self) -> Tensor<T> {
        self.0.depth().detach()
    }

    fn sparsity(&self) -> Tensor<T> {
        self.0.sparsity().detach()
    }

    fn distortion(&self) -> Tensor<T> {
        self.0.distortion().detach()
    }
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
    Rendered::new(rgb, opacity, log_transmittance, sample_count, PerSample { weights, radiance, samples })
}

impl<T: Real> Rendered<T> {
    /// Pixels from their tensors, `[n, 3]`, `[n]` and `[n]`, and what computes the other columns.
    pub fn new(
        rgb: Tensor<T>,
        opacity: Tensor<T>,
        log_transmittance: Tensor<T>,
        sample_count: usize,
        columns: impl Columns<T> + 'static,
    ) -> Self {
        Rendered { rgb, opacity, log_transmittance, sample_count, columns: Arc::new(columns) }
    }

    /// Density, color and weight of every sample, if the graph rendered this: a fused kernel does not keep them.
    pub fn samples(&self) -> Option<&PerSample<T>> {
        self.columns.samples()
    }

    /// `[n]` Σ wᵢ tᵢ, world length. It is not divided by opacity, so that it is smooth; pictures divide.
    pub fn depth(&self) -> Tensor<T> {
        self.columns.depth()
    }

    /// `[n]` Σ ln(1 + 2σᵢ²): Cauchy sparsity (PlenOctrees, svox2).
    pub fn sparsity(&self) -> Tensor<T> {
        self.columns.sparsity()
    }

    /// `[n]` Σᵢⱼ wᵢ wⱼ |tᵢ − tⱼ| + ⅓ Σ wᵢ² δᵢ, world length: the distortion of mip-NeRF 360 (eq. 15).
    pub fn distortion(&self) -> Tensor<T> {
        self.columns.distortion()
    }

    /// The same pixels as constants, through which no gradient flows: for a loss that compares with a rendering that is not to change.
    /// Single samples are left out.
    pub fn detach(&self) -> Self {
        Rendered {
            rgb: self.rgb.detach(),
            opacity: self.opacity.detach(),
            log_transmittance: self.log_transmittance.detach(),
            sample_count: self.sample_count,
            columns: Arc::new(Detached(self.columns.clone())),
        }
    }

    /// The same pixels with other colors `[n, 3]`.
    ///
    /// Panics if the shape is another.
    #[track_caller]
    pub fn with_rgb(&self, rgb: Tensor<T>) -> Self {
        assert_eq!(rgb.shape(), self.rgb.shape(), "with_rgb: one color for each ray");
        Rendered { rgb, ..self.clone() }
    }
}

impl<T: Real> Columns<T> for PerSample<T> {
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

    fn samples(&self) -> Option<&PerSample<T>> {
        Some(self)
    }
}
