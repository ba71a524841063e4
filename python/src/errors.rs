//! The border to Python: library errors become exceptions with the same words, and no panic passes.

use plenoxel::error::Error;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// The exception classes, which `plenoxel/_errors.py` defines.
mod classes {
    pyo3::import_exception!(plenoxel._errors, SettingsError);
    pyo3::import_exception!(plenoxel._errors, InputError);
    pyo3::import_exception!(plenoxel._errors, NumericError);
    pyo3::import_exception!(plenoxel._errors, FileError);
    pyo3::import_exception!(plenoxel._errors, ArrayError);
    pyo3::import_exception!(plenoxel._errors, DtypeError);
    pyo3::import_exception!(plenoxel._errors, GradcheckError);
    pyo3::import_exception!(plenoxel._errors, StateError);
}

/// The exception of a library error. The key of a setting is spelled as an argument of Python: `--init-from` is `init_from`.
pub fn raised(error: Error) -> PyErr {
    let error = error.with_key(|key| match key.strip_prefix("--") {
        Some(flag) => flag.replace('-', "_"),
        None => key.to_owned(),
    });
    let text = error.to_string();
    match error {
        Error::Config { .. } => classes::SettingsError::new_err(text),
        Error::Input { .. } => classes::InputError::new_err(text),
        Error::Numeric { .. } => classes::NumericError::new_err(text),
        Error::Io { .. } => classes::FileError::new_err(text),
    }
}

/// The exception for an argument with an invalid value, with the form `key: invalid value V; expected E`.
pub fn invalid(key: &str, value: impl ToString, expected: &str) -> PyErr {
    raised(Error::config(key, value, expected))
}

/// The exception for an array or a tensor of the wrong shape or with unusable numbers: `place: problem; expected …`.
pub fn array(place: &str, problem: impl AsRef<str>, expected: impl AsRef<str>) -> PyErr {
    classes::ArrayError::new_err(format!("{place}: {}; {}", problem.as_ref(), expected.as_ref()))
}

/// The exception for an array or a tensor of the wrong type of numbers.
pub fn dtype(place: &str, problem: impl AsRef<str>, expected: impl AsRef<str>) -> PyErr {
    classes::DtypeError::new_err(format!("{place}: {}; {}", problem.as_ref(), expected.as_ref()))
}

/// The exception for something that is not possible any more, or not yet.
pub fn state(place: &str, problem: &str, remedy: &str) -> PyErr {
    classes::StateError::new_err(format!("{place}: {problem}; {remedy}"))
}

/// The exception of a failed gradient check.
pub fn gradcheck(message: impl ToString) -> PyErr {
    classes::GradcheckError::new_err(message.to_string())
}

/// Runs `work`. A panic, which would be a bug, becomes a `RuntimeError`.
pub fn guarded<R>(work: impl FnOnce() -> R) -> PyResult<R> {
    catch_unwind(AssertUnwindSafe(work)).map_err(|payload| {
        let message = payload.downcast_ref::<String>().map(String::as_str).or(payload.downcast_ref::<&str>().copied());
        PyRuntimeError::new_err(format!("a bug in plenoxel: {}", message.unwrap_or("a panic without a message")))
    })
}

/// Runs `work` without the lock of the interpreter, so that other threads of Python go on, and threads of the library may wait for each other.
pub fn compute<R: Send>(py: Python<'_>, work: impl FnOnce() -> R + Send) -> PyResult<R> {
    check_fork()?;
    py.detach(|| guarded(work))
}

/// Like [`compute`], for work that may fail.
pub fn attempt<R: Send>(py: Python<'_>, work: impl FnOnce() -> Result<R, Error> + Send) -> PyResult<R> {
    compute(py, work)?.map_err(raised)
}

/// True once this process may have started threads.
static USED: AtomicBool = AtomicBool::new(false);
/// True in a child that was forked from such a process: its copies of the threads do not run.
static FORKED: AtomicBool = AtomicBool::new(false);

/// Called in a child process after a fork.
#[pyfunction]
pub fn after_fork() {
    FORKED.store(USED.load(Relaxed), Relaxed);
}

/// Errors in a forked process that has lost the threads of its parent: waiting for them would never end.
pub fn check_fork() -> PyResult<()> {
    USED.store(true, Relaxed);
    match FORKED.load(Relaxed) {
        false => Ok(()),
        true => {
            let problem = "this process was forked after its parent had used plenoxel, and the threads were not copied";
            Err(state("fork", problem, "start processes with multiprocessing.get_context(\"spawn\")"))
        }
    }
}
