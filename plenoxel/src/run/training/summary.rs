//! Final figures of a training run.

use super::StageSummary;
use crate::evaluate::ViewScore;
use crate::loss::ViewWeight;
use crate::run::figures::Figures;
use crate::run::metrics::Best;
use crate::train::poses::PoseFigures;
use serde::Serialize;

/// Final figures of a run: `result.json` of its folder.
#[derive(Debug, Serialize)]
pub struct Summary {
    /// Mean scores over the test views, with their definitions.
    #[serde(flatten)]
    pub figures: Figures,
    /// Mean test PSNR of the plain background.
    pub baseline_background_psnr: Option<f64>,
    /// Mean test PSNR of the mean training image.
    pub baseline_mean_image_psnr: Option<f64>,
    /// Seconds of training.
    pub seconds: f64,
    /// Planned seconds of training, or of the whole run (`--time`).
    pub seconds_planned: Option<f64>,
    /// True if those are the seconds of the whole run with its evaluation.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub with_evaluation: bool,
    /// Seconds of reading images.
    pub seconds_load: f64,
    /// Seconds of rendering and comparing test views.
    pub seconds_evaluate: f64,
    /// Peak memory of the process, in bytes.
    pub peak_memory_bytes: Option<u64>,
    /// Steps taken.
    pub steps: u64,
    /// Training rays.
    pub rays: u64,
    /// Samples on these rays.
    pub samples: u64,
    /// Name of the scene.
    pub scene: String,
    /// Preset under the settings.
    pub preset: Option<String>,
    /// Folder of the run.
    pub run: String,
    /// Mean PSNR over some pixels of validation views, when it was measured last.
    pub validation_psnr: Option<f64>,
    /// The best validation PSNR and its step.
    pub best_validation: Option<Best>,
    /// Corrections of the training views' poses, if they were refined. Test and validation views keep their given poses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poses: Option<PoseFigures>,
    /// Training views that counted less at the end, with the loss `outlier_views`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub outlier_views: Option<Vec<ViewWeight>>,
    /// Each stage.
    pub stages: Vec<StageSummary>,
    /// Reasons to doubt the result.
    pub warnings: Vec<String>,
    /// Scores of each test view.
    pub per_view: Vec<ViewScore>,
}
