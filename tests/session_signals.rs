//! Ctrl-C once, twice, SIGTERM, SIGHUP: heard whatever is under way, the log complete, and the session ends in order.
#![cfg(unix)]

use std::time::Duration;

use crate::live_lab::{HANG_S, Live, Signal, copies, deliver, eventually, many_images, quiet_lab};

/// Forty images in one file are being registered. Ctrl-C is heard before they are, and the telemetry is complete up to then; a second
/// Ctrl-C leaves without them. (It was 219 of 504 packets, and Ctrl-C took 89 s.)
#[test]
fn a_second_interrupt_leaves_at_once_and_nothing_recorded_is_lost() {
    let Some((lab, frame, folder)) = quiet_lab("40") else { return };
    let file = folder.path().join("run.dcm");
    many_images(&frame, 40, &file);
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    deliver(&[file], &lab);
    std::thread::sleep(Duration::from_secs(3));
    let first_us = live.signalled(Signal::INT);
    let unfinished = "Ctrl-C again leaves at once";
    let told = eventually(HANG_S, || (live.stderr().contains(unfinished) || live.program.end(0.0).is_some()).then_some(()));
    assert!(
        told.is_some() && live.stderr().contains(unfinished),
        "it was heard before the images were finished: {}",
        live.stderr()
    );
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S);
    let words = live.stderr();
    assert!(status.is_some(), "still there: {words}");
    assert!(!words.contains("panicked"), "{words}");
    let heard = live.heard();
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "the log has its end: {:?}", heard.losses);
    assert!(matches!(status.and_then(|status| status.code()), Some(3)), "what was not finished is said: {status:?} {words}");
    let missing = heard.missing(&lab.sent(), live.recording_us, first_us);
    println!("{} images in the log; telemetry {missing:?}", heard.images);
    assert_eq!(missing.lost, 0, "{missing:?}");
    assert!(missing.sent > 300, "{missing:?}");
}

/// One Ctrl-C, SIGTERM, SIGHUP: the same end, with a report, everything in the log and the pairs that were begun.
#[test]
fn every_signal_ends_the_session_in_order() {
    let mut cases = 0;
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        // A lab of its own: what an earlier reader left in the line's buffer is lost, and would be said.
        let Some((lab, frame, folder)) = quiet_lab("60") else { return };
        let name = format!("{cases}");
        let files = copies(&frame, 2, &folder.path().join(format!("copies-{name}")));
        let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join(&name), &[]);
        deliver(&files, &lab);
        std::thread::sleep(Duration::from_millis(1_500));
        let signal_us = live.signalled(signal);
        let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("{signal:?}: still there: {}", live.stderr()));
        let words = live.stderr();
        assert_eq!(status.code(), Some(0), "{signal:?}: {words} {}", live.stdout());
        assert!(live.report().contains("</html>"), "{signal:?}: no report");
        let heard = live.heard();
        assert!(heard.end_us.is_some_and(|end_us| end_us >= signal_us), "{signal:?}: no end");
        assert!(heard.losses.is_empty(), "{signal:?}: {:?}", heard.losses);
        let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
        assert_eq!(missing.lost, 0, "{signal:?}: {missing:?}");
        assert_eq!(heard.frames.len(), 2, "{signal:?}: frames");
        assert_eq!(live.pairs(), 2, "{signal:?}: {words}");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

/// Ctrl-C was heard while the scene was loaded, and the session began all the same; so was the second one.
#[cfg(target_os = "linux")]
#[test]
fn an_interrupt_while_the_scene_is_loaded_ends_the_program() {
    let Some((lab, _, folder)) = quiet_lab("60") else { return };
    let slow = lab.kit.join("slow.nii.gz");
    nothing_but_air(&slow, [512, 512, 500]);
    let text = std::fs::read_to_string(lab.kit.join("scene.json")).expect("the scene");
    std::fs::write(lab.kit.join("slow.json"), text.replace("ct.nii.gz", "slow.nii.gz")).expect("written");
    let session = lab.session("session-slow.json", |session| session["scene"] = "slow.json".into());
    let mut live = Live::launch(&session, &folder.path().join("session"), &[]);
    let catches = || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", live.program.id())).unwrap_or_default();
        let caught = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigCgt:")?.trim(), 16).ok());
        caught.is_some_and(|mask| mask & (1 << (Signal::INT.as_raw() - 1)) != 0).then_some(())
    };
    assert!(eventually(HANG_S, catches).is_some(), "it listens: {}", live.stderr());
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stderr();
    assert!(status.code() == Some(1) && words.contains("ended before the session began"), "{status:?} {words}");
    assert!(!live.log.exists(), "nothing was recorded");
}

/// A volume of air alone, which takes seconds to load.
#[cfg(target_os = "linux")]
fn nothing_but_air(path: &std::path::Path, size: [i16; 3]) {
    use std::io::Write;
    let mut header = vec![0u8; 352];
    header[..4].copy_from_slice(&348i32.to_le_bytes());
    for (n, extent) in [3, size[0], size[1], size[2], 1, 1, 1, 1].into_iter().enumerate() {
        header[40 + 2 * n..42 + 2 * n].copy_from_slice(&extent.to_le_bytes());
    }
    // int16, 16 bits.
    header[70..72].copy_from_slice(&4i16.to_le_bytes());
    header[72..74].copy_from_slice(&16i16.to_le_bytes());
    (0..4).for_each(|n| header[76 + 4 * n..80 + 4 * n].copy_from_slice(&1f32.to_le_bytes()));
    header[108..112].copy_from_slice(&352f32.to_le_bytes());
    // One slope, the sform in scanner coordinates, millimetres.
    header[112..116].copy_from_slice(&1f32.to_le_bytes());
    header[123] = 2;
    header[254..256].copy_from_slice(&1i16.to_le_bytes());
    for row in 0..3 {
        header[280 + 20 * row..284 + 20 * row].copy_from_slice(&1f32.to_le_bytes());
    }
    header[344..348].copy_from_slice(b"n+1\0");
    let mut packed = flate2::write::GzEncoder::new(std::fs::File::create(path).expect("created"), flate2::Compression::fast());
    packed.write_all(&header).expect("written");
    let slice: Vec<u8> =
        (0..usize::from(size[0] as u16) * usize::from(size[1] as u16)).flat_map(|_| (-1000i16).to_le_bytes()).collect();
    (0..size[2]).for_each(|_| packed.write_all(&slice).expect("written"));
    packed.finish().expect("written");
}

/// `count` frames at once, then Ctrl-C: telemetry is complete whatever the workshop does. Gives images in the log and the words.
fn burst(count: usize, record_s: f64) {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let files = copies(&frame, count, &folder.path().join("copies"));
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    deliver(&files, &lab);
    std::thread::sleep(Duration::from_secs_f64(record_s));
    let signal_us = live.signalled(Signal::INT);
    std::thread::sleep(Duration::from_millis(500));
    if live.program.end(0.0).is_none() {
        live.program.signal(Signal::INT);
    }
    let ended = live.program.end(HANG_S);
    let heard = live.heard();
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    let pairs = live.pairs();
    println!(
        "{count} frames delivered at once, {record_s} s of session: {} of {} packets lost, {} frames in the log, {pairs} pairs",
        missing.lost, missing.sent, heard.images
    );
    assert!(ended.is_some(), "{}", live.stderr());
    assert_eq!(missing.lost, 0, "{missing:?}");
    assert!(missing.sent as f64 > 80.0 * record_s, "{missing:?}");
}

#[test]
#[ignore = "minutes long: scripts/evaluate burst runs it"]
fn bursts_of_frames_leave_the_telemetry_alone() {
    burst(200, 40.0);
    burst(500, 60.0);
}
