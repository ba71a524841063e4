//! Metrics of training, as lines of `metrics.jsonl` and as TensorBoard events.

use super::folder::RunFolder;
use super::tensorboard::EventFile;
use crate::error::{Error, Result};
use crate::files;
use crate::json;
use crate::memory;
use crate::train::{PlannedStage, Report};
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Approximate number of lines per run.
const LINES: u64 = 1000;

/// A writer for the metrics of a run. It appends whole lines. Resuming a run removes the lines after its last checkpoint.
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

/// The best validation PSNR of a run, and the step after which it was measured.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Best {
    /// Number of the step, from 0.
    pub step: u64,
    /// Mean PSNR of the validation views, in dB.
    pub psnr: f64,
}

/// The last value of some figures.
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
        // Of equal values, the later one counts.
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

/// The figures of a run before it was resumed, read from its metrics.
#[derive(Default)]
pub struct History {
    /// Loss of each step: the mean in its line.
    pub losses: Vec<f64>,
    /// Index of each finished stage, and the seconds of training at its end.
    pub stages: Vec<(usize, f64)>,
    /// Seconds of training.
    pub seconds: f64,
    /// Mean PSNR of validation views, by the step after which it was measured.
    pub validation: BTreeMap<u64, f64>,
    /// The figures of the last line.
    known: Known,
}

impl History {
    /// Parses the lines of the first `taken` steps. Returns their text, and their history.
    pub fn of(text: &str, taken: u64) -> (String, Self) {
        let (mut kept, mut past) = (String::new(), History::default());
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

/// A line of the metrics. Losses and PSNR are means over the steps since the previous line.
#[derive(Serialize, Deserialize)]
pub struct Line<'a> {
    /// Index of the last step of the line, from 0.
    pub step: u64,
    /// Stage of that step, from 0.
    pub stage: usize,
    /// Voxels along each axis, if the model is a grid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resolution: Option<usize>,
    /// True if that step was the last of its stage.
    pub ends_stage: bool,
    /// Weighted sum of the losses.
    pub loss: f64,
    /// Each loss, unweighted.
    #[serde(borrow)]
    pub losses: BTreeMap<Cow<'a, str>, f64>,
    /// PSNR of training rays, in dB.
    pub psnr: f64,
    /// Rays since the start of training.
    pub rays: u64,
    /// Samples since the start of training.
    pub samples: u64,
    /// Facts about the model, such as `voxels`, and learning rates of its parameters, such as `density_rate`.
    #[serde(flatten)]
    pub figures: BTreeMap<String, serde_json::Number>,
    /// Mean PSNR of validation views in dB, if it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation_psnr: Option<f64>,
    /// Seconds of training.
    pub seconds: f64,
}

impl Line<'_> {
    /// A fact about the model or a learning rate, by name.
    pub fn figure(&self, name: &str) -> Option<f64> {
        self.figures.get(name)?.as_f64()
    }

    /// The scalars for TensorBoard. `before` has the figures of the previous line, for the rays per second.
    fn scalars(&self, before: &Known) -> Vec<(Cow<'_, str>, f64)> {
        let rays_per_second = self.rays.saturating_sub(before.rays) as f64 / (self.seconds - before.seconds);
        let each = self.losses.iter().map(|(name, value)| (format!("loss/{name}").into(), *value));
        let others = [
            ("loss", Some(self.loss)),
            ("psnr/train", Some(self.psnr)),
            ("psnr/validation", self.validation_psnr),
            ("resolution", self.resolution.map(|n| n as f64)),
            ("rays_per_second", Some(rays_per_second)),
        ];
        let others = others.into_iter().filter_map(|(name, value)| Some((name.into(), value?)));
        let figures = self.figures.iter().filter_map(|(name, value)| Some((name.as_str().into(), value.as_f64()?)));
        others.chain(figures).chain(each).collect()
    }
}

/// Figures of a step that are not in the trainer's report.
#[derive(Clone, Default)]
pub struct Observation {
    /// Facts about the model, the most important first ([`Model::facts`](crate::train::Model::facts)).
    pub facts: Vec<(&'static str, f64)>,
    /// Mean PSNR of validation views after the step, if it was measured.
    pub validation_psnr: Option<f64>,
    /// Seconds of training so far.
    pub seconds: f64,
    /// Estimated seconds of rendering for the final evaluation, if they were measured after the step.
    pub evaluation_seconds: Option<f64>,
}

/// Collects facts about a model by name, and learning rates by the name of their parameter with the suffix `_rate`. Whole numbers become integers.
pub fn figures(facts: &[(&'static str, f64)], rates: &[(String, f64)]) -> BTreeMap<String, serde_json::Number> {
    let facts = facts.iter().filter_map(|&(name, value)| {
        let whole = value.fract() == 0.0 && (0.0..9e15).contains(&value);
        let number = if whole { Some((value as u64).into()) } else { serde_json::Number::from_f64(value) };
        Some((name.to_owned(), number?))
    });
    let rates = rates.iter().filter_map(|(name, rate)| Some((format!("{name}_rate"), serde_json::Number::from_f64(*rate)?)));
    facts.chain(rates).collect()
}

/// Sums over the steps since the last line.
#[derive(Default)]
struct Sums {
    steps: f64,
    loss: f64,
    squared_error: f64,
    losses: Vec<(String, f64)>,
}

/// Reads the text of a metrics file; it is empty if the file does not exist.
///
/// Errors: the file cannot be read, is not a regular file, or is too large; there is not enough memory for its lines.
pub fn read(path: &Path) -> Result<String> {
    if !files::is_there(path) {
        return Ok(String::new());
    }
    let bytes = files::read(path, files::METRICS)?;
    let what = format!("reading {} of metrics", memory::bytes(bytes.len() as u64));
    memory::check(path, &what, parsed_bytes(&bytes))?;
    // Text that is not UTF-8 is copied, and may become three times as long.
    String::from_utf8(bytes).or_else(|damaged| {
        let bytes = damaged.as_bytes();
        memory::check(path, &what, 4 * bytes.len() as u64 + parsed_bytes(bytes))?;
        Ok(String::from_utf8_lossy(bytes).into_owned())
    })
}

/// Upper estimate of the memory of a text and its parsed lines, in bytes.
fn parsed_bytes(text: &[u8]) -> u64 {
    /// A line in a growing list, and both of its maps with up to 11 entries.
    const LINE: u64 = 2 * size_of::<Line<'_>>() as u64 + 850;
    /// Required keys of a line. The names of the next FEW keys take NAME each; further keys take a place in a map too.
    const OWN: u64 = 9;
    const FEW: u64 = 20;
    const NAME: u64 = 40;
    const ENTRY: u64 = 130;
    /// An entry while its line is parsed.
    const READING: u64 = 260;
    let (mut kept, mut longest) = (text.len() as u64, 0);
    for line in text.split(|byte| *byte == b'\n') {
        let entries = 1 + line.iter().filter(|byte| **byte == b',').count() as u64;
        longest = entries.max(longest);
        if entries < OWN {
            continue;
        }
        kept += LINE + NAME * entries.saturating_sub(OWN).min(FEW) + ENTRY * entries.saturating_sub(OWN + FEW);
    }
    kept + READING * longest
}

/// Parses the lines of training steps. Returns them with the number of unreadable lines, such as a truncated line.
pub fn of_steps(text: &str) -> (Vec<Line<'_>>, usize) {
    /// Any other line, such as the final figures.
    #[derive(Deserialize)]
    struct Other {
        #[serde(default)]
        step: Option<IgnoredAny>,
    }
    let mut unreadable = 0;
    let line = |text| {
        let line = serde_json::from_str(text).ok();
        let is_other = || serde_json::from_str::<Other>(text).is_ok_and(|other| other.step.is_none());
        unreadable += usize::from(line.is_none() && !is_other());
        line
    };
    (text.lines().filter_map(line).collect(), unreadable)
}

/// Parses the lines of training steps; returns each with its text. Truncated lines and other lines are skipped.
pub fn lines(text: &str) -> impl Iterator<Item = (&str, Line<'_>)> {
    text.lines().filter_map(|text| Some((text, serde_json::from_str(text).ok()?)))
}

/// Returns the number of steps between two lines.
fn every(total_steps: u64) -> u64 {
    (total_steps / LINES).max(1)
}

impl MetricsFile {
    /// Creates the metrics of a run of `total_steps` steps.
    ///
    /// Errors: the file cannot be created.
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
            every: every(total_steps),
            since: Sums::default(),
            rays: known.rays,
            samples: known.samples,
            known,
        })
    }

    /// Sets the number of steps of a run whose plan has changed.
    pub fn plan(&mut self, total_steps: u64) {
        self.every = every(total_steps);
    }

    /// Opens the metrics of a run that resumes after `taken` steps. Removes the lines of later steps.
    ///
    /// Errors: the file cannot be read or written.
    pub fn resume(folder: &RunFolder, total_steps: u64, taken: u64) -> Result<(Self, History)> {
        let path = folder.metrics();
        let (kept, past) = History::of(&read(&path)?, taken);
        files::write_atomically(&path, kept.as_bytes())?;
        Ok((Self::open(folder, total_steps, taken, past.known)?, past))
    }

    /// Adds a step. A line is written every few steps, at the end of a stage, with a validation PSNR, and if `must` is true.
    ///
    /// Errors: the file cannot be written.
    pub fn step(&mut self, report: &Report, plan: &[PlannedStage], seen: &Observation, must: bool) -> Result<()> {
        // A damaged file may contain any number.
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
        let Observation { facts, validation_psnr, seconds, .. } = seen;
        let (validation_psnr, seconds) = (*validation_psnr, *seconds);
        let must = must || report.ends_stage || validation_psnr.is_some();
        if !(report.step + 1).is_multiple_of(self.every) && !must {
            return Ok(());
        }
        let since = std::mem::take(&mut self.since);
        let mean = |sum: f64| sum / since.steps;
        let line = Line {
            step: report.step,
            stage: report.stage,
            resolution: plan[report.stage].resolution,
            ends_stage: report.ends_stage,
            loss: mean(since.loss),
            losses: since.losses.iter().map(|(name, sum)| (name.into(), mean(*sum))).collect(),
            psnr: -10.0 * mean(since.squared_error).log10(),
            rays: self.rays,
            samples: self.samples,
            figures: figures(facts, &report.rates),
            validation_psnr,
            seconds,
        };
        let scalars = line.scalars(&self.known);
        self.events.scalars(line.step, scalars.iter().map(|(name, value)| (name.as_ref(), *value)))?;
        self.known.add(&line);
        self.append(&line)
    }

    /// Appends the last line, with the final figures. `figures` are also written for TensorBoard.
    ///
    /// Errors: the file cannot be written.
    pub fn conclude(&mut self, line: &impl Serialize, figures: &[(&str, Option<f64>)]) -> Result<()> {
        self.append(line)?;
        self.events.scalars(self.known.step, figures.iter().filter_map(|(name, value)| Some((*name, (*value)?))))
    }

    /// Adds a picture for TensorBoard after a step: a PNG file of `(width, height)` pixels.
    ///
    /// Errors: the picture cannot be read, or the events cannot be written.
    pub fn picture(&mut self, step: u64, size: (usize, usize), png: &Path) -> Result<()> {
        let bytes = files::read(png, files::IMAGE)?;
        self.events.image(step, "preview", size, &bytes)
    }

    /// Syncs the lines to disk.
    ///
    /// Errors: they cannot be written.
    pub fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(|e| Error::io(&self.path, e, "writing the metrics"))
    }

    /// Appends any line.
    ///
    /// Errors: the file cannot be written.
    pub fn append(&mut self, line: &impl Serialize) -> Result<()> {
        let text = json::line(line)? + "\n";
        let written = self.file.write_all(text.as_bytes());
        written.map_err(|e| Error::io(&self.path, e, "writing the metrics"))
    }

    /// Returns the rays and samples since the start of training.
    pub fn counts(&self) -> (u64, u64) {
        (self.rays, self.samples)
    }

    /// Returns the last and the best validation PSNR.
    pub fn validation(&self) -> (Option<f64>, Option<Best>) {
        (self.known.validation_psnr, self.known.best)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(losses: &str, figures: &str) -> String {
        format!(
            r#"{{"step":7,"stage":0,"resolution":16,"ends_stage":false,"loss":0.25,"losses":{{{losses}}},"psnr":12.5,"rays":9,"samples":99,{figures}"seconds":1.5}}"#
        )
    }

    #[test]
    fn a_truncated_or_damaged_line_is_counted_and_other_lines_are_not() {
        let good = line(r#""mse":0.2"#, "");
        let text = format!("{good}\n{{\"step\":8,\n{{\"step\":\"8\"}}\n7\n{{\"final\":{{\"psnr\":1}}}}\n{good}\n{}", &good[..20]);
        let (lines, unreadable) = of_steps(&text);
        assert_eq!((lines.len(), unreadable), (2, 4));
    }

    #[test]
    fn the_memory_of_parsed_lines_is_not_less_than_their_parts_have() {
        let figures = r#""voxels":7,"density_rate":1.0,"color_rate":0.03,"#;
        let text = line(r#""mse":0.2,"tv":0.1"#, figures) + "\n";
        let one = parsed_bytes(text.repeat(2).as_bytes()) - parsed_bytes(text.as_bytes()) - text.len() as u64;
        // A node of each map, and the names of three figures.
        let least = (size_of::<Line<'_>>() + 11 * (24 + 8) + 11 * (24 + 16) + 3 * 32) as u64;
        assert!((least..2 * least).contains(&one), "{one} for {least}");
        let many = parsed_bytes(text.repeat(1000).as_bytes());
        assert!(many >= 1000 * (least + text.len() as u64) && lines(&text.repeat(3)).count() == 3, "{many}");
        // Thousands in a line, half of the nodes' places empty.
        let names = (0..3000).map(|i| format!("\"l{i}\":1")).collect::<Vec<_>>().join(",");
        assert!(parsed_bytes(line(&names, "").as_bytes()) >= 3000 * 64);
        let names = (0..3000).map(|i| format!("\"l{i}\":1,")).collect::<String>();
        assert!(parsed_bytes(line("", &names).as_bytes()) >= 3000 * (32 + 80 + 128));
    }
}
