//! The mocked laboratory over its other wires, each through `live`: devices that print lines, frames that are stored over DICOM, shown on a
//! monitor, or recorded off it. What comes of them is held against what the mock knows.

use std::net::{Ipv4Addr, TcpListener};
use std::path::PathBuf;

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::acquire::read_frames;
use sidecarm::geometry::Projection;
use sidecarm::record::{read_log, topic};

use crate::lab_truth::{
    has_its_own_exposure, is_of_exposure, pairs, poses, prior_is_right, robot_is_right, told_frames, wait_for_pairs,
};
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::telemetry_lines::Heard;

/// P takes every bead to within so many pixels of where it was: of linear frames, and of what a monitor shows in 256 grey values.
const RIGHT_PX: f64 = 0.5;
#[cfg(feature = "vision")]
const SHOWN_PX: f64 = 1.5;
/// That of another exposure takes one of them farther off: the arm's stands are degrees apart.
const WRONG_PX: f64 = 20.0;
/// A picture comes from a monitor when the beam of 0.3 s is off, and within the time in which frames count as prompt.
#[cfg(feature = "vision")]
const SHOWN_AFTER_US: std::ops::Range<i64> = 300_000..6_000_000;

fn json_of(lab: &Lab, name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(lab.kit.join(name)).expect("readable")).expect("JSON")
}

/// The file that tells what was sent or shown.
fn exported(lab: &Lab, counter: u32) -> PathBuf {
    lab.kit.join(format!("exported/frame-{counter:03}.dcm"))
}

/// That P is that of this exposure, and of no other.
fn projection_is_right(lab: &Lab, pose: &Value, counter: u32, near_px: f64) {
    let truth = json_of(lab, "truth.json");
    let point = |bead: &Value| -> DVec3 { serde_json::from_value(bead["lps_mm"].clone()).expect("a point") };
    let projection = |value: &Value| -> Projection { serde_json::from_value(value["projection"].clone()).expect("a projection") };
    let beads: Vec<DVec3> = truth["beads"].as_array().expect("beads").iter().map(point).collect();
    let (found, frames) = (projection(pose), truth["frames"].as_array().expect("frames"));
    assert!(beads.len() >= 6 && frames.len() >= 3, "{} beads, {} frames", beads.len(), frames.len());
    for (told, exposure) in frames.iter().zip(1..) {
        let taken = projection(told);
        let off_px = beads.iter().map(|bead| found.project(*bead).0.distance(taken.project(*bead).0)).fold(0.0, f64::max);
        let is_right = if exposure == counter { off_px < near_px } else { off_px > WRONG_PX };
        assert!(is_right, "exposure {counter}: {off_px} px from where exposure {exposure} was taken: {pose:#}");
    }
}

/// Ends a session; what it said.
fn ended(live: &mut Live) -> String {
    live.signalled(Signal::INT);
    let status = live.program.end(HANG_S);
    let said = live.stdout() + &live.stderr();
    assert!(status.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{said}");
    said
}

/// The pairs in their order, each with its pose; their files are called `NAME-0001` and so on, as the exposures were made.
fn in_order(live: &Live, name: &str, said: &str) -> Vec<(Value, Value, u32)> {
    let (pairs, poses) = (pairs(live), poses(live));
    let told = |(pair, counter): (Value, u32)| {
        assert_eq!(pair["frame"], format!("{name}-{counter:04}"), "{said}");
        let pose = poses.iter().find(|pose| pose["number"] == pair["number"]).cloned();
        (pair, pose.unwrap_or_else(|| panic!("no pose of {name}-{counter:04}: {said}")), counter)
    };
    pairs.into_iter().zip(1..).map(told).collect()
}

/// The lines that `mocks/PROTOCOL.md` prints of a device, each in another format.
fn printed(device: &str) -> Vec<&'static str> {
    let section = include_str!("../mocks/PROTOCOL.md").split("## Lines in place of packets").nth(1).expect("a section");
    let block = section.split(device).nth(1).and_then(|rest| rest.split("```").nth(1)).expect("a block");
    block.trim().lines().collect()
}

fn near(found: f64, expected: f64, limit: f64) -> bool {
    (found - expected).abs() < limit
}

#[test]
fn lines_of_every_format_have_the_values_of_the_protocol_by_the_declarations_of_the_kit() {
    let formats = ["csv", "json", "words"];
    let [robots, carms] = ["Robot:", "C-arm:"].map(printed);
    assert_eq!([robots.len(), carms.len()], [formats.len(); 2]);
    for (at, format) in formats.into_iter().enumerate() {
        let lines = format!("carm:{format},robot:{format}");
        let Some(lab) = Lab::start_without_ct(&["--kit-only", "--exposures", "0", "--lines", &lines]) else { return };
        let heard = |name: &str, line: &str| Heard::of(&json_of(&lab, name), format!("{line}\n").as_bytes());
        let robot = heard("robot-lines.json", robots[at]).robot();
        assert_eq!((robot.device_us, robot.sequence, robot.status), (987_654_000, 1234, 0), "{format}");
        let sensed = robot.sensed_deg.expect("declared");
        for (found, expected) in sensed.iter().zip([1.125, 2.25, 0.5, -1.25, 0.0625]) {
            assert!(near(*found, expected, 1e-4), "{format}: {sensed:?}");
        }
        for (found, expected) in robot.commanded_deg.iter().zip([1.0, 2.0, 0.5, -1.0, 0.0]) {
            assert!(near(*found, expected, 1e-9), "{format}: {:?}", robot.commanded_deg);
        }
        let pulled = [robot.tendons[0].position_mm, robot.tendons[1].position_mm];
        assert!(near(pulled[0], 3.5, 1e-9) && near(pulled[1], -3.5, 1e-9) && near(robot.drill_rpm, 8000.0, 0.05), "{robot:?}");

        let carms = heard("carm-lines.json", carms[at]).carms();
        let [carm] = &carms[..] else { panic!("{format}: {} samples", carms.len()) };
        // 28 turns of a clock of 32 bits ago.
        assert_eq!((carm.device_us, carm.sequence, carm.status), (3_197_704_724, 77, 0), "{format}");
        assert!(carm.xray_on && carm.exposure_counter == Some(17), "{format}: {carm:?}");
        let joints = carm.joints;
        let lengths = [joints.lift_mm, joints.longitudinal_mm, joints.source_to_detector_mm];
        let angles = [joints.wig_wag_rad, joints.angulation_rad, joints.orbital_rad].map(f64::to_degrees);
        let beam = [carm.tube_kvp, carm.tube_ma, carm.pulse_width_ms, carm.filter_mm_al, carm.filter_mm_cu];
        let found = [&lengths[..], &angles, &beam, &carm.field_mm].concat();
        let expected = [120.5, 40.0, 1020.0, -3.25, 12.5, -30.25, 74.0, 3.5, 8.0, 4.5, 0.25, -120.0, -93.0, 120.0, 93.0];
        assert_eq!(found.len(), expected.len());
        let is_near = found.iter().zip(expected).all(|(found, expected)| near(*found, expected, 1e-4));
        assert!(is_near && joints.detector_rotation_rad.is_nan(), "{format}: {carm:?}");
    }
}

/// The arm prints words on a pseudo-terminal, the robot's program writes objects into a file; one of these loses its end.
#[test]
fn devices_that_print_lines_say_where_they_stood_and_what_was_lost() {
    let args = ["--lines", "carm:words,robot:json", "--tail", "robot", "--duration-s", "12", "--exposures", "3"];
    let more = ["--faults", "robot:tear@0.24", "--await-all", "--idle-s", "300"];
    let Some(lab) = Lab::start_without_ct(&[&args[..], &more].concat()) else { return };
    let session = lab.kit.join("session.json");
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 3);
    let said = ended(&mut live);
    assert!(said.contains("robot: 2 lines lost on the line, 1 corrupt lines") && said.contains("no JSON object"), "{said}");

    let frames = told_frames(&live);
    assert_eq!(frames.len(), 3, "{said}");
    for (pair, pose, counter) in &frames {
        assert_eq!((&pair["binding"], &pair["pose_source"]), (&json!("counter"), &json!("beads")), "{pair:#} {said}");
        has_its_own_exposure(&lab, pose, *counter);
        robot_is_right(pose, *counter);
        prior_is_right(pair);
        projection_is_right(&lab, pose, *counter, RIGHT_PX);
    }
    // Of the robot's samples two are missing, one after the other: the torn line, and the one that it ran into.
    let log = read_log(&live.log).expect("a log");
    let robots = log.entries.iter().filter(|entry| &*entry.topic == topic::ROBOT_JOINTS);
    let numbers: Vec<u64> =
        robots.map(|entry| entry.json::<Value>().expect("JSON")["sequence"].as_u64().expect("a number")).collect();
    let steps: Vec<u64> = numbers.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step != 1).collect();
    assert!(numbers.len() > 300 && steps == [3], "{} samples, {steps:?}: {said}", numbers.len());
}

#[test]
fn frames_that_a_console_stores_are_bound_by_their_number_and_posed() {
    let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).and_then(|listener| listener.local_addr()).expect("a free port");
    let port = free.port().to_string();
    let args = ["--dicom", &port, "--duration-s", "12", "--exposures", "3", "--faults", "none", "--await-all", "--idle-s", "300"];
    let Some(lab) = Lab::start_without_ct(&args) else { return };
    let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 3);
    let said = ended(&mut live);
    assert!(!said.contains("half a DICOM object") && !said.contains("came over DICOM that had come before"), "{said}");
    let frames = in_order(&live, "dicom", &said);
    assert_eq!(frames.len(), 3, "{said}");
    for (pair, pose, counter) in &frames {
        assert_eq!((&pair["binding"], &pair["pose_source"]), (&json!("counter"), &json!("beads")), "{pair:#} {said}");
        is_of_exposure(&exported(&lab, *counter), pose, *counter);
        robot_is_right(pose, *counter);
        prior_is_right(pair);
        projection_is_right(&lab, pose, *counter, RIGHT_PX);
        let [sent, kept] = [exported(&lab, *counter), lab.frames().join(format!("dicom-{counter:04}.dcm"))]
            .map(|file| read_frames(&file, None).expect("a frame").remove(0).pixels);
        assert!(sent.same_size(&kept) && sent.pixels == kept.pixels, "exposure {counter}: every pixel as it was sent");
    }
}

/// How many of the frames have an accepted pose, each of these that of its exposure.
#[cfg(feature = "vision")]
fn accepted(lab: &Lab, frames: &[(Value, Value, u32)]) -> usize {
    let is_accepted = |pose: &Value| pose["pose"]["status"] == "accepted";
    let posed = frames.iter().filter(|(_, pose, _)| is_accepted(pose));
    posed.inspect(|(_, pose, counter)| projection_is_right(lab, pose, *counter, SHOWN_PX)).count()
}

#[cfg(feature = "vision")]
#[test]
fn frames_that_a_monitor_shows_are_posed_and_bound_to_none_but_their_exposures() {
    let args = ["--video", "monitor", "--duration-s", "16", "--exposures", "4", "--faults", "none", "--await-all"];
    let Some(lab) = Lab::start_without_ct(&[&args[..], &["--idle-s", "300"]].concat()) else { return };
    let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 4);
    let said = ended(&mut live);
    assert!(said.contains("video of 720 x 480"), "{said}");
    let frames = in_order(&live, "video", &said);
    assert_eq!(frames.len(), 4, "{said}");
    for (pair, pose, counter) in &frames {
        // A monitor tells the time of a picture and no number: of exposures that follow within seconds it may not tell which. Then the time
        // is still right, and nothing is taken from telemetry.
        if pair["binding"] == "none" {
            let late_us = pair["time_us"].as_i64().map(|us| us - crate::lab_truth::began_us(&exported(&lab, *counter)));
            assert!(late_us.is_some_and(|us| SHOWN_AFTER_US.contains(&us)), "exposure {counter}, {late_us:?}: {pair:#} {said}");
            assert_ne!(pair["pose_source"], "telemetry", "{pair:#} {said}");
            continue;
        }
        assert_eq!(pair["binding"], "time", "{pair:#} {said}");
        is_of_exposure(&exported(&lab, *counter), pose, *counter);
        robot_is_right(pose, *counter);
    }
    assert!(accepted(&lab, &frames) >= 3, "{said}");
}

/// No device is there: K is that of the C-arm's calibration, and P that of the beads alone.
#[cfg(feature = "vision")]
#[test]
fn frames_of_a_recording_are_posed_by_their_beads() {
    let args = ["--video", "recording", "--kit-only", "--duration-s", "8", "--exposures", "4", "--no-robot"];
    let Some(lab) = Lab::start_without_ct(&args) else { return };
    let mut live = Live::launch(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 4);
    let said = ended(&mut live);
    let frames = in_order(&live, "video", &said);
    assert_eq!(frames.len(), 4, "{said}");
    for (pair, pose, counter) in &frames {
        let of_beads = pair["pose_source"] == "beads" || pose["pose"]["status"] == "refused";
        assert!(of_beads && pair["binding"] == "none", "exposure {counter}: {pair:#} {said}");
    }
    assert!(accepted(&lab, &frames) >= 3, "{said}");
}
