//! Evaluation of a trained grid against photographs: PSNR and SSIM of each view, and their means.
//!
//! One ray goes through the centre of each pixel. A rendered picture is clamped to [0, 1] and not rounded; a photograph is composited over the
//! background in floats. [`crate::metrics`] has the formulas.

use crate::camera::Camera;
use crate::dataset::View;
use crate::error::Result;
use crate::field::voxel_grid::{GridShape, VoxelGrid};
use crate::geometry::Aabb;
use crate::metrics;
use crate::render::picture::{Picture, picture};
use crate::render::{Engine, RenderOptions};
use crate::sampling::{Jitter, Occupancy};
use crate::model::plenoxels::config::{Config, Sampling};
use ndarray::Array3;
use serde::Serialize;

/// Transmittance at which the ray of a picture ends: no 8-bit value changes by more than a fortieth of a step.
const STOP_BELOW: f64 = 1e-4;

/// A grid with the options to render pictures of it: no jitter, and empty cells are skipped, which changes no pixel.
pub struct Viewer<'a> {
    grid: &'a VoxelGrid<f32>,
    sampling: Sampling,
    background: [f32; 3],
    engine: Engine,
    occupancy: Occupancy,
}

impl<'a> Viewer<'a> {
    /// A viewer of a grid, with the background and the engine of its run.
    pub fn new(grid: &'a VoxelGrid<f32>, sampling: Sampling, config: &Config) -> Self {
        Viewer { grid, sampling, background: config.background, engine: config.engine, occupancy: grid.matter() }
    }

    /// A viewer of a grid over black, for grids that hold something else in place of colors, such as normals: a pixel is then a plain sum.
    pub fn over_black(grid: &'a VoxelGrid<f32>, sampling: Sampling, config: &Config) -> Self {
        Viewer { background: [0.0; 3], ..Viewer::new(grid, sampling, config) }
    }

    /// Renders the picture of a camera.
    pub fn see(&self, camera: &Camera) -> Picture {
        let shape = self.grid.shape();
        let options = RenderOptions {
            aabb: Aabb::cube(shape.half_width),
            spacing: self.sampling.spacing(shape.voxel_side()),
            jitter: Jitter::None,
            background: self.background,
            occupancy: Some(&self.occupancy),
            engine: self.engine,
            stop_below: STOP_BELOW,
        };
        picture(self.grid, camera, &options)
    }

    /// Renders each view and compares it with its photograph. `seen(number, view, target, picture)` is called after each; `target` is the
    /// photograph over the background, `[h, w, 3]`.
    ///
    /// Errors: those of `seen`, which end the comparison.
    pub fn compare(&self, views: &[View], mut seen: impl FnMut(usize, &View, &Array3<f32>, &Picture) -> Result<()>) -> Result<Scores> {
        let mut per_view = Vec::with_capacity(views.len());
        for (i, view) in views.iter().enumerate() {
            let picture = self.see(&view.camera);
            let target = view.composite(self.background);
            let (prediction, reference) = (picture.rgb.view(), target.view());
            let mse = metrics::mse(prediction, reference);
            per_view.push(ViewScore {
                name: view.name.clone(),
                psnr: metrics::psnr_of(mse),
                mse,
                ssim: metrics::ssim(prediction, reference),
                ssim_same: metrics::ssim_same(prediction, reference),
            });
            seen(i, view, &target, &picture)?;
        }
        Ok(Scores { per_view })
    }
}

/// Scores of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewScore {
    /// Name of the view.
    pub name: String,
    /// PSNR in dB.
    pub psnr: f64,
    /// Mean squared error over pixels and channels, values in [0, 1].
    pub mse: f64,
    /// SSIM over the windows inside the image; `None` for images of less than 11 pixels a side.
    pub ssim: Option<f64>,
    /// SSIM with zeros around the image, as svox2 computes it.
    pub ssim_same: f64,
}

/// Scores of several views. Their means are `None` if there are no views.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scores {
    /// Scores of each view, in the order of the views.
    pub per_view: Vec<ViewScore>,
}

impl Scores {
    /// Mean PSNR in dB.
    pub fn psnr(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.psnr)))
    }

    /// PSNR in dB of the mean squared error over the views. Views with large errors count more than in the mean PSNR.
    pub fn psnr_of_mean_mse(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.mse))).map(metrics::psnr_of)
    }

    /// Mean SSIM; `None` if a view has none.
    pub fn ssim(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| view.ssim))
    }

    /// Mean SSIM with zeros around the images.
    pub fn ssim_same(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.ssim_same)))
    }
}

/// Mean PSNR in dB of the plain background against the views: a baseline.
pub fn background_psnr(views: &[View], background: [f32; 3]) -> Option<f64> {
    let (width, height) = views.first()?.image.dimensions();
    let shape = (height as usize, width as usize, 3);
    let plain = Array3::from_shape_fn(shape, |(_, _, c)| background[c]);
    constant_psnr(views, &plain, background)
}

/// Mean image of the views over a background, `[h, w, 3]`; `None` if there are no views.
pub fn mean_image(views: &[View], background: [f32; 3]) -> Option<Array3<f32>> {
    let mut sum = views.first()?.composite(background).mapv(f64::from);
    for view in &views[1..] {
        sum.zip_mut_with(&view.composite(background), |sum, value| *sum += f64::from(*value));
    }
    Some(sum.mapv(|value| (value / views.len() as f64) as f32))
}

/// Mean PSNR in dB of one picture, `[h, w, 3]`, against the views; `None` if there are no views or one has another size.
pub fn constant_psnr(views: &[View], picture: &Array3<f32>, background: [f32; 3]) -> Option<f64> {
    mean(views.iter().map(|view| {
        let target = view.composite(background);
        (target.dim() == picture.dim()).then(|| metrics::psnr(picture.view(), target.view()))
    }))
}

/// A sampling with `samples` points on the longest line through the box, or on each ray where the sampling is the source paper's.
pub fn with_samples(sampling: Sampling, samples: u32, shape: &GridShape) -> Sampling {
    match sampling {
        Sampling::Points { far, .. } => Sampling::Points { samples: samples as usize, far },
        Sampling::Step { .. } => Sampling::Step { step: 3f64.sqrt() * shape.resolution as f64 / f64::from(samples) },
    }
}

/// Mean of the values; `None` if there are no values or one is `None`.
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
