//! The one way from bytes to samples: live ports, replayed logs and test scripts all go through a [`Link`].

use super::decoder::{Decoder, Event};
use super::device::DeviceKind;
use super::health::Health;
use super::port::PortEvent;

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

/// Anything that yields what happens on one device's line: a port, a recording, a script.
pub trait ByteSource {
    /// What happened next; `None` at the end, or when nothing is there yet.
    fn next_event(&mut self) -> Option<PortEvent>;
}

/// Recordings and scripts: `(host_us, epoch, bytes)` in order.
impl<I: Iterator<Item = (i64, u32, Vec<u8>)>> ByteSource for I {
    fn next_event(&mut self) -> Option<PortEvent> {
        self.next().map(|(host_us, epoch, bytes)| PortEvent::Bytes { host_us, epoch, bytes })
    }
}

/// A device's decoder with what it needs to know of time: openings and silences.
#[derive(Clone, Debug)]
pub struct Link {
    device: DeviceKind,
    decoder: Decoder,
    epoch: Option<u32>,
    last_us: Option<i64>,
}

impl Link {
    /// For one device.
    #[must_use]
    pub fn new(device: DeviceKind) -> Self {
        Self { device, decoder: Decoder::new(device), epoch: None, last_us: None }
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
            PortEvent::Opened { .. } | PortEvent::Lost { .. } | PortEvent::Retry { .. } => {}
        }
    }

    /// Takes bytes that arrived at `host_us` in opening `epoch`. Bytes of another opening than the last begin afresh.
    pub fn feed(&mut self, host_us: i64, epoch: u32, bytes: &[u8], sink: &mut dyn FnMut(Received)) {
        if self.epoch != Some(epoch) {
            self.epoch = Some(epoch);
            self.decoder.begin_epoch();
        }
        if self.last_us.is_some_and(|last_us| host_us.saturating_sub(last_us) > STALE_SILENCE_US) {
            self.decoder.count_stale();
        }
        self.last_us = Some(host_us);
        self.decoder.push(bytes, &mut |event| sink(Received { host_us, epoch, event }));
    }

    /// Takes all that `source` has.
    pub fn drain(&mut self, source: &mut dyn ByteSource, sink: &mut dyn FnMut(Received)) {
        while let Some(event) = source.next_event() {
            self.handle(&event, sink);
        }
    }

    /// The counters.
    #[must_use]
    pub fn health(&self) -> &Health {
        self.decoder.health()
    }
}
