//! Evaluation of a trained model against photographs: PSNR and SSIM of each view, and their means.
//!
//! One ray passes through the centre of each pixel. Rendered images are clamped to [0, 1] and not rounded. Photographs are composited over
//! the background in floating point. See [`crate::metrics`] for the formulas.

use crate::camera::{Camera, Intrinsics, Ray};
use crate::dataset::View;
use crate::dataset::mask::Mask;
use crate::error::Result;
use crate::metrics;
use crate::render::Rendered;
use crate::render::picture::{Picture, TILE, picture_unless, sampled_packets};
use crate::train::{Model, RenderFn, ViewOptions};
use autograd::{Real, no_grad};
use ndarray::Array3;
use rayon::prelude::*;
use serde::Serialize;
use std::borrow::Cow;
use std::time::Instant;

/// Renders the views of a model and compares them with their photographs over the background of `options`.
///
/// ```no_run
/// # use plenoxel::{dataset::View, evaluate::evaluate, train::{Model, ViewOptions}};
/// # fn example(model: &impl Model<f32>, test: &[View]) {
/// let scores = evaluate(model, test, &ViewOptions::over([1.0; 3]));
/// println!("{:?} dB over {} views", scores.psnr(), scores.per_view.len());
/// # }
/// ```
pub fn evaluate<T: Real>(model: &(impl Model<T> + ?Sized), views: &[View], options: &ViewOptions) -> Scores {
    Viewer::of(model, options).compare(views, |_, _, _, _| Ok(())).unwrap_or_default()
}

/// Time to evaluate a pixel of a test view (reading, rendering, PSNR, SSIM), relative to a training ray of the last stage. It is used if no picture was timed.
/// Measured: voxel grids 0.17 on the built-in scene, 0.20 and 0.23 on lego; factored fields 0.12 on lego and 0.38 on bonsai.
pub const PIXEL_COST: f64 = 0.2;

/// Returns the number of pixels of the images of some cameras.
pub(crate) fn pixels(cameras: &[Camera]) -> usize {
    cameras.iter().map(|camera| camera.intrinsics.width * camera.intrinsics.height).sum()
}

/// Renderer of images, for a model or for any function that renders rays.
pub struct Viewer<'a, T: Real> {
    show: RenderFn<'a, T>,
    background: [f32; 3],
    /// Side of the tiles of pixels that are rendered at a time.
    tile: usize,
}

impl<'a, T: Real> Viewer<'a, T> {
    /// Creates a viewer from a function that renders rays over a background, sRGB in [0, 1].
    pub fn new(show: impl Fn(&[Ray]) -> Rendered<T> + Sync + 'a, background: [f32; 3]) -> Self {
        Viewer { show: Box::new(show), background, tile: TILE }
    }

    /// Creates a viewer of a model.
    pub fn of(model: &'a (impl Model<T> + ?Sized), options: &ViewOptions) -> Self {
        Viewer { show: model.viewer(options), background: options.background, tile: model.tile() }
    }

    /// Renders images in tiles of pixels with this side ([`Model::tile`]).
    pub fn in_tiles(self, side: usize) -> Self {
        Viewer { tile: side, ..self }
    }

    /// Renders the image of a camera.
    pub fn see(&self, camera: &Camera) -> Picture {
        self.see_unless(camera, || false).expect("nothing stops it")
    }

    /// Renders the image of a camera, unless `stopped` becomes true meanwhile.
    pub fn see_unless(&self, camera: &Camera, stopped: impl Fn() -> bool) -> Option<Picture> {
        picture_unless(&self.show, camera, self.tile, stopped)
    }

    /// Estimates the seconds in which the images of these cameras are rendered, from some packets of their pixels. If rays take long, there are fewer packets.
    pub fn seconds_for(&self, cameras: &[Camera]) -> f64 {
        const PACKETS: usize = 256;
        const ENOUGH: f64 = 0.2;
        let pixels = pixels(cameras);
        if pixels == 0 {
            return 0.0;
        }
        let rays = sampled_packets(cameras, PACKETS);
        let start = Instant::now();
        let mut rendered = 0;
        // As many rays at a time as a tile of side `TILE` has. If the model has larger tiles, the estimate is slightly too high; with many threads, more so.
        for rays in rays.chunks(rays.len().div_ceil(4)) {
            no_grad(|| drop((self.show)(rays)));
            rendered += rays.len();
            if start.elapsed().as_secs_f64() > ENOUGH {
                break;
            }
        }
        start.elapsed().as_secs_f64() * pixels as f64 / rendered as f64
    }

    /// Renders the image of a camera in about `seconds`: if all pixels take longer, one ray is rendered for k × k pixels, k a power of 2 up to 16, and the image is
    /// enlarged. Which k depends on the speed of the machine.
    pub fn glance(&self, camera: &Camera, seconds: f64) -> Picture {
        let Intrinsics { width, height, .. } = camera.intrinsics;
        for k in [16, 8, 4, 2] {
            let [w, h] = [width, height].map(|n| (n / k).max(1));
            let start = Instant::now();
            let coarse = self.see(&Camera { intrinsics: camera.intrinsics.resized(w, h), ..*camera });
            // Few rays do not use all threads: where the whole image seems to take too long, the next finer one tells more.
            let of_ray = start.elapsed().as_secs_f64() / (w * h) as f64;
            if of_ray * (width * height) as f64 <= seconds {
                break;
            }
            if 4.0 * of_ray * (w * h) as f64 > seconds {
                return coarse.enlarged([width, height]);
            }
        }
        self.see(camera)
    }

    /// Renders each view and compares it with its photograph over the background. Pixels that a mask ignores do not count in the squared
    /// error, and are equal to the photograph in SSIM. `seen(number, view, target, picture)` is called after
    /// each view; `target` is the photograph over the background, `[h, w, 3]`.
    ///
    /// Errors if `seen` does; the comparison then stops.
    pub fn compare(&self, views: &[View], mut seen: impl FnMut(usize, &View, &Array3<f32>, &Picture) -> Result<()>) -> Result<Scores> {
        let mut per_view = Vec::with_capacity(views.len());
        for (i, view) in views.iter().enumerate() {
            let picture = self.see(&view.camera);
            let target = view.composite(self.background);
            let mse = mse(view, &picture.rgb, &target);
            let compared = kept(view, &picture.rgb, &target);
            let (ssim, ssim_same) = metrics::ssims(picture.rgb.view(), compared.view());
            per_view.push(ViewScore { name: view.name.clone(), psnr: metrics::psnr_of(mse), mse, ssim, ssim_same });
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
    /// SSIM over the windows inside the image; `None` for images smaller than 11 pixels per side.
    pub ssim: Option<f64>,
    /// SSIM with zero padding around the image, as in svox2.
    pub ssim_same: f64,
}

/// Scores of several views. Means are `None` if there are no views.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scores {
    /// Scores of each view, in the order of the views.
    pub per_view: Vec<ViewScore>,
}

impl Scores {
    /// Returns the mean PSNR in dB.
    pub fn psnr(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.psnr)))
    }

    /// Returns the PSNR in dB of the mean squared error over all views. Views with large errors have more influence than in the mean PSNR.
    pub fn psnr_of_mean_mse(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.mse))).map(metrics::psnr_of)
    }

    /// Returns the mean SSIM; `None` if a view has none.
    pub fn ssim(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| view.ssim))
    }

    /// Returns the mean SSIM with zero padding.
    pub fn ssim_same(&self) -> Option<f64> {
        mean(self.per_view.iter().map(|view| Some(view.ssim_same)))
    }
}

/// Returns the mean squared error of an image of a view, `[h, w, 3]`, over the pixels that its mask keeps. `target` is the photograph.
pub(crate) fn mse(view: &View, picture: &Array3<f32>, target: &Array3<f32>) -> f64 {
    let share = view.mask.as_ref().map_or(1.0, Mask::share);
    metrics::mse(picture.view(), kept(view, picture, target).view()) / share
}

/// Returns the photograph with the pixels of the image where the mask ignores them: no error is left there.
fn kept<'a>(view: &View, picture: &Array3<f32>, target: &'a Array3<f32>) -> Cow<'a, Array3<f32>> {
    let Some(mask) = &view.mask else { return Cow::Borrowed(target) };
    let mut kept = target.clone();
    for ((y, x, c), value) in kept.indexed_iter_mut().filter(|((y, x, _), _)| !mask.keeps(*x, *y)) {
        *value = picture[[y, x, c]].clamp(0.0, 1.0);
    }
    Cow::Owned(kept)
}

/// Returns the mean PSNR in dB of the plain background against the views, as a baseline.
pub fn background_psnr(views: &[View], background: [f32; 3]) -> Option<f64> {
    let (width, height) = views.first()?.image.dimensions();
    let shape = (height as usize, width as usize, 3);
    let plain = Array3::from_shape_fn(shape, |(_, _, c)| background[c]);
    constant_psnr(views, &plain, background)
}

/// Returns the mean image of the views over a background, `[h, w, 3]`; `None` if there are no views, or if they have
/// different sizes, as in a capture.
///
/// Needs no memory beyond the result.
pub fn mean_image(views: &[View], background: [f32; 3]) -> Option<Array3<f32>> {
    let [width, height] = views.first()?.size();
    if views.iter().any(|view| view.size() != [width, height]) {
        return None;
    }
    let mut mean = vec![0.0; 3 * width * height];
    mean.par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let mut sum = [0.0; 3];
            for view in views {
                let color = view.color(x, y, background);
                sum.iter_mut().zip(color).for_each(|(sum, value)| *sum += f64::from(value));
            }
            *pixel = sum.map(|sum: f64| (sum / views.len() as f64) as f32);
        }
    });
    Array3::from_shape_vec((height, width, 3), mean).ok()
}

/// Returns the mean PSNR in dB of one image, `[h, w, 3]`, against the views; `None` if there are no views or a view has another size.
pub fn constant_psnr(views: &[View], picture: &Array3<f32>, background: [f32; 3]) -> Option<f64> {
    mean(views.iter().map(|view| {
        let target = view.composite(background);
        (target.dim() == picture.dim()).then(|| metrics::psnr_of(mse(view, picture, &target)))
    }))
}

/// Returns the mean of the values; `None` if there are no values or one is `None`.
fn mean(values: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let n = values.len();
    let sum: Option<f64> = values.sum();
    sum.filter(|_| n > 0).map(|sum| sum / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::image::RgbaImage;
    use crate::geometry::Aabb;
    use crate::model::nerf::{Config, Nerf};
    use glam::DVec3;
    use std::time::Duration;

    #[test]
    fn ignored_pixels_do_not_count_in_the_error() {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(4, 3, 0.7));
        let gray = |level| RgbaImage::from_pixel(4, 3, [level, level, level, 255].into());
        let mut view = View { name: String::new(), camera, image: gray(51), depth: None, mask: None };
        // The image is 0.2 off everywhere, and 0.8 in the first column; photographs are 0.2.
        let picture = Array3::from_shape_fn((3, 4, 3), |(_, x, _)| if x == 0 { 1.0 } else { 0.4 });
        let target = view.composite([0.0; 3]);
        assert!((mse(&view, &picture, &target) - (0.64 + 3.0 * 0.04) / 4.0).abs() < 1e-7);
        assert_eq!(mse(&view, &picture, &target), metrics::mse(picture.view(), target.view()));
        view.mask = Some(Mask::new([4, 3], |x, _| x > 0));
        assert!((mse(&view, &picture, &target) - 0.04).abs() < 1e-7);
        assert!(constant_psnr(&[view], &picture, [0.0; 3]).is_some_and(|psnr| (psnr - metrics::psnr_of(0.04)).abs() < 1e-5));
    }

    #[test]
    fn means_need_every_value() {
        assert_eq!(mean([Some(1.0), Some(2.0)].into_iter()), Some(1.5));
        assert_eq!(mean([Some(1.0), None].into_iter()), None);
        assert_eq!(mean([None; 0].into_iter()), None);
    }

    #[test]
    fn the_seconds_of_pictures_grow_with_their_pixels() {
        let camera = |side| Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(side, side, 0.7));
        let config = Config { depth: 1, width: 4, skip: 0, color_width: 4, coarse_samples: 2, fine_samples: 2, ..Config::default() };
        let model = Nerf::<f32>::new(config, Aabb::cube(0.5), 1).unwrap();
        let show = model.viewer(&ViewOptions::over([1.0; 3]));
        let pause = Duration::from_millis(2);
        let slow = |rays: &[Ray]| {
            std::thread::sleep(pause);
            show(rays)
        };
        let viewer = Viewer::new(slow, [1.0; 3]);
        // A tile of 64 x 64 pixels pauses once.
        let estimate = viewer.seconds_for(&[camera(640), camera(1280)]);
        assert!(estimate >= 500.0 * pause.as_secs_f64(), "{estimate}");
        assert_eq!(viewer.seconds_for(&[]), 0.0);
    }

    #[test]
    fn a_glance_has_as_many_pixels_as_the_seconds_allow() {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(40, 24, 0.7));
        let config = Config { depth: 2, width: 8, skip: 0, color_width: 4, coarse_samples: 4, fine_samples: 4, ..Config::default() };
        let model = Nerf::<f32>::new(config, Aabb::cube(0.5), 1).unwrap();
        let viewer = Viewer::of(&model, &ViewOptions::over([1.0; 3]));
        assert_eq!(viewer.glance(&camera, 1e6).rgb, viewer.see(&camera).rgb);
        let coarse = viewer.glance(&camera, 0.0).rgb;
        assert_eq!(coarse.dim(), (24, 40, 3));
        // Two pixels beside each other.
        assert_eq!(coarse[[0, 0, 0]], coarse[[23, 19, 0]]);
        assert_ne!(coarse[[0, 19, 0]], coarse[[0, 20, 0]]);
    }
}
