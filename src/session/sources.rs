//! Where a session's frames come from, and the thread that takes them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::SessionError;
use super::board::Board;
use super::busy::Busy;
use super::event::{Event, Source};
use super::fault;
use super::file::Setup;
use super::intake::FrameIntake;
use super::log::SessionLog;
use crate::acquire::video::GrabbedSource;
use crate::acquire::{FolderSource, FolderTree, FrameSource, ReceivedSource};
use crate::foreign;
use crate::record::Level;
use crate::reporter::Reporter;
use crate::time::host_now_us;

/// Tells the session that a thread has ended, however it did; one that died is a loss at once, and nobody waits for it.
pub(super) struct Ending {
    source: Source,
    log: Arc<SessionLog>,
    reporter: Reporter,
}

impl Ending {
    pub(super) fn new(source: Source, log: &Arc<SessionLog>, reporter: &Reporter) -> Self {
        Self { source, log: Arc::clone(log), reporter: reporter.clone() }
    }
}

impl Drop for Ending {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let (kind, words) = match self.source {
                Source::Lines => (
                    "reading died",
                    "the thread that reads the serial lines died: no telemetry is recorded any more; end the session and start it again",
                ),
                Source::Frames => (
                    "reading died",
                    "the thread that reads frames died: no frame is taken any more; end the session, start it again, and attach what came meanwhile",
                ),
                Source::Registrar => (
                    "no registration",
                    "the thread that registers frames died: no frame is posed any more; recording goes on, and a replay of the log poses them",
                ),
                Source::Editor => (
                    "no edits",
                    "the thread that poses edited frames died: no bead is edited any more; a replay of the log makes the edits",
                ),
            };
            match self.source {
                Source::Lines | Source::Frames => self.log.lose_for_good(words.to_owned()),
                // A replay does what was left.
                Source::Registrar | Source::Editor => {
                    self.log.event(Level::Error, host_now_us(), words);
                    self.log.lose(words.to_owned());
                }
            }
            self.reporter.warn(kind, words);
        }
        self.log.tell(Event::Ended(self.source));
    }
}

/// Where a session's frames come from, from now on: its folder, and what is sent into that over DICOM.
pub(super) fn frame_source(
    setup: &Setup,
    include_existing: bool,
    reporter: &Reporter,
) -> Result<Box<dyn FrameSource>, SessionError> {
    let path = &setup.session.frames.folder;
    fault::hangs("watch");
    let (domain, reader) = (setup.domain(), foreign::installed().with_reserve());
    let folder: Box<dyn FrameSource> = match setup.session.frames.sub_folders {
        true => Box::new(FolderTree::new(path, domain, include_existing, reader)),
        false => Box::new(FolderSource::new(path, domain, include_existing, reader)),
    };
    let folder: Box<dyn FrameSource> = match &setup.session.frames.video {
        Some(video) => Box::new(GrabbedSource::open(folder, path, video, include_existing)?),
        None => folder,
    };
    let Some(dicom) = &setup.session.frames.dicom else { return Ok(folder) };
    let received = ReceivedSource::open(folder, path, dicom.options())?;
    let whom = if dicom.bind.is_loopback() { "" } else { "; whoever reaches this address may send" };
    reporter.note(format!("DICOM storage {:?} listens on {}{whom}", dicom.ae_title, received.address()));
    Ok(Box::new(received))
}

/// The frames.
pub(super) struct Frames {
    closing: Arc<AtomicBool>,
}

impl Frames {
    /// Watches a source of frames; they are numbered, recorded and go to the engine.
    pub(super) fn watch(
        source: Box<dyn FrameSource>,
        log: &Arc<SessionLog>,
        (board, busy): (&Board, &Busy),
        reporter: &Reporter,
    ) -> Result<Self, SessionError> {
        let closing = Arc::new(AtomicBool::new(false));
        let mut intake = FrameIntake::new(source, log, board, busy, reporter);
        let told = Arc::clone(&closing);
        let ending = Ending::new(Source::Frames, log, reporter);
        std::thread::Builder::new()
            .name("frames".to_owned())
            .spawn(move || {
                let _told = ending;
                intake.run(&told);
            })
            .map_err(|source| SessionError::Thread { source })?;
        Ok(Self { closing })
    }

    /// Reads what is there, then ends.
    pub(super) fn close(&self) {
        self.closing.store(true, Ordering::Relaxed);
    }
}
