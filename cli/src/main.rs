//! The `plenoxel` program: everything is in the library, where tests can call it.
#![forbid(unsafe_code)]

use std::io::IsTerminal;
use std::process::ExitCode;

fn main() -> ExitCode {
    let (mut out, mut err) = (std::io::stdout(), std::io::stderr());
    let (terminal, read_by_people) = (err.is_terminal(), out.is_terminal());
    let streams = plenoxel_cli::Streams { out: &mut out, err: &mut err, terminal, read_by_people };
    ExitCode::from(plenoxel_cli::run(std::env::args_os(), streams))
}
