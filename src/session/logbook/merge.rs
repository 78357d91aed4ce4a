//! Logs of one session that was recorded in pieces, as one log.
//!
//! A session that was started again had to learn everything again: clocks of devices and console, the numbers of exposures, where the specimen
//! lies. So the pieces are not made into one stream; a message says where the next one begins, and there a replay begins anew as the session
//! did: poses and images come out as they were recorded. Frames of later pieces get new numbers, consistently in every message.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::Value;

use super::super::log::SETUP_TOPIC;
use super::super::records::{RESTART_TOPIC, RestartRecord};
use super::LogbookError;
use super::frames::Frames;
use super::inventory::Reading;
use super::renumber::renumbered;
use crate::image::{refuse_overwrite, refuse_same_content};
use crate::record::{Attachment, LogCopy, LogReader, Provenance, Tolerance, topic};
use crate::reporter::Reporter;

/// A log as it was joined.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Joined {
    /// The log.
    pub path: PathBuf,
    /// Host time of its first message.
    pub start_us: i64,
    /// Of its last one.
    pub end_us: i64,
    /// Frames in it.
    pub frames: usize,
    /// What was added to their numbers.
    pub numbers_from: u32,
}

/// What came of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MergeReport {
    /// The new log.
    pub path: PathBuf,
    /// Messages in it.
    pub messages: u64,
    /// In order of time.
    pub logs: Vec<Joined>,
    /// What a person should know.
    pub notes: Vec<String>,
    /// What of the logs could not be read.
    pub losses: Vec<String>,
}

/// A log before it is joined.
struct Piece {
    path: PathBuf,
    start_us: i64,
    end_us: i64,
    frames: Frames,
    setup: Value,
    version: String,
    attachments: Vec<Attachment>,
    losses: Vec<String>,
}

impl Piece {
    fn read(path: &Path, reporter: &Reporter) -> Result<Self, LogbookError> {
        let mut reader = LogReader::open(path)?;
        let mut reading = Reading::new("reading", &reader, reporter);
        let (mut frames, mut tolerance) = (Frames::default(), Tolerance::default());
        let (mut span, mut setup, mut version) = (None, None, String::new());
        while let Some(entry) = reader.next() {
            reading.at(&reader);
            let (start_us, end_us) = span.unwrap_or((entry.host_us, entry.host_us));
            span = Some((entry.host_us.min(start_us), entry.host_us.max(end_us)));
            match &*entry.topic {
                SETUP_TOPIC if setup.is_none() => setup = tolerance.take(entry.json::<Value>()),
                topic::PROVENANCE if version.is_empty() => {
                    version = tolerance.take(entry.json::<Provenance>()).map(|from| from.version).unwrap_or_default();
                }
                _ => _ = tolerance.take(frames.take(&entry)),
            }
        }
        if frames.without_numbers {
            return Err(LogbookError::WithoutNumbers { path: path.to_owned(), todo: "joined with others" });
        }
        let no_session = || LogbookError::NoSession { path: path.to_owned(), todo: "joined" };
        let (start_us, end_us) = span.ok_or_else(no_session)?;
        let damage = reader.losses().iter().map(|loss| format!("{}: {loss}", path.display()));
        Ok(Self {
            path: path.to_owned(),
            start_us,
            end_us,
            setup: setup.map(comparable).ok_or_else(no_session)?,
            version,
            losses: damage.chain(tolerance.losses()).collect(),
            attachments: reader.attachments().to_vec(),
            frames,
        })
    }
}

/// A session without what may be another after a restart and decides nothing: ports, and the folder of frames.
fn comparable(mut setup: Value) -> Value {
    for line in ["/session/carm", "/session/robot"] {
        setup.pointer_mut(line).and_then(Value::as_object_mut).map(|line| line.remove("port"));
    }
    setup.pointer_mut("/session/frames").and_then(Value::as_object_mut).map(|frames| frames.remove("folder"));
    setup
}

/// Joins `logs`, in whatever order they are named, into `out`.
///
/// # Errors
/// When one cannot be read or holds no session, when they are not of one session or not one after the other, or `out` exists or cannot be
/// written.
pub fn merge(logs: &[PathBuf], out: &Path, reporter: &Reporter) -> Result<MergeReport, LogbookError> {
    refuse_overwrite(&[out], logs)?;
    LogCopy::refuse_existing(out)?;
    refuse_same_content(logs)?;
    let mut pieces = logs.iter().map(|log| Piece::read(log, reporter)).collect::<Result<Vec<_>, _>>()?;
    pieces.sort_by_key(|piece| piece.start_us);
    for pair in pieces.windows(2) {
        refuse_strangers(&pair[0], &pair[1])?;
    }
    let mut copy = LogCopy::create(out)?;
    let mut attached: Vec<&Attachment> = Vec::new();
    for (attachment, start_us) in pieces.iter().flat_map(|piece| piece.attachments.iter().map(|file| (file, piece.start_us))) {
        if !attached.contains(&attachment) {
            copy.attach(attachment, start_us)?;
            attached.push(attachment);
        }
    }
    let (mut joined, mut losses, mut numbers_from) = (Vec::new(), Vec::new(), 0);
    for piece in &pieces {
        if !joined.is_empty() {
            copy.json(RESTART_TOPIC, piece.start_us, &RestartRecord { numbers_from })?;
        }
        write(piece, numbers_from, &mut copy, &mut losses, reporter)?;
        let frames = piece.frames.by_number.len();
        let Piece { path, start_us, end_us, .. } = piece;
        joined.push(Joined { path: path.clone(), start_us: *start_us, end_us: *end_us, frames, numbers_from });
        let last = piece.frames.by_number.last_key_value().map_or(0, |(number, _)| *number);
        numbers_from = numbers_from.saturating_add(last);
    }
    let summary = copy.finish()?;
    losses.splice(0..0, pieces.iter().flat_map(|piece| piece.losses.iter().cloned()));
    let notes = notes(&pieces, &joined);
    Ok(MergeReport { path: summary.path, messages: summary.messages, logs: joined, notes, losses })
}

fn write(
    piece: &Piece,
    numbers_from: u32,
    copy: &mut LogCopy,
    losses: &mut Vec<String>,
    reporter: &Reporter,
) -> Result<(), LogbookError> {
    let mut reader = LogReader::open(&piece.path)?;
    let mut reading = Reading::new("joining", &reader, reporter);
    let mut tolerance = Tolerance::default();
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        let entry = match numbers_from {
            0 => Some(entry),
            by => tolerance.take(renumbered(&entry, by)),
        };
        if let Some(entry) = entry {
            copy.message(&reader, &entry)?;
        }
    }
    losses.extend(tolerance.losses().into_iter().map(|loss| format!("{}: {loss}", piece.path.display())));
    Ok(())
}

fn refuse_strangers(first: &Piece, second: &Piece) -> Result<(), LogbookError> {
    let (a, b) = (first.path.clone(), second.path.clone());
    if let Some(what) = difference(&first.setup, &second.setup, "") {
        return Err(LogbookError::Differ { first: a, second: b, what });
    }
    let overlap_us = first.end_us.saturating_sub(second.start_us);
    if overlap_us > 0 {
        return Err(LogbookError::Overlap { first: a, second: b, overlap_s: overlap_us as f64 * 1e-6 });
    }
    Ok(())
}

/// So much of a value is shown.
const SHOWN: usize = 40;

/// The first place where two sessions differ, with both values.
fn difference(a: &Value, b: &Value, at: &str) -> Option<String> {
    match (a, b) {
        (Value::Object(a), Value::Object(b)) => {
            let mut keys = a.keys().chain(b.keys().filter(|key| !a.contains_key(*key)));
            let none = Value::Null;
            let inside = |key: &String| if at.is_empty() { key.clone() } else { format!("{at}.{key}") };
            keys.find_map(|key| difference(a.get(key).unwrap_or(&none), b.get(key).unwrap_or(&none), &inside(key)))
        }
        (Value::Array(a), Value::Array(b)) if a.len() == b.len() => {
            (0..).zip(a.iter().zip(b)).find_map(|(index, (a, b)): (usize, _)| difference(a, b, &format!("{at}[{index}]")))
        }
        _ if a == b => None,
        _ => {
            let shown = |value: &Value| {
                let text = value.to_string();
                let short: String = text.chars().take(SHOWN).collect();
                if short.len() < text.len() { format!("{short}…") } else { short }
            };
            Some(format!("`{at}` ({} and {})", shown(a), shown(b)))
        }
    }
}

fn notes(pieces: &[Piece], joined: &[Joined]) -> Vec<String> {
    let mut notes = Vec::new();
    for pair in pieces.windows(2) {
        if pair[0].version != pair[1].version {
            let (path, before, now) = (pair[1].path.display(), &pair[0].version, &pair[1].version);
            notes.push(format!("{path}: was recorded by version {now}, the one before by {before}"));
        }
    }
    // A session that is started again takes in what its folder holds.
    let mut seen: BTreeMap<(&str, [usize; 2]), u32> = BTreeMap::new();
    for (piece, log) in pieces.iter().zip(joined) {
        for frame in piece.frames.by_number.values() {
            let number = frame.number + log.numbers_from;
            let first = *seen.entry((&frame.sha256, frame.size_px)).or_insert(number);
            if first <= log.numbers_from && first != number && notes.len() < 20 {
                notes.push(format!("frame {number} is of the same file as frame {first} of an earlier log"));
            }
        }
    }
    notes
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn sessions_differ_where_they_do_and_ports_do_not_matter() {
        let setup = |port: &str, sha: &str| json!({"session": {"carm": {"port": port, "baud": 9600}, "frames": {"folder": port}}, "inputs": [{"sha256": sha}]});
        let [a, b, c] = [setup("0", "ab"), setup("1", "ab"), setup("0", "cd")].map(comparable);
        assert_eq!(difference(&a, &b, ""), None);
        assert_eq!(difference(&a, &c, "").as_deref(), Some("`inputs[0].sha256` (\"ab\" and \"cd\")"));
    }
}
