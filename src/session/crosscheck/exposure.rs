//! One exposure: what telemetry, tags, calibration, scene and beads say of it, each against the others.

use glam::DVec3;

use super::field::check_field;
use super::filter::check_filter;
use super::finding::Finding;
use super::units::{PITCH_SHARE, scene_kvp, told_sid};
use crate::acquire::Frame;
use crate::geometry::{CarmCalibration, Rigid};
use crate::report::Innovation;
use crate::scene::Scene;
use crate::telemetry::CarmSample;

/// Generators and consoles round to whole kilovolts.
const KVP_TOLERANCE: f64 = 3.0;
/// DRRs of another voltage are off by more than the renderer's error beyond this.
const SCENE_KVP_TOLERANCE: f64 = 5.0;
/// What tubes of C-arms can do, and filters that are put before them.
const TUBE_KVP: (f64, f64) = (20.0, 160.0);
const MOST_FILTER_MM: (f64, f64) = (30.0, 3.0);
/// Distances of tags and telemetry differ by rounding at most.
pub(super) const SID_TOLERANCE_MM: f64 = 6.0;
/// Sag and an uncalibrated arm explain this much: degrees, mm across, mm in depth.
const POSE_TOLERANCE: (f64, f64, f64) = (3.0, 18.0, 25.0);

/// A turn about the beam that is within this of whole quarters is one of the picture: degrees.
const QUARTER_DEG: f64 = 5.0;
/// An innovation beyond this is a jump.
const JUMP_SIGMAS: f64 = 5.0;

/// What is known of one exposure; what is absent is not checked.
#[derive(Clone, Copy, Debug)]
pub struct ExposureFacts<'a> {
    /// The frame.
    pub frame: &'a Frame,
    /// The C-arm's calibration.
    pub carm: Option<&'a CarmCalibration>,
    /// What is rendered.
    pub scene: &'a Scene,
    /// Text of the scene's file.
    pub scene_json: &'a str,
    /// The C-arm's sample nearest the middle of the exposure.
    pub beam: Option<&'a CarmSample>,
    /// camera_from_lps by the beads, where they were accepted.
    pub from_beads: Option<&'a Rigid>,
    /// camera_from_lps by telemetry.
    pub nominal: Option<&'a Rigid>,
    /// Centroid of the beads.
    pub centre_lps_mm: Option<DVec3>,
    /// Share of the frame that lies behind the shutters, as found in its pixels.
    pub shuttered_share: Option<f64>,
}

/// Disagreements; nothing where all agrees.
#[must_use]
pub fn check_exposure(facts: &ExposureFacts) -> Vec<Finding> {
    let mut found = Vec::new();
    found.extend(check_size(facts));
    found.extend(check_pitch(facts));
    found.extend(check_distance(facts));
    found.extend(check_voltage(facts));
    found.extend(check_filter(facts.beam, facts.frame.tags.filter.as_ref(), facts.scene_json));
    let told = facts.beam.zip(facts.carm);
    found.extend(told.and_then(|(beam, carm)| check_field(beam, carm, facts.frame, facts.shuttered_share)));
    found.extend(check_pose(facts));
    found
}

fn check_size(facts: &ExposureFacts) -> Option<Finding> {
    let carm = facts.carm?;
    let ([columns, rows], expected) = (facts.frame.size_px, [carm.columns_px as usize, carm.rows_px as usize]);
    if [columns, rows] == expected {
        return None;
    }
    let detail = format!("the frame is {columns} x {rows} px, the C-arm calibration is for {} x {}", expected[0], expected[1]);
    let factor = expected[0].checked_div(columns).unwrap_or(0);
    let remedy = if [rows, columns] == expected {
        "the console has turned it by 90 degrees: declare `console` in the session, or export it unturned".to_owned()
    } else if factor > 1 && columns * factor == expected[0] && rows * factor == expected[1] {
        format!("it is binned {factor} x {factor}: use a calibration for that size, or export full frames")
    } else {
        "use the calibration of this frame size, or declare `console` in the session".to_owned()
    };
    Some(Finding::warn("frame size", detail, remedy))
}

fn check_pitch(facts: &ExposureFacts) -> Option<Finding> {
    let (carm, [across, down]) = (facts.carm?, facts.frame.tags.pitch_mm?);
    let off = |pitch: f64| !((pitch / carm.pitch_mm - 1.0).abs() <= PITCH_SHARE);
    if !(off(across) || off(down)) {
        return None;
    }
    let detail = format!("the frame's pitch is {across} x {down} mm, the C-arm calibration's {} mm", carm.pitch_mm);
    Some(Finding::warn("pitch", detail, "correct pitch_mm in the calibration (binned pixels are larger)"))
}

fn check_distance(facts: &ExposureFacts) -> Option<Finding> {
    const CHECK: &str = "SID";
    let told_mm = facts.beam.map(|beam| beam.joints.source_to_detector_mm).filter(|mm| mm.is_finite());
    if let Some(wrong) = told_mm.and_then(|mm| told_sid(mm, facts.carm)) {
        return Some(wrong);
    }
    let offset_mm = facts.carm.map_or(0.0, |carm| carm.offsets.source_to_detector_mm);
    let ours = told_mm.map(|mm| ("telemetry", mm)).or_else(|| Some(("the calibration", facts.carm?.source_to_detector_mm?)));
    let ((whose, ours_mm), tag_mm) = ours.map(|(whose, mm)| (whose, mm + offset_mm)).zip(facts.frame.tags.sid_mm)?;
    if (ours_mm - tag_mm).abs() <= SID_TOLERANCE_MM.max(0.01 * ours_mm) {
        return None;
    }
    let detail = format!("the frame says {tag_mm:.0} mm from focal spot to detector, {whose} says {ours_mm:.0} mm");
    Some(Finding::warn(CHECK, detail, "P rests on telemetry and calibration; correct the one that is wrong"))
}

fn check_voltage(facts: &ExposureFacts) -> Option<Finding> {
    const CHECK: &str = "kVp";
    let told = facts.beam.map(|beam| beam.tube_kvp).filter(|kvp| *kvp > 0.0);
    let tag = facts.frame.tags.kvp;
    // Beside the beam, none is what a generator tells.
    if let Some(tag) = tag.filter(|_| facts.beam.is_some_and(|beam| beam.xray_on && beam.tube_kvp == 0.0)) {
        let detail = format!("telemetry says 0 kVp while the beam is on, the frame {tag:.0}");
        return Some(Finding::warn(CHECK, detail, "correct the generator's telemetry, or send NaN for what it does not know"));
    }
    if let (Some(told), Some(tag)) = (told, tag)
        && !((told - tag).abs() <= KVP_TOLERANCE)
    {
        let detail = format!("telemetry says {told:.0} kVp, the frame {tag:.0}");
        return Some(Finding::warn(
            CHECK,
            detail,
            "check that the frame belongs to this exposure and the generator's telemetry is live",
        ));
    }
    let (whose, seen) = tag.map(|kvp| ("of the frame", kvp)).or_else(|| told.map(|kvp| ("by telemetry", kvp)))?;
    against_scene(CHECK, whose, seen, facts.scene)
}

/// The voltage that was used against the one that is rendered.
pub(super) fn against_scene(check: &str, whose: &str, seen_kvp: f64, scene: &Scene) -> Option<Finding> {
    let rendered = scene_kvp(scene)?;
    if (seen_kvp - rendered).abs() <= SCENE_KVP_TOLERANCE {
        return None;
    }
    let detail = format!("kVp {whose} {seen_kvp:.0}, the scene renders {rendered:.0}");
    Some(Finding::warn(check, detail, format!("set beam.tube_kvp of the scene to {seen_kvp:.0}")))
}

/// Numbers of a beam that no tube has. What is not measured is NaN on the wire, not zero.
pub(super) fn plausible_beam(beam: &CarmSample) -> Vec<Finding> {
    let (low_kvp, high_kvp) = TUBE_KVP;
    let (most_al_mm, most_cu_mm) = MOST_FILTER_MM;
    let told = [
        ("kVp", "a tube voltage", beam.tube_kvp, low_kvp, high_kvp, "kVp"),
        ("filter", "a filter", beam.filter_mm_al, 0.0, most_al_mm, "mm of aluminium"),
        ("filter", "a filter", beam.filter_mm_cu, 0.0, most_cu_mm, "mm of copper"),
    ];
    let wrong = told.into_iter().filter(|(_, _, value, low, high, _)| !(value.is_nan() || (*low..=*high).contains(value)));
    wrong
        .map(|(check, what, value, low, high, unit)| {
            let detail = format!("telemetry says {what} of {value:.2} {unit}, expected {low} to {high}");
            let remedy = "set the technique at the console; what the arm does not measure it has to send as NaN, not as a number";
            Finding::warn(check, detail, remedy)
        })
        .collect()
}

/// What is checked where telemetry and beads are held against each other.
pub(crate) const TELEMETRY_AND_BEADS: &str = "telemetry and beads";

/// How far telemetry puts the specimen from where the beads say it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseDifference {
    /// Of the specimen's attitude, degrees.
    pub angle_deg: f64,
    /// Telemetry minus beads at the centroid, camera axes, mm.
    pub shift_mm: DVec3,
}

/// Telemetry's camera_from_lps against that of the beads, at a point.
#[must_use]
pub fn pose_difference(from_beads: &Rigid, nominal: &Rigid, centre_lps_mm: DVec3) -> PoseDifference {
    PoseDifference {
        angle_deg: from_beads.angle_to_rad(nominal).to_degrees(),
        shift_mm: nominal.transform_point(centre_lps_mm) - from_beads.transform_point(centre_lps_mm),
    }
}

/// By how many degrees, 90 or 180, the picture is turned about the beam against what telemetry says, as a console turns it; `None` where it is not.
#[must_use]
pub fn turned_picture_deg(from_beads: &Rigid, nominal: &Rigid) -> Option<u32> {
    let turn = nominal.rotation * from_beads.rotation.conjugate();
    let about_beam_deg = 2.0 * turn.z.atan2(turn.w).to_degrees();
    let tilt_deg = 2.0 * turn.x.hypot(turn.y).atan2(turn.z.hypot(turn.w)).to_degrees();
    let quarters = (about_beam_deg / 90.0).round();
    if !(tilt_deg <= QUARTER_DEG && (about_beam_deg - 90.0 * quarters).abs() <= QUARTER_DEG) {
        return None;
    }
    match quarters.rem_euclid(4.0) as u32 {
        0 => None,
        2 => Some(180),
        _ => Some(90),
    }
}

/// Telemetry against the beads; `None` where either has no pose, or nothing says about which point.
#[must_use]
pub fn innovation(facts: &ExposureFacts) -> Option<Innovation> {
    let ((from_beads, nominal), centre) = facts.from_beads.zip(facts.nominal).zip(facts.centre_lps_mm)?;
    let PoseDifference { angle_deg, shift_mm } = pose_difference(from_beads, nominal, centre);
    let sigmas = facts.carm.and_then(|carm| carm.camera_sigma_mm.zip(carm.camera_sigma_deg));
    let sigmas = sigmas.map(|(mm, deg)| innovation_sigmas(mm, deg, angle_deg, shift_mm));
    Some(Innovation { shift_mm: shift_mm.to_array(), turn_deg: angle_deg, sigmas })
}

/// The largest of shift and turn in standard deviations: √mean over axes of a frame's and of the tying frame's, which err alike.
fn innovation_sigmas(sigma_mm: f64, sigma_deg: f64, angle_deg: f64, shift_mm: DVec3) -> f64 {
    let both = 2f64.sqrt() * 3f64.sqrt();
    (shift_mm.length() / (both * sigma_mm)).max(angle_deg / (both * sigma_deg))
}

/// A measured arm tells how far telemetry may be off: a jump beyond it is said long before an uncalibrated arm would explain it.
fn check_jump(innovation: &Innovation) -> Option<Finding> {
    let sigmas = innovation.sigmas?;
    if sigmas <= JUMP_SIGMAS {
        return None;
    }
    let detail = format!(
        "{TELEMETRY_AND_BEADS} are {:.1} mm and {:.2} degrees apart, {sigmas:.0} standard deviations of the calibrated arm",
        DVec3::from_array(innovation.shift_mm).length(),
        innovation.turn_deg
    );
    Some(Finding::warn(
        TELEMETRY_AND_BEADS,
        detail,
        "the specimen or the arm's base was moved, or an encoder jumped: tie the specimen anew",
    ))
}

fn check_pose(facts: &ExposureFacts) -> Option<Finding> {
    let innovation = innovation(facts)?;
    let (angle_deg, [u_mm, v_mm, depth_mm]) = (innovation.turn_deg, innovation.shift_mm);
    let (most_deg, most_across_mm, most_depth_mm) = POSE_TOLERANCE;
    let across_mm = u_mm.hypot(v_mm);
    if angle_deg <= most_deg && across_mm <= most_across_mm && depth_mm.abs() <= most_depth_mm {
        return check_jump(&innovation);
    }
    let detail = format!(
        "telemetry puts the specimen {angle_deg:.1} degrees, {across_mm:.0} mm across and {depth_mm:+.0} mm in depth from where the beads are"
    );
    let only_depth = angle_deg <= most_deg && across_mm <= most_across_mm;
    let other = "check world_from_lps, the joints' offsets, and whether specimen or arm was moved";
    let turned_deg =
        facts.from_beads.zip(facts.nominal).and_then(|(from_beads, nominal)| turned_picture_deg(from_beads, nominal));
    let remedy = match turned_deg {
        _ if only_depth => "check the source-to-detector distance and the pitch: a wrong focal length shows as depth".to_owned(),
        Some(deg) => format!(
            "that is a turn about the beam: was the picture turned by {deg} degrees at the console? Turn it back there, or declare `console` \
             (rotation_deg) in the session; else {other}"
        ),
        None => other.to_owned(),
    };
    Some(Finding::warn(TELEMETRY_AND_BEADS, detail, remedy))
}
