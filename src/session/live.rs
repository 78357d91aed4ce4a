//! A running session: ports and folder in, log first, then the engine, then pairs.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::SessionError;
use super::board::{Board, Link};
use super::develop::{Developed, Workshop};
use super::engine::{Engine, Input, Output, Posed};
use super::file::Setup;
use super::folder::Folder;
use super::journal::Journal;
use crate::acquire::{FolderSource, Frame, FrameSource, Reading, Sighting};
use crate::foreign;
use crate::gpu::DeviceChoice;
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, PortConfig, PortEvent, spawn_port};
use crate::time::host_now_us;

/// How a live session runs.
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// The session's folder.
    pub out: PathBuf,
    /// Set from outside to end the session.
    pub stop: Arc<AtomicBool>,
    /// Ends by itself after this many seconds.
    pub seconds: Option<f64>,
    /// Also take frames that were in the folder before the start.
    pub include_existing: bool,
}

/// Ticks keep waiting frames and stale marks moving when nothing arrives.
const TICK_US: i64 = 100_000;
/// Capacity of the channel from the ports; when full, bytes wait in the system's buffers.
const PORT_QUEUE: usize = 4096;
/// After the stop, pairs that are still being developed may take this long.
const SETTLE_MS: u64 = 5;

/// Runs until stopped; returns the finished session's folder.
///
/// # Errors
/// When the scene cannot be loaded, the folder cannot be written, or no renderer is available. What was recorded stays readable.
pub fn run(setup: Setup, options: &LiveOptions, board: &Board, reporter: &Reporter) -> Result<Folder, SessionError> {
    let mut workshop = Workshop::open(&setup, DeviceChoice::Auto, reporter)?;
    let mut journal = Journal::create(&options.out, &setup, &workshop, reporter)?;
    let mut engine = Engine::new(setup.clone(), workshop.layout().cloned(), reporter.clone());
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(|source| SessionError::Runtime { source })?;
    let (sender, mut arrivals) = tokio::sync::mpsc::channel::<(DeviceKind, PortEvent)>(PORT_QUEUE);
    let mut tasks = Vec::new();
    for (device, line) in lines(&setup) {
        board.update(|state| state.links.push(new_link(device)));
        tasks.push(spawn_port(runtime.handle(), line, sender.clone()));
    }
    drop(sender);
    let frames = &setup.session.frames;
    let mut watch = FolderSource::new(&frames.folder, frames.domain, options.include_existing, foreign::installed());

    let started_us = host_now_us();
    let mut next_tick_us = started_us;
    let mut outputs = Vec::new();
    loop {
        let mut idle = true;
        while let Ok((device, event)) = arrivals.try_recv() {
            idle = false;
            if let Some(input) = arrival(device, event, board, &mut journal, reporter) {
                engine.push(input, &mut |output| outputs.push(output));
            }
        }
        let now_us = host_now_us();
        if now_us >= next_tick_us {
            next_tick_us = now_us + TICK_US;
            journal.tick(now_us);
            engine.push(Input::Tick { host_us: now_us }, &mut |output| outputs.push(output));
            for sighting in watch.look(now_us) {
                for frame in found(sighting, board, reporter, &mut journal, now_us) {
                    journal.frame(&frame, now_us);
                    engine.push(Input::Frame { frame, host_us: now_us }, &mut |output| outputs.push(output));
                }
            }
            publish(board, &engine, reporter, now_us);
            idle = false;
        }
        for output in outputs.drain(..) {
            take(output, &mut journal, &mut workshop, reporter);
        }
        while let Some(developed) = workshop.try_take() {
            finish_pair(developed, &mut journal, board)?;
        }
        let over = options.seconds.is_some_and(|limit_s| (now_us - started_us) as f64 * 1e-6 > limit_s);
        if over || options.stop.load(Ordering::Relaxed) {
            break;
        }
        if idle {
            std::thread::sleep(Duration::from_millis(SETTLE_MS));
        }
    }
    for task in tasks {
        task.stop();
    }
    runtime.shutdown_timeout(Duration::from_millis(500));
    let end_us = host_now_us();
    journal.end(end_us);
    engine.finish(end_us, &mut |output| outputs.push(output));
    for output in outputs.drain(..) {
        take(output, &mut journal, &mut workshop, reporter);
    }
    for developed in workshop.finish()? {
        finish_pair(developed, &mut journal, board)?;
    }
    publish(board, &engine, reporter, end_us);
    board.update(|state| state.finished = true);
    journal.close(&engine, reporter)
}

fn lines(setup: &Setup) -> Vec<(DeviceKind, PortConfig)> {
    let carm = setup.session.carm.as_ref().map(|line| (DeviceKind::Carm, line.port.clone(), line.baud));
    let robot = setup.session.robot.as_ref().map(|line| (DeviceKind::Robot, line.port.clone(), line.baud));
    [carm, robot].into_iter().flatten().map(|(device, path, baud)| (device, PortConfig { device, path, baud })).collect()
}

fn new_link(device: DeviceKind) -> Link {
    Link { device, open: false, epoch: 0, health: Default::default(), last_byte_us: None, trouble: None }
}

/// Records what a port says, shows it, and turns bytes into an input.
fn arrival(device: DeviceKind, event: PortEvent, board: &Board, journal: &mut Journal, reporter: &Reporter) -> Option<Input> {
    let link = |change: &dyn Fn(&mut Link)| {
        board.update(|state| state.links.iter_mut().filter(|link| link.device == device).for_each(change));
    };
    match event {
        PortEvent::Opened { epoch, path, host_us, .. } => {
            link(&|link| {
                link.open = true;
                link.epoch = epoch;
                link.trouble = None;
            });
            journal.line_opened(device, host_us, epoch, &path);
            None
        }
        PortEvent::Lost { reason, host_us, .. } => {
            link(&|link| {
                link.open = false;
                link.trouble = Some(reason.clone());
            });
            journal.line_lost(device, host_us, &reason);
            reporter.warn("line lost", format!("{} line lost ({reason}); it is re-opened as soon as it is back", device.key()));
            None
        }
        PortEvent::Retry { error, attempt, .. } => {
            link(&|link| link.trouble = Some(error.to_string()));
            if attempt == 1 {
                reporter.warn("line not open", format!("{error}; {}", crate::telemetry::hint(&error)));
            }
            None
        }
        PortEvent::Bytes { host_us, epoch, bytes } => {
            // The raw bytes go to the log before anything is made of them.
            journal.bytes(device, epoch, host_us, &bytes);
            link(&|link| link.last_byte_us = Some(host_us));
            Some(Input::Bytes { device, epoch, host_us, bytes })
        }
    }
}

fn found(sighting: Sighting, board: &Board, reporter: &Reporter, journal: &mut Journal, now_us: i64) -> Vec<Arc<Frame>> {
    let mut say = |kind: &str, words: String| {
        journal.event(now_us, &words);
        reporter.warn(kind, words);
    };
    match sighting {
        Sighting::Ready(arrival) => match arrival.read() {
            Reading::Frames { frames, .. } => {
                board.update(|state| state.frames_seen += frames.len());
                return frames.into_iter().map(Arc::new).collect();
            }
            Reading::Refused(error) => say("unreadable frame", format!("unreadable frame {error}; the file is left where it is")),
            Reading::Same { .. } | Reading::Later => {}
        },
        Sighting::Trouble(trouble) => say(trouble.kind(), trouble.to_string()),
        Sighting::FolderLost { detail } => say("frame folder", format!("the frame folder cannot be listed ({detail})")),
        Sighting::FolderBack => say("frame folder", "the frame folder is back".to_owned()),
    }
    Vec::new()
}

fn take(output: Output, journal: &mut Journal, workshop: &mut Workshop, reporter: &Reporter) {
    match output {
        Output::Sample { device, host_us, sample } => journal.sample(device, host_us, &sample),
        Output::Fault { device, host_us, detail } => {
            journal.event(host_us, &format!("{}: {detail}", device.key()));
        }
        Output::Posed(posed) => {
            announce(&posed, reporter);
            journal.pose(&posed);
            workshop.submit(*posed, None);
        }
    }
}

fn announce(posed: &Posed, reporter: &Reporter) {
    if let Some(reason) = &posed.pose.reason {
        reporter.note(format!("{}: refused, {reason}", posed.frame.name));
    }
}

fn finish_pair(developed: Developed, journal: &mut Journal, board: &Board) -> Result<(), SessionError> {
    let view = Arc::new(developed.picture());
    board.update(|state| match state.pairs.iter_mut().find(|pair| pair.name == view.name) {
        Some(slot) => *slot = view,
        None => state.pairs.push(view),
    });
    journal.pair(developed)
}

fn publish(board: &Board, engine: &Engine, reporter: &Reporter, now_us: i64) {
    board.update(|state| {
        state.now_us = now_us;
        for link in &mut state.links {
            if let Some(health) = engine.health(link.device) {
                link.health = health;
            }
        }
        state.warnings = reporter.warnings().into_iter().map(|(kind, counted)| (kind, counted.count)).collect();
    });
}
