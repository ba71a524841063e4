//! The folder of a run: the name of each file in it, and when one may be overwritten.

mod listing;
mod record;

pub use record::{RunKind, RunRecord};

use super::settings::{self, ConfigFile};
use super::tensorboard;
use crate::checkpoint::{self, Header};
use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::files;
use crate::json;
use crate::model::plenoxels::config::Config;
use listing::{RENDERED, entries, first_free, is_fragment, is_frame, is_one_of, remove};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// The folder of a run.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    /// File name of the grid that is read and written: the last or the best.
    grid: &'static str,
}

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
/// Endings of what `export` writes.
const EXPORTED: [&str; 4] = ["vox", "ply", "obj", "glb"];

impl RunFolder {
    /// The run folder at a path; nothing is read, and nothing needs to be there.
    pub fn at(path: &Path) -> Self {
        RunFolder { path: path.to_owned(), grid: CHECKPOINT }
    }

    /// The folder of a new run: `out`, or `runs/<scene>-<n>` with the first free n. Nothing is written yet.
    ///
    /// Errors: it is a file; it is not empty and `overwrite` is false; it is not empty and not the folder of a run.
    pub fn choose(out: Option<&Path>, scene: &str, overwrite: bool) -> Result<Self> {
        let Some(path) = out else {
            return Ok(Self::at(&first_free(Path::new("runs"), scene)));
        };
        if let Some(file) = path.ancestors().find(|path| path.exists()).filter(|path| !path.is_dir()) {
            let found = format!("{}, where {} is a file,", path.display(), file.display());
            return Err(Error::config("--out", found, "a folder"));
        }
        let occupied = std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_some());
        if occupied && !overwrite {
            let found = format!("{}, which is not empty,", path.display());
            return Err(Error::config("--out", found, "a new folder; or --force, which overwrites the run in it"));
        }
        if occupied && !path.join(RECORD).exists() {
            let found = format!("{}, which holds something that is not a run,", path.display());
            return Err(Error::config("--out", found, "a new folder, or that of a run, which --force overwrites"));
        }
        Ok(Self::at(path))
    }

    /// Creates the folder, and removes the files of a run that is overwritten. Files of other kinds stay.
    pub fn prepare(&self) -> Result<()> {
        files::create_dir(&self.path)?;
        self.remove_fragments()?;
        let names = [CHECKPOINT, BEST, STATE, RESULT, EVALUATION, METRICS, LOSS, REPORT, CONFIG, RECORD, README];
        let paths = names.map(|name| self.path.join(name)).into_iter().filter(|path| files::is_there(path));
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
        let command = record.kind.command();
        let again = format!("plenoxel {command}{} --config THIS_FILE", record.data.arguments());
        settings::write(
            &self.path.join(CONFIG),
            config,
            &format!("Settings of a run of {}. The same run again:\n{again}", record.program),
        )?;
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
        let mut record = RunRecord::parse(&record, &files::read(&record, files::RECORD)?)?;
        let config = ConfigFile::read(&path.join(CONFIG))?.complete()?;
        if config.stages.is_empty() {
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
        checkpoint::header(&self.path.join(BEST)).ok().map(|(header, _)| header.step)
    }

    /// Writes the grid with the best validation PSNR so far.
    pub fn save_best(&self, grid: &VoxelGrid<f32>, header: &Header) -> Result<()> {
        checkpoint::save(&self.path.join(BEST), grid, header)
    }

    /// Removes the best grid, when the last is as good.
    pub fn remove_best(&self) -> Result<()> {
        remove([self.path.join(BEST)].into_iter().filter(|path| path.exists()))
    }

    /// Writes the trained grid.
    pub fn save(&self, grid: &VoxelGrid<f32>, header: &Header) -> Result<()> {
        checkpoint::save(&self.checkpoint(), grid, header)
    }

    /// Reads the trained grid.
    ///
    /// Errors: there is none, because the run did not end well; or it is damaged.
    pub fn load(&self) -> Result<(VoxelGrid<f32>, Header)> {
        checkpoint::load(&self.existing_checkpoint()?)
    }

    /// Reads the header of the trained grid, and the number of its voxels.
    ///
    /// Errors as for [`RunFolder::load`].
    pub fn header(&self) -> Result<(Header, usize)> {
        checkpoint::header(&self.existing_checkpoint()?)
    }

    fn existing_checkpoint(&self) -> Result<PathBuf> {
        let path = self.checkpoint();
        if !files::is_there(&path) {
            let found = format!("there is no {CHECKPOINT} in this folder: the run did not end");
            let best = if self.path.join(BEST).exists() { "; or --best, for the best grid that was saved" } else { "" };
            return Err(Error::input(&self.path, found, format!("go on with `plenoxel train --resume`, or train again{best}")));
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

    /// Removes files that were being written when a run was killed.
    pub fn remove_fragments(&self) -> Result<()> {
        [&self.path, &self.path.join(IMAGES)].into_iter().try_for_each(|folder| remove(entries(folder).filter(|path| is_fragment(path))))
    }

    /// Writes the final figures.
    pub fn write_result(&self, result: &impl Serialize) -> Result<()> {
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

    /// The final figures, with those of an evaluation where the final ones are without test views.
    ///
    /// Errors as for [`RunFolder::result`].
    pub fn figures(&self) -> Result<Option<serde_json::Value>> {
        let Some(mut all) = self.result()? else { return Ok(None) };
        if let (Some(all), Some(serde_json::Value::Object(evaluation))) = (all.as_object_mut(), self.evaluation()?) {
            for (key, value) in evaluation {
                all.entry(key).or_insert(value);
            }
        }
        Ok(Some(all))
    }

    fn read_json(&self, name: &str) -> Result<Option<serde_json::Value>> {
        let path = self.path.join(name);
        if !files::is_there(&path) {
            return Ok(None);
        }
        Ok(json::parse(&path, &files::read(&path, files::RECORD)?).ok())
    }

    /// Writes the chart of the loss, an SVG.
    pub fn write_loss(&self, svg: &str) -> Result<()> {
        files::write_atomically(&self.path.join(LOSS), svg.as_bytes())
    }

    /// Writes the report, an HTML page.
    pub fn write_report(&self, page: &str) -> Result<()> {
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
        remove(entries(&path).filter(|path| is_frame(path) || is_fragment(path)))?;
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
