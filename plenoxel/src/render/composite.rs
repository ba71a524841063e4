//! **Reference implementation** of volume rendering: emission and absorption along a ray (Max 1995), as a graph of small ops. Other
//! implementations must agree with this file.
//!
//! With optical depth τᵢ = σᵢ δᵢ of a sample, transmittance before it Tᵢ = exp(−Σ_{j<i} τⱼ), weight wᵢ = Tᵢ (1 − e^{−τᵢ}), transmittance to
//! the background T_N = exp(−Σ τⱼ) and background b:  C = Σ wᵢ cᵢ + T_N b,  depth = Σ wᵢ tᵢ,  opacity = 1 − T_N = Σ wᵢ.

use super::Radiance;
use crate::sampling::Samples;
use autograd::{Real, Tensor, no_grad};
use std::fmt::Debug;
use std::sync::Arc;

/// Rendered pixels of n rays, with further columns for losses.
#[derive(Debug, Clone)]
pub struct Rendered<T: Real> {
    /// Color over the background, `[n, 3]`.
    pub rgb: Tensor<T>,
    /// Opacity 1 − T_N, `[n]`, in [0, 1].
    pub opacity: Tensor<T>,
    /// Logarithm of the transmittance ln T_N, `[n]`, <= 0.
    pub log_transmittance: Tensor<T>,
    /// Number of samples on all rays.
    pub sample_count: usize,
    /// Color of an earlier pass over the same rays, `[n, 3]`, from which the field of that pass learns; `None` for models with one pass.
    pub coarse: Option<Tensor<T>>,
    columns: Arc<dyn Columns<T>>,
}

/// Columns of rendered pixels that are computed only when a loss or an image needs them.
///
/// A kernel that renders a field implements this trait. [`composite()`] computes the columns from the samples.
pub trait Columns<T: Real>: Debug + Send + Sync {
    /// Returns the depth Σ wᵢ tᵢ, `[n]`, with tᵢ of [`Samples`].
    fn depth(&self) -> Tensor<T>;

    /// Returns the sparsity Σ ln(1 + 2σᵢ²), `[n]`.
    fn sparsity(&self) -> Tensor<T>;

    /// Returns the distortion Σᵢⱼ wᵢ wⱼ |tᵢ − tⱼ| + ⅓ Σ wᵢ² δᵢ, `[n]`, world length.
    fn distortion(&self) -> Tensor<T>;

    /// Returns density, color and weight of every sample, if they are kept.
    fn samples(&self) -> Option<&PerSample<T>> {
        None
    }
}

/// Columns detached from the graph.
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

/// Columns of joined batches.
#[derive(Debug)]
struct Joined<T: Real>(Vec<Rendered<T>>);

impl<T: Real> Joined<T> {
    fn column(&self, of: fn(&Rendered<T>) -> Tensor<T>) -> Tensor<T> {
        let columns: Vec<Tensor<T>> = self.0.iter().map(of).collect();
        Tensor::concat(&columns.iter().collect::<Vec<_>>(), 0)
    }
}

impl<T: Real> Columns<T> for Joined<T> {
    fn depth(&self) -> Tensor<T> {
        self.column(Rendered::depth)
    }

    fn sparsity(&self) -> Tensor<T> {
        self.column(Rendered::sparsity)
    }

    fn distortion(&self) -> Tensor<T> {
        self.column(Rendered::distortion)
    }
}

/// Values of m samples.
#[derive(Debug, Clone)]
pub struct PerSample<T: Real> {
    /// Rendering weights wᵢ = Tᵢ (1 − e^{−σᵢδᵢ}), `[m]`, in [0, 1].
    pub weights: Tensor<T>,
    /// Density and color.
    pub radiance: Radiance<T>,
    /// Positions, intervals and rays of the samples.
    pub samples: Samples<T>,
}

/// Returns the rendering weights wᵢ of samples with densities `sigma` `[m]`, without recording a gradient: `[m]`.
pub fn weights<T: Real>(samples: &Samples<T>, sigma: &Tensor<T>) -> Tensor<T> {
    no_grad(|| {
        let tau = &sigma.detach() * &samples.delta;
        (-tau.segment_exclusive_sum(&samples.offsets)).exp() * tau.one_minus_exp_neg()
    })
}

/// Composites samples to pixels. `background` is `[3]`, or `[n, 3]` for one color per ray.
///
/// Panics if the numbers of radiance values and samples differ.
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
    /// Creates pixels from `rgb` `[n, 3]`, `opacity` `[n]`, `log_transmittance` `[n]`, and an implementation of the other columns.
    pub fn new(
        rgb: Tensor<T>,
        opacity: Tensor<T>,
        log_transmittance: Tensor<T>,
        sample_count: usize,
        columns: impl Columns<T> + 'static,
    ) -> Self {
        Rendered { rgb, opacity, log_transmittance, sample_count, coarse: None, columns: Arc::new(columns) }
    }

    /// Returns density, color and weight of every sample, if the graph engine rendered the pixels. Fused kernels do not keep them.
    pub fn samples(&self) -> Option<&PerSample<T>> {
        self.columns.samples()
    }

    /// Returns the depth Σ wᵢ tᵢ, `[n]`, world length. It is not divided by the opacity, so that it is smooth; images divide it.
    pub fn depth(&self) -> Tensor<T> {
        self.columns.depth()
    }

    /// Returns the Cauchy sparsity Σ ln(1 + 2σᵢ²), `[n]` (PlenOctrees, svox2).
    ///
    /// The samples of a picture ([`Model::viewer`](crate::train::Model::viewer)) that was rendered from tables are not kept: this panics for voxel grids, and is 0 for
    /// factored fields.
    pub fn sparsity(&self) -> Tensor<T> {
        self.columns.sparsity()
    }

    /// Returns the distortion of mip-NeRF 360 (eq. 15), Σᵢⱼ wᵢ wⱼ |tᵢ − tⱼ| + ⅓ Σ wᵢ² δᵢ, `[n]`, world length.
    pub fn distortion(&self) -> Tensor<T> {
        self.columns.distortion()
    }

    /// Returns the pixels detached from the graph, so that no gradient flows through them; for losses that compare with a fixed rendering.
    /// The values of single samples are dropped.
    pub fn detach(&self) -> Self {
        Rendered {
            rgb: self.rgb.detach(),
            opacity: self.opacity.detach(),
            log_transmittance: self.log_transmittance.detach(),
            sample_count: self.sample_count,
            coarse: self.coarse.as_ref().map(Tensor::detach),
            columns: Arc::new(Detached(self.columns.clone())),
        }
    }

    /// Joins the pixels of batches of rays. The values of single samples and the colors of earlier passes are dropped.
    ///
    /// Panics if there is no batch.
    #[track_caller]
    pub fn joined(parts: Vec<Self>) -> Self {
        let joined = |column: fn(&Self) -> &Tensor<T>| Tensor::concat(&parts.iter().map(column).collect::<Vec<_>>(), 0);
        let (rgb, opacity, log_transmittance) = (joined(|x| &x.rgb), joined(|x| &x.opacity), joined(|x| &x.log_transmittance));
        let sample_count = parts.iter().map(|part| part.sample_count).sum();
        Rendered::new(rgb, opacity, log_transmittance, sample_count, Joined(parts))
    }

    /// Returns the pixels with the color of an earlier pass over the same rays, `[n, 3]`.
    ///
    /// Panics if the shape differs.
    #[track_caller]
    pub fn with_coarse(self, rgb: Tensor<T>) -> Self {
        assert_eq!(rgb.shape(), self.rgb.shape(), "with_coarse: colors must have the shape of the rendered colors");
        Rendered { coarse: Some(rgb), ..self }
    }

    /// Returns the pixels with other colors `[n, 3]`.
    ///
    /// Panics if the shape differs.
    #[track_caller]
    pub fn with_rgb(&self, rgb: Tensor<T>) -> Self {
        assert_eq!(rgb.shape(), self.rgb.shape(), "with_rgb: colors must have the shape of the rendered colors");
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

    /// Computed in linear time with the prefix sums Wᵢ = Σ_{j<i} wⱼ and Mᵢ = Σ_{j<i} wⱼ tⱼ, as Σ 2 wᵢ (tᵢ Wᵢ − Mᵢ) + wᵢ² δᵢ / 3.
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
