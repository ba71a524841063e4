//! `run.json`: the facts of a run that its settings do not hold.

use crate::dataset::Dataset;
use crate::error::{Error, Result};
use crate::files;
use crate::model::plenoxels;
use crate::run::data::DataSource;
use crate::run::{PROGRAM, machine};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// How the grid of a run was made.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunKind {
    /// By training.
    #[default]
    Trained,
    /// By carving, without training.
    Carved,
}

impl RunKind {
    /// The command that makes such a run.
    pub fn command(self) -> &'static str {
        match self {
            RunKind::Trained => "train",
            RunKind::Carved => "carve",
        }
    }
}

/// The facts of a run that its settings do not hold: program, machine, data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// How its grid was made. Runs of earlier versions do not say; [`RunFolder::open`](super::RunFolder::open) knows the carved ones by their settings,
    /// which have no stages.
    #[serde(default)]
    pub kind: RunKind,
    /// Kind of its model. Runs of earlier versions do not say: they are Plenoxels.
    #[serde(default = "plenoxels_kind")]
    pub model: String,
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

fn plenoxels_kind() -> String {
    plenoxels::KIND.to_owned()
}

impl RunRecord {
    /// The record of a run of Plenoxels that begins now, on this machine.
    pub fn new(kind: RunKind, dataset: &Dataset, preset: Option<&str>, source: &DataSource) -> Self {
        RunRecord {
            kind,
            model: plenoxels_kind(),
            program: PROGRAM.to_owned(),
            instruction_set: machine::instruction_set().to_owned(),
            threads: machine::threads(),
            scene: dataset.name().to_owned(),
            format: dataset.format().to_owned(),
            preset: preset.map(str::to_owned),
            data: source.clone(),
            seconds_planned: None,
        }
    }

    /// True if the grid of the run was carved.
    pub fn is_carved(&self) -> bool {
        self.kind == RunKind::Carved
    }

    /// True for a run of a model that this crate's own commands do not train.
    pub fn is_of_own_model(&self) -> bool {
        self.model != plenoxels::KIND
    }

    /// Reads the bytes of a file; `path` names it in messages.
    ///
    /// Errors: they are not JSON with the keys of a record.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        serde_json::from_str(&files::text(path, bytes)?).map_err(|e| {
            let found = format!("this does not describe a run ({e})");
            Error::input(path, found, "train again, or use an undamaged copy")
        })
    }
}
