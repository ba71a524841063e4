//! Runs as child processes: the sweep continues if a run crashes or is killed for lack of memory, and the peak memory of each run is measured separately.

use crate::Machine;
use crate::child::{Last, ask_to_stop, code, command_line, follow};
use crate::interrupt::Watch;
use plenoxel::error::{Error, Result};
use plenoxel::files::FolderLock;
use std::ffi::OsString;
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The program that a sweep runs.
pub struct Program {
    /// Path of this program.
    pub path: PathBuf,
    /// Flags for all runs: threads and memory.
    pub machine: Vec<String>,
    /// The lock of the sweep or of its run. Child processes inherit it, so that a run that outlives its sweep keeps it.
    pub lock: FolderLock,
}

/// Result of a child process.
pub struct Ended {
    /// Exit code; 128 plus the number of the signal if a signal ended the process, as in shells.
    pub code: u8,
    /// Its output on stdout.
    pub out: String,
    /// Its error message, or its last line on stderr.
    pub last: String,
}

/// Path of this program. On Linux it refers to the running program even if its file was replaced, so that a sweep uses a single version.
fn this_program() -> Result<PathBuf> {
    let link = Path::new("/proc/self/exe");
    if link.exists() {
        return Ok(link.to_owned());
    }
    std::env::current_exe().map_err(|e| Error::io("plenoxel", e, "finding this program"))
}

impl Program {
    /// This program, of which `together` children share the machine.
    pub fn new(machine: &Machine, together: usize, lock: FolderLock) -> Result<Self> {
        Ok(Program { path: this_program()?, machine: machine.flags(together), lock })
    }

    /// Runs the program to its end. Its stderr is appended to the file `log` and passed to `said` line by line. A request to stop the sweep is forwarded
    /// to the program.
    pub fn run(&self, arguments: &[OsString], log: &Path, watch: &Watch, mut said: impl FnMut(&str)) -> Result<Ended> {
        let writing = |e| Error::io(log, e, "writing the log");
        let starting = |e| Error::io(&self.path, e, "starting a run");
        let mut file = File::options().append(true).create(true).open(log).map_err(writing)?;
        writeln!(file, "$ {}", command_line("plenoxel", arguments)).map_err(writing)?;
        let mut child = Command::new(&self.path)
            .args(&self.machine)
            .args(arguments)
            // Not for input: the child inherits the lock as its stdin.
            .stdin(self.lock.file().try_clone().map_err(starting)?)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(starting)?;
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        let mut last = Last::new(|line| line.strip_prefix("error: "));
        let out = std::thread::scope(|scope| {
            let out = scope.spawn(|| {
                let mut bytes = Vec::new();
                // Unreadable output is ignored.
                drop(stdout.map(|mut stdout| stdout.read_to_end(&mut bytes)));
                String::from_utf8_lossy(&bytes).into_owned()
            });
            if let Some(stderr) = stderr {
                follow(&child, stderr, &mut file, watch, ask_to_stop, |line| {
                    last.hear(line);
                    said(line);
                });
            }
            out.join().unwrap_or_default()
        });
        let status = child.wait().map_err(starting)?;
        Ok(Ended { code: code(status), out, last: last.words(status) })
    }
}
