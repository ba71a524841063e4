//! Events of a run, in the order in which they come.

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

/// An event of a run. Listeners change nothing of what is trained.
pub enum Event<'a> {
    /// A sentence for people about what happens next, or what went wrong without ending the run.
    Note(String),
    /// The dataset is open.
    Opened {
        /// The views, not read yet.
        dataset: &'a Dataset,
        /// The recipe.
        config: &'a Config,
    },
    /// Images are read or rendered.
    Loading {
        /// The split they belong to.
        split: Split,
        /// Where they come from.
        source: &'a DataSource,
        /// Number of images that are there.
        done: usize,
        /// Number of images that are read.
        total: usize,
    },
    /// The visual hull of the silhouettes is computed, which is told if it takes longer than a second.
    Carving {
        /// Number of views whose silhouettes were used.
        done: usize,
        /// Number of views to use.
        total: usize,
    },
    /// Training begins, or goes on.
    Started {
        /// The run.
        run: Underway<'a>,
        /// The stages with their steps.
        plan: &'a [PlannedStage],
        /// Number of the test views that the model is compared with at the end.
        test_views: usize,
        /// What a resumed run did before.
        history: &'a History,
    },
    /// The model before its first step and before the first stage prunes it; a resumed run does not tell this again.
    Initial {
        /// The first stage.
        stage: PlannedStage,
        /// Renders a camera's picture of the model.
        see: &'a dyn Fn(&Camera) -> Picture,
    },
    /// A step was taken.
    Step {
        /// Figures of the step.
        report: &'a Report,
        /// Figures of the model, of validation views if they were looked at, and of time.
        observation: &'a Observation,
    },
    /// The model was looked at while it trains.
    Preview {
        /// Step after which it was.
        step: u64,
        /// True if that was the last of its stage.
        ends_stage: bool,
        /// The picture of the model.
        picture: &'a Array3<f32>,
        /// The photograph of the same view, if there is one.
        target: Option<&'a Array3<f32>>,
        /// The metrics, to which a listener may add the picture as it was written.
        metrics: &'a mut MetricsFile,
    },
    /// A stage has ended.
    StageEnded {
        /// The stage.
        stage: PlannedStage,
        /// Loss of each step so far.
        losses: &'a [f64],
        /// Renders a camera's picture of the model as it is now.
        see: &'a dyn Fn(&Camera) -> Picture,
    },
    /// The state from which the run resumes was saved.
    Saved {
        /// Steps taken.
        steps: u64,
    },
    /// Training failed: the error follows as the result of the run.
    Failed {
        /// Loss of each step so far.
        losses: &'a [f64],
    },
    /// The last step was taken and the checkpoint is written, or the run was stopped and saved.
    Trained,
    /// Test views are compared.
    Evaluating {
        /// Number of comparisons that were made.
        done: usize,
        /// Number of comparisons to make.
        total: usize,
    },
    /// A test view was compared with the final model.
    Compared {
        /// Number of the view among those that are compared.
        number: usize,
        /// The view.
        view: &'a View,
        /// Its photograph over the background.
        target: &'a Array3<f32>,
        /// The picture of the model.
        picture: &'a Picture,
        /// Half the longest side of the model's box.
        half_width: f64,
    },
    /// The run has its figures; they are written.
    Evaluated {
        /// The figures.
        summary: &'a Summary,
        /// The run.
        run: Finished<'a>,
    },
}

/// A run that trains.
#[derive(Clone, Copy)]
pub struct Underway<'a> {
    /// Its folder.
    pub folder: &'a RunFolder,
    /// Its settings.
    pub config: &'a Config,
    /// Its views.
    pub dataset: &'a Dataset,
}

/// A run that has ended.
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
