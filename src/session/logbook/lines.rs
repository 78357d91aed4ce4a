//! The devices of a log: its serial bytes through the decoder into a timeline, as the session had them.

use super::super::file::Setup;
use super::super::log::SETUP_TOPIC;
use super::super::losses::line_losses;
use super::super::records::RESTART_TOPIC;
use crate::record::{LogEntry, RecordError, topic};
use crate::telemetry::{DeviceKind, Event, Health, Link};
use crate::timeline::{ExposureInterval, Stamps, Timeline};

/// What the decoder found in the bytes of a message.
pub(super) struct Heard<'a> {
    pub device: DeviceKind,
    /// Opening of the port.
    pub epoch: u32,
    pub event: &'a Event,
    /// Its times as they are known so far; of samples that have one.
    pub stamps: Option<Stamps>,
}

/// Takes the messages of a log in order.
pub(super) struct Lines {
    links: [Link; 2],
    timeline: Timeline,
    /// Exposures of the logs that were joined before, and what their lines had lost.
    before: Vec<(Vec<ExposureInterval>, [Link; 2])>,
    /// How the bytes are read: packets, until the session's setup says otherwise.
    setup: Option<Setup>,
}

impl Lines {
    pub(super) fn new() -> Self {
        Self { links: DeviceKind::ALL.map(Link::new), timeline: Timeline::new(), before: Vec::new(), setup: None }
    }

    /// Logs joined on before.
    pub(super) fn piece(&self) -> u32 {
        self.before.len() as u32
    }

    /// Takes any message; `sink` is told what came of it.
    ///
    /// # Errors
    /// When raw bytes are shorter than their own head.
    pub(super) fn take(&mut self, entry: &LogEntry, sink: &mut dyn FnMut(Heard<'_>)) -> Result<(), RecordError> {
        let device = match &*entry.topic {
            topic::CARM_RAW => DeviceKind::Carm,
            topic::ROBOT_RAW => DeviceKind::Robot,
            SETUP_TOPIC if self.setup.is_none() => {
                // What is no setup says nothing of how bytes are read.
                self.setup = entry.json().ok();
                self.listen_anew();
                return Ok(());
            }
            RESTART_TOPIC => {
                self.finish();
                self.before.push((self.timeline.exposures(), self.links.clone()));
                self.listen_anew();
                return Ok(());
            }
            _ => return Ok(()),
        };
        let Some(raw) = entry.raw_bytes()? else { return Ok(()) };
        let Self { links, timeline, .. } = self;
        links[device as usize].feed(entry.host_us, raw.epoch, raw.bytes, &mut |received| {
            let stamps = match &received.event {
                Event::Sample(sample, sequenced) => {
                    timeline.push_sample(device, entry.host_us, raw.epoch, *sequenced, sample.clone())
                }
                Event::Fault(_) => None,
            };
            sink(Heard { device, epoch: raw.epoch, event: &received.event, stamps });
        });
        Ok(())
    }

    /// As a session that begins.
    fn listen_anew(&mut self) {
        let Some(setup) = &self.setup else {
            (self.links, self.timeline) = (DeviceKind::ALL.map(Link::new), Timeline::new());
            return;
        };
        (self.links, self.timeline) = (DeviceKind::ALL.map(|device| setup.link(device)), setup.adapters.timeline());
    }

    /// Times of a sample of the log that is being read, as they are known by now; `None` while they may yet become better, because samples
    /// like it had waited in front of a port that was just opened.
    pub(super) fn stamps_now(&self, device: DeviceKind, stamps: &Stamps) -> Option<Stamps> {
        let now = self.timeline.stamps_now(device, stamps);
        (!self.timeline.is_catching_up(device)).then(|| now.unwrap_or(*stamps))
    }

    /// Nothing more comes of the log that is being read.
    pub(super) fn finish(&mut self) {
        self.timeline.finish();
    }

    /// Exposures of each of the logs that were joined, in order.
    pub(super) fn exposures(&self) -> Vec<Vec<ExposureInterval>> {
        self.before.iter().map(|(exposures, _)| exposures.clone()).chain([self.timeline.exposures()]).collect()
    }

    fn links(&self, device: DeviceKind) -> impl Iterator<Item = &Link> {
        self.before.iter().map(|(_, links)| links).chain([&self.links]).map(move |links| &links[device as usize])
    }

    /// Counters of a device in each of the logs that were joined, in order.
    pub(super) fn health(&self, device: DeviceKind) -> Vec<Health> {
        self.links(device).map(|link| *link.health()).collect()
    }

    /// What the session had lost on its lines, a sentence each: the log holds it as it was.
    pub(super) fn losses(&self) -> Vec<String> {
        DeviceKind::ALL.into_iter().flat_map(|device| self.links(device).filter_map(line_losses)).collect()
    }
}
