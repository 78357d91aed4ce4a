//! How a running session ends: in order, stage by stage, or at once.

use std::path::PathBuf;
use std::time::Duration;

use super::super::SessionError;
use super::super::busy::Task;
use super::super::editor::Editor;
use super::super::folder::Folder;
use super::{Session, Stage};
use crate::record::Level;
use crate::time::host_now_us;

/// Whoever leaves at once waits this long for the log, and three times as long for files that are being written.
const LEAVE: Duration = Duration::from_secs(1);
/// In the end a folder that has not answered for so long is not waited for any more.
const FOLDER_PATIENCE: Duration = Duration::from_secs(10);
/// Nor is a file: whoever reads it would have been killed by then, so that it is the file that does not come.
const READING_PATIENCE: Duration = Duration::from_secs(45);

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
            Stage::Closing { .. } if self.end_is_logged && (self.frames_ended || self.is_folder_dead()) => {
                if !self.frames_ended {
                    self.log.lose("the frame folder did not answer at the end: attach what came into it meanwhile".to_owned());
                }
                let (frames, complete) = (self.frames(), self.scribe.complete());
                if complete < frames {
                    let log = if self.log.has_failed() { "what is not finished is lost" } else { "the log is complete" };
                    self.reporter.note(format!("finishing {complete} of {frames}; Ctrl-C again leaves at once, {log}"));
                }
                let progress = self.reporter.progress("finishing", frames as u64);
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

    /// Whether nothing that is waited for will come of the folder: it is asked and does not answer, or all that is still read of it hangs.
    fn is_folder_dead(&self) -> bool {
        let long = self.busy.longer_than(FOLDER_PATIENCE);
        let hang = |(task, taken): &&(Task, Duration)| matches!(task, Task::Reading(_)) && *taken >= READING_PATIENCE;
        let hanging = long.iter().filter(hang).count();
        let are_all = || self.board.read(|state| state.frames_unread) == hanging;
        long.iter().any(|(task, _)| *task == Task::Folder) || (hanging > 0 && are_all())
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
            self.log.lose(format!("left at once: {unread} files of the frame folder were not read yet; attach them to the log"));
        }
        if open > 0 {
            self.log.lose(format!("left at once: {open} frames were not finished; {}", self.log.again()));
        }
        self.report(Some(LEAVE))
    }

    fn report(mut self, limit: Option<Duration>) -> Folder {
        self.finishing = None;
        self.engine.line_losses().into_iter().for_each(|lost| self.log.lose(lost));
        self.engine.hardly_bound().into_iter().for_each(|words| self.log.lose(words));
        let unmatched = [
            ("exposures without a frame", self.engine.exposures_without_frame()),
            ("frames of no exposure", self.engine.frames_of_no_exposure()),
        ];
        for (kind, words) in unmatched {
            if let Some(words) = words {
                self.reporter.warn(kind, &words);
                self.log.event(Level::Warning, host_now_us(), &words);
            }
        }
        self.publish(host_now_us());
        self.board.update(|state| state.finished = true);
        self.log.finish(limit);
        let path = self.log.path().to_owned();
        match self.scribe.join(limit.map(|limit| 3 * limit)) {
            Ok(collector) => {
                let (losses, again) = (self.log.losses(), self.log.again());
                collector.finish(&self.engine, self.tracks, (losses, again), &self.reporter, Some(path))
            }
            Err(how) => {
                self.log.lose(format!("the thread that writes files {how}; {}", self.log.again()));
                let folder = path.parent().map(PathBuf::from).unwrap_or_default();
                let (pairs, views, losses) = (Vec::new(), Default::default(), self.log.losses());
                Folder { path: folder, log: Some(path), pairs, views, losses, report: None }
            }
        }
    }
}
