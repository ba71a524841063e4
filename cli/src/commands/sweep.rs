//! `plenoxel sweep`: a list of scenes with a list of methods, and the table of what came of it.

mod child;
mod flags;
mod job;
mod plan;

use super::table::{Cell, Failure, Published, Row, RunTable};
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
  plenoxel sweep nerf.toml                   into sweeps/nerf; the same again goes on with the rest
  plenoxel sweep nerf.toml --dry-run
  plenoxel sweep nerf.toml --scene data/lego --scene data/chair   its methods with other scenes

A file of scenes and methods, every scene with every method. Keys are flags of train (or carve):
downscale = 4 for --downscale 4. Those of a method count more than those of a scene. Paths are
relative to the file:

  [[scenes]]
  data = \"../data/lego\"                      # its name is lego, unless name = \"...\" says another
  downscale = 4

  [[scenes]]
  name = \"small\"                             # without data: the built-in scene
  scene_size = 100
  methods = [\"fast\"]                         # not all of them

  [[methods]]
  preset = \"fast\"

  [[methods]]
  name = \"paper-tv\"
  preset = \"paper\"
  set = [\"losses.tv_density=5e-5\", \"losses.tv_color=5e-5\"]

  [[methods]]
  name = \"hull\"
  command = \"carve\"
  evaluate_downscale = 8                     # test views at another size than the run

  [[published]]                              # a column of figures that are not measured here
  name = \"Plenoxels\"
  source = \"Fridovich-Keil et al. 2022, at 800 x 800\"
  psnr = { lego = 34.10 }                    # ssim and seconds likewise

Runs are in OUT/SCENE/METHOD, what they said beside them in METHOD.log. The table is table.md (on
stdout too), table.csv with all figures, and table.html with pictures. After Ctrl-C the same command
goes on; what failed it tries again. The exit code is that of the first run that failed, or 0.";

/// Run a list of scenes with a list of methods, whatever of it is not finished, and print the table scene x method
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true, group = ArgGroup::new("methods").required(true))]
pub struct SweepArgs {
    /// TOML file with scenes and methods, as below; or say them with --scene and --preset
    #[arg(value_hint = ValueHint::FilePath, group = "methods")]
    file: Option<PathBuf>,

    /// Folder of a dataset, or procedural, the built-in scene; may be repeated. With FILE, these scenes replace those of the file; the name of a
    /// scene of the file selects that scene
    #[arg(long, value_name = "DATA")]
    scene: Vec<String>,

    /// Train with this preset; may be repeated
    #[arg(long, group = "methods", requires_all = ["scene", "out"], value_parser = PossibleValuesParser::new(PRESETS.map(|preset| preset.name)))]
    preset: Vec<String>,

    /// Folder to write [default: sweeps/<name of the file>]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,

    /// Overwrite runs in it that have other settings than are asked for now
    #[arg(long, help_heading = "Output")]
    force: bool,

    /// Say what would run and what is finished, and do nothing
    #[arg(long, help_heading = "Output")]
    dry_run: bool,

    /// Set any key of the configuration, for all runs; may be repeated
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Settings")]
    set: Vec<String>,
}

/// File that is locked while a sweep is made; a folder that has it is that of a sweep.
const LOCK: &str = "sweep.lock";

/// Refuses a folder that holds something else: a run, a dataset.
fn check_place(out: &Path) -> Result<()> {
    let holds = |name: &str| out.join(name).exists();
    let is_empty = std::fs::read_dir(out).map_or(true, |mut entries| entries.next().is_none());
    if is_empty || ((holds(LOCK) || holds("table.csv")) && !holds("run.json")) {
        return Ok(());
    }
    let found = format!("{} is not empty, and not the folder of a sweep", out.display());
    Err(Error::config("--out", found, "a new folder, or that of a sweep"))
}

/// Makes the runs that are not finished, and the table of all. `machine` are flags that each run is to have. Returns the exit code.
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
    // A child is asked too, and saves; the sweep waits for it.
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
        console.error("interrupted; the same command again goes on with what is not finished", EXIT_CODE);
        return Ok(EXIT_CODE);
    }
    let Some((first, failure)) = failed.first() else { return Ok(0) };
    let (count, of, log) = (failed.len(), plan.jobs.len(), first.log());
    console.error(
        &format!("{count} of {of} runs failed, the first as {} tells; the same command again tries once more", log.display()),
        failure.code,
    );
    Ok(failure.code)
}

/// One run among all.
struct Sweep<'a, 'c> {
    program: &'a Program,
    watch: &'a Watch,
    console: &'a Console<'c>,
    index: usize,
    of: usize,
}

impl Sweep<'_, '_> {
    /// Does what is missing of a run, and returns how it failed, if it did.
    fn finish(&self, job: &Job) -> Result<Option<Failure>> {
        job.forget()?;
        let state = job.state();
        if state == State::Finished {
            self.note(job, &format!("finished already: {}", said(job)));
            return Ok(None);
        }
        job.folder.parent().map_or(Ok(()), files::create_dir)?;
        if !matches!(state, State::Interrupted | State::Unevaluated) {
            job.remove_log()?;
        }
        if let Some(arguments) = job.command_line(&state) {
            self.note(job, if state == State::Interrupted { "going on" } else { "begins" });
            if let Err(failure) = self.process(job, &arguments)? {
                return Ok(Some(failure));
            }
        }
        if job.state() == State::Unevaluated {
            // The command keeps its figures in the folder.
            if let Err(failure) = self.process(job, &job.evaluation())? {
                return Ok(Some(failure));
            }
        }
        self.note(job, &said(job));
        Ok(None)
    }

    /// Has the program called, and returns what it said on stdout, or how it failed.
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

/// What came of a run, in few words.
fn said(job: &Job) -> String {
    match job.cell() {
        Cell::Measured(measured) => measured.sentence(),
        Cell::Failed(_) | Cell::Missing => "no figures".to_owned(),
    }
}

/// Refuses to go on where a run with other settings is in the way.
fn check(job: &Job, state: &State) -> Result<()> {
    match state {
        State::Different(how) => {
            let found = format!("{} has a run with other settings ({how})", job.folder.display());
            Err(Error::config("--out", found, "a folder of its own for each sweep; or --force, which overwrites such runs"))
        }
        _ => Ok(()),
    }
}

/// Says what would be done about a run, and with which command.
fn describe(job: &Job, state: &State, console: &Console<'_>) -> Result<()> {
    let what = match (state, job.cell()) {
        (State::Finished, _) => format!("finished: {}", said(job)),
        (State::Different(how), _) => format!("in the way is another run: {how}"),
        (State::Unevaluated, _) => "to evaluate".to_owned(),
        (State::Interrupted, _) => "to go on with".to_owned(),
        (_, Cell::Failed(failure)) => format!("to run again, it failed with exit code {}: {}", failure.code, failure.error),
        (State::New | State::CutShort, _) => "to run".to_owned(),
    };
    console.result(&format!("{} {}: {what}", job.scene, job.method))?;
    let arguments = job.command_line(state);
    arguments.iter().try_for_each(|arguments| console.result(&format!("    {}", child::command_line(arguments))))
}

/// The table of what there is now.
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
