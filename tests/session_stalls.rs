//! Lines that stall, through `live`: what a device or an adapter held back comes at once, and nothing of it is lost or moved in time.
#![cfg(unix)]

use sidecarm::telemetry::DeviceKind;

use crate::lab_truth::{has_its_own_exposure, prior_is_right, robot_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Sent, Signal};
use crate::session_silence::steps_of;

/// A pause on a line that nobody but a stall makes at these rates.
const STALL_US: i64 = 60_000;

/// How often each device held its packets back, and whether numbers are missing in what left it: the line did not take all of it.
fn stalls(sent: &[Sent], device: DeviceKind) -> (usize, bool) {
    let sent: Vec<&Sent> = sent.iter().filter(|packet| packet.device == device).collect();
    let pauses = sent.windows(2).filter(|pair| pair[1].host_us - pair[0].host_us >= STALL_US).count();
    (pauses, sent.windows(2).any(|pair| pair[1].sequence != pair[0].sequence + 1))
}

/// Five per cent of the time, a tenth of a second at a time. Arrival says little of when a sample was measured: its own clock does.
#[test]
fn stalls_of_a_twentieth_of_the_time_lose_and_move_nothing() {
    // A pseudo-terminal holds so much: on a machine that gives its reader no core for long, packets never get into the line.
    for attempt in 1..=3 {
        let lab =
            ["--duration-s", "16", "--faults", "none", "--stalled", "0.05", "--seed", "7", "--await-all", "--idle-s", "300"];
        let Some(lab) = Lab::start(&lab) else { return };
        let lab = lab.without_ct();
        let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
        wait_for_pairs(&live, 8);
        let signal_us = live.signalled(Signal::INT);
        let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
        let (words, report, sent) = (format!("{} {}", live.stdout(), live.stderr()), live.report(), lab.sent());

        let stalled = DeviceKind::ALL.map(|device| stalls(&sent, device));
        let missing = live.heard().missing(&sent, live.recording_us, signal_us);
        // With this seed the C-arm's fourth comes after 13 s, before the last exposure.
        assert!(stalled.iter().all(|(pauses, _)| *pauses >= 4), "{stalled:?}");
        assert!(missing.sent > 1500 && missing.lost == 0, "{missing:?} {words}");
        check_frames(&lab, &live);
        assert_eq!(["carm", "robot"].map(|device| steps_of(&report, device)), [Some(0); 2], "a stall is no step: {words}");
        for never in ["clock jumped", "began anew", "nothing to be used", "stands still"] {
            assert!(!words.contains(never), "'{never}': {words}");
        }
        if stalled.iter().all(|(_, torn)| !torn) {
            assert!(code == Some(0) && !words.contains("lost:"), "exit code {code:?}: {words}");
            assert!(report.to_lowercase().contains("nothing was lost"), "{words}");
            return;
        }
        assert!(attempt < 3, "the machine is too crowded for the line: {stalled:?} {words}");
    }
}

fn check_frames(lab: &Lab, live: &Live) {
    let frames = told_frames(live);
    assert!(frames.len() == 8, "{} frames: {}", frames.len(), live.stderr());
    for (pair, pose, counter) in &frames {
        assert!(pair["binding"] != "none", "{pair:#}");
        has_its_own_exposure(lab, pose, *counter);
        robot_is_right(pose, *counter);
        let gap_us = pair["gap_us"].as_i64().unwrap_or_else(|| panic!("{pair:#}"));
        assert!(gap_us < STALL_US, "no gap of telemetry where it only came late: {gap_us} µs");
        if pair["pose_source"] == "beads" {
            prior_is_right(pair);
        }
    }
}
