//! One run of a sweep: the command line that makes it, and how far it is.

use super::flags::Flag;
use crate::commands::table::{Cell, Failure, Measured};
use crate::commands::train::NOT_WHEN_RESUMED;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::json;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::budget;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunFolder;
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
    /// Factor by which test images are reduced, where it is another than that of the run.
    pub evaluate_downscale: Option<usize>,
}

/// A command line, but for where the run goes.
#[derive(Debug)]
pub struct Call {
    pub command: &'static str,
    pub flags: Vec<Flag>,
    /// The folder with the views; the built-in scene has none.
    pub data: Option<PathBuf>,
}

/// What that command line amounts to.
#[derive(Debug)]
pub struct Asked {
    pub config: Config,
    pub source: DataSource,
    /// Seconds that training was asked to take: then the lengths of stages are found out when it begins.
    pub time: Option<f64>,
}

/// How far a run is.
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// There is nothing of it.
    New,
    /// It ended before anything was saved from which it could go on.
    CutShort,
    /// It can go on from where it was saved.
    Interrupted,
    /// It is not compared with test views yet.
    Unevaluated,
    Finished,
    /// The folder has a run with other settings: these.
    Different(String),
}

impl Call {
    /// The command line, with more flags.
    pub fn arguments(&self, more: &[OsString]) -> Vec<OsString> {
        let flags = self.flags.iter().map(|flag| OsString::from(&flag.text));
        // What comes after -- is no flag, whatever it looks like.
        let data = self.data.iter().flat_map(|data| ["--".into(), data.into()]);
        [self.command.into()].into_iter().chain(flags).chain(more.iter().cloned()).chain(data).collect()
    }
}

impl Job {
    /// How far it is, by what lies in its folder.
    pub fn state(&self) -> State {
        if RunFolder::at(&self.folder).is_empty() {
            return State::New;
        }
        let (folder, config, record) = match RunFolder::open(&self.folder) {
            Ok(run) => run,
            Err(e) => return State::Different(e.to_string()),
        };
        let different = self.asked.differences(&config, &record.data, record.seconds_planned);
        if !different.is_empty() {
            return State::Different(different.join("; "));
        }
        match (folder.result(), folder.evaluation()) {
            (Err(e), _) | (_, Err(e)) => State::Different(e.to_string()),
            (Ok(Some(result)), _) if self.evaluate_downscale.is_some() && result["psnr"].is_number() => {
                State::Different("it was compared with test views at the size of its training".to_owned())
            }
            (Ok(Some(result)), Ok(Some(evaluation))) if !result["psnr"].is_number() => {
                // An evaluation of an earlier version does not tell its reduction: it is the run's.
                let reduction = evaluation["image"]["downscale"].as_u64().map_or(config.downscale, |reduction| reduction as usize);
                let asked = self.evaluate_downscale.unwrap_or(self.asked.config.downscale);
                if reduction == asked { State::Finished } else { State::Unevaluated }
            }
            // A comparison with no test views is one too, and has no PSNR.
            (Ok(Some(result)), Ok(_)) if result.get("psnr").is_some() && self.evaluate_downscale.is_none() => State::Finished,
            (Ok(Some(_)), _) => State::Unevaluated,
            (Ok(None), _) if !record.is_carved() && folder.existing_state().is_ok() => State::Interrupted,
            (Ok(None), _) => State::CutShort,
        }
    }

    /// The command line that brings it to its end from a state; none if there is nothing to do but to evaluate it.
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

    /// The command line that compares it with its test views and prints the figures.
    pub fn evaluation(&self) -> Vec<OsString> {
        let reduced = self.evaluate_downscale.into_iter().flat_map(|k| [format!("--downscale={k}").into(), "--keep".into()]);
        ["evaluate".into(), self.folder.clone().into_os_string(), "--json".into()].into_iter().chain(reduced).collect()
    }

    /// What it said while it was made. Names of runs have no dots, so that no run can be in the way.
    pub fn log(&self) -> PathBuf {
        self.folder.with_extension("log")
    }

    fn failure_path(&self) -> PathBuf {
        self.folder.with_extension("failure.json")
    }

    /// Writes down that it failed.
    pub fn remember(&self, failure: &Failure) -> Result<()> {
        files::write_atomically(&self.failure_path(), (json::line(failure)? + "\n").as_bytes())
    }

    /// It may have failed once: that counts no longer.
    pub fn forget(&self) -> Result<()> {
        remove(&self.failure_path())
    }

    /// Removes what an earlier run said.
    pub fn remove_log(&self) -> Result<()> {
        remove(&self.log())
    }

    /// What came of it, so far; another run in its place is none of it.
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

/// Removes a file, if it is there.
fn remove(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path, e, "removing it")),
        _ => Ok(()),
    }
}

impl Asked {
    /// Where a run is not what was asked for.
    fn differences(&self, config: &Config, source: &DataSource, planned: Option<f64>) -> Vec<String> {
        let asked = match (self.time, planned) {
            (Some(seconds), Some(planned)) if planned != seconds => return vec![format!("time is {planned} s and not {seconds} s")],
            (Some(_), _) => budget::planned_like(self.config.clone(), config),
            (None, _) => self.config.clone(),
        };
        let data = (source != &self.source).then(|| format!("data is {source} and not {}", self.source));
        data.into_iter().chain(settings::differences(config, &asked)).collect()
    }
}
