//! Device clocks that somebody sets in mid-session, through `live`.
#![cfg(unix)]

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::geometry::{Projection, Rigid};

use crate::lab_truth::{TIME_US, has_its_own_exposure, prior_is_right, robot_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::session_silence::steps_of;

/// The collimated exposure, whose frame shows too few beads.
const COLLIMATED: u32 = 7;
/// How far telemetry may put the specimen from where it is, as [`prior_is_right`] has it: the session's word of it is off by 4 mm and
/// half a degree, encoders by what an arm of a metre makes of a twentieth of a degree. The other exposures were taken from ten degrees
/// away or more.
const NEAR_MM: f64 = 12.0;
const NEAR_DEG: f64 = 2.0;
const ELSEWHERE_DEG: f64 = 10.0;
/// The same in the frame, where a millimetre of the specimen is 4.2 px.
const NEAR_PX: f64 = 50.0;

/// That a frame whose beads give no pose has that of telemetry, near the one with which it was taken.
fn falls_back_to_telemetry(lab: &Lab, pair: &Value, pose: &Value, counter: u32) {
    let by_telemetry = json!("telemetry");
    assert_eq!((&pair["status"], &pair["pose_source"]), (&json!("refused"), &by_telemetry), "{pair:#}");
    assert_eq!((&pose["pose_source"], &pose["pose"]["projection"]), (&by_telemetry, &Value::Null), "{pose:#}");
    let truth: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("truth.json")).expect("truth")).expect("JSON");
    let camera = |value: &Value| -> Rigid { serde_json::from_value(value["camera_from_lps"].clone()).expect("a pose") };
    let projection = |value: &Value| -> Projection { serde_json::from_value(value["projection"].clone()).expect("a projection") };
    let point = |bead: &Value| -> DVec3 { serde_json::from_value(bead["lps_mm"].clone()).expect("a point") };
    let beads: Vec<DVec3> = truth["beads"].as_array().expect("beads").iter().map(point).collect();
    let (found, p) = (camera(pose), projection(pose));
    let mut others = 0;
    for (told, exposure) in truth["frames"].as_array().expect("frames").iter().zip(1..) {
        let taken = camera(told);
        let deg = found.angle_to_rad(&taken).to_degrees();
        if exposure != counter {
            assert!(deg > ELSEWHERE_DEG, "the pose is {deg} degrees from that of exposure {exposure}: {pose:#}");
            others += 1;
            continue;
        }
        // The specimen's origin lies at the isocentre.
        let mm = found.transform_point(DVec3::ZERO).distance(taken.transform_point(DVec3::ZERO));
        assert!(mm < NEAR_MM && deg < NEAR_DEG, "{mm} mm and {deg} degrees off: {pose:#}");
        let truth = projection(told);
        let off = beads.iter().map(|bead| p.project(*bead).0.distance(truth.project(*bead).0)).fold(0.0, f64::max);
        assert!(beads.len() >= 6 && off < NEAR_PX, "P puts a bead {off} px from where it was: {pose:#}");
    }
    assert!(others >= 7, "{others} other exposures");
    // Beads of earlier frames agree with where telemetry has the specimen.
    assert!(!pair["flags"].to_string().contains("the pose is telemetry's alone"), "{pair:#}");
}

/// That each exposure says when it began and ended by the C-arm's own clock, and in which stretch of that: before both jumps, an hour ahead
/// between them, and after them. In the fifth the clock is set back.
fn is_told_by_the_arms_clock(frames: &[(Value, Value, u32)]) {
    const HOUR_US: i64 = 3_600_000_000;
    const STRETCHES: [[u32; 2]; 8] = [[0, 0], [0, 0], [1, 1], [1, 1], [1, 2], [2, 2], [2, 2], [2, 2]];
    let mut apart_us = Vec::new();
    for (_, pose, counter) in frames {
        let (exposure, stretches) = (&pose["binding"]["exposure"], STRETCHES[*counter as usize - 1]);
        assert_eq!(exposure["segment"], stretches[0], "exposure {counter}: {exposure:#}");
        for (end, key) in ["start_us", "end_us"].into_iter().enumerate() {
            let time_us = |value: &Value| value.as_i64().expect("a time");
            let ahead_us = if stretches[end] == 1 { HOUR_US } else { 0 };
            apart_us.push(time_us(&exposure["device_us"][end]) - ahead_us - time_us(&exposure[key]));
        }
    }
    let (least, most) = (apart_us.iter().min().expect("frames"), apart_us.iter().max().expect("frames"));
    assert!(most - least < 4 * TIME_US, "the arm's clock and the host's, apart from the jumps: {apart_us:?} µs");
}

/// Both devices are set to summer time and back again, the C-arm once while the beam is on. An hour is no silence, and what was exposed
/// before it is not an hour away.
#[test]
fn clocks_that_jump_by_an_hour_and_back_cost_no_frame_its_exposure() {
    let jumps = "carm:ahead@0.23,robot:ahead@0.25,carm:back@0.578,robot:back@0.62";
    let Some(lab) = Lab::start(&["--duration-s", "16", "--faults", jumps, "--await-all", "--idle-s", "300"]) else {
        return;
    };
    let lab = lab.without_ct();
    let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 8);
    let signal_us = live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    let words = format!("exit code {code:?}: {} {}", live.stdout(), live.stderr());

    for device in ["C-arm", "robot"] {
        for by in ["+3600.0", "-3600.0"] {
            assert!(words.contains(&format!("the {device}'s clock jumped by {by}")), "{device} {by}: {words}");
        }
    }
    let report = live.report();
    assert_eq!(["carm", "robot"].map(|device| steps_of(&report, device)), [Some(2); 2], "{words}");
    assert!(!words.contains("began anew") && !words.contains("nothing to be used"), "{words}");
    // A crowded machine may lose packets on the way to the line's reader, which is another matter, and said.
    let missing = live.heard().missing(&lab.sent(), live.recording_us, signal_us);
    assert_eq!(missing.lost, 0, "recording went on: {missing:?} {words}");

    let frames = told_frames(&live);
    assert!(frames.len() == 8, "{} frames: {words}", frames.len());
    is_told_by_the_arms_clock(&frames);
    for (pair, pose, counter) in &frames {
        assert!(pair["binding"] != "none", "{pair:#} {words}");
        has_its_own_exposure(&lab, pose, *counter);
        robot_is_right(pose, *counter);
        if pair["pose_source"] == "beads" {
            prior_is_right(pair);
        }
        if *counter == COLLIMATED {
            falls_back_to_telemetry(&lab, pair, pose, *counter);
        }
    }
}
