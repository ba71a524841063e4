//! `metrics.jsonl`: what a run did, line by line, while it does it; and the same figures for TensorBoard.

use crate::event_file::EventFile;
use crate::run_folder::RunFolder;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::train::{PlannedStage, Report};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// About so many lines in a run: enough for any curve.
const LINES: u64 = 1000;

/// The file, which grows by a whole line at a time; a run that goes on cuts it back to where it was saved.
pub struct MetricsFile {
    path: PathBuf,
    file: File,
    events: EventFile,
    every: u64,
    since: Sums,
    rays: u64,
    samples: u64,
    known: Known,
}

/// The step after which validation views were seen best.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Best {
    step: u64,
    psnr: f64,
}

/// What the lines so far come to.
#[derive(Clone, Copy, Default)]
struct Known {
    step: u64,
    seconds: f64,
    rays: u64,
    samples: u64,
    validation_psnr: Option<f64>,
    best: Option<Best>,
}

impl Known {
    fn add(&mut self, line: &Line<'_>) {
        let seen = line.validation_psnr.map(|psnr| Best { step: line.step, psnr });
        // Of equal ones the later: it has learned more.
        let better = seen.filter(|seen| self.best.is_none_or(|best| seen.psnr >= best.psnr));
        *self = Known {
            step: line.step,
            seconds: line.seconds,
            rays: line.rays,
            samples: line.samples,
            validation_psnr: line.validation_psnr.or(self.validation_psnr),
            best: better.or(self.best),
        };
    }
}

/// What the lines of a run tell that goes on.
#[derive(Default)]
pub struct Past {
    /// Of each step: the mean of its line.
    pub losses: Vec<f64>,
    /// Each stage that has ended, and the seconds of training by then.
    pub stages: Vec<(usize, f64)>,
    /// Seconds of training.
    pub seconds: f64,
    /// PSNR of validation views by the step after which they were looked at.
    pub validation: BTreeMap<u64, f64>,
    /// What the last of them comes to.
    known: Known,
}

impl Past {
    /// What a file tells of so many steps, and the lines that do.
    pub fn of(text: &str, taken: u64) -> (String, Self) {
        let (mut kept, mut past) = (String::new(), Past::default());
        for (text, line) in lines(text).filter(|(_, line)| line.step < taken) {
            kept += text;
            kept += "\n";
            past.losses.resize(line.step as usize + 1, line.loss);
            past.seconds = line.seconds;
            if line.ends_stage {
                past.stages.push((line.stage, line.seconds));
            }
            past.validation.extend(line.validation_psnr.map(|psnr| (line.step, psnr)));
            past.known.add(&line);
        }
        let last = past.losses.last().copied().unwrap_or(0.0);
        past.losses.resize(taken as usize, last);
        (kept, past)
    }
}

/// A line about training: means of the losses and the PSNR since the line before, everything else as it is now.
#[derive(Serialize, Deserialize)]
pub struct Line<'a> {
    pub step: u64,
    pub stage: usize,
    pub resolution: usize,
    pub ends_stage: bool,
    pub loss: f64,
    #[serde(borrow)]
    pub losses: BTreeMap<Cow<'a, str>, f64>,
    pub psnr: f64,
    pub rays: u64,
    pub samples: u64,
    pub density_rate: f64,
    pub color_rate: f64,
    #[serde(default)]
    pub voxels: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation_psnr: Option<f64>,
    pub seconds: f64,
}

impl Line<'_> {
    /// Its figures as TensorBoard shows them, rays a second from what was known before.
    fn scalars(&self, before: &Known) -> Vec<(Cow<'_, str>, f64)> {
        let rays_per_second = self.rays.saturating_sub(before.rays) as f64 / (self.seconds - before.seconds);
        let each = self.losses.iter().map(|(name, value)| (format!("loss/{name}").into(), *value));
        let others = [
            ("loss", Some(self.loss)),
            ("psnr/train", Some(self.psnr)),
            ("psnr/validation", self.validation_psnr),
            ("resolution", Some(self.resolution as f64)),
            ("voxels", Some(self.voxels as f64)),
            ("density_rate", Some(self.density_rate)),
            ("color_rate", Some(self.color_rate)),
            ("rays_per_second", Some(rays_per_second)),
        ];
        let others = others.into_iter().filter_map(|(name, value)| Some((name.into(), value?)));
        others.chain(each).collect()
    }
}

/// What is known of a step besides what the trainer reports.
#[derive(Clone, Copy, Default)]
pub struct Seen {
    /// Voxels that the grid has.
    pub voxels: usize,
    /// PSNR of validation views after the step, if they were looked at.
    pub validation_psnr: Option<f64>,
    /// Seconds of training that have passed.
    pub seconds: f64,
}

/// Sums over the steps since the last line.
#[derive(Default)]
struct Sums {
    steps: f64,
    loss: f64,
    squared_error: f64,
    losses: Vec<(String, f64)>,
}

/// The text of a file, empty if there is none.
pub fn read(path: &Path) -> Result<String> {
    match std::fs::read(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path, e, "reading the metrics")),
        bytes => Ok(String::from_utf8_lossy(&bytes.unwrap_or_default()).into_owned()),
    }
}

/// The lines about training, as they are written and as they are meant. One that was cut short, and what is no line of a step, say nothing.
pub fn lines(text: &str) -> impl Iterator<Item = (&str, Line<'_>)> {
    text.lines().filter_map(|text| Some((text, serde_json::from_str(text).ok()?)))
}

impl MetricsFile {
    /// A new file for a run of so many steps.
    pub fn create(folder: &RunFolder, total_steps: u64) -> Result<Self> {
        Self::open(folder, total_steps, 0, Known::default())
    }

    fn open(folder: &RunFolder, total_steps: u64, taken: u64, known: Known) -> Result<Self> {
        let path = folder.metrics();
        let file = OpenOptions::new().append(true).create(true).open(&path);
        Ok(MetricsFile {
            file: file.map_err(|e| Error::io(&path, e, "creating the metrics"))?,
            path,
            events: EventFile::create(folder.path(), taken)?,
            every: (total_steps / LINES).max(1),
            since: Sums::default(),
            rays: known.rays,
            samples: known.samples,
            known,
        })
    }

    /// The file of a run that goes on after so many steps: lines about later ones go.
    pub fn resume(folder: &RunFolder, total_steps: u64, taken: u64) -> Result<(Self, Past)> {
        let path = folder.metrics();
        let (kept, past) = Past::of(&read(&path)?, taken);
        files::write_atomically(&path, kept.as_bytes())?;
        Ok((Self::open(folder, total_steps, taken, past.known)?, past))
    }

    /// A step was taken. A line is written if it is time to, or it must be; it must if validation views were looked at.
    pub fn step(&mut self, report: &Report, plan: &[PlannedStage], seen: Seen, must: bool) -> Result<()> {
        // Lines of a damaged file may have said anything.
        self.rays = self.rays.saturating_add(report.rays as u64);
        self.samples = self.samples.saturating_add(report.samples as u64);
        let since = &mut self.since;
        since.steps += 1.0;
        since.loss += report.loss;
        since.squared_error += 10f64.powf(-0.1 * report.psnr);
        for (name, value) in &report.losses {
            match since.losses.iter_mut().find(|(known, _)| known == name) {
                Some((_, sum)) => *sum += value,
                None => since.losses.push((name.clone(), *value)),
            }
        }
        let Seen { voxels, validation_psnr, seconds } = seen;
        let must = must || report.ends_stage || validation_psnr.is_some();
        if !(report.step + 1).is_multiple_of(self.every) && !must {
            return Ok(());
        }
        let since = std::mem::take(&mut self.since);
        let mean = |sum: f64| sum / since.steps;
        let line = Line {
            step: report.step,
            stage: report.stage,
            resolution: plan[report.stage].stage.resolution,
            ends_stage: report.ends_stage,
            loss: mean(since.loss),
            losses: since.losses.iter().map(|(name, sum)| (name.into(), mean(*sum))).collect(),
            psnr: -10.0 * mean(since.squared_error).log10(),
            rays: self.rays,
            samples: self.samples,
            density_rate: report.density_rate,
            color_rate: report.color_rate,
            voxels,
            validation_psnr,
            seconds,
        };
        let scalars = line.scalars(&self.known);
        self.events.scalars(line.step, scalars.iter().map(|(name, value)| (name.as_ref(), *value)))?;
        self.known.add(&line);
        self.append(&line)
    }

    /// The last line, with the final figures; some of them are TensorBoard's too.
    pub fn conclude(&mut self, line: &impl Serialize, figures: &[(&str, Option<f64>)]) -> Result<()> {
        self.append(line)?;
        self.events.scalars(self.known.step, figures.iter().filter_map(|(name, value)| Some((*name, (*value)?))))
    }

    /// A picture for TensorBoard, as the grid is seen after a step: a PNG file of so many pixels.
    pub fn picture(&mut self, step: u64, size: (usize, usize), png: &Path) -> Result<()> {
        let bytes = std::fs::read(png).map_err(|e| Error::io(png, e, "reading the picture"))?;
        self.events.image(step, "preview", size, &bytes)
    }

    /// Has what was written on the disk.
    pub fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(|e| Error::io(&self.path, e, "writing the metrics"))
    }

    /// Appends a line.
    pub fn append(&mut self, line: &impl Serialize) -> Result<()> {
        let text = crate::json_line(line)? + "\n";
        let written = self.file.write_all(text.as_bytes());
        written.map_err(|e| Error::io(&self.path, e, "writing the metrics"))
    }

    /// Rays and samples since the start of training.
    pub fn counts(&self) -> (u64, u64) {
        (self.rays, self.samples)
    }

    /// The PSNR of validation views when they were last looked at, and the best there was.
    pub fn validation(&self) -> (Option<f64>, Option<Best>) {
        (self.known.validation_psnr, self.known.best)
    }
}
