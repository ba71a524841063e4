//! `plenoxel sweep`: runs a list of scenes with a list of methods, and writes a table of the results.

mod child;
mod flags;
mod job;
mod plan;

use super::table::{Cell, Failure, Published, Row, RunTable};
use crate::child::command_line;
use crate::interrupt::{EXIT_CODE, Watch};
use crate::progress::Console;
use child::Program;
use clap::builder::PossibleValuesParser;
use clap::{ArgGroup, Args, ValueHint};
use job::{Job, State};
use plan::Plan;
use plenoxel::error::{Error, Result};
use plenoxel::files::{self, FolderLock};
use plenoxel::run::settings::PRESETS;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel sweep --scene data/lego --scene procedural --preset fast --preset paper --out sweeps/first
  plenoxel sweep nerf.toml                   run the sweep in sweeps/nerf, or resume it
  plenoxel sweep nerf.toml --dry-run         list the runs and their states
  plenoxel sweep nerf.toml --scene data/lego --scene data/chair    run its methods on other scenes

The TOML file lists scenes and methods. Every scene is run with every method. Keys are flags of train
or carve: downscale = 4 means --downscale 4. Keys of a method override those of a scene. Paths are
relative to the file. Example:

  [[scenes]]
  data = \"../data/lego\"                      # the name is lego, or that of the key `name`
  downscale = 4

  [[scenes]]
  name = \"small\"                             # the built-in scene, because there is no `data`
  scene_size = 100
  methods = [\"fast\"]                         # only these methods

  [[methods]]
  preset = \"fast\"

  [[methods]]
  name = \"paper-tv\"
  preset = \"paper\"
  set = [\"losses.tv_density=5e-5\", \"losses.tv_color=5e-5\"]

  [[methods]]
  name = \"hull\"
  command = \"carve\"
  evaluate_downscale = 8                     # downscale factor of the evaluation

  [[published]]                              # a column with published results
  name = \"Plenoxels\"
  source = \"Fridovich-Keil et al. 2022, at 800 x 800\"
  psnr = { lego = 34.10 }                    # also: ssim, seconds

Run folders are OUT/SCENE/METHOD, with the log next to them in METHOD.log. The table is written to
table.md (and stdout), table.csv with all results, and table.html with pictures. SIGINT and SIGTERM
are forwarded to the current run, which saves its state. Repeat the command to resume the sweep and
to retry failed runs. The exit code is that of the first failed run, or 0.";

/// Run every scene of a list with every method, skip finished runs, and print a table of the results
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true, group = ArgGroup::new("methods").required(true))]
pub struct SweepArgs {
    /// TOML file with scenes and methods, described below; alternatively, use --scene and --preset
    #[arg(value_hint = ValueHint::FilePath, group = "methods")]
    file: Option<PathBuf>,

    /// Dataset folder, or `procedural` for the built-in scene; may be repeated. With FILE, these scenes replace those of the file, and the name of a
    /// scene in the file selects that scene
    #[arg(long, value_name = "DATA")]
    scene: Vec<String>,

    /// Train with this preset; may be repeated
    #[arg(long, group = "methods", requires_all = ["scene", "out"], value_parser = PossibleValuesParser::new(PRESETS.map(|preset| preset.name)))]
    preset: Vec<String>,

    /// Sweep folder to write [default: sweeps/<name of the file>]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,

    /// Overwrite existing runs with other settings
    #[arg(long, help_heading = "Output")]
    force: bool,

    /// List the runs with their states and commands, without running them
    #[arg(long, help_heading = "Output")]
    dry_run: bool,

    /// Set any key of the configuration of all runs; may be repeated
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Settings")]
    set: Vec<String>,
}

/// Lock file of a sweep folder, by which it is recognized.
const LOCK: &str = "sweep.lock";

/// Checks that a folder is empty or a sweep folder.
fn check_place(out: &Path) -> Result<()> {
    let holds = |name: &str| out.join(name).exists();
    let is_empty = std::fs::read_dir(out).map_or(true, |mut entries| entries.next().is_none());
    if is_empty || ((holds(LOCK) || holds("table.csv")) && !holds("run.json")) {
        return Ok(());
    }
    let found = format!("{} is not empty and not a sweep folder", out.display());
    Err(Error::usage("--out", found, "choose a new folder or a sweep folder"))
}

/// Makes the unfinished runs, and writes the table. `machine` are additional flags for each run. Returns the exit code.
pub fn run(args: &SweepArgs, machine: &[String], console: &Console<'_>) -> Result<u8> {
    let named = args.file.as_deref().and_then(Path::file_stem).unwrap_or_default();
    let out = args.out.clone().unwrap_or_else(|| Path::new("sweeps").join(named));
    let plan = match &args.file {
        Some(file) => Plan::from_file(file, &args.scene, &args.set, &out)?,
        None => Plan::from_flags(&args.scene, &args.preset, &args.set, &out)?,
    };
    let states: Vec<State> = plan.jobs.iter().map(Job::state).collect();
    if args.dry_run {
        return plan.jobs.iter().zip(&states).try_for_each(|(job, state)| describe(job, state, console)).map(|()| 0);
    }
    if !args.force {
        plan.jobs.iter().zip(&states).try_for_each(|(job, state)| check(job, state))?;
    }
    check_place(&out)?;
    files::create_dir(&out)?;
    let program = Program { path: child::this_program()?, machine: machine.to_vec(), lock: FolderLock::acquire(&out, LOCK, "--out")? };
    // Signals are forwarded to the child, which saves its state. The sweep waits for it.
    let watch = Watch::begin();
    let (mut failed, mut interrupted) = (Vec::new(), false);
    for (index, job) in plan.jobs.iter().enumerate() {
        let sweep = Sweep { program: &program, watch: &watch, console, index, of: plan.jobs.len() };
        let failure = sweep.finish(job)?;
        interrupted = watch.requested();
        if interrupted {
            break;
        }
        if let Some(failure) = failure {
            job.remember(&failure)?;
            failed.push((job, failure));
        }
    }
    drop(watch);
    console.text(table(&plan, &out).write(&out)?.trim_end())?;
    console.note(&format!("table: {}", out.join("table.html").display()));
    if interrupted {
        console.error("interrupted; repeat the command to resume the sweep", EXIT_CODE);
        return Ok(EXIT_CODE);
    }
    let Some((first, failure)) = failed.first() else { return Ok(0) };
    let (count, of, log) = (failed.len(), plan.jobs.len(), first.log());
    console.error(
        &format!("{count} of {of} runs failed, see {} for the first one; repeat the command to retry them", log.display()),
        failure.code,
    );
    Ok(failure.code)
}

/// The context of a run in a sweep.
struct Sweep<'a, 'c> {
    program: &'a Program,
    watch: &'a Watch,
    console: &'a Console<'c>,
    index: usize,
    of: usize,
}

impl Sweep<'_, '_> {
    /// Completes a run. Returns its failure, if it failed.
    fn finish(&self, job: &Job) -> Result<Option<Failure>> {
        job.forget()?;
        let state = job.state();
        if state == State::Finished {
            self.note(job, &format!("already finished: {}", said(job)));
            return Ok(None);
        }
        job.folder.parent().map_or(Ok(()), files::create_dir)?;
        if !matches!(state, State::Interrupted | State::Unevaluated) {
            job.remove_log()?;
        }
        if let Some(arguments) = job.command_line(&state) {
            self.note(job, if state == State::Interrupted { "resuming" } else { "starting" });
            if let Err(failure) = self.process(job, &arguments)? {
                return Ok(Some(failure));
            }
        }
        if job.state() == State::Unevaluated {
            // The command writes the scores to the run folder.
            if let Err(failure) = self.process(job, &job.evaluation())? {
                return Ok(Some(failure));
            }
        }
        self.note(job, &said(job));
        Ok(None)
    }

    /// Runs the program, and returns its output on stdout, or its failure.
    fn process(&self, job: &Job, arguments: &[OsString]) -> Result<std::result::Result<String, Failure>> {
        let progress = self.console.relay(self.of);
        let ended = self.program.run(arguments, &job.log(), self.watch, |line| progress.say(self.index, || self.line(job, line)))?;
        drop(progress);
        if ended.code == 0 {
            return Ok(Ok(ended.out));
        }
        let failure = Failure { code: ended.code, error: ended.last };
        if !self.watch.requested() {
            self.note(job, &format!("failed with exit code {}: {}", failure.code, failure.error));
        }
        Ok(Err(failure))
    }

    fn note(&self, job: &Job, text: &str) {
        self.console.note(&self.line(job, text));
    }

    fn line(&self, job: &Job, text: &str) -> String {
        format!("{}/{} {} {}: {text}", self.index + 1, self.of, job.scene, job.method)
    }
}

/// A short summary of the results of a run.
fn said(job: &Job) -> String {
    match job.cell() {
        Cell::Measured(measured) => measured.sentence(),
        Cell::Failed(_) | Cell::Missing => "no results".to_owned(),
    }
}

/// Checks that the folder of a run has no run with other settings.
fn check(job: &Job, state: &State) -> Result<()> {
    match state {
        State::Different(how) => {
            let found = format!("{} is a run with other settings ({how})", job.folder.display());
            Err(Error::usage("--out", found, "choose another folder for this sweep, or overwrite the run with --force"))
        }
        _ => Ok(()),
    }
}

/// Prints the state of a run, and the command that completes it.
fn describe(job: &Job, state: &State, console: &Console<'_>) -> Result<()> {
    let what = match (state, job.cell()) {
        (State::Finished, _) => format!("finished: {}", said(job)),
        (State::Different(how), _) => format!("blocked by a run with other settings: {how}"),
        (State::Unevaluated, _) => "to evaluate".to_owned(),
        (State::Interrupted, _) => "to resume".to_owned(),
        (_, Cell::Failed(failure)) => format!("to retry, failed with exit code {}: {}", failure.code, failure.error),
        (State::New | State::CutShort, _) => "to run".to_owned(),
    };
    console.result(&format!("{} {}: {what}", job.scene, job.method))?;
    let arguments = job.command_line(state);
    arguments.iter().try_for_each(|arguments| console.result(&format!("    {}", command_line("plenoxel", arguments))))
}

/// The table of the current results.
fn table(plan: &Plan, out: &Path) -> RunTable {
    let cell = |scene: &String, method: &String| {
        let job = plan.jobs.iter().find(|job| job.scene == *scene && job.method == *method);
        job.map_or(Cell::Missing, Job::cell)
    };
    let is_shown = |published: &Published| published.scenes().iter().any(|scene| plan.scenes.contains(scene));
    let row = |scene: &String| Row { scene: scene.clone(), cells: plan.methods.iter().map(|method| cell(scene, method)).collect() };
    RunTable {
        title: format!("Sweep {}", out.file_name().unwrap_or_default().to_string_lossy()),
        methods: plan.methods.clone(),
        rows: plan.scenes.iter().map(row).collect(),
        published: plan.published.iter().filter(|published| is_shown(published)).cloned().collect(),
        elsewhere: plan.published.iter().filter(|published| !is_shown(published)).cloned().collect(),
    }
}
