//! Lines of text: bytes in, events out. Does no input or output; of time it knows when a line arrived.

use super::super::counting;
use super::super::event::{DecodeFault, Event};
use super::super::health::Health;
use super::super::line_fault::LineFault;
use super::super::sample::Sample;
use super::super::sequence::SequenceTracker;
use super::adapter::{LineAdapter, Read};
use super::cycle::Cycle;
use super::sample::Stamp;
use super::split::{Columns, text_of_line};

/// Longest line without its end.
pub const MAX_LINE_BYTES: usize = 64 << 10;

/// Decodes one device's lines. Memory is bounded by the longest line.
#[derive(Clone, Debug)]
pub struct LineDecoder {
    adapter: LineAdapter,
    buffer: Vec<u8>,
    /// More came than fits; bytes are dropped until the next end of a line.
    overflowing: bool,
    /// Bytes of an opening begin with a whole line.
    begins_whole: bool,
    /// No end of a line yet since the port was opened: the line may be cut, and half a number is a number.
    may_be_cut: bool,
    header: Option<Columns>,
    clock: Cycle,
    count: Cycle,
    sequence: SequenceTracker,
    /// Samples, where lines have no number.
    counted: u32,
    /// Arrival of the last line that had a time.
    last_host_us: Option<i64>,
    health: Health,
    latest_fault: Option<String>,
}

impl LineDecoder {
    /// For lines as declared. `begins_whole`: bytes of an opening begin with a whole line, as those of datagrams and files do.
    #[must_use]
    pub fn new(adapter: LineAdapter, begins_whole: bool) -> Self {
        let [clock, count] = adapter.periods().map(Cycle::new);
        Self {
            adapter,
            buffer: Vec::new(),
            overflowing: false,
            begins_whole,
            may_be_cut: !begins_whole,
            header: None,
            clock,
            count,
            sequence: SequenceTracker::default(),
            counted: 0,
            last_host_us: None,
            health: Health::default(),
            latest_fault: None,
        }
    }

    /// Takes bytes that arrived at `host_us`, in chunks of any size; calls `sink` for each event, faults before the sample they belong to.
    pub fn push(&mut self, host_us: i64, bytes: &[u8], sink: &mut dyn FnMut(Event)) {
        self.health.bytes += bytes.len() as u64;
        for byte in bytes {
            // Both end a line, for devices that send either or both: an empty line means nothing.
            if matches!(byte, b'\n' | b'\r') {
                self.end_line(host_us, sink);
            } else if self.buffer.len() < MAX_LINE_BYTES {
                self.buffer.push(*byte);
            } else if !self.overflowing {
                self.overflowing = true;
                self.health.overlong += 1;
                self.fault(DecodeFault::Overlong { limit: MAX_LINE_BYTES }, sink);
            }
        }
    }

    /// The port was opened (again): what was left of a line will never be completed.
    pub fn begin_epoch(&mut self) {
        self.health.epochs += 1;
        if !self.buffer.is_empty() && !self.overflowing {
            self.health.corrupt += 1;
            self.latest_fault = Some(LineFault::Cut { bytes: self.buffer.len() }.to_string());
        }
        self.buffer.clear();
        self.overflowing = false;
        self.may_be_cut = !self.begins_whole;
        self.sequence.reopen();
    }

    /// Counts a silence.
    pub fn count_stale(&mut self) {
        self.health.stale += 1;
    }

    /// The counters; lines stand as frames.
    #[must_use]
    pub fn health(&self) -> &Health {
        &self.health
    }

    /// What was wrong with the latest line that is no sample.
    #[must_use]
    pub fn latest_fault(&self) -> Option<&str> {
        self.latest_fault.as_deref()
    }

    fn fault(&mut self, fault: DecodeFault, sink: &mut dyn FnMut(Event)) {
        self.latest_fault = Some(fault.to_string());
        sink(Event::Fault(fault));
    }

    fn end_line(&mut self, host_us: i64, sink: &mut dyn FnMut(Event)) {
        let may_be_cut = std::mem::take(&mut self.may_be_cut);
        let overflowed = std::mem::take(&mut self.overflowing);
        let line = std::mem::take(&mut self.buffer);
        if !overflowed && !line.is_empty() {
            // A header that is cut has fewer columns than the lines after it, and none of them is taken.
            if may_be_cut && !self.adapter.is_header(&line) {
                self.health.partial_at_open += 1;
            } else {
                self.take_line(host_us, &line, sink);
            }
        }
        // Its memory serves the next line.
        self.buffer = line;
        self.buffer.clear();
    }

    fn take_line(&mut self, host_us: i64, line: &[u8], sink: &mut dyn FnMut(Event)) {
        match self.read(host_us, line) {
            Ok(None) => {}
            Ok(Some((sample, judged_us))) => {
                let counted = counting::count(&mut self.sequence, &mut self.health, sample.sequence(), judged_us, sink);
                if let Some(sequenced) = counted {
                    self.health.frames += 1;
                    sink(Event::Sample(sample, sequenced));
                }
            }
            Err(fault) => {
                self.health.corrupt += 1;
                self.fault(DecodeFault::Line(fault), sink);
            }
        }
    }

    /// The sample of a line, and the time by which its number is judged; none of a line that means nothing.
    fn read(&mut self, host_us: i64, line: &[u8]) -> Result<Option<(Sample, u64)>, LineFault> {
        let not_text = || LineFault::NotText { bytes: line.len() };
        let text = text_of_line(line).ok_or_else(not_text)?;
        if text.trim().is_empty() {
            return Ok(None);
        }
        let Self { adapter, header, clock, count, counted, last_host_us, .. } = self;
        let values = match adapter.read(text, header.as_ref())? {
            Read::Values(values) => values,
            Read::Header(columns) => {
                *header = Some(columns);
                return Ok(None);
            }
            Read::Nothing => return Ok(None),
        };
        let (time_us, number) = (values.time_us().transpose()?, values.sequence().transpose()?);
        // Read whole before anything is counted on: a line that is none leaves no trace in clock and count.
        let sample = values.sample(Stamp { sequence: 0, device_us: 0 })?;
        let since_us = last_host_us.map_or(0, |last_us| host_us.saturating_sub(last_us));
        *last_host_us = Some(host_us);
        let device_us = match time_us {
            Some(time_us) => clock.take(time_us, since_us),
            None => host_us.saturating_sub(adapter.host_time_delay_us()),
        };
        let sequence = match number {
            Some(number) => count.take(number, 1) as u32,
            None => {
                *counted = counted.wrapping_add(1);
                *counted
            }
        };
        let device_us = u64::try_from(device_us).unwrap_or(0);
        // Arrival says nothing of the order in which lines were sent.
        let judged_us = if time_us.is_some() { device_us } else { 0 };
        Ok(Some((stamped(sample, Stamp { sequence, device_us }), judged_us)))
    }
}

fn stamped(mut sample: Sample, stamp: Stamp) -> Sample {
    let (sequence, device_us) = match &mut sample {
        Sample::Carm(sample) => (&mut sample.sequence, &mut sample.device_us),
        Sample::Robot(sample) => (&mut sample.sequence, &mut sample.device_us),
        Sample::Metadata(metadata) => (&mut metadata.sequence, &mut metadata.device_us),
    };
    (*sequence, *device_us) = (stamp.sequence, stamp.device_us);
    sample
}
