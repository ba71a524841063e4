//! Runs of a sweep on this machine, one after another or several at the same time.

use super::child::Program;
use super::job::{Job, State};
use super::said;
use crate::commands::table::Failure;
use crate::interrupt::Watch;
use crate::progress::{Console, Relay};
use plenoxel::error::Result;
use plenoxel::files;
use std::ffi::OsString;
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};
use std::sync::{Mutex, PoisonError};

/// Runs the program for the jobs of a sweep.
pub struct Runner<'a, 'c> {
    program: &'a Program,
    watch: &'a Watch,
    console: &'a Console<'c>,
    progress: Relay<'a, 'c>,
    /// Number of the sweep's jobs, and of those that have ended.
    of: usize,
    ended: AtomicUsize,
}

impl<'a, 'c> Runner<'a, 'c> {
    /// Runs jobs of a sweep that has `of` of them.
    pub fn new(program: &'a Program, watch: &'a Watch, console: &'a Console<'c>, of: usize) -> Self {
        Runner { program, watch, console, progress: console.relay(of), of, ended: AtomicUsize::new(0) }
    }

    /// Completes the jobs, up to `together` at the same time, and records failures. Returns the failures in the order of the jobs. A request to stop ends the
    /// current runs, and no others are started.
    pub fn finish_all<'j>(&self, jobs: &'j [Job], together: usize) -> Result<Vec<(&'j Job, Failure)>> {
        let (next, failed) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
        let work = || {
            while !self.watch.requested() {
                let index = next.fetch_add(1, SeqCst);
                let Some(job) = jobs.get(index) else { break };
                // After an error of the sweep itself, the others start no more runs.
                let failure = self.finish(job, index).inspect_err(|_| next.store(jobs.len(), SeqCst))?;
                failed.lock().unwrap_or_else(PoisonError::into_inner).extend(failure.map(|failure| (index, failure)));
                self.ended.fetch_add(1, SeqCst);
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            let workers: Vec<_> = (0..together.min(jobs.len())).map(|_| scope.spawn(work)).collect();
            workers.into_iter().try_for_each(|worker| worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })?;
        let mut failed = failed.into_inner().unwrap_or_else(PoisonError::into_inner);
        failed.sort_by_key(|(index, _)| *index);
        Ok(failed.into_iter().map(|(index, failure)| (&jobs[index], failure)).collect())
    }

    /// Completes the job with this index in the sweep. Returns its failure, if it failed. A failure that is not due to a request to stop is recorded.
    pub fn finish(&self, job: &Job, index: usize) -> Result<Option<Failure>> {
        let failure = self.complete(job, index)?.filter(|_| !self.watch.requested());
        failure.iter().try_for_each(|failure| job.remember(failure))?;
        Ok(failure)
    }

    fn complete(&self, job: &Job, index: usize) -> Result<Option<Failure>> {
        job.forget()?;
        let state = job.state();
        if state == State::Finished {
            self.note(job, index, &format!("already finished: {}", said(job)));
            return Ok(None);
        }
        files::create_dir(job.place())?;
        if !matches!(state, State::Interrupted | State::Unevaluated) {
            job.remove_log()?;
        }
        if let Some(arguments) = job.command_line(&state) {
            self.note(job, index, if state == State::Interrupted { "resuming" } else { "starting" });
            if let Err(failure) = self.process(job, index, &arguments)? {
                return Ok(Some(failure));
            }
        }
        if job.state() == State::Unevaluated {
            // The command writes the scores to the run folder.
            if let Err(failure) = self.process(job, index, &job.evaluation())? {
                return Ok(Some(failure));
            }
        }
        self.note(job, index, &said(job));
        Ok(None)
    }

    /// Runs the program, and returns its output on stdout, or its failure.
    fn process(&self, job: &Job, index: usize, arguments: &[OsString]) -> Result<std::result::Result<String, Failure>> {
        let say = |line: &str| self.progress.say(self.ended.load(SeqCst), || self.line(job, index, line));
        let ended = self.program.run(arguments, &job.log(), self.watch, say)?;
        if ended.code == 0 {
            return Ok(Ok(ended.out));
        }
        let failure = Failure { code: ended.code, error: ended.last };
        if !self.watch.requested() {
            self.note(job, index, &format!("failed with exit code {}: {}", failure.code, failure.error));
        }
        Ok(Err(failure))
    }

    fn note(&self, job: &Job, index: usize, text: &str) {
        self.console.note(&self.line(job, index, text));
    }

    fn line(&self, job: &Job, index: usize, text: &str) -> String {
        format!("{}/{} {} {}: {text}", index + 1, self.of, job.scene, job.method)
    }
}
