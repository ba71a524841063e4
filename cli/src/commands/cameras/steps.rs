//! The steps: features of each photograph, matches of pairs, and the mapping, which finds cameras and points.

use super::colmap::{Ended, Installed, Place, log};
use super::folder::{CameraFolder, IMAGES, WORK};
use super::output::{self, Unit};
use super::photos::{Photo, by_size};
use super::settings::{Matcher, Settings};
use plenoxel::dataset::colmap;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::run::machine;
use plenoxel::text::clock;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Database of features and matches, in the folder of what only COLMAP needs.
const DATABASE: &str = "database.db";
/// Files of the database while it is open.
const JOURNALS: [&str; 3] = ["-journal", "-wal", "-shm"];
/// Folder of the models of the mapping.
const MODELS: &str = "models";
/// Rows of the table of all pairs, in blocks. Progress is reported by blocks.
const BLOCKS: usize = 8;
/// Most photographs of a block, as COLMAP has it.
const LARGEST_BLOCK: usize = 50;

/// A step, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Step {
    Features,
    Matching,
    Mapping,
}

impl Step {
    pub const ALL: [Step; 3] = [Step::Features, Step::Matching, Step::Mapping];

    /// Number and name for people: `step 2/3, matching`.
    pub fn title(self) -> String {
        format!("step {}/{}, {}", self as usize + 1, Step::ALL.len(), self.name())
    }

    pub fn name(self) -> &'static str {
        match self {
            Step::Features => "features",
            Step::Matching => "matching",
            Step::Mapping => "mapping",
        }
    }
}

/// Inputs of a step.
pub struct Work<'a, 'c> {
    /// When the step began.
    pub begun: Instant,
    pub colmap: &'a Installed,
    pub place: Place<'a, 'c>,
    pub settings: &'a Settings,
    pub photos: &'a [Photo],
}

impl Work<'_, '_> {
    /// Takes the step from its beginning; matches of an earlier call are kept by COLMAP. Returns false if it was interrupted.
    pub fn take(&self, step: Step, folder: &CameraFolder) -> Result<bool> {
        match step {
            Step::Features => self.features(folder),
            Step::Matching => self.matching(),
            Step::Mapping => self.mapping(folder),
        }
    }

    fn features(&self, folder: &CameraFolder) -> Result<bool> {
        // Half of the features would be kept, but with a camera of their own.
        folder.remove(&inside(DATABASE))?;
        JOURNALS.iter().try_for_each(|journal| folder.remove(&inside(&format!("{DATABASE}{journal}"))))?;
        // A call of COLMAP makes a camera, which photographs of one size can share.
        let groups = if self.settings.camera_per_photo { vec![self.photos.iter().collect()] } else { by_size(self.photos) };
        let kind = if self.settings.camera_per_photo { "single_camera_per_image" } else { "single_camera" };
        let mut before = 0;
        for (number, group) in groups.iter().enumerate() {
            let list = inside(&format!("photos_{number}.txt"));
            let names: String = group.iter().flat_map(|photo| [&photo.name, "\n"]).collect();
            files::write_atomically(&self.place.folder.join(&list), names.as_bytes())?;
            let arguments = [
                words(["feature_extractor", "--database_path", &inside(DATABASE), "--image_path", IMAGES, "--image_list_path", &list]),
                words([&format!("--ImageReader.{kind}"), "1", "--ImageReader.camera_model", &self.settings.camera_model]),
                self.machine(self.colmap.extraction),
            ];
            if !self.succeeds(Step::Features, before, &arguments.concat())? {
                return Ok(false);
            }
            before += group.len();
        }
        Ok(true)
    }

    fn matching(&self) -> Result<bool> {
        let block = self.photos.len().div_ceil(BLOCKS).clamp(2, LARGEST_BLOCK).to_string();
        let (command, more) = match self.settings.matcher {
            Matcher::Exhaustive => ("exhaustive_matcher", words(["--ExhaustiveMatching.block_size", &block])),
            Matcher::Sequential => ("sequential_matcher", Vec::new()),
        };
        let arguments = [words([command, "--database_path", &inside(DATABASE)]), more, self.machine(self.colmap.matching)];
        self.succeeds(Step::Matching, 0, &arguments.concat())
    }

    /// Finds the cameras, and makes the largest model the reconstruction of the folder.
    fn mapping(&self, folder: &CameraFolder) -> Result<bool> {
        let models = self.place.folder.join(inside(MODELS));
        folder.remove(&inside(MODELS))?;
        files::create_dir(&models)?;
        let arguments = [
            words(["mapper", "--database_path", &inside(DATABASE), "--image_path", IMAGES, "--output_path", &inside(MODELS)]),
            words(["--Mapper.num_threads", &machine::threads().to_string()]),
        ];
        let mut is_without_model = false;
        let ended = self.run(Step::Mapping, 0, &arguments.concat(), |line| is_without_model |= output::is_without_model(line))?;
        if ended.code != 0 && !is_without_model {
            return self.interrupted_or_failed(Step::Mapping, "mapper", ended);
        }
        match largest(&models)? {
            Some((images, model)) if 2 * images >= self.photos.len() => folder.adopt(&model).map(|()| true),
            found => Err(self.too_few(found)),
        }
    }

    /// The options about the machine, of a group of options.
    fn machine(&self, group: &str) -> Vec<String> {
        words([&format!("--{group}.use_gpu"), "0", &format!("--{group}.num_threads"), &machine::threads().to_string()])
    }

    /// Runs a command of COLMAP. Returns false if it was interrupted. `before` photographs are done already.
    fn succeeds(&self, step: Step, before: usize, arguments: &[String]) -> Result<bool> {
        let ended = self.run(step, before, arguments, |_| {})?;
        if ended.code == 0 { Ok(true) } else { self.interrupted_or_failed(step, &arguments[0], ended) }
    }

    /// Runs a command of COLMAP, and shows its progress.
    fn run(&self, step: Step, before: usize, arguments: &[String], mut heard: impl FnMut(&str)) -> Result<Ended> {
        let photos = self.photos.len();
        let progress = self.place.console.relay(photos);
        self.colmap.run(&self.place, arguments, |line| {
            heard(line);
            if let Some(position) = output::position(line, photos) {
                let (at, total) = match position.unit {
                    Unit::Image => (before as u64 + u64::from(position.at), photos as u64),
                    Unit::Block => (u64::from(position.at), u64::from(position.total)),
                };
                let done = (at * photos as u64 / total) as usize;
                let seconds = self.begun.elapsed().as_secs_f64();
                progress.say(done, || format!("{}: {} {at}/{total}, {}", step.title(), position.unit.name(), clock(seconds)));
            }
        })
    }

    fn interrupted_or_failed(&self, step: Step, command: &str, ended: Ended) -> Result<bool> {
        if self.place.watch.requested() {
            return Ok(false);
        }
        let found = format!("{} failed: {command} of COLMAP ended with exit code {}: {}", step.title(), ended.code, ended.last);
        Err(Error::input(log(self.place.folder), found, "read the output in this file; repeat the command to continue with this step"))
    }

    fn too_few(&self, found: Option<(usize, PathBuf)>) -> Error {
        let all = self.photos.len();
        let found = match found {
            Some((images, model)) => format!("only {images} of {all} photographs got a camera (see {})", model.display()),
            None => format!("none of {all} photographs got a camera"),
        };
        let order = match self.settings.matcher {
            Matcher::Sequential => "match all pairs with --matcher exhaustive --force, or ",
            Matcher::Exhaustive => "",
        };
        let remedy = format!(
            "{order}take more photographs that overlap: sharp ones, of a scene with texture that does not move, each part of it in at least \
             three photographs, from places a step apart, with one zoom"
        );
        Error::input(self.place.folder, found, remedy)
    }
}

/// Returns the model with the most images in a folder of models, with their number.
fn largest(models: &Path) -> Result<Option<(usize, PathBuf)>> {
    let entries = std::fs::read_dir(models).map_err(|e| Error::io(models, e, "listing the models"))?;
    let mut best: Option<(usize, PathBuf)> = None;
    for model in entries.flatten().map(|entry| entry.path()) {
        let file = model.join("images.bin");
        if !files::is_there(&file) {
            continue;
        }
        let images = colmap::images(&file)?.len();
        // Of equal ones the first by name.
        if best.as_ref().is_none_or(|(most, first)| images > *most || (images == *most && model < *first)) {
            best = Some((images, model));
        }
    }
    Ok(best)
}

/// A path in the folder of what only COLMAP needs, as seen from the folder of cameras.
fn inside(name: &str) -> String {
    format!("{WORK}/{name}")
}

fn words<const N: usize>(words: [&str; N]) -> Vec<String> {
    words.map(str::to_owned).to_vec()
}
