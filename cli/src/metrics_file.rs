//! `metrics.jsonl`: what a run did, line by line, while it does it.

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
    every: u64,
    since: Sums,
    rays: u64,
    samples: u64,
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
    /// Rays and samples.
    counts: (u64, u64),
}

impl Past {
    /// What the bytes of a file tell of so many steps, and the lines that do.
    pub fn of(bytes: &[u8], taken: u64) -> (String, Self) {
        let text = String::from_utf8_lossy(bytes);
        let (mut kept, mut past) = (String::new(), Past::default());
        for text in text.lines() {
            // A line that was cut short, and what is no line of a step, say nothing.
            let Some(line) = serde_json::from_str::<Line<'_>>(text).ok().filter(|line| line.step < taken) else { continue };
            kept += text;
            kept += "\n";
            past.losses.resize(line.step as usize + 1, line.loss);
            past.seconds = line.seconds;
            if line.ends_stage {
                past.stages.push((line.stage, line.seconds));
            }
            past.counts = (line.rays, line.samples);
        }
        let last = past.losses.last().copied().unwrap_or(0.0);
        past.losses.resize(taken as usize, last);
        (kept, past)
    }
}

/// A line: means of the losses and the PSNR since the line before, everything else as it is now.
#[derive(Serialize, Deserialize)]
struct Line<'a> {
    step: u64,
    stage: usize,
    resolution: usize,
    ends_stage: bool,
    loss: f64,
    #[serde(borrow)]
    losses: BTreeMap<Cow<'a, str>, f64>,
    psnr: f64,
    rays: u64,
    samples: u64,
    density_rate: f64,
    color_rate: f64,
    seconds: f64,
}

/// Sums over the steps since the last line.
#[derive(Default)]
struct Sums {
    steps: f64,
    loss: f64,
    squared_error: f64,
    losses: Vec<(String, f64)>,
}

impl MetricsFile {
    /// A new file for a run of so many steps.
    pub fn create(path: &Path, total_steps: u64) -> Result<Self> {
        let file = OpenOptions::new().append(true).create(true).open(path);
        Ok(MetricsFile {
            path: path.to_owned(),
            file: file.map_err(|e| Error::io(path, e, "creating the metrics"))?,
            every: (total_steps / LINES).max(1),
            since: Sums::default(),
            rays: 0,
            samples: 0,
        })
    }

    /// The file of a run that goes on after so many steps: lines about later ones go.
    pub fn resume(path: &Path, total_steps: u64, taken: u64) -> Result<(Self, Past)> {
        let bytes = match std::fs::read(path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(Error::io(path, e, "reading the metrics")),
            bytes => bytes.unwrap_or_default(),
        };
        let (kept, past) = Past::of(&bytes, taken);
        files::write_atomically(path, kept.as_bytes())?;
        let (rays, samples) = past.counts;
        Ok((MetricsFile { rays, samples, ..Self::create(path, total_steps)? }, past))
    }

    /// A step was taken; `seconds` of training have passed. A line is written if it is time to, or it must be.
    pub fn step(&mut self, report: &Report, plan: &[PlannedStage], seconds: f64, must: bool) -> Result<()> {
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
        if !(report.step + 1).is_multiple_of(self.every) && !report.ends_stage && !must {
            return Ok(());
        }
        let since = std::mem::take(&mut self.since);
        let mean = |sum: f64| sum / since.steps;
        self.append(&Line {
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
            seconds,
        })
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
}
