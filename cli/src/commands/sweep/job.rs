//! A run of a sweep: its command line and its state.

use super::flags::Flag;
use crate::commands::table::{Cell, Failure, Measured};
use crate::commands::train::NOT_WHEN_RESUMED;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::json;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::{RunFolder, RunKind, RunRecord};
use plenoxel::run::settings;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// A run of a scene with a method.
#[derive(Debug)]
pub struct Job {
    pub scene: String,
    pub method: String,
    /// Its run folder.
    pub folder: PathBuf,
    pub call: Call,
    pub asked: Asked,
    /// Downscale factor of the evaluation, if it differs from that of the run.
    pub evaluate_downscale: Option<usize>,
}

/// A command line without its output folder.
#[derive(Debug)]
pub struct Call {
    pub command: &'static str,
    pub flags: Vec<Flag>,
    /// Dataset folder; `None` for the built-in scene.
    pub data: Option<PathBuf>,
}

/// The settings of that command line.
#[derive(Debug)]
pub struct Asked {
    pub config: Config,
    pub source: DataSource,
    /// Requested seconds of training (`--time`); the lengths of the stages are then computed at the start of the run.
    pub time: Option<f64>,
    /// True if these are the seconds of the whole run (`--including-evaluation`).
    pub with_evaluation: bool,
}

/// State of a run.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// Not started.
    New,
    /// Ended before its first checkpoint.
    CutShort,
    /// Stopped with a checkpoint, so that it can be resumed.
    Interrupted,
    /// Trained or carved, but not evaluated on the test views.
    Unevaluated,
    Finished,
    /// The folder has a run with other settings; the text lists the differences.
    Different(String),
}

impl Call {
    /// The arguments of the command line, with additional ones.
    pub fn arguments(&self, more: &[OsString]) -> Vec<OsString> {
        let flags = self.flags.iter().map(|flag| OsString::from(&flag.text));
        // An argument after -- is not a flag.
        let data = self.data.iter().flat_map(|data| ["--".into(), data.into()]);
        [self.command.into()].into_iter().chain(flags).chain(more.iter().cloned()).chain(data).collect()
    }
}

impl Job {
    /// Its name: SCENE/METHOD.
    pub fn name(&self) -> String {
        format!("{}/{}", self.scene, self.method)
    }

    /// Folder of the run folder, the log and the lock.
    pub fn place(&self) -> &Path {
        self.folder.parent().unwrap_or(Path::new(""))
    }

    /// Name of the lock file of a task that makes the run. Names of runs have no dots, so it cannot conflict with a run.
    pub fn lock(&self) -> String {
        format!("{}.lock", self.method)
    }

    /// True if a process writes to the run folder.
    pub fn is_running(&self) -> bool {
        RunFolder::at(&self.folder).shared("RUN").is_err()
    }

    /// Returns the last line of the log.
    pub fn last_line(&self) -> String {
        let text = files::read(&self.log(), files::METRICS).map_or(String::new(), |bytes| String::from_utf8_lossy(&bytes).into_owned());
        text.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("started").to_owned()
    }

    /// Determines the state from the files in the folder.
    pub fn state(&self) -> State {
        if RunFolder::at(&self.folder).is_empty() {
            return State::New;
        }
        let (folder, config, record) = match RunFolder::open(&self.folder) {
            Ok(run) => run,
            Err(e) => return State::Different(e.to_string()),
        };
        let different = self.asked.differences(&config, &record);
        if !different.is_empty() {
            return State::Different(different.join("; "));
        }
        match (folder.result(), folder.evaluation()) {
            (Err(e), _) | (_, Err(e)) => State::Different(e.to_string()),
            (Ok(Some(result)), _) if self.evaluate_downscale.is_some() && result["psnr"].is_number() => {
                State::Different("it was evaluated at the image size of its training".to_owned())
            }
            (Ok(Some(result)), Ok(Some(evaluation))) if !result["psnr"].is_number() => {
                // Evaluations of earlier versions do not have the factor: it is that of the run.
                let evaluated = evaluation["image"]["downscale"].as_u64().map_or(config.downscale, |factor| factor as usize);
                let asked = self.evaluate_downscale.unwrap_or(self.asked.config.downscale);
                if evaluated == asked { State::Finished } else { State::Unevaluated }
            }
            // An evaluation without test views is complete, and has no PSNR.
            (Ok(Some(result)), Ok(_)) if result.get("psnr").is_some() && self.evaluate_downscale.is_none() => State::Finished,
            (Ok(Some(_)), _) => State::Unevaluated,
            (Ok(None), _) if record.kind == RunKind::Trained && folder.existing_state().is_ok() => State::Interrupted,
            (Ok(None), _) => State::CutShort,
        }
    }

    /// Returns the command line that finishes the run from a state; `None` if it is finished or only has to be evaluated.
    pub fn command_line(&self, state: &State) -> Option<Vec<OsString>> {
        let folder = || self.folder.clone().into_os_string();
        let out = || ["--out".into(), folder()];
        match state {
            State::New => Some(self.call.arguments(&out())),
            State::CutShort | State::Different(_) => Some(self.call.arguments(&[&out()[..], &["--force".into()]].concat())),
            State::Interrupted => {
                let again = self.call.flags.iter().filter(|flag| !NOT_WHEN_RESUMED.contains(&flag.key.as_str()));
                let again = again.map(|flag| OsString::from(&flag.text));
                Some(["train".into(), "--resume".into(), folder()].into_iter().chain(again).collect())
            }
            State::Unevaluated | State::Finished => None,
        }
    }

    /// Returns the command line that evaluates the run on its test views.
    pub fn evaluation(&self) -> Vec<OsString> {
        let downscale = self.evaluate_downscale.into_iter().flat_map(|k| [format!("--downscale={k}").into(), "--keep".into()]);
        ["evaluate".into(), self.folder.clone().into_os_string(), "--json".into()].into_iter().chain(downscale).collect()
    }

    /// Path of the log. Names of runs have no dots, so it cannot conflict with a run.
    pub fn log(&self) -> PathBuf {
        self.folder.with_extension("log")
    }

    fn failure_path(&self) -> PathBuf {
        self.folder.with_extension("failure.json")
    }

    /// Records a failure.
    pub fn remember(&self, failure: &Failure) -> Result<()> {
        files::write_atomically(&self.failure_path(), (json::line(failure)? + "\n").as_bytes())
    }

    /// Removes the record of an earlier failure.
    pub fn forget(&self) -> Result<()> {
        remove(&self.failure_path())
    }

    /// Removes the log of an earlier run.
    pub fn remove_log(&self) -> Result<()> {
        remove(&self.log())
    }

    /// Returns the current result. A run with other settings does not count.
    pub fn cell(&self) -> Cell {
        let failure = files::read(&self.failure_path(), files::RECORD).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
        match (failure, Measured::read(&self.folder)) {
            (Some(failure), _) => Cell::Failed(failure),
            _ if matches!(self.state(), State::Different(_)) => Cell::Missing,
            (None, Ok(Some(measured))) => Cell::Measured(Box::new(measured)),
            _ => Cell::Missing,
        }
    }
}

/// Removes a file if it exists.
fn remove(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path, e, "removing the file")),
        _ => Ok(()),
    }
}

impl Asked {
    /// Lists the differences between a run and the requested settings.
    fn differences(&self, config: &Config, record: &RunRecord) -> Vec<String> {
        let found = match (self.time, record.seconds_planned, &record.asked) {
            (Some(_), None, _) => return vec!["it was not planned by time".to_owned()],
            (Some(seconds), Some(planned), _) if planned != seconds => return vec![format!("time is {planned} s, not {seconds} s")],
            (Some(_), ..) if record.with_evaluation != self.with_evaluation => {
                let does = |included: bool| if included { "includes" } else { "does not include" };
                return vec![format!(
                    "its time {} evaluation, and this one {} it",
                    does(record.with_evaluation),
                    does(self.with_evaluation)
                )];
            }
            (Some(_), _, None) => {
                return vec!["it was planned by an earlier version, which did not record the settings before the plan".to_owned()];
            }
            (Some(_), _, Some(asked)) => asked.clone(),
            (None, ..) => settings::values(config),
        };
        let source = &record.data;
        let data = (source != &self.source).then(|| format!("data is {source}, not {}", self.source));
        data.into_iter().chain(settings::differences(&found, &settings::values(&self.config))).collect()
    }
}
