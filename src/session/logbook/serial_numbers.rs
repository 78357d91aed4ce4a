//! Serial numbers and other words of devices, taken out of the bytes that came from them without moving one byte: packets keep their length,
//! their place and a right checksum, lines of text all that a sample rests on, so everything decodes as before.

use std::collections::HashMap;
use std::path::Path;

use super::super::file::Setup;
use super::super::log::SETUP_TOPIC;
use super::super::records::RESTART_TOPIC;
use super::LogbookError;
use super::inventory::Reading;
use crate::record::{LogEntry, LogReader, topic};
use crate::reporter::Reporter;
use crate::telemetry::lines::{LineBlanker, MAX_LINE_BYTES};
use crate::telemetry::{Decoder, DeviceKind, Event, MAX_ENCODED_BYTES, Sample, Telling, blanked};

/// The epoch in front of the bytes of a message.
const EPOCH_BYTES: usize = 4;
/// What stands in place of letters whose packet is not intact.
const FILLER: u8 = b'x';
/// So many letters and digits in a row may be a word.
const WORD_BYTES: usize = 4;

/// A byte and where it is: which message of its device, and where in that.
type Placed = (u8, u64, usize);

/// Changes of the raw bytes of one device.
struct Line {
    device: DeviceKind,
    /// Of a device that does not speak packets.
    blanker: Option<LineBlanker>,
    epoch: Option<[u8; EPOCH_BYTES]>,
    messages: u64,
    /// Of a packet or a line of text whose end has not come.
    open: Vec<Placed>,
    changes: HashMap<u64, Vec<(usize, u8)>>,
    written: u64,
}

/// What is to be changed in a log.
pub(super) struct SerialNumbers {
    lines: [Line; 2],
    /// What metadata messages say now, by device, sequence number and device time.
    said: HashMap<(DeviceKind, u32, u64), Sample>,
    /// Packets and lines that were changed.
    pub(super) packets: usize,
}

fn device_of(entry: &LogEntry) -> Option<DeviceKind> {
    match &*entry.topic {
        topic::CARM_RAW => Some(DeviceKind::Carm),
        topic::ROBOT_RAW => Some(DeviceKind::Robot),
        _ => None,
    }
}

impl SerialNumbers {
    /// Finds them.
    ///
    /// # Errors
    /// When the log cannot be read.
    pub(super) fn find(log: &Path, reporter: &Reporter) -> Result<Self, LogbookError> {
        let line = |device| Line {
            device,
            blanker: None,
            epoch: None,
            messages: 0,
            open: Vec::new(),
            changes: HashMap::new(),
            written: 0,
        };
        let mut found = Self { lines: DeviceKind::ALL.map(line), said: HashMap::new(), packets: 0 };
        let mut reader = LogReader::open(log)?;
        let mut reading = Reading::new("looking for serial numbers", &reader, reporter);
        while let Some(entry) = reader.next() {
            reading.at(&reader);
            if &*entry.topic == RESTART_TOPIC {
                found.lines.iter_mut().for_each(Line::interrupt);
            } else if &*entry.topic == SETUP_TOPIC {
                // What is no setup says nothing of how bytes are read.
                let Ok(setup) = entry.json::<Setup>() else { continue };
                for line in &mut found.lines {
                    line.blanker = setup.adapters.of(line.device).map(LineBlanker::new);
                }
            } else if let Some(device) = device_of(&entry) {
                found.take(device, &entry.data);
            }
        }
        found.lines.iter_mut().for_each(Line::interrupt);
        Ok(found)
    }

    fn take(&mut self, device: DeviceKind, data: &[u8]) {
        let Self { lines, said, packets } = self;
        let line = &mut lines[device as usize];
        let Some((epoch, bytes)) = data.split_first_chunk::<EPOCH_BYTES>() else {
            line.messages += 1;
            return;
        };
        if line.epoch != Some(*epoch) {
            line.interrupt();
            line.epoch = Some(*epoch);
        }
        let longest = if line.blanker.is_some() { MAX_LINE_BYTES } else { 2 * MAX_ENCODED_BYTES };
        for (place, byte) in (EPOCH_BYTES..).zip(bytes) {
            let ends = if line.blanker.is_some() { matches!(byte, b'\n' | b'\r') } else { *byte == 0 };
            if ends {
                *packets += usize::from(if line.blanker.is_some() { line.end_line() } else { line.end_packet(said) });
                continue;
            }
            line.open.push((*byte, line.messages, place));
            if line.open.len() > longest {
                line.interrupt();
            }
        }
        line.messages += 1;
    }

    /// The bytes of the next message of its device, changed; whatever is no such message stays as it is.
    pub(super) fn take_out(&mut self, entry: &mut LogEntry) {
        let Some(device) = device_of(entry) else { return };
        let line = &mut self.lines[device as usize];
        for (place, byte) in line.changes.remove(&line.written).into_iter().flatten() {
            entry.data[place] = byte;
        }
        line.written += 1;
    }

    /// What a device says of itself now, of what it said.
    pub(super) fn said(&self, before: &serde_json::Value) -> Option<&Sample> {
        let device = serde_json::from_value(before["device"].clone()).ok()?;
        let sequence = u32::try_from(before["sequence"].as_u64()?).ok()?;
        self.said.get(&(device, sequence, before["device_us"].as_u64()?))
    }
}

impl Line {
    fn change(&mut self, (_, message, place): Placed, byte: u8) {
        self.changes.entry(message).or_default().push((place, byte));
    }

    /// A delimiter came; whether the packet before it told a serial number.
    fn end_packet(&mut self, said: &mut HashMap<(DeviceKind, u32, u64), Sample>) -> bool {
        let stuffed: Vec<u8> = self.open.iter().map(|(byte, ..)| *byte).collect();
        if stuffed.is_empty() {
            return false;
        }
        match blanked(&stuffed) {
            Telling::Nothing => self.open.clear(),
            Telling::Unknown => self.interrupt(),
            Telling::Blanked(now) => {
                let mut decoder = Decoder::new(self.device);
                let mut packet = now.clone();
                packet.push(0);
                decoder.push(&packet, &mut |event| {
                    if let Event::Sample(sample @ Sample::Metadata(_), _) = event {
                        said.insert((self.device, sample.sequence(), sample.device_us()), sample);
                    }
                });
                for (placed, byte) in std::mem::take(&mut self.open).into_iter().zip(now) {
                    if placed.0 != byte {
                        self.change(placed, byte);
                    }
                }
                return true;
            }
        }
        false
    }

    /// The end of a line of text came; whether there was something in it that no sample rests on.
    fn end_line(&mut self) -> bool {
        let Some(blanker) = &mut self.blanker else { return false };
        let line: Vec<u8> = self.open.iter().map(|(byte, ..)| *byte).collect();
        let blanked = blanker.blanked(&line);
        let open = std::mem::take(&mut self.open);
        let mut changed = false;
        for (placed, now) in open.into_iter().zip(blanked) {
            if placed.0 != now {
                self.change(placed, now);
                changed = true;
            }
        }
        changed
    }

    /// What is open will not be completed, or is not intact: whatever may be a word in it is taken out.
    fn interrupt(&mut self) {
        let open = std::mem::take(&mut self.open);
        for run in open.chunk_by(|a, b| is_letter(a) == is_letter(b)) {
            if run.len() >= WORD_BYTES && is_letter(&run[0]) {
                run.iter().for_each(|placed| self.change(*placed, FILLER));
            }
        }
    }
}

fn is_letter((byte, ..): &Placed) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b' ' | b'.')
}
