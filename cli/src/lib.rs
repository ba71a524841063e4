//! The command line of plenoxel as a library: [`run`] takes arguments and two streams and returns an exit code, so that tests can call it
//! directly.
//!
//! Exit codes: 0 success, 2 usage or an invalid setting, 3 bad input, 4 numbers that are not finite, 5 reading or writing, 130 interrupted with
//! what is finished saved. A sweep ends with the exit code of its first failed run.
#![forbid(unsafe_code)]

mod camera_plan;
mod chart;
mod child;
mod commands;
mod curves;
mod html;
mod images;
mod interrupt;
mod live;
#[doc(hidden)]
pub mod parsers;
mod progress;
mod report;

use clap::{Args, Parser, Subcommand};
use commands::{
    bake, cameras, carve, compare, completions, evaluate, export, filter, harmonics, import, info, man, presets, render, scene, sweep,
    train, view,
};
use plenoxel::error::Error;
use plenoxel::run::data::DataSource;
use plenoxel::run::training::Listener;
use plenoxel::run::{machine, memory};
use progress::{Console, LogFormat};
use std::ffi::OsString;
use std::io::Write;
use std::path::Path;

/// Program name and version, recorded by runs.
const PROGRAM: &str = concat!("plenoxel ", env!("CARGO_PKG_VERSION"));

const EXAMPLES: &str = "\
Examples:
  plenoxel train                             train the built-in scene; needs no files
  plenoxel cameras data/photos --out data/room    compute the cameras of photographs with COLMAP
  plenoxel train data/lego --preset paper    train a NeRF-synthetic scene as in the source paper
  plenoxel carve data/lego                   carve an opaque colored grid from silhouettes
  plenoxel bake runs/field                   turn a field without voxels into a voxel grid, for exports and fast pictures
  plenoxel import ckpt.npz --out runs/lego   turn a checkpoint of svox2, or an octree of PlenOctrees, into a run
  plenoxel evaluate runs/lego-1              compute PSNR and SSIM on the test views
  plenoxel render runs/lego-1 --view 0       render a test view
  plenoxel render runs/lego-1 --path orbit   render a video along a camera path
  plenoxel view runs/lego-1                  look at the scene in a browser; `train --view` shows it while it is learned
  plenoxel report runs/lego-1                regenerate report.html, with an interactive viewer
  plenoxel export ply runs/lego-1            export the voxels as a colored point cloud
  plenoxel export mesh runs/lego-1           export the surface as a mesh
  plenoxel presets                           list presets and their training times
  plenoxel compare runs/a runs/b             compare results, curves and pictures of runs
  plenoxel harmonics                         draw the spherical harmonics, the basis of view-dependent color
  plenoxel sweep scenes.toml                 run every scene with every method and print the results

Progress is printed to stderr, results to stdout. Exit codes: 0 success, 2 usage, 3 bad input, 4 numeric failure, 5 reading or writing, \
130 interrupted (what is finished is saved).";

/// Train radiance fields from photographs with known cameras
#[derive(Debug, Parser)]
#[command(name = "plenoxel", version, after_help = EXAMPLES, max_term_width = 110, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    machine: Machine,
}

#[derive(Debug, Subcommand)]
enum Command {
    Cameras(cameras::CamerasArgs),
    Train(Box<train::TrainArgs>),
    Carve(Box<carve::CarveArgs>),
    Bake(bake::BakeArgs),
    Import(import::ImportArgs),
    Render(render::RenderArgs),
    Compare(compare::CompareArgs),
    Report(commands::report::ReportArgs),
    Evaluate(evaluate::EvaluateArgs),
    Export(export::ExportArgs),
    Filter(filter::FilterArgs),
    Info(info::InfoArgs),
    Harmonics(harmonics::HarmonicsArgs),
    Scene(scene::SceneArgs),
    Presets(presets::PresetsArgs),
    Completions(completions::CompletionsArgs),
    Man(man::ManArgs),
    Sweep(sweep::SweepArgs),
    View(view::ViewArgs),
}

#[derive(Debug, Args)]
struct Machine {
    /// Number of threads; results do not depend on it [default: all cores]
    #[arg(long, global = true, value_name = "N", help_heading = "Machine", value_parser = commands::whole::<usize>(1, machine::MOST_THREADS as u64), allow_negative_numbers = true)]
    threads: Option<usize>,

    /// Memory limit, such as 8GB or 500MiB; a command that needs more is refused before it starts [default: the free memory]
    #[arg(long, global = true, value_name = "SIZE", help_heading = "Machine", value_parser = commands::memory_size, allow_hyphen_values = true)]
    max_memory: Option<u64>,

    /// Print errors and results only
    #[arg(long, short, global = true, help_heading = "Machine")]
    quiet: bool,

    /// Format of messages on stderr: plain text, or one JSON object per line; it does not affect stdout
    #[arg(long, global = true, value_name = "FORMAT", help_heading = "Machine", value_enum, default_value_t = LogFormat::Plain)]
    log_format: LogFormat,
}

impl Machine {
    /// The command-line flags of each of `together` child processes, which share the threads and the memory.
    fn flags(&self, together: usize) -> Vec<String> {
        let threads = if together > 1 { Some((self.threads.unwrap_or_else(machine::threads) / together).max(1)) } else { self.threads };
        let memory = self.max_memory.map(|bytes| bytes / together as u64);
        threads.map(|n| format!("--threads={n}")).into_iter().chain(memory.map(|bytes| format!("--max-memory={bytes}"))).collect()
    }
}

/// Output streams of a command.
pub struct Streams<'a> {
    /// Results.
    pub out: &'a mut (dyn Write + Send),
    /// Progress, notes and errors.
    pub err: &'a mut (dyn Write + Send),
    /// True if stderr is a terminal; progress is then drawn as a bar.
    pub terminal: bool,
    /// True if stdout is a terminal; the JSON line for programs is then not printed.
    pub read_by_people: bool,
}

/// Calls `run` with a listener that writes the pictures and the report of a training run to its folder, as `train` does, and prints nothing. Returns the result
/// of `run`, and whether the report was written.
pub fn with_pages<R>(run: impl FnOnce(&mut Listener<'_>) -> R) -> (R, Result<(), Error>) {
    silently(|console| {
        let mut screen = train::Screen::new(console, true, true);
        let result = run(&mut |event| screen.show(event));
        (result, screen.finish())
    })
}

/// Writes report.html of a run, as `report` does, and prints nothing. `data` is the source of its views if it is another than the recorded one.
///
/// Errors: the folder is not a finished run; its views cannot be read; there is not enough memory; the page cannot be written.
pub fn write_report(run: &Path, data: Option<DataSource>) -> Result<(), Error> {
    silently(|console| commands::report::write(run, data, console))
}

fn silently<R>(f: impl FnOnce(&Console<'_>) -> R) -> R {
    let streams = Streams { out: &mut std::io::sink(), err: &mut std::io::sink(), terminal: false, read_by_people: true };
    f(&Console::new(streams, LogFormat::Plain, true))
}

/// Runs a command line, which begins with the program name, and returns the exit code.
pub fn run<A: Into<OsString> + Clone>(args: impl IntoIterator<Item = A>, streams: Streams<'_>) -> u8 {
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(answer) => return answer_to_arguments(&answer, streams),
    };
    interrupt::install();
    let console = Console::new(streams, cli.machine.log_format, cli.machine.quiet);
    memory::limit(cli.machine.max_memory);
    let code = machine::with_threads(cli.machine.threads, || -> Result<u8, Error> {
        let done = match &cli.command {
            Command::Cameras(args) => return cameras::run(args, &console),
            Command::Train(args) => return train::run(args, &console),
            Command::Carve(args) => carve::run(args, &console),
            Command::Bake(args) => bake::run(args, &console),
            Command::Import(args) => import::run(args, &console),
            Command::Render(args) => render::run(args, &console),
            Command::Compare(args) => compare::run(args, &console),
            Command::Report(args) => commands::report::run(args, &console),
            Command::Evaluate(args) => evaluate::run(args, &console),
            Command::Export(args) => export::run(args, &console),
            Command::Filter(args) => filter::run(args, &console),
            Command::Info(args) => info::run(args, &console),
            Command::Harmonics(args) => harmonics::run(args, &console),
            Command::Scene(args) => scene::run(args, &console),
            Command::Presets(args) => presets::run(args, &console),
            Command::Completions(args) => completions::run(args, &console),
            Command::Man(args) => man::run(args, &console),
            Command::View(args) => view::run(args, &console),
            Command::Sweep(args) => return sweep::run(args, &cli.machine, &console),
        };
        done.map(|()| 0)
    });
    match code.map_err(commands::as_flag).flatten() {
        Ok(code) => code,
        Err(error) => {
            console.error(&error.to_string(), error.exit_code());
            error.exit_code()
        }
    }
}

/// Prints help and version to stdout with exit code 0, errors of arguments to stderr with exit code 2.
fn answer_to_arguments(answer: &clap::Error, streams: Streams<'_>) -> u8 {
    let text = answer.render();
    // A failure to print cannot be reported.
    if answer.use_stderr() {
        let written = match streams.terminal {
            true => write!(streams.err, "{}", text.ansi()),
            false => write!(streams.err, "{text}"),
        };
        drop(written);
        return 2;
    }
    drop(write!(streams.out, "{text}"));
    0
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Command, CommandFactory, ValueHint};
    use plenoxel::model::plenoxels::config::Config;
    use plenoxel::run::settings::{CARVE, PRESETS};

    /// A command and its subcommands.
    fn commands(command: &Command) -> Vec<Command> {
        let below = command.get_subcommands().flat_map(commands);
        std::iter::once(command.clone()).chain(below).collect()
    }

    fn all() -> Vec<Command> {
        let mut command = Cli::command().disable_help_subcommand(true);
        command.build();
        commands(&command)
    }

    #[test]
    fn the_definitions_of_the_command_line_hold_together() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_has_examples_and_every_argument_a_sentence() {
        for command in all() {
            let name = command.get_bin_name().unwrap_or_default().to_owned();
            let help = command.clone().render_long_help().to_string();
            assert!(help.contains("\nExamples:\n") && help.contains(&format!("\n  {name}")), "{help}");
            for argument in command.get_arguments() {
                let text = argument.get_help().unwrap_or_default().to_string();
                assert!(text.len() > 5 && !text.ends_with('.'), "{name}: {argument}: {text}");
            }
        }
    }

    #[test]
    fn a_negative_number_is_a_value_that_the_flag_itself_refuses() {
        const TEXTS: [&str; 8] = ["KEY=VALUE", "SCENE/METHOD", "DATA", "SPLIT", "NAME", "FORMAT", "FORMATS", "orbit|spiral|cameras|FILE"];
        for command in all() {
            for flag in
                command.get_opts().filter(|flag| flag.get_value_hint() == ValueHint::Unknown && flag.get_possible_values().is_empty())
            {
                let name = flag.get_value_names().unwrap_or_default().concat();
                let takes = flag.is_allow_negative_numbers_set() || flag.is_allow_hyphen_values_set() || flag.is_require_equals_set();
                assert!(takes || TEXTS.contains(&name.as_str()), "{}: {flag}", command.get_name());
            }
        }
    }

    #[test]
    fn a_preset_of_the_library_is_what_the_command_line_resolves() {
        let resolved = |line: &[&str]| match Cli::try_parse_from(line).expect("a command line").command {
            super::Command::Train(args) => args.config().expect("valid settings").0,
            super::Command::Carve(args) => args.config().expect("valid settings").0,
            _ => panic!("{line:?}"),
        };
        for preset in PRESETS.map(|preset| preset.name) {
            assert_eq!(Config::preset(preset).expect("a preset"), resolved(&["plenoxel", "train", "--preset", preset]), "{preset}");
        }
        assert_eq!(Config::preset(CARVE.name).expect("a preset"), resolved(&["plenoxel", "carve"]));
    }

    #[test]
    fn defaults_that_the_help_of_train_names_are_those_of_the_presets() {
        let train = all().into_iter().find(|command| command.get_name() == "train").expect("train");
        for flag in ["seed", "downscale", "half-width", "interpolation", "color", "sh-degree", "sh-reduction", "hull", "engine"] {
            let argument = train.get_arguments().find(|argument| argument.get_long() == Some(flag)).expect(flag);
            let help = argument.get_help().unwrap_or_default().to_string();
            let defaults = help.split("[default: ").nth(1).expect("a default");
            let value = |preset: &str| {
                let settings = toml::Table::try_from(Config::preset(preset).expect("a valid preset")).expect("a table");
                settings[&flag.replace('-', "_")].to_string().replace('"', "")
            };
            let usual = value("fast");
            assert!(defaults.starts_with(&usual), "{flag}: {usual} in {defaults}");
            for preset in PRESETS.map(|preset| preset.name) {
                let value = value(preset);
                let special = value != usual;
                assert!(defaults.contains(preset) == special && defaults.contains(&value), "{flag}: {preset} has {value}, not {defaults}");
            }
        }
    }

    #[test]
    fn the_examples_of_all_helps_are_understood() {
        let helps = all().into_iter().map(|command| command.get_after_help().unwrap_or_default().to_string());
        // The description of an example follows two spaces.
        let example = |line: &str| Some(line.strip_prefix("  plenoxel ")?.split("  ").next()?.split(['>', '|']).next()?.to_owned());
        let examples = helps.flat_map(|help| help.lines().filter_map(example).collect::<Vec<_>>());
        let lines: Vec<String> = examples.collect();
        assert!(lines.len() > 25, "{lines:?}");
        for line in lines {
            let parsed = Cli::try_parse_from(["plenoxel"].into_iter().chain(line.split_whitespace()));
            // Help is an answer too.
            let refused = parsed.err().filter(clap::Error::use_stderr);
            assert!(refused.is_none(), "plenoxel {line}\n{refused:?}");
        }
    }
}
