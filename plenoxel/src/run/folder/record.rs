//! `run.json`: the facts of a run that its settings do not hold.

use crate::error::{Error, Result};
use crate::run::data::DataSource;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The facts of a run that its settings do not hold: program, machine, data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Program and version that made the run.
    pub program: String,
    /// Vector instructions it used: results repeat to the bit on the same ones.
    pub instruction_set: String,
    /// Number of threads it ran on. Results do not depend on it.
    pub threads: usize,
    /// Name of the scene.
    pub scene: String,
    /// Format of the dataset, in words.
    pub format: String,
    /// Preset under the settings, if there was one.
    pub preset: Option<String>,
    /// Source of the views.
    pub data: DataSource,
    /// Seconds that training was planned to take, if it was planned by time.
    #[serde(default)]
    pub seconds_planned: Option<f64>,
}

impl RunRecord {
    /// Reads the bytes of a file; `path` names it in messages.
    ///
    /// Errors: they are not JSON with the keys of a record.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        serde_json::from_slice(bytes).map_err(|e| {
            let found = format!("this does not describe a run ({e})");
            Error::input(path, found, "train again, or use an undamaged copy")
        })
    }
}
