//! `plenoxel sweep`: runs a list of scenes with a list of methods, and writes a table of the results.

mod child;
mod flags;
mod job;
mod local;
mod plan;
mod slurm;

use super::table::{Cell, Published, Row, RunTable};
use crate::Machine;
use crate::child::command_line;
use crate::interrupt::{EXIT_CODE, Watch};
use crate::progress::Console;
use child::Program;
use clap::builder::PossibleValuesParser;
use clap::{ArgGroup, Args, ValueEnum, ValueHint};
use job::{Job, State};
use local::Runner;
use plan::Plan;
use plenoxel::error::{Error, Result};
use plenoxel::files::{self, FolderLock};
use plenoxel::run::settings::{self, PRESETS};
use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel sweep --scene data/lego --scene procedural --preset fast --preset paper --out sweeps/first
  plenoxel sweep nerf.toml                   run the sweep in sweeps/nerf, or resume it
  plenoxel sweep nerf.toml --dry-run         list the runs and their states
  plenoxel sweep nerf.toml --jobs 4          make four runs at the same time
  plenoxel sweep nerf.toml --engine slurm --threads 8 --slurm partition=long
                                             submit a job array with one run in each task, and a job
                                             after it that writes the table
  plenoxel sweep nerf.toml --status          list what is finished, running, queued or failed
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
are forwarded to the current runs, which save their states. Repeat the command to resume the sweep
and to retry failed runs. The exit code is that of the first failed run, or 0.

With Slurm, the sweep folder must be on a file system that all nodes share. Its subfolder slurm has
the scripts and the output of the tasks. A task has the CPUs of --threads (without it 2), 1.5 times
the estimated memory, and, if all runs have --time, twice that time and half an hour. Options of
--slurm replace these. A task that Slurm requeues resumes its run.";

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
    #[arg(long, help_heading = "Output", group = "instead")]
    dry_run: bool,

    /// List the runs with their states: finished, running, queued, failed
    #[arg(long, help_heading = "Output", group = "instead")]
    status: bool,

    /// Write the table of the current results, without running anything
    #[arg(long, help_heading = "Output", group = "instead")]
    table: bool,

    /// Make the runs on this machine, or submit them to Slurm as a job array
    #[arg(long, help_heading = "Machine", value_enum, default_value_t = Engine::Local)]
    engine: Engine,

    /// Number of runs at the same time; on this machine, they share its threads [default: 1; with Slurm, no limit]
    #[arg(long, help_heading = "Machine", value_name = "N", value_parser = super::whole::<usize>(1, MOST_TOGETHER), allow_negative_numbers = true)]
    jobs: Option<usize>,

    /// Option of sbatch for the runs, such as partition=long, time=4:00:00 or exclusive; may be repeated
    #[arg(long, help_heading = "Machine", value_name = "KEY=VALUE")]
    slurm: Vec<String>,

    /// Make only this run, without the lock of the sweep and without a table: for the tasks of a job array
    #[arg(long, help_heading = "Machine", value_name = "SCENE/METHOD", group = "instead", conflicts_with_all = ["engine", "jobs", "slurm"])]
    task: Option<String>,

    /// Set any key of the configuration of all runs; may be repeated
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Settings")]
    set: Vec<String>,
}

/// The runs are made on this machine, or by Slurm.
#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
enum Engine {
    Local,
    Slurm,
}

/// Largest number of runs at the same time.
const MOST_TOGETHER: u64 = 1024;

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

/// Makes the unfinished runs, or submits them, and writes the table. Returns the exit code.
pub fn run(args: &SweepArgs, machine: &Machine, console: &Console<'_>) -> Result<u8> {
    let named = args.file.as_deref().and_then(Path::file_stem).unwrap_or_default();
    let out = args.out.clone().unwrap_or_else(|| Path::new("sweeps").join(named));
    let plan = match &args.file {
        Some(file) => Plan::from_file(file, &args.scene, &args.set, &out)?,
        None => Plan::from_flags(&args.scene, &args.preset, &args.set, &out)?,
    };
    if let Some(name) = &args.task {
        return task(args, &plan, name, machine, console);
    }
    let states: Vec<State> = plan.jobs.iter().map(Job::state).collect();
    let slurm = match args.engine {
        Engine::Local if !args.slurm.is_empty() => {
            return Err(Error::usage("--slurm", "the runs of this sweep are made on this machine", "add --engine slurm"));
        }
        Engine::Local => None,
        Engine::Slurm => Some(slurm::Submission {
            out: &out,
            jobs: plan.jobs.iter().zip(&states).filter(|(_, state)| **state != State::Finished).map(|(job, _)| job).collect(),
            sweep: args.command_line(&out, machine),
            threads: machine.threads,
            together: args.jobs,
            options: slurm::options(&args.slurm)?,
        }),
    };
    if args.status || args.dry_run {
        let queued = if args.status { slurm::queued(&out) } else { BTreeMap::new() };
        plan.jobs.iter().zip(&states).try_for_each(|(job, state)| describe(job, state, &queued, args.dry_run, console))?;
        return slurm
            .filter(|slurm| args.dry_run && !slurm.jobs.is_empty())
            .map_or(Ok(0), |slurm| console.text(&slurm.describe()?).map(|()| 0));
    }
    if !args.force {
        plan.jobs.iter().zip(&states).try_for_each(|(job, state)| check(job, state))?;
    }
    check_place(&out)?;
    files::create_dir(&out)?;
    let lock = FolderLock::acquire(&out, LOCK, "--out")?;
    if args.table {
        return write_table(&plan, &out, console).map(|()| 0);
    }
    check_queue(&out)?;
    match slurm {
        Some(submission) if submission.jobs.is_empty() => write_table(&plan, &out, console).map(|()| 0),
        Some(submission) => {
            let submitted = submission.submit()?;
            let (runs, array, table) = (submitted.runs.len(), submitted.array, submitted.table);
            console.note(&format!(
                "submitted {runs} runs as job {array}, and the table as job {table}; --status lists them, scancel {array} cancels them"
            ));
            Ok(0)
        }
        None => make(&plan, &out, args.jobs.unwrap_or(1), Program::new(machine, args.jobs.unwrap_or(1), lock)?, console),
    }
}

/// Makes the unfinished runs on this machine, and writes the table. Returns the exit code.
fn make(plan: &Plan, out: &Path, together: usize, program: Program, console: &Console<'_>) -> Result<u8> {
    // Signals are forwarded to the children, which save their states. The sweep waits for them.
    let watch = Watch::begin();
    let failed = Runner::new(&program, &watch, console, plan.jobs.len()).finish_all(&plan.jobs, together)?;
    let interrupted = watch.requested();
    drop(watch);
    write_table(plan, out, console)?;
    if interrupted {
        return Ok(stopped(console));
    }
    let Some((first, failure)) = failed.first() else { return Ok(0) };
    let (count, of, log) = (failed.len(), plan.jobs.len(), first.log());
    console.error(
        &format!("{count} of {of} runs failed, see {} for the first one; repeat the command to retry them", log.display()),
        failure.code,
    );
    Ok(failure.code)
}

/// Makes one run of the sweep, and returns the exit code. Others may make other runs meanwhile.
fn task(args: &SweepArgs, plan: &Plan, name: &str, machine: &Machine, console: &Console<'_>) -> Result<u8> {
    let names: Vec<String> = plan.jobs.iter().map(Job::name).collect();
    let index = names.iter().position(|known| known == name).ok_or_else(|| {
        let known: Vec<&str> = names.iter().map(String::as_str).collect();
        settings::unknown_name("run", name, &known, "--task")
    })?;
    let job = &plan.jobs[index];
    if !args.force {
        check(job, &job.state())?;
    }
    files::create_dir(job.place())?;
    let program = Program::new(machine, 1, FolderLock::acquire(job.place(), &job.lock(), "--task")?)?;
    let watch = Watch::begin();
    let failure = Runner::new(&program, &watch, console, plan.jobs.len()).finish(job, index)?;
    if watch.requested() {
        return Ok(stopped(console));
    }
    Ok(failure.map_or(0, |failure| failure.code))
}

/// Says that the sweep was interrupted, and returns the exit code.
fn stopped(console: &Console<'_>) -> u8 {
    console.error("interrupted; repeat the command to resume the sweep", EXIT_CODE);
    EXIT_CODE
}

/// Writes the table of the current results.
fn write_table(plan: &Plan, out: &Path, console: &Console<'_>) -> Result<()> {
    console.text(table(plan, out).write(out)?.trim_end())?;
    console.note(&format!("table: {}", out.join("table.html").display()));
    Ok(())
}

/// Checks that Slurm has no runs of an earlier submission.
fn check_queue(out: &Path) -> Result<()> {
    let queued = slurm::queued(out);
    let Some((run, state)) = queued.first_key_value() else { return Ok(()) };
    let found = format!("Slurm still has {} of its runs: {run} is {state}", queued.len());
    Err(Error::usage("--out", found, "wait until they have ended (--status lists them), or cancel them with scancel"))
}

impl SweepArgs {
    /// The command line of the same sweep, on another machine with the same file system.
    fn command_line(&self, out: &Path, machine: &Machine) -> Vec<OsString> {
        let flag = |name: &str, value: &OsStr| {
            let mut flag = OsString::from(format!("--{name}="));
            flag.push(value);
            flag
        };
        let machine = machine.flags(1).into_iter().map(OsString::from);
        let scenes = self.scene.iter().map(|scene| flag("scene", scene.as_ref()));
        let presets = self.preset.iter().map(|preset| flag("preset", preset.as_ref()));
        let set = self.set.iter().map(|set| flag("set", set.as_ref()));
        let force = self.force.then(|| OsString::from("--force"));
        let file = self.file.iter().map(|file| file.clone().into_os_string());
        machine
            .chain(["sweep".into()])
            .chain(scenes)
            .chain(presets)
            .chain(set)
            .chain(force)
            .chain([flag("out", out.as_os_str())])
            .chain(file)
            .collect()
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

/// Prints the state of a run, and what Slurm says about it. With `command`, also prints the command that completes it.
fn describe(job: &Job, state: &State, queued: &BTreeMap<String, String>, command: bool, console: &Console<'_>) -> Result<()> {
    let what = match (state, job.cell()) {
        (State::Finished, _) => format!("finished: {}", said(job)),
        (State::Different(how), _) => format!("blocked by a run with other settings: {how}"),
        _ if job.is_running() => format!("running: {}", job.last_line()),
        (State::Unevaluated, _) => "to evaluate".to_owned(),
        (State::Interrupted, _) => "to resume".to_owned(),
        (_, Cell::Failed(failure)) => format!("to retry, failed with exit code {}: {}", failure.code, failure.error),
        (State::New | State::CutShort, _) => "to run".to_owned(),
    };
    let queue = queued.get(&job.name()).map_or(String::new(), |queue| format!("; Slurm: {queue}"));
    console.result(&format!("{} {}: {what}{queue}", job.scene, job.method))?;
    let arguments = job.command_line(state).filter(|_| command);
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
