//! Lines that are away for long while frames go on coming, through `live`: nothing of before stands for what nobody heard.
#![cfg(unix)]

use std::path::PathBuf;

use sidecarm::telemetry::DeviceKind;

use crate::lab_truth::{began_us, file_of, has_its_own_exposure, prior_is_right, robot_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

const DURATION_S: f64 = 30.0;
/// Much longer than telemetry may be old, and long enough to be said while it lasts.
const AWAY_S: f64 = 5.0;
const HOUR_S: f64 = 3_600.0;
/// Packets by which the count may be larger: what was on the way when the plug was pulled, and what a crowded machine lost.
const SLACK: f64 = 300.0;

/// Samples per second; and once a second a device tells of itself.
fn samples_per_s(device: DeviceKind) -> f64 {
    if device == DeviceKind::Carm { 30.0 } else { 100.0 }
}

/// The most that a device sends while its line is away.
fn sent_meanwhile(device: DeviceKind) -> f64 {
    AWAY_S * (samples_per_s(device) + 1.0) + SLACK
}

/// Of the session, when each plug is pulled: two exposures fall into either time.
const PULLED: [(DeviceKind, f64, [u32; 2]); 2] = [(DeviceKind::Carm, 0.25, [3, 4]), (DeviceKind::Robot, 0.62, [6, 7])];

/// What a line's path leads to.
fn behind(lab: &Lab, device: DeviceKind) -> Option<PathBuf> {
    std::fs::read_link(lab.kit.join(if device == DeviceKind::Carm { "ttyCARM" } else { "ttyROBOT" })).ok()
}

/// First the C-arm's plug, then the robot's; both come back as another terminal behind the same path.
#[test]
fn frames_that_come_while_a_line_is_away_have_nothing_of_it_and_those_after_have_all() {
    for (device, missed) in played("unplug").into_iter().flatten() {
        let most = sent_meanwhile(device);
        assert!(missed <= most, "the {device} missed {missed} packets, at most {most} were sent meanwhile");
    }
}

/// The same where an hour has passed by the device, whose clock gained 200 ppm: what it counted meanwhile is missed and said, it is not taken for
/// one that began anew, and nothing of before stands for what comes after.
#[test]
fn a_line_that_was_away_for_an_hour_by_its_own_clock_and_count_goes_on() {
    for (device, missed) in played("away").into_iter().flatten() {
        let least = HOUR_S * samples_per_s(device);
        let most = least + sent_meanwhile(device);
        assert!(
            (least..=most).contains(&missed),
            "the {device} missed {missed} packets, {least} to {most} were counted meanwhile"
        );
    }
}

/// Plays a session in which each line has `fault` for a while; gives how many packets of each are said to be missed. `None` (said) where mock-lab
/// was not built.
fn played(fault: &str) -> Option<[(DeviceKind, f64); 2]> {
    let faults = PULLED.map(|(device, at, _)| format!("{}:{fault}@{at}", device.key())).join(",");
    let (duration_s, away_s) = (DURATION_S.to_string(), AWAY_S.to_string());
    let lab = ["--duration-s", &duration_s, "--faults", &faults, "--unplugged-s", &away_s, "--await-all", "--idle-s", "300"];
    let lab = Lab::start(&lab)?.without_ct();
    let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    for (device, ..) in PULLED {
        let gone = eventually(HANG_S, || behind(&lab, device).is_none().then_some(()));
        assert!(gone.is_some(), "the mock pulls the {device}'s plug");
        // Said while something can be done, and not only in the report.
        let silent = format!("nothing to be used from the {device} for 3 s");
        let said = eventually(HANG_S, || (live.stderr().contains(&silent) || behind(&lab, device).is_some()).then_some(()));
        assert!(said.is_some() && live.stderr().contains(&silent), "{device}: {}", live.stderr());
        assert!(eventually(HANG_S, || behind(&lab, device)).is_some(), "it comes back");
    }
    wait_for_pairs(&live, 8);
    live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    let (words, report) = (format!("exit code {code:?}: {} {}", live.stdout(), live.stderr()), live.report());

    assert_eq!(code, Some(3), "{words}");
    let missed = PULLED.map(|(device, ..)| (device, missed(&words, device)));
    assert!(!words.contains("began anew"), "neither device did: {words}");
    for (device, ..) in PULLED {
        assert!(report.contains(&format!("{device}: silent for")), "the report says what it cost: {words}");
    }
    // Both lines go on after their silence.
    let heard = live.heard();
    for (device, ..) in PULLED {
        let at_us: Vec<i64> = heard.packets.iter().filter(|((of, _), _)| *of == device).map(|(_, at_us)| *at_us).collect();
        let pauses_us: Vec<i64> = at_us.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let longest = (0..pauses_us.len()).max_by_key(|at| pauses_us[*at]).expect("packets");
        let (before, after) = (longest + 1, at_us.len() - longest - 1);
        assert!(pauses_us[longest] as f64 > 1e6 * (AWAY_S - 0.5), "{device}: its longest silence is {} µs", pauses_us[longest]);
        assert!(before > 100 && after > 100, "{device}: {before} packets before its silence, {after} after");
    }

    let frames = told_frames(&live);
    assert!(frames.len() == 8, "{} frames: {words}", frames.len());
    let [(.., without_arm), (.., without_robot)] = PULLED;
    for (pair, pose, counter) in &frames {
        // All of them show their beads but the seventh, which is collimated: that the arm is not heard costs no pose.
        assert!(*counter == 7 || pair["pose_source"] == "beads", "{pair:#}");
        if without_arm.contains(counter) {
            assert!(pair["innovation"].is_null(), "no prior without joints: {pair:#}");
            assert!(pose["binding"]["exposure"]["joints"].is_null(), "joints of another time: {pose:#}");
            // The console's stamp says when it was; without that a robot that moved meanwhile is drawn as in the scene.
            let off_us = pose["binding"]["time_us"].as_i64().expect("a time") - began_us(&file_of(&lab, *counter)) - 150_000;
            // Half of what is left open by a clock known from a few frames and the scatter of stamps.
            assert!(off_us.abs() < 600_000, "exposure {counter}: {off_us} µs off: {pose:#}");
            if !pose["control_angles_deg"].is_null() {
                robot_is_right(pose, *counter);
            }
            continue;
        }
        has_its_own_exposure(&lab, pose, *counter);
        if pair["pose_source"] == "beads" {
            prior_is_right(pair);
        }
        if without_robot.contains(counter) {
            assert!(pair["robot_source"] == "scene" && pose["control_angles_deg"].is_null(), "a shape of another time: {pair:#}");
            let said = format!("(frame-{counter:03}): robot drawn as in the scene file: no telemetry covers the exposure");
            assert!(words.contains(&said), "'{said}' is not in {words}");
        } else {
            robot_is_right(pose, *counter);
            assert_eq!(pair["robot_source"], "sensed", "{pair:#}");
        }
    }
    Some(missed)
}

/// What a session says in the end that it missed of a device.
fn missed(words: &str, device: DeviceKind) -> f64 {
    let said = format!("lost: {device}: ");
    let before = |line: &'_ str| {
        Some(line.strip_prefix(said.as_str())?.split_once(" packets missed while it was unplugged")?.0.to_owned())
    };
    let number = words.lines().find_map(before).and_then(|before| before.rsplit(' ').next()?.parse().ok());
    number.unwrap_or_else(|| panic!("what the {device} said meanwhile is missed: {words}"))
}
