//! Shots from a session's log: poses, control angles and tracked bases of its exposures. The frames come from the log as well.

use std::path::Path;

use serde::Deserialize;

use super::shot::NoShot;
use crate::calibrate::logged_poses::{LoggedPose, shots_of};
use crate::geometry::Rigid;
use crate::pose::Pose;
use crate::record::RecordError;

/// Samples further apart than this around an exposure say nothing of it.
const MAX_GAP_US: i64 = 500_000;

/// What a log says of a frame in which the robot may be seen.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedShot {
    /// Its number of arrival.
    pub number: u32,
    /// How people call it.
    pub name: String,
    /// Its last pose.
    pub pose: Pose,
    /// Control angles at the exposure.
    pub readings_deg: [f64; 5],
    /// The base as the tracker reported it.
    pub tracker_from_base: Option<Rigid>,
}

#[derive(Deserialize)]
struct BindingRecord {
    exposure: Option<ExposureRecord>,
}

#[derive(Deserialize)]
struct ExposureRecord {
    control_angles_deg: Option<AnswerRecord<[f64; 5]>>,
    tracker_from_base: Option<AnswerRecord<Rigid>>,
}

#[derive(Deserialize)]
struct AnswerRecord<T> {
    value: T,
    gap_us: i64,
}

fn shot_of(name: &str, record: LoggedPose<BindingRecord>) -> Result<LoggedShot, NoShot> {
    if record.pose.camera().is_none() {
        return Err(NoShot::Refused);
    }
    let exposure = record.binding.exposure.ok_or(NoShot::NoAngles)?;
    let angles = exposure.control_angles_deg.ok_or(NoShot::NoAngles)?;
    if angles.gap_us > MAX_GAP_US {
        return Err(NoShot::Gap);
    }
    let tracked = exposure.tracker_from_base.filter(|answer| answer.gap_us <= MAX_GAP_US);
    Ok(LoggedShot {
        number: record.number,
        name: name.to_owned(),
        pose: record.pose,
        readings_deg: angles.value,
        tracker_from_base: tracked.map(|answer| answer.value),
    })
}

/// The shots of a log in order of arrival; a frame that was posed again counts with its last pose. Second: what is no shot and why, and what
/// of the log could not be read.
///
/// # Errors
/// When the file cannot be read or is no log.
pub fn shots_of_log(path: &Path) -> Result<(Vec<LoggedShot>, Vec<String>), RecordError> {
    shots_of(path, shot_of)
}
