//! What a device says of itself, against what the session assumes of it.

use std::collections::BTreeSet;

use super::exposure::{SID_TOLERANCE_MM, against_scene};
use super::finding::{Finding, Level, tell};
use super::robot_watch::RobotWatch;
use super::units::told_sid;
use crate::geometry::JOINT_KEYS;
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::session::file::Setup;
use crate::telemetry::{CarmSample, DeviceKind, Limit, Metadata, Sample};

/// Limits that differ by more than this are of another robot.
const BEND_TOLERANCE_DEG: f64 = 0.05;
/// Joints may be beyond their range by this share of it: encoders are noisy at the end stop.
const RANGE_SLACK: f64 = 0.01;
/// A field wider than the panel by more than this share is another panel's.
const PANEL_SHARE: f64 = 0.02;

/// Tells each disagreement of the lines once, when the sample that shows it arrives.
#[derive(Default)]
pub struct LineWatch {
    told: BTreeSet<String>,
    /// Ranges of the arm's joints, as it stated them last.
    ranges: Vec<Limit>,
    robot: RobotWatch,
}

impl LineWatch {
    /// Takes a sample of any line.
    pub fn take(&mut self, setup: &Setup, sample: &Sample, reporter: &Reporter) {
        let findings = match sample {
            Sample::Metadata(metadata) => {
                if metadata.device == DeviceKind::Carm {
                    self.ranges.clone_from(&metadata.limits);
                }
                check_line(setup, None, Some(metadata), None)
            }
            Sample::Carm(sample) => {
                let beyond = check_joints(&self.ranges, sample);
                beyond.into_iter().chain(check_line(setup, None, None, Some(sample))).collect()
            }
            // It tells each loss once by itself, and again when what was lost has been back.
            Sample::Robot(sample) => return tell(&self.robot.take(setup, sample), reporter),
        };
        // By what was checked: a length that jitters is one disagreement.
        let new: Vec<Finding> = findings
            .into_iter()
            .filter(|finding| finding.level > Level::Pass && self.told.insert(finding.check.clone()))
            .collect();
        tell(&new, reporter);
    }
}

/// Disagreements of a line with the session's models; nothing where all agrees.
#[must_use]
pub fn check_line(
    setup: &Setup,
    scene: Option<&Scene>,
    metadata: Option<&Metadata>,
    sample: Option<&CarmSample>,
) -> Vec<Finding> {
    let mut found = Vec::new();
    if let Some(metadata) = metadata {
        found.extend(check_units(metadata));
        match metadata.device {
            DeviceKind::Robot => found.extend(check_bend(setup, metadata)),
            DeviceKind::Carm => found.extend(check_distance_range(setup, metadata)),
        }
    }
    if let Some(sample) = sample {
        let distance_mm = sample.joints.source_to_detector_mm;
        let implausible = told_sid(distance_mm, setup.carm.as_ref());
        found.extend(implausible.or_else(|| check_distance(setup, distance_mm)));
        found.extend(check_panel(setup, sample));
        if let Some(scene) = scene.filter(|_| sample.tube_kvp > 0.0) {
            found.extend(against_scene("kVp", "by telemetry", sample.tube_kvp, scene));
        }
    }
    found
}

/// Joints beyond the ranges that the arm itself states.
fn check_joints(ranges: &[Limit], sample: &CarmSample) -> Vec<Finding> {
    let joints = JOINT_KEYS.iter().zip(sample.joints.to_array()).zip(ranges);
    let beyond = joints.filter_map(|(((joint, is_angle), value), range)| {
        // An encoder that counts to 360 means as much by 359 as one that says −1.
        let whole_turns = |deg: f64| 360.0 * ((deg - 0.5 * (range.min + range.max)) / 360.0).round();
        let value = if *is_angle { value.to_degrees() - whole_turns(value.to_degrees()) } else { value };
        let slack = RANGE_SLACK * (range.max - range.min);
        // A joint without an encoder, or a range that is none, is not judged.
        let is_beyond = value < range.min - slack || value > range.max + slack;
        is_beyond.then(|| {
            let detail = format!("the arm reports {joint} {value:.1}, and that it reaches {} to {}", range.min, range.max);
            Finding::warn(
                &format!("{joint} out of range"),
                detail,
                "an encoder is off: home the arm, or do without its telemetry",
            )
        })
    });
    beyond.collect()
}

fn check_units(metadata: &Metadata) -> Option<Finding> {
    let units: Vec<&str> = metadata.units.split(',').map(str::trim).collect();
    let missing: Vec<&str> = ["mm", "deg"].into_iter().filter(|unit| !units.contains(unit)).collect();
    if missing.is_empty() || metadata.units.is_empty() {
        return None;
    }
    let detail = format!("the {} says that it sends {}, without {}", metadata.device, metadata.units, missing.join(" and "));
    Some(Finding::warn("units on the wire", detail, "set the device to mm and degrees, as the protocol has it"))
}

fn check_bend(setup: &Setup, metadata: &Metadata) -> Option<Finding> {
    let model = setup.robot.as_ref()?;
    let off = |limit: &&crate::telemetry::Limit| {
        let apart = (limit.max - model.max_bend_deg).abs().max((limit.min + model.max_bend_deg).abs());
        apart.is_finite() && apart > BEND_TOLERANCE_DEG
    };
    let limit = metadata.limits.iter().find(off)?;
    let detail = format!(
        "the robot says that it bends {:.2} to {:.2} degrees a notch, the model clamps at {}",
        limit.min, limit.max, model.max_bend_deg
    );
    Some(Finding::warn("robot limits", detail, "use the model file of this robot, or correct its max_bend_deg"))
}

fn check_distance_range(setup: &Setup, metadata: &Metadata) -> Option<Finding> {
    let distance_mm = setup.carm.as_ref()?.source_to_detector_mm?;
    let limit = metadata.limits.get(6).filter(|limit| limit.min.is_finite() && limit.max.is_finite())?;
    if distance_mm >= limit.min && distance_mm <= limit.max {
        return None;
    }
    let detail = format!(
        "the calibration has {distance_mm} mm from focal spot to detector, the arm says that it has {} to {} mm",
        limit.min, limit.max
    );
    Some(Finding::warn("SID", detail, "correct source_to_detector_mm in the calibration (in millimetres)"))
}

/// The distance that telemetry says against the one that the calibration was made for. Telemetry's is used.
fn check_distance(setup: &Setup, told_mm: f64) -> Option<Finding> {
    let nominal_mm = setup.carm.as_ref()?.source_to_detector_mm?;
    // An arm that does not measure it is NaN here, and the calibration's holds.
    if !((told_mm - nominal_mm).abs() > SID_TOLERANCE_MM.max(0.01 * nominal_mm)) {
        return None;
    }
    let detail = format!(
        "telemetry says {told_mm:.0} mm from focal spot to detector, the calibration {nominal_mm:.0} mm; telemetry's is used"
    );
    let remedy =
        "correct the one that is wrong; for an arm whose detector moves, leave source_to_detector_mm out of the calibration";
    Some(Finding::warn("SID", detail, remedy))
}

fn check_panel(setup: &Setup, sample: &CarmSample) -> Option<Finding> {
    let carm = setup.carm.as_ref()?;
    let [left, top, right, bottom] = sample.field_mm;
    let (field, panel) = ([right - left, bottom - top], [carm.columns_px, carm.rows_px].map(|n| f64::from(n) * carm.pitch_mm));
    // Shutters make a field smaller than the panel, never larger.
    if !field.iter().zip(panel).any(|(field, panel)| *field > panel * (1.0 + PANEL_SHARE)) {
        return None;
    }
    let detail = format!(
        "telemetry's field is {:.0} x {:.0} mm, the calibration's panel {:.0} x {:.0} mm ({} x {} px of {} mm)",
        field[0], field[1], panel[0], panel[1], carm.columns_px, carm.rows_px, carm.pitch_mm
    );
    Some(Finding::warn("panel size", detail, "check columns_px, rows_px and pitch_mm of the calibration against the frames"))
}
