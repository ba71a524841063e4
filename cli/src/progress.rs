//! The only printing: progress and notes to stderr, results to stdout.
//!
//! On a terminal progress is a bar; elsewhere, in a log file say, it is a plain line every few seconds and at the end of each stage.

use crate::Streams;
use indicatif::{ProgressBar, ProgressStyle};
use plenoxel::error::{Error, Result};
use plenoxel::train::{PlannedStage, Report};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time between plain lines.
const LINE_EVERY: Duration = Duration::from_secs(5);
/// Time between changes of a bar: as often as an eye can follow.
const BAR_EVERY: Duration = Duration::from_millis(100);

/// Where everything is printed; usable from several threads.
pub struct Console<'a> {
    streams: Mutex<Streams<'a>>,
    /// The bar on the screen, if there is one: other lines must not be written through it.
    bar: Mutex<Option<ProgressBar>>,
    terminal: bool,
    quiet: bool,
}

impl<'a> Console<'a> {
    /// A console on two streams. `quiet` leaves only errors and results.
    pub fn new(streams: Streams<'a>, quiet: bool) -> Self {
        let terminal = streams.terminal;
        Console { streams: Mutex::new(streams), bar: Mutex::new(None), terminal, quiet }
    }

    /// A line of results on stdout. A reader that has gone away is no failure: the results are in files too.
    pub fn result(&self, text: &str) -> Result<()> {
        let out = &mut lock(&self.streams).out;
        match writeln!(out, "{text}").and_then(|()| out.flush()) {
            Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("stdout", e, "printing the result")),
            _ => Ok(()),
        }
    }

    /// A line of information on stderr.
    pub fn note(&self, text: &str) {
        if !self.quiet {
            self.write(text);
        }
    }

    /// A line about a failure on stderr.
    pub fn error(&self, text: &str) {
        self.write(&format!("error: {text}"));
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

    /// Progress of something that is counted, such as images read.
    pub fn count(&self, what: &str, total: usize) -> Count<'_, 'a> {
        Count { meter: Meter::new(self, total as u64), what: what.to_owned() }
    }

    /// Progress of a number of things that other processes do, who tell of it in lines.
    pub fn relay(&self, total: usize) -> Relay<'_, 'a> {
        Relay { meter: Meter::new(self, total as u64) }
    }

    /// Progress of a training run that has taken so many seconds.
    pub fn training(&self, plan: &[PlannedStage], prune_from_stage: Option<usize>, seconds: f64) -> Training<'_, 'a> {
        let total = plan.iter().map(|p| p.steps).sum();
        Training {
            meter: Meter::new(self, total),
            plan: plan.to_vec(),
            prune_from_stage,
            total,
            rays: 0,
            mse: Smoothed::new(0.01),
            loss: Smoothed::new(0.01),
            samples: Smoothed::new(0.05),
            step_seconds: Smoothed::new(0.05),
            seconds,
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A bar or its plain lines.
struct Meter<'c, 'a> {
    console: &'c Console<'a>,
    bar: Option<ProgressBar>,
    shown: Mutex<Instant>,
}

impl<'c, 'a> Meter<'c, 'a> {
    fn new(console: &'c Console<'a>, total: u64) -> Self {
        let bar = (console.terminal && !console.quiet).then(|| {
            let style =
                ProgressStyle::with_template("{bar:12} {percent:>3} %  {wide_msg}").unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::new(total).with_style(style)
        });
        lock(&console.bar).clone_from(&bar);
        let shown = Mutex::new(Instant::now());
        Meter { console, bar, shown }
    }

    /// Shows a position, if it is time to or it must be.
    fn show(&self, position: u64, must: bool, line: impl FnOnce() -> String) {
        if self.console.quiet {
            return;
        }
        let every = if self.bar.is_some() { BAR_EVERY } else { LINE_EVERY };
        let mut shown = lock(&self.shown);
        if !must && shown.elapsed() < every {
            return;
        }
        *shown = Instant::now();
        match &self.bar {
            Some(bar) => {
                bar.set_position(position);
                bar.set_message(line());
            }
            None => self.console.write(&line()),
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
        let line = || format!("{}  {done}/{total}", self.what);
        self.meter.show(done as u64, false, line);
    }
}

/// Progress of what other processes do.
pub struct Relay<'c, 'a> {
    meter: Meter<'c, 'a>,
}

impl Relay<'_, '_> {
    /// So many things are done, and the one that is being done says this of itself.
    pub fn say(&self, done: usize, line: impl FnOnce() -> String) {
        self.meter.show(done as u64, false, line);
    }
}

/// A mean that forgets: each value moves it by `share` of the way, the first ones by more, so that it starts without a bias.
#[derive(Debug, Clone, Copy)]
struct Smoothed {
    share: f64,
    count: f64,
    value: f64,
}

impl Smoothed {
    fn new(share: f64) -> Self {
        Smoothed { share, count: 0.0, value: 0.0 }
    }

    fn add(&mut self, value: f64) {
        self.count += 1.0;
        self.value += (value - self.value) * self.share.max(1.0 / self.count);
    }
}

/// Progress of a training run.
pub struct Training<'c, 'a> {
    meter: Meter<'c, 'a>,
    plan: Vec<PlannedStage>,
    prune_from_stage: Option<usize>,
    total: u64,
    rays: u64,
    mse: Smoothed,
    loss: Smoothed,
    samples: Smoothed,
    step_seconds: Smoothed,
    seconds: f64,
}

impl Training<'_, '_> {
    /// A step was taken; `seconds` of training have passed.
    pub fn step(&mut self, report: &Report, seconds: f64) {
        let took = seconds - self.seconds;
        self.seconds = seconds;
        self.rays += report.rays as u64;
        self.mse.add(10f64.powf(-0.1 * report.psnr));
        self.loss.add(report.loss);
        if report.step == self.plan[report.stage].first {
            // The first step of a stage also makes its grid: it says nothing about the next ones.
            (self.step_seconds, self.samples) = (Smoothed::new(0.05), Smoothed::new(0.05));
        } else {
            self.step_seconds.add(took);
        }
        self.samples.add(report.samples as f64 / report.rays.max(1) as f64);
        let line = || self.line(report);
        self.meter.show(report.step + 1, report.ends_stage, line);
    }

    fn line(&self, report: &Report) -> String {
        let stage = &self.plan[report.stage].stage;
        let pace = match self.step_seconds.value {
            0.0 => String::new(),
            step => format!("{:.1} it/s  {}rays/s  ", 1.0 / step, metric(report.rays as f64 / step)),
        };
        format!(
            "stage {}/{} ({}³)  step {}/{}  ETA {}  loss {:.5}  psnr {:.2} dB  {pace}{:.0} samples/ray",
            report.stage + 1,
            self.plan.len(),
            stage.resolution,
            report.step + 1,
            self.total,
            clock(self.remaining(report)),
            self.loss.value,
            -10.0 * self.mse.value.log10(),
            self.samples.value,
        )
    }

    /// Seconds to go: this stage at its pace, later ones at a pace in proportion to their resolution, as their samples are, and three
    /// times faster once empty space is left out.
    fn remaining(&self, report: &Report) -> f64 {
        let now = &self.plan[report.stage];
        let step = match self.step_seconds.count {
            // The first of a stage: as all before it, on the mean.
            0.0 => self.seconds / (report.step + 1) as f64,
            _ => self.step_seconds.value,
        };
        let samples = |index: usize| {
            let pruned = self.prune_from_stage.is_some_and(|first| index >= first);
            self.plan[index].stage.resolution as f64 / if pruned { 3.0 } else { 1.0 }
        };
        let here = (now.first + now.steps - report.step - 1) as f64;
        let later = (report.stage + 1..self.plan.len()).map(|i| self.plan[i].steps as f64 * samples(i) / samples(report.stage));
        step * (here + later.sum::<f64>())
    }
}

/// Minutes and seconds, with hours where there are any.
pub fn clock(seconds: f64) -> String {
    let s = seconds.max(0.0).round() as u64;
    match s / 3600 {
        0 => format!("{}:{:02}", s / 60, s % 60),
        h => format!("{h}:{:02}:{:02}", s / 60 % 60, s % 60),
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

/// Bytes as people say them.
pub fn bytes(n: u64) -> String {
    match n as f64 {
        n if n >= 1e10 => format!("{:.0} GB", n / 1e9),
        n if n >= 1e9 => format!("{:.1} GB", n / 1e9),
        n if n >= 1e6 => format!("{:.0} MB", n / 1e6),
        n => format!("{:.0} kB", n / 1e3),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_and_sizes_read_well() {
        assert_eq!(clock(3.4), "0:03");
        assert_eq!(clock(59.6), "1:00");
        assert_eq!(clock(3725.0), "1:02:05");
        assert_eq!(metric(431_204.0) + "rays/s", "431 krays/s");
        assert_eq!(bytes(2_345_678_901), "2.3 GB");
        assert_eq!(bytes(99_000), "99 kB");
    }

    #[test]
    fn a_smoothed_value_starts_as_the_plain_mean() {
        let mut mean = Smoothed::new(0.1);
        [1.0, 2.0, 6.0].into_iter().for_each(|x| mean.add(x));
        assert!((mean.value - 3.0).abs() < 1e-12);
    }
}
