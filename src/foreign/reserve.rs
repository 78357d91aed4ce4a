//! A helper that has started before it is needed. Starting takes longer than reading a radiograph (the program links to many libraries),
//! and of a file that is not in the log yet a kill -9 leaves only the file.

use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::{Mutex, PoisonError};

use super::process::{kill_and_reap, spawn};

/// One started helper of `program` that waits for its request.
#[derive(Debug)]
pub struct Reserve {
    program: PathBuf,
    ready: Mutex<Option<Ready>>,
}

/// A helper that knows neither its request nor its file yet. Dropped, it ends.
#[derive(Debug)]
struct Ready(Option<Child>);

impl Reserve {
    /// Starts the first one.
    pub(super) fn of(program: &Path) -> Self {
        let reserve = Self { program: program.to_owned(), ready: Mutex::default() };
        reserve.refill();
        reserve
    }

    /// The helper that stands ready; `None` when there is none, or it has ended (a machine short of memory ends whom it likes).
    pub(super) fn take(&self) -> Option<Child> {
        let mut child = self.ready.lock().unwrap_or_else(PoisonError::into_inner).take()?.0.take()?;
        match child.try_wait() {
            Ok(None) => Some(child),
            _ => None,
        }
    }

    /// Process number of the helper that stands ready.
    pub(super) fn waiting(&self) -> Option<u32> {
        let ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner);
        ready.as_ref()?.0.as_ref().map(Child::id)
    }

    /// Starts one where there is none. One that cannot be started is no matter: whoever needs it starts its own, and hears why it fails.
    pub(super) fn refill(&self) {
        let mut ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner);
        if ready.is_none() {
            *ready = spawn(&self.program, None, Stdio::piped()).ok().map(|child| Ready(Some(child)));
        }
    }
}

impl Drop for Ready {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            kill_and_reap(&mut child);
        }
    }
}
