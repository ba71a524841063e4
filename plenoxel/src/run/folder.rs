//! The run folder: the names of its files, its lock, and the rules for overwriting it.

mod listing;
mod record;

pub use record::{Baked, Imported, RunKind, RunRecord};

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
    /// File name of the model: the last or the best.
    grid: &'static str,
    /// Lock held while the folder is written.
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
/// The files of a run in the order of their removal, the least important first. The record is the last, because it marks the folder as a run.
const FILES: [&str; 11] = [README, LOSS, REPORT, METRICS, EVALUATION, RESULT, STATE, BEST, CHECKPOINT, CONFIG, RECORD];
/// All content of figure files is kept. The figures of the run and of an evaluation are in memory at the same time.
const FIGURES: json::Kept = json::Kept { keys: |_| true, entries: usize::MAX, share: 45 };
/// File extensions of `plenoxel export`.
const EXPORTED: [&str; 6] = ["vox", "ply", "obj", "glb", "stl", "npz"];

/// A run folder to be created.
#[derive(Debug)]
pub struct NewFolder {
    /// `None` for `runs/<scene>-<n>` with the first free n.
    path: Option<PathBuf>,
    scene: String,
    overwrite: bool,
}

impl NewFolder {
    /// Chooses the folder of a new run: `out`, or `runs/<scene>-<n>` with the first n that is free at [`create`](Self::create). Writes nothing.
    ///
    /// Errors: `out` is a file; it is not empty and `overwrite` is false; it is not empty and not a run folder; another process is writing to it.
    pub fn choose(out: Option<&Path>, scene: &str, overwrite: bool) -> Result<Self> {
        if let Some(path) = out {
            if let Some(file) = path.ancestors().find(|path| path.exists()).filter(|path| !path.is_dir()) {
                let found = match file == path {
                    true => format!("{} is a file", path.display()),
                    false => format!("{} cannot be a folder, because {} is a file", path.display(), file.display()),
                };
                return Err(Error::usage("--out", found, "choose a folder"));
            }
            FolderLock::share(path, LOCK, "--out")?;
            check_vacant(path, overwrite)?;
        }
        Ok(NewFolder { path: out.map(Path::to_owned), scene: scene.to_owned(), overwrite })
    }

    /// Returns the size of the files that will be overwritten, in bytes: the model and the state of the existing run.
    pub fn overwritten(&self) -> u64 {
        let size = |name: &str| self.path.as_ref().and_then(|path| path.join(name).metadata().ok()).map_or(0, |file| file.len());
        if self.overwrite { [CHECKPOINT, BEST, STATE].map(size).iter().sum() } else { 0 }
    }

    /// Creates the folder, locks it, and removes the files of a run that is overwritten. Other files are kept.
    ///
    /// Errors: those of [`choose`](Self::choose), checked again; the folder cannot be written.
    pub fn create(self) -> Result<RunFolder> {
        let Some(path) = self.path else { return RunFolder::at(&reserve(Path::new("runs"), &self.scene)?).locked("--out") };
        files::create_dir(&path)?;
        let folder = RunFolder::at(&path).locked("--out")?;
        check_vacant(&path, self.overwrite)?;
        folder.clear()?;
        Ok(folder)
    }
}

/// Checks that a folder may be written: it is empty, or it is a run folder to be overwritten.
fn check_vacant(path: &Path, overwrite: bool) -> Result<()> {
    let folder = RunFolder::at(path);
    let occupied = !folder.is_empty();
    if occupied && !overwrite && !folder.has_saved_nothing() {
        let found = format!("{} is not empty", path.display());
        return Err(Error::usage("--out", found, "choose a new folder, or overwrite the run in it with --force"));
    }
    if occupied && !path.join(RECORD).exists() {
        let found = format!("{} is not empty and not a run folder", path.display());
        return Err(Error::usage("--out", found, "choose a new folder, or a run folder to overwrite with --force"));
    }
    // Checked before any file is removed.
    match FILES.iter().find(|name| path.join(name).is_dir()) {
        Some(name) => {
            let found = format!("{} is not a run folder: its {name} is a folder", path.display());
            Err(Error::usage("--out", found, "choose a run folder or a new folder"))
        }
        None => Ok(()),
    }
}

impl RunFolder {
    /// The run folder at a path. Reads nothing; the folder need not exist.
    pub fn at(path: &Path) -> Self {
        RunFolder { path: path.to_owned(), grid: CHECKPOINT, lock: None }
    }

    /// Locks the folder exclusively: no other process trains or carves into it until this value and its clones are dropped. `key` is the flag or
    /// argument that names the folder, for messages.
    ///
    /// Errors: another process is writing to it.
    pub fn locked(self, key: &str) -> Result<Self> {
        let lock = FolderLock::acquire(&self.path, LOCK, key)?;
        Ok(RunFolder { lock: Some(Arc::new(lock)), ..self })
    }

    /// Locks the folder for adding files to a finished run, shared with other such processes: no process trains or carves into it until this value and
    /// its clones are dropped.
    ///
    /// Errors: another process is training or carving into it.
    pub fn shared(self, key: &str) -> Result<Self> {
        let lock = FolderLock::share(&self.path, LOCK, key)?;
        Ok(RunFolder { lock: lock.map(Arc::new), ..self })
    }

    /// Checks that the folder is still the locked one, so that another folder of the same name is not written.
    ///
    /// Errors: it was moved, deleted or replaced.
    pub fn check_identity(&self) -> Result<()> {
        if self.lock.as_ref().is_none_or(|lock| lock.is_of(&self.path, LOCK)) {
            return Ok(());
        }
        let found = std::io::Error::other("the folder, or its run.lock, was moved, deleted or replaced");
        Err(Error::io(&self.path, found, "the run was writing it"))
    }

    /// True if the folder does not exist, or contains only a lock and temporary files.
    pub fn is_empty(&self) -> bool {
        entries(&self.path).all(|path| path.ends_with(LOCK) || is_fragment(&path))
    }

    /// True for a run that ended before its first step and can be overwritten without loss.
    fn has_saved_nothing(&self) -> bool {
        let is_empty = |name: &str| self.path.join(name).metadata().map_or(true, |file| file.len() == 0);
        self.path.join(RECORD).exists() && [CHECKPOINT, BEST, STATE, RESULT, METRICS].into_iter().all(is_empty)
    }

    /// True for a file that belongs to the run: its settings, figures, metrics, models or pictures.
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
            std::fs::remove_file(&path).map_err(|e| Error::io(&path, e, "removing the file"))?;
        }
        let clear = |folder: &Path, endings| remove(entries(folder).filter(|path| path.is_file() && is_one_of(path, endings)));
        clear(&self.path.join(IMAGES), &["png"])?;
        for grid in [CHECKPOINT, BEST] {
            let made = RunFolder { grid, ..self.clone() };
            clear(&made.of_grid(EXPORTS), &EXPORTED)?;
            let renders = made.of_grid(RENDERS);
            clear(&renders, &RENDERED)?;
            // Each camera path has a folder with its frames.
            for film in entries(&renders).filter(|path| path.is_dir() && !path.is_symlink()) {
                remove(entries(&film).filter(|path| is_frame(path)))?;
            }
        }
        Ok(())
    }

    /// Writes `config.toml`, `run.json` and `README.md`, before the first step and when the plan changes.
    pub fn describe(&self, config: &Config, record: &RunRecord) -> Result<()> {
        let about = match record.is_of_own_model() {
            false => {
                format!("Settings of a run of {}. This command repeats the run:\n{}", record.program, record.command_line("THIS_FILE"))
            }
            true => format!(
                "Settings of a run with a model of kind `{}`, on {}. The program that created it may not use all of them.",
                record.model, record.data
            ),
        };
        settings::write(&self.path.join(CONFIG), config, &about)?;
        self.write_json(RECORD, record)?;
        files::write_atomically(&self.path.join(README), EXPLANATION.as_bytes())
    }

    /// Opens a run folder for reading.
    ///
    /// Errors: it is not a run folder.
    pub fn open(path: &Path) -> Result<(Self, Config, RunRecord)> {
        let remedy = "give a run folder written by `plenoxel train` or `plenoxel carve`";
        if !path.exists() {
            return Err(Error::input(path, "this run folder does not exist", remedy));
        }
        if !path.is_dir() {
            let found = "this is a file, not a run folder";
            return Err(Error::input(path, found, remedy));
        }
        let folder = Self::at(path);
        let record = path.join(RECORD);
        if !files::is_there(&record) {
            return Err(Error::input(path, format!("this is not a run folder: it has no {RECORD}"), remedy));
        }
        let mut record = RunRecord::parse(&record, &files::read(&record, files::RUN)?)?;
        let config = ConfigFile::read(&path.join(CONFIG))?.complete()?;
        if record.kind == RunKind::Trained && !config.trains() && !record.is_of_own_model() {
            record.kind = RunKind::Carved;
        }
        Ok((folder, config, record))
    }

    /// Selects the best grid, by validation PSNR, instead of the last.
    ///
    /// Errors: there is no separate best grid.
    pub fn with_best(self) -> Result<Self> {
        let best = RunFolder { grid: BEST, ..self };
        if !files::is_there(&best.checkpoint()) {
            let found = format!("this run folder has no {BEST}");
            let remedy = "leave out --best: the last grid was the best, there was no earlier checkpoint, or there are no validation views";
            return Err(Error::input(&best.path, found, remedy));
        }
        Ok(best)
    }

    /// Returns the step after which the best grid was written, if there is one.
    pub fn best_step(&self) -> Option<u64> {
        train::about(&self.path.join(BEST)).ok().map(|about| about.step)
    }

    /// Writes the model with the best validation PSNR so far.
    pub fn save_best(&self, model: &impl Model<f32>, about: &About) -> Result<()> {
        model.save(&self.path.join(BEST), about)
    }

    /// Removes the best grid.
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

    /// Returns the path of the existing trained model.
    ///
    /// Errors: there is none, because the run did not finish.
    pub fn existing_checkpoint(&self) -> Result<PathBuf> {
        let path = self.checkpoint();
        if !files::is_there(&path) {
            let found = format!("the run is not finished: it has no {CHECKPOINT}");
            let best = if self.path.join(BEST).exists() { ", or use the best grid so far with --best" } else { "" };
            return Err(Error::input(
                &self.path,
                found,
                format!("resume it (`plenoxel train --resume`, if `plenoxel train` started it), or train again{best}"),
            ));
        }
        Ok(path)
    }

    /// Returns the path of the state from which training resumes; `None` if training has ended and only the final figures are missing.
    ///
    /// Errors: there is none, because the run is finished or has no checkpoint yet.
    pub fn existing_state(&self) -> Result<Option<PathBuf>> {
        let path = self.state();
        let (found, remedy) = match (files::is_there(&path), files::is_there(&self.checkpoint())) {
            (true, _) => return Ok(Some(path)),
            (false, true) if self.result()?.is_none() => return Ok(None),
            (false, true) => ("this run is finished", "to train its grid further, use --init-from"),
            (false, false) => ("this run ended before its first checkpoint", "train again with its config.toml"),
        };
        Err(Error::input(&self.path, found, remedy))
    }

    /// Removes the state from which training resumes.
    pub fn remove_state(&self) -> Result<()> {
        remove([self.state()].into_iter().filter(|path| path.exists()))
    }

    /// Removes temporary files of killed processes.
    pub fn remove_fragments(&self) -> Result<()> {
        [&self.path, &self.path.join(IMAGES)].into_iter().try_for_each(|folder| remove(entries(folder).filter(|path| is_abandoned(path))))
    }

    /// Writes the final figures.
    pub fn write_result(&self, result: &impl Serialize) -> Result<()> {
        self.check_identity()?;
        self.write_json(RESULT, result)
    }

    /// Reads the final figures, if there are any. Invalid JSON counts as none: resuming the run writes it again.
    ///
    /// Errors: the file exists but cannot be read.
    pub fn result(&self) -> Result<Option<serde_json::Value>> {
        self.read_json(RESULT)
    }

    /// Writes the scores of `plenoxel evaluate`, for a run whose final figures have none.
    pub fn write_evaluation(&self, figures: &impl Serialize) -> Result<()> {
        self.write_json(EVALUATION, figures)
    }

    /// Reads the scores of `plenoxel evaluate`, if they were written.
    ///
    /// Errors: those of [`RunFolder::result`].
    pub fn evaluation(&self) -> Result<Option<serde_json::Value>> {
        self.read_json(EVALUATION)
    }

    /// Reads the final figures, completed with those of `plenoxel evaluate` if they have no test scores: for a carved run, or one trained with
    /// `--no-evaluate`.
    ///
    /// Errors: those of [`RunFolder::result`].
    pub fn figures(&self) -> Result<Option<serde_json::Value>> {
        let Some(mut all) = self.result()? else { return Ok(None) };
        if let (Some(all), Some(serde_json::Value::Object(evaluation))) = (all.as_object_mut(), self.evaluation()?) {
            // The costs of training or carving are kept. A run with `--no-evaluate` has the keys of the scores without values.
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

    /// Path of a picture rendered by `plenoxel render`.
    pub fn render(&self, name: &str) -> PathBuf {
        self.of_grid(RENDERS).join(name)
    }

    /// File name of the picture of a test view.
    pub fn panel_name(number: usize, view: &str) -> String {
        format!("test_{number:03}_{view}.png")
    }

    /// File name of the picture at the end of stage `number`, counted from 1; 0 is the picture before the first step. `resolution` is that of the
    /// grid, if the model has one.
    pub fn stage_name(number: usize, resolution: Option<usize>) -> String {
        let resolution = resolution.map_or(String::new(), |n| format!("_{n}"));
        format!("stage_{number}{resolution}.png")
    }

    /// Creates the folder of the run's pictures.
    pub fn create_images(&self) -> Result<()> {
        files::create_dir(&self.path.join(IMAGES))
    }

    /// Path of a folder for renders or exports; those of the best grid have a separate folder.
    fn of_grid(&self, name: &str) -> PathBuf {
        if self.grid == BEST { self.path.join(format!("{name}-best")) } else { self.path.join(name) }
    }

    /// Creates the folder for the pictures of `plenoxel render` and returns its path.
    pub fn create_renders(&self) -> Result<PathBuf> {
        let path = self.of_grid(RENDERS);
        files::create_dir(&path)?;
        Ok(path)
    }

    /// Creates the folder for the frames of a camera path and returns its path. Removes earlier frames of the same name, and the GIF and MP4 files,
    /// whose names are that of the path with one of `suffixes`.
    pub fn create_film(&self, name: &str, suffixes: &[&str]) -> Result<PathBuf> {
        let renders = self.create_renders()?;
        let path = renders.join(name);
        files::create_dir(&path)?;
        remove(entries(&path).filter(|path| is_frame(path) || is_abandoned(path)))?;
        let joined = suffixes.iter().flat_map(|suffix| ["gif", "mp4"].map(|ending| renders.join(format!("{name}{suffix}.{ending}"))));
        remove(joined.filter(|path| path.exists()))?;
        Ok(path)
    }

    /// Creates the folder for exports and returns the path of a file in it.
    pub fn create_export(&self, name: &str) -> Result<PathBuf> {
        let path = self.of_grid(EXPORTS);
        files::create_dir(&path)?;
        Ok(path.join(name))
    }

    fn write_json(&self, name: &str, value: &impl Serialize) -> Result<()> {
        let path = self.path.join(name);
        let text = serde_json::to_string_pretty(value).map_err(|e| Error::input(&path, e.to_string(), "this is a bug in the program"))?;
        files::write_atomically(&path, (text + "\n").as_bytes())
    }
}

/// `README.md` of a run folder, which describes its files.
const EXPLANATION: &str = include_str!("folder/README.md");

#[cfg(test)]
mod tests;
