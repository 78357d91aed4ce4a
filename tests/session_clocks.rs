//! Device clocks that somebody sets in mid-session, through `live`.
#![cfg(unix)]

use crate::lab_truth::{has_its_own_exposure, prior_is_right, robot_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::session_silence::steps_of;

/// Both devices are set to summer time and back again, the C-arm once while the beam is on. An hour is no silence, and what was exposed
/// before it is not an hour away.
#[test]
fn clocks_that_jump_by_an_hour_and_back_cost_no_frame_its_exposure() {
    let jumps = "carm:ahead@0.23,robot:ahead@0.25,carm:back@0.578,robot:back@0.62";
    let Some(lab) = Lab::start(&["--duration-s", "20", "--faults", jumps, "--await-all", "--idle-s", "300"]) else {
        return;
    };
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
    for (pair, pose, counter) in &frames {
        assert!(pair["binding"] != "none", "{pair:#} {words}");
        has_its_own_exposure(&lab, pose, *counter);
        robot_is_right(pose, *counter);
        if pair["pose_source"] == "beads" {
            prior_is_right(pair);
        }
    }
}
