//! What comes into a session, each kind on a thread that does nothing else: bytes of the devices' lines, frames of the folder.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use super::SessionError;
use super::board::{Board, Link};
use super::event::{Event, Source};
use super::file::Setup;
use super::input::Input;
use super::log::SessionLog;
use crate::acquire::{Arrival, FolderSource, Frame, FrameSource, Reading, ReceivedSource, Sighting};
use crate::foreign;
use crate::record::Level;
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, PortConfig, PortEvent, PortTask, spawn_port};
use crate::time::host_now_us;

/// Capacity of the channel from the ports; when full, bytes wait in the system's buffers.
const PORT_QUEUE: usize = 4096;
/// A port that is closed may take this long to hand over what has arrived.
const DRAIN: Duration = Duration::from_millis(200);
/// How often the folder is looked at.
const FOLDER_POLL: Duration = Duration::from_millis(25);
/// Looks at the folder after the session was told to end.
const LAST_LOOKS: u32 = 8;
/// So many files are read in the order in which they came.
const FEW: usize = 4;
/// Pixels of frames that wait to be developed may take this much memory, those on the disk apart; then reading waits, and files wait in their
/// folder.
const MOST_PIXEL_BYTES: usize = 2 << 30;

/// The serial lines.
pub(super) struct Lines {
    runtime: tokio::runtime::Runtime,
    tasks: Vec<PortTask>,
}

impl Lines {
    /// Opens the ports of a session; what they say is recorded and goes to the engine.
    pub(super) fn open(setup: &Setup, log: &Arc<SessionLog>, board: &Board, reporter: &Reporter) -> Result<Self, SessionError> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(|source| SessionError::Thread { source })?;
        let (sender, mut arrivals) = tokio::sync::mpsc::channel::<(DeviceKind, PortEvent)>(PORT_QUEUE);
        let mut tasks = Vec::new();
        for config in ports(setup) {
            board.update(|state| state.links.push(new_link(config.device)));
            tasks.push(spawn_port(runtime.handle(), config, sender.clone()));
        }
        drop(sender);
        for (what, words) in setup.adapters.unknowns() {
            reporter.warn(what, &words);
            log.event(Level::Warning, host_now_us(), &words);
        }
        let intake = LineIntake { log: Arc::clone(log), board: board.clone(), reporter: reporter.clone() };
        std::thread::Builder::new()
            .name("lines".to_owned())
            .spawn(move || {
                while let Some((device, event)) = arrivals.blocking_recv() {
                    intake.take(device, event);
                }
                intake.log.tell(Event::Ended(Source::Lines));
            })
            .map_err(|source| SessionError::Thread { source })?;
        Ok(Self { runtime, tasks })
    }

    /// Closes the ports once what has arrived is read.
    pub(super) fn close(self) {
        let Self { runtime, tasks } = self;
        tasks.iter().for_each(PortTask::finish);
        std::thread::spawn(move || {
            runtime.block_on(async {
                for task in tasks {
                    task.ended_within(DRAIN).await;
                }
            });
            runtime.shutdown_timeout(DRAIN);
        });
    }
}

fn ports(setup: &Setup) -> Vec<PortConfig> {
    let carm = setup.session.carm.as_ref().map(|line| (DeviceKind::Carm, line.port.clone(), line.baud));
    let robot = setup.session.robot.as_ref().map(|line| (DeviceKind::Robot, line.port.clone(), line.baud));
    let config = |(device, path, baud)| PortConfig { device, path, baud, adapter: setup.adapters.of(device).cloned() };
    [carm, robot].into_iter().flatten().map(config).collect()
}

fn new_link(device: DeviceKind) -> Link {
    Link { device, open: false, epoch: 0, health: Default::default(), last_byte_us: None, trouble: None }
}

struct LineIntake {
    log: Arc<SessionLog>,
    board: Board,
    reporter: Reporter,
}

impl LineIntake {
    /// Records what a port says, shows it, and hands bytes to the engine.
    fn take(&self, device: DeviceKind, event: PortEvent) {
        let link = |change: &dyn Fn(&mut Link)| {
            self.board.update(|state| state.links.iter_mut().filter(|link| link.device == device).for_each(change));
        };
        match event {
            PortEvent::Bytes { host_us, epoch, bytes } => {
                self.log.input(Input::Bytes { device, epoch, host_us, bytes });
                link(&|link| link.last_byte_us = Some(host_us));
            }
            PortEvent::Opened { epoch, host_us, .. } => {
                link(&|link| {
                    link.open = true;
                    link.epoch = epoch;
                    link.trouble = None;
                });
                self.log.event(Level::Info, host_us, &format!("{} line opened, epoch {epoch}", device.key()));
                self.log.tell(Event::LineOpened { device, host_us });
            }
            PortEvent::Lost { reason, host_us, .. } => {
                link(&|link| {
                    link.open = false;
                    link.trouble = Some(reason.clone());
                });
                self.log.event(Level::Warning, host_us, &format!("{} line lost: {reason}", device.key()));
                let advice = format!("{} line lost ({reason}); it is re-opened as soon as it is back", device.key());
                self.reporter.warn("line lost", advice);
                self.log.tell(Event::LineLost { device, host_us, reason });
            }
            PortEvent::Said { host_us, words } => {
                self.log.event(Level::Warning, host_us, &format!("{} line: {words}", device.key()));
                self.reporter.warn("line", format!("{} line: {words}", device.key()));
            }
            PortEvent::Retry { error, attempt, .. } => {
                link(&|link| link.trouble = Some(error.to_string()));
                if attempt == 1 {
                    self.reporter.warn("line not open", format!("{error}; {}", crate::telemetry::hint(&error)));
                }
            }
        }
    }
}

/// Where a session's frames come from, from now on: its folder, and what is sent into that over DICOM.
pub(super) fn frame_source(
    setup: &Setup,
    include_existing: bool,
    reporter: &Reporter,
) -> Result<Box<dyn FrameSource>, SessionError> {
    let path = &setup.session.frames.folder;
    let folder = FolderSource::new(path, setup.domain(), include_existing, foreign::installed());
    let Some(dicom) = &setup.session.frames.dicom else { return Ok(Box::new(folder)) };
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
                intake.run(&told);
                intake.log.tell(Event::Ended(Source::Frames));
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
        loop {
            let is_closing = closing.load(Ordering::Relaxed);
            if is_closing {
                self.source.close();
            }
            self.look();
            let has_room = is_closing || self.held_bytes() <= MOST_PIXEL_BYTES;
            if has_room && let Some(seen) = self.next() {
                self.read(seen);
                continue;
            }
            if is_closing && self.backlog.is_empty() {
                last_looks -= 1;
                if last_looks == 0 {
                    return;
                }
            }
            std::thread::sleep(FOLDER_POLL);
        }
    }

    fn look(&mut self) {
        let host_us = host_now_us();
        let mut ready = Vec::new();
        for sighting in self.source.look(host_us) {
            match sighting {
                Sighting::Ready(arrival) => ready.push(arrival),
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
        }
        ready.sort_by_key(Arrival::modified_us);
        for arrival in ready {
            self.numbered += 1;
            self.backlog.push(Seen { number: self.numbered, host_us: arrival.seen_us().min(host_us), arrival });
        }
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
