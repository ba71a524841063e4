//! The command line of plenoxel as a library: [`run`] takes arguments and two streams and returns an exit code, so that a test can call
//! it like any function.
//!
//! Exit codes: 0 done, 2 usage or a setting that cannot be used, 3 bad input, 4 numbers that are not finite, 5 reading or writing,
//! 130 training that was interrupted, and saved.
#![forbid(unsafe_code)]

mod commands;
mod config;
mod curves;
mod data;
mod evaluation;
mod images;
mod machine;
mod memory;
mod metrics_file;
#[doc(hidden)]
pub mod parsers;
mod progress;
mod run_folder;

use clap::{Args, Parser, Subcommand};
use commands::{carve, evaluate, export, filter, info, render, scene, train};
use plenoxel::error::Error;
use progress::Console;
use std::ffi::OsString;
use std::io::Write;

/// Name and version, as runs record it.
const PROGRAM: &str = concat!("plenoxel ", env!("CARGO_PKG_VERSION"));

const EXAMPLES: &str = "\
Examples:
  plenoxel train                             learn the built-in scene; needs no files
  plenoxel train data/lego --preset paper    learn a NeRF-synthetic scene as the source paper does
  plenoxel carve data/lego                   an opaque colored grid from silhouettes
  plenoxel evaluate runs/lego-1              PSNR and SSIM on its test views
  plenoxel render runs/lego-1 --view 0       a picture of it
  plenoxel export ply runs/lego-1            its voxels as a colored point cloud
  plenoxel export mesh runs/lego-1           its surface, for other programs

Progress goes to stderr, results to stdout. Exit codes: 0 done, 2 usage, 3 bad input, 4 numeric failure, 5 reading or writing,
130 interrupted (what was trained is saved).";

/// Voxel radiance fields from photographs with known cameras
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
    Train(Box<train::TrainArgs>),
    Carve(Box<carve::CarveArgs>),
    Render(render::RenderArgs),
    Evaluate(evaluate::EvaluateArgs),
    Export(export::ExportArgs),
    Filter(filter::FilterArgs),
    Info(info::InfoArgs),
    Scene(scene::SceneArgs),
}

#[derive(Debug, Args)]
struct Machine {
    /// Threads to compute with; results do not depend on it [default: all cores]
    #[arg(long, global = true, value_name = "N", help_heading = "Machine", value_parser = commands::whole::<usize>(1, machine::MOST_THREADS as u64))]
    threads: Option<usize>,

    /// Refuse what would need more memory than this, such as 8GB or 500MiB [default: what is free]
    #[arg(long, global = true, value_name = "SIZE", help_heading = "Machine", value_parser = commands::memory_size)]
    max_memory: Option<u64>,

    /// Print errors and results only
    #[arg(long, short, global = true, help_heading = "Machine")]
    quiet: bool,
}

/// Where a command prints.
pub struct Streams<'a> {
    /// Results.
    pub out: &'a mut (dyn Write + Send),
    /// Progress and errors.
    pub err: &'a mut (dyn Write + Send),
    /// True if the process's stderr is a terminal: progress is then drawn there as a bar.
    pub terminal: bool,
}

/// Runs a command line, the program's name first, and returns the exit code.
pub fn run<A: Into<OsString> + Clone>(args: impl IntoIterator<Item = A>, streams: Streams<'_>) -> u8 {
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(answer) => return answer_to_arguments(&answer, streams),
    };
    let console = Console::new(streams, cli.machine.quiet);
    memory::limit(cli.machine.max_memory);
    let code = machine::with_threads(cli.machine.threads, || {
        let done = match &cli.command {
            Command::Train(args) => return train::run(args, &console),
            Command::Carve(args) => carve::run(args, &console),
            Command::Render(args) => render::run(args, &console),
            Command::Evaluate(args) => evaluate::run(args, &console),
            Command::Export(args) => export::run(args, &console),
            Command::Filter(args) => filter::run(args, &console),
            Command::Info(args) => info::run(args, &console),
            Command::Scene(args) => scene::run(args, &console),
        };
        done.map(|()| 0)
    });
    match code {
        Ok(code) => code,
        Err(error) => {
            console.error(&error.to_string());
            error.exit_code()
        }
    }
}

/// Help and version go to stdout with exit code 0, complaints to stderr with 2.
fn answer_to_arguments(answer: &clap::Error, streams: Streams<'_>) -> u8 {
    let text = answer.render();
    // A stream that is closed cannot be told so.
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

/// A value as JSON on one line, its keys in the order of its fields. Numbers that are not finite become null.
fn json_line(value: &impl serde::Serialize) -> Result<String, Error> {
    let defect = |e: serde_json::Error| Error::input("result", e.to_string(), "this is a defect of the program");
    serde_json::to_string(value).map_err(defect)
}
