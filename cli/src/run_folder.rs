//! A run folder, which explains itself: what each file in it is called, and when one may be overwritten.

use crate::event_file;
use plenoxel::checkpoint::{self, Header};
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::files;
use plenoxel::run::data::DataSource;
use plenoxel::run::settings::{self, ConfigFile};
use plenoxel::train::config::Config;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What is true of a run and not of its configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Program and version that made the run.
    pub program: String,
    /// Vector instructions it used: bits repeat on the same ones.
    pub instruction_set: String,
    /// Threads it ran on: bits do not depend on them.
    pub threads: usize,
    /// Name of the scene.
    pub scene: String,
    /// Format of its views, in words.
    pub format: String,
    /// Preset the configuration started from, if it did.
    pub preset: Option<String>,
    /// Where the views are.
    pub data: DataSource,
    /// The time that training was planned for, if it was.
    #[serde(default)]
    pub seconds_planned: Option<f64>,
}

impl RunRecord {
    /// Reads the bytes of a file; `path` names it in messages.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        serde_json::from_slice(bytes).map_err(|e| {
            let found = format!("this does not describe a run ({e})");
            Error::input(path, found, "train again, or use an undamaged copy")
        })
    }
}

/// The folder of a run.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    /// Which of its grids is meant.
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
/// Endings of what `render` writes.
const RENDERED: [&str; 5] = ["png", "exr", "npy", "gif", "mp4"];
/// Endings of what `export` writes.
const EXPORTED: [&str; 4] = ["vox", "ply", "obj", "glb"];

impl RunFolder {
    /// That at a path, whatever is there.
    pub fn at(path: &Path) -> Self {
        RunFolder { path: path.to_owned(), grid: CHECKPOINT }
    }

    /// The folder that a new run will have: the one asked for, or `runs/<scene>-<n>` with the first free n. Nothing is written yet.
    ///
    /// Errors: it has something in it that is not a run, or a run that may not be overwritten; or it is a file.
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

    /// Makes the folder. Of a run that is overwritten, the files go that this one may not write, so that nothing of it is mistaken for
    /// the new one's; files of other kinds stay.
    pub fn prepare(&self) -> Result<()> {
        files::create_dir(&self.path)?;
        self.remove_fragments()?;
        let names = [CHECKPOINT, BEST, STATE, RESULT, EVALUATION, METRICS, LOSS, REPORT, CONFIG, RECORD, README];
        let paths = names.map(|name| self.path.join(name)).into_iter().filter(|path| path.exists());
        for path in paths.chain(event_file::present(&self.path)) {
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

    /// Writes what is known before the first step.
    pub fn describe(&self, config: &Config, record: &RunRecord) -> Result<()> {
        let command = if config.stages.is_empty() { "carve" } else { "train" };
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
        let bytes = std::fs::read(&record).map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => Error::input(path, format!("there is no {RECORD} in this folder"), remedy),
            _ => Error::io(&record, e, "reading the run"),
        })?;
        let record = RunRecord::parse(&record, &bytes)?;
        Ok((folder, ConfigFile::read(&path.join(CONFIG))?.complete()?, record))
    }

    /// The same run with the best of its grids, as `--best` asks for.
    ///
    /// Errors: it kept no other than its last.
    pub fn with_best(self) -> Result<Self> {
        let best = RunFolder { grid: BEST, ..self };
        if !best.checkpoint().exists() {
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

    /// Writes the best grid so far.
    pub fn save_best(&self, grid: &VoxelGrid<f32>, header: &Header) -> Result<()> {
        checkpoint::save(&self.path.join(BEST), grid, header)
    }

    /// Removes the grid that was the best before the last.
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

    /// Reads what the trained grid says of itself, and the number of its voxels.
    ///
    /// Errors as for [`RunFolder::load`].
    pub fn header(&self) -> Result<(Header, usize)> {
        checkpoint::header(&self.existing_checkpoint()?)
    }

    fn existing_checkpoint(&self) -> Result<PathBuf> {
        let path = self.checkpoint();
        if !path.exists() {
            let found = format!("there is no {CHECKPOINT} in this folder: the run did not end");
            let best = if self.path.join(BEST).exists() { "; or --best, for the best grid that was saved" } else { "" };
            return Err(Error::input(&self.path, found, format!("go on with `plenoxel train --resume`, or train again{best}")));
        }
        Ok(path)
    }

    /// The file from which training goes on; `None` if training has ended, and all that is missing are the final figures.
    ///
    /// Errors: there is none, because the run has ended, or never came so far.
    pub fn existing_state(&self) -> Result<Option<PathBuf>> {
        let path = self.state();
        let (found, remedy) = match (path.exists(), self.checkpoint().exists()) {
            (true, _) => return Ok(Some(path)),
            (false, true) if self.result().is_none() => return Ok(None),
            (false, true) => ("this run has ended", "to train its grid further, use `--init-from`"),
            (false, false) => ("this run left nothing from which to go on", "train again with its config.toml"),
        };
        Err(Error::input(&self.path, found, remedy))
    }

    /// Removes what only an unfinished run needs.
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

    /// Reads the final figures, as far as there are any.
    pub fn result(&self) -> Option<serde_json::Value> {
        self.read_json(RESULT)
    }

    /// Writes what an evaluation found of a run whose final figures do not compare it with test views.
    pub fn write_evaluation(&self, figures: &impl Serialize) -> Result<()> {
        self.write_json(EVALUATION, figures)
    }

    /// Reads what an evaluation found, if one was written.
    pub fn evaluation(&self) -> Option<serde_json::Value> {
        self.read_json(EVALUATION)
    }

    /// The final figures, and of a carved run, which compares nothing with test views, those of its evaluation.
    pub fn figures(&self) -> Option<serde_json::Value> {
        let mut all = self.result()?;
        if let (Some(all), Some(serde_json::Value::Object(evaluation))) = (all.as_object_mut(), self.evaluation()) {
            for (key, value) in evaluation {
                all.entry(key).or_insert(value);
            }
        }
        Some(all)
    }

    fn read_json(&self, name: &str) -> Option<serde_json::Value> {
        let text = std::fs::read_to_string(self.path.join(name)).ok()?;
        serde_json::from_str(&text).ok()
    }

    /// Writes the picture of the loss.
    pub fn write_loss(&self, svg: &str) -> Result<()> {
        files::write_atomically(&self.path.join(LOSS), svg.as_bytes())
    }

    /// Writes the report.
    pub fn write_report(&self, page: &str) -> Result<()> {
        files::write_atomically(&self.report(), page.as_bytes())
    }

    /// Reads the settings as they are written down.
    pub fn settings(&self) -> Result<String> {
        let path = self.path.join(CONFIG);
        std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e, "reading the settings"))
    }

    /// The report.
    pub fn report(&self) -> PathBuf {
        self.path.join(REPORT)
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The lines that grow during the run.
    pub fn metrics(&self) -> PathBuf {
        self.path.join(METRICS)
    }

    /// The trained grid: that of the last step, or the best.
    pub fn checkpoint(&self) -> PathBuf {
        self.path.join(self.grid)
    }

    /// What an unfinished run goes on from.
    pub fn state(&self) -> PathBuf {
        self.path.join(STATE)
    }

    /// A picture of the run.
    pub fn image(&self, name: &str) -> PathBuf {
        self.path.join(IMAGES).join(name)
    }

    /// The pictures of the run, by name; none if there are none.
    pub fn images(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.path.join(IMAGES));
        let mut images: Vec<PathBuf> = entries.into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        images.sort();
        images
    }

    /// A picture made later.
    pub fn render(&self, name: &str) -> PathBuf {
        self.of_grid(RENDERS).join(name)
    }

    /// Name of the picture of a test view.
    pub fn panel_name(number: usize, view: &str) -> String {
        format!("test_{number:03}_{view}.png")
    }

    /// Makes the folder for the pictures of the run.
    pub fn create_images(&self) -> Result<()> {
        files::create_dir(&self.path.join(IMAGES))
    }

    /// Where something lies that is made of the grid: that of the best does not take the place of the last one's.
    fn of_grid(&self, name: &str) -> PathBuf {
        if self.grid == BEST { self.path.join(format!("{name}-best")) } else { self.path.join(name) }
    }

    /// Makes the folder for pictures made later, and says where it is.
    pub fn create_renders(&self) -> Result<PathBuf> {
        let path = self.of_grid(RENDERS);
        files::create_dir(&path)?;
        Ok(path)
    }

    /// Makes the folder for the frames of a film, and says where it is. Those of an earlier film of this name go, and what they were joined to,
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

    /// Makes the folder for what other programs read, and names a file in it.
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

/// What lies in a folder, as far as it can be listed.
fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

fn file_name(path: &Path) -> std::borrow::Cow<'_, str> {
    path.file_name().unwrap_or_default().to_string_lossy()
}

/// True for a name that ends in a dot and one of `endings`.
fn is_one_of(path: &Path, endings: &[&str]) -> bool {
    path.extension().is_some_and(|ending| endings.iter().any(|e| ending == *e))
}

/// True for a frame of a film.
fn is_frame(path: &Path) -> bool {
    file_name(path).starts_with("frame_") && is_one_of(path, &RENDERED)
}

/// True for a file that was being written.
fn is_fragment(path: &Path) -> bool {
    let name = file_name(path);
    name.starts_with(".tmp") || name.starts_with('.') && name.ends_with(".tmp")
}

fn remove(files: impl Iterator<Item = PathBuf>) -> Result<()> {
    files.into_iter().try_for_each(|path| std::fs::remove_file(&path).map_err(|e| Error::io(&path, e, "removing it")))
}

/// The folder's own explanation.
const EXPLANATION: &str = include_str!("run_folder/README.md");

/// `root/<scene>-<n>` with the first n from 1 on that nothing has.
fn first_free(root: &Path, scene: &str) -> PathBuf {
    let plain = |c: char| {
        let keep = c.is_alphanumeric() || matches!(c, '-' | '_' | '.');
        if keep { c } else { '-' }
    };
    let scene: String = scene.chars().map(plain).collect();
    let mut n = 1;
    loop {
        let path = root.join(format!("{scene}-{n}"));
        // A dangling link exists too: nothing may be written through it.
        if path.symlink_metadata().is_err() {
            return path;
        }
        n += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_free_number_is_taken_and_names_become_plain() {
        let root = std::env::temp_dir().join(format!("plenoxel-runs-{}", std::process::id()));
        std::fs::create_dir_all(root.join("my-lego-1")).unwrap();
        std::fs::create_dir_all(root.join("my-lego-3")).unwrap();
        assert_eq!(first_free(&root, "my lego"), root.join("my-lego-2"));
        assert_eq!(first_free(&root, "../x"), root.join("..-x-1"));
        std::fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn an_occupied_folder_is_refused_unless_forced_and_other_files_survive() {
        let path = std::env::temp_dir().join(format!("plenoxel-occupied-{}", std::process::id()));
        for folder in ["images/paper", "exports/blender", "renders/orbit", "renders-best/orbit"] {
            std::fs::create_dir_all(path.join(folder)).unwrap();
        }
        let mine = ["notes.txt", "exports/notes.txt", "exports/blender/final.glb", "images/paper/figure_1.png", "renders/orbit/title.png"];
        let ours = [
            CHECKPOINT,
            "events.out.tfevents.17.plenoxel",
            "images/old.png",
            "exports/mesh.glb",
            "renders/orbit.mp4",
            "renders/orbit/frame_0001.png",
            "renders-best/orbit/frame_0001.exr",
        ];
        mine.iter().chain(&ours).for_each(|name| std::fs::write(path.join(name), "x").unwrap());
        let refused = RunFolder::choose(Some(&path), "x", false).unwrap_err();
        assert!(refused.exit_code() == 2 && refused.to_string().contains("--force"));
        // What is not a run is not overwritten, come what may.
        let refused = RunFolder::choose(Some(&path), "x", true).unwrap_err();
        assert!(refused.exit_code() == 2 && refused.to_string().contains("not a run"), "{refused}");
        std::fs::write(path.join(RECORD), "{}").unwrap();
        RunFolder::choose(Some(&path), "x", true).unwrap().prepare().unwrap();
        let there = |name: &&&str| path.join(name).exists();
        assert_eq!((mine.iter().filter(there).count(), ours.iter().filter(there).count()), (mine.len(), 0));
        std::fs::remove_dir_all(path).unwrap();
    }
}
