//! How a running session ends: in order, stage by stage, or at once.

use std::path::PathBuf;
use std::time::Duration;

use super::super::SessionError;
use super::super::busy::Task;
use super::super::editor::Editor;
use super::super::folder::Folder;
use super::super::intake::MOST_READ;
use super::{Session, Stage};
use crate::record::Level;
use crate::time::host_now_us;

/// Whoever leaves at once waits this long for the log, and three times as long for files that are being written.
const LEAVE: Duration = Duration::from_secs(1);
/// In the end a folder that has not answered for so long is not waited for any more.
const FOLDER_PATIENCE: Duration = Duration::from_secs(10);
/// Nor is a file: whoever reads it would have been killed by then, so that it is the file that does not come.
const READING_PATIENCE: Duration = Duration::from_secs(45);

/// What of the frame folder is not waited for any more, and how many of its files that were seen are not in the log.
#[derive(Clone, Debug, PartialEq, Eq)]
enum GivenUp {
    /// It is asked what is in it, and does not answer.
    Folder { unread: usize },
    /// The files of these frames do not come, and all others that are unread wait for those who read these.
    Files { hanging: Vec<u32>, unread: usize },
}

impl GivenUp {
    /// `tasks` are those that are not over, with how long each has taken; `unread` counts the files that were seen and not read yet.
    fn of(tasks: &[(Task, Duration)], unread: usize) -> Option<Self> {
        if tasks.iter().any(|(task, taken)| *task == Task::Folder && *taken >= FOLDER_PATIENCE) {
            return Some(Self::Folder { unread });
        }
        let hanging = |(task, taken): &(Task, Duration)| match task {
            Task::Reading(frame) if *taken >= READING_PATIENCE => Some(*frame),
            _ => None,
        };
        let hanging: Vec<u32> = tasks.iter().filter_map(hanging).collect();
        // Where so many hang, nobody is left to read what waits behind them.
        let are_all = hanging.len() >= unread || hanging.len() >= MOST_READ;
        (!hanging.is_empty() && are_all).then_some(Self::Files { hanging, unread })
    }
}

impl std::fmt::Display for GivenUp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Folder { unread } => {
                f.write_str("the frame folder did not answer at the end: attach what came into it meanwhile")?;
                if *unread > 0 { write!(f, ", and {unread} files that were not read yet") } else { Ok(()) }
            }
            Self::Files { hanging, unread } => {
                let numbers: Vec<String> = hanging.iter().map(u32::to_string).collect();
                write!(
                    f,
                    "{unread} files of the frame folder were not read at the end, because reading that of frame {} took more than {} s: \
                     attach them to the log",
                    numbers.join(", "),
                    READING_PATIENCE.as_secs()
                )
            }
        }
    }
}

impl Session {
    /// From one stage to the next, when its time has come.
    pub(super) fn advance(&mut self, is_over: bool) {
        match std::mem::replace(&mut self.stage, Stage::Finishing) {
            Stage::Open { lines, frames } if is_over => {
                lines.close();
                frames.close();
                self.board.update(|state| state.editable = false);
                self.stage = Stage::Closing { asked_us: host_now_us() };
            }
            Stage::Closing { asked_us } if self.lines_ended && !self.end_is_logged => {
                self.stage = Stage::Closing { asked_us };
                self.end_is_logged = true;
                self.log.end(asked_us);
                self.with_engine(|engine, sink| engine.finish(asked_us, sink));
            }
            Stage::Closing { asked_us } if self.end_is_logged => {
                if !self.frames_ended {
                    let Some(given_up) = self.given_up() else {
                        self.stage = Stage::Closing { asked_us };
                        return;
                    };
                    self.log.lose_for_good(given_up.to_string());
                }
                let (frames, complete) = (self.frames(), self.scribe.complete());
                let progress = self.reporter.progress("finishing", frames as u64);
                if complete < frames {
                    let log = if self.log.has_failed() { "what is not finished is lost" } else { "the log is complete" };
                    // A bar says itself how far it is.
                    let so_far = if progress.is_shown() { String::new() } else { format!("finishing {complete} of {frames}; ") };
                    self.reporter.note(format!("{so_far}Ctrl-C again leaves at once, {log}"));
                }
                progress.advance(complete as u64);
                self.finishing = Some((progress, complete));
            }
            Stage::Finishing => {
                if self.is_registered() {
                    self.workshop.close();
                }
            }
            stage => self.stage = stage,
        }
    }

    /// What will not come of the folder any more; `None` while something may.
    fn given_up(&self) -> Option<GivenUp> {
        let long = self.busy.longer_than(FOLDER_PATIENCE);
        GivenUp::of(&long, self.board.read(|state| state.frames_unread))
    }

    /// Whether every frame has its pose, or gets none any more, and every edit.
    pub(super) fn is_registered(&self) -> bool {
        let are_posed = self.engine.waiting() == 0 && self.engine.bound().next().is_none() && self.registering.is_none();
        (are_posed || self.registrar_ended) && self.editor.as_ref().is_none_or(Editor::is_idle)
    }

    /// Everything is developed and written.
    pub(super) fn close(mut self) -> Result<Folder, SessionError> {
        let died = self.workshop.join().is_err();
        if died {
            self.log.lose(format!("the rendering thread died: some frames have no DRR; {}", self.log.again()));
        }
        Ok(self.report(None))
    }

    /// Somebody wants to leave at once: what is recorded is kept, what is not developed is said.
    pub(super) fn leave(self) -> Folder {
        let open = self.frames().saturating_sub(self.scribe.complete());
        match self.stage {
            Stage::Open { .. } => self.log.end(host_now_us()),
            Stage::Closing { asked_us } if !self.end_is_logged => self.log.end(asked_us),
            Stage::Closing { .. } | Stage::Finishing => {}
        }
        self.workshop.abandon();
        self.scribe.leave();
        let unread = self.board.read(|state| state.frames_unread);
        if unread > 0 {
            let words = "files of the frame folder were not read yet; attach them to the log";
            self.log.lose_for_good(format!("left at once: {unread} {words}"));
        }
        if open > 0 {
            self.log.lose(format!("left at once: {open} frames were not finished; {}", self.log.again()));
        }
        self.report(Some((LEAVE, open)))
    }

    /// Of a session that is left at once (`left`): for how long the log is waited for, and how many frames are not finished.
    fn report(mut self, left: Option<(Duration, usize)>) -> Folder {
        self.finishing = None;
        let (frames, limit) = (self.frames(), left.map(|(limit, _)| limit));
        self.engine.line_losses().into_iter().for_each(|lost| self.log.lose(lost));
        self.engine.hardly_bound().into_iter().for_each(|words| self.log.lose(words));
        for (kind, words) in self.engine.unmatched() {
            self.reporter.warn(kind, &words);
            self.log.event(Level::Warning, host_now_us(), &words);
        }
        self.publish(host_now_us());
        self.board.update(|state| state.finished = true);
        self.log.finish(limit);
        let path = self.log.path().to_owned();
        match self.scribe.join(limit.map(|limit| 3 * limit)) {
            Ok(collector) => {
                let (losses, again) = (self.log.losses(), self.log.again());
                let folder = collector.finish(&self.engine, self.tracks, (losses, again), &self.reporter, Some(path));
                let without_pair = frames.saturating_sub(folder.pairs.len());
                Folder { frames, unfinished: left.map_or(without_pair, |(_, open)| open), ..folder }
            }
            Err(how) => {
                self.log.lose(format!("the thread that writes files {how}; {}", self.log.again()));
                let folder = path.parent().map(PathBuf::from).unwrap_or_default();
                let (pairs, views, losses) = (Vec::new(), Default::default(), self.log.losses());
                let unfinished = left.map_or(frames, |(_, open)| open);
                Folder { path: folder, log: Some(path), pairs, views, losses, frames, unfinished, report: None }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading(tasks: &[(u32, u64)]) -> Vec<(Task, Duration)> {
        tasks.iter().map(|(frame, taken_s)| (Task::Reading(*frame), Duration::from_secs(*taken_s))).collect()
    }

    #[test]
    fn a_file_that_does_not_come_is_given_up_when_nothing_else_may_and_is_said() {
        let long = READING_PATIENCE.as_secs();
        assert_eq!(GivenUp::of(&reading(&[(3, long - 1)]), 1), None, "its reader is not killed yet");
        assert_eq!(GivenUp::of(&reading(&[(3, long), (5, long - 1)]), 2), None, "the other may come");
        assert_eq!(GivenUp::of(&reading(&[(3, long)]), 2), None, "one that waits may be read");
        assert_eq!(GivenUp::of(&[(Task::Writing(3), 2 * READING_PATIENCE)], 0), None, "no file of the folder");
        let given_up = GivenUp::of(&reading(&[(3, long), (5, 2 * long)]), 2).expect("nothing else may come");
        assert_eq!(given_up, GivenUp::Files { hanging: vec![3, 5], unread: 2 });
        let words = given_up.to_string();
        assert!(words.starts_with("2 files of the frame folder were not read") && words.contains("frame 3, 5 took"), "{words}");
    }

    /// The end waited for files that nobody could read any more: all who read hung, and the session with them.
    #[test]
    fn files_behind_as_many_that_hang_as_are_read_at_once_are_given_up_with_them() {
        let hanging: Vec<(u32, u64)> = (1..).take(MOST_READ).map(|frame| (frame, READING_PATIENCE.as_secs())).collect();
        let unread = MOST_READ + 3;
        assert_eq!(GivenUp::of(&reading(&hanging[1..]), unread), None, "one is left to read them");
        let given_up = GivenUp::of(&reading(&hanging), unread).expect("nobody is left to read them");
        assert!(given_up.to_string().starts_with("7 files of the frame folder"), "{given_up}");
    }

    #[test]
    fn a_folder_that_does_not_answer_is_given_up_with_what_is_unread_of_it() {
        let asked = |taken| GivenUp::of(&[(Task::Folder, taken)], 2);
        assert_eq!(asked(FOLDER_PATIENCE - Duration::from_millis(1)), None);
        let words = asked(FOLDER_PATIENCE).map(|given_up| given_up.to_string()).unwrap_or_default();
        assert!(words.starts_with("the frame folder did not answer at the end") && words.contains("and 2 files"), "{words}");
    }
}
