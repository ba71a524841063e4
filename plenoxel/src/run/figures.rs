//! Final figures of a run against the views of a split, with the resolution, the background and the definitions they depend on.

use crate::dataset::{Dataset, Split};
use crate::evaluate::Scores;
use crate::model::plenoxels::config::Config;
use crate::train::{Model, ViewOptions};
use serde::Serialize;
use serde_json::{Map, Value};

/// Mean scores over the views of a split, the images and the model they are of, and their definitions.
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
    /// Facts about the model, among them how it is sampled.
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

/// Definitions of the figures, for readers of the file.
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
    NotComputed { computed: false, why: "it takes the weights of a trained network, which this program does not have" };

const DEFINITIONS: Definitions = Definitions {
    prediction: "one ray through each pixel's centre, clamped to [0, 1], not rounded to 8 bits",
    target: "the 8-bit image with its alpha, composited over the background in floats, not rounded again",
    color_space: "sRGB values as stored, not linearized",
    mse: "mean of the squared error over the pixels and the three channels of a view",
    psnr: "dB; -10 log10(mse) of each view, then the mean over views",
    psnr_of_mean_mse: "dB; -10 log10 of the mean of the views' mse, as instant-ngp reports it",
    ssim: "Gaussian window of 11 x 11 pixels, sigma 1.5, k1 0.01, k2 0.03, of each channel; mean over the windows inside the image (valid), channels and views",
    ssim_same: "the same with a window at each pixel and zeros around the image (same), as svox2",
};

impl Figures {
    /// The figures of a model against the views of a split, rendered like `view`.
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

    /// The figures as one sentence.
    pub fn sentence(&self) -> String {
        let Figures { psnr, ssim, split, views, of, width, height, .. } = self;
        let Some(psnr) = psnr else {
            return match of {
                0 => format!("no {split} views to evaluate on"),
                _ => format!("not compared with the {of} {split} views"),
            };
        };
        let ssim = ssim.map_or(String::new(), |ssim| format!(", SSIM {ssim:.4}"));
        let some = if views < of { format!(", evenly spaced among {of}") } else { String::new() };
        let views = if *views == 1 { format!("of 1 {split} view") } else { format!("means over {views} {split} views") };
        format!("PSNR {psnr:.2} dB{ssim}: {views} of {width} x {height}{some}")
    }
}
