//! Child processes: their output goes line by line to a log, a request to stop is passed on, and what they said last explains how they ended.

use crate::interrupt::Watch;
use std::ffi::OsStr;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ExitStatus};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::time::Duration;

/// Interval of checks for a request to stop.
const LISTENING: Duration = Duration::from_millis(50);

/// Reads the `output` of a child process to its end, and passes each line to the file `log` and to `said`. At a request to stop, calls `stop` once.
pub fn follow(child: &Child, output: impl Read, log: &mut File, watch: &Watch, stop: fn(&Child), mut said: impl FnMut(&str)) {
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // Also set when this closure panics.
        let ends = Ends(&over);
        scope.spawn(|| {
            while !over.load(SeqCst) {
                if watch.requested() {
                    return stop(child);
                }
                std::thread::sleep(LISTENING);
            }
        });
        let (mut output, mut bytes) = (BufReader::new(output), Vec::new());
        while output.read_until(b'\n', &mut bytes).is_ok_and(|n| n > 0) {
            // A failure to write the log does not fail the process.
            drop(log.write_all(&bytes));
            said(String::from_utf8_lossy(&bytes).trim_end());
            bytes.clear();
        }
        drop(ends);
    });
}

/// A guard that sets its flag when it is dropped.
struct Ends<'o>(&'o AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, SeqCst);
    }
}

/// The last error and the last line of a process.
pub struct Last {
    line: String,
    error: Option<String>,
    /// Returns the message of a line that is an error.
    error_of: fn(&str) -> Option<&str>,
}

impl Last {
    /// Nothing was said yet. `error_of` returns the message of a line that is an error.
    pub fn new(error_of: fn(&str) -> Option<&str>) -> Self {
        Last { line: String::new(), error: None, error_of }
    }

    /// Takes notice of a line.
    pub fn hear(&mut self, line: &str) {
        if let Some(error) = (self.error_of)(line) {
            self.error = Some(error.to_owned());
        }
        if !line.trim().is_empty() {
            line.clone_into(&mut self.line);
        }
    }

    /// Returns the last error, or how the process ended after which line.
    pub fn words(self, status: ExitStatus) -> String {
        match (self.error, signal(status)) {
            (Some(error), _) => error,
            // SIGKILL, sent by systems that run out of memory.
            (None, Some(9)) => format!("killed, possibly for lack of memory, after: {}", self.line),
            (None, Some(signal)) => format!("ended by signal {signal} after: {}", self.line),
            (None, None) => self.line,
        }
    }
}

/// Formats a call of a program as a shell command.
pub fn command_line<S: AsRef<OsStr>>(program: &str, arguments: &[S]) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_=./,:+@%".contains(c);
    let quoted = |word: &str| {
        if !word.is_empty() && word.chars().all(plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
    };
    let words = arguments.iter().map(|argument| quoted(&argument.as_ref().to_string_lossy()));
    [quoted(program)].into_iter().chain(words).collect::<Vec<_>>().join(" ")
}

/// Returns the exit code; 128 plus the number of the signal if a signal ended the process, as in shells.
pub fn code(status: ExitStatus) -> u8 {
    let code = status.code().or_else(|| signal(status).map(|signal| 128 + signal));
    code.and_then(|code| u8::try_from(code).ok()).unwrap_or(u8::MAX)
}

/// Sends SIGTERM to the child. On a terminal, the child also receives Ctrl-C itself.
#[cfg(unix)]
pub fn ask_to_stop(child: &Child) {
    // The child may have ended already.
    let _ = number(child).map(|process| rustix::process::kill_process(process, rustix::process::Signal::TERM));
}

/// Sends SIGTERM to the process group that the child leads.
#[cfg(unix)]
pub fn ask_group_to_stop(child: &Child) {
    // All of its processes may have ended already.
    let _ = number(child).map(|group| rustix::process::kill_process_group(group, rustix::process::Signal::TERM));
}

#[cfg(unix)]
fn number(child: &Child) -> Option<rustix::process::Pid> {
    i32::try_from(child.id()).ok().and_then(rustix::process::Pid::from_raw)
}

#[cfg(not(unix))]
pub fn ask_to_stop(_: &Child) {}

#[cfg(not(unix))]
pub fn ask_group_to_stop(_: &Child) {}

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
        let line = command_line("plenoxel", &["train", "--set=a=[{b=\"c\"}]", "it's", "", "data/lego"]);
        assert_eq!(line, r#"plenoxel train '--set=a=[{b="c"}]' 'it'\''s' '' data/lego"#);
        assert_eq!(command_line("my colmap", &["-h"]), "'my colmap' -h");
    }

    #[test]
    fn the_last_error_counts_more_than_the_last_line() {
        let hear = |lines: &[&str]| {
            let mut last = Last::new(|line| line.strip_prefix("error: "));
            lines.iter().for_each(|line| last.hear(line));
            last.words(ExitStatus::default())
        };
        assert_eq!(hear(&["step 1", "error: no room", "bye", ""]), "no room");
        assert_eq!(hear(&["step 1", "thread panicked", " "]), "thread panicked");
    }
}
