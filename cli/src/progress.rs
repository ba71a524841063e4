//! Output of the program: progress and notes to stderr, results to stdout.
//!
//! On a terminal, progress is a bar. In a file or pipe, it is a line every few seconds and at the end of each stage. With `--log-format json`, each
//! line on stderr is a JSON object.

mod terminal;
mod training;

use crate::Streams;
use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressStyle};
use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::json;
use plenoxel::run::machine;
use plenoxel::text::one_line;
use serde::Serialize;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
pub use training::Training;

/// Interval of progress lines.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Interval of updates of a bar.
const BAR_EVERY: Duration = Duration::from_millis(100);

/// Width of a bar with its percentage, in columns.
const BAR_COLUMNS: usize = 14;

/// Format of messages on stderr.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Plain text; on a terminal, with progress bars.
    Plain,
    /// One JSON object per line.
    Json,
}

/// The console, for use from several threads.
pub struct Console<'a> {
    streams: Mutex<Streams<'a>>,
    /// The visible progress bar, which is suspended while other lines are printed.
    bar: Mutex<Option<ProgressBar>>,
    bars: bool,
    /// True if stderr is a terminal.
    terminal: bool,
    format: LogFormat,
    quiet: bool,
}

impl<'a> Console<'a> {
    /// Creates a console on two streams. With `quiet`, it prints errors and results only.
    pub fn new(streams: Streams<'a>, format: LogFormat, quiet: bool) -> Self {
        let bars = streams.terminal && format == LogFormat::Plain && !quiet;
        let terminal = streams.terminal;
        Console { streams: Mutex::new(streams), bar: Mutex::new(None), bars, terminal, format, quiet }
    }

    /// Prints a line of results to stdout, with control characters escaped.
    pub fn result(&self, line: &str) -> Result<()> {
        let line = one_line(line);
        let read_by_people = lock(&self.streams).read_by_people;
        if read_by_people { self.text(&terminal::wrapped(&line, terminal::columns())) } else { self.text(&line) }
    }

    /// Prints lines of results to stdout unchanged. Untrusted text in them must be escaped with [`one_line`]. A closed stdout is no error, because the
    /// results are also in files.
    pub fn text(&self, text: &str) -> Result<()> {
        let out = &mut lock(&self.streams).out;
        match writeln!(out, "{text}").and_then(|()| out.flush()) {
            Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("stdout", e, "printing the results")),
            _ => Ok(()),
        }
    }

    /// Writes a file given on the command line; `-` and `/dev/stdout` are stdout.
    pub fn write_file(&self, path: &Path, bytes: &[u8]) -> Result<()> {
        if !is_stdout(path) {
            return files::write_atomically(path, bytes);
        }
        let out = &mut lock(&self.streams).out;
        out.write_all(bytes).and_then(|()| out.flush()).map_err(|e| Error::io("stdout", e, "writing the file"))
    }

    /// Prints a message about a written file: to stdout, or to stderr if stdout is the file.
    pub fn wrote(&self, path: &Path, text: &str) -> Result<()> {
        if is_stdout(path) {
            self.note(text);
            return Ok(());
        }
        self.result(text)
    }

    /// Prints the results as a JSON object for programs, unless stdout is a terminal.
    pub fn record(&self, value: &impl Serialize) -> Result<()> {
        let read_by_people = lock(&self.streams).read_by_people;
        if read_by_people { Ok(()) } else { self.result(&json::line(value)?) }
    }

    /// Prints a note to stderr.
    pub fn note(&self, text: &str) {
        #[derive(Serialize)]
        struct Note<'t> {
            message: &'t str,
        }
        if !self.quiet {
            self.log("note", &Note { message: text }, || text.to_owned());
        }
    }

    /// The name of a written page: a `file://` address on a terminal, which can be clicked, and its path elsewhere.
    pub fn address(&self, page: &Path) -> String {
        if self.terminal { terminal::file_address(page) } else { page.display().to_string() }
    }

    /// Prints an error to stderr.
    pub fn error(&self, text: &str, exit_code: u8) {
        #[derive(Serialize)]
        struct Failure<'t> {
            message: &'t str,
            exit_code: u8,
        }
        self.log("error", &Failure { message: text, exit_code }, || format!("error: {text}"));
    }

    /// Prints an event to stderr, as JSON with its fields or as plain text.
    fn log(&self, event: &str, fields: &impl Serialize, plain: impl FnOnce() -> String) {
        #[derive(Serialize)]
        struct Line<'t, F> {
            /// Seconds since 1970.
            time: f64,
            event: &'t str,
            #[serde(flatten)]
            fields: &'t F,
        }
        let time = machine::time();
        match self.format {
            LogFormat::Plain if self.terminal => self.write(&terminal::wrapped(&one_line(&plain()), terminal::columns())),
            LogFormat::Plain => self.write(&one_line(&plain())),
            LogFormat::Json => self.write(&json::line(&Line { time, event, fields }).unwrap_or_else(|e| e.to_string())),
        }
    }

    fn write(&self, text: &str) {
        let bar = lock(&self.bar).clone();
        // A failure to print cannot be reported.
        let write = || drop(writeln!(lock(&self.streams).err, "{text}"));
        match bar {
            Some(bar) => bar.suspend(write),
            None => write(),
        }
    }

    /// Returns the result of drawing a picture. An error becomes a note, so that the run continues.
    pub fn drawn<R>(&self, done: Result<R>) -> Option<R> {
        done.map_err(|e| self.note(&format!("a picture was not written: {e}"))).ok()
    }

    /// Progress of a countable task, such as reading images.
    pub fn count(&self, what: &str, total: usize) -> Count<'_, 'a> {
        Count { meter: Meter::new(self, total as u64), what: what.to_owned() }
    }

    /// Progress of child processes, reported as lines of text.
    pub fn relay(&self, total: usize) -> Relay<'_, 'a> {
        Relay { meter: Meter::new(self, total as u64), total }
    }
}

/// True if the path is a name of stdout.
pub fn is_stdout(path: &Path) -> bool {
    ["-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"].iter().any(|name| path == Path::new(name))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A state of progress; its fields are those of the JSON object.
trait Standing: Serialize {
    /// Formats the state as a line of text.
    fn line(&self) -> String;

    /// Formats the state for display beside a bar, the most important part first, because narrow terminals truncate it.
    fn beside_bar(&self) -> String {
        self.line()
    }
}

/// A progress bar or progress lines.
struct Meter<'c, 'a> {
    console: &'c Console<'a>,
    bar: Option<ProgressBar>,
    shown: Mutex<Instant>,
}

impl<'c, 'a> Meter<'c, 'a> {
    fn new(console: &'c Console<'a>, total: u64) -> Self {
        let bar = console.bars.then(|| {
            let style = ProgressStyle::with_template("{bar:7} {percent:>3}%  {msg}").unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::with_draw_target(Some(total), terminal::bar_target()).with_style(style)
        });
        lock(&console.bar).clone_from(&bar);
        let shown = Mutex::new(Instant::now());
        Meter { console, bar, shown }
    }

    /// Shows the state if an update is due. If `must` is true, it is always shown, as a permanent line.
    fn show<S: Standing>(&self, (position, total): (u64, u64), must: bool, standing: impl FnOnce() -> S) {
        if self.console.quiet {
            return;
        }
        let every = if self.bar.is_some() { BAR_EVERY } else { LINE_EVERY };
        let mut shown = lock(&self.shown);
        if !must && shown.elapsed() < every {
            return;
        }
        *shown = Instant::now();
        let standing = standing();
        if let Some(bar) = &self.bar {
            bar.set_length(total);
            bar.set_position(position);
            bar.set_message(terminal::fitted(&one_line(&standing.beside_bar()), BAR_COLUMNS, terminal::columns()));
        }
        if must || self.bar.is_none() {
            self.console.log("progress", &standing, || standing.line());
        }
    }
}

impl Drop for Meter<'_, '_> {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
            *lock(&self.console.bar) = None;
        }
    }
}

/// Progress of a countable task.
pub struct Count<'c, 'a> {
    meter: Meter<'c, 'a>,
    what: String,
}

impl Count<'_, '_> {
    /// Reports that `done` of `total` items are done.
    pub fn at(&self, done: usize, total: usize) {
        // Only programs need a message at the end.
        let must = done == total && self.meter.console.format == LogFormat::Json;
        self.meter.show((done as u64, total as u64), must, || Counted { what: &self.what, done, total });
    }
}

/// Progress of child processes.
pub struct Relay<'c, 'a> {
    meter: Meter<'c, 'a>,
    total: usize,
}

impl Relay<'_, '_> {
    /// Reports that `done` processes have ended, and a line of the current one.
    pub fn say(&self, done: usize, line: impl FnOnce() -> String) {
        let total = self.total;
        self.meter.show((done as u64, total as u64), false, || Relayed { done, total, message: line() });
    }
}

/// Number of ended processes, and a line of the current one.
#[derive(Serialize)]
struct Relayed {
    done: usize,
    total: usize,
    message: String,
}

impl Standing for Relayed {
    fn line(&self) -> String {
        self.message.clone()
    }
}

/// Number of done items.
#[derive(Serialize)]
struct Counted<'w> {
    what: &'w str,
    done: usize,
    total: usize,
}

impl Standing for Counted<'_> {
    fn line(&self) -> String {
        format!("{}  {}/{}", self.what, self.done, self.total)
    }
}

/// Formats a number with about three digits, followed by a space and the prefix k or M.
fn metric(x: f64) -> String {
    match x {
        x if x >= 1e6 => format!("{:.2} M", x / 1e6),
        x if x >= 1e4 => format!("{:.0} k", x / 1e3),
        x => format!("{x:.0} "),
    }
}

/// Formats a number with narrow spaces between groups of three digits.
pub fn thousands(n: u64) -> String {
    let digits = n.to_string();
    let first = digits.len() % 3;
    let groups = (first..digits.len()).step_by(3).map(|at| &digits[at..at + 3]);
    [&digits[..first]].into_iter().filter(|group| !group.is_empty()).chain(groups).collect::<Vec<_>>().join("\u{202f}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!(metric(431_204.0) + "rays/s", "431 krays/s");
        assert_eq!([7, 999, 1000, 1_234_567].map(thousands), ["7", "999", "1\u{202f}000", "1\u{202f}234\u{202f}567"]);
    }
}
