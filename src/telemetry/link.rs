//! The one way from bytes to samples: live ports, replayed logs and test scripts all go through a [`Link`].

use super::address::{PortAddress, PortConfig};
use super::decoder::Decoder;
use super::device::DeviceKind;
use super::event::Event;
use super::health::Health;
use super::lines::{LineAdapter, LineDecoder};
use super::outlet::PortEvent;

/// A silence longer than this is counted as stale.
pub const STALE_SILENCE_US: i64 = 500_000;

/// A decoded event with its arrival.
#[derive(Clone, Debug, PartialEq)]
pub struct Received {
    /// Host time of the read that completed the frame.
    pub host_us: i64,
    /// Opening of the port.
    pub epoch: u32,
    /// Sample or fault.
    pub event: Event,
}

/// What a device's bytes are.
#[derive(Clone, Debug)]
enum Decoding {
    /// Of `mocks/PROTOCOL.md`.
    Packets(Decoder),
    /// Of a declaration.
    Lines(LineDecoder),
}

/// A device's decoder with what it needs to know of time: openings and silences.
#[derive(Clone, Debug)]
pub struct Link {
    device: DeviceKind,
    decoding: Decoding,
    epoch: Option<u32>,
    last_us: Option<i64>,
}

impl Link {
    /// For a device that sends packets.
    #[must_use]
    pub fn new(device: DeviceKind) -> Self {
        Self { device, decoding: Decoding::Packets(Decoder::new(device)), epoch: None, last_us: None }
    }

    /// For what comes through a port.
    #[must_use]
    pub fn of_port(config: &PortConfig) -> Self {
        match &config.adapter {
            Some(adapter) => Self::of_lines(adapter, PortAddress::begins_whole(&config.path)),
            None => Self::new(config.device),
        }
    }

    /// For a device that sends lines as declared. `begins_whole`: bytes of an opening begin with a whole line.
    #[must_use]
    pub fn of_lines(adapter: &LineAdapter, begins_whole: bool) -> Self {
        let decoder = LineDecoder::new(adapter.clone(), begins_whole);
        Self { device: adapter.device(), decoding: Decoding::Lines(decoder), epoch: None, last_us: None }
    }

    /// Which device.
    #[must_use]
    pub fn device(&self) -> DeviceKind {
        self.device
    }

    /// Takes what happened on the port; events that carry no bytes decode to nothing.
    pub fn handle(&mut self, event: &PortEvent, sink: &mut dyn FnMut(Received)) {
        match event {
            PortEvent::Bytes { host_us, epoch, bytes } => self.feed(*host_us, *epoch, bytes, sink),
            PortEvent::Opened { .. } | PortEvent::Lost { .. } | PortEvent::Retry { .. } | PortEvent::Said { .. } => {}
        }
    }

    /// Takes bytes that arrived at `host_us` in opening `epoch`. Bytes of another opening than the last begin afresh.
    pub fn feed(&mut self, host_us: i64, epoch: u32, bytes: &[u8], sink: &mut dyn FnMut(Received)) {
        let is_stale = self.last_us.is_some_and(|last_us| host_us.saturating_sub(last_us) > STALE_SILENCE_US);
        let is_anew = self.epoch != Some(epoch);
        (self.epoch, self.last_us) = (Some(epoch), Some(host_us));
        let mut sink = |event| sink(Received { host_us, epoch, event });
        match &mut self.decoding {
            Decoding::Packets(decoder) => {
                if is_anew {
                    decoder.begin_epoch();
                }
                if is_stale {
                    decoder.count_stale();
                }
                decoder.push(bytes, &mut sink);
            }
            Decoding::Lines(decoder) => {
                if is_anew {
                    decoder.begin_epoch();
                }
                if is_stale {
                    decoder.count_stale();
                }
                decoder.push(host_us, bytes, &mut sink);
            }
        }
    }

    /// The counters.
    #[must_use]
    pub fn health(&self) -> &Health {
        match &self.decoding {
            Decoding::Packets(decoder) => decoder.health(),
            Decoding::Lines(decoder) => decoder.health(),
        }
    }

    /// What one of the device's messages is called, and several.
    #[must_use]
    pub fn units(&self) -> [&'static str; 2] {
        match &self.decoding {
            Decoding::Packets(_) => ["packet", "packets"],
            Decoding::Lines(_) => ["line", "lines"],
        }
    }

    /// Of a device that sends lines: what was wrong with the latest one that is no sample.
    #[must_use]
    pub fn latest_fault(&self) -> Option<&str> {
        match &self.decoding {
            Decoding::Packets(_) => None,
            Decoding::Lines(decoder) => decoder.latest_fault(),
        }
    }
}
