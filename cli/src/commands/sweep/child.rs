//! A run as a process of its own: it may crash, or be killed for want of memory, and the sweep goes on; and its peak memory is its own.

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

/// Time between looks whether the sweep was asked to stop.
const LISTENING: Duration = Duration::from_millis(50);

/// What the processes of a sweep have in common.
pub struct Program {
    /// This program.
    pub path: PathBuf,
    /// Flags for all: threads and memory.
    pub machine: Vec<String>,
    /// The lock of the sweep, which lasts until the last who has the file open ends: a run that outlives its sweep keeps it.
    pub lock: FolderLock,
}

/// How a process ended.
pub struct Ended {
    /// Exit code; of one that a signal ended 128 and the signal's number, as shells count.
    pub code: u8,
    /// What it said on stdout.
    pub out: String,
    /// What it said last, its error if it said so.
    pub last: String,
}

/// This very program: on Linux even if another has taken its place on the disk since, so that one sweep is made by one program.
pub fn this_program() -> Result<PathBuf> {
    let link = Path::new("/proc/self/exe");
    if link.exists() {
        return Ok(link.to_owned());
    }
    std::env::current_exe().map_err(|e| Error::io("plenoxel", e, "finding this program"))
}

impl Program {
    /// Runs the program to its end. What it says on stderr goes to the end of the file `log`, and line by line to `said`. If the sweep is asked to
    /// stop, so is the program.
    pub fn run(&self, arguments: &[OsString], log: &Path, watch: &Watch, mut said: impl FnMut(&str)) -> Result<Ended> {
        let writing = |e| Error::io(log, e, "writing the log");
        let starting = |e| Error::io(&self.path, e, "starting a run");
        let mut file = File::options().append(true).create(true).open(log).map_err(writing)?;
        writeln!(file, "$ {}", command_line(arguments)).map_err(writing)?;
        let mut child = Command::new(&self.path)
            .args(&self.machine)
            .args(arguments)
            // Nothing is read from it: it is how a process is given an open file.
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
            // However it ends.
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
                // What cannot be read is not there.
                drop(stdout.map(|mut stdout| stdout.read_to_end(&mut bytes)));
                String::from_utf8_lossy(&bytes).into_owned()
            });
            let mut bytes = Vec::new();
            if let Some(stderr) = stderr {
                let mut stderr = BufReader::new(stderr);
                while stderr.read_until(b'\n', &mut bytes).is_ok_and(|n| n > 0) {
                    // A full disk is no reason for the run to fail, which may have its own elsewhere.
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

/// Says that something is over when it is dropped.
struct Ends<'o>(&'o AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, SeqCst);
    }
}

/// What a process said last that matters.
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
            // What a system does that runs out of memory.
            (None, Some(9)) => format!("killed, perhaps for want of memory, after: {}", self.line),
            (None, Some(signal)) => format!("ended by signal {signal} after: {}", self.line),
            (None, None) => self.line,
        }
    }
}

/// A call of the program as one types it into a shell.
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

/// From a terminal it hears it too, at the same time.
#[cfg(unix)]
fn ask_to_stop(child: &Child) {
    let process = i32::try_from(child.id()).ok().and_then(rustix::process::Pid::from_raw);
    // One that has ended need not be asked.
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
