//! What a session says at its end on a terminal, where a bar can say how far it is. Registration is slow because it is asked to
//! (`src/session/fault.rs`, which only a build with debug assertions hears).
#![cfg(all(unix, debug_assertions))]

use std::fs::File;
use std::io::{ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use serialport::{SerialPort, TTYPort};
use sidecarm::record::{read_log, topic};

use crate::live_lab::{HANG_S, Running, Signal, copies, deliver, eventually, quiet_lab};

const FRAMES: usize = 3;

/// The bar was there, and above it a line for each of its steps. (That lines come where nobody sees a bar is what `session_said` holds.)
#[test]
fn at_the_end_a_terminal_shows_a_bar_and_no_lines_that_count_beside_it() {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, FRAMES, &folder.path().join("copies"));
    let out = folder.path().join("session");
    let (mut ours, mut theirs) = TTYPort::pair().expect("a pseudo-terminal");
    theirs.set_exclusive(false).expect("it can be shared");
    // It is the program's, and not that of whoever runs the tests.
    let flags = rustix::fs::OFlags::NOCTTY.bits() as i32;
    let terminal = File::options().read(true).write(true).custom_flags(flags).open(theirs.name().expect("a path"));
    let terminal = terminal.expect("it opens");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("live").arg(lab.kit.join("session.json")).arg("--out").arg(&out).arg("--headless");
    command.env("SIDECARM_BREAKS", "slow-register:700").env("TERM", "xterm");
    let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(terminal).spawn().expect("the program starts");
    let mut program = Running(child);
    let over = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&over);
    let reader = std::thread::spawn(move || {
        let (mut text, mut buffer) = (Vec::new(), [0; 4096]);
        loop {
            match ours.read(&mut buffer) {
                Ok(0) => return String::from_utf8_lossy(&text).into_owned(),
                Ok(count) => text.extend_from_slice(&buffer[..count]),
                Err(error) if error.kind() == ErrorKind::TimedOut && !told.load(Ordering::Relaxed) => {}
                Err(_) => return String::from_utf8_lossy(&text).into_owned(),
            }
        }
    });
    let log = out.join("session.mcap");
    assert!(eventually(HANG_S, || log.exists().then_some(())).is_some(), "it begins");
    deliver(&files, &lab);
    // A log that has just been begun may not open yet.
    let images = || {
        let entries = read_log(&log).map(|log| log.entries).unwrap_or_default();
        entries.iter().filter(|entry| &*entry.topic == topic::FRAME_PIXELS).count()
    };
    let recorded = eventually(HANG_S, || (images() == FRAMES).then_some(()));
    program.signal(Signal::INT);
    let status = program.end(HANG_S);
    over.store(true, Ordering::Relaxed);
    let words = reader.join().expect("it reads to the end");
    drop(theirs);
    assert!(recorded.is_some() && status.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{status:?} {words}");
    let steps = (0..=FRAMES).filter(|done| words.contains(&format!("{done}/{FRAMES}"))).count();
    assert!(words.contains("finishing") && steps >= 1, "no bar is seen: {words}");
    let counted: Vec<usize> = (0..=FRAMES).filter(|done| words.contains(&format!("finishing {done} of {FRAMES}"))).collect();
    assert!(counted.is_empty(), "{counted:?} are counted beside the bar: {words}");
    assert!(words.contains("Ctrl-C again leaves at once, the log is complete"), "{words}");
}
