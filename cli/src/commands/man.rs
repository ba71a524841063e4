//! `plenoxel man`: manual pages, generated from the definitions of the command line.

use crate::Cli;
use crate::progress::Console;
use clap::{Args, Command, CommandFactory, ValueHint};
use clap_mangen::Man;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel man > plenoxel.1               print the page of the program
  plenoxel man ~/.local/share/man/man1    write the pages of all commands to a folder that man searches

After the second example, `man plenoxel-train` shows the page of train.";

/// Print the manual page, or write the pages of all commands
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct ManArgs {
    /// Folder to which the pages of all commands are written: plenoxel.1, plenoxel-train.1 and so on [default: print plenoxel.1]
    #[arg(value_hint = ValueHint::DirPath)]
    folder: Option<PathBuf>,
}

/// Prints the page of the program, or writes all pages.
pub fn run(args: &ManArgs, console: &Console<'_>) -> Result<()> {
    let mut command = Cli::command().disable_help_subcommand(true);
    command.build();
    let Some(folder) = &args.folder else {
        return console.text(page(&command)?.trim_end());
    };
    files::create_dir(folder)?;
    let count = write(&command, folder)?;
    console.result(&format!("wrote {count} pages to {}", folder.display()))
}

/// Writes the pages of a command and its subcommands. Returns their number.
fn write(command: &Command, folder: &Path) -> Result<usize> {
    let file = folder.join(Man::new(command.clone()).get_filename());
    files::write_atomically(&file, page(command)?.as_bytes())?;
    command.get_subcommands().try_fold(1, |count, command| Ok(count + write(command, folder)?))
}

fn page(command: &Command) -> Result<String> {
    let mut page = Vec::new();
    let defect = |e: std::io::Error| Error::input("the manual page", e.to_string(), "this is a bug in the program");
    // Pages have no date; an empty one would be replaced.
    Man::new(command.clone()).date(" ").source(crate::PROGRAM).manual("User Commands").render(&mut page).map_err(defect)?;
    let page = String::from_utf8_lossy(&page);
    let Some((above, below)) = page.split_once(".SH EXTRA\nExamples:\n") else { return Ok(page.into_owned()) };
    // Examples keep their line breaks; the text below is filled.
    let end = below.lines().take_while(|line| line.starts_with("  ")).map(|line| line.len() + 1).sum();
    let (examples, rest) = below.split_at_checked(end).unwrap_or((below, ""));
    Ok(format!("{above}.SH EXAMPLES\n.nf\n{examples}.fi\n{rest}"))
}
