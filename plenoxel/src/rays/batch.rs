//! A batch of rays with the data of their pixels.

use crate::camera::Ray;
use autograd::{Real, Tensor};

/// Rays with the data of their pixels in the photographs.
///
/// Every list and tensor has n entries, in the order of `rays`.
#[derive(Debug, Clone)]
pub struct RayBatch<T: Real> {
    /// Rays with origins and unit directions, world frame.
    pub rays: Vec<Ray>,
    /// Photographed colors, `[n, 3]`, sRGB in [0, 1], composited over the background.
    pub target: Tensor<T>,
    /// Alpha, `[n]`, in [0, 1]: the fraction of the pixel that the object covers; 1 for images without an alpha channel.
    pub alpha: Tensor<T>,
    /// Weights, `[n]`: those of importance sampling, with expectation 1 and inversely proportional to how often a ray's pixel is drawn, times that of
    /// the ray's view ([`Objective::with_outlier_views`](crate::loss::Objective::with_outlier_views)). `None` if all are 1. [`RayBatch::mean`] applies them.
    pub weight: Option<Tensor<T>>,
    /// Number of each ray's view in the source, from 0, for example as an index into a table with one row per view.
    pub view: Vec<u32>,
    /// Column and row of each ray's pixel in the reduced image of its view, from 0 at the top left. The ray passes through the pixel's
    /// centre, at + ½.
    pub pixel: Vec<[u32; 2]>,
    /// Depth, `[n]`, world length: distance along the unit ray to the first surface ([`View::depth`](crate::dataset::View::depth));
    /// infinite if the ray hits no surface, NaN if the view has no depth image. `None` unless requested with
    /// [`RaySource::with_depth`](crate::rays::RaySource::with_depth), or if no view has a depth image.
    pub depth: Option<Tensor<T>>,
    /// Custom channels, `[n, width]`, by name, in the order of [`RaySource::with_channel`](crate::rays::RaySource::with_channel) calls.
    pub channels: Vec<(String, Tensor<T>)>,
}

impl<T: Real> RayBatch<T> {
    /// Returns the number of rays.
    pub fn len(&self) -> usize {
        self.rays.len()
    }

    /// Returns true if there are no rays.
    pub fn is_empty(&self) -> bool {
        self.rays.is_empty()
    }

    /// Returns the mean over rays and further axes of values `[n, …]`, with the rays' weights: with those of importance sampling alone, an unbiased
    /// estimate of the mean over all pixels. Without weights it is `values.mean()`.
    pub fn mean(&self, values: &Tensor<T>) -> Tensor<T> {
        let Some(weight) = &self.weight else { return values.mean() };
        let shape: Vec<usize> = (0..values.shape().len()).map(|axis| if axis == 0 { self.len() } else { 1 }).collect();
        (values * weight.reshape(&shape)).mean()
    }

    /// Returns the batch with the weight of each ray multiplied by that of its view.
    pub(crate) fn weighted(&self, of_views: &[f64]) -> Self {
        let of_rays = Tensor::from_vec(self.view.iter().map(|&v| T::lit(of_views[v as usize])).collect(), &[self.len()]);
        let weight = match &self.weight {
            None => of_rays,
            Some(weight) => weight * of_rays,
        };
        RayBatch { weight: Some(weight), ..self.clone() }
    }

    /// Returns the channel of this name, `[n, width]`; `None` if the source has no such channel.
    pub fn channel(&self, name: &str) -> Option<&Tensor<T>> {
        self.channels.iter().find(|(found, _)| found == name).map(|(_, values)| values)
    }

    /// Returns the channel of this name, `[n, width]`, for a loss that requires it.
    ///
    /// Panics at the caller's line if the source has no such channel; the message lists the existing channels.
    #[track_caller]
    pub fn expect_channel(&self, name: &str) -> &Tensor<T> {
        let names = || self.channels.iter().map(|(name, _)| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        self.channel(name).unwrap_or_else(|| panic!("the batch has no channel `{name}`; its channels: [{}]", names()))
    }
}
