//! The `plenoxel` program: everything is in the library, where tests can call it.
#![forbid(unsafe_code)]

use std::io::IsTerminal;
use std::process::ExitCode;

fn main() -> ExitCode {
    refuse_large_files_by_error();
    let (mut out, mut err) = (std::io::stdout(), std::io::stderr());
    let (terminal, read_by_people) = (err.is_terminal(), out.is_terminal());
    let streams = plenoxel_cli::Streams { out: &mut out, err: &mut err, terminal, read_by_people };
    ExitCode::from(plenoxel_cli::run(std::env::args_os(), streams))
}

/// Has a file that grows beyond `ulimit -f` be an error of the write, and not the end of the process.
#[cfg(unix)]
fn refuse_large_files_by_error() {
    // The flag is not read: that there is a handler is what counts.
    drop(signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Default::default()));
}

#[cfg(not(unix))]
fn refuse_large_files_by_error() {}
