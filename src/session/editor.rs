//! The person who edits beads in the window, as the session's thread hears of it: requests come by a channel, are logged as inputs in an
//! order that a replay has again, and their poses are solved on a thread of their own, one after the other.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

use super::SessionError;
use super::busy::{Busy, Task};
use super::edit::EditRequest;
use super::editing::EditJob;
use super::event::{Event, Source};
use super::log::SessionLog;
use super::sources::Ending;
use crate::reporter::Reporter;

/// See the module.
pub(super) struct Editor {
    requests: Receiver<EditRequest>,
    jobs: Sender<EditJob>,
    /// Edits that are not logged yet.
    waiting: Vec<EditRequest>,
    /// Edits that were logged and are not posed, or refused, yet.
    open: usize,
}

impl Editor {
    /// Starts the thread; it ends with the editor.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn start(
        requests: Receiver<EditRequest>,
        log: Arc<SessionLog>,
        busy: &Busy,
        reporter: &Reporter,
    ) -> Result<Self, SessionError> {
        let (jobs, inbox) = channel::<EditJob>();
        let busy = busy.clone();
        let ending = Ending::new(Source::Editor, &log, reporter);
        // Somebody waits for it: it does not stand back.
        std::thread::Builder::new()
            .name("editor".to_owned())
            .spawn(move || {
                let _told = ending;
                for job in inbox {
                    let _at_work = busy.begin(Task::Registering(job.number()));
                    let attempt = catch_unwind(AssertUnwindSafe(|| job.clone().run()));
                    let posed = attempt.unwrap_or_else(|_| {
                        job.failed("posing it with its edits failed (a fault of this program); the log has both")
                    });
                    log.tell(Event::Edited(Box::new(posed)));
                }
            })
            .map_err(|source| SessionError::Thread { source })?;
        Ok(Self { requests, jobs, waiting: Vec::new(), open: 0 })
    }

    /// Requests that may be logged now: no edit while a frame is registered, for a replay registers at once. Each edit counts as open until
    /// [`Editor::done`]. Notes wait for nothing.
    pub(super) fn take(&mut self, is_registering: bool) -> Vec<EditRequest> {
        self.waiting.extend(self.requests.try_iter().filter(|request| request.edit.is_finite()));
        let is_due = |request: &EditRequest| request.edit.is_note() || !is_registering;
        let (now, waiting): (Vec<_>, Vec<_>) = std::mem::take(&mut self.waiting).into_iter().partition(is_due);
        self.waiting = waiting;
        self.open += now.iter().filter(|request| !request.edit.is_note()).count();
        now
    }

    /// Has an edited frame posed; false where the thread has died.
    pub(super) fn submit(&self, job: EditJob) -> bool {
        self.jobs.send(job).is_ok()
    }

    /// An edit has come to its pose, or to nothing.
    pub(super) fn done(&mut self) {
        self.open = self.open.saturating_sub(1);
    }

    /// The thread died: nothing comes of what it had.
    pub(super) fn give_up(&mut self) {
        self.open = 0;
    }

    /// Whether every edit that was logged has come to its end.
    pub(super) fn is_idle(&self) -> bool {
        self.open == 0
    }
}
