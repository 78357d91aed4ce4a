//! Shots from what a user has: pose files, or the poses and joints of a session's log.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec2;
use serde::Deserialize;

use super::shot::{Shot, ShotBead};
use crate::geometry::CarmJoints;
use crate::pose::{BeadResidual, Pose};
use crate::record::{LogReader, RecordError, Tolerance, topic};

/// What `/pose` says, as far as it matters here.
#[derive(Deserialize)]
struct PoseRecord {
    number: u32,
    #[serde(default)]
    development: u32,
    frame: String,
    binding: BindingRecord,
    pose: Pose,
}

#[derive(Deserialize)]
struct BindingRecord {
    exposure: Option<ExposureRecord>,
}

#[derive(Deserialize)]
struct ExposureRecord {
    joints: Option<JointsRecord>,
}

#[derive(Deserialize)]
struct JointsRecord {
    value: CarmJoints,
}

impl Shot {
    /// An accepted pose with the joints at its exposure; `None` where it is refused or names no frame size.
    #[must_use]
    pub fn of(name: &str, pose: &Pose, joints: CarmJoints) -> Option<Self> {
        let (_, camera_from_lps) = pose.camera()?;
        let bead = |bead: &BeadResidual| {
            let (image_px, sigma_px) = (bead.image_px.filter(|_| bead.used)?, bead.sigma_px?);
            let image_px = DVec2::from_array(image_px);
            (sigma_px > 0.0).then(|| ShotBead { name: bead.name.clone(), lps_mm: bead.lps_mm, image_px, sigma_px })
        };
        let beads = pose.beads.iter().filter_map(bead).collect();
        Some(Self { name: name.to_owned(), size_px: pose.size_px?, joints, beads, camera_from_lps })
    }
}

/// The shots of a session's log: frames that are bound to an exposure with joints and have an accepted pose, in order of arrival; a frame that
/// was posed again counts with its last pose. Second: what is no shot and why, and what of the log could not be read.
///
/// # Errors
/// When the file cannot be read or is no log.
pub fn shots_of_log(path: &Path) -> Result<(Vec<Shot>, Vec<String>), RecordError> {
    let mut latest: BTreeMap<u32, PoseRecord> = BTreeMap::new();
    let mut tolerance = Tolerance::default();
    let mut reader = LogReader::open(path)?;
    for entry in reader.by_ref().filter(|entry| &*entry.topic == topic::POSE) {
        let Some(record) = tolerance.take(entry.json::<PoseRecord>()) else { continue };
        if latest.get(&record.number).is_none_or(|known| known.development <= record.development) {
            latest.insert(record.number, record);
        }
    }
    let (mut shots, mut notes) = (Vec::new(), Vec::new());
    for record in latest.into_values() {
        let name = format!("frame {} ({})", record.number, record.frame);
        match record.binding.exposure.and_then(|exposure| exposure.joints) {
            Some(joints) => match Shot::of(&name, &record.pose, joints.value) {
                Some(shot) => shots.push(shot),
                None => notes.push(format!("{name} is no shot: its pose was refused")),
            },
            None => notes.push(format!("{name} is no shot: it is not bound to an exposure with joints")),
        }
    }
    notes.extend(reader.losses().iter().map(|loss| format!("at byte {} of the log: {}", loss.at_byte, loss.reason)));
    notes.extend(tolerance.losses());
    Ok((shots, notes))
}
