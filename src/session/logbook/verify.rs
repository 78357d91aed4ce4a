//! Whether a log is whole: every chunk with its checksum, every message as its topic promises, every frame with its hash, and whatever
//! names a frame with that frame.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::super::against_log::Samples;
use super::super::as_recorded::AsRecorded;
use super::super::edit::{EDIT_TOPIC, EditRecord, NOTE_TOPIC, NoteRecord};
use super::super::file::Setup;
use super::super::log::{DISAGREES_TOPIC, DRR_HASH_TOPIC, END_TOPIC, ORDER_TOPIC, PoseRecord, SETUP_TOPIC};
use super::super::recorded::sha256_of;
use super::super::records::{CUT_TOPIC, CutRecord, RESTART_TOPIC};
use super::LogbookError;
use super::frames::{Frames, Pixels};
use super::inventory::Reading;
use super::lines::Lines;
use crate::record::{FrameAssembler, LogEntry, LogReader, RecordError, topic, wrong_sums};
use crate::render::Plan;
use crate::reporter::Reporter;
use crate::telemetry::Event;

/// Faults that are kept one by one; further ones are counted.
const MOST_FAULTS: usize = 1000;
/// The same of places where a line lost something.
const MOST_PLACES: usize = 1000;
/// A larger jump of a count is damage of the count.
const MOST_MISSING: u32 = 100_000;

/// A fault and where it is.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fault {
    /// Of the file: where the chunk begins, or the record.
    pub at_byte: u64,
    /// Of the message, where it is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// Of the message, host time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_us: Option<i64>,
    /// What is wrong.
    pub what: String,
}

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Verdict {
    /// Of the file.
    pub bytes: u64,
    /// Host time of the first message.
    pub start_us: i64,
    /// That were read.
    pub messages: u64,
    /// Frames with their pixels, as they were recorded.
    pub frames: u64,
    /// Frames whose pixels were left out on purpose.
    pub frames_without_pixels: u64,
    /// Poses.
    pub poses: u64,
    /// DRRs whose pixels have the hash that the log says.
    pub drrs: u64,
    /// Packets of the devices.
    pub packets: u64,
    /// What is wrong; empty for a whole log.
    pub faults: Vec<Fault>,
    /// Faults beyond those.
    pub more_faults: u64,
    /// What the session had lost on its lines, a sentence each; the log holds it as it was, so it is no fault of it.
    pub line_losses: Vec<String>,
    /// Where on the lines, by message.
    pub line_places: Vec<Fault>,
}

impl Verdict {
    /// Whether nothing is wrong.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        self.faults.is_empty()
    }
}

#[derive(Deserialize)]
struct OfFrame {
    number: u32,
    #[serde(default)]
    sha256: Option<String>,
}

#[derive(Deserialize)]
struct PlanLine {
    #[serde(rename = "plan")]
    _plan: Plan,
}

/// Messages of one topic by their count: what comes later than its number says is awaited so long.
#[derive(Default)]
struct Count {
    next: u32,
    missing: BTreeMap<u32, (u64, i64)>,
}

struct Check {
    verdict: Verdict,
    frames: Frames,
    /// Where the tags of each frame are.
    places: BTreeMap<u32, u64>,
    assembler: FrameAssembler,
    lines: Lines,
    samples: Samples,
    counts: BTreeMap<String, Count>,
    order: AsRecorded,
    /// What names a frame: topic, place and time of the first that does.
    named: BTreeMap<u32, (String, u64, i64)>,
    /// Hash that scores name, and where.
    hashes: Vec<(u32, String, u64, i64)>,
    drr: Option<String>,
    scene: Option<String>,
    has_session: bool,
    has_end: bool,
}

/// Reads all of `path`.
///
/// # Errors
/// When the file cannot be read or is no log.
pub fn verify(path: &Path, reporter: &Reporter) -> Result<Verdict, LogbookError> {
    let mut reader = LogReader::open(path)?;
    let mut reading = Reading::new("verifying", &reader, reporter);
    let mut check = Check {
        verdict: Verdict { bytes: reader.length(), ..Verdict::default() },
        frames: Frames::default(),
        places: BTreeMap::new(),
        assembler: FrameAssembler::default(),
        lines: Lines::new(),
        samples: Samples::default(),
        counts: BTreeMap::new(),
        order: AsRecorded::default(),
        named: BTreeMap::new(),
        hashes: Vec::new(),
        drr: None,
        scene: None,
        has_session: false,
        has_end: false,
    };
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        if check.verdict.messages == 0 {
            check.verdict.start_us = entry.host_us;
        }
        check.verdict.messages += 1;
        check.order.see(&entry);
        check.count(&entry, reader.place());
        if let Err(error) = check.take(&entry, reader.place()) {
            check.fault(&entry, reader.place(), told(error));
        }
    }
    check.finish(&reader, &wrong_sums(path)?);
    Ok(check.verdict)
}

/// The topic stands beside it.
fn told(error: RecordError) -> String {
    match error {
        RecordError::Message { sequence, detail, .. } => format!("message {sequence}: {detail}"),
        other => other.to_string(),
    }
}

impl Check {
    fn add(&mut self, fault: Fault) {
        if self.verdict.faults.len() < MOST_FAULTS {
            self.verdict.faults.push(fault);
        } else {
            self.verdict.more_faults += 1;
        }
    }

    fn fault(&mut self, entry: &LogEntry, at_byte: u64, what: String) {
        self.add(Fault { at_byte, topic: Some(entry.topic.to_string()), time_us: Some(entry.host_us), what });
    }

    /// Each topic counts its messages from 1. Pixels are counted when they are compressed, so two may have changed places.
    fn count(&mut self, entry: &LogEntry, at_byte: u64) {
        let (sequence, time_us) = (entry.sequence, entry.host_us);
        let count = self.counts.entry(entry.topic.to_string()).or_default();
        // Other programs count otherwise, or not at all.
        if sequence == 0 {
            return;
        }
        let next = count.next.max(1);
        if sequence >= next {
            if sequence - next <= MOST_MISSING {
                count.missing.extend((next..sequence).map(|missing| (missing, (at_byte, time_us))));
            }
            count.next = sequence.saturating_add(1);
        } else if count.missing.remove(&sequence).is_none() {
            self.fault(entry, at_byte, format!("message {sequence} is there twice"));
        } else if matches!(&*entry.topic, topic::CARM_RAW | topic::ROBOT_RAW) {
            // What a line brought is one stream: in another order its packets are others.
            self.fault(entry, at_byte, format!("message {sequence} stands behind message {}", next - 1));
        }
    }

    fn take(&mut self, entry: &LogEntry, at_byte: u64) -> Result<(), RecordError> {
        entry.check()?;
        let number = self.frames.take(entry)?;
        if self.assembler.push(entry)?.is_some() {
            self.verdict.frames += 1;
        }
        self.samples.says(entry);
        self.hear(entry, at_byte)?;
        match &*entry.topic {
            topic::FRAME_TAGS => self.places.extend(number.map(|number| (number, at_byte))),
            SETUP_TOPIC => {
                let setup: Setup = entry.json()?;
                self.has_session = true;
                self.scene.get_or_insert(setup.scene_json);
            }
            END_TOPIC => self.has_end = true,
            CUT_TOPIC => {
                let cut: CutRecord = entry.json()?;
                self.samples.cut(cut.from_us, cut.to_us);
            }
            RESTART_TOPIC => {
                self.end(Some(entry.host_us), at_byte);
                self.samples.begin_anew();
                self.frames.piece += 1;
            }
            topic::POSE => {
                entry.json::<PoseRecord>()?;
                self.verdict.poses += 1;
                number.into_iter().for_each(|number| self.names(number, entry, at_byte));
            }
            topic::PLAN => {
                entry.json::<PlanLine>()?;
                self.names(entry.json::<OfFrame>()?.number, entry, at_byte);
            }
            topic::SCORES => {
                let OfFrame { number, sha256 } = entry.json()?;
                self.names(number, entry, at_byte);
                self.hashes.extend(sha256.map(|sha256| (number, sha256, at_byte, entry.host_us)));
            }
            EDIT_TOPIC => self.names(entry.json::<EditRecord>()?.number, entry, at_byte),
            NOTE_TOPIC => self.names(entry.json::<NoteRecord>()?.number, entry, at_byte),
            ORDER_TOPIC | DISAGREES_TOPIC => self.names(entry.json::<OfFrame>()?.number, entry, at_byte),
            topic::DRR => self.drr = entry.image()?.map(|image| sha256_of(&image)),
            DRR_HASH_TOPIC => self.drr_hash(entry, at_byte)?,
            _ => {}
        }
        Ok(())
    }

    /// Serial bytes, as the decoder judges them.
    fn hear(&mut self, entry: &LogEntry, at_byte: u64) -> Result<(), RecordError> {
        let Self { lines, samples, verdict, .. } = self;
        lines.take(entry, &mut |heard| match heard.event {
            Event::Sample(sample, _) => {
                verdict.packets += 1;
                samples.decoded(heard.device, entry.host_us, sample);
            }
            Event::Fault(fault) if verdict.line_places.len() < MOST_PLACES => verdict.line_places.push(Fault {
                at_byte,
                topic: Some(entry.topic.to_string()),
                time_us: Some(entry.host_us),
                what: fault.to_string(),
            }),
            Event::Fault(_) => {}
        })
    }

    fn names(&mut self, number: u32, entry: &LogEntry, at_byte: u64) {
        self.named.entry(number).or_insert_with(|| (entry.topic.to_string(), at_byte, entry.host_us));
    }

    /// The hash comes behind the DRR that it is of.
    fn drr_hash(&mut self, entry: &LogEntry, at_byte: u64) -> Result<(), RecordError> {
        let OfFrame { number, sha256 } = entry.json()?;
        self.names(number, entry, at_byte);
        match (self.drr.take(), sha256) {
            (Some(found), Some(stated)) if found != stated => {
                self.fault(entry, at_byte, format!("the DRR of frame {number} is not the one that its hash names"));
            }
            (Some(_), Some(_)) => self.verdict.drrs += 1,
            (None, _) => self.fault(entry, at_byte, format!("the DRR of frame {number} is gone; its hash is there")),
            (_, None) => self.fault(entry, at_byte, format!("no hash of the DRR of frame {number}")),
        }
        Ok(())
    }

    /// The end of a session, or of one of the logs that were joined.
    fn end(&mut self, time_us: Option<i64>, at_byte: u64) {
        if self.has_session && !std::mem::take(&mut self.has_end) {
            let what = "the session's inputs have no end here: it was cut short".to_owned();
            self.add(Fault { at_byte, topic: Some(END_TOPIC.to_owned()), time_us, what });
        }
    }

    fn finish(&mut self, reader: &LogReader, sums: &[crate::record::LogLoss]) {
        let of_file: Vec<Fault> = reader
            .losses()
            .iter()
            .chain(sums)
            .map(|loss| Fault { at_byte: loss.at_byte, topic: None, time_us: None, what: loss.reason.clone() })
            .collect();
        of_file.into_iter().for_each(|fault| self.add(fault));
        self.end(None, reader.length());
        if let Some(words) = self.order.words() {
            self.add(Fault { at_byte: 0, topic: None, time_us: None, what: words.to_owned() });
        }
        self.missing_messages();
        self.missing_frames();
        if self.samples.different() > 0 {
            let what = format!("{} samples of the devices are not what the log's bytes say", self.samples.different());
            self.add(Fault { at_byte: 0, topic: Some(topic::CARM_JOINTS.to_owned()), time_us: None, what });
        }
        let scene = reader.attachments().iter().find(|file| file.name == "scene.json");
        if scene.is_some_and(|scene| self.scene.as_ref().is_some_and(|text| text.as_bytes() != scene.data)) {
            let what = "the attached scene.json is not the scene of the session".to_owned();
            self.add(Fault { at_byte: 0, topic: None, time_us: None, what });
        }
        self.verdict.line_losses = self.lines.losses();
        self.verdict.faults.sort_by_key(|fault| fault.at_byte);
    }

    fn missing_messages(&mut self) {
        for (topic, count) in std::mem::take(&mut self.counts) {
            let mut numbers = count.missing.into_iter().peekable();
            while let Some((first, (at_byte, time_us))) = numbers.next() {
                let mut last = first;
                while let Some((next, _)) = numbers.next_if(|(next, _)| *next == last + 1) {
                    last = next;
                }
                let what = match last - first {
                    0 => format!("message {first} is missing before this"),
                    more => format!("messages {first} to {last} ({}) are missing before this", more + 1),
                };
                self.add(Fault { at_byte, topic: Some(topic.clone()), time_us: Some(time_us), what });
            }
        }
    }

    fn missing_frames(&mut self) {
        let by_number = std::mem::take(&mut self.frames.by_number);
        for (number, frame) in &by_number {
            match frame.pixels {
                Pixels::There => {}
                Pixels::LeftOut => self.verdict.frames_without_pixels += 1,
                Pixels::Missing => {
                    let what = format!("the pixels of frame {number} are gone; its tags are there");
                    let (topic, time_us) = (Some(topic::FRAME_PIXELS.to_owned()), Some(frame.arrival_us));
                    let at_byte = self.places.get(number).copied().unwrap_or(0);
                    self.add(Fault { at_byte, topic, time_us, what });
                }
            }
        }
        for (number, (topic, at_byte, time_us)) in std::mem::take(&mut self.named) {
            if !by_number.contains_key(&number) {
                let what = format!("names frame {number}, which is not in the log");
                self.add(Fault { at_byte, topic: Some(topic), time_us: Some(time_us), what });
            }
        }
        for (number, sha256, at_byte, time_us) in std::mem::take(&mut self.hashes) {
            if by_number.get(&number).is_some_and(|frame| frame.sha256 != sha256) {
                let what = format!("the pair of frame {number} is of another file than that frame");
                self.add(Fault { at_byte, topic: Some(topic::SCORES.to_owned()), time_us: Some(time_us), what });
            }
        }
    }
}
