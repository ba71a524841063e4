//! The program `colmap`: which options the installed version has, and running its commands.

use super::folder::WORK;
use super::output;
use crate::child::{Last, ask_group_to_stop, code, command_line, follow};
use crate::interrupt::Watch;
use crate::progress::Console;
use plenoxel::error::{Error, Result};
use plenoxel::files::FolderLock;
use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// File of the output of COLMAP, in its folder.
const LOG: &str = "colmap.log";

/// An installed COLMAP.
pub struct Installed {
    program: PathBuf,
    /// Name and version.
    pub version: String,
    /// Group of the options of the feature extraction: `FeatureExtraction`, or `SiftExtraction` before version 3.12.
    pub extraction: &'static str,
    /// Group of the options of the matching.
    pub matching: &'static str,
}

/// Where commands of COLMAP run.
pub struct Place<'a, 'c> {
    /// The folder of cameras, in which the paths of the arguments are.
    pub folder: &'a Path,
    /// Its lock. Child processes inherit it, so that one that outlives this program keeps it.
    pub lock: &'a FolderLock,
    pub watch: &'a Watch,
    pub console: &'a Console<'c>,
    /// True to print the output.
    pub verbose: bool,
}

/// How a command of COLMAP ended.
pub struct Ended {
    pub code: u8,
    /// Its error, or its last line.
    pub last: String,
}

impl Installed {
    /// Finds the program, and reads in its help which options it has.
    ///
    /// Errors if there is no such program, saying how to install it, or if it is not COLMAP.
    pub fn find(program: &Path) -> Result<Self> {
        // A path is resolved here, because the commands run in another folder.
        let program = match program.components().count() {
            0 | 1 => program.to_owned(),
            _ => std::path::absolute(program).map_err(|e| Error::io(program, e, "finding the program"))?,
        };
        let help = help(&program, "feature_extractor")?;
        let group = |help: &str, names: [&'static str; 2]| names.into_iter().find(|name| help.contains(&format!("--{name}.use_gpu")));
        let strange = || {
            let found = format!("`{}` does not have the options of COLMAP", program.display());
            Error::usage("--colmap", found, "give the program of COLMAP 3.6 or newer")
        };
        let extraction = group(&help, ["FeatureExtraction", "SiftExtraction"]).ok_or_else(strange)?;
        let matching = group(&self::help(&program, "exhaustive_matcher")?, ["FeatureMatching", "SiftMatching"]).ok_or_else(strange)?;
        let version = help.lines().find(|line| line.starts_with("COLMAP ")).unwrap_or("COLMAP").to_owned();
        Ok(Installed { program, version, extraction, matching })
    }

    /// Runs a command to its end. Its output is appended to the log and passed to `said` line by line. At a request to stop, it is ended.
    pub fn run(&self, place: &Place<'_, '_>, arguments: &[String], mut said: impl FnMut(&str)) -> Result<Ended> {
        let log = log(place.folder);
        let writing = |e| Error::io(&log, e, "writing the log");
        let starting = |e| Error::io(&self.program, e, "running COLMAP");
        let mut file = File::options().append(true).create(true).open(&log).map_err(writing)?;
        writeln!(file, "$ {}", command_line(&self.program.to_string_lossy(), arguments)).map_err(writing)?;
        // Both streams are one, in the order of their lines.
        let (output, input) = std::io::pipe().map_err(starting)?;
        let mut command = Command::new(&self.program);
        command.args(arguments).current_dir(place.folder);
        // Not for input: the child inherits the lock as its stdin.
        command.stdin(place.lock.file().try_clone().map_err(starting)?);
        command.stdout(input.try_clone().map_err(starting)?).stderr(input);
        // A group of its own, so that a script that starts COLMAP is ended with all of its processes.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn().map_err(starting)?;
        // The ends of the pipe in this process: without this, the output would never end.
        drop(command);
        let mut last = Last::new(output::error);
        follow(&child, output, &mut file, place.watch, ask_group_to_stop, |line| {
            last.hear(line);
            if place.verbose {
                place.console.note(line);
            }
            said(line);
        });
        let status = child.wait().map_err(starting)?;
        Ok(Ended { code: code(status), last: last.words(status) })
    }
}

/// The file of the output of COLMAP in a folder of cameras.
pub fn log(folder: &Path) -> PathBuf {
    folder.join(WORK).join(LOG)
}

/// Returns the help about a command.
fn help(program: &Path, about: &str) -> Result<String> {
    let answer = Command::new(program).args([about, "-h"]).stdin(Stdio::null()).output().map_err(|e| {
        let found = match e.kind() {
            ErrorKind::NotFound => format!("there is no program `{}`", program.display()),
            _ => format!("`{}` cannot be run ({e})", program.display()),
        };
        let remedy = "install COLMAP, with `apt install colmap` on Debian and Ubuntu, `brew install colmap` on macOS, \
                      or from https://colmap.github.io, or give the path of the program with --colmap";
        Error::usage("--colmap", found, remedy)
    })?;
    Ok([answer.stdout, answer.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat())
}
