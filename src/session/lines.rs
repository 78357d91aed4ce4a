//! The devices' lines of a session, on a thread that does nothing else. They are heard before anything can be recorded.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc::{Receiver, channel};

use super::SessionError;
use super::board::{Board, Link};
use super::event::{Event, Source};
use super::fault;
use super::file::Setup;
use super::input::Input;
use super::log::SessionLog;
use super::sources::Ending;
use crate::record::Level;
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, PortEvent, PortTask, spawn_port};
use crate::time::host_now_us;

/// So many reads of ports may wait: two devices' of a quarter of an hour, in which a scene is loaded. When it is full, bytes wait in the
/// system's buffers.
const PORT_QUEUE: usize = 1 << 18;
/// A port that is closed may take this long to hand over what has arrived.
const DRAIN: Duration = Duration::from_millis(200);

/// The ports of a session, open; what they say waits until somebody records it.
pub(super) struct Ports {
    runtime: tokio::runtime::Runtime,
    tasks: Vec<PortTask>,
    arrivals: Receiver<(DeviceKind, PortEvent)>,
}

impl Ports {
    /// Opens the ports of a session.
    pub(super) fn listen(setup: &Setup, board: &Board) -> Result<Self, SessionError> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(|source| SessionError::Thread { source })?;
        let (sender, arrivals) = channel(PORT_QUEUE);
        let mut tasks = Vec::new();
        for config in setup.ports().into_iter().flatten() {
            board.update(|state| state.links.push(Link::new(config.device)));
            tasks.push(spawn_port(runtime.handle(), config, sender.clone()));
        }
        Ok(Self { runtime, tasks, arrivals })
    }

    /// Records what has come so far, then all that comes; it goes to the engine as well.
    pub(super) fn record(
        self,
        setup: &Setup,
        log: &Arc<SessionLog>,
        board: &Board,
        reporter: &Reporter,
    ) -> Result<Lines, SessionError> {
        for (what, words) in setup.adapters.unknowns() {
            reporter.warn(what, &words);
            log.event(Level::Warning, host_now_us(), &words);
        }
        let Self { runtime, tasks, mut arrivals } = self;
        let intake = LineIntake { log: Arc::clone(log), board: board.clone(), reporter: reporter.clone() };
        // On this thread: the engine hears of it before its clock ticks.
        while let Ok((device, event)) = arrivals.try_recv() {
            intake.take(device, event);
        }
        std::thread::Builder::new()
            .name("lines".to_owned())
            .spawn(move || {
                let _told = Ending::new(Source::Lines, &intake.log, &intake.reporter);
                let mut taken = 0_u32;
                while let Some((device, event)) = arrivals.blocking_recv() {
                    taken = taken.saturating_add(1);
                    fault::breaks("lines", taken);
                    intake.take(device, event);
                }
            })
            .map_err(|source| SessionError::Thread { source })?;
        Ok(Lines { runtime, tasks })
    }
}

/// The serial lines, recorded.
pub(super) struct Lines {
    runtime: tokio::runtime::Runtime,
    tasks: Vec<PortTask>,
}

impl Lines {
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
        if let Some((kind, words)) = warning(device, &event) {
            self.reporter.warn(&kind, words);
        }
        match event {
            PortEvent::Bytes { host_us, epoch, bytes } => {
                self.log.input(Input::Bytes { device, epoch, host_us, bytes });
            }
            PortEvent::Opened { epoch, host_us, .. } => {
                link(&|link| {
                    link.open = true;
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
                self.log.tell(Event::LineLost { device, host_us, reason });
            }
            PortEvent::Said { host_us, words } => {
                self.log.event(Level::Warning, host_us, &format!("{} line: {words}", device.key()));
            }
            PortEvent::Retry { error, .. } => link(&|link| link.trouble = Some(error.to_string())),
        }
    }
}

/// What a person is told of a line's trouble: the kind, which names the line, so that counts and latest words are those of one line, and
/// the words.
fn warning(device: DeviceKind, event: &PortEvent) -> Option<(String, String)> {
    match event {
        PortEvent::Lost { reason, .. } => {
            Some((format!("{device} line lost"), format!("{device} line lost ({reason}); it is re-opened as soon as it is back")))
        }
        PortEvent::Retry { error, attempt: 1, .. } => {
            Some((format!("{device} line not open"), format!("{error}; {}", crate::telemetry::hint(error))))
        }
        PortEvent::Said { words, .. } => Some((format!("{device} line"), format!("{device} line: {words}"))),
        PortEvent::Retry { .. } | PortEvent::Bytes { .. } | PortEvent::Opened { .. } => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both lines were counted together: after five losses of the C-arm and one of the robot the report said "line lost, 6 times: robot".
    #[test]
    fn each_line_s_losses_are_counted_and_worded_by_themselves() {
        let reporter = Reporter::silent();
        for device in [DeviceKind::Carm, DeviceKind::Carm, DeviceKind::Robot] {
            let lost = PortEvent::Lost { epoch: 1, host_us: 0, reason: "unplugged".to_owned() };
            let (kind, words) = warning(device, &lost).expect("a person must know");
            reporter.warn(&kind, words);
        }
        let counted: Vec<_> =
            reporter.warnings().into_iter().map(|(kind, counted)| (kind, counted.count, counted.latest)).collect();
        assert_eq!(counted.iter().map(|(_, count, _)| *count).collect::<Vec<_>>(), [2, 1]);
        for ((kind, _, latest), device) in counted.iter().zip(["C-arm", "robot"]) {
            assert!(kind.starts_with(device) && latest.starts_with(device), "{kind}: {latest}");
        }
    }
}
