//! A running session. Threads, each with one task, joined by channels:
//!
//! ```text
//! ports ─ lines ──┬─ log (first) ─┬─ engine ─ registrar ─ engine ─ workshop ─ scribe ─ log, folder, board
//! folder ─ frames ┤               └─ file
//! window ─ edits ─┘                      engine ─ editor ─ workshop
//! ```
//! Nothing that is slow or dead behind the engine stops what is in front of it from being recorded.

mod ending;
mod ready;
mod registering;
mod telling;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use super::SessionError;
use super::background::loops_stand_back;
use super::board::Board;
use super::broadcast::Broadcast;
use super::busy::{AtWork, Busy, LATE_AFTER, Task};
use super::chime::Chime;
use super::crosscheck::refuse_among_frames;
use super::develop::solved;
use super::edit::{BeadEdit, EditRequest, take_note};
use super::editor::Editor;
use super::engine::Engine;
use super::event::{Event, Source};
use super::file::Setup;
use super::folder::{Collector, Folder, Times};
use super::input::{Input, Output};
use super::jobs::Order;
use super::lines::{Lines, Ports};
use super::link_view::LinkReadings;
use super::log::SessionLog;
use super::onlooker::Onlooker;
use super::places;
use super::posing::{PoseJob, Registered};
use super::registrar::start_registrar;
use super::scribe::Scribe;
use super::sources::{Frames, frame_source};
use super::stop::Stop;
use super::tracks::{News, Tracks};
use super::whereabouts::Whereabouts;
use super::workshop::Workshop;
use crate::gpu::DeviceChoice;
use crate::record::Level;
use crate::reporter::{Progress, Reporter};
use crate::telemetry::DeviceKind;
use crate::time::{Stopwatch, host_now_us};

/// How a live session runs.
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// The session's folder.
    pub out: PathBuf,
    /// Set from outside to end the session.
    pub stop: Stop,
    /// Ends by itself after this many seconds.
    pub seconds: Option<f64>,
    /// Also take frames that were in the folder before the start.
    pub include_existing: bool,
    /// Each exposure makes a sound.
    pub sound: bool,
}

/// The session's thread looks at the clock and the stop flag this often.
const LOOK: Duration = Duration::from_millis(5);
/// Faults of a line that are logged one by one within a tick; the counters hold all.
const FAULTS_PER_TICK: u32 = 10;

/// Runs until stopped; returns the finished session's folder. `edits` are what a person asks for who looks at `board`; without them frames
/// cannot be edited.
///
/// # Errors
/// When the scene cannot be loaded, the folder cannot be written, or no renderer is available. What was recorded stays readable.
pub fn run(
    setup: Setup,
    options: &LiveOptions,
    edits: Option<Receiver<EditRequest>>,
    board: &Board,
    reporter: &Reporter,
) -> Result<Folder, SessionError> {
    loops_stand_back();
    let setup = Arc::new(setup);
    SessionLog::refuse_occupied(&options.out)?;
    // Before anything that takes time: what arrives meanwhile is the session's.
    let heard_from_us = host_now_us();
    let (of_frames, include_existing, told) = (Arc::clone(&setup), options.include_existing, reporter.clone());
    let out = options.out.clone();
    let folder_late = || reporter.warn(Task::Folder.kind(), Task::Folder.words(LATE_AFTER));
    let source = unless_stopped(&options.stop, "frame folder", folder_late, move || {
        match refuse_among_frames(&out, &of_frames.session.frames.folder) {
            Some(detail) => Err(SessionError::AmongFrames { detail }),
            None => frame_source(&of_frames, include_existing, &told),
        }
    })??;
    let ports = Ports::listen(&setup, board)?;
    let (of_scene, told) = (Arc::clone(&setup), reporter.clone());
    // What is heard meanwhile waits to be recorded.
    let mut workshop =
        unless_stopped(&options.stop, "scene", || (), move || Workshop::open(&of_scene, DeviceChoice::Auto, &told))??;
    places::remember(workshop.names());
    let started_us = host_now_us();
    let (events, inbox) = channel();
    let whereabouts = Whereabouts::new(&setup, workshop.robot());
    let broadcast = Arc::new(Broadcast::open(setup.session.igtl.as_ref(), whereabouts.clone(), reporter)?);
    let collector = Collector::create(&options.out, heard_from_us, Times::Told, &workshop)?;
    board.keep_pictures_in(&options.out, reporter);
    let log = Arc::new(SessionLog::create((&options.out, heard_from_us), &setup, &workshop, events, reporter)?);
    let mut engine = Engine::new(Arc::clone(&setup), workshop.layout().cloned(), reporter.clone());
    engine.park_in(&options.out);
    let busy = workshop.busy().clone();
    let editor = edits.map(|edits| Editor::start(edits, Arc::clone(&log), &busy, reporter)).transpose()?;
    if editor.is_some() {
        engine.keep_for_edits();
        board.update(|state| state.editable = true);
    }
    let chime = if options.sound { Some(Chime::start(reporter)?) } else { None };
    let (scribe, pairs) =
        Scribe::start(collector, Arc::clone(&log), board.clone(), (Arc::clone(&broadcast), &busy, chime), reporter)?;
    workshop.start(Order::NewestFirst, move |developed| pairs.send(developed).is_ok())?;
    let jobs = start_registrar(Arc::clone(&log), reporter)?;
    let lines = ports.record(&setup, &log, board, reporter)?;
    let frames = Frames::watch(source, &log, (board, &busy), reporter)?;
    if editor.is_none() {
        // No window says it.
        reporter.note(ready::ready(&setup, workshop.names(), &options.out));
    }
    let session = Session {
        engine,
        log,
        jobs,
        workshop,
        broadcast,
        scribe,
        tracks: Tracks::new(),
        onlooker: Onlooker::new(whereabouts),
        board: board.clone(),
        reporter: reporter.clone(),
        stage: Stage::Open { lines, frames },
        lines_ended: false,
        frames_ended: false,
        end_is_logged: false,
        registering: None,
        registrar_ended: false,
        busy,
        late_said: BTreeSet::new(),
        dead_said: BTreeSet::new(),
        editor,
        newest_posed: 0,
        faults_this_tick: 0,
        next_tick_us: started_us,
        tell_losses_us: started_us,
        told_losses: BTreeMap::new(),
        told_keepers_lost: 0,
        finishing: None,
        readings: LinkReadings::default(),
    };
    session.run(&inbox, options, started_us)
}

/// Opens `what`, which may take long, or for ever, before a session begins: whoever wants to leave may. `late` is called where it takes longer
/// than a second.
fn unless_stopped<T: Send + 'static>(
    stop: &Stop,
    what: &'static str,
    late: impl Fn(),
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, SessionError> {
    let opening = std::thread::Builder::new().name("opening".to_owned()).spawn(work);
    let opening = opening.map_err(|source| SessionError::Thread { source })?;
    let (watch, mut is_late) = (Stopwatch::start(), false);
    while !opening.is_finished() {
        if stop.is_asked() {
            return Err(SessionError::NotBegun);
        }
        if watch.ms() >= 1e3 * LATE_AFTER.as_secs_f64() && !std::mem::replace(&mut is_late, true) {
            late();
        }
        std::thread::sleep(LOOK);
    }
    opening.join().map_err(|_| SessionError::OpeningDied { what })
}

/// How far a session has come.
enum Stage {
    /// Things come in.
    Open { lines: Lines, frames: Frames },
    /// The sources were told to end; what they still have comes in.
    Closing { asked_us: i64 },
    /// Nothing comes in any more; what is there is developed.
    Finishing,
}

struct Session {
    engine: Engine,
    log: Arc<SessionLog>,
    jobs: Sender<PoseJob>,
    workshop: Workshop,
    broadcast: Arc<Broadcast>,
    scribe: Scribe,
    tracks: Tracks,
    onlooker: Onlooker,
    board: Board,
    reporter: Reporter,
    stage: Stage,
    lines_ended: bool,
    frames_ended: bool,
    end_is_logged: bool,
    /// The frame that is being registered.
    registering: Option<(u32, AtWork)>,
    /// Its thread died: no frame is registered any more.
    registrar_ended: bool,
    busy: Busy,
    /// Tasks of which it was said that they are late, or that they hang.
    late_said: BTreeSet<(Task, bool)>,
    /// Kinds of threads of which it was said that they died.
    dead_said: BTreeSet<&'static str>,
    /// Who edits beads; absent without a window.
    editor: Option<Editor>,
    /// Number of the newest frame that was handed to be posed.
    newest_posed: u32,
    faults_this_tick: u32,
    next_tick_us: i64,
    tell_losses_us: i64,
    told_losses: BTreeMap<DeviceKind, u64>,
    told_keepers_lost: u32,
    finishing: Option<(Progress, usize)>,
    readings: LinkReadings,
}

impl Session {
    fn run(mut self, inbox: &Receiver<Event>, options: &LiveOptions, started_us: i64) -> Result<Folder, SessionError> {
        loop {
            match inbox.recv_timeout(LOOK) {
                Ok(event) => self.take(event),
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {}
            }
            self.register_next();
            self.workshop.await_frames(self.frames_come());
            self.take_edits();
            let now_us = host_now_us();
            if now_us >= self.next_tick_us {
                self.tick(now_us);
            }
            let over = options.seconds.is_some_and(|limit_s| (now_us - started_us) as f64 * 1e-6 > limit_s);
            if options.stop.leaves_at_once() {
                return Ok(self.leave());
            }
            self.advance(over || options.stop.is_asked());
            // Where a thread died, the others end before it is over.
            if matches!(self.stage, Stage::Finishing) && self.scribe.has_ended() && self.is_registered() {
                return self.close();
            }
        }
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Input(input) => {
                let tick_us = if let Input::Tick { host_us } = &input { Some(*host_us) } else { None };
                self.with_engine(|engine, sink| engine.push(input, sink));
                // In the order of what was heard: nothing that waits to be taken is silence.
                tick_us.into_iter().for_each(|now_us| self.broadcast.look(&self.engine, now_us));
            }
            Event::Registered(registered) => {
                self.registering = None;
                self.with_engine(|engine, sink| engine.registered(*registered, sink));
            }
            Event::Edited(posed) => {
                self.editor.iter_mut().for_each(Editor::done);
                self.take_output(Output::Posed(posed.clone()));
                // The pose is seen at once, its DRR when it is made.
                self.board.show(|| solved(*posed));
            }
            Event::LineOpened { device, host_us } => self.tracks.line_opened(device, host_us),
            Event::LineLost { device, host_us, reason } => self.tracks.line_lost(device, host_us, &reason),
            Event::Ended(source) => {
                // A session without lines hears of their end at its start.
                match source {
                    Source::Frames => self.frames_ended = true,
                    Source::Lines => self.lines_ended = true,
                    // Nobody answers for the frame that it had.
                    Source::Registrar => (self.registrar_ended, self.registering) = (true, None),
                    Source::Editor => self.editor.iter_mut().for_each(Editor::give_up),
                }
            }
        }
    }

    fn with_engine(&mut self, drive: impl FnOnce(&mut Engine, &mut dyn FnMut(Output))) {
        let mut outputs = Vec::new();
        drive(&mut self.engine, &mut |output| outputs.push(output));
        for output in outputs {
            self.take_output(output);
        }
    }

    fn take_output(&mut self, output: Output) {
        match output {
            Output::Sample { device, host_us, sample } => {
                self.log.sample(device, host_us, &sample);
                let world_from_lps = self.engine.world_from_lps();
                self.broadcast.sample(host_us, &sample, world_from_lps);
                self.onlooker.sample(&self.log, host_us, &sample, world_from_lps);
                match self.tracks.sample(host_us, &sample) {
                    Some(News::Told(words)) => {
                        // One status must not hide another; what bits without a meaning say is counted together.
                        let kind = if words.contains("status bit") { "device status" } else { words.as_str() };
                        self.reporter.warn(kind, &words);
                        self.log.event(Level::Warning, host_us, &words);
                    }
                    Some(News::Lost(words)) => {
                        self.reporter.warn(&words, &words);
                        self.log.lose_for_good(words);
                    }
                    None => {}
                }
            }
            Output::Fault { device, host_us, detail } => {
                self.faults_this_tick += 1;
                if self.faults_this_tick <= FAULTS_PER_TICK {
                    self.log.event(Level::Warning, host_us, &format!("{}: {detail}", device.key()));
                }
            }
            Output::Bound { .. } => {}
            Output::BoundLate { words, .. } => self.log.event(Level::Warning, host_now_us(), &words),
            Output::Job(job) => {
                // The registrar ends with this thread.
                let _ = self.jobs.send(*job);
            }
            Output::PictureLost { job, words } => {
                self.log.lose(format!("frame {}: {words}; {}", job.number(), self.log.again()));
                self.log.tell(Event::Registered(Box::new(Registered::failed(*job, &words))));
            }
            Output::Edit(job) => {
                let number = job.number();
                if !self.editor.as_ref().is_some_and(|editor| editor.submit(*job)) {
                    self.not_edited(&format!(
                        "frame {number} is not edited: the thread of edits died; a replay of the log makes the edit"
                    ));
                }
            }
            Output::NotEdited { words, .. } => self.not_edited(&words),
            Output::Noted { number, words } => {
                self.tracks.noted(number, &words);
                self.board.update(|state| take_note(&mut state.notes, number, &words));
            }
            Output::Posed(posed) => {
                let words = posed.announcement();
                self.reporter.note(&words);
                for caution in posed.pose.cautions.iter().filter(|_| posed.pose.is_accepted()) {
                    self.reporter.warn("doubtful pose", format!("{}: {caution}", posed.label()));
                }
                let placed = self.onlooker.posed(&posed, self.engine.world_from_lps());
                self.log.pose(&posed, &placed);
                self.broadcast.posed(&posed, &words);
                self.workshop.submit(*posed, None);
            }
        }
    }

    /// An edit came to nothing.
    fn not_edited(&mut self, words: &str) {
        self.editor.iter_mut().for_each(Editor::done);
        self.reporter.warn("not edited", words);
        self.log.event(Level::Warning, host_now_us(), words);
    }

    /// What a person asks for is logged, and comes to the engine as all else does.
    fn take_edits(&mut self) {
        let Some(editor) = self.editor.as_mut().filter(|_| matches!(self.stage, Stage::Open { .. })) else { return };
        for EditRequest { number, edit } in editor.take(self.registering.is_some()) {
            let host_us = host_now_us();
            self.log.input(match edit {
                BeadEdit::Note { words } => Input::Note { number, words, host_us },
                edit => Input::Edit { number, edit, host_us },
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whoever reads it looks there, and not for the renderer.
    #[test]
    fn a_fault_in_opening_the_folder_is_said_to_be_there() {
        let stop = Stop::default();
        let opened = |work: fn() -> u32| unless_stopped(&stop, "frame folder", || (), work);
        let words = opened(|| panic!("a fault")).expect_err("it died").to_string();
        assert!(words.contains("opening the frame folder failed") && words.contains("nothing was recorded"), "{words}");
        assert_eq!(opened(|| 7).ok(), Some(7), "the control");
        stop.finish();
        let left = unless_stopped(&stop, "scene", || (), || std::thread::sleep(Duration::from_secs(2)));
        assert!(matches!(left, Err(SessionError::NotBegun)), "{left:?}");
    }
}
