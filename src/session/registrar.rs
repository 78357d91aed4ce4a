//! Registers frames on a thread of its own, one at a time.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};

use super::SessionError;
use super::background::stand_back;
use super::event::{Event, Source};
use super::fault;
use super::log::SessionLog;
use super::posing::{PoseJob, Registered};
use super::sources::Ending;
use crate::reporter::Reporter;

/// Starts it; it ends when the sender is dropped.
///
/// # Errors
/// When the system gives no thread.
pub(super) fn start_registrar(log: Arc<SessionLog>, reporter: &Reporter) -> Result<Sender<PoseJob>, SessionError> {
    let (jobs, inbox) = channel::<PoseJob>();
    let ending = Ending::new(Source::Registrar, &log, reporter);
    std::thread::Builder::new()
        .name("registrar".to_owned())
        .spawn(move || {
            let _told = ending;
            stand_back();
            for job in inbox {
                fault::breaks("registrar", job.number());
                fault::hangs("register");
                fault::lags("slow-register");
                let attempt = catch_unwind(AssertUnwindSafe(|| job.clone().run()));
                let registered = attempt.unwrap_or_else(|_| {
                    Registered::failed(job, "looking for beads failed (a fault of this program); the log has the frame")
                });
                log.tell(Event::Registered(Box::new(registered)));
            }
        })
        .map_err(|source| SessionError::Thread { source })?;
    Ok(jobs)
}
