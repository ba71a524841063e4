//! `plenoxel completions`: what a shell needs to complete command lines, from the definitions that parse them.

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
  source <(plenoxel completions bash)                for this session alone";

/// Print completions for a shell
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Prints a script for a shell.
pub fn run(args: &CompletionsArgs, console: &Console<'_>) -> Result<()> {
    let mut command = Cli::command();
    let name = command.get_name().to_owned();
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, name, &mut script);
    console.text(String::from_utf8_lossy(&script).trim_end())
}
