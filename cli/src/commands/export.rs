//! `plenoxel export`: a trained run as files for other programs.

mod ply;

use crate::progress::Console;
use clap::{Args, Subcommand};
use plenoxel::error::Result;

/// Write a trained run as a file for other programs
#[derive(Debug, Args)]
pub struct ExportArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    Ply(ply::PlyArgs),
}

/// Exports a run.
pub fn run(args: &ExportArgs, console: &Console<'_>) -> Result<()> {
    match &args.what {
        What::Ply(args) => ply::run(args, console),
    }
}
