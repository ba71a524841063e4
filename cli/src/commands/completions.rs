//! `plenoxel completions`: shell completions, generated from the definitions of the command line.

use crate::Cli;
use crate::progress::Console;
use clap::{Args, CommandFactory};
use clap_complete::Shell;
use plenoxel::error::Result;

const EXAMPLES: &str = "\
Examples:
  plenoxel completions bash > ~/.local/share/bash-completion/completions/plenoxel
  plenoxel completions zsh > ~/.zfunc/_plenoxel      with ~/.zfunc in fpath before compinit
  plenoxel completions fish > ~/.config/fish/completions/plenoxel.fish
  source <(plenoxel completions bash)                for this session only";

/// Print the completion script of a shell
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct CompletionsArgs {
    /// Shell for which the script is printed
    shell: Shell,
}

/// Prints the completion script.
pub fn run(args: &CompletionsArgs, console: &Console<'_>) -> Result<()> {
    let mut command = Cli::command();
    let name = command.get_name().to_owned();
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, name, &mut script);
    console.text(String::from_utf8_lossy(&script).trim_end())
}
