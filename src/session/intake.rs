//! Frames from their source into a session: seen, numbered, read, recorded. A file that is slow to read does not hold up the next ones.

use std::collections::{BTreeMap, HashMap};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Weak};
use std::time::Duration;

use super::board::Board;
use super::busy::{Busy, Task};
use super::fault;
use super::input::Input;
use super::log::SessionLog;
use crate::acquire::{Arrival, Frame, FrameSource, FrameTags, Reading, Sighting, Trouble};
use crate::record::Level;
use crate::reporter::Reporter;
use crate::time::{Stopwatch, host_now_us};

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
/// A file that takes longer is passed by the next.
const SLOW_MS: f64 = 150.0;
/// Files that are read at once, at most: each by a process that may take much memory.
pub(super) const MOST_READ: usize = 4;
/// Pixels of frames that wait to be developed may take this much memory, those on the disk apart; then reading waits, and files wait in their
/// folder.
const MOST_PIXEL_BYTES: usize = 2 << 30;

/// A file that was seen and not read yet, under the number of its first image.
struct Seen {
    number: u32,
    host_us: i64,
    arrival: Arrival,
}

/// How a reading ended, and what was said to be lost of the file and is not; `None` where its thread died in it.
struct Read {
    number: u32,
    host_us: i64,
    reading: Option<(Reading, Vec<Trouble>)>,
}

/// See the module.
pub(super) struct FrameIntake {
    source: Box<dyn FrameSource>,
    log: Arc<SessionLog>,
    board: Board,
    busy: Busy,
    reporter: Reporter,
    backlog: Vec<Seen>,
    /// Files that are being read, by number, since when.
    reading: BTreeMap<u32, Stopwatch>,
    read: (Sender<Read>, Receiver<Read>),
    is_folder_lost: bool,
    /// Frames whose pixels may still be in memory.
    held: Vec<Weak<Frame>>,
    numbered: u32,
    /// Of each content the numbers of its images, and what the first says of its exposure.
    numbers_of: HashMap<String, (Vec<u32>, FrameTags)>,
}

impl FrameIntake {
    pub(super) fn new(
        source: Box<dyn FrameSource>,
        log: &Arc<SessionLog>,
        board: &Board,
        busy: &Busy,
        reporter: &Reporter,
    ) -> Self {
        Self {
            source,
            log: Arc::clone(log),
            board: board.clone(),
            busy: busy.clone(),
            reporter: reporter.clone(),
            backlog: Vec::new(),
            reading: BTreeMap::new(),
            read: channel(),
            is_folder_lost: false,
            held: Vec::new(),
            numbered: 0,
            numbers_of: HashMap::new(),
        }
    }

    /// Until the session closes and all is read.
    pub(super) fn run(&mut self, closing: &AtomicBool) {
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
            if has_room
                && self.may_begin()
                && let Some(seen) = self.next()
            {
                self.begin(seen);
            }
            let unread = self.backlog.len() + self.reading.len();
            self.board.tick(|state| state.frames_unread = unread);
            if let Ok(read) = self.read.1.recv_timeout(FOLDER_POLL) {
                self.take(read);
                continue;
            }
            if is_closing && self.backlog.is_empty() && self.reading.is_empty() {
                last_looks = last_looks.saturating_sub(1);
                let waited_us = closing_since_us.map_or(0, |since_us| host_now_us() - since_us);
                if last_looks == 0 && !self.source.is_expecting() {
                    return self.tell_lost_folder();
                }
                if waited_us > LAST_PATIENCE_US {
                    let given_up = self.source.give_up();
                    given_up.into_iter().for_each(|sighting| drop(self.sighted(sighting)));
                    return self.tell_lost_folder();
                }
                if waited_us > SAY_WAIT_US && !std::mem::replace(&mut wait_said, true) {
                    let most_s = LAST_PATIENCE_US / 1_000_000;
                    self.reporter.note(format!(
                        "a frame is still being written: it is waited for, at most {most_s} s; Ctrl-C again leaves at once, without it"
                    ));
                }
            }
        }
    }

    /// What came into a folder that is not there at the end was not seen.
    fn tell_lost_folder(&self) {
        if self.is_folder_lost {
            self.log.lose_for_good("the frame folder was not there at the end: attach what came into it meanwhile".to_owned());
        }
    }

    /// One file after the other, until one takes long: the next ones must not wait for it.
    fn may_begin(&self) -> bool {
        self.reading.len() < MOST_READ && self.reading.values().all(|since| since.ms() > SLOW_MS)
    }

    /// Reads it on a thread of its own.
    fn begin(&mut self, seen: Seen) {
        let Seen { number, host_us, arrival } = seen;
        let (told, busy) = (self.read.0.clone(), self.busy.clone());
        let reader = std::thread::Builder::new().name("frame".to_owned()).spawn(move || {
            let at_work = busy.begin(Task::Reading(number));
            let reading = catch_unwind(AssertUnwindSafe(|| arrival.read_and_mend())).ok();
            drop(at_work);
            // Whoever left at once does not listen.
            let _ = told.send(Read { number, host_us, reading });
        });
        match reader {
            Ok(_) => _ = self.reading.insert(number, Stopwatch::start()),
            Err(error) => {
                self.refuse(number, &format!("frame {number} is not read: the system gives no thread ({error})"));
            }
        }
    }

    fn refuse(&mut self, number: u32, words: &str) {
        self.log.lose_for_good(words.to_owned());
        self.reporter.warn("unreadable frame", format!("{words}; the file is left where it is"));
        self.give_back(number);
    }

    fn look(&mut self) {
        let host_us = host_now_us();
        let at_work = self.busy.begin(Task::Folder);
        fault::hangs("folder");
        let sightings = self.source.look(host_us);
        drop(at_work);
        let mut ready: Vec<Arrival> = sightings.into_iter().filter_map(|sighting| self.sighted(sighting)).collect();
        ready.sort_by_key(Arrival::modified_us);
        for arrival in ready {
            self.numbered += 1;
            self.backlog.push(Seen { number: self.numbered, host_us: arrival.seen_us().min(host_us), arrival });
        }
    }

    /// What can be read; all else is said, and what is lost is noted.
    fn sighted(&mut self, sighting: Sighting) -> Option<Arrival> {
        match sighting {
            Sighting::Ready(arrival) => return Some(arrival),
            Sighting::Trouble(trouble) => {
                self.log.lose_for_good(trouble.to_string());
                self.reporter.warn(trouble.kind(), trouble.to_string());
            }
            Sighting::FolderLost { detail } => {
                let words = format!("the frame folder cannot be listed ({detail}); check that it is there and mounted");
                self.is_folder_lost = true;
                self.say("frame folder", &words);
            }
            Sighting::Said { kind, words } => self.say(kind, &words),
            Sighting::FolderBack => {
                self.is_folder_lost = false;
                self.say("frame folder", "the frame folder is back");
            }
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

    fn take(&mut self, read: Read) {
        let Read { number, host_us, reading } = read;
        fault::breaks("frames", number);
        self.reading.remove(&number);
        let (reading, mended) = reading.unzip();
        mended.into_iter().flatten().for_each(|trouble| self.take_back(&trouble));
        match reading {
            Some(Reading::Frames { frames, earlier }) => {
                let before = earlier.and_then(|earlier| Some((self.numbers_of.get(&earlier.sha256)?, earlier.was_unfinished)));
                // A picture that is written anew with all that it says of its exposure is that one's, whatever was read of it before.
                let replaced = before.map(|((numbers, tags), was_unfinished)| {
                    let is_same = frames.first().is_some_and(|frame| frame.tags.names_same_exposure(tags));
                    (numbers.clone(), was_unfinished, was_unfinished || is_same)
                });
                if let Some((numbers, was_unfinished, is_replaced)) = &replaced {
                    let was = numbers.first().copied().unwrap_or_default();
                    let (kind, words) = match (was_unfinished, is_replaced) {
                        (true, _) => (
                            "frame delivered unfinished",
                            format!(
                                "frame {number}: frame {was} was the same file before it was written to its end, and is replaced; let the console write under another name and rename"
                            ),
                        ),
                        (false, true) => (
                            "frame rewritten",
                            format!(
                                "frame {number}: the file of frame {was} was rewritten with a picture of the same exposure, which replaces it; let the console write under another name and rename"
                            ),
                        ),
                        (false, false) => (
                            "frame rewritten",
                            format!("frame {number}: its file was rewritten; an earlier version of it was frame {was}"),
                        ),
                    };
                    self.say(kind, &words);
                }
                let replaces = replaced.filter(|(.., is_replaced)| *is_replaced).map(|(numbers, ..)| numbers);
                let tags = frames.first().map(|frame| frame.tags.clone()).unwrap_or_default();
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
                    let completes = replaces.as_ref().and_then(|numbers| numbers.get(image).copied());
                    let frame = Arc::new(Frame { number, completes, ..frame });
                    self.held.push(Arc::downgrade(&frame));
                    self.board.update(|state| state.frames_seen += 1);
                    self.log.input(Input::Frame { frame, host_us });
                }
                self.numbers_of.entry(sha256).or_insert((numbers, tags));
            }
            Some(Reading::Refused(error)) => self.refuse(number, &format!("unreadable frame {error}")),
            // The source offers it again, or reports it.
            Some(Reading::Later | Reading::Same { .. }) => self.give_back(number),
            None => self.refuse(number, &format!("frame {number}: reading it failed (a fault of this program)")),
        }
    }

    /// What was said to be lost of a file has come with it after all.
    fn take_back(&self, trouble: &Trouble) {
        if self.log.take_back(&trouble.to_string()) {
            self.reporter.mend(trouble.kind(), trouble.mended());
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
