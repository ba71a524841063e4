//! Mean scores of a run on the views of a split, with the resolution, the background and the definitions on which they depend.

use crate::dataset::{Dataset, Split};
use crate::evaluate::Scores;
use crate::model::plenoxels::config::Config;
use crate::train::{Model, ViewOptions};
use serde::Serialize;
use serde_json::{Map, Value};

/// Mean scores over the views of a split, with facts about the images and the model, and the definition of each score.
#[derive(Debug, Serialize)]
pub struct Figures {
    psnr: Option<f64>,
    ssim: Option<f64>,
    ssim_same: Option<f64>,
    psnr_of_mean_mse: Option<f64>,
    lpips: NotComputed,
    split: String,
    /// Number of views that were compared.
    views: usize,
    /// Number of views of the split.
    #[serde(skip)]
    of: usize,
    width: usize,
    height: usize,
    background: [f32; 3],
    /// Facts about the model, including its sampling.
    #[serde(flatten)]
    model: Map<String, Value>,
    image: ImageFacts,
    dataset: Counts,
    definitions: Definitions,
}

#[derive(Debug, Serialize)]
struct NotComputed {
    computed: bool,
    why: &'static str,
}

/// The images that were compared, in pixels.
#[derive(Debug, Serialize)]
struct ImageFacts {
    width: usize,
    height: usize,
    /// Factor by which the dataset's images were reduced.
    downscale: usize,
}

/// Views of the dataset by split.
#[derive(Debug, Serialize)]
struct Counts {
    train: usize,
    val: usize,
    test: usize,
}

/// Definitions of the scores, for readers of the file.
#[derive(Debug, Serialize)]
struct Definitions {
    prediction: &'static str,
    target: &'static str,
    color_space: &'static str,
    mse: &'static str,
    psnr: &'static str,
    psnr_of_mean_mse: &'static str,
    ssim: &'static str,
    ssim_same: &'static str,
}

const LPIPS: NotComputed =
    NotComputed { computed: false, why: "it needs the weights of a trained network, which this program does not have" };

const DEFINITIONS: Definitions = Definitions {
    prediction: "one ray through each pixel's centre, clamped to [0, 1], not rounded to 8 bits",
    target: "the 8-bit image, composited over the background with its alpha in floats, not rounded again",
    color_space: "sRGB values as stored, not linearized",
    mse: "mean of the squared error over the pixels and the three channels of a view",
    psnr: "dB; -10 log10(mse) of each view, averaged over views",
    psnr_of_mean_mse: "dB; -10 log10 of the mse averaged over views, as instant-ngp reports it",
    ssim: "Gaussian window of 11 x 11 pixels, sigma 1.5, k1 0.01, k2 0.03, of each channel; mean over the windows inside the image (valid), channels and views",
    ssim_same: "ssim with a window at each pixel and zero padding (same), as in svox2",
};

impl Figures {
    /// The scores of a model on the views of a split, rendered with the options `view`.
    pub fn new(scores: &Scores, split: Split, dataset: &Dataset, config: &Config, model: &dyn Model<f32>, view: &ViewOptions) -> Self {
        let (width, height) = dataset.size();
        let [train, val, test] = Split::ALL.map(|split| dataset.count(split));
        Figures {
            psnr: scores.psnr(),
            ssim: scores.ssim(),
            ssim_same: scores.ssim_same(),
            psnr_of_mean_mse: scores.psnr_of_mean_mse(),
            lpips: LPIPS,
            split: split.to_string(),
            views: scores.per_view.len(),
            of: dataset.count(split),
            width,
            height,
            background: view.background,
            model: model.figures(view),
            image: ImageFacts { width, height, downscale: config.downscale },
            dataset: Counts { train, val, test },
            definitions: DEFINITIONS,
        }
    }

    /// The mean PSNR in dB; `None` if no view was compared.
    pub fn psnr(&self) -> Option<f64> {
        self.psnr
    }

    /// The scores in one sentence.
    pub fn sentence(&self) -> String {
        let Figures { psnr, ssim, split, views, of, width, height, .. } = self;
        let Some(psnr) = psnr else {
            return match of {
                0 => format!("not evaluated: there are no {split} views"),
                _ => format!("not evaluated on the {of} {split} views"),
            };
        };
        let ssim = ssim.map_or(String::new(), |ssim| format!(", SSIM {ssim:.4}"));
        let some = if views < of { format!(", evenly spaced among all {of}") } else { String::new() };
        let views = if *views == 1 { format!("on 1 {split} view") } else { format!("means over {views} {split} views") };
        format!("PSNR {psnr:.2} dB{ssim}: {views} of {width} x {height}{some}")
    }
}
