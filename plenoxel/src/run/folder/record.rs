//! `run.json`: the facts about a run beyond its settings.

use crate::dataset::Dataset;
use crate::error::{Error, Result};
use crate::files;
use crate::geometry::Similarity;
use crate::model::{self, plenoxels};
use crate::run::data::DataSource;
use crate::run::{PROGRAM, machine};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Origin of the grid of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunKind {
    /// Training.
    #[default]
    Trained,
    /// Carving, without training.
    Carved,
    /// Baking of a trained field.
    Baked,
    /// Import of a file of another program.
    Imported,
}

impl RunKind {
    /// The name of the kind: trained, carved, baked or imported.
    pub fn name(self) -> &'static str {
        match self {
            RunKind::Trained => "trained",
            RunKind::Carved => "carved",
            RunKind::Baked => "baked",
            RunKind::Imported => "imported",
        }
    }

    /// The command that creates such a run.
    pub fn command(self) -> &'static str {
        match self {
            RunKind::Trained => "train",
            RunKind::Carved => "carve",
            RunKind::Baked => "bake",
            RunKind::Imported => "import",
        }
    }

    /// The name of what this command does.
    pub fn process(self) -> &'static str {
        match self {
            RunKind::Trained => "training",
            RunKind::Carved => "carving",
            RunKind::Baked => "baking",
            RunKind::Imported => "importing",
        }
    }
}

/// Origin of a baked grid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Baked {
    /// Run folder of the field.
    pub run: PathBuf,
    /// Number of voxels along each axis.
    pub resolution: usize,
    /// Degree of the harmonics.
    pub sh_degree: usize,
}

/// Origin of an imported grid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Imported {
    /// File of the other program.
    pub file: PathBuf,
    /// Name of its format.
    pub format: String,
    /// Length in the file of one world unit.
    pub scene_scale: f64,
}

/// Facts about a run beyond its settings: program, machine and data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Origin of the grid. Runs of earlier versions do not record it; [`RunFolder::open`](super::RunFolder::open) recognizes carved ones by their
    /// settings, which have no stages.
    #[serde(default)]
    pub kind: RunKind,
    /// Kind of the model. Runs of earlier versions do not record it: they are Plenoxels.
    #[serde(default = "plenoxels_kind")]
    pub model: String,
    /// Program and version that created the run.
    pub program: String,
    /// Vector instructions; results repeat bit by bit with the same ones.
    pub instruction_set: String,
    /// Number of threads. Results do not depend on it.
    pub threads: usize,
    /// Name of the scene.
    pub scene: String,
    /// Name of the dataset format.
    pub format: String,
    /// Preset of the settings, if there was one.
    pub preset: Option<String>,
    /// Source of the views.
    pub data: DataSource,
    /// Planned seconds of training, or of the whole run, if it was planned by time.
    #[serde(default)]
    pub seconds_planned: Option<f64>,
    /// True if these are the seconds of the whole run with its evaluation.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub with_evaluation: bool,
    /// Settings before they were planned by time, as [`settings::values`](crate::run::settings::values) returns them. Runs of earlier versions do not record them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub asked: Option<BTreeMap<String, String>>,
    /// From the coordinates of the dataset to the world of the run. Runs of earlier versions, and those without a dataset, do not record it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_world: Option<Similarity>,
    /// The field that was baked, for a baked run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baked: Option<Baked>,
    /// The file that was imported, for an imported run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imported: Option<Imported>,
}

fn plenoxels_kind() -> String {
    plenoxels::KIND.to_owned()
}

impl RunRecord {
    /// The record of a new run of Plenoxels on this machine.
    pub fn new(kind: RunKind, dataset: &Dataset, preset: Option<&str>, source: &DataSource) -> Self {
        let to_world = Some(dataset.normalization().to_world);
        RunRecord { preset: preset.map(str::to_owned), to_world, ..Self::of_scene(kind, dataset.name(), dataset.format(), source) }
    }

    /// The record of a new run of Plenoxels on this machine, for a scene with a name and a format.
    pub fn of_scene(kind: RunKind, scene: &str, format: &str, source: &DataSource) -> Self {
        RunRecord {
            kind,
            model: plenoxels_kind(),
            program: PROGRAM.to_owned(),
            instruction_set: machine::instruction_set().to_owned(),
            threads: machine::threads(),
            scene: scene.to_owned(),
            format: format.to_owned(),
            preset: None,
            data: source.clone(),
            seconds_planned: None,
            with_evaluation: false,
            asked: None,
            to_world: None,
            baked: None,
            imported: None,
        }
    }

    /// The command line that repeats the run; `config` is the name of its file of settings.
    pub fn command_line(&self, config: &str) -> String {
        let command = self.kind.command();
        if let Some(Imported { file, scene_scale, .. }) = &self.imported {
            let data = self.data.path().map_or(String::new(), |_| format!(" --data{}", self.data.arguments()));
            return format!("plenoxel {command}{} --scene-scale {scene_scale}{data}", DataSource::folder(file).arguments());
        }
        match &self.baked {
            Some(Baked { run, resolution, sh_degree }) => {
                let run = DataSource::folder(run).arguments();
                format!("plenoxel {command}{run} --resolution {resolution} --sh-degree {sh_degree}")
            }
            None => format!("plenoxel {command}{} --config {config}", self.data.arguments()),
        }
    }

    /// True if the grid of the run was carved.
    pub fn is_carved(&self) -> bool {
        self.kind == RunKind::Carved
    }

    /// True for a custom model, which the commands of this program do not train.
    pub fn is_of_own_model(&self) -> bool {
        !model::KINDS.contains(&&self.model[..])
    }

    /// Parses the bytes of a file; `path` names it in messages.
    ///
    /// Errors: the bytes are not JSON with the keys of a record.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        serde_json::from_str(&files::text(path, bytes)?).map_err(|e| {
            let found = format!("this is not a valid record of a run ({e})");
            Error::input(path, found, "use an undamaged copy, or train again")
        })
    }
}
