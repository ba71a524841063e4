//! Sweeps on a cluster: a job array of Slurm with one run in each task, and a job after it that writes the table.
//!
//! The run folders on the shared file system are the only state: a task that is requeued, or an array that is submitted again, resumes the runs that have begun.
//! Only the numbers of the last jobs are kept, for the question whether they are still queued.

use super::job::Job;
use crate::child::command_line;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::json;
use plenoxel::run::memory::Estimate;
use plenoxel::run::training::RunOptions;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

/// CPUs of a task without `--threads`: the recipes were chosen on two cores.
const CPUS: usize = 2;
/// Memory of a task, relative to the estimates, which are for typical scenes.
const MEMORY_MARGIN: f64 = 1.5;
/// Time limit of a task relative to `--time`, and what is added: evaluation and page need as long as training or less, on slow file systems more.
const TIME_MARGIN: f64 = 2.0;
const MINUTES_BESIDE_TRAINING: f64 = 30.0;
/// Options of sbatch that a sweep sets, and no flag may change.
const RESERVED: [&str; 6] = ["array", "dependency", "output", "open-mode", "parsable", "wrap"];
/// Options that say where jobs may run and who pays; the job that writes the table has them too.
const PLACES: [&str; 5] = ["account", "clusters", "partition", "qos", "reservation"];

/// The jobs of the last submission.
#[derive(Debug, Serialize, Deserialize)]
pub struct Submitted {
    /// Number of the job array.
    pub array: String,
    /// Number of the job that writes the table.
    pub table: String,
    /// Runs of the tasks, as SCENE/METHOD. The first task has number 1.
    pub runs: Vec<String>,
}

/// A sweep that is submitted to Slurm.
pub struct Submission<'a> {
    /// Folder of the sweep.
    pub out: &'a Path,
    /// Its unfinished runs.
    pub jobs: Vec<&'a Job>,
    /// Command line of the sweep, without the flags of one engine.
    pub sweep: Vec<OsString>,
    /// Threads of a run.
    pub threads: Option<usize>,
    /// Largest number of runs at the same time.
    pub together: Option<usize>,
    /// Additional options of sbatch.
    pub options: BTreeMap<String, Option<String>>,
}

/// Parses `KEY=VALUE` or `KEY`, an option of sbatch without its dashes.
pub fn options(given: &[String]) -> Result<BTreeMap<String, Option<String>>> {
    let option = |text: &String| {
        let (key, value) = text.split_once('=').map_or((text.as_str(), None), |(key, value)| (key, Some(value)));
        if key.is_empty() || !key.chars().all(|c| c.is_ascii_lowercase() || c == '-') || key.starts_with('-') {
            let expected = "a long option of sbatch without dashes, such as partition=long, time=4:00:00 or exclusive";
            return Err(Error::config("--slurm", format!("`{text}`"), expected));
        }
        if RESERVED.contains(&key) {
            let remedy = "leave it out; --jobs limits the number of runs at the same time";
            return Err(Error::usage("--slurm", format!("`{key}` is set by the sweep"), remedy));
        }
        Ok((key.to_owned(), value.map(str::to_owned)))
    };
    given.iter().map(option).collect()
}

impl Submission<'_> {
    fn folder(&self) -> PathBuf {
        folder(self.out)
    }

    /// The script of a task.
    fn task(&self) -> Result<String> {
        let list = command_line("cat", &[self.folder().join("runs")]);
        let call = self.call("--task")?;
        Ok(format!(
            "#!/bin/sh\n# A task of a job array: makes one run of the sweep. Signals reach the program, which saves the run.\nrun=$({list} | sed -n \"${{SLURM_ARRAY_TASK_ID}}p\")\n{call} \"$run\"\n"
        ))
    }

    /// The script of the job that writes the table.
    fn table(&self) -> Result<String> {
        Ok(format!("#!/bin/sh\n# Writes the table of the results.\n{}\n", self.call("--table")?))
    }

    /// The line of a script that becomes the sweep with one more flag. The program is named by its path, for other machines that share its file system.
    fn call(&self, flag: &str) -> Result<String> {
        let program = std::env::current_exe().map_err(|e| Error::io("plenoxel", e, "finding this program"))?;
        Ok(command_line("exec", &[&[program.into()], &self.sweep[..], &[flag.into()]].concat()))
    }

    /// Arguments of sbatch for the job array.
    fn of_array(&self) -> Result<Vec<OsString>> {
        let mut options = BTreeMap::from([
            ("job-name".to_owned(), Some(self.name())),
            ("cpus-per-task".to_owned(), Some(self.threads.unwrap_or(CPUS).to_string())),
            ("requeue".to_owned(), None),
        ]);
        if !self.options.keys().any(|key| key.starts_with("mem")) {
            let bytes = self.jobs.iter().map(|job| bytes_of(job)).try_fold(0, |most, bytes| bytes.map(|bytes| bytes.max(most)))?;
            options.insert("mem".to_owned(), Some(format!("{}M", (MEMORY_MARGIN * bytes as f64 / f64::from(1 << 20)).ceil())));
        }
        // Without a plan by time, the limit is that of the partition.
        let times: Option<Vec<f64>> = self.jobs.iter().map(|job| job.asked.time).collect();
        if let Some(longest) = times.and_then(|times| times.into_iter().reduce(f64::max)) {
            let minutes = (TIME_MARGIN * longest / 60.0).ceil() + MINUTES_BESIDE_TRAINING;
            options.insert("time".to_owned(), Some(minutes.to_string()));
        }
        options.extend(self.options.clone());
        let limit = self.together.map_or(String::new(), |together| format!("%{together}"));
        let array = format!("--array=1-{}{limit}", self.jobs.len());
        let output = self.folder().join("%A_%a.out");
        Ok(self.sbatch(options.iter(), &output, "task.sh", vec![array.into(), "--open-mode=append".into()]))
    }

    /// Arguments of sbatch for the job that writes the table after an array.
    fn of_table(&self, array: &str) -> Vec<OsString> {
        let own = [
            ("cpus-per-task", "1".to_owned()),
            ("job-name", format!("{}-table", self.name())),
            ("mem", "1G".to_owned()),
            ("time", "30".to_owned()),
        ];
        let own: Vec<(String, Option<String>)> = own.into_iter().map(|(key, value)| (key.to_owned(), Some(value))).collect();
        let places = self.options.iter().filter(|(key, _)| PLACES.contains(&key.as_str()));
        let output = self.folder().join("table.out");
        let after = format!("--dependency=afterany:{array}");
        self.sbatch(own.iter().map(|(key, value)| (key, value)).chain(places), &output, "table.sh", vec![after.into()])
    }

    fn sbatch<'o>(
        &self,
        options: impl Iterator<Item = (&'o String, &'o Option<String>)>,
        output: &Path,
        script: &str,
        own: Vec<OsString>,
    ) -> Vec<OsString> {
        let option = |(key, value): (&String, &Option<String>)| match value {
            Some(value) => format!("--{key}={value}").into(),
            None => format!("--{key}").into(),
        };
        let mut output_flag = OsString::from("--output=");
        output_flag.push(output);
        ["--parsable".into()]
            .into_iter()
            .chain(own)
            .chain([output_flag])
            .chain(options.map(option))
            .chain([self.folder().join(script).into()])
            .collect()
    }

    fn name(&self) -> String {
        format!("plenoxel-{}", self.out.file_name().unwrap_or_default().to_string_lossy())
    }

    /// The scripts and commands, for a dry run.
    pub fn describe(&self) -> Result<String> {
        let array = command_line("sbatch", &self.of_array()?);
        let table = command_line("sbatch", &self.of_table("ARRAY"));
        Ok(format!("{array}\n\n{}\n{table}\n\n{}", self.task()?, self.table()?))
    }

    /// Writes the scripts, and submits the array and the job that writes the table.
    ///
    /// Errors: a file cannot be written; there is no Slurm; it refuses a job.
    pub fn submit(&self) -> Result<Submitted> {
        let runs: Vec<String> = self.jobs.iter().map(|job| job.name()).collect();
        files::create_dir(&self.folder())?;
        let write = |name: &str, text: &str| files::write_atomically(&self.folder().join(name), text.as_bytes());
        write("runs", &(runs.join("\n") + "\n"))?;
        write("task.sh", &self.task()?)?;
        write("table.sh", &self.table()?)?;
        let array = call("sbatch", &self.of_array()?)?;
        // Written at once: whatever fails after this, the array is known.
        let mut submitted = Submitted { array, table: String::new(), runs };
        write(SUBMITTED, &(json::line(&submitted)? + "\n"))?;
        submitted.table = call("sbatch", &self.of_table(&submitted.array))?;
        write(SUBMITTED, &(json::line(&submitted)? + "\n"))?;
        Ok(submitted)
    }
}

/// File with the last submission.
const SUBMITTED: &str = "submitted.json";

fn folder(out: &Path) -> PathBuf {
    out.join("slurm")
}

/// Estimated memory of a run.
fn bytes_of(job: &Job) -> Result<u64> {
    let (config, options) = (&job.asked.config, RunOptions::default());
    let dataset = job.asked.source.open(config)?;
    let estimate = match config.recipe() {
        _ if job.call.command == "carve" => Estimate::of_carving(config, &dataset, 0, true),
        Some(recipe) => Estimate::of_recipe(config, recipe, &dataset, &options),
        None => Estimate::of_training(&config.fitted_to(&dataset.cameras(plenoxel::dataset::Split::Train)), &dataset, None, &options),
    };
    Ok(estimate.total())
}

/// Calls a program of Slurm, and returns the first word of its answer.
fn call(program: &str, arguments: &[OsString]) -> Result<String> {
    let remedy = "submit from a machine of a Slurm cluster, or use --engine local";
    let done = Command::new(program).args(arguments).output().map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::usage("--engine slurm", format!("there is no program `{program}`"), remedy),
        _ => Error::io(program, e, "starting the program"),
    })?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_owned();
    if !done.status.success() {
        let found = format!("{program} refused the job: {}", text(&done.stderr));
        return Err(Error::usage("--engine slurm", found, "change its options with --slurm KEY=VALUE; --dry-run shows them"));
    }
    // NUMBER, or NUMBER;CLUSTER.
    Ok(text(&done.stdout).split(';').next().unwrap_or_default().to_owned())
}

/// The tasks that Slurm still has, by the name of their run: their state, and why they wait.
pub fn queued(out: &Path) -> BTreeMap<String, String> {
    let read = files::read(&folder(out).join(SUBMITTED), files::RECORD).ok();
    let Some(submitted) = read.and_then(|bytes| serde_json::from_slice::<Submitted>(&bytes).ok()) else { return BTreeMap::new() };
    let arguments = ["--noheader", "--array", "--format=%K|%T|%r", &format!("--jobs={}", submitted.array)];
    // Slurm forgets ended jobs, and then refuses their numbers.
    let answer = Command::new("squeue").args(arguments).output().ok().filter(|done| done.status.success());
    let lines = answer.map_or(String::new(), |done| String::from_utf8_lossy(&done.stdout).into_owned());
    let task = |line: &str| {
        let mut parts = line.trim().splitn(3, '|');
        let number: usize = parts.next()?.parse().ok()?;
        let (state, reason) = (parts.next()?.to_lowercase(), parts.next()?);
        let run = submitted.runs.get(number.checked_sub(1)?)?;
        let why = if reason == "None" { String::new() } else { format!(" ({reason})") };
        Some((run.clone(), format!("{state}{why}, task {}_{number}", submitted.array)))
    };
    lines.lines().filter_map(task).collect()
}
