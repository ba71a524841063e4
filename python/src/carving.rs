//! Carving runs.

use crate::background;
use crate::errors::raised;
use crate::scene::Scene;
use crate::settings::resolve;
use plenoxel::run::carving::{CarvingSettings, Event, carve as carve_run};
use plenoxel::run::settings::CARVE;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Carves the grid of a scene. Returns the folder of the run.
#[pyfunction]
pub fn carve(
    py: Python<'_>,
    scene: &Scene,
    settings: &Bound<'_, PyDict>,
    out: Option<PathBuf>,
    force: bool,
    listener: Option<Bound<'_, PyAny>>,
) -> PyResult<PathBuf> {
    let (config, preset) = resolve(None, CARVE.name, None, settings)?;
    let preset = preset.map(str::to_owned);
    let settings = CarvingSettings { config, preset, data: scene.source.clone(), out, force, report: false };
    let work = |sender: std::sync::mpsc::Sender<String>| {
        carve_run(&settings, &mut |event| {
            if let Event::Note(text) = event {
                // Nobody listens after an exception.
                drop(sender.send(text));
            }
        })
    };
    let hear = |text: String| match &listener {
        Some(listener) => {
            let event = PyDict::new(py);
            event.set_item("kind", "note")?;
            event.set_item("text", text)?;
            listener.call1((event,)).map(drop)
        }
        None => Ok(()),
    };
    let (summary, failure) = background::run(py, &Arc::new(AtomicBool::new(false)), work, hear)?;
    match failure {
        Some(error) => Err(error),
        None => Ok(PathBuf::from(summary.map_err(raised)?.run)),
    }
}
