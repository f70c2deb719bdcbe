//! How an operation is run: cancellation, progress and the memory limit.
//!
//! What is asked (an operator's parameters), how it is solved ([`SolverOptions`](crate::pde::SolverOptions)) and how it is
//! run ([`RunOptions`]) are three structs. This is the third; every long loop of the library takes it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::error::{EditError, Result};

/// Receives the progress of a long operation. All methods may be called from any thread.
pub trait Progress: Send + Sync {
    /// A task of `total` units begins; 0 means that the amount is not known.
    fn begin(&self, task: &str, total: u64);
    /// `done` more units are finished.
    fn advance(&self, done: u64);
    /// The task is finished or abandoned.
    fn end(&self);
}

/// Cancellation, progress and the memory limit of one run. Cheap to clone; clones share the cancel flag.
#[derive(Clone, Default)]
pub struct RunOptions {
    /// Bytes that the run may use; `None` is no limit.
    pub memory_limit: Option<u64>,
    /// Bytes in use, of the limit, before more is reserved.
    in_use: Option<fn() -> u64>,
    cancel: Arc<AtomicBool>,
    progress: Option<Arc<dyn Progress>>,
}

impl RunOptions {
    /// The same run, reporting to `progress`.
    pub fn with_progress(mut self, progress: Arc<dyn Progress>) -> Self {
        self.progress = Some(progress);
        self
    }

    /// The same run, whose memory limit is for all that `in_use` says, what was there before included: for a process of its own.
    pub fn with_memory_in_use(mut self, in_use: fn() -> u64) -> Self {
        self.in_use = Some(in_use);
        self
    }

    /// The flag that cancels the run when set, from a signal handler for instance.
    pub fn cancel_flag(&self) -> Arc<AtomicBool> {
        self.cancel.clone()
    }

    /// Whether the run was cancelled: for loops inside a parallel task, which leave early and let the caller report.
    pub fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// [`EditError::Cancelled`] if the run was cancelled.
    pub fn check(&self, operation: &str) -> Result<()> {
        if self.is_cancelled() { Err(EditError::Cancelled { operation: operation.into() }) } else { Ok(()) }
    }

    /// Bytes of the limit that are in use; 0 where the limit is for the run alone.
    pub fn memory_in_use(&self) -> u64 {
        self.in_use.map_or(0, |in_use| in_use())
    }

    /// [`EditError::Memory`] if `bytes` more than what is in use would exceed the limit; `advice` says what needs less.
    pub fn reserve(&self, operation: &str, bytes: u64, advice: &str) -> Result<()> {
        match self.memory_limit {
            Some(_) => self.reserve_since(self.memory_in_use(), operation, bytes, advice),
            None => Ok(()),
        }
    }

    /// As [`reserve`](Self::reserve), for work that takes its memory bit by bit: `bytes` in all since `before` were in use.
    pub fn reserve_since(&self, before: u64, operation: &str, bytes: u64, advice: &str) -> Result<()> {
        let needed = before.saturating_add(bytes);
        match self.memory_limit {
            Some(limit) if needed > limit => {
                Err(EditError::Memory { operation: operation.into(), needed, limit, advice: advice.into() })
            }
            _ => Ok(()),
        }
    }

    /// Begins a task of `total` units on the progress display; it ends when the returned guard is dropped.
    pub fn task(&self, name: &str, total: u64) -> Task<'_> {
        if let Some(progress) = &self.progress {
            progress.begin(name, total);
        }
        Task { run: self }
    }
}

/// A running task on the progress display.
pub struct Task<'a> {
    run: &'a RunOptions,
}

impl Task<'_> {
    /// `done` more units are finished.
    pub fn advance(&self, done: u64) {
        if let Some(progress) = &self.run.progress {
            progress.advance(done);
        }
    }
}

impl Drop for Task<'_> {
    fn drop(&mut self) {
        if let Some(progress) = &self.run.progress {
            progress.end();
        }
    }
}
