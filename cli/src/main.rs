//! The `plenoxel` program. Its implementation is in the library, so that tests can call it.
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

/// Ignores the signal for files beyond `ulimit -f`, so that the write returns an error instead.
#[cfg(unix)]
fn refuse_large_files_by_error() {
    // Nothing reads the flag; installing a handler is enough.
    drop(signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Default::default()));
}

#[cfg(not(unix))]
fn refuse_large_files_by_error() {}
