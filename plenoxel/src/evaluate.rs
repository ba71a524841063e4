//! A trained model against photographs: PSNR and SSIM of each view, and their means.

use crate::dataset::View;
use crate::metrics;
use crate::render::picture::{Picture, picture_by};
use crate::train::{Model, ViewOptions};
use autograd::Real;
use ndarray::Array3;
use serde::Serialize;

/// Figures of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewScore {
    /// Name of the view.
    pub name: String,
    /// In dB.
    pub psnr: f64,
    /// Mean squared error, from which it is computed.
    pub mse: f64,
    /// Over windows inside the image; none for images below 11 pixels.
    pub ssim: Option<f64>,
    /// With zeros around the image, as svox2 computes it.
    pub ssim_same: f64,
}

impl ViewScore {
    /// Compares a picture with the photograph of a view, both `[h, w, 3]` sRGB.
    pub fn new(view: &View, prediction: &Array3<f32>, target: &Array3<f32>) -> Self {
        let (prediction, target) = (prediction.view(), target.view());
        let mse = metrics::mse(prediction, target);
        ViewScore {
            name: view.name.clone(),
            psnr: metrics::psnr_of(mse),
            mse,
            ssim: metrics::ssim(prediction, target),
            ssim_same: metrics::ssim_same(prediction, target),
        }
    }
}

/// Figures of several views. Means are over the views' figures; there are none of no views.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Scores {
    /// In the order of the views.
    pub per_view: Vec<ViewScore>,
}

impl Scores {
    /// Mean PSNR in dB.
    pub fn psnr(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.psnr)))
    }

    /// PSNR of the mean error, in dB: views with large errors count more than in the mean PSNR.
    pub fn psnr_of_mean_mse(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.mse))).map(metrics::psnr_of)
    }

    /// Mean SSIM.
    pub fn ssim(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| view.ssim))
    }

    /// Mean SSIM with zeros around the images.
    pub fn ssim_same(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.ssim_same)))
    }
}

/// Renders the views of a model and compares them with their photographs over the background of `options`.
///
/// ```no_run
/// # use plenoxel::{dataset::View, evaluate::evaluate, train::{Model, ViewOptions}};
/// # fn example(model: &impl Model<f32>, test: &[View]) {
/// let scores = evaluate(model, test, &ViewOptions::over([1.0; 3]));
/// println!("{:?} dB over {} views", scores.psnr(), scores.per_view.len());
/// # }
/// ```
pub fn evaluate<T: Real>(model: &impl Model<T>, views: &[View], options: &ViewOptions) -> Scores {
    evaluate_with(model, views, options, |_, _, _, _| {})
}

/// The same, with a function that is called after each view with its number, its photograph over the background, and the picture of the model.
pub fn evaluate_with<T: Real>(
    model: &impl Model<T>,
    views: &[View],
    options: &ViewOptions,
    mut seen: impl FnMut(usize, &View, &Array3<f32>, &Picture),
) -> Scores {
    let viewer = model.viewer(options);
    let per_view = views.iter().enumerate().map(|(i, view)| {
        let picture = picture_by(|rays| viewer(rays), &view.camera);
        let target = view.composite(options.background);
        let score = ViewScore::new(view, &picture.rgb, &target);
        seen(i, view, &target, &picture);
        score
    });
    Scores { per_view: per_view.collect() }
}

/// The mean, if there are values and all of them are there.
fn mean(values: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let n = values.len();
    let sum: Option<f64> = values.sum();
    sum.filter(|_| n > 0).map(|sum| sum / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_need_every_value() {
        assert_eq!(mean([Some(1.0), Some(2.0)].into_iter()), Some(1.5));
        assert_eq!(mean([Some(1.0), None].into_iter()), None);
        assert_eq!(mean([None; 0].into_iter()), None);
    }
}
