//! Ctrl-C once, twice, SIGTERM, SIGHUP: heard at once, the log complete, and the session ends in order.
#![cfg(unix)]

use std::path::PathBuf;
use std::time::Duration;

use sidecarm::time::{Stopwatch, host_now_us};

use crate::live_lab::{Lab, Live, Signal, copies, eventually, many_images};

/// A signal is heard within this.
const HEARD_MS: f64 = 100.0;

/// A lab without exposures of its own, a frame of another lab to deliver, and an empty folder.
fn quiet_lab(seconds: &str) -> Option<(Lab, PathBuf, tempfile::TempDir)> {
    let folder = tempfile::tempdir().expect("temporary folder");
    let frame = folder.path().join("frame.dcm");
    {
        let kit = Lab::start(&["--kit-only", "--exposures", "1"])?;
        let made = eventually(60.0, || std::fs::read_dir(kit.frames()).ok()?.flatten().next()).expect("a frame");
        std::thread::sleep(Duration::from_millis(200));
        std::fs::copy(made.path(), &frame).expect("copied");
    }
    let lab = Lab::start(&["--duration-s", seconds, "--faults", "none", "--exposures", "0", "--linger-s", "30"])?;
    Some((lab, frame, folder))
}

fn deliver(files: &[PathBuf], lab: &Lab) {
    for file in files {
        let name = file.file_name().expect("a name");
        let staged = lab.kit.join(name);
        std::fs::copy(file, &staged).expect("copied");
        std::fs::rename(staged, lab.frames().join(name)).expect("renamed");
    }
}

/// Forty images in one file are being registered. Ctrl-C is heard at once and the telemetry is complete up to then; a second Ctrl-C
/// leaves at once. (It was 219 of 504 packets, and Ctrl-C took 89 s.)
#[test]
fn a_second_interrupt_leaves_at_once_and_nothing_recorded_is_lost() {
    let Some((lab, frame, folder)) = quiet_lab("40") else { return };
    let file = folder.path().join("run.dcm");
    many_images(&frame, 40, &file);
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    deliver(&[file], &lab);
    std::thread::sleep(Duration::from_secs(3));
    let first_us = host_now_us();
    live.program.signal(Signal::INT);
    let heard_end = eventually(5.0, || live.heard().end_us);
    std::thread::sleep(Duration::from_millis(300));
    let left = Stopwatch::start();
    if live.program.end(0.0).is_none() {
        live.program.signal(Signal::INT);
    }
    let status = live.program.end(20.0);
    let words = live.stderr();
    assert!(status.is_some() && left.ms() < 2_000.0, "left {:.0} ms after the second Ctrl-C: {words}", left.ms());
    assert!(!words.contains("panicked"), "{words}");
    let heard = live.heard();
    let end_us = heard_end.unwrap_or_else(|| panic!("the log has no end five seconds after Ctrl-C: {words}"));
    let heard_ms = (end_us - first_us) as f64 * 1e-3;
    let missing = heard.missing(&lab.sent(), live.recording_us, first_us);
    println!("heard after {heard_ms:.0} ms; {} images in the log; telemetry {missing:?}", heard.images);
    assert!(heard_ms <= HEARD_MS, "heard after {heard_ms:.0} ms");
    assert_eq!(missing.lost, 0, "{missing:?}");
    assert!(missing.sent > 300, "{missing:?}");
}

/// One Ctrl-C, SIGTERM, SIGHUP: the same end, with a report, everything in the log and the pairs that were begun.
#[test]
fn every_signal_ends_the_session_in_order() {
    let Some((lab, frame, folder)) = quiet_lab("60") else { return };
    let mut cases = 0;
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        let name = format!("{cases}");
        let files = copies(&frame, 2, &folder.path().join(format!("copies-{name}")));
        let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join(&name), &[]);
        deliver(&files, &lab);
        std::thread::sleep(Duration::from_millis(1_500));
        let signal_us = host_now_us();
        live.program.signal(signal);
        let status =
            live.program.end(60.0).unwrap_or_else(|| panic!("{signal:?}: still there after a minute: {}", live.stderr()));
        let words = live.stderr();
        assert_eq!(status.code(), Some(0), "{signal:?}: {words} {}", live.stdout());
        assert!(live.report().contains("</html>"), "{signal:?}: no report");
        let heard = live.heard();
        let end_us = heard.end_us.unwrap_or_else(|| panic!("{signal:?}: no end"));
        let heard_ms = (end_us - signal_us) as f64 * 1e-3;
        assert!(heard_ms <= HEARD_MS, "{signal:?} was heard after {heard_ms:.0} ms");
        assert!(heard.losses.is_empty(), "{signal:?}: {:?}", heard.losses);
        assert_eq!(heard.missing(&lab.sent(), live.recording_us, signal_us).lost, 0, "{signal:?}");
        assert_eq!(heard.frames.len(), 2, "{signal:?}: frames");
        let pairs = std::fs::read_to_string(live.out.join("pairs.json")).expect("pairs");
        assert_eq!(pairs.matches("\"status\"").count(), 2, "{signal:?}: {pairs}");
        for file in std::fs::read_dir(lab.frames()).expect("folder").flatten() {
            std::fs::remove_file(file.path()).expect("removed");
        }
        cases += 1;
    }
    assert_eq!(cases, 3);
}

/// `count` frames at once, then Ctrl-C: telemetry is complete whatever the workshop does. Gives images in the log and the words.
fn burst(count: usize, record_s: f64) {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let files = copies(&frame, count, &folder.path().join("copies"));
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    let watch = Stopwatch::start();
    deliver(&files, &lab);
    let delivered_ms = watch.ms();
    std::thread::sleep(Duration::from_secs_f64(record_s));
    let signal_us = host_now_us();
    live.program.signal(Signal::INT);
    let end_us = eventually(10.0, || live.heard().end_us);
    std::thread::sleep(Duration::from_millis(500));
    if live.program.end(0.0).is_none() {
        live.program.signal(Signal::INT);
    }
    let ended = live.program.end(20.0);
    let heard = live.heard();
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    let pairs = std::fs::read_to_string(live.out.join("pairs.json")).unwrap_or_default().matches("\"status\"").count();
    println!(
        "{count} frames delivered within {delivered_ms:.0} ms, {record_s} s of session: {} of {} packets lost, {} frames in the log, {pairs} \
         pairs; Ctrl-C heard after {} ms",
        missing.lost,
        missing.sent,
        heard.images,
        end_us.map_or(f64::NAN, |us| (us - signal_us) as f64 * 1e-3)
    );
    assert!(ended.is_some(), "{}", live.stderr());
    assert_eq!(missing.lost, 0, "{missing:?}");
    assert!(missing.sent as f64 > 80.0 * record_s, "{missing:?}");
    assert!(end_us.is_some_and(|us| (us - signal_us) as f64 * 1e-3 <= HEARD_MS), "Ctrl-C");
}

#[test]
#[ignore = "minutes long: scripts/evaluate burst runs it"]
fn bursts_of_frames_leave_the_telemetry_alone() {
    burst(200, 40.0);
    burst(500, 60.0);
}
