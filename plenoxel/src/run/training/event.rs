//! Events of a run, in the order in which they occur.

use super::Summary;
use crate::camera::Camera;
use crate::dataset::{Dataset, Split, View};
use crate::model::plenoxels::config::Config;
use crate::render::picture::Picture;
use crate::run::data::DataSource;
use crate::run::folder::{RunFolder, RunRecord};
use crate::run::metrics::{History, MetricsFile, Observation};
use crate::train::{Model, PlannedStage, Report};
use ndarray::Array3;

/// An event of a run. Listeners do not affect the training.
pub enum Event<'a> {
    /// A message about the next step of the run, or about a problem that does not end it.
    Note(String),
    /// The dataset was opened.
    Opened {
        /// The dataset; its images are not read yet.
        dataset: &'a Dataset,
        /// The settings.
        config: &'a Config,
    },
    /// Images are being read, or rendered for the built-in scene.
    Loading {
        /// Their split.
        split: Split,
        /// Their source.
        source: &'a DataSource,
        /// Number of images read so far.
        done: usize,
        /// Number of images to read.
        total: usize,
    },
    /// The visual hull is being computed. Sent only if that takes longer than a second.
    Carving {
        /// Number of views used so far.
        done: usize,
        /// Number of views to use.
        total: usize,
    },
    /// Training starts or resumes.
    Started {
        /// The run.
        run: Underway<'a>,
        /// The stages with their steps.
        plan: &'a [PlannedStage],
        /// Number of test views for the final evaluation.
        test_views: usize,
        /// The history of a resumed run.
        history: &'a History,
    },
    /// The plan has changed: the stages to come were adjusted to the measured speed ([`Pace`](crate::run::pace::Pace)).
    Planned {
        /// The stages with their steps.
        plan: &'a [PlannedStage],
    },
    /// The model before its first step, before the first stage prunes it; or after the steps that measured the speed of the machine, if they are steps of the run
    /// ([`Begun`](crate::run::pace::Begun)). A resumed run does not emit this event again.
    Initial {
        /// The first stage.
        stage: PlannedStage,
        /// Renders the model from a camera, with fewer pixels if its rays take long ([`Viewer::glance`](crate::evaluate::Viewer::glance)).
        see: &'a dyn Fn(&Camera) -> Picture,
    },
    /// A step was taken.
    Step {
        /// Figures of the step.
        report: &'a Report,
        /// Facts about the model, the validation PSNR if it was measured, and the time.
        observation: &'a Observation,
        /// The model after the step, or after the last of the steps that were taken before training started.
        model: &'a dyn Model<f32>,
    },
    /// A preview of the model was rendered.
    Preview {
        /// Step after which it was rendered.
        step: u64,
        /// True if that was the last step of its stage.
        ends_stage: bool,
        /// The rendered picture.
        picture: &'a Array3<f32>,
        /// The photograph of the same view, if there is one.
        target: Option<&'a Array3<f32>>,
        /// The metrics, to which a listener may add the picture after writing it.
        metrics: &'a mut MetricsFile,
    },
    /// A stage ended.
    StageEnded {
        /// The stage.
        stage: PlannedStage,
        /// Loss of each step so far.
        losses: &'a [f64],
        /// Renders the current model from a camera, as in [`Event::Initial`].
        see: &'a dyn Fn(&Camera) -> Picture,
    },
    /// A checkpoint from which the run can resume was saved.
    Saved {
        /// Steps taken.
        steps: u64,
    },
    /// Training failed. The run returns the error.
    Failed {
        /// Loss of each step so far.
        losses: &'a [f64],
    },
    /// The last step was taken and the final checkpoint was written, or the run was stopped and saved.
    Trained,
    /// Test views are being evaluated.
    Evaluating {
        /// Number of comparisons so far.
        done: usize,
        /// Number of comparisons to make.
        total: usize,
    },
    /// The final model was evaluated on a test view.
    Compared {
        /// Index of the view among the evaluated views.
        number: usize,
        /// The view.
        view: &'a View,
        /// Its photograph over the background.
        target: &'a Array3<f32>,
        /// The rendered picture.
        picture: &'a Picture,
        /// Half the longest side of the model's box.
        half_width: f64,
    },
    /// The final figures were written.
    Evaluated {
        /// The final figures.
        summary: &'a Summary,
        /// The run.
        run: Finished<'a>,
    },
}

/// A run during training.
#[derive(Clone, Copy)]
pub struct Underway<'a> {
    /// Its folder.
    pub folder: &'a RunFolder,
    /// Its settings.
    pub config: &'a Config,
    /// Its views.
    pub dataset: &'a Dataset,
}

/// A finished run.
#[derive(Clone, Copy)]
pub struct Finished<'a> {
    /// Its folder.
    pub folder: &'a RunFolder,
    /// Its settings.
    pub config: &'a Config,
    /// Facts about it.
    pub record: &'a RunRecord,
    /// Its views.
    pub dataset: &'a Dataset,
    /// The trained model.
    pub model: &'a dyn Model<f32>,
    /// The test views.
    pub test: &'a [View],
}

impl Event<'_> {
    pub(super) fn note(text: impl Into<String>) -> Self {
        Event::Note(text.into())
    }

    pub(super) fn warning(text: &str) -> Self {
        Event::Note(format!("warning: {text}"))
    }
}
