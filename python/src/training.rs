//! Training runs: `train` and `resume`.

use crate::background;
use crate::errors::{invalid, raised};
use crate::events::Message;
use crate::loss::{Failure, Loss, Losses, Param};
use crate::scene::Scene;
use crate::settings::resolve;
use plenoxel::error::{Error, Result};
use plenoxel::run::machine;
use plenoxel::run::training::{Event, Listener, MakeLosses, Outcome, RunOptions, RunSettings, resume_adding, train_adding};
use plenoxel::text::duration;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::Sender;

/// How a run ended: its folder, the steps that it took, and those of its plan. It has final figures if `finished`.
#[pyclass(module = "plenoxel._plenoxel", frozen, get_all)]
pub struct Ended {
    folder: PathBuf,
    finished: bool,
    steps: u64,
    total: u64,
}

/// Arguments of a run besides its settings: losses, listener, checkpoints, evaluation and page.
#[derive(FromPyObject)]
pub struct Extras<'py> {
    /// Losses: name, weight, function.
    #[pyo3(item)]
    pub losses: Vec<Loss>,
    #[pyo3(item)]
    pub params: Vec<Py<Param>>,
    /// Called with each event; `None` for no callback.
    #[pyo3(item)]
    pub listener: Option<Bound<'py, PyAny>>,
    #[pyo3(item)]
    pub checkpoint_every: Bound<'py, PyAny>,
    #[pyo3(item)]
    pub test_views: Option<usize>,
    /// Write pictures and the report.
    #[pyo3(item)]
    pub page: bool,
    #[pyo3(item)]
    pub threads: Option<usize>,
}

/// Trains a model of a scene.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they are the arguments of a function of Python")]
pub fn train(
    py: Python<'_>,
    scene: &Scene,
    preset: Option<&str>,
    config: Option<PathBuf>,
    settings: &Bound<'_, PyDict>,
    time: Option<&Bound<'_, PyAny>>,
    out: Option<PathBuf>,
    force: bool,
    extras: Extras<'_>,
) -> PyResult<Ended> {
    let (config, preset) = resolve(preset, "fast", config.as_ref(), settings)?;
    let time = time.map(|time| seconds("time", time)).transpose()?;
    let (preset, data) = (preset.map(str::to_owned), scene.source.clone());
    run(py, extras, move |options, losses, on| {
        let settings = RunSettings { preset, out, force, time, options, ..RunSettings::new(config, data) };
        train_adding(&settings, losses, on)
    })
}

/// Resumes a stopped run.
#[pyfunction]
pub fn resume(py: Python<'_>, folder: PathBuf, scene: Option<&Scene>, extras: Extras<'_>) -> PyResult<Ended> {
    let data = scene.map(|scene| scene.source.clone());
    run(py, extras, move |options, losses, on| resume_adding(&folder, data, &options, losses, on))
}

/// Runs `work` in the background with its losses and its listener.
fn run(
    py: Python<'_>,
    extras: Extras<'_>,
    work: impl FnOnce(RunOptions, &MakeLosses<'_>, &mut Listener<'_>) -> Result<Outcome> + Send,
) -> PyResult<Ended> {
    let Extras { losses, params, listener, checkpoint_every, test_views, page, threads } = extras;
    let (failure, stop) = (Failure::default(), Arc::new(AtomicBool::new(false)));
    let losses = Losses::new(py, losses, params, failure.clone())?;
    let asked = stop.clone();
    let options = RunOptions {
        checkpoint_every: seconds("checkpoint_every", &checkpoint_every)?,
        preview_every: f64::INFINITY,
        test_views: test_views.unwrap_or(usize::MAX),
        report: page,
        stop: Box::new(move || asked.load(Relaxed)),
        ..RunOptions::default()
    };
    let training = |tell: &(dyn Fn(Message) + Sync)| {
        let make = || losses.objective();
        let tell = |event: &Event<'_>| Message::of(event).into_iter().for_each(tell);
        match page {
            false => work(options, &make, &mut |event| tell(&event)),
            true => {
                let (outcome, written) = plenoxel_cli::with_pages(|pages| {
                    work(options, &make, &mut |event| {
                        tell(&event);
                        pages(event);
                    })
                });
                written.and(outcome)
            }
        }
    };
    let (outcome, heard) = in_background(py, listener.as_ref(), threads, &stop, training)?;
    // A loss that failed has made the loss NaN, which the library reports as such.
    if let Some(error) = failure.take() {
        return Err(error);
    }
    let outcome = outcome.map_err(raised)?;
    let ended = match outcome {
        Outcome::Done(summary) => Ended { folder: PathBuf::from(&summary.run), finished: true, steps: summary.steps, total: summary.steps },
        Outcome::Stopped { steps, total, folder } => Ended { folder: folder.path().to_owned(), finished: false, steps, total },
    };
    match heard {
        Some(error) if !error.is_instance_of::<pyo3::exceptions::PyKeyboardInterrupt>(py) => Err(error),
        _ => Ok(ended),
    }
}

/// Runs `work` in the background with a number of threads. It is given a function that hands messages to `listener`. An exception of `listener`, or Ctrl-C, sets
/// `stop`; it is returned with the result.
///
/// Errors: there cannot be so many threads.
pub fn in_background<R: Send>(
    py: Python<'_>,
    listener: Option<&Bound<'_, PyAny>>,
    threads: Option<usize>,
    stop: &Arc<AtomicBool>,
    work: impl FnOnce(&(dyn Fn(Message) + Sync)) -> Result<R> + Send,
) -> PyResult<(Result<R>, Option<PyErr>)> {
    if let Some(threads) = threads.filter(|threads| !(1..=machine::MOST_THREADS).contains(threads)) {
        return Err(invalid("threads", threads, &format!("1 to {}", machine::MOST_THREADS)));
    }
    let hears = listener.is_some();
    let working = |sender: Sender<Message>| {
        let run = || {
            work(&|message| {
                if hears {
                    // Nobody listens after an exception.
                    drop(sender.send(message));
                }
            })
        };
        match threads {
            None => run(),
            Some(_) => machine::with_threads(threads, run)?,
        }
    };
    let hear = |message: Message| match listener {
        Some(listener) => listener.call1((message.to_dict(py)?,)).map(drop),
        None => Ok(()),
    };
    background::run(py, stop, working, hear)
}

/// Seconds of a number, or of a text such as "90s", "5m" or "1h".
pub fn seconds(key: &str, value: &Bound<'_, PyAny>) -> PyResult<f64> {
    let text = value.str()?.to_string();
    duration(&text).map_err(|expected| raised(Error::usage(key, format!("invalid value {text}"), expected)))
}

/// Writes report.html of a run.
#[pyfunction]
pub fn write_report(py: Python<'_>, folder: PathBuf, scene: Option<&Scene>) -> PyResult<()> {
    let data = scene.map(|scene| scene.source.clone());
    crate::errors::attempt(py, || plenoxel_cli::write_report(&folder, data))
}

/// Runs the program `plenoxel` with arguments, of which the first is its name. Returns its exit code.
#[pyfunction]
pub fn program(py: Python<'_>, args: Vec<String>) -> PyResult<u8> {
    use std::io::IsTerminal;
    crate::errors::compute(py, || {
        let (mut out, mut err) = (std::io::stdout(), std::io::stderr());
        let (terminal, read_by_people) = (err.is_terminal(), out.is_terminal());
        plenoxel_cli::run(args, plenoxel_cli::Streams { out: &mut out, err: &mut err, terminal, read_by_people })
    })
}
