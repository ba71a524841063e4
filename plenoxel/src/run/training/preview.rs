//! Previews during training: a small picture, and the PSNR over some pixels of a few validation views.
//!
//! Previews do not affect the training. They do not use test views.

use crate::camera::{Camera, Intrinsics};
use crate::dataset::image::RgbaImage;
use crate::dataset::mask::Mask;
use crate::dataset::{Dataset, Split, View};
use crate::error::Result;
use crate::evaluate::{Viewer, mse};
use crate::metrics::psnr_of;
use crate::run::evenly_spaced;
use ndarray::Array3;
use std::time::Instant;

/// Number of validation views, evenly spaced.
const VIEWS: usize = 4;
/// Maximum number of rays along the longer side of a validation view, so that its PSNR costs little.
const SIDE: usize = 128;
/// Maximum number of pixels along the longer side of the picture.
const PICTURE_SIDE: usize = 256;
/// Seconds of a picture. Pictures of models whose rays take long have fewer pixels, so that they do not delay the training.
pub const GLANCE: f64 = 4.0;
/// Maximum share of the training time for previews: for those at intervals and checkpoints, and for those at stage ends.
const SHARES: [f64; 2] = [0.03, 0.05];
/// Minimum training time in seconds for that share, so that the stages of short runs have previews too.
const LEAST: f64 = 20.0;

/// When a preview may be made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Moment {
    /// After a step, if the interval has passed.
    Step,
    /// At a checkpoint.
    Checkpoint,
    /// At the end of a stage.
    StageEnd,
    /// At the end of a run that has a best checkpoint, with which its last model must be compared: whatever share of the time was taken.
    Comparison,
}

/// Periodic previews.
pub struct Preview {
    views: Vec<View>,
    pace: Pace,
    /// The first of the views, larger.
    shown: Option<View>,
    /// Camera of the picture if there are no validation views; `None` if no picture is wanted.
    camera: Option<Camera>,
    /// Cameras of the views of the final evaluation.
    evaluated: Vec<Camera>,
}

/// Result of a preview.
pub struct Look {
    /// Mean PSNR of the validation views over every k-th pixel of every k-th row, if there are any.
    pub psnr: Option<f64>,
    /// A picture, if one was wanted, and the photograph of the same view, if there is one.
    pub picture: Option<(Array3<f32>, Option<Array3<f32>>)>,
    /// Estimated seconds of rendering for the final evaluation, with the model as it is now.
    pub evaluation_seconds: f64,
}

/// No previews.
impl Default for Preview {
    fn default() -> Self {
        Preview { views: Vec::new(), pace: Pace::new(f64::INFINITY), shown: None, camera: None, evaluated: Vec::new() }
    }
}

impl Preview {
    /// Previews at intervals of `every` seconds or more; infinity disables them. Reads the validation views that are needed.
    pub fn new(dataset: &Dataset, every: f64) -> Result<Self> {
        let chosen = match every.is_finite() {
            true => evenly_spaced(dataset.count(Split::Val), VIEWS),
            false => Vec::new(),
        };
        let (mut views, mut shown) = (Vec::new(), None);
        // One after the other, so that one image of full size is in memory at a time.
        for number in chosen {
            let view = dataset.load_view(Split::Val, number)?;
            views.push(thinned(&view, SIDE));
            shown = shown.or_else(|| Some(reduced(&view, PICTURE_SIDE)));
        }
        Ok(Preview { views, pace: Pace::new(every), shown, camera: None, evaluated: Vec::new() })
    }

    /// Starts the clock of the previews. They include a picture if `camera` is given; it is used if there are no validation views. `evaluated` are the cameras of the
    /// final evaluation.
    pub fn begin(self, camera: Option<Camera>, evaluated: Vec<Camera>) -> Self {
        let camera = camera.map(|camera| {
            let Intrinsics { width, height, .. } = camera.intrinsics;
            let intrinsics = camera.intrinsics.downscaled(width.max(height).div_ceil(PICTURE_SIDE).min(width).min(height));
            Camera { intrinsics, ..camera }
        });
        Preview { pace: Pace::new(self.pace.every), camera, evaluated, ..self }
    }

    /// Makes a preview if one is due at this moment, within the allowed share of the time; a comparison is always made.
    pub fn look<'a>(&mut self, viewer: impl FnOnce() -> Viewer<'a, f32>, moment: Moment, background: [f32; 3]) -> Option<Look> {
        let nothing = self.views.is_empty() && self.camera.is_none();
        if nothing || !self.pace.due(self.pace.now(), moment) {
            return None;
        }
        let start = self.pace.now();
        let viewer = viewer();
        let psnr = self.views.iter().map(|view| {
            let (picture, target) = (viewer.see(&view.camera).rgb, view.composite(background));
            psnr_of(mse(view, &picture, &target))
        });
        let sum: f64 = psnr.sum();
        let psnr = (!self.views.is_empty()).then(|| sum / self.views.len() as f64);
        let picture = self.camera.as_ref().map(|camera| match &self.shown {
            Some(view) => (viewer.glance(&view.camera, GLANCE).rgb, Some(view.composite(background))),
            None => (viewer.glance(camera, GLANCE).rgb, None),
        });
        let evaluation_seconds = viewer.seconds_for(&self.evaluated);
        self.pace.took(start, self.pace.now());
        Some(Look { psnr, picture, evaluation_seconds })
    }
}

/// Subsamples a view: every k-th pixel of every k-th row, at most `side` pixels per side, with a camera that has the rays of these pixels. Unlike
/// the pixels of a downscaled image, they are pixels of the training resolution.
fn thinned(view: &View, side: usize) -> View {
    let (width, height) = view.image.dimensions();
    let k = width.max(height).div_ceil(side as u32).min(width).min(height);
    let first = (k - 1) / 2;
    let image = RgbaImage::from_fn(width / k, height / k, |x, y| *view.image.get_pixel(k * x + first, k * y + first));
    let (all, step) = (view.camera.intrinsics, f64::from(k));
    let moved = |center: f64| 0.5 - (f64::from(first) + 0.5 - center) / step;
    let intrinsics = Intrinsics {
        width: image.width() as usize,
        height: image.height() as usize,
        fx: all.fx / step,
        fy: all.fy / step,
        cx: moved(all.cx),
        cy: moved(all.cy),
        lens: all.lens,
    };
    let size = [intrinsics.width, intrinsics.height];
    let (k, first) = (k as usize, first as usize);
    let mask = view.mask.as_ref().map(|mask| Mask::new(size, |x, y| mask.keeps(k * x + first, k * y + first)));
    View { name: view.name.clone(), camera: Camera { intrinsics, ..view.camera }, image, depth: None, mask }
}

/// Downscales a view to at most `side` pixels per side, without the last columns and rows that do not fill a pixel.
fn reduced(view: &View, side: usize) -> View {
    let (width, height) = view.image.dimensions();
    let k = width.max(height).div_ceil(side as u32).min(width).min(height);
    let whole = |side: u32| side - side % k;
    let image = RgbaImage::from_fn(whole(width), whole(height), |x, y| *view.image.get_pixel(x, y));
    let (width, height) = (image.width() as usize, image.height() as usize);
    let camera = Camera { intrinsics: Intrinsics { width, height, ..view.camera.intrinsics }, ..view.camera };
    // Only looked at, so that no mask is needed.
    View { name: view.name.clone(), camera, image, depth: None, mask: None }.reduced(k as usize)
}

/// Schedule of previews: at intervals, checkpoints and stage ends, within a small share of the time, and at comparisons.
struct Pace {
    every: f64,
    began: Instant,
    /// End of the last preview, in seconds since `began`.
    last: f64,
    /// Seconds of all previews, and of the last one.
    spent: f64,
    cost: f64,
}

impl Pace {
    fn new(every: f64) -> Self {
        Pace { every, began: Instant::now(), last: 0.0, spent: 0.0, cost: 0.0 }
    }

    /// Seconds since training began.
    fn now(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn due(&self, now: f64, moment: Moment) -> bool {
        let affordable = |share: f64| self.spent + self.cost <= share * now.max(LEAST);
        let due = match moment {
            Moment::Step => now - self.last >= self.every && affordable(SHARES[0]),
            Moment::Checkpoint => affordable(SHARES[0]),
            Moment::StageEnd => affordable(SHARES[1]),
            Moment::Comparison => true,
        };
        self.every.is_finite() && due
    }

    fn took(&mut self, start: f64, end: f64) {
        self.cost = end - start;
        self.spent += self.cost;
        self.last = end;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;

    #[test]
    fn looking_takes_a_small_share_of_the_time() {
        for (every, cost) in [(10.0, 0.1), (10.0, 3.0), (0.1, 0.2), (0.001, 0.01)] {
            let (mut pace, mut now, mut looks, mut missed) = (Pace::new(every), 0.0, 0.0, 0);
            for step in 1..20_000 {
                now += 0.05;
                let ends_stage = step % 5_000 == 0;
                if pace.due(now, if ends_stage { Moment::StageEnd } else { Moment::Step }) {
                    pace.took(now, now + cost);
                    now += cost;
                    looks += 1.0;
                } else if ends_stage {
                    missed += 1;
                }
            }
            assert!(pace.spent <= SHARES[1] * now && missed == 0, "{every} {cost}: {} of {now}, {missed} missed", pace.spent);
            let most = (SHARES[0] * now / cost).min(now / every);
            assert!(looks > 0.9 * most - 1.0, "{every} {cost}: {looks} of {most}");
        }
        let never = Pace::new(f64::INFINITY);
        assert!([Moment::Step, Moment::Checkpoint, Moment::StageEnd, Moment::Comparison].iter().all(|&moment| !never.due(1e6, moment)));
    }

    #[test]
    fn the_last_model_is_compared_with_the_best_though_the_share_is_used_up() {
        let mut pace = Pace::new(1.0);
        pace.took(0.0, 2.0);
        assert!(!pace.due(3.0, Moment::StageEnd) && pace.due(3.0, Moment::Comparison));
    }

    #[test]
    fn a_reduced_view_shows_the_same_from_the_same_place() {
        let options = ProceduralOptions { width: 53, height: 37, train: 1, val: 1, test: 0, ..ProceduralOptions::default() };
        let view = Dataset::procedural(options).unwrap().load_view(Split::Val, 0).unwrap();
        let small = reduced(&view, 12);
        assert_eq!(small.image.dimensions(), (10, 7));
        assert_eq!((small.camera.intrinsics.width, small.camera.intrinsics.height), (10, 7));
        // The ray of a reduced pixel is that of the middle one of its twenty-five.
        let (ray, middle) = (small.camera.ray(2.5, 3.5), view.camera.ray(12.5, 17.5));
        assert!(ray.direction.distance(middle.direction) < 1e-12 && ray.origin == middle.origin);
        // A thinned view has pixels and rays of the whole one.
        let thin = thinned(&view, 12);
        assert_eq!(thin.image.dimensions(), (10, 7));
        let (ray, one) = (thin.camera.ray(2.5, 3.5), view.camera.ray(12.5, 17.5));
        assert!(ray.direction.distance(one.direction) < 1e-12 && ray.origin == one.origin);
        assert_eq!(thin.image.get_pixel(2, 3), view.image.get_pixel(12, 17));
    }
}
