//! What the threads of a session are at, and for how long: a part that hangs is told apart from one that has nothing to do.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crate::time::Stopwatch;

/// What somebody waits for is shown and said from then on.
pub(super) const LATE_AFTER: Duration = Duration::from_secs(1);
/// What nobody waits for: a null is put off for a frame that comes.
const NULL_LATE_AFTER: Duration = Duration::from_secs(5);
/// It hangs from then on, which is said once more.
pub(super) const HANGS_AFTER: Duration = Duration::from_secs(12);

/// What may take long, or for ever.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Task {
    /// The folder of frames, or whatever else they come from, is asked.
    Folder,
    /// The renderer does what the first frame would wait for.
    Warming,
    /// A frame's file is read.
    Reading(u32),
    /// A frame is posed, for the first time or after an edit.
    Registering(u32),
    /// A frame's DRR is made and compared.
    Developing(u32),
    /// A frame is put against other poses.
    Null(u32),
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
            Self::Warming => "renderer slow to start",
            Self::Developing(_) => "rendering slow",
            Self::Null(_) => "null slow",
            Self::Writing(_) => "writing slow",
        }
    }

    /// It is late from then on.
    fn late_after(self) -> Duration {
        match self {
            Self::Warming => HANGS_AFTER,
            Self::Null(_) => NULL_LATE_AFTER,
            Self::Folder | Self::Reading(_) | Self::Registering(_) | Self::Developing(_) | Self::Writing(_) => LATE_AFTER,
        }
    }

    /// That it is not over after so long.
    pub(super) fn words(self, taken: Duration) -> String {
        let so_far = format!("({} s so far)", taken.as_secs());
        match self {
            Self::Folder => {
                format!(
                    "the frame folder does not answer {so_far}: is its server or disk there? telemetry is recorded all the same"
                )
            }
            Self::Warming => format!("the renderer's first steps take long {so_far}: no DRR comes meanwhile, all else goes on"),
            Self::Reading(frame) => format!("frame {frame}: reading its file takes long {so_far}; other frames pass it"),
            Self::Registering(frame) => {
                format!("frame {frame}: registering it takes long {so_far}; recording goes on, other frames wait")
            }
            Self::Developing(frame) => {
                format!("frame {frame}: making its DRR takes long {so_far}; recording and registration go on")
            }
            Self::Null(frame) => {
                format!("frame {frame}: putting it against other poses takes long {so_far}; recording and registration go on")
            }
            Self::Writing(frame) => {
                format!("frame {frame}: writing its files takes long {so_far}: is the disk slow? recording goes on")
            }
        }
    }

    /// That it hung and is over.
    pub(super) fn over(self) -> String {
        match self {
            Self::Folder => "the frame folder answers again".to_owned(),
            _ => format!("{}: that is over", self.kind()),
        }
    }
}

#[derive(Debug, Default)]
struct State {
    /// By task and how many were begun before: two threads may be at one task, each for a moment.
    open: BTreeMap<(Task, u64), Stopwatch>,
    begun: u64,
    /// Kinds of which the last one that ended was late.
    late: BTreeSet<&'static str>,
}

/// Shared by the threads; cheap to clone.
#[derive(Clone, Debug, Default)]
pub(super) struct Busy {
    state: Arc<Mutex<State>>,
}

/// The task is over when this is dropped, however its thread comes out of it.
#[derive(Debug)]
pub(super) struct AtWork {
    busy: Busy,
    key: (Task, u64),
}

impl Busy {
    /// Begins a task.
    pub(super) fn begin(&self, task: Task) -> AtWork {
        let mut key = (task, 0);
        self.change(|state| {
            key.1 = state.begun;
            state.begun += 1;
            state.open.insert(key, Stopwatch::start());
        });
        AtWork { busy: self.clone(), key }
    }

    /// Tasks that are not over after `limit`, and how long each has taken.
    pub(super) fn longer_than(&self, limit: Duration) -> Vec<(Task, Duration)> {
        self.open().into_iter().filter(|(_, taken)| *taken >= limit).collect()
    }

    /// Tasks that are late, and how long each has taken.
    pub(super) fn late(&self) -> Vec<(Task, Duration)> {
        self.open().into_iter().filter(|(task, taken)| *taken >= task.late_after()).collect()
    }

    /// Whether the last one of this kind that ended was late: then the next one is no news.
    pub(super) fn was_late(&self, kind: &str) -> bool {
        let mut was_late = false;
        self.change(|state| was_late = state.late.contains(kind));
        was_late
    }

    fn open(&self) -> Vec<(Task, Duration)> {
        let mut found = Vec::new();
        self.change(|state| found.extend(state.open.iter().map(|((task, _), since)| (*task, taken(since)))));
        found
    }

    fn change(&self, change: impl FnOnce(&mut State)) {
        change(&mut self.state.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

fn taken(since: &Stopwatch) -> Duration {
    Duration::from_secs_f64(1e-3 * since.ms())
}

impl Drop for AtWork {
    fn drop(&mut self) {
        let (key, task) = (self.key, self.key.0);
        self.busy.change(|state| {
            let is_late = state.open.remove(&key).is_some_and(|since| taken(&since) >= task.late_after());
            match is_late {
                true => state.late.insert(task.kind()),
                false => state.late.remove(task.kind()),
            };
        });
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
        assert_eq!(busy.late(), [], "none of these is late yet");
        drop(folder);
        // A thread that dies in it.
        let _ = std::thread::spawn(move || {
            let _frame = frame;
            panic!("a fault");
        })
        .join();
        assert_eq!(busy.longer_than(Duration::ZERO), []);
        assert!(Task::Folder.words(Duration::from_secs(4)).contains("(4 s so far)"));
    }

    /// An edit and a registration of one frame: the one that still runs may hang, and is then to be said.
    #[test]
    fn the_end_of_one_of_two_that_are_at_one_task_is_not_the_other_s() {
        let busy = Busy::default();
        let (edit, registration) = (busy.begin(Task::Registering(7)), busy.begin(Task::Registering(7)));
        let tasks = || busy.longer_than(Duration::ZERO).into_iter().map(|(task, _)| task).collect::<Vec<_>>();
        drop(edit);
        assert_eq!(tasks(), [Task::Registering(7)]);
        drop(registration);
        assert_eq!(tasks(), []);
    }

    /// A machine that is slow for every frame would say so for every frame.
    #[test]
    fn what_is_late_again_and_again_is_told_from_what_was_on_time_before() {
        let (busy, kind) = (Busy::default(), Task::Developing(1).kind());
        drop(busy.begin(Task::Developing(1)));
        assert!(!busy.was_late(kind), "it was on time");
        let late = busy.begin(Task::Developing(2));
        let null = busy.begin(Task::Null(1));
        std::thread::sleep(LATE_AFTER);
        let late_now: Vec<Task> = busy.late().into_iter().map(|(task, _)| task).collect();
        assert_eq!(late_now, [Task::Developing(2)], "nobody waits for a null");
        assert!(!busy.was_late(kind), "it is not over");
        drop((late, null));
        assert!(busy.was_late(kind) && !busy.was_late(Task::Null(1).kind()) && busy.late().is_empty());
        drop(busy.begin(Task::Developing(3)));
        assert!(!busy.was_late(kind), "on time again");
    }
}
