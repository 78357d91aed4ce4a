//! Parts of a session that hang: the others go on, and it is said which one does not.
#![cfg(target_os = "linux")]

use crate::acquire_foreign::readers;
use crate::live_lab::{HANG_S, Live, Signal, deliver, eventually, many_images, quiet_lab};

/// One file on a slow share, or one that a reader hangs on, held up every frame after it, without a word.
#[test]
fn a_file_that_is_slow_to_read_is_passed_by_the_next_and_said() {
    const IMAGES: usize = 24;
    let Some((lab, frame, folder)) = quiet_lab("90") else { return };
    let lab = lab.without_ct();
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    let [run, next] = ["run.dcm", "next.dcm"].map(|name| folder.path().join(name));
    many_images(&frame, IMAGES, &run);
    std::fs::copy(&frame, &next).expect("copied");
    // The helper that stands ready gets the first file.
    let held = eventually(HANG_S, || readers(live.program.id()).pop()).expect("a helper stands ready");
    rustix::process::kill_process(held, Signal::STOP).expect("it is there");
    deliver(&[run], &lab);
    let said = eventually(20.0, || live.stderr().contains("reading its file takes long (").then_some(()));
    assert!(said.is_some(), "nobody says what is slow: {}", live.stderr());
    assert_eq!(live.heard().images, 0, "it is held");
    deliver(&[next], &lab);
    // A reader is killed after half a minute: until then the next frame must have come.
    let passed = eventually(20.0, || (live.heard().images == 1).then_some(()));
    assert!(passed.is_some(), "the next frame waits: {}", live.stderr());
    rustix::process::kill_process(held, Signal::CONT).expect("it is there");
    let all = eventually(HANG_S, || (live.heard().images == 1 + IMAGES).then_some(()));
    assert!(all.is_some(), "{} images: {}", live.heard().images, live.stderr());
    live.program.signal(Signal::INT);
    live.program.signal(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());
    assert_eq!(live.heard().frames.len(), 2);
}
