//! What the threads of a session are at, and for how long: a part that hangs is told apart from one that has nothing to do.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::time::Stopwatch;

/// Shown to whoever looks from then on.
pub(super) const SHOWN_AFTER: Duration = Duration::from_secs(1);
/// Said from then on.
pub(super) const SAID_AFTER: Duration = Duration::from_secs(3);
/// A warning from then on.
pub(super) const WARNED_AFTER: Duration = Duration::from_secs(12);

/// What may take long, or for ever.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Task {
    /// The folder of frames, or whatever else they come from, is asked.
    Folder,
    /// A frame's file is read.
    Reading(u32),
    /// A frame is posed.
    Registering(u32),
    /// A frame's DRR is made and compared.
    Developing(u32),
    /// A frame's files are written.
    Writing(u32),
}

impl Task {
    /// What counts together.
    pub(super) fn kind(self) -> &'static str {
        match self {
            Self::Folder => "frame folder slow",
            Self::Reading(_) => "frame slow to read",
            Self::Registering(_) => "registration slow",
            Self::Developing(_) => "rendering slow",
            Self::Writing(_) => "writing slow",
        }
    }

    /// That it is not over after so long.
    pub(super) fn words(self, taken: Duration) -> String {
        let seconds = taken.as_secs();
        match self {
            Self::Folder => {
                format!(
                    "the frame folder has not answered for {seconds} s: is its server or disk there? no frame is taken meanwhile"
                )
            }
            Self::Reading(frame) => {
                format!("frame {frame}: its file has been read for {seconds} s and is not there yet; other frames pass it")
            }
            Self::Registering(frame) => {
                format!(
                    "frame {frame}: it has been registered for {seconds} s and is not done; recording goes on, other frames wait"
                )
            }
            Self::Developing(frame) => {
                format!("frame {frame}: its DRR has been made for {seconds} s and is not done; recording and registration go on")
            }
            Self::Writing(frame) => {
                format!(
                    "frame {frame}: its files have been written for {seconds} s and are not done: is the disk slow? recording goes on"
                )
            }
        }
    }
}

/// Shared by the threads; cheap to clone.
#[derive(Clone, Debug, Default)]
pub(super) struct Busy {
    open: Arc<Mutex<BTreeMap<Task, Stopwatch>>>,
}

/// The task is over when this is dropped, however its thread comes out of it.
#[derive(Debug)]
pub(super) struct AtWork {
    busy: Busy,
    task: Task,
}

impl Busy {
    /// Begins a task.
    pub(super) fn begin(&self, task: Task) -> AtWork {
        self.change(|open| _ = open.insert(task, Stopwatch::start()));
        AtWork { busy: self.clone(), task }
    }

    /// Tasks that are not over after `limit`, and how long each has taken.
    pub(super) fn longer_than(&self, limit: Duration) -> Vec<(Task, Duration)> {
        let open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = |since: &Stopwatch| Duration::from_secs_f64(1e-3 * since.ms());
        open.iter().map(|(task, since)| (*task, taken(since))).filter(|(_, taken)| *taken >= limit).collect()
    }

    fn change(&self, change: impl FnOnce(&mut BTreeMap<Task, Stopwatch>)) {
        change(&mut self.open.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

impl Drop for AtWork {
    fn drop(&mut self) {
        self.busy.change(|open| _ = open.remove(&self.task));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_over_is_told_with_how_long_it_took() {
        let busy = Busy::default();
        let (folder, frame) = (busy.begin(Task::Folder), busy.begin(Task::Registering(7)));
        std::thread::sleep(Duration::from_millis(20));
        assert_eq!(busy.longer_than(Duration::from_secs(60)), []);
        let long = busy.longer_than(Duration::from_millis(20));
        assert_eq!(long.iter().map(|(task, _)| *task).collect::<Vec<_>>(), [Task::Folder, Task::Registering(7)]);
        assert!(long.iter().all(|(_, taken)| *taken >= Duration::from_millis(20)), "{long:?}");
        drop(folder);
        // A thread that dies in it.
        let _ = std::thread::spawn(move || {
            let _frame = frame;
            panic!("a fault");
        })
        .join();
        assert_eq!(busy.longer_than(Duration::ZERO), []);
        assert!(Task::Folder.words(Duration::from_secs(4)).contains("for 4 s"));
    }
}
