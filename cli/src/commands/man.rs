//! `plenoxel man`: manual pages, from the definitions that parse command lines.

use crate::Cli;
use crate::progress::Console;
use clap::{Args, Command, CommandFactory, ValueHint};
use clap_mangen::Man;
use plenoxel::error::{Error, Result};
use plenoxel::files;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel man > plenoxel.1               the page of the program
  plenoxel man ~/.local/share/man/man1    a page for each command, where man looks for them

Then `man plenoxel-train` shows the page of train, and so on.";

/// Print the manual page, or write those of all commands
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct ManArgs {
    /// Folder for a page of each command: plenoxel.1, plenoxel-train.1 and so on; without it, the program's page is printed
    #[arg(value_hint = ValueHint::DirPath)]
    folder: Option<PathBuf>,
}

/// Prints or writes pages.
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

/// Writes the pages of a command and of those below it, and says how many.
fn write(command: &Command, folder: &Path) -> Result<usize> {
    let file = folder.join(Man::new(command.clone()).get_filename());
    files::write_atomically(&file, page(command)?.as_bytes())?;
    command.get_subcommands().try_fold(1, |count, command| Ok(count + write(command, folder)?))
}

fn page(command: &Command) -> Result<String> {
    let mut page = Vec::new();
    let defect = |e: std::io::Error| Error::input("the manual page", e.to_string(), "this is a defect of the program");
    // A page has no date, and nothing at all would not be counted as one.
    Man::new(command.clone()).date(" ").source(crate::PROGRAM).manual("User Commands").render(&mut page).map_err(defect)?;
    let page = String::from_utf8_lossy(&page);
    let Some((above, below)) = page.split_once(".SH EXTRA\nExamples:\n") else { return Ok(page.into_owned()) };
    // Examples keep their lines, what stands below them flows.
    let end = below.lines().take_while(|line| line.starts_with("  ")).map(|line| line.len() + 1).sum();
    let (examples, rest) = below.split_at_checked(end).unwrap_or((below, ""));
    Ok(format!("{above}.SH EXAMPLES\n.nf\n{examples}.fi\n{rest}"))
}
