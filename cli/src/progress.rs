//! The only printing: progress and notes to stderr, results to stdout.
//!
//! On a terminal progress is a bar; elsewhere, in a log file say, it is a plain line every few seconds and at the end of each stage. With
//! `--log-format json` each line on stderr is one JSON object, for programs.

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

/// Time between lines.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Time between changes of a bar: as often as an eye can follow.
const BAR_EVERY: Duration = Duration::from_millis(100);

/// Columns of a bar and its percentage.
const BAR_COLUMNS: usize = 14;

/// What is written to stderr.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Lines for people; on a terminal, bars.
    Plain,
    /// A JSON object on each line.
    Json,
}

/// Where everything is printed; usable from several threads.
pub struct Console<'a> {
    streams: Mutex<Streams<'a>>,
    /// The bar on the screen, if there is one: other lines must not be written through it.
    bar: Mutex<Option<ProgressBar>>,
    bars: bool,
    /// True if stderr is a terminal.
    terminal: bool,
    format: LogFormat,
    quiet: bool,
}

impl<'a> Console<'a> {
    /// A console on two streams. `quiet` leaves only errors and results.
    pub fn new(streams: Streams<'a>, format: LogFormat, quiet: bool) -> Self {
        let bars = streams.terminal && format == LogFormat::Plain && !quiet;
        let terminal = streams.terminal;
        Console { streams: Mutex::new(streams), bar: Mutex::new(None), bars, terminal, format, quiet }
    }

    /// A line of results on stdout, in which nothing does anything to a terminal.
    pub fn result(&self, line: &str) -> Result<()> {
        let line = one_line(line);
        let read_by_people = lock(&self.streams).read_by_people;
        if read_by_people { self.text(&terminal::wrapped(&line, terminal::columns())) } else { self.text(&line) }
    }

    /// Lines of results on stdout as they are: they were made here, and [`one_line`] was asked about what came from elsewhere. A reader that has
    /// gone away is no failure: the results are in files too.
    pub fn text(&self, text: &str) -> Result<()> {
        let out = &mut lock(&self.streams).out;
        match writeln!(out, "{text}").and_then(|()| out.flush()) {
            Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("stdout", e, "printing the result")),
            _ => Ok(()),
        }
    }

    /// Writes a file that the user named; `-` and `/dev/stdout` are stdout.
    pub fn write_file(&self, path: &Path, bytes: &[u8]) -> Result<()> {
        if !is_stdout(path) {
            return files::write_atomically(path, bytes);
        }
        let out = &mut lock(&self.streams).out;
        out.write_all(bytes).and_then(|()| out.flush()).map_err(|e| Error::io("stdout", e, "writing the result"))
    }

    /// Says what was written to a file: on stdout, or on stderr if stdout is the file.
    pub fn wrote(&self, path: &Path, text: &str) -> Result<()> {
        if is_stdout(path) {
            self.note(text);
            return Ok(());
        }
        self.result(text)
    }

    /// The same as a JSON object, for programs; nothing where people read it.
    pub fn record(&self, value: &impl Serialize) -> Result<()> {
        let read_by_people = lock(&self.streams).read_by_people;
        if read_by_people { Ok(()) } else { self.result(&json::line(value)?) }
    }

    /// A line of information on stderr.
    pub fn note(&self, text: &str) {
        #[derive(Serialize)]
        struct Note<'t> {
            message: &'t str,
        }
        if !self.quiet {
            self.log("note", &Note { message: text }, || text.to_owned());
        }
    }

    /// Returns the name of a page for a message: on a terminal an address that a click opens in the browser, elsewhere its path.
    pub fn address(&self, page: &Path) -> String {
        if self.terminal { terminal::file_address(page) } else { page.display().to_string() }
    }

    /// A line on stderr about why the command ends with an exit code.
    pub fn error(&self, text: &str, exit_code: u8) {
        #[derive(Serialize)]
        struct Failure<'t> {
            message: &'t str,
            exit_code: u8,
        }
        self.log("error", &Failure { message: text, exit_code }, || format!("error: {text}"));
    }

    /// A line on stderr: what happened with its figures, or the same for people.
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
        // Nobody can be told that stderr cannot be written.
        let write = || drop(writeln!(lock(&self.streams).err, "{text}"));
        match bar {
            Some(bar) => bar.suspend(write),
            None => write(),
        }
    }

    /// What came of drawing: a picture that cannot be written is no reason to lose what was learned.
    pub fn drawn<R>(&self, done: Result<R>) -> Option<R> {
        done.map_err(|e| self.note(&format!("no picture: {e}"))).ok()
    }

    /// Progress of something that is counted, such as images read.
    pub fn count(&self, what: &str, total: usize) -> Count<'_, 'a> {
        Count { meter: Meter::new(self, total as u64), what: what.to_owned() }
    }

    /// Progress of a number of things that other processes do, who tell of it in lines.
    pub fn relay(&self, total: usize) -> Relay<'_, 'a> {
        Relay { meter: Meter::new(self, total as u64), total }
    }
}

/// True for a name of stdout.
pub fn is_stdout(path: &Path) -> bool {
    ["-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"].iter().any(|name| path == Path::new(name))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// How far something is: its fields are what programs read.
trait Standing: Serialize {
    /// The same on a line for people.
    fn line(&self) -> String;

    /// The same beside a bar, the most important first, for a narrow terminal shows no more.
    fn beside_bar(&self) -> String {
        self.line()
    }
}

/// A bar or its lines.
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

    /// Shows how far it is, if it is time to or it must be; what must be shown stays as a line above the bar.
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

/// Progress of something that is counted.
pub struct Count<'c, 'a> {
    meter: Meter<'c, 'a>,
    what: String,
}

impl Count<'_, '_> {
    /// So many are done.
    pub fn at(&self, done: usize, total: usize) {
        // People see that it is over; programs are told.
        let must = done == total && self.meter.console.format == LogFormat::Json;
        self.meter.show((done as u64, total as u64), must, || Counted { what: &self.what, done, total });
    }
}

/// Progress of what other processes do.
pub struct Relay<'c, 'a> {
    meter: Meter<'c, 'a>,
    total: usize,
}

impl Relay<'_, '_> {
    /// So many things are done, and the one that is being done says this of itself.
    pub fn say(&self, done: usize, line: impl FnOnce() -> String) {
        let total = self.total;
        self.meter.show((done as u64, total as u64), false, || Relayed { done, total, message: line() });
    }
}

/// So many of how many, and how far the next one is.
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

/// So many of how many.
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

/// A number with three digits and k or M, and a space before the unit.
fn metric(x: f64) -> String {
    match x {
        x if x >= 1e6 => format!("{:.2} M", x / 1e6),
        x if x >= 1e4 => format!("{:.0} k", x / 1e3),
        x => format!("{x:.0} "),
    }
}

/// A number with spaces between its thousands.
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
