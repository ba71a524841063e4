//! Long work on a thread of its own, while the calling thread hands its messages to Python and watches for Ctrl-C.
//!
//! Messages come from any thread of the library. None of these threads waits for Python: a thread that holds the interpreter may itself wait for them.

use crate::errors::{check_fork, guarded};
use pyo3::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Interval at which signals are looked for.
const POLL: Duration = Duration::from_millis(50);

/// Runs `work` on another thread and calls `receive` with each message that it sends. An exception of `receive` or of a signal handler sets `stop`; it is returned
/// with the result of `work`, which is waited for.
///
/// Errors: the thread cannot be started; `work` panics.
pub fn run<M: Send, R: Send>(
    py: Python<'_>,
    stop: &Arc<AtomicBool>,
    work: impl FnOnce(Sender<M>) -> R + Send,
    mut receive: impl FnMut(M) -> PyResult<()>,
) -> PyResult<(R, Option<PyErr>)> {
    check_fork()?;
    let (sender, receiver) = mpsc::channel();
    let receiver = Mutex::new(receiver);
    let next = || receiver.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(POLL);
    let mut failure = None;
    thread::scope(|scope| {
        let worker = thread::Builder::new().name("plenoxel".to_owned()).spawn_scoped(scope, || guarded(|| work(sender)))?;
        loop {
            let message = py.detach(next);
            let heard = match message {
                Ok(message) if failure.is_none() => receive(message),
                Err(RecvTimeoutError::Disconnected) => break,
                _ => Ok(()),
            };
            if let Err(error) = heard.and_then(|()| py.check_signals()) {
                stop.store(true, Relaxed);
                failure.get_or_insert(error);
            }
        }
        let result = py.detach(|| worker.join()).unwrap_or_else(|_| guarded(|| panic!("the thread ended without a result")));
        Ok((result?, failure))
    })
}
