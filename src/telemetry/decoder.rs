//! Packets: bytes in, events out: framing, checksum, sequence. Does no input or output and knows no time.

use super::counting;
use super::device::DeviceKind;
use super::event::{DecodeFault, Event};
use super::health::Health;
use super::sample::Sample;
use super::sequence::{SequenceTracker, Sequenced};
use super::wire::{self, FrameFault, Stamp, Unread};

/// Decodes one device's line. Memory is bounded by the longest frame.
#[derive(Clone, Debug)]
pub struct Decoder {
    device: DeviceKind,
    buffer: Vec<u8>,
    /// More came than fits; bytes are dropped until the next delimiter.
    overflowing: bool,
    /// No delimiter yet since the port was opened: the frame may be cut.
    may_be_cut: bool,
    sequence: SequenceTracker,
    /// The device began anew with a packet that could not be read.
    began_anew: bool,
    /// Another schema that the device's metadata announced.
    foreign_schema: Option<u32>,
    health: Health,
}

impl Decoder {
    /// For the line of one device.
    #[must_use]
    pub fn new(device: DeviceKind) -> Self {
        Self {
            device,
            buffer: Vec::with_capacity(wire::MAX_ENCODED_BYTES),
            overflowing: false,
            may_be_cut: true,
            sequence: SequenceTracker::default(),
            began_anew: false,
            foreign_schema: None,
            health: Health::default(),
        }
    }

    /// Takes bytes as they came, in chunks of any size; calls `sink` for each event, faults before the sample they belong to.
    pub fn push(&mut self, bytes: &[u8], sink: &mut dyn FnMut(Event)) {
        self.health.bytes += bytes.len() as u64;
        for byte in bytes {
            if *byte == 0 {
                self.end_frame(sink);
            } else if self.buffer.len() < wire::MAX_ENCODED_BYTES {
                self.buffer.push(*byte);
            } else if !self.overflowing {
                self.overflowing = true;
                self.health.overlong += 1;
                sink(Event::Fault(DecodeFault::Overlong { limit: wire::MAX_ENCODED_BYTES }));
            }
        }
    }

    /// The port was opened (again): what was left of a frame will never be completed.
    pub fn begin_epoch(&mut self) {
        self.health.epochs += 1;
        self.buffer.clear();
        self.overflowing = false;
        self.may_be_cut = true;
        self.sequence.reopen();
    }

    /// Counts a silence; the decoder itself knows no time.
    pub fn count_stale(&mut self) {
        self.health.stale += 1;
    }

    /// The counters.
    #[must_use]
    pub fn health(&self) -> &Health {
        &self.health
    }

    fn end_frame(&mut self, sink: &mut dyn FnMut(Event)) {
        let may_be_cut = std::mem::take(&mut self.may_be_cut);
        let overflowed = std::mem::take(&mut self.overflowing);
        if overflowed || self.buffer.is_empty() {
            self.buffer.clear();
            return;
        }
        let outcome = wire::read_frame(&mut self.buffer, self.foreign_schema);
        self.buffer.clear();
        match outcome {
            Ok(sample) => self.deliver(sample, sink),
            Err(Unread { fault: FrameFault::Corrupt { .. } | FrameFault::Stuffing { .. }, .. }) if may_be_cut => {
                self.health.partial_at_open += 1;
            }
            Err(Unread { fault, stamp }) => {
                // It makes no sense, but it was not lost on the way.
                let own = stamp
                    .filter(|_| !matches!(&fault, FrameFault::Malformed { id, .. } if wire::is_of_another(*id, self.device)));
                match own.map(|stamp| self.count(stamp, sink)) {
                    Some(None) => return,
                    Some(Some(Sequenced::Reset)) => self.began_anew = true,
                    Some(Some(_)) | None => {}
                }
                if let FrameFault::SchemaMismatch { found, .. } = fault {
                    self.foreign_schema = Some(found);
                }
                *match fault {
                    FrameFault::Corrupt { .. } | FrameFault::Stuffing { .. } => &mut self.health.corrupt,
                    FrameFault::SchemaMismatch { .. } => &mut self.health.schema_mismatch,
                    FrameFault::VersionMismatch { .. } => &mut self.health.version_mismatch,
                    FrameFault::UnknownMessage { .. } => &mut self.health.unknown_message,
                    FrameFault::Malformed { .. } => &mut self.health.malformed,
                } += 1;
                sink(Event::Fault(DecodeFault::Frame(fault)));
            }
        }
    }

    fn deliver(&mut self, sample: Sample, sink: &mut dyn FnMut(Event)) {
        if let Some(found) = sample.device()
            && found != self.device
        {
            self.health.wrong_device += 1;
            sink(Event::Fault(DecodeFault::WrongDevice { expected: self.device, found }));
            return;
        }
        let stamp = Stamp { sequence: sample.sequence(), device_us: sample.device_us() };
        if let Some(sequenced) = self.count(stamp, sink) {
            // The packet that began the new count could not be read: this is the first of it.
            let sequenced = if std::mem::take(&mut self.began_anew) { Sequenced::Reset } else { sequenced };
            self.health.frames += 1;
            sink(Event::Sample(sample, sequenced));
        }
    }

    /// What the number of an intact packet says; `None` for one that was here before.
    fn count(&mut self, stamp: Stamp, sink: &mut dyn FnMut(Event)) -> Option<Sequenced> {
        counting::count(&mut self.sequence, &mut self.health, stamp.sequence, stamp.device_us, sink)
    }
}
