//! The folder of a run: the name of each file in it, and when one may be overwritten.

mod listing;
mod record;

pub use record::{RunKind, RunRecord};

use super::settings::{self, ConfigFile};
use super::tensorboard;
use crate::error::{Error, Result};
use crate::files::{self, FolderLock, is_abandoned};
use crate::json;
use crate::model::plenoxels::config::Config;
use crate::train::{self, About, Model};
use listing::{RENDERED, entries, is_fragment, is_frame, is_one_of, remove, reserve};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The folder of a run.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    /// File name of the model that is read and written: the last or the best.
    grid: &'static str,
    /// Held while the folder is written.
    lock: Option<Arc<FolderLock>>,
}

const LOCK: &str = "run.lock";
const CONFIG: &str = "config.toml";
const RECORD: &str = "run.json";
const METRICS: &str = "metrics.jsonl";
const CHECKPOINT: &str = "checkpoint.safetensors";
const BEST: &str = "best.safetensors";
const STATE: &str = "training.safetensors";
const LOSS: &str = "loss.svg";
const RESULT: &str = "result.json";
const EVALUATION: &str = "evaluation.json";
const README: &str = "README.md";
const REPORT: &str = "report.html";
const IMAGES: &str = "images";
const RENDERS: &str = "renders";
const EXPORTS: &str = "exports";
/// Files of a run, in the order in which they are removed: an interruption loses the least valuable ones. The record is the last, because it marks the folder of a run.
const FILES: [&str; 11] = [README, LOSS, REPORT, METRICS, EVALUATION, RESULT, STATE, BEST, CHECKPOINT, CONFIG, RECORD];
/// Content of figures that is kept: all of it. The figures of the run and of an evaluation are in memory at the same time.
const FIGURES: json::Kept = json::Kept { keys: |_| true, entries: usize::MAX, share: 45 };
/// Endings of what `export` writes.
const EXPORTED: [&str; 5] = ["vox", "ply", "obj", "glb", "stl"];

/// The place of a run folder that will be created.
#[derive(Debug)]
pub struct NewFolder {
    /// `None` for `runs/<scene>-<n>` with the first free n.
    path: Option<PathBuf>,
    scene: String,
    overwrite: bool,
}

impl NewFolder {
    /// The place for a new run: `out`, or `runs/<scene>-<n>` with the first n that is free when the folder is created. Nothing is written yet.
    ///
    /// Errors: `out` is a file; it is not empty and `overwrite` is false; it is not empty and not the folder of a run; another process is writing it.
    pub fn choose(out: Option<&Path>, scene: &str, overwrite: bool) -> Result<Self> {
        if let Some(path) = out {
            if let Some(file) = path.ancestors().find(|path| path.exists()).filter(|path| !path.is_dir()) {
                let found = format!("{} cannot be a folder, because {} is a file", path.display(), file.display());
                return Err(Error::config("--out", found, "a folder"));
            }
            FolderLock::share(path, LOCK, "--out")?;
            check_vacant(path, overwrite)?;
        }
        Ok(NewFolder { path: out.map(Path::to_owned), scene: scene.to_owned(), overwrite })
    }

    /// Bytes of the files that are overwritten: the model and the state of the run that is there.
    pub fn overwritten(&self) -> u64 {
        let size = |name: &str| self.path.as_ref().and_then(|path| path.join(name).metadata().ok()).map_or(0, |file| file.len());
        if self.overwrite { [CHECKPOINT, BEST, STATE].map(size).iter().sum() } else { 0 }
    }

    /// Creates the folder and locks it, and removes the files of a run that is overwritten. Files of other kinds stay.
    ///
    /// Errors: those of [`choose`](Self::choose), which may have become true since; the folder cannot be written.
    pub fn create(self) -> Result<RunFolder> {
        let Some(path) = self.path else { return RunFolder::at(&reserve(Path::new("runs"), &self.scene)?).locked("--out") };
        files::create_dir(&path)?;
        let folder = RunFolder::at(&path).locked("--out")?;
        check_vacant(&path, self.overwrite)?;
        folder.clear()?;
        Ok(folder)
    }
}

/// Refuses a folder that may not be written: one with files, unless it is that of a run which is overwritten.
fn check_vacant(path: &Path, overwrite: bool) -> Result<()> {
    let folder = RunFolder::at(path);
    let occupied = !folder.is_empty();
    if occupied && !overwrite && !folder.has_saved_nothing() {
        let found = format!("{} is not empty", path.display());
        return Err(Error::config("--out", found, "a new folder; or --force, which overwrites the run in it"));
    }
    if occupied && !path.join(RECORD).exists() {
        let found = format!("{} is not empty, and not the folder of a run", path.display());
        return Err(Error::config("--out", found, "a new folder, or that of a run, which --force overwrites"));
    }
    // Found out before the first file is removed.
    match FILES.iter().find(|name| path.join(name).is_dir()) {
        Some(name) => {
            let found = format!("{name} in {} is a folder", path.display());
            Err(Error::config("--out", found, "the folder of a run; or a new one"))
        }
        None => Ok(()),
    }
}

impl RunFolder {
    /// The run folder at a path; nothing is read, and nothing needs to be there.
    pub fn at(path: &Path) -> Self {
        RunFolder { path: path.to_owned(), grid: CHECKPOINT, lock: None }
    }

    /// Locks the folder: no other process trains or carves into it before this value and its clones are dropped. `key` is the flag or argument that names the
    /// folder, for messages.
    ///
    /// Errors: another process is writing it.
    pub fn locked(self, key: &str) -> Result<Self> {
        let lock = FolderLock::acquire(&self.path, LOCK, key)?;
        Ok(RunFolder { lock: Some(Arc::new(lock)), ..self })
    }

    /// Shares the folder with others that add to a finished run: no process trains or carves into it before this value and its clones are dropped.
    ///
    /// Errors: another process is training or carving into it.
    pub fn shared(self, key: &str) -> Result<Self> {
        let lock = FolderLock::share(&self.path, LOCK, key)?;
        Ok(RunFolder { lock: lock.map(Arc::new), ..self })
    }

    /// Checks that the folder is still the one that was locked: another of its name is not written.
    ///
    /// Errors: it was moved, deleted or replaced.
    pub fn check_identity(&self) -> Result<()> {
        if self.lock.as_ref().is_none_or(|lock| lock.is_of(&self.path, LOCK)) {
            return Ok(());
        }
        let found = std::io::Error::other("the folder, or its run.lock, was moved, deleted or replaced");
        Err(Error::io(&self.path, found, "the run was writing it"))
    }

    /// True if there is nothing in the folder but a lock and temporary files, or no such folder.
    pub fn is_empty(&self) -> bool {
        entries(&self.path).all(|path| path.ends_with(LOCK) || is_fragment(&path))
    }

    /// True for a run that ended before its first step, of which nothing is lost if it is overwritten.
    fn has_saved_nothing(&self) -> bool {
        let is_empty = |name: &str| self.path.join(name).metadata().map_or(true, |file| file.len() == 0);
        self.path.join(RECORD).exists() && [CHECKPOINT, BEST, STATE, RESULT, METRICS].into_iter().all(is_empty)
    }

    /// True for a file that is one of the run's own: its settings, figures, metrics, models or pictures.
    pub fn owns(&self, file: &Path) -> bool {
        let (Ok(file), Ok(folder)) = (file.canonicalize(), self.path.canonicalize()) else { return false };
        let own = FILES.iter().any(|name| file == folder.join(name));
        own || file.starts_with(folder.join(IMAGES))
    }

    /// Removes the files of a run.
    fn clear(&self) -> Result<()> {
        self.remove_fragments()?;
        let paths = FILES.map(|name| self.path.join(name)).into_iter().filter(|path| files::is_there(path));
        for path in paths.chain(tensorboard::present(&self.path)) {
            std::fs::remove_file(&path).map_err(|e| Error::io(&path, e, "removing it"))?;
        }
        let clear = |folder: &Path, endings| remove(entries(folder).filter(|path| path.is_file() && is_one_of(path, endings)));
        clear(&self.path.join(IMAGES), &["png"])?;
        for grid in [CHECKPOINT, BEST] {
            let made = RunFolder { grid, ..self.clone() };
            clear(&made.of_grid(EXPORTS), &EXPORTED)?;
            let renders = made.of_grid(RENDERS);
            clear(&renders, &RENDERED)?;
            // Films have folders of their own, for their frames.
            for film in entries(&renders).filter(|path| path.is_dir() && !path.is_symlink()) {
                remove(entries(&film).filter(|path| is_frame(path)))?;
            }
        }
        Ok(())
    }

    /// Writes `config.toml`, `run.json` and `README.md`, which are known before the first step.
    pub fn describe(&self, config: &Config, record: &RunRecord) -> Result<()> {
        let about = match record.is_of_own_model() {
            false => {
                let again = format!("plenoxel {}{} --config THIS_FILE", record.kind.command(), record.data.arguments());
                format!("Settings of a run of {}. The same run again:\n{again}", record.program)
            }
            true => format!(
                "Settings of a run of a model of kind `{}`, on {}. The program that made it may not use all of them.",
                record.model, record.data
            ),
        };
        settings::write(&self.path.join(CONFIG), config, &about)?;
        self.write_json(RECORD, record)?;
        files::write_atomically(&self.path.join(README), EXPLANATION.as_bytes())
    }

    /// Opens the folder of a run for reading.
    ///
    /// Errors: it is not the folder of a run.
    pub fn open(path: &Path) -> Result<(Self, Config, RunRecord)> {
        let remedy = "give the folder that `plenoxel train` or `plenoxel carve` wrote";
        if !path.exists() {
            return Err(Error::input(path, "there is no such run", remedy));
        }
        if !path.is_dir() {
            let found = "this is a file, not the folder of a run";
            return Err(Error::input(path, found, remedy));
        }
        let folder = Self::at(path);
        let record = path.join(RECORD);
        if !files::is_there(&record) {
            return Err(Error::input(path, format!("there is no {RECORD} in this folder"), remedy));
        }
        let mut record = RunRecord::parse(&record, &files::read(&record, files::RUN)?)?;
        let config = ConfigFile::read(&path.join(CONFIG))?.complete()?;
        if config.stages.is_empty() && !record.is_of_own_model() {
            record.kind = RunKind::Carved;
        }
        Ok((folder, config, record))
    }

    /// The same folder with the best grid, by validation PSNR, in place of the last.
    ///
    /// Errors: there is no best grid besides the last.
    pub fn with_best(self) -> Result<Self> {
        let best = RunFolder { grid: BEST, ..self };
        if !files::is_there(&best.checkpoint()) {
            let found = format!("there is no {BEST} in this folder");
            let remedy =
                "leave --best away: the last grid was the best, or nothing was saved before it, or there were no validation views to tell";
            return Err(Error::input(&best.path, found, remedy));
        }
        Ok(best)
    }

    /// The step after which the best grid so far was written, if there is one.
    pub fn best_step(&self) -> Option<u64> {
        train::about(&self.path.join(BEST)).ok().map(|about| about.step)
    }

    /// Writes the model with the best validation PSNR so far.
    pub fn save_best(&self, model: &impl Model<f32>, about: &About) -> Result<()> {
        model.save(&self.path.join(BEST), about)
    }

    /// Removes the best grid, when the last is as good.
    pub fn remove_best(&self) -> Result<()> {
        remove([self.path.join(BEST)].into_iter().filter(|path| path.exists()))
    }

    /// Writes the trained model.
    ///
    /// Errors: the folder is no longer the one that was locked; the file cannot be written.
    pub fn save(&self, model: &impl Model<f32>, about: &About) -> Result<()> {
        self.check_identity()?;
        model.save(&self.checkpoint(), about)
    }

    /// Path of the trained model, which is there.
    ///
    /// Errors: there is none, because the run did not end well.
    pub fn existing_checkpoint(&self) -> Result<PathBuf> {
        let path = self.checkpoint();
        if !files::is_there(&path) {
            let found = format!("there is no {CHECKPOINT} in this folder: the run did not end");
            let best = if self.path.join(BEST).exists() { "; or --best, for the best grid that was saved" } else { "" };
            return Err(Error::input(
                &self.path,
                found,
                format!("resume it (`plenoxel train --resume`, if that began it), or train again{best}"),
            ));
        }
        Ok(path)
    }

    /// The file from which training resumes; `None` if training has ended and only the final figures are missing.
    ///
    /// Errors: there is none, because the run has ended or has saved nothing yet.
    pub fn existing_state(&self) -> Result<Option<PathBuf>> {
        let path = self.state();
        let (found, remedy) = match (files::is_there(&path), files::is_there(&self.checkpoint())) {
            (true, _) => return Ok(Some(path)),
            (false, true) if self.result()?.is_none() => return Ok(None),
            (false, true) => ("this run has ended", "to train its grid further, use `--init-from`"),
            (false, false) => ("this run left nothing from which to go on", "train again with its config.toml"),
        };
        Err(Error::input(&self.path, found, remedy))
    }

    /// Removes the state from which training resumes.
    pub fn remove_state(&self) -> Result<()> {
        remove([self.state()].into_iter().filter(|path| path.exists()))
    }

    /// Removes temporary files of processes that were killed.
    pub fn remove_fragments(&self) -> Result<()> {
        [&self.path, &self.path.join(IMAGES)].into_iter().try_for_each(|folder| remove(entries(folder).filter(|path| is_abandoned(path))))
    }

    /// Writes the final figures.
    pub fn write_result(&self, result: &impl Serialize) -> Result<()> {
        self.check_identity()?;
        self.write_json(RESULT, result)
    }

    /// Reads the final figures, if there are any. Damaged ones count as none: resuming the run writes them again.
    ///
    /// Errors: the file is there and cannot be read.
    pub fn result(&self) -> Result<Option<serde_json::Value>> {
        self.read_json(RESULT)
    }

    /// Writes the figures of an evaluation, of a run whose final figures are without test views.
    pub fn write_evaluation(&self, figures: &impl Serialize) -> Result<()> {
        self.write_json(EVALUATION, figures)
    }

    /// Reads the figures of an evaluation, if they were written.
    ///
    /// Errors as for [`RunFolder::result`].
    pub fn evaluation(&self) -> Result<Option<serde_json::Value>> {
        self.read_json(EVALUATION)
    }

    /// The final figures, with those of an evaluation where the final ones are without test views: of a carved run, or of one trained without evaluation.
    ///
    /// Errors as for [`RunFolder::result`].
    pub fn figures(&self) -> Result<Option<serde_json::Value>> {
        let Some(mut all) = self.result()? else { return Ok(None) };
        if let (Some(all), Some(serde_json::Value::Object(evaluation))) = (all.as_object_mut(), self.evaluation()?) {
            // What training or carving took stays; a run of `--no-evaluate` has the keys of figures without values.
            const OF_THE_RUN: [&str; 2] = ["seconds_load", "peak_memory_bytes"];
            let replaced = |key: &str| !all.get("psnr").is_some_and(serde_json::Value::is_number) && !OF_THE_RUN.contains(&key);
            let (replaced, added): (Vec<_>, Vec<_>) = evaluation.into_iter().partition(|(key, _)| replaced(key));
            for (key, value) in added {
                all.entry(key).or_insert(value);
            }
            all.extend(replaced);
        }
        Ok(Some(all))
    }

    fn read_json(&self, name: &str) -> Result<Option<serde_json::Value>> {
        let path = self.path.join(name);
        if !files::is_there(&path) {
            return Ok(None);
        }
        json::parse_if_whole(&path, &files::read(&path, files::RECORD)?, &FIGURES)
    }

    /// Writes the chart of the loss, an SVG.
    pub fn write_loss(&self, svg: &str) -> Result<()> {
        self.check_identity()?;
        files::write_atomically(&self.path.join(LOSS), svg.as_bytes())
    }

    /// Writes the report, an HTML page.
    pub fn write_report(&self, page: &str) -> Result<()> {
        self.check_identity()?;
        files::write_atomically(&self.report(), page.as_bytes())
    }

    /// Reads the text of `config.toml`.
    pub fn settings(&self) -> Result<String> {
        let path = self.path.join(CONFIG);
        Ok(files::text(&path, &files::read(&path, files::SETTINGS)?)?.into_owned())
    }

    /// Path of the report.
    pub fn report(&self) -> PathBuf {
        self.path.join(REPORT)
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Path of the metrics.
    pub fn metrics(&self) -> PathBuf {
        self.path.join(METRICS)
    }

    /// Path of the trained grid, the last or the best.
    pub fn checkpoint(&self) -> PathBuf {
        self.path.join(self.grid)
    }

    /// Path of the state from which training resumes.
    pub fn state(&self) -> PathBuf {
        self.path.join(STATE)
    }

    /// Path of a picture of the run.
    pub fn image(&self, name: &str) -> PathBuf {
        self.path.join(IMAGES).join(name)
    }

    /// Paths of the pictures of the run, sorted.
    pub fn images(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.path.join(IMAGES));
        let mut images: Vec<PathBuf> = entries.into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        images.sort();
        images
    }

    /// Path of a picture that is rendered of the grid after the run.
    pub fn render(&self, name: &str) -> PathBuf {
        self.of_grid(RENDERS).join(name)
    }

    /// File name of the picture of a test view.
    pub fn panel_name(number: usize, view: &str) -> String {
        format!("test_{number:03}_{view}.png")
    }

    /// File name of the picture of a view at the end of a stage, which is counted from 1; number 0 is the view before the first step. The resolution
    /// is that of the grid, if the model has one.
    pub fn stage_name(number: usize, resolution: Option<usize>) -> String {
        let resolution = resolution.map_or(String::new(), |n| format!("_{n}"));
        format!("stage_{number}{resolution}.png")
    }

    /// Creates the folder of the run's pictures.
    pub fn create_images(&self) -> Result<()> {
        files::create_dir(&self.path.join(IMAGES))
    }

    /// Path of a folder for files made of the grid; those of the best grid have a folder of their own.
    fn of_grid(&self, name: &str) -> PathBuf {
        if self.grid == BEST { self.path.join(format!("{name}-best")) } else { self.path.join(name) }
    }

    /// Creates the folder of pictures that are rendered after the run, and returns its path.
    pub fn create_renders(&self) -> Result<PathBuf> {
        let path = self.of_grid(RENDERS);
        files::create_dir(&path)?;
        Ok(path)
    }

    /// Creates the folder of the frames of a film, and returns its path. Frames of an earlier film of this name are removed, and its GIF and MP4,
    /// whose names are the film's with one of `suffixes`.
    pub fn create_film(&self, name: &str, suffixes: &[&str]) -> Result<PathBuf> {
        let renders = self.create_renders()?;
        let path = renders.join(name);
        files::create_dir(&path)?;
        remove(entries(&path).filter(|path| is_frame(path) || is_abandoned(path)))?;
        let joined = suffixes.iter().flat_map(|suffix| ["gif", "mp4"].map(|ending| renders.join(format!("{name}{suffix}.{ending}"))));
        remove(joined.filter(|path| path.exists()))?;
        Ok(path)
    }

    /// Creates the folder of exports, and returns the path of a file in it.
    pub fn create_export(&self, name: &str) -> Result<PathBuf> {
        let path = self.of_grid(EXPORTS);
        files::create_dir(&path)?;
        Ok(path.join(name))
    }

    fn write_json(&self, name: &str, value: &impl Serialize) -> Result<()> {
        let path = self.path.join(name);
        let text =
            serde_json::to_string_pretty(value).map_err(|e| Error::input(&path, e.to_string(), "this is a defect of the program"))?;
        files::write_atomically(&path, (text + "\n").as_bytes())
    }
}

/// The folder's own explanation.
const EXPLANATION: &str = include_str!("folder/README.md");

#[cfg(test)]
mod tests;
