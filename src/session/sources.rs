//! The frames that come into a session, on a thread that does nothing else.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use super::SessionError;
use super::board::Board;
use super::event::{Event, Source};
use super::file::Setup;
use super::input::Input;
use super::log::SessionLog;
use crate::acquire::video::GrabbedSource;
use crate::acquire::{Arrival, FolderSource, FolderTree, Frame, FrameSource, Reading, ReceivedSource, Sighting};
use crate::foreign;
use crate::record::Level;
use crate::reporter::Reporter;
use crate::time::host_now_us;

/// How often the folder is looked at.
const FOLDER_POLL: Duration = Duration::from_millis(25);
/// Looks at the folder after the session was told to end.
const LAST_LOOKS: u32 = 8;
/// What is being written by then is waited for so long: as long as for a file whose copy has stopped.
const LAST_PATIENCE_US: i64 = 10_000_000;
/// A wait that is longer is said.
const SAY_WAIT_US: i64 = 700_000;
/// So many files are read in the order in which they came.
const FEW: usize = 4;
/// Pixels of frames that wait to be developed may take this much memory, those on the disk apart; then reading waits, and files wait in their
/// folder.
const MOST_PIXEL_BYTES: usize = 2 << 30;

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
            let words = match self.source {
                Source::Lines => {
                    "the thread that reads the serial lines died: no telemetry is recorded any more; end the session and start it again"
                }
                Source::Frames => {
                    "the thread that reads frames died: no frame is taken any more; end the session, start it again, and attach what came meanwhile"
                }
            };
            self.log.event(Level::Error, host_now_us(), words);
            self.log.lose(words.to_owned());
            self.reporter.warn("reading died", words);
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
    let (domain, reader) = (setup.domain(), foreign::installed());
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
        board: &Board,
        reporter: &Reporter,
    ) -> Result<Self, SessionError> {
        let closing = Arc::new(AtomicBool::new(false));
        let mut intake = FrameIntake {
            source,
            log: Arc::clone(log),
            board: board.clone(),
            reporter: reporter.clone(),
            backlog: Vec::new(),
            held: Vec::new(),
            numbered: 0,
            numbers_of: HashMap::new(),
        };
        let told = Arc::clone(&closing);
        std::thread::Builder::new()
            .name("frames".to_owned())
            .spawn(move || {
                let _told = Ending::new(Source::Frames, &intake.log, &intake.reporter);
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

/// A file that was seen and not read yet, under the number of its first image.
struct Seen {
    number: u32,
    host_us: i64,
    arrival: Arrival,
}

struct FrameIntake {
    source: Box<dyn FrameSource>,
    log: Arc<SessionLog>,
    board: Board,
    reporter: Reporter,
    backlog: Vec<Seen>,
    /// Frames whose pixels may still be in memory.
    held: Vec<Weak<Frame>>,
    numbered: u32,
    /// Of each content the number of its first image.
    numbers_of: HashMap<String, Vec<u32>>,
}

impl FrameIntake {
    fn run(&mut self, closing: &AtomicBool) {
        // What was being written when the session was told to end gets its chance to lie still.
        let mut last_looks = LAST_LOOKS;
        let mut closing_since_us = None;
        let mut wait_said = false;
        loop {
            let is_closing = closing.load(Ordering::Relaxed);
            if is_closing {
                self.source.close();
                closing_since_us = closing_since_us.or_else(|| Some(host_now_us()));
            }
            self.look();
            let has_room = is_closing || self.held_bytes() <= MOST_PIXEL_BYTES;
            if has_room && let Some(seen) = self.next() {
                self.read(seen);
                continue;
            }
            if is_closing && self.backlog.is_empty() {
                last_looks = last_looks.saturating_sub(1);
                let waited_us = closing_since_us.map_or(0, |since_us| host_now_us() - since_us);
                if last_looks == 0 && !self.source.is_expecting() {
                    return;
                }
                if waited_us > LAST_PATIENCE_US {
                    let given_up = self.source.give_up();
                    return given_up.into_iter().for_each(|sighting| drop(self.sighted(sighting)));
                }
                if waited_us > SAY_WAIT_US && !std::mem::replace(&mut wait_said, true) {
                    let most_s = LAST_PATIENCE_US / 1_000_000;
                    self.reporter.note(format!(
                        "a frame is still being written: it is waited for, at most {most_s} s; Ctrl-C again leaves at once, without it"
                    ));
                }
            }
            std::thread::sleep(FOLDER_POLL);
        }
    }

    fn look(&mut self) {
        let host_us = host_now_us();
        let sightings = self.source.look(host_us);
        let mut ready: Vec<Arrival> = sightings.into_iter().filter_map(|sighting| self.sighted(sighting)).collect();
        ready.sort_by_key(Arrival::modified_us);
        for arrival in ready {
            self.numbered += 1;
            self.backlog.push(Seen { number: self.numbered, host_us: arrival.seen_us().min(host_us), arrival });
        }
    }

    /// What can be read; all else is said, and what is lost is noted.
    fn sighted(&self, sighting: Sighting) -> Option<Arrival> {
        match sighting {
            Sighting::Ready(arrival) => return Some(arrival),
            Sighting::Trouble(trouble) => {
                self.log.lose(trouble.to_string());
                self.say(trouble.kind(), &trouble.to_string());
            }
            Sighting::FolderLost { detail } => {
                let words = format!("the frame folder cannot be listed ({detail}); check that it is there and mounted");
                self.say("frame folder", &words);
            }
            Sighting::Said { kind, words } => self.say(kind, &words),
            Sighting::FolderBack => self.say("frame folder", "the frame folder is back"),
        }
        None
    }

    /// The oldest file while there are few, else the newest: that is the one somebody waits for.
    fn next(&mut self) -> Option<Seen> {
        match self.backlog.len() {
            0 => None,
            1..=FEW => Some(self.backlog.remove(0)),
            _ => self.backlog.pop(),
        }
    }

    fn read(&mut self, seen: Seen) {
        let Seen { number, host_us, arrival } = seen;
        match arrival.read() {
            Reading::Frames { frames, earlier } => {
                let before =
                    earlier.and_then(|earlier| Some((self.numbers_of.get(&earlier.sha256)?.clone(), earlier.was_unfinished)));
                if let Some((numbers, was_unfinished)) = &before {
                    let was = numbers.first().copied().unwrap_or_default();
                    let (kind, words) = match was_unfinished {
                        true => (
                            "frame delivered unfinished",
                            format!(
                                "frame {number}: frame {was} was the same file before it was written to its end, and is replaced; let the console write under another name and rename"
                            ),
                        ),
                        false => (
                            "frame rewritten",
                            format!("frame {number}: its file was rewritten; an earlier version of it was frame {was}"),
                        ),
                    };
                    self.say(kind, &words);
                }
                let unfinished = before.filter(|(_, was_unfinished)| *was_unfinished).map(|(numbers, _)| numbers);
                let sha256 = frames.first().map(|frame| frame.sha256.clone()).unwrap_or_default();
                let mut numbers = Vec::with_capacity(frames.len());
                for (image, frame) in frames.into_iter().enumerate() {
                    let number = match image {
                        0 => number,
                        _ => {
                            self.numbered += 1;
                            self.numbered
                        }
                    };
                    numbers.push(number);
                    let completes = unfinished.as_ref().and_then(|numbers| numbers.get(image).copied());
                    let frame = Arc::new(Frame { number, completes, ..frame });
                    self.held.push(Arc::downgrade(&frame));
                    self.board.update(|state| state.frames_seen += 1);
                    self.log.input(Input::Frame { frame, host_us });
                }
                self.numbers_of.entry(sha256).or_insert(numbers);
            }
            Reading::Refused(error) => {
                self.log.lose(format!("unreadable frame {error}"));
                self.say("unreadable frame", &format!("unreadable frame {error}; the file is left where it is"));
                self.give_back(number);
            }
            // The source offers it again, or reports it.
            Reading::Later | Reading::Same { .. } => self.give_back(number),
        }
    }

    /// A number that no frame got goes to the next one, if it was the last.
    fn give_back(&mut self, number: u32) {
        if number == self.numbered {
            self.numbered -= 1;
        }
    }

    fn say(&self, kind: &str, words: &str) {
        self.log.event(Level::Warning, host_now_us(), words);
        self.reporter.warn(kind, words);
    }

    fn held_bytes(&mut self) -> usize {
        self.held.retain(|frame| frame.strong_count() > 0);
        self.held.iter().filter_map(Weak::upgrade).map(|frame| frame.pixels.pixels.len() * 4).sum()
    }
}
