//! The last pose of each frame of a log, with what a calibration wants to know of its exposure.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::pose::Pose;
use crate::record::{LogReader, RecordError, Tolerance, topic};

/// What `/pose` says, as far as it matters; `Binding` reads what is wanted of the binding.
#[derive(Deserialize)]
pub(super) struct LoggedPose<Binding> {
    /// The frame's number of arrival.
    pub number: u32,
    #[serde(default)]
    development: u32,
    frame: String,
    pub binding: Binding,
    pub pose: Pose,
}

/// The shots of a log in order of arrival, a frame that was posed again by its last pose: what `shot` makes of the name and the record.
/// Second: what is no shot and why, and what of the log could not be read.
///
/// # Errors
/// When the file cannot be read or is no log.
pub(super) fn shots_of<Binding: DeserializeOwned, Shot, Why: std::fmt::Display>(
    path: &Path,
    shot: impl Fn(&str, LoggedPose<Binding>) -> Result<Shot, Why>,
) -> Result<(Vec<Shot>, Vec<String>), RecordError> {
    let mut latest: BTreeMap<u32, LoggedPose<Binding>> = BTreeMap::new();
    let mut tolerance = Tolerance::default();
    let mut reader = LogReader::open(path)?;
    for entry in reader.by_ref().filter(|entry| &*entry.topic == topic::POSE) {
        let Some(record) = tolerance.take(entry.json::<LoggedPose<Binding>>()) else { continue };
        if latest.get(&record.number).is_none_or(|known| known.development <= record.development) {
            latest.insert(record.number, record);
        }
    }
    let (mut shots, mut notes) = (Vec::new(), Vec::new());
    for record in latest.into_values() {
        let name = format!("frame {} ({})", record.number, record.frame);
        match shot(&name, record) {
            Ok(shot) => shots.push(shot),
            Err(why) => notes.push(format!("{name} is no shot: {why}")),
        }
    }
    notes.extend(reader.losses().iter().map(|loss| format!("at byte {} of the log: {}", loss.at_byte, loss.reason)));
    notes.extend(tolerance.losses());
    Ok((shots, notes))
}
