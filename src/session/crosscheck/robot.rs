//! The robot: whether it is drawn as it is, by the session's files and by what its line says.

use super::finding::Finding;
use crate::geometry::Rigid;
use crate::scene::Scene;
use crate::session::file::Setup;
use crate::telemetry::{AngleSource, RobotSample};

/// A robot as far as this from all else that is drawn is in no frame of it.
const FAR_MM: f64 = 150.0;
/// Sensed and commanded angles of a robot that stands still differ by less: play and load.
pub const APART_DEG: f64 = 2.0;
/// A robot whose angles changed by less while it was listened to stands still.
const STILL_DEG: f64 = 0.3;
/// Whether it stands still shows within this time.
const STILL_US: u64 = 500_000;

/// A robot that is drawn without telemetry, or reported and not drawn, or drawn where nothing else is.
pub(super) fn check_robot(setup: &Setup, scene: &Scene) -> Vec<Finding> {
    const CHECK: &str = "robot";
    let of_line = match (&setup.robot, &scene.robot) {
        (None, None) => None,
        (Some(line), Some(drawn)) if !line.is_like(&drawn.model) => Some(Finding::warn(
            CHECK,
            "the session's robot model is not the one that the scene draws",
            "name the same model file in both",
        )),
        (Some(_), Some(_)) => Some(Finding::pass(CHECK, "drawn as telemetry says")),
        (None, Some(_)) => Some(Finding::warn(
            CHECK,
            "robot drawn as in the scene file: no telemetry",
            "add the robot's line to the session, or take the robot out of the scene",
        )),
        (Some(_), None) => Some(Finding::warn(
            CHECK,
            "the session has a robot, the scene has none: it is not drawn",
            "add {\"robot\": …} to the scene's objects",
        )),
    };
    of_line.into_iter().chain(check_scene_base(setup, scene)).collect()
}

/// What the robot says of itself; `first` is what it said when the listening began.
pub(super) fn check_robot_line(
    setup: &Setup,
    scene: Option<&Scene>,
    first: Option<&RobotSample>,
    latest: &RobotSample,
) -> Vec<Finding> {
    // What is not drawn cannot be drawn wrongly, and that it is not is said elsewhere.
    if scene.is_some_and(|scene| scene.robot.is_none()) {
        return Vec::new();
    }
    let mut found = Vec::new();
    found.extend(check_source(latest));
    found.extend(check_apart(first, latest));
    found.extend(check_bend(setup, scene, latest));
    found.extend(check_tracking(setup, latest));
    found.extend(scene.and_then(|scene| check_tracked_base(setup, scene, latest)));
    found
}

fn check_source(latest: &RobotSample) -> Option<Finding> {
    const CHECK: &str = "robot angles";
    match latest.control_angles_deg() {
        (angles_deg, _) if !angles_deg.iter().all(|angle| angle.is_finite()) => Some(Finding::warn(
            CHECK,
            "the robot reports no control angles: it is drawn as in the scene file",
            "home the robot, and check that its controller knows its angles",
        )),
        (_, AngleSource::Commanded) => Some(Finding::warn(
            CHECK,
            "the robot senses none of its angles, or not all five: it is drawn as commanded, whether it went there or not",
            "switch its sensing on, if it has any",
        )),
        (_, AngleSource::Sensed) => None,
    }
}

fn check_apart(first: Option<&RobotSample>, latest: &RobotSample) -> Option<Finding> {
    let first = first?;
    let listened_us = latest.device_us.saturating_sub(first.device_us);
    let near = |a: [f64; 5], b: [f64; 5]| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= STILL_DEG);
    let still = near(first.commanded_deg, latest.commanded_deg) && near(first.sensed_deg?, latest.sensed_deg?);
    let (index, apart_deg) = latest.sensed_from_commanded_deg()?;
    if listened_us < STILL_US || !still || apart_deg.abs() <= APART_DEG {
        return None;
    }
    let detail = format!(
        "the robot stands still, and senses {apart_deg:+.1} degrees more than it was commanded at control point {}: one of the two is \
         wrong; the sensed ones are drawn",
        index + 1
    );
    Some(Finding::warn(
        "robot angles",
        detail,
        "home the robot, check its tendons and encoders, or run `sidecarm calibrate robot`",
    ))
}

/// Angles beyond what the robot can bend: it is drawn at its limit.
fn check_bend(setup: &Setup, scene: Option<&Scene>, latest: &RobotSample) -> Option<Finding> {
    let (angles_deg, _) = latest.control_angles_deg();
    let (clamped, limit_deg) = match scene {
        Some(scene) => {
            let robot = scene.with_robot(angles_deg, None).ok()?.robot?;
            (robot.clamped, robot.model.max_bend_deg)
        }
        None => {
            let model = setup.robot.as_ref()?;
            (model.shape(&angles_deg).ok()?.clamped, model.max_bend_deg)
        }
    };
    if clamped == 0 {
        return None;
    }
    let detail = format!(
        "{clamped} notches of the robot would be clamped to {limit_deg} degrees: its angles {angles_deg:.1?} are beyond what it can bend, \
         and it is drawn straighter than it says"
    );
    let remedy = "check that it reports degrees a notch, that the model is this robot's, and home it";
    Some(Finding::warn("robot bend", detail, remedy))
}

/// Whether a tracked base is used, and a base whose tracking is counted on is tracked.
fn check_tracking(setup: &Setup, latest: &RobotSample) -> Option<Finding> {
    const CHECK: &str = "robot base";
    match (&latest.tracker_from_base, setup.session.world_from_tracker) {
        (Some(_), None) => Some(Finding::warn(
            CHECK,
            "the robot's base is tracked, but the session has no world_from_tracker: the robot is drawn at the scene's base, wherever it is",
            "give world_from_tracker in the session (4 x 4, in millimetres)",
        )),
        (None, Some(_)) => Some(Finding::warn(
            CHECK,
            "the session has world_from_tracker, but the robot's base is not tracked: the robot is drawn at the scene's base",
            "check that the tracker sees the robot's marker and that the robot hands its pose on, or take world_from_tracker out",
        )),
        (Some(base), Some(_)) if !(base.translation_mm.length() > 0.0) => Some(Finding::warn(
            CHECK,
            "the robot says that its base is tracked exactly at the tracker's origin, as where nothing is measured",
            "check the tracker; a base that is not seen has to be sent without the flag that says it is tracked",
        )),
        _ => None,
    }
}

/// Where the tracker puts the robot, against all else that is drawn.
fn check_tracked_base(setup: &Setup, scene: &Scene, latest: &RobotSample) -> Option<Finding> {
    let tied = |rows: Option<[[f64; 4]; 4]>| Rigid::from_rows(&rows?).ok();
    let world_from_tracker = tied(setup.session.world_from_tracker)?;
    let lps_from_world = tied(setup.session.world_from_lps)?.inverse();
    let base = latest.tracker_from_base.filter(|base| base.translation_mm.length() > 0.0)?;
    let away = |world_from_tracker: Rigid, base: Rigid| away_mm(scene, Some(lps_from_world * world_from_tracker * base));
    let away_mm = away(world_from_tracker, base)?;
    if away_mm <= FAR_MM {
        return None;
    }
    let detail = format!("the tracker puts the robot {away_mm:.0} mm from all else that the scene draws");
    let in_metres = |pose: Rigid| Rigid { translation_mm: 1e3 * pose.translation_mm, ..pose };
    let fits = |tracker: Rigid, base: Rigid| away(tracker, base).is_some_and(|mm| mm <= FAR_MM);
    let (why, remedy) = if fits(world_from_tracker, in_metres(base)) {
        ("; its translation fits if it is in metres", "have the robot send its base in millimetres, as the protocol has it")
    } else if fits(in_metres(world_from_tracker), base) {
        ("; it fits if world_from_tracker is in metres", "write world_from_tracker in millimetres")
    } else if fits(world_from_tracker.inverse(), base) {
        ("; it fits with the inverse of world_from_tracker", "write world_from_tracker, which maps the tracker to the room")
    } else {
        ("", "check world_from_tracker, world_from_lps, and the marker that is tracked (marker_from_base of its calibration)")
    };
    Some(Finding::warn("robot base", format!("{detail}{why}"), remedy))
}

/// The scene's own base; where a tracker tells it, the scene may leave it out.
fn check_scene_base(setup: &Setup, scene: &Scene) -> Option<Finding> {
    let away_mm = away_mm(scene, None).filter(|_| setup.session.world_from_tracker.is_none())?;
    if away_mm <= FAR_MM {
        return None;
    }
    let detail = format!("the scene's lps_from_base puts the robot {away_mm:.0} mm from all else that the scene draws");
    Some(Finding::warn("robot base", detail, "write lps_from_base in millimetres, in the CT's own lps coordinates"))
}

/// From the box around the robot to the box around all else, with the base where the scene or a tracked marker has it; `None` where
/// one of the two is not there.
fn away_mm(scene: &Scene, lps_from_marker: Option<Rigid>) -> Option<f64> {
    let angles_deg = scene.robot.as_ref()?.control_angles_deg;
    let placed = scene.with_robot(angles_deg, lps_from_marker).ok()?;
    let (low, high) = placed.objects[placed.robot.as_ref()?.object].bounds_lps_mm()?;
    let (rest_low, rest_high) = placed.without_robot().bounds_lps_mm()?;
    Some((low - rest_high).max(rest_low - high).max(glam::DVec3::ZERO).length())
}
