//! Runs as child processes: the sweep continues if a run crashes or is killed for lack of memory, and the peak memory of each run is measured separately.

use crate::interrupt::Watch;
use plenoxel::error::{Error, Result};
use plenoxel::files::FolderLock;
use std::ffi::OsString;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::time::Duration;

/// Interval of checks for a request to stop.
const LISTENING: Duration = Duration::from_millis(50);

/// The program that a sweep runs.
pub struct Program {
    /// Path of this program.
    pub path: PathBuf,
    /// Flags for all runs: threads and memory.
    pub machine: Vec<String>,
    /// The lock of the sweep. Child processes inherit it, so that a run that outlives its sweep keeps it.
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
pub fn this_program() -> Result<PathBuf> {
    let link = Path::new("/proc/self/exe");
    if link.exists() {
        return Ok(link.to_owned());
    }
    std::env::current_exe().map_err(|e| Error::io("plenoxel", e, "finding this program"))
}

impl Program {
    /// Runs the program to its end. Its stderr is appended to the file `log` and passed to `said` line by line. A request to stop the sweep is forwarded
    /// to the program.
    pub fn run(&self, arguments: &[OsString], log: &Path, watch: &Watch, mut said: impl FnMut(&str)) -> Result<Ended> {
        let writing = |e| Error::io(log, e, "writing the log");
        let starting = |e| Error::io(&self.path, e, "starting a run");
        let mut file = File::options().append(true).create(true).open(log).map_err(writing)?;
        writeln!(file, "$ {}", command_line(arguments)).map_err(writing)?;
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
        let mut last = Last::default();
        let over = AtomicBool::new(false);
        let out = std::thread::scope(|scope| {
            let child = &child;
            // Also set when this closure panics.
            let ends = Ends(&over);
            scope.spawn(|| {
                while !over.load(SeqCst) {
                    if watch.requested() {
                        return ask_to_stop(child);
                    }
                    std::thread::sleep(LISTENING);
                }
            });
            let out = scope.spawn(|| {
                let mut bytes = Vec::new();
                // Unreadable output is ignored.
                drop(stdout.map(|mut stdout| stdout.read_to_end(&mut bytes)));
                String::from_utf8_lossy(&bytes).into_owned()
            });
            let mut bytes = Vec::new();
            if let Some(stderr) = stderr {
                let mut stderr = BufReader::new(stderr);
                while stderr.read_until(b'\n', &mut bytes).is_ok_and(|n| n > 0) {
                    // A failure to write the log does not fail the run.
                    drop(file.write_all(&bytes));
                    let text = String::from_utf8_lossy(&bytes);
                    last.hear(text.trim_end());
                    said(text.trim_end());
                    bytes.clear();
                }
            }
            drop(ends);
            out.join().unwrap_or_default()
        });
        let status = child.wait().map_err(starting)?;
        let code = code(status);
        Ok(Ended { code, out, last: last.words(status) })
    }
}

/// A guard that sets its flag when it is dropped.
struct Ends<'o>(&'o AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, SeqCst);
    }
}

/// The last error and the last line of a process.
#[derive(Default)]
struct Last {
    line: String,
    error: Option<String>,
}

impl Last {
    fn hear(&mut self, line: &str) {
        if let Some(error) = line.strip_prefix("error: ") {
            self.error = Some(error.to_owned());
        }
        if !line.trim().is_empty() {
            self.line = line.to_owned();
        }
    }

    fn words(self, status: ExitStatus) -> String {
        match (self.error, signal(status)) {
            (Some(error), _) => error,
            // SIGKILL, sent by systems that run out of memory.
            (None, Some(9)) => format!("killed, possibly for lack of memory, after: {}", self.line),
            (None, Some(signal)) => format!("ended by signal {signal} after: {}", self.line),
            (None, None) => self.line,
        }
    }
}

/// Formats a call of the program as a shell command.
pub fn command_line(arguments: &[OsString]) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_=./,:+@%".contains(c);
    let words = arguments.iter().map(|argument| {
        let word = argument.to_string_lossy();
        if !word.is_empty() && word.chars().all(plain) { word.into_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
    });
    ["plenoxel".to_owned()].into_iter().chain(words).collect::<Vec<_>>().join(" ")
}

fn code(status: ExitStatus) -> u8 {
    let code = status.code().or_else(|| signal(status).map(|signal| 128 + signal));
    code.and_then(|code| u8::try_from(code).ok()).unwrap_or(u8::MAX)
}

/// Sends SIGTERM to the child. On a terminal, the child also receives Ctrl-C itself.
#[cfg(unix)]
fn ask_to_stop(child: &Child) {
    let process = i32::try_from(child.id()).ok().and_then(rustix::process::Pid::from_raw);
    // The child may have ended already.
    let _ = process.map(|process| rustix::process::kill_process(process, rustix::process::Signal::TERM));
}

#[cfg(not(unix))]
fn ask_to_stop(_: &Child) {}

#[cfg(unix)]
fn signal(status: ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(&status)
}

#[cfg(not(unix))]
fn signal(_: ExitStatus) -> Option<i32> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_line_can_be_typed_into_a_shell() {
        let line = command_line(&["train", "--set=a=[{b=\"c\"}]", "it's", "", "data/lego"].map(OsString::from));
        assert_eq!(line, r#"plenoxel train '--set=a=[{b="c"}]' 'it'\''s' '' data/lego"#);
    }

    #[test]
    fn the_last_error_counts_more_than_the_last_line() {
        let hear = |lines: &[&str]| {
            let mut last = Last::default();
            lines.iter().for_each(|line| last.hear(line));
            last.words(ExitStatus::default())
        };
        assert_eq!(hear(&["step 1", "error: no room", "bye", ""]), "no room");
        assert_eq!(hear(&["step 1", "thread panicked", " "]), "thread panicked");
    }
}
