//! What is in a log.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;
use serde_json::Value;

use super::super::log::{END_TOPIC, SETUP_TOPIC};
use super::super::records::{CUT_TOPIC, REDACTED_TOPIC, RESTART_TOPIC};
use super::LogbookError;
use super::frames::{FrameTold, Frames, PoseTold};
use super::lines::Lines;
use crate::record::{LogLoss, LogReader, Provenance, Tolerance, topic};
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, Event, Health};

/// Messages of one topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TopicTold {
    /// Name of the schema.
    pub schema: String,
    /// How many.
    pub messages: u64,
    /// As they are, before compression.
    pub bytes: u64,
    /// Between the first and the last of them; `None` for fewer than two.
    pub per_s: Option<f64>,
    /// Host time.
    pub first_us: i64,
    /// Host time.
    pub last_us: i64,
}

/// A device, as its bytes tell of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DeviceTold {
    /// `carm` or `robot`.
    pub device: DeviceKind,
    /// Arrival of its first packet, host time.
    pub first_us: Option<i64>,
    /// Of its last one.
    pub last_us: Option<i64>,
    /// Packets that were read.
    pub packets: u64,
    /// Between the two; `None` for fewer than two.
    pub per_s: Option<f64>,
    /// What became of its bytes; of each log, where several were joined.
    pub counters: Vec<Health>,
}

/// What is in a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inventory {
    /// Of the file.
    pub bytes: u64,
    /// Which program recorded it, on what, with what.
    pub provenance: Option<Provenance>,
    /// Whether it holds a session; else it may be told and checked, and not be replayed.
    pub has_session: bool,
    /// Host time of the first message.
    pub start_us: Option<i64>,
    /// Host time of the last one.
    pub end_us: Option<i64>,
    /// The inputs of the session, and of each log that was joined, came to their end; else it was cut short.
    pub ended: bool,
    /// The file has its summary; else its program was stopped.
    pub closed: bool,
    /// Messages in all.
    pub messages: u64,
    /// By name.
    pub topics: BTreeMap<String, TopicTold>,
    /// Those of which bytes are there.
    pub devices: Vec<DeviceTold>,
    /// That telemetry tells of.
    pub exposures: usize,
    /// In order of their number.
    pub frames: Vec<FrameTold>,
    /// Attached files, and their bytes.
    pub attachments: BTreeMap<String, u64>,
    /// Logs that were joined on.
    pub joined: u32,
    /// What was cut, where it was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cut: Option<Value>,
    /// What was taken out, where it was redacted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub redacted: Option<Value>,
    /// What the session had lost on its lines.
    pub line_losses: Vec<String>,
    /// What could not be read.
    pub damage: Vec<LogLoss>,
    /// Messages that could not be understood, a sentence for each topic.
    pub malformed: Vec<String>,
}

impl Inventory {
    /// Frames with a pose from beads, refused ones, those without beads to look for, and those that the session did not come to.
    #[must_use]
    pub fn poses(&self) -> [usize; 4] {
        let count = |is: &dyn Fn(&PoseTold) -> bool| {
            self.frames.iter().filter_map(|frame| frame.pose.as_ref()).filter(|pose| is(pose)).count()
        };
        let [accepted, untried] = [count(&|pose| pose.accepted), count(&|pose| !pose.accepted && !pose.tried)];
        let all = count(&|_| true);
        [accepted, all - accepted - untried, untried, self.frames.len() - all]
    }

    /// What is lost, a sentence each.
    #[must_use]
    pub fn losses(&self) -> Vec<String> {
        let damage = self.damage.iter().map(ToString::to_string);
        let cut_short = (self.has_session && !self.ended).then(|| "the log has no end: the session was cut short".to_owned());
        damage.chain(cut_short).chain(self.malformed.iter().cloned()).collect()
    }
}

/// Steps of a progress bar: so many bytes each.
const STEP_BYTES: u64 = 1 << 20;

/// A progress bar over the bytes of a log.
pub(super) struct Reading {
    bar: crate::reporter::Progress,
    told: u64,
}

impl Reading {
    pub(super) fn new(label: &str, reader: &LogReader, reporter: &Reporter) -> Self {
        Self { bar: reporter.progress(label, reader.length() / STEP_BYTES + 1), told: 0 }
    }

    /// Reading has come to where `reader` is.
    pub(super) fn at(&mut self, reader: &LogReader) {
        let steps = reader.place() / STEP_BYTES;
        self.bar.advance(steps.saturating_sub(self.told));
        self.told = self.told.max(steps);
    }
}

pub(super) fn per_s(count: u64, first_us: i64, last_us: i64) -> Option<f64> {
    let span_s = last_us.saturating_sub(first_us) as f64 * 1e-6;
    (count > 1 && span_s > 0.0).then(|| (count - 1) as f64 / span_s)
}

/// Reads through `path` once.
///
/// # Errors
/// When the file cannot be read or is no log.
pub fn take_inventory(path: &Path, reporter: &Reporter) -> Result<Inventory, LogbookError> {
    let mut reader = LogReader::open(path)?;
    let mut reading = Reading::new("reading", &reader, reporter);
    let (mut frames, mut lines, mut tolerance) = (Frames::default(), Lines::new(), Tolerance::default());
    let mut heard: BTreeMap<DeviceKind, (i64, i64, u64)> = BTreeMap::new();
    let mut found = Inventory {
        bytes: reader.length(),
        provenance: None,
        has_session: false,
        start_us: None,
        end_us: None,
        ended: false,
        closed: true,
        messages: 0,
        topics: BTreeMap::new(),
        devices: Vec::new(),
        exposures: 0,
        frames: Vec::new(),
        attachments: BTreeMap::new(),
        joined: 0,
        cut: None,
        redacted: None,
        line_losses: Vec::new(),
        damage: Vec::new(),
        malformed: Vec::new(),
    };
    let mut unended = 0;
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        found.messages += 1;
        found.start_us = Some(found.start_us.map_or(entry.host_us, |start_us| start_us.min(entry.host_us)));
        found.end_us = found.end_us.max(Some(entry.host_us));
        let told = found.topics.entry(entry.topic.to_string()).or_insert_with(|| TopicTold {
            schema: entry.schema.to_string(),
            first_us: entry.host_us,
            last_us: entry.host_us,
            ..TopicTold::default()
        });
        told.messages += 1;
        told.bytes += entry.data.len() as u64;
        told.first_us = told.first_us.min(entry.host_us);
        told.last_us = told.last_us.max(entry.host_us);
        match &*entry.topic {
            topic::PROVENANCE if found.provenance.is_none() => found.provenance = tolerance.take(entry.json()),
            SETUP_TOPIC => found.has_session = true,
            END_TOPIC => found.ended = true,
            CUT_TOPIC => found.cut = tolerance.take(entry.json()),
            REDACTED_TOPIC => found.redacted = tolerance.take(entry.json()),
            RESTART_TOPIC => {
                found.joined += 1;
                unended += usize::from(!std::mem::take(&mut found.ended));
                frames.piece = found.joined;
            }
            _ => {}
        }
        tolerance.take(frames.take(&entry));
        tolerance.take(lines.take(&entry, &mut |event| {
            if matches!(event.event, Event::Sample(..)) {
                let (_, last_us, count) = heard.entry(event.device).or_insert((entry.host_us, entry.host_us, 0));
                (*last_us, *count) = (entry.host_us, *count + 1);
            }
        }));
    }
    found.ended &= unended == 0;
    for told in found.topics.values_mut() {
        told.per_s = per_s(told.messages, told.first_us, told.last_us);
    }
    found.devices = devices(&lines, &heard);
    lines.finish();
    found.exposures = lines.exposures().iter().map(Vec::len).sum();
    found.line_losses = lines.losses();
    found.frames = frames.by_number.into_values().collect();
    found.attachments = reader.attachments().iter().map(|file| (file.name.clone(), file.data.len() as u64)).collect();
    found.damage = reader.losses().to_vec();
    found.closed = reader.is_closed();
    found.malformed = tolerance.losses();
    Ok(found)
}

fn devices(lines: &Lines, heard: &BTreeMap<DeviceKind, (i64, i64, u64)>) -> Vec<DeviceTold> {
    let told = |device: DeviceKind| {
        let counters = lines.health(device);
        let known = heard.get(&device).copied();
        let (first_us, last_us, packets) = known.map_or((None, None, 0), |(first, last, count)| (Some(first), Some(last), count));
        let per_s = known.and_then(|(first_us, last_us, count)| per_s(count, first_us, last_us));
        let has_bytes = counters.iter().any(|health| health.bytes > 0);
        has_bytes.then_some(DeviceTold { device, first_us, last_us, packets, per_s, counters })
    };
    DeviceKind::ALL.into_iter().filter_map(told).collect()
}
