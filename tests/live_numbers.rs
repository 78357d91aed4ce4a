//! The same numbers through `live` on a pseudo-terminal, and through the replay of its log.
#![cfg(unix)]

use std::io::Write;
use std::process::Command;
use std::time::Duration;

use serialport::{SerialPort, TTYPort};

use crate::live_lab::{HANG_S, Lab, Live, eventually};
use crate::telemetry_frames::carm;

/// It was `attempt to multiply with overflow`, live and in every replay of the log.
#[test]
fn a_device_whose_clock_leaps_centuries_ends_neither_live_nor_replay() {
    let Some(lab) = Lab::start_without_ct(&["--kit-only"]) else { return };
    let (mut device, mut line) = TTYPort::pair().expect("pseudo-terminals are there");
    line.set_exclusive(false).expect("the line can be shared");
    let port = line.name().expect("the line has a path");
    // An open line is locked.
    drop(line);
    let session = lab.session("leaping.json", |session| {
        session["carm"]["port"] = port.into();
        if let Some(session) = session.as_object_mut() {
            session.remove("robot");
        }
    });
    let out = lab.kit.with_file_name("session");
    let mut live = Live::launch(&session, &out, &["--seconds", "6"]);
    let opened = eventually(HANG_S, || live.log.exists().then_some(()));
    assert!(opened.is_some(), "{}", live.stderr());
    std::thread::sleep(Duration::from_millis(500));
    let joints = [0.0, 0.0, 0.0, 0.0, 10.0, 0.0, 1020.0];
    let mut sent = 0;
    let steps = (0..8u32).map(|i| (i, u64::from(i) << 57));
    let edges = (0..8u32).map(|i| (20 + i, u64::from(i) << 49));
    let after_gaps = (0..60u32).map(|i| (9_000 + i, (1 << 52) + u64::from(i) * 33_333));
    for (sequence, device_us) in steps.chain(edges).chain(after_gaps) {
        device.write_all(&carm(sequence, device_us, joints, sequence % 16 > 7, Some(sequence / 16))).expect("the line takes it");
        std::thread::sleep(Duration::from_millis(10));
        sent += 1;
    }
    assert_eq!(sent, 76);
    let status = live.program.end(HANG_S).expect("live ends");
    assert!(!live.stderr().contains("panicked"), "{}", live.stderr());
    assert!(matches!(status.code(), Some(0 | 3)), "{status}: {}", live.stderr());
    let heard = live.heard();
    assert!(heard.packets.len() >= 70 && heard.end_us.is_some(), "{} packets in the log: {}", heard.packets.len(), live.stderr());
    let replayed = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(["replay", &live.log.display().to_string(), "--out", &out.with_file_name("again").display().to_string()])
        .output()
        .expect("the program starts");
    let words = String::from_utf8_lossy(&replayed.stderr);
    assert!(matches!(replayed.status.code(), Some(0 | 3)) && !words.contains("panicked"), "{}: {words}", replayed.status);
}
