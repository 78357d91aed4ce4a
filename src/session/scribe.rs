//! The scribe: a thread that records pairs and writes their files. What cannot be written is counted and said, and stops nothing.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use super::SessionError;
use super::background::stand_back;
use super::board::Board;
use super::broadcast::Broadcast;
use super::busy::{Busy, HANGS_AFTER, Task};
use super::chime::Chime;
use super::developed::Developed;
use super::fault;
use super::folder::Collector;
use super::input::Input;
use super::log::SessionLog;
use super::pair_view::PairView;
use crate::report::PairStatus;
use crate::reporter::Reporter;
use crate::time::{Stopwatch, host_now_us};

/// Pairs that wait for a slow disk; then the workshop waits, and once many posed frames wait for it, those that are not posed yet.
const QUEUE: usize = 4;
/// How often the scribe looks whether it is to leave.
const LOOK: Duration = Duration::from_millis(100);
/// How often whoever leaves at once looks whether the scribe has come.
const JOIN: Duration = Duration::from_millis(5);
/// So long a strip waits for its null to begin: where other frames come first it is written as it is.
const STRIP_WAITS_MS: f64 = 1000.0;

/// See the module.
pub(super) struct Scribe {
    thread: std::thread::JoinHandle<Collector>,
    complete: Arc<AtomicUsize>,
    leave: Arc<AtomicBool>,
    died: Arc<AtomicBool>,
}

/// Notes that the thread died; one whose pairs have ended ends as well, and did not.
struct Death(Arc<AtomicBool>);

impl Drop for Death {
    fn drop(&mut self) {
        self.0.store(std::thread::panicking(), Ordering::Relaxed);
    }
}

impl Scribe {
    /// Starts the thread; pairs go into the sender.
    pub(super) fn start(
        collector: Collector,
        log: Arc<SessionLog>,
        board: Board,
        (broadcast, busy, chime): (Arc<Broadcast>, &Busy, Option<Chime>),
        reporter: &Reporter,
    ) -> Result<(Self, SyncSender<Developed>), SessionError> {
        let (sender, inbox) = sync_channel(QUEUE);
        let (complete, leave) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        let work = Work {
            collector,
            log,
            board,
            broadcast,
            busy: busy.clone(),
            chime,
            reporter: reporter.clone(),
            complete: Arc::clone(&complete),
            completed: BTreeSet::new(),
        };
        let (left, died) = (Arc::clone(&leave), Arc::default());
        let death = Death(Arc::clone(&died));
        let thread = std::thread::Builder::new().name("scribe".to_owned()).spawn(move || {
            let _death = death;
            stand_back();
            work.run(&inbox, &left)
        });
        let thread = thread.map_err(|source| SessionError::Thread { source })?;
        Ok((Self { thread, complete, leave, died }, sender))
    }

    /// Pairs that are as complete as they get.
    pub(super) fn complete(&self) -> usize {
        self.complete.load(Ordering::Relaxed)
    }

    /// Whether the thread has ended.
    pub(super) fn has_ended(&self) -> bool {
        self.thread.is_finished()
    }

    /// Whether it ended because of a fault of this program.
    pub(super) fn has_died(&self) -> bool {
        self.died.load(Ordering::Relaxed)
    }

    /// What waits is not written any more.
    pub(super) fn leave(&self) {
        self.leave.store(true, Ordering::Relaxed);
    }

    /// Waits for the thread, within a `limit` where somebody leaves at once; in words, what became of it where it does not come.
    pub(super) fn join(self, limit: Option<Duration>) -> Result<Collector, &'static str> {
        if let Some(limit) = limit {
            let watch = Stopwatch::start();
            while !self.thread.is_finished() {
                if watch.ms() >= 1e3 * limit.as_secs_f64() {
                    return Err("stands still");
                }
                std::thread::sleep(JOIN);
            }
        }
        self.thread.join().map_err(|_| "died")
    }
}

struct Work {
    collector: Collector,
    log: Arc<SessionLog>,
    board: Board,
    broadcast: Arc<Broadcast>,
    busy: Busy,
    chime: Option<Chime>,
    reporter: Reporter,
    complete: Arc<AtomicUsize>,
    completed: BTreeSet<u32>,
}

impl Work {
    fn run(mut self, inbox: &Receiver<Developed>, leave: &AtomicBool) -> Collector {
        loop {
            match inbox.recv_timeout(LOOK) {
                Ok(_) | Err(_) if leave.load(Ordering::Relaxed) => return self.collector,
                Ok(developed) => self.take(developed),
                Err(RecvTimeoutError::Timeout) => {
                    let failure = self.collector.write_pairs_if_due();
                    self.say(failure);
                }
                Err(RecvTimeoutError::Disconnected) => return self.collector,
            }
            self.write_strips();
        }
    }

    /// Writes the strips whose null is not coming soon.
    fn write_strips(&mut self) {
        let at_work = self.busy.longer_than(Duration::ZERO);
        let is_due = |(number, waited_ms): &(u32, f64)| {
            let of_it = [Task::Developing(*number), Task::Null(*number)];
            let making = at_work.iter().find(|(task, _)| of_it.contains(task));
            strip_is_due(*waited_ms, making.map(|(_, taken)| *taken))
        };
        let due: Vec<(u32, f64)> = self.collector.waiting().filter(is_due).collect();
        for (number, _) in due {
            let _at_work = self.busy.begin(Task::Writing(number));
            let failure = self.collector.write_waiting(number);
            self.say(failure);
        }
    }

    fn take(&mut self, developed: Developed) {
        fault::breaks("scribe", developed.posed.number);
        let _at_work = self.busy.begin(Task::Writing(developed.posed.number));
        let (number, time_us, complete) = (developed.posed.number, developed.posed.time_us, developed.complete);
        let is_new = !self.collector.knows(&developed);
        if let (Some((drr, _)), Some(sha256), true) = (&developed.drr, &developed.drr_sha256, is_new) {
            self.log.drr(&developed.posed, drr, sha256);
        }
        if is_new {
            self.log.shown(&developed.posed);
        }
        if complete {
            self.log.scores(&developed.pair, time_us);
        }
        // Where the specimen lies does not rest on a pose that a hand changed.
        if developed.pair.status == PairStatus::AcceptedImageDisagrees && developed.pair.edited.is_none() {
            self.log.input(Input::ImageDisagrees { number });
        }
        // What is recorded comes first.
        self.board.show(|| {
            let late_ms = (host_now_us() - time_us) as f64 * 1e-3;
            // A hand takes its time.
            let latency_ms = developed.pair.edited.is_none().then_some(late_ms);
            PairView { latency_ms, ..developed.picture() }
        });
        if let Some(chime) = self.chime.as_ref().filter(|_| is_new) {
            chime.sound(developed.pair.standing());
        }
        self.broadcast.developed(&developed, is_new);
        let failures = self.collector.take(developed);
        failures.into_iter().for_each(|failure| self.say(Some(failure)));
        if complete {
            self.completed.insert(number);
            self.complete.store(self.completed.len(), Ordering::Relaxed);
        }
    }

    fn say(&self, failure: Option<String>) {
        if let Some(failure) = failure {
            self.reporter.warn("file not written", format!("{failure}; {}", self.log.again()));
        }
    }
}

/// Whether a strip is written that has waited so long; `making` is for how long its null is being made, if it is.
fn strip_is_due(waited_ms: f64, making: Option<Duration>) -> bool {
    waited_ms >= STRIP_WAITS_MS && making.is_none_or(|taken| taken >= HANGS_AFTER)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_waits_for_its_null_while_that_is_made_and_for_no_other_reason() {
        let soon = Duration::from_secs(1);
        // When the pair stands, its null has not begun yet.
        assert!(!strip_is_due(0.0, None) && !strip_is_due(0.5 * STRIP_WAITS_MS, Some(soon)));
        assert!(!strip_is_due(5.0 * STRIP_WAITS_MS, Some(soon)), "it would be written twice");
        assert!(strip_is_due(STRIP_WAITS_MS, None), "other frames come first");
        assert!(strip_is_due(2e4, Some(HANGS_AFTER)), "its null hangs");
    }
}
