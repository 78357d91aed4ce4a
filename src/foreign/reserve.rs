//! A helper that has started before it is needed, and reads one file after the other. Starting takes longer than reading a radiograph (the
//! program links to many libraries), and of a file that is not in the log yet a kill -9 leaves only the file.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::{Mutex, PoisonError};

use super::process::Process;

/// After so many files a helper gives way to a fresh one: what decoders keep is never more than these leave.
const MOST_FILES: u32 = 200;

/// One started helper of `program` that waits for its next file.
#[derive(Debug)]
pub struct Reserve {
    program: PathBuf,
    ready: Mutex<Option<Standing>>,
}

/// A helper that gets its requests and files through a pipe, and how many it has served.
#[derive(Debug)]
pub(super) struct Standing {
    pub(super) process: Process,
    pub(super) served: u32,
}

impl Reserve {
    /// Starts the first one.
    pub(super) fn of(program: &Path) -> Self {
        let reserve = Self { program: program.to_owned(), ready: Mutex::default() };
        reserve.refill();
        reserve
    }

    /// The helper that stands ready, else a fresh one. One that has ended stands no more: a machine short of memory ends whom it likes.
    pub(super) fn take(&self) -> std::io::Result<Standing> {
        let mut ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner).take();
        match ready.take_if(|ready| ready.process.is_alive()) {
            Some(ready) => Ok(ready),
            None => self.fresh(),
        }
    }

    fn fresh(&self) -> std::io::Result<Standing> {
        Ok(Standing { process: Process::start(&self.program, None, Stdio::piped())?, served: 0 })
    }

    /// Process number of the helper that stands ready.
    pub(super) fn waiting(&self) -> Option<u32> {
        let ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner);
        ready.as_ref()?.process.id()
    }

    /// One that has served a file well, to its last byte.
    pub(super) fn give_back(&self, mut standing: Standing) {
        standing.served += 1;
        let mut ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner);
        if ready.is_none() && standing.served < MOST_FILES {
            *ready = Some(standing);
        }
    }

    /// Starts one where there is none. One that cannot be started is no matter: whoever needs it starts its own, and hears why it fails.
    pub(super) fn refill(&self) {
        let mut ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner);
        if ready.is_none() {
            *ready = self.fresh().ok();
        }
    }
}
