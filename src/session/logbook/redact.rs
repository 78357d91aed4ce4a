//! A log that can be given away: what a replay needs, and no name, path, serial number or free text beyond that.
//!
//! Messages of topics that are not known here are left out, and of known ones whatever is not needed: told events, notes, sentences about pairs, the
//! origin of calibrations, what the frames' headers said besides physics and time. Names are replaced alike in all messages, so the poses of a
//! replay are those of the log, byte for byte. Times stay, and so does whatever is burned into the pixels.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::{Value, json};

use super::super::against_log::METADATA_TOPIC;
use super::super::edit::{EDIT_TOPIC, NOTE_TOPIC};
use super::super::file::Setup;
use super::super::log::{CLOCK_TOPIC, DISAGREES_TOPIC, DRR_HASH_TOPIC, END_TOPIC, ORDER_TOPIC, SCATTER_NETWORK, SETUP_TOPIC};
use super::super::pictures::{PictureDigest, Pictures};
use super::super::records::{CUT_TOPIC, REDACTED_TOPIC, RESTART_TOPIC, RedactedRecord, SEEN_TOPIC, SeenRecord};
use super::LogbookError;
use super::cut::drr_of;
use super::inventory::Reading;
use super::names::Names;
use super::serial_numbers::SerialNumbers;
use crate::acquire::Frame;
use crate::image::refuse_overwrite;
use crate::record::{Attachment, FrameAssembler, LogCopy, LogEntry, LogReader, Provenance, RecordError, Tolerance, topic};
use crate::reporter::Reporter;

/// How much is taken out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RedactOptions {
    /// Frames and DRRs without their pixels.
    pub no_pixels: bool,
}

/// What was taken out.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RedactReport {
    /// The new log.
    pub path: PathBuf,
    /// Messages in it.
    pub messages: u64,
    /// Names of files, beads, bodies, landmarks and labels that others stand for.
    pub names: usize,
    /// Events that were told.
    pub events: usize,
    /// What persons noted, in words of their own.
    pub notes: usize,
    /// Packets in which a device told its serial number, and lines in which there was more than a sample.
    pub serial_numbers: usize,
    /// Frames whose pixels were left out.
    pub pixels: usize,
    /// Messages of topics that are not known here.
    pub unknown_topics: BTreeMap<String, u64>,
    /// What of the log could not be read.
    pub losses: Vec<String>,
}

/// What a header said that no replay needs.
const NEEDLESS_TAGS: [&str; 9] = [
    "modality",
    "instance_number",
    "study",
    "photometric",
    "intensity_relationship",
    "intensity_sign",
    "presentation_intent",
    "burned_in_annotation",
    "window",
];

/// Sentences of a pair, and names of files.
const NEEDLESS_OF_PAIRS: [&str; 7] = ["reason", "note", "binding_evidence", "flags", "robot_cautions", "strip", "drr"];

/// Writes `log` to `out` without what identifies anybody.
///
/// # Errors
/// When the log cannot be read, or `out` exists or cannot be written.
pub fn redact(log: &Path, options: RedactOptions, out: &Path, reporter: &Reporter) -> Result<RedactReport, LogbookError> {
    refuse_overwrite(&[out], &[log])?;
    LogCopy::refuse_existing(out)?;
    let setup = setup_of(log)?;
    let serial_numbers = SerialNumbers::find(log, reporter)?;
    let names = setup.as_ref().map(Names::of).unwrap_or_default();
    let mut writing = Redacting {
        report: RedactReport { names: names.count(), serial_numbers: serial_numbers.packets, ..RedactReport::default() },
        options,
        names,
        serial_numbers,
        labels: BTreeMap::new(),
        pictures: Pictures::default(),
        assembler: FrameAssembler::default(),
        tags: None,
        copy: LogCopy::create(out)?,
        tolerance: Tolerance::default(),
    };
    let mut reader = LogReader::open(log)?;
    let mut reading = Reading::new("redacting", &reader, reporter);
    let (mut start_us, mut end_us) = (None, 0);
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        if start_us.is_none() {
            start_us = Some(entry.host_us);
            writing.attach(setup.as_ref(), entry.host_us)?;
        }
        end_us = entry.host_us.max(end_us);
        writing.take(&reader, entry)?;
    }
    let Redacting { mut report, mut copy, tolerance, .. } = writing;
    let RedactReport { names, events, serial_numbers, pixels, .. } = report;
    copy.json(REDACTED_TOPIC, end_us, &RedactedRecord { names, events, serial_numbers, pixels })?;
    let summary = copy.finish()?;
    (report.path, report.messages) = (summary.path, summary.messages);
    let damage = reader.losses().iter().map(ToString::to_string);
    report.losses = damage.chain(tolerance.losses()).collect();
    Ok(report)
}

fn setup_of(log: &Path) -> Result<Option<Setup>, RecordError> {
    let mut reader = LogReader::open(log)?;
    let found = reader.by_ref().find(|entry| &*entry.topic == SETUP_TOPIC);
    Ok(found.and_then(|entry| entry.json().ok()))
}

struct Redacting {
    report: RedactReport,
    options: RedactOptions,
    names: Names,
    serial_numbers: SerialNumbers,
    /// What each frame is called now.
    labels: BTreeMap<u32, String>,
    /// As the engine has them, where pixels are left out.
    pictures: Pictures,
    assembler: FrameAssembler,
    /// Tags whose pixels come next.
    tags: Option<LogEntry>,
    copy: LogCopy,
    tolerance: Tolerance,
}

impl Redacting {
    fn attach(&mut self, setup: Option<&Setup>, start_us: i64) -> Result<(), RecordError> {
        let Some(kept) = setup.map(|setup| self.names.setup(setup)) else { return Ok(()) };
        let beads = kept.beads.map(|(_, text)| ("beads.mrk.json", text));
        for (name, text) in [("scene.json", kept.scene_json)].into_iter().chain(beads) {
            let attachment =
                Attachment { name: name.to_owned(), media_type: "application/json".to_owned(), data: text.into_bytes() };
            self.copy.attach(&attachment, start_us)?;
        }
        Ok(())
    }

    fn take(&mut self, reader: &LogReader, mut entry: LogEntry) -> Result<(), RecordError> {
        let no_pixels = self.options.no_pixels;
        match &*entry.topic {
            topic::CARM_RAW | topic::ROBOT_RAW => self.serial_numbers.take_out(&mut entry),
            topic::FRAME_TAGS => {
                self.tags = Some(entry.clone());
                self.tolerance.take(self.assembler.push(&entry));
                return Ok(());
            }
            topic::FRAME_PIXELS => return self.frame(reader, &entry),
            topic::EVENTS => {
                let text = self.tolerance.take(entry.event()).flatten().unwrap_or_default();
                if drr_of(&text).is_none() {
                    self.report.events += 1;
                    return Ok(());
                }
                if no_pixels {
                    return Ok(());
                }
            }
            topic::DRR | topic::SHOWN | DRR_HASH_TOPIC if no_pixels => return Ok(()),
            topic::ANNOTATIONS => match self.tolerance.take(entry.reworded(&|text| self.names.word(text))) {
                Some(reworded) => entry = reworded,
                None => return Ok(()),
            },
            topic::CARM_JOINTS
            | topic::ROBOT_JOINTS
            | topic::DRR
            | topic::SHOWN
            | topic::CALIBRATION
            | topic::TRANSFORMS
            | topic::CARM_TRANSFORMS
            | topic::ROBOT_TRANSFORMS
            | topic::CARM_JOINT_STATES
            | topic::ROBOT_JOINT_STATES
            | DRR_HASH_TOPIC
            | CLOCK_TOPIC
            | ORDER_TOPIC
            | DISAGREES_TOPIC
            | END_TOPIC
            | CUT_TOPIC => {}
            RESTART_TOPIC => self.pictures = Pictures::default(),
            REDACTED_TOPIC => return Ok(()),
            NOTE_TOPIC => {
                self.report.notes += 1;
                return Ok(());
            }
            topic::PROVENANCE
            | SETUP_TOPIC
            | METADATA_TOPIC
            | SEEN_TOPIC
            | EDIT_TOPIC
            | topic::POSE
            | topic::PLAN
            | topic::SCORES => {
                let redacted = self.json(&entry);
                let Some(value) = self.tolerance.take(redacted) else { return Ok(()) };
                return self.copy.json(&entry.topic, entry.host_us, &value);
            }
            other => {
                *self.report.unknown_topics.entry(other.to_owned()).or_default() += 1;
                return Ok(());
            }
        }
        self.copy.message(reader, &entry)
    }

    /// A message of a topic whose content is not kept as it is.
    fn json(&mut self, entry: &LogEntry) -> Result<Value, RecordError> {
        let mut value: Value = entry.json()?;
        match &*entry.topic {
            topic::PROVENANCE => {
                let Provenance { program, version, started_us, details, .. } = entry.json()?;
                let mut inputs = details["inputs"].clone();
                self.names.reword(&mut inputs);
                if let Some(scene) = inputs.get_mut(0).and_then(|scene| scene.get_mut("path")) {
                    *scene = json!("scene.json");
                }
                let mut kept = json!({"adapter": details["adapter"], "inputs": inputs});
                // A hash of weights names nobody.
                let is_hash = |text: &str| text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
                if let Some(sha256) = details[SCATTER_NETWORK].as_str().filter(|text| is_hash(text)) {
                    kept[SCATTER_NETWORK] = json!(sha256);
                }
                let details = kept;
                let host = String::new();
                value = as_value(&Provenance { program, version, started_us, host, details });
            }
            SETUP_TOPIC => value = as_value(&self.names.setup(&entry.json()?)),
            METADATA_TOPIC => match self.serial_numbers.said(&value) {
                Some(sample) => value = as_value(sample),
                // The bytes that said it are gone.
                None => {
                    for key in ["serial_number", "firmware", "calibration_id", "units"] {
                        value[key] = json!("");
                    }
                }
            },
            SEEN_TOPIC if self.options.no_pixels => {
                let SeenRecord { frame, picture } = entry.json()?;
                value = self.seen(picture, frame);
            }
            SEEN_TOPIC => self.tags(&mut value["frame"]),
            topic::POSE => {
                self.relabel(&mut value);
                self.names.without_layout_notes(&mut value["pose"]);
                self.names.reword(&mut value);
            }
            topic::SCORES => {
                self.relabel(&mut value);
                if let Some(pair) = value.as_object_mut() {
                    NEEDLESS_OF_PAIRS.iter().for_each(|key| _ = pair.shift_remove(*key));
                }
                self.names.reword(&mut value);
            }
            _ => self.names.reword(&mut value),
        }
        Ok(value)
    }

    fn relabel(&self, value: &mut Value) {
        let number = value["number"].as_u64().and_then(|number| u32::try_from(number).ok()).unwrap_or(0);
        value["frame"] = self.labels.get(&number).map_or_else(|| json!("frame"), |label| json!(label));
    }

    /// Tags without names and free text.
    fn tags(&mut self, frame: &mut Value) {
        let sha256 = frame["sha256"].as_str().unwrap_or_default();
        let label = format!("frame-{}", sha256.get(..12).unwrap_or(sha256));
        let number = frame["number"].as_u64().and_then(|number| u32::try_from(number).ok()).unwrap_or(0);
        frame["name"] = json!(label);
        for texts in ["notes", "domain_evidence"] {
            frame[texts] = json!([]);
        }
        if let Some(tags) = frame["tags"].as_object_mut() {
            NEEDLESS_TAGS.iter().for_each(|tag| _ = tags.shift_remove(*tag));
        }
        self.labels.insert(number, label);
    }

    /// A frame without its pixels. Its grain would tell something of them.
    fn seen(&mut self, picture: Option<PictureDigest>, frame: Frame) -> Value {
        let picture = self.pictures.told_without_grain(&frame, picture);
        let mut value = as_value(&SeenRecord { frame, picture });
        self.tags(&mut value["frame"]);
        value
    }

    fn frame(&mut self, reader: &LogReader, entry: &LogEntry) -> Result<(), RecordError> {
        let Some(tags) = self.tags.take() else {
            self.tolerance.take(self.assembler.push(entry));
            return Ok(());
        };
        let Some(frame) = self.tolerance.take(self.assembler.push(entry)).flatten() else { return Ok(()) };
        if self.options.no_pixels {
            self.report.pixels += 1;
            let value = self.seen(PictureDigest::of(&frame), frame);
            return self.copy.json(SEEN_TOPIC, entry.host_us, &value);
        }
        let Some(mut value) = self.tolerance.take(tags.json::<Value>()) else { return Ok(()) };
        self.tags(&mut value);
        self.copy.json(topic::FRAME_TAGS, tags.host_us, &value)?;
        self.copy.message(reader, entry)
    }
}

/// Whatever came out of a log has a JSON form.
fn as_value(value: &impl Serialize) -> Value {
    serde_json::to_value(value).unwrap_or_default()
}
