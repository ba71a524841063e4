//! Events of a run as dicts.

use plenoxel::run::training::Event;
use plenoxel::train::{PlannedStage, Report};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// An event that Python hears of, copied from the thread that trains.
pub enum Message {
    Note(String),
    Loading { split: String, done: usize, total: usize },
    Started { folder: String, steps: u64 },
    Planned { steps: u64 },
    Step(Box<StepFigures>),
    StageEnded { stage: usize, resolution: Option<usize>, steps: u64 },
    Saved { steps: u64 },
    Evaluating { done: usize, total: usize },
}

/// Figures of a step.
pub struct StepFigures {
    step: u64,
    stage: usize,
    loss: f64,
    losses: Vec<(String, f64)>,
    psnr: f64,
    validation_psnr: Option<f64>,
    rays: usize,
    seconds: f64,
    facts: Vec<(&'static str, f64)>,
}

/// Number of steps of a plan.
fn total(plan: &[PlannedStage]) -> u64 {
    plan.iter().map(|stage| stage.steps).sum()
}

impl Message {
    /// The message of an event, if there is one.
    pub fn of(event: &Event<'_>) -> Option<Self> {
        Some(match event {
            Event::Note(text) => Message::Note(text.clone()),
            Event::Loading { split, done, total, .. } => Message::Loading { split: split.to_string(), done: *done, total: *total },
            Event::Started { run, plan, .. } => Message::Started { folder: run.folder.path().display().to_string(), steps: total(plan) },
            Event::Planned { plan } => Message::Planned { steps: total(plan) },
            Event::Step { report, observation, .. } => {
                Message::step(report, observation.validation_psnr, observation.seconds, observation.facts.clone())
            }
            Event::StageEnded { stage, .. } => {
                Message::StageEnded { stage: stage.index, resolution: stage.resolution, steps: stage.first + stage.steps }
            }
            Event::Saved { steps } => Message::Saved { steps: *steps },
            Event::Evaluating { done, total } => Message::Evaluating { done: *done, total: *total },
            _ => return None,
        })
    }

    /// The message of a step after `seconds` of training.
    pub fn step(report: &Report, validation_psnr: Option<f64>, seconds: f64, facts: Vec<(&'static str, f64)>) -> Self {
        Message::Step(Box::new(StepFigures {
            step: report.step,
            stage: report.stage,
            loss: report.loss,
            losses: report.losses.clone(),
            psnr: report.psnr,
            validation_psnr,
            rays: report.rays,
            seconds,
            facts,
        }))
    }

    /// The dict that a callback is given: `kind`, and the figures of the event.
    pub fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let event = PyDict::new(py);
        let kind = match self {
            Message::Note(text) => {
                event.set_item("text", text)?;
                "note"
            }
            Message::Loading { split, done, total } => {
                event.set_item("split", split)?;
                event.set_item("done", done)?;
                event.set_item("total", total)?;
                "loading"
            }
            Message::Started { folder, steps } => {
                event.set_item("folder", folder)?;
                event.set_item("steps", steps)?;
                "started"
            }
            Message::Planned { steps } => {
                event.set_item("steps", steps)?;
                "planned"
            }
            Message::Step(figures) => {
                let StepFigures { step, stage, loss, losses, psnr, validation_psnr, rays, seconds, facts } = &**figures;
                event.set_item("step", step)?;
                event.set_item("stage", stage)?;
                event.set_item("loss", loss)?;
                event.set_item("losses", dict(py, losses.iter().map(|(name, value)| (name.as_str(), *value)))?)?;
                event.set_item("psnr", psnr)?;
                event.set_item("validation_psnr", validation_psnr)?;
                event.set_item("rays", rays)?;
                event.set_item("seconds", seconds)?;
                event.set_item("facts", dict(py, facts.iter().copied())?)?;
                "step"
            }
            Message::StageEnded { stage, resolution, steps } => {
                event.set_item("stage", stage)?;
                event.set_item("resolution", resolution)?;
                event.set_item("steps", steps)?;
                "stage_ended"
            }
            Message::Saved { steps } => {
                event.set_item("steps", steps)?;
                "saved"
            }
            Message::Evaluating { done, total } => {
                event.set_item("done", done)?;
                event.set_item("total", total)?;
                "evaluating"
            }
        };
        event.set_item("kind", kind)?;
        Ok(event)
    }
}

fn dict<'py, 'n>(py: Python<'py>, values: impl Iterator<Item = (&'n str, f64)>) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    values.into_iter().try_for_each(|(name, value)| dict.set_item(name, value))?;
    Ok(dict)
}
